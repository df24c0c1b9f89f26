from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from cdpipe.config import MergeConfig
from cdpipe.merge import merge_maps
from cdpipe.refine import _held
from cdpipe.types import MappedSession


@pytest.mark.parametrize("scales", [(1.005, 0.995), (0.995, 1.005), (1.0, 1.0)])
def test_maps_that_stretch_differently_are_aligned_where_the_robot_stood(
    looking_ahead: Callable[[int, float], MappedSession], scales: tuple[float, float]
) -> None:
    # a sensor that looks ahead puts every face where the odometry stood some metres before it
    before, after = (looking_ahead(sample, scale) for sample, scale in enumerate(scales, 1))
    merged = merge_maps(before, after, MergeConfig(fallback=False))
    assert merged.is_accepted
    assert merged.local is not None
    path = after.map.odom_T_keyframe[:, :3, 3]
    errors_m = np.linalg.norm(merged.local.to_map(path) - path * scales[0] / scales[1], axis=1)
    assert np.median(errors_m) < 0.01
    assert np.percentile(errors_m, 95) < 0.02


def test_a_smooth_wall_holds_nothing_along_itself() -> None:
    # 300 normals across x, each off by some degrees: what they seem to hold along x is their noise
    rng = np.random.default_rng(0)
    normals = np.column_stack([rng.normal(0, 0.08, 300), np.repeat(np.eye(3)[1:, 1:], 150, axis=0)])
    jacobian = np.hstack([np.cross(rng.uniform(-4, 4, (300, 3)), normals), normals])
    information = jacobian.T @ jacobian
    held = _held(information[None])[0]
    assert information[3, 3] > 1.5
    assert np.linalg.eigvalsh(held[3:, 3:])[0] == pytest.approx(0.0, abs=1e-6)
    assert np.linalg.eigvalsh(held)[0] > -1e-6
    np.testing.assert_allclose(np.diag(held)[4:], np.diag(information)[4:], rtol=0.05)
    np.testing.assert_array_equal(held[:3, :3], information[:3, :3])
