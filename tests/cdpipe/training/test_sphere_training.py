from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from cdpipe.core.errors import InputError
from cdpipe.descriptors.sphere_image import COLUMNS, REACH_M, ROWS
from cdpipe.descriptors.sphere_network import SECTORS, make_untrained_sphere_network
from cdpipe.training import sphere_training
from cdpipe.training.fit import FitConfig
from cdpipe.training.sphere_training import (
    BATCH,
    SphereData,
    SphereTask,
    fit_platt,
    local_scores,
    pooled_scores,
    sector_targets,
)

WIDE = COLUMNS // SECTORS


def _walls(n: int, changed: dict[int, tuple[int, int]], distance_m: float = 3.0) -> SphereData:
    """N keyframes a metre apart in a round tunnel; of each of `changed` a block stands at (row, sector) afterwards."""
    before = torch.full((n, ROWS, COLUMNS), distance_m) + 0.02 * torch.rand(
        n, ROWS, COLUMNS, generator=torch.Generator().manual_seed(n)
    )
    after, marks = before.clone(), torch.zeros(n, ROWS, COLUMNS, dtype=torch.uint8)
    for index, (row, sector) in changed.items():
        block = slice(row, row + 3), slice(sector * WIDE, sector * WIDE + 4)
        after[index][block] = distance_m - 1.0
        marks[index][block] = 1
    labels = np.array([1 if index in changed else 0 for index in range(n)], dtype=np.int64)
    return SphereData(
        before,
        after[:, None],
        torch.zeros(n, ROWS, COLUMNS, dtype=torch.uint8),
        marks[:, None],
        np.column_stack([10.0 * np.arange(n), np.zeros(n), np.zeros(n)]),
        labels,
        np.zeros(n, dtype=np.int64),
        np.full(n, 4.5),
    )


