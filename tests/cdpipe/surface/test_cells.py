"""Near returns and cells of a room that a sensor drove through in steps of 0.25 m."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, transform
from cdpipe.model.types import MergedMaps
from cdpipe.surface.cells import CELL_M, N_FOLDS, NearReturns, make_cells, near_returns, number_cells
from cdpipe.surface.motions import PathMotions
from tests.cdpipe.rooms import RoomScans

STEP_M, REACH_M = 0.25, 16.0
PATH = tuple((x, 0.0, 1.5) for x in np.arange(-3.0, 3.01, STEP_M).tolist())
AFTER = np.diag([-1.0, -1.0, 1.0, 1.0])


@pytest.fixture(name="merged", scope="module")
def merged_fixture() -> MergedMaps:
    room = RoomScans((), 1, PATH)
    turned = RoomScans((), 2, PATH, odom_T_room=AFTER)
    return MergedMaps(room.mapped(), turned.mapped(), np.linalg.inv(AFTER), {}, True)


@pytest.fixture(name="returns", scope="module")
def returns_fixture(merged: MergedMaps) -> NearReturns:
    return near_returns(merged, "before")


def all_returns(merged: MergedMaps) -> tuple[Float64Array, Float64Array, Float64Array]:
    """(N, 3) every return within reach, (N,) its scan's path position, (N,) its inverse variance."""
    points, path_m, weights = [], [], []
    for scan, pose in enumerate(merged.before.odom_T_sensor):
        found = merged.before.positions_of(slice(*merged.before.scan_offsets[scan : scan + 2]))
        range_m = np.linalg.norm(found - pose[:3, 3], axis=1)
        near = range_m < REACH_M
        points.append(found[near])
        path_m.append(np.full(near.sum(), scan * STEP_M))
        weights.append(1 / (0.015**2 + (np.deg2rad(0.09) ** 2 + 0.01**2) * range_m[near] ** 2))
    return np.concatenate(points), np.concatenate(path_m), np.concatenate(weights)


def test_every_return_is_in_one_mean(merged: MergedMaps, returns: NearReturns) -> None:
    points, _, weights = all_returns(merged)
    assert returns.counts.sum() == len(points)
    assert len(returns.points) < 0.8 * len(points)
    assert returns.weights.sum() == pytest.approx(weights.sum())
    assert np.allclose(returns.weights @ returns.points, weights @ points)


def test_cells_are_those_of_all_returns(merged: MergedMaps, returns: NearReturns) -> None:
    points, path_m, weights = all_returns(merged)
    _, cell_of = np.unique(np.floor(points / CELL_M), axis=0, return_inverse=True)
    counts = np.bincount(cell_of)
    means = np.stack([np.bincount(cell_of, weights * axis) / np.bincount(cell_of, weights) for axis in points.T], 1)
    cells = make_cells(returns)
    assert np.allclose(cells.points, means[counts >= 2], atol=1e-9)
    of_fold = np.floor(path_m).astype(np.int64) % N_FOLDS == 1
    fold_weights = np.bincount(cell_of[of_fold], weights[of_fold], len(counts))
    fold_sums = np.bincount(cell_of[of_fold], weights[of_fold] * points[of_fold, 0], len(counts))
    known = (fold_weights > 0) & (counts >= 2)
    fold_x = cells.points[:, 0] + cells.fold_offsets[:, 1, 0]
    assert np.array_equal(np.isfinite(fold_x), known[counts >= 2])
    assert np.allclose(fold_x[np.isfinite(fold_x)], fold_sums[known] / fold_weights[known], atol=1e-6)


def test_the_after_session_is_laid_on_the_before_session(merged: MergedMaps, returns: NearReturns) -> None:
    after = near_returns(merged, "after")
    assert np.allclose(after.points.min(axis=0), returns.points.min(axis=0), atol=0.05)
    assert np.allclose(after.map_T_sensor[:, :3, 3], np.array(PATH), atol=1e-9)


def test_a_motion_is_taken_off_and_cells_stay_together(returns: NearReturns) -> None:
    slide = np.array([[0.0, 0.0, 0.0, 0.03, -0.01, 0.02]])
    motions = PathMotions(0.0, np.zeros((1, 3)), slide, np.full((1, 6, 6), np.nan))
    moved, before = make_cells(returns.without(motions)), make_cells(returns)
    assert np.allclose(moved.points, before.points - slide[0, 3:], atol=1e-9)
    assert np.array_equal(np.isnan(moved.fold_offsets), np.isnan(before.fold_offsets))


def test_a_turn_is_taken_off_about_its_centre(returns: NearReturns) -> None:
    turn, centre = np.array([0.0, 0.0, 1e-4]), np.array([[1.0, 2.0, 0.0]])
    motions = PathMotions(0.0, centre, np.append(turn, np.zeros(3))[None], np.full((1, 6, 6), np.nan))
    rotation = np.eye(4)
    rotation[:2, :2] = [[1, turn[2]], [-turn[2], 1]]
    expected = transform(rotation, returns.points - centre) + centre
    assert np.allclose(returns.without(motions).points, expected, atol=1e-9)


@pytest.mark.parametrize("threads", ["1", "3"])
def test_threads_change_nothing(
    threads: str, merged: MergedMaps, returns: NearReturns, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", threads)
    again = near_returns(merged, "before")
    assert np.array_equal(again.points, returns.points)
    assert np.array_equal(make_cells(again).fold_offsets, make_cells(returns).fold_offsets, equal_nan=True)


def test_stretches_are_put_together_in_order(
    merged: MergedMaps, returns: NearReturns, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cdpipe.surface.cells._STRETCHES", 2)
    again = near_returns(merged, "before")
    assert np.array_equal(again.points, returns.points)
    assert np.array_equal(again.cell_of, returns.cell_of)


def test_stations_share_no_fold_wherever_they_stand(returns: NearReturns) -> None:
    n = len(returns.points)
    places = np.repeat(np.arange(4), -(-n // 4))[:n]
    for apart_m in (4.0, 4.5, 8.0):
        cells = make_cells(replace(returns, path_m=apart_m * places, cell_of=np.zeros(n, np.int64)))
        assert np.isfinite(cells.fold_offsets).all(), apart_m


def test_without_folds_the_cells_are_the_same(returns: NearReturns) -> None:
    cells, folded = make_cells(returns, with_folds=False), make_cells(returns)
    assert np.allclose(cells.points, folded.points, atol=1e-12)
    assert cells.fold_offsets.shape == (len(folded.points), 1, 3)


def test_cells_are_numbered_by_their_keys() -> None:
    keys = np.array([7, 7, -2, 40, 7, -2])
    assert number_cells(keys).tolist() == [1, 1, 0, 2, 1, 0]
    assert number_cells(keys[:0]).shape == (0,)
