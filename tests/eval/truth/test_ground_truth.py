"""The truth of a pair put together: which changes count, where they lie, and sessions that do not fit."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import make_pose
from eval.truth.ground_truth import (
    SessionTruth,
    SurfaceLabels,
    _load_seen_movers,
    _load_surface,
    ground_truth,
    load_ground_truth,
)
from eval.truth.scoring_points import ScoringPoints
from sim.session.truth import (
    MoverTrack,
    MoverTruth,
    PairTruth,
    read_pair_truth,
    write_mover_track,
    write_pair_truth,
    write_surface_labels,
)
from tests.eval.changes import change
from tests.eval.conftest import CHUNK_SCANS

RETURNS = np.array([0, 7, 13, 17, 24, 29])


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


def test_places_of_movers_and_labels_of_rock_that_do_not_fit_are_named() -> None:
    right, short, fits = session([0, 0]), np.zeros(1), np.zeros(2)
    with pytest.raises(ValueError, match=r"^seen_movers_world must be "):
        replace(right, seen_movers_world=np.zeros((4, 2)))
    with pytest.raises(ValueError, match=r"^surface\.displacement_m must be \(2\), got \(1,\)"):
        replace(right, surface=SurfaceLabels(short.astype(np.float32), fits.astype(np.int16)))
    with pytest.raises(ValueError, match=r"^surface\.change must be \(2\), got \(1,\)"):
        replace(right, surface=SurfaceLabels(fits.astype(np.float32), short.astype(np.int16)))
    assert replace(right, surface=SurfaceLabels(fits.astype(np.float32), fits.astype(np.int16))).surface is not None


def load_surface_labels(folder: Path, n_scans: Sequence[int]) -> SurfaceLabels | None:
    """Write the labels of five scans of 2 x 3 pixels in chunks of two, and load those of six returns.

    The k-th return of the session moved by k mm and belongs to change k mod 5.
    """
    for index, n in enumerate(n_scans):
        number = 12 * index + np.arange(6 * n).reshape(n, 2, 3)
        write_surface_labels(folder, index, (number / 1000).astype(np.float32), (number % 5).astype(np.int16))
    session: Any = SimpleNamespace(path=folder, n_chunks=3, chunk_scans=2, n_scans=5)
    of_points = np.zeros(6, dtype=np.int16)
    return _load_surface(session, ScoringPoints(RETURNS, np.zeros((6, 3), np.float32), of_points, of_points, 5, 6))


def test_every_scoring_point_has_the_movement_of_its_return(tmp_path: Path) -> None:
    assert load_surface_labels(tmp_path / "without", []) is None
    labels = load_surface_labels(tmp_path, (2, 2, 1))
    assert labels is not None
    np.testing.assert_array_equal(labels.displacement_m, (RETURNS / 1000).astype(np.float32))
    np.testing.assert_array_equal(labels.change, RETURNS % 5)
    assert (labels.displacement_m.dtype, labels.change.dtype) == (np.float32, np.int16)


def test_movements_of_a_session_with_other_scans_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"^surface/00002\.npz must be \(1, 6\), got \(2, 6\)"):
        load_surface_labels(tmp_path, (2, 2, 2))


def test_movers_are_seen_where_they_have_returns(tmp_path: Path) -> None:
    assert _load_seen_movers(tmp_path, 0, 3).shape == (0, 3)
    seen_world = np.arange(18.0).reshape(2, 3, 3)
    n_returns = np.array([[0, 1, 2], [3, 0, 0]], dtype=np.int32)
    write_mover_track(tmp_path, MoverTrack(np.tile(np.eye(4), (2, 3, 1, 1)), n_returns, seen_world))
    np.testing.assert_array_equal(_load_seen_movers(tmp_path, 2, 3), seen_world[[0, 0, 1], [1, 2, 0]])
    with pytest.raises(InputError, match="it has 2 movers and 3 revolutions, expected 2 and 4"):
        _load_seen_movers(tmp_path, 2, 4)


def test_a_mover_of_one_session_is_looked_for_there(tiny_pair: Path) -> None:
    n_scans = load_ground_truth(tiny_pair).sessions["after"].scoring_points.n_scans
    mover = MoverTruth("worker", "person", 3, "after", stretch_m=0.0, moving_share=0.0, n_returns=n_scans)
    write_pair_truth(tiny_pair, replace(read_pair_truth(tiny_pair), movers=(mover,)))
    track = MoverTrack(
        np.tile(np.eye(4), (1, n_scans, 1, 1)), np.ones((1, n_scans), np.int32), np.ones((1, n_scans, 3))
    )
    write_mover_track(tiny_pair / "after", track)
    sessions = load_ground_truth(tiny_pair).sessions
    assert [len(sessions[name].seen_movers_world) for name in ("before", "after")] == [0, n_scans]


def test_movements_come_with_the_truth_of_a_pair(tiny_pair: Path) -> None:
    truth = load_ground_truth(tiny_pair, keeps_points=False)
    assert not list(tiny_pair.glob("*/truth/scoring_points.npz"))
    points = truth.sessions["before"].scoring_points
    for index, first in enumerate(range(0, points.n_scans, CHUNK_SCANS)):
        shape = min(CHUNK_SCANS, points.n_scans - first), 1, points.n_pixels
        write_surface_labels(tiny_pair / "before", index, np.full(shape, 0.25, np.float32), np.full(shape, 2, np.int16))
    surface = load_ground_truth(tiny_pair).sessions["before"].surface
    assert surface is not None and (surface.displacement_m == 0.25).all() and (surface.change == 2).all()
    assert len(list(tiny_pair.glob("*/truth/scoring_points.npz"))) == 2