def test_targets_by_hand() -> None:
    nothing = torch.zeros(1, ROWS, COLUMNS, dtype=torch.uint8)
    marks = nothing.clone()
    marks[0, ROWS // 2, :3] = 1  # three pixels of sector 0: changed
    marks[0, ROWS // 2, WIDE] = 1  # one pixel of sector 1: neither
    marks[0, 0, 2 * WIDE : 3 * WIDE] = 1  # sector 2, but in a row that the neighbour answers for
    marks[0, ROWS // 2, 3 * WIDE : 4 * WIDE] = 2  # sector 3: a change that does not count
    expected = torch.zeros(1, SECTORS)
    expected[0, 0], expected[0, 1], expected[0, 3] = 1, -1, -1
    torch.testing.assert_close(sector_targets(marks, nothing), expected)
    torch.testing.assert_close(sector_targets(nothing, marks), expected)


@pytest.fixture(name="as_simulated")
def as_simulated_fixture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tunnels as wide and maps as dense as they were simulated."""
    monkeypatch.setattr(sphere_training, "_LOG_SCALE", 0.0)
    monkeypatch.setattr(sphere_training, "_MAX_MISSING", 0.0)


def test_another_width_and_density_change_no_place_and_no_target() -> None:
    data = _walls(12, {0: (6, 2), 1: (7, 9), 2: (5, 14)})
    task = SphereTask(make_untrained_sphere_network(), data, data, seed=3)
    before, after, targets = task.batch(0)
    seen = (before > 0).float().flatten(1).mean(dim=1), (after > 0).float().flatten(1).mean(dim=1)
    for share in seen:
        assert 0.65 < share.min() < 0.8 < 0.95 < share.max() <= 1.0
    # both images of a pair are scaled alike: where nothing stands the walls agree
    is_wall = (before > 0) & (after > 0) & ((before - after).abs() < 0.3)
    torch.testing.assert_close(before[is_wall], after[is_wall], atol=1e-5, rtol=0)
    walls = torch.stack([image[image > 0].median() for image in before])
    assert 3.0 / 1.65 < walls.min() < 2.2 and 4.2 < walls.max() < 3.0 * 1.65
    assert before.max() <= REACH_M and (targets == 1).any(dim=1).sum() > BATCH // 2


@pytest.mark.usefixtures("as_simulated")
def test_a_batch_keeps_images_and_targets_together_under_every_turn() -> None:
    data = _walls(12, {0: (6, 2), 1: (7, 9), 2: (5, 14)})
    task = SphereTask(make_untrained_sphere_network(), data, data, seed=3)
    n_changed = []
    for step in range(24):
        before, after, targets = task.batch(step)
        assert before.shape == after.shape == (BATCH, ROWS, COLUMNS)
        differs = ((before - after).abs() > 0.5)[:, ROWS // 4 : -ROWS // 4].sum(dim=1)
        per_sector = differs.reshape(BATCH, SECTORS, WIDE).sum(dim=2)
        # wherever the images differ by the block, and nowhere else, the target says so
        assert ((targets == 1) == (per_sector >= 3)).all()
        assert (targets[per_sector == 0] == 0).all()
        n_changed.append(int((targets == 1).any(dim=1).sum()))
    assert min(n_changed) > BATCH // 2  # the changed half, and what was pasted into the other
    torch.testing.assert_close(task.batch(5)[1], task.batch(5)[1], rtol=0, atol=0)


@pytest.mark.usefixtures("as_simulated")
def test_training_tells_where_the_blocks_stand() -> None:
    training = _walls(24, {index: (4 + index % 5, (5 * index) % SECTORS) for index in range(12)})
    validation = _walls(10, {0: (6, 3), 4: (5, 11), 7: (8, 6)})
    task = SphereTask(make_untrained_sphere_network(), training, validation, seed=0)
    optimiser = torch.optim.AdamW(task.network.parameters(), lr=FitConfig().learning_rate)
    losses = []
    for step in range(150):  # how fast the first ones go depends on the processor
        optimiser.zero_grad()
        loss = torch.stack(list(task.losses(step).values())).sum()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        losses.append(loss.item())
    assert np.mean(losses[-5:]) < 0.7 * np.mean(losses[:5])
    assert task.scores()["auroc"] == 1.0


def test_a_keyframe_with_ignored_sectors_alone_is_not_called_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    data = _walls(12, {0: (6, 2), 1: (7, 9), 2: (5, 14)})
    task = SphereTask(make_untrained_sphere_network(), data, data, seed=3)
    before, after, targets = task.batch(0)
    told = task.losses(0)["keyframe"]
    unsure = targets.clone()
    unsure[-1] = torch.where(torch.arange(SECTORS) == 4, -1.0, 0.0)  # something hardly stands out there
    monkeypatch.setattr(task, "batch", lambda _: (before, after, unsure))
    without = task.losses(0)["keyframe"]
    monkeypatch.setattr(task, "batch", lambda _: (before[:-1], after[:-1], targets[:-1]))
    torch.testing.assert_close(without, task.losses(0)["keyframe"])
    assert without != told


def test_scores_are_agreed_on_by_neighbours_and_reach_the_radius() -> None:
    data = _walls(6, {2: (6, 3)})
    near = replace(data, positions=data.positions / 5.0)  # 2 m apart
    network = make_untrained_sphere_network()
    with torch.inference_mode():
        sectors = network(data.before_m, data.after_m[:, 0]).numpy().astype(np.float64)
    # 10 m apart nobody has a neighbour
    np.testing.assert_allclose(pooled_scores(network, data, 0), sectors.max(axis=1), rtol=1e-6)
    padded = np.concatenate([sectors[:1], sectors, sectors[-1:]])
    alone = ((padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4).max(axis=1)
    # 4.5 m reach two on either side
    expected = [alone[max(0, k - 2) : k + 3].max() for k in range(6)]
    np.testing.assert_allclose(pooled_scores(network, near, 0), expected, rtol=1e-6)


def test_what_is_compared_is_what_storing_left() -> None:
    data = _walls(6, {2: (6, 3)})
    network = make_untrained_sphere_network()
    with torch.inference_mode():
        spheres, after = network.encode(data.before_m), data.after_m[:, 0]
        halved = network.compare(spheres / 2, after).amax(dim=1).numpy()
        whole = network.compare(spheres, after).amax(dim=1).numpy()
    found = local_scores(network, data, 0, lambda stored: stored / 2)
    np.testing.assert_allclose(found, halved, rtol=1e-5)
    np.testing.assert_allclose(local_scores(network, data, 0), whole, rtol=1e-5)
    assert np.abs(halved - whole).max() > 1e-4


def test_calibration_by_hand() -> None:
    # of those scored 1 three in four are positive, of those scored -1 one in four. Platt's targets are 5/6 and 1/6:
    # (3 x 5/6 + 1/6) / 4 = 2/3, log-odds log 2 and -log 2
    scores = np.repeat([1.0, -1.0], 4)
    slope, offset, likelihood = fit_platt(scores, np.array([1, 1, 1, 0, 1, 0, 0, 0], dtype=np.bool_))
    np.testing.assert_allclose([slope, offset], [np.log(2), 0.0], atol=1e-3)
    assert likelihood == pytest.approx(2 / 3 * np.log(2 / 3) + 1 / 3 * np.log(1 / 3), abs=1e-6)


def test_the_calibration_goes_with_the_weights() -> None:
    data = _walls(12, {0: (6, 3), 4: (5, 11), 7: (8, 6)})
    task = SphereTask(make_untrained_sphere_network(), data, data, seed=0)
    said = task.finish()
    kept = make_untrained_sphere_network()
    kept.load_state_dict(task.network.state_dict())
    expected = said["slope"] * -2.0 + said["offset"]
    assert float(kept.calibrate(torch.tensor(-2.0))) == pytest.approx(expected)


def test_classes_that_are_wholly_apart_get_a_curve() -> None:
    slope, offset, _ = fit_platt(np.array([-4.0, -3.0, 2.0, 3.0]), np.array([0, 0, 1, 1], dtype=np.bool_))
    assert 0.1 < slope < 5
    assert -3.0 < -offset / slope < 2.0


def test_a_ranking_the_wrong_way_round_earns_no_curve() -> None:
    scores, labels = np.array([-2.0, -1.5, 1.0, 2.0, 0.1]), np.array([1, 1, 0, 0, 0], dtype=np.bool_)
    slope, _, likelihood = fit_platt(scores, labels)
    assert slope == pytest.approx(0.0, abs=1e-6)
    assert likelihood < fit_platt(-scores, labels)[2]


def test_validation_without_both_classes_is_refused() -> None:
    data = _walls(12, {0: (6, 3), 4: (5, 11), 7: (8, 6)})
    for label in (0, 1):
        alone = replace(data, labels=np.full_like(data.labels, label))
        with pytest.raises(InputError, match="make more validation tunnels"):
            SphereTask(make_untrained_sphere_network(), data, alone, seed=0)
