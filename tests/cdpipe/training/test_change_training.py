from __future__ import annotations

import numpy as np
import pytest
import torch

from cdpipe.core.errors import InputError
from cdpipe.core.ranking import average_precision
from cdpipe.descriptors.change_network import make_untrained_change_network
from cdpipe.descriptors.sphere_image import COLUMNS, REACH_M, ROWS
from cdpipe.training import sphere_training
from cdpipe.training.change_training import BATCH, ChangeTask, visible_mask
from cdpipe.training.sphere_training import SphereData

WALL_M, BLOCK_M = 3.0, 2.0


def walls(n: int, changed: dict[int, tuple[int, int]]) -> SphereData:
    """N keyframes of a round tunnel; at each of `changed` a block stands at (row, column) afterwards."""
    noise = torch.rand(n, ROWS, COLUMNS, generator=torch.Generator().manual_seed(n))
    before = WALL_M + 0.02 * noise
    after, marks = before.clone(), torch.zeros(n, ROWS, COLUMNS, dtype=torch.uint8)
    for index, (row, column) in changed.items():
        block = slice(row, row + 4), slice(column, column + 6)
        after[index][block] = BLOCK_M
        marks[index][block] = 1
    nothing = torch.zeros(n, ROWS, COLUMNS, dtype=torch.uint8)
    positions = np.column_stack([10.0 * np.arange(n), np.zeros((n, 2))])
    labels = np.array([int(index in changed) for index in range(n)])
    tunnels, radii_m = np.zeros(n, dtype=np.int64), np.full(n, 4.5)
    return SphereData(before, after[:, None], nothing, marks[:, None], positions, labels, tunnels, radii_m)


@pytest.fixture(name="as_simulated")
def as_simulated_fixture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tunnels as wide and maps as dense as they were simulated."""
    monkeypatch.setattr(sphere_training, "_LOG_SCALE", 0.0)
    monkeypatch.setattr(sphere_training, "_MAX_MISSING", 0.0)


def test_visible_is_what_the_other_session_looked_at_or_through() -> None:
    own = torch.tensor([[[3.0, 3.0, 3.0, 3.0, 3.0]]])
    other = torch.tensor([[[3.0, 5.0, 2.75, 2.5, 0.0]]])
    nothing = torch.zeros(1, 1, 5, dtype=torch.uint8)
    assert visible_mask(own, other, nothing).tolist() == [[[True, True, True, False, False]]]
    # what the truth calls observable was seen, and what it does not is as the images say
    assert visible_mask(own, other, nothing + 1).all()
    assert visible_mask(own, other, nothing + 2).tolist() == [[[True, True, True, False, False]]]


@pytest.mark.usefixtures("as_simulated")
def test_a_batch_keeps_images_marks_and_visibility_together_under_every_turn() -> None:
    data = walls(12, {0: (6, 12), 1: (7, 54), 2: (5, 84)})
    task = ChangeTask(make_untrained_change_network(), data, data, seed=3)
    firsts = set()
    for step in range(24):
        own, other, marks, is_visible = task.batch(step)
        assert own.shape == other.shape == marks.shape == is_visible.shape == (BATCH, ROWS, COLUMNS)
        stands, hides = own < other - 0.5, other < own - 0.5
        assert ((marks == 1) == stands).all()
        assert (is_visible == ~hides).all()
        # a block is in every keyframe of the first half, and pasted into a quarter; in one session or the other
        blocks = (stands | hides).flatten(1).any(dim=1)
        assert blocks[: BATCH // 2 + BATCH // 4].all()
        firsts.add((bool(stands.any()), bool(hides.any())))
    assert firsts == {(True, False), (False, True)}
    for one, again in zip(task.batch(5), task.batch(5), strict=True):
        torch.testing.assert_close(one, again, rtol=0, atol=0)


def test_another_width_and_density_change_no_mark() -> None:
    data = walls(12, {0: (6, 12), 1: (7, 54), 2: (5, 84)})
    own, other, marks, is_visible = ChangeTask(make_untrained_change_network(), data, data, seed=3).batch(1)
    for image in (own, other):
        shares = (image > 0).float().flatten(1).mean(dim=1)
        assert 0.65 < shares.min() < 0.8 < 0.95 < shares.max() <= 1.0 and image.max() <= REACH_M
    # visibility is that of the maps, not of what was left of them
    assert is_visible[(other == 0) & (own > 0)].any()
    both = (own > 0) & (other > 0)
    assert ((marks == 1) == (own < 0.8 * other))[both].all()


@pytest.mark.usefixtures("as_simulated")
def test_training_finds_the_blocks() -> None:
    training = walls(16, {index: (2 + index, 9 * index) for index in range(8)})
    validation = walls(10, {0: (6, 12), 4: (5, 60), 7: (8, 33)})
    task = ChangeTask(make_untrained_change_network(), training, validation, seed=0)
    before = task.scores()
    optimiser = torch.optim.AdamW(task.network.parameters(), lr=5e-3)
    losses = []
    for step in range(25):
        optimiser.zero_grad()
        terms = task.losses(step)
        torch.stack(list(terms.values())).sum().backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        losses.append({name: loss.item() for name, loss in terms.items()})
    for name in ("change", "visibility"):
        assert losses[-1][name] < 0.5 * losses[0][name]
    after = task.scores()
    assert after["average_precision"] > 0.9 > 0.5 > before["average_precision"]
    assert after["visibility_accuracy"] > 0.95


def test_pixels_that_teach_nothing_do_not_count() -> None:
    data = walls(12, {0: (6, 12), 1: (7, 54), 2: (5, 84)})
    unobservable = SphereData(
        **{name: getattr(data, name) for name in SphereData.__dataclass_fields__ if name != "before_marks"},
        before_marks=torch.where(data.before_marks == 0, 2, data.before_marks).to(torch.uint8),
    )
    task = ChangeTask(make_untrained_change_network(), data, unobservable, seed=0)
    # of the before session nothing counts; of the after session what counted before
    scores = task.scores()["average_precision_change_head"]
    with torch.inference_mode():
        change, _ = task.network(data.after_m[:, 0], data.before_m)
    alone = average_precision(change.sigmoid().numpy().ravel(), (data.after_marks[:, 0] == 1).numpy().ravel())
    assert scores == pytest.approx(alone)


def test_training_without_an_object_is_refused_in_one_line() -> None:
    nothing = walls(4, {})
    with pytest.raises(InputError, match="with an object added: make more tunnels"):
        ChangeTask(make_untrained_change_network(), nothing, nothing, seed=0)
