"""The truth of a pair put together: which changes count, where they lie, and sessions that do not fit."""

from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.geometry import make_pose
from eval.truth.ground_truth import SessionTruth, ground_truth
from eval.truth.scoring_points import ScoringPoints
from sim.session.truth import PairTruth
from tests.eval.changes import change


def session(labels: list[int]) -> SessionTruth:
    """Points at x = 0, 1, 2 ...; the world lies 10 m beside odom."""
    n = len(labels)
    points = np.column_stack([np.arange(n), np.zeros(n), np.zeros(n)]).astype(np.float32)
    change_ids = np.array(labels, dtype=np.int16)
    scoring_points = ScoringPoints(np.arange(n, dtype=np.int64), points, change_ids, change_ids, 2, n)
    odom = np.stack([make_pose(translation=(float(scan), 0.0, 0.0)) for scan in range(2)])
    world = np.stack([make_pose(translation=(float(scan), 10.0, 0.0)) for scan in range(2)])
    return SessionTruth(odom, world, scoring_points)


def test_a_change_without_cells_lies_at_its_object_and_is_never_observable() -> None:
    changes = (
        change(1, world_T_object=make_pose(translation=(7.0, 8.0, 9.0)).tolist()),
        change(2),
        change(3, group="partial"),
        change(4, "before", is_observable=False),
    )
    truth = ground_truth(
        PairTruth("test", 0, 3.0, changes, {}), {"before": session([4, 4]), "after": session([0, 2, 3, 3])}
    )
    # change 2 fills one cell, the least that can be seen
    assert truth.is_observable.tolist() == [False, True, True, False]
    assert truth.is_partial.tolist() == [False, False, True, False]
    np.testing.assert_allclose(truth.centroids_world, [(7, 8, 9), (1, 10, 0), (2.5, 10, 0), (0.5, 10, 0)])
    assert [rows.tolist() for rows in truth.change_rows] == [[], [1], [2, 3], [0, 1]]
    assert truth.n_observable == 2


def test_an_object_in_whole_metres_has_a_place_in_floating_point() -> None:
    whole = change(1, world_T_object=np.eye(4, dtype=np.int64).tolist())
    truth = ground_truth(PairTruth("test", 0, 3.0, (whole,), {}), {"before": session([0]), "after": session([0])})
    assert truth.centroids_world.dtype == np.float64
    none = ground_truth(PairTruth("test", 0, 3.0, (), {}), {"before": session([0]), "after": session([0])})
    assert none.centroids_world.shape == (0, 3) and none.centroids_world.dtype == np.float64


@pytest.mark.parametrize(
    ("name", "change_it", "told"),
    [
        ("odom_T_sensor", lambda poses: 2.0 * poses, r"^odom_T_sensor\[0\] is not"),
        ("world_T_sensor", lambda poses: 2.0 * poses, r"^world_T_sensor\[0\] is not"),
        ("world_T_sensor", lambda poses: poses[:1], r"^world_T_sensor must be \(2, 4, 4\)"),
    ],
)
def test_poses_that_do_not_fit_are_named(name: str, change_it: object, told: str) -> None:
    right = session([0])
    with pytest.raises(ValueError, match=told):
        replace(right, **{name: change_it(getattr(right, name))})
