from __future__ import annotations

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, make_pose, transform, transform_each
from cdpipe.merge.held_out import _is_refined_better, choose_alignment
from cdpipe.merge.registration import IndexedMap
from cdpipe.model.config import MergeConfig
from cdpipe.model.types import MappedSession

RADIUS_M, SPACING = 5.0, 4


class Judge:
    """The tunnel, seen again: alignments are given by how far they are off, sideways, in metres."""

    def __init__(self, before: MappedSession, after: MappedSession, true: Float64Array) -> None:
        self.before = IndexedMap(before.map, MergeConfig(), is_target=True, has_coarse_target=False)
        self.after, self.true = after.map, true
        self.n = len(after.map.keyframe_scans)
        self.places = np.arange(0, self.n, SPACING)

    def pose(self, off_m: float) -> Float64Array:
        return make_pose(translation=(0.0, off_m, 0.0)) @ self.true

    def choose(
        self, refined_off_m: Float64Array, rigid_off_m: float | Float64Array, within_m: float = np.inf, every: int = 5
    ) -> tuple[Float64Array | None, dict[str, float]]:
        """Return how far the choice is off at each keyframe (K,), None where it is the rigid one, and the evidence."""
        refined = np.array([self.pose(off_m) for off_m in refined_off_m])
        held_out = self.after.points[::every]
        chosen, evidence = choose_alignment(
            self.before,
            held_out,
            self.after.odom_T_keyframe,
            self.places,
            refined,
            self.pose(rigid_off_m) if isinstance(rigid_off_m, float) else np.array([*map(self.pose, rigid_off_m)]),
            RADIUS_M,
            within_m,
        )
        if chosen is None:
            return None, evidence
        path = self.after.odom_T_keyframe[:, :3, 3]
        np.testing.assert_allclose(chosen[:, :3, :3], np.broadcast_to(self.true[:3, :3], (self.n, 3, 3)), atol=1e-9)
        return (transform_each(chosen, path) - transform(self.true, path))[:, 1], evidence


@pytest.fixture(scope="module")
def judge(tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array) -> Judge:
    return Judge(tunnel_before, tunnel_after, true_before_T_after)


def test_each_place_has_the_alignment_that_fits_and_there_is_no_step_between(judge: Judge) -> None:
    half = judge.n // 2
    off_m, evidence = judge.choose(np.where(np.arange(judge.n) < half, 0.0, 0.4), rigid_off_m=0.1)
    assert off_m is not None
    np.testing.assert_allclose(off_m[: half - 2 * SPACING], 0.0, atol=1e-9)
    np.testing.assert_allclose(off_m[half + 2 * SPACING :], 0.1, atol=1e-9)
    # between two places the rigid share grows by a quarter a keyframe: by at most (0.4 - 0.1) / 4 m
    assert np.abs(np.diff(off_m[half:])).max() < 0.08
    assert evidence["n_judged"] == len(judge.places)
    assert abs(evidence["n_kept"] - len(judge.places) / 2) <= 1
    assert 0 < evidence["rigid_misfit"] < evidence["refined_misfit"] < 1


def test_a_merge_that_bends_is_kept_place_by_place(judge: Judge) -> None:
    half, given_m = judge.n // 2, np.linspace(0.05, 0.25, judge.n)
    off_m, _ = judge.choose(np.where(np.arange(judge.n) < half, 0.0, 0.6), given_m)
    assert off_m is not None
    np.testing.assert_allclose(off_m[: half - 2 * SPACING], 0.0, atol=1e-9)
    np.testing.assert_allclose(off_m[half + 2 * SPACING :], given_m[half + 2 * SPACING :], atol=1e-9)


def test_a_place_and_its_neighbours_decide_together() -> None:
    # sums over a place and its neighbours: -2, -1, 0, 3 eighths
    gains = np.array([1, -3, 1, 2]) / 8
    misfits = np.column_stack([0.5 + gains, np.full(4, 0.5)])
    assert _is_refined_better(misfits).tolist() == [False, False, False, True]
    assert _is_refined_better(misfits[:1]).tolist() == [True]


def test_what_fits_no_better_than_the_rigid_merge_is_not_kept(judge: Judge) -> None:
    for refined_m in (0.0, 0.3):
        off_m, evidence = judge.choose(np.full(judge.n, refined_m), rigid_off_m=0.0)
        assert off_m is None
        assert (evidence["n_judged"], evidence["n_kept"]) == (len(judge.places), 0)


def test_no_place_moves_farther_than_it_may(judge: Judge) -> None:
    refined_m = np.zeros(judge.n)
    off_m, evidence = judge.choose(refined_m, rigid_off_m=0.3, within_m=0.29)
    assert off_m is None and evidence["n_beyond"] == evidence["n_judged"] == len(judge.places)
    off_m, evidence = judge.choose(refined_m, rigid_off_m=0.3, within_m=0.31)
    assert off_m is not None and evidence["n_beyond"] == 0
    assert "n_beyond" not in judge.choose(refined_m, rigid_off_m=0.3)[1]
    np.testing.assert_allclose(off_m, 0.0, atol=1e-9)


def test_without_points_to_judge_the_rigid_merge_holds(judge: Judge) -> None:
    off_m, evidence = judge.choose(np.zeros(judge.n), rigid_off_m=0.3, every=len(judge.after.points))
    assert off_m is None
    assert evidence == {"n_judged": 0.0, "n_kept": 0.0}
