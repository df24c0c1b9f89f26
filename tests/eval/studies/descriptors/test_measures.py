"""What a network says of held-out tunnels, against hand arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from cdpipe.descriptors.sphere_image import COLUMNS, ROWS
from cdpipe.descriptors.sphere_network import SECTORS, SphereNetwork
from cdpipe.training.sphere_training import SphereData
from eval.studies.descriptors.curves import HeldOut, measures, rounded

# two tunnels, keyframes 10 m apart, so that none has a neighbour
LOG_ODDS = [2.0, -1.0, 0.5, -3.0, 1.0, -2.0]
LABELS = [1, 0, 0, -1, 1, 1]
TUNNELS = [0, 0, 0, 0, 1, 1]


class _Told(SphereNetwork):
    """Says what the first pixel of the after image holds, if the stored number came through whole."""

    def encode(self, images_m: Tensor) -> Tensor:
        return torch.full((len(images_m), self.size.per_sector, SECTORS), 0.49)

    def compare(self, spheres: Tensor, images_m: Tensor) -> Tensor:
        return images_m[:, 0, :1] + 100 * (spheres[:, 0] - 0.49)


def _held() -> HeldOut:
    n = len(LABELS)
    after = torch.zeros(n, 2, ROWS, COLUMNS)
    after[:, 1, 0, 0] = torch.tensor(LOG_ODDS)
    nothing = torch.zeros(n, ROWS, COLUMNS, dtype=torch.uint8)
    positions = np.column_stack([10.0 * np.arange(n), np.zeros(n), np.zeros(n)])
    data = SphereData(
        torch.zeros(n, ROWS, COLUMNS), after, nothing, nothing[:, None], positions,
        np.array(LABELS), np.array(TUNNELS), np.full(n, 4.5),
    )  # fmt: skip
    centroids = np.array([[4.0, 1.0, 0.0], [33.0, 0.0, 0.0], [44.0, 0.0, 0.0], [24.0, 0.0, 0.0], [46.0, 0.0, 0.0]])
    return HeldOut(data, np.array(["wide", "tight"]), centroids, np.array([0, 0, 1, 1, 1]))


def test_measures_by_hand() -> None:
    found = measures(_Told().eval(), _held())
    # of the unchanged -1 and 0.5 one lies above 0
    assert found["unchanged_above_0"] == 0.5 and found["n_unchanged"] == 2
    # found: 4 m from the keyframe at 0, 4 m from that at 40. At 33 the only keyframe near says -3; at 24 the keyframe
    # that says 0.5 is of another tunnel; 46 lies 4 m from -2 at 50 and 6 m from 1 at 40
    assert found["changes_found"] == pytest.approx(2 / 5) and found["n_changes"] == 5
    # the tight tunnel has no unchanged keyframe and so no AUROC of its own
    assert found["auroc"] == found["auroc_wide"] == 1.0 and np.isnan(found["auroc_tight"])
    assert found["changes_found_wide"] == 1 / 2 and found["changes_found_tight"] == pytest.approx(1 / 3)
    of_wide = np.log([1 / (1 + np.exp(-2.0)), 1 / (1 + np.exp(-1.0)), 1 / (1 + np.exp(0.5))])
    of_tight = np.log([1 / (1 + np.exp(-1.0)), 1 / (1 + np.exp(2.0))])
    assert found["log_likelihood_wide"] == pytest.approx(of_wide.mean(), abs=1e-6)
    assert found["log_likelihood"] == pytest.approx((of_wide.sum() + of_tight.sum()) / 5, abs=1e-6)


def test_the_calibration_moves_the_threshold() -> None:
    network = _Told().eval()
    network.calibration.copy_(torch.tensor([2.0, -1.5]))
    # 2 * 0.5 - 1.5 is below 0, and so is all else unchanged; the changes' own 2 and 1 stay above
    found = measures(network, _held())
    assert found["unchanged_above_0"] == 0.0 and found["changes_found"] == pytest.approx(2 / 5)


def test_coarse_numbers_reach_the_comparison() -> None:
    # 0.49 is kept as 0.25 by two bits: 100 * (0.25 - 0.49) pushes everything below 0
    assert measures(_Told().eval(), _held(), bits=2)["changes_found"] == 0.0


def test_rounding_by_hand() -> None:
    numbers = torch.tensor([-0.999, -0.6, -0.1, 0.0, 0.3, 0.999])
    assert rounded(numbers, 32) is numbers
    torch.testing.assert_close(rounded(numbers, 8), torch.tensor([-127, -76, -13, 0, 38, 127]) / 127)
    torch.testing.assert_close(rounded(numbers, 2), torch.tensor([-0.75, -0.75, -0.25, 0.25, 0.25, 0.75]))
    # sixteen cells of 1/8
    torch.testing.assert_close(rounded(numbers, 4), torch.tensor([-15, -9, -1, 1, 5, 15]) / 16)
