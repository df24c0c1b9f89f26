"""Widths of drifts that are known, and the radii that follow from them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, make_pose, transform, yaw_pose
from cdpipe.model.config import QueryConfig
from cdpipe.model.types import PointMap
from cdpipe.query.drift_width import keyframe_radii, measure_widths, score_radii

HEIGHT_M = 3.0
SENSOR_M = 1.0  # above the floor, as z = 0


def wall(start: tuple[float, float], end: tuple[float, float]) -> Float64Array:
    """Points every 0.2 m of an upright wall between two places in plan."""
    length_m = float(np.hypot(end[0] - start[0], end[1] - start[1]))
    along = np.linspace(0.0, 1.0, int(length_m / 0.2) + 1)
    up_m = np.arange(-SENSOR_M, HEIGHT_M - SENSOR_M, 0.2)
    plan = np.array(start) + along[:, None] * (np.array(end) - np.array(start))
    return np.column_stack([np.repeat(plan, len(up_m), axis=0), np.tile(up_m, len(plan))])


def floor(x_m: tuple[float, float], y_m: tuple[float, float]) -> Float64Array:
    x, y = np.meshgrid(np.arange(*x_m, 0.2), np.arange(*y_m, 0.2))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -SENSOR_M)])


def tunnel(width_m: float, length_m: float = 60.0, mouths_m: tuple[tuple[float, float], ...] = ()) -> Float64Array:
    """A straight drift along x, centred on y = 0; at its mouths the left wall is open, into a crosscut of 30 m."""
    side_m = width_m / 2
    parts = [wall((0.0, -side_m), (length_m, -side_m)), floor((0.0, length_m), (-side_m, side_m))]
    start = 0.0
    for first, last in (*mouths_m, (length_m, length_m)):
        parts.append(wall((start, side_m), (first, side_m)))
        if last < length_m:
            parts += [wall((each, side_m), (each, side_m + 30.0)) for each in (first, last)]
        start = last
    return np.concatenate(parts)


def path(length_m: float = 60.0, y_m: float = 0.0) -> Float64Array:
    return np.array([(x, y_m, 0.0) for x in np.arange(2.0, length_m - 1.0)])


def radii(points: Float64Array, odom_T_sensor: Float64Array, radius_m: float | str = "width") -> Float64Array:
    return keyframe_radii(*session(points, odom_T_sensor), QueryConfig(radius_m=radius_m))


def session(points: Float64Array, odom_T_sensor: Float64Array) -> tuple[PointMap, np.ndarray]:
    n, none = len(odom_T_sensor), np.zeros(0, np.int32)
    nearest_m = np.ones(len(points), np.float32)
    point_map = PointMap(points, nearest_m, 0.2, odom_T_sensor, np.arange(n), none, none, np.zeros(n + 1, np.int64))
    return point_map, np.arange(n)


@pytest.mark.parametrize("width_m", [2.5, 5.0, 8.0, 12.0])
@pytest.mark.parametrize("aside", [0.0, 0.3])
def test_a_known_width_from_wherever_in_the_drift_it_is_measured(width_m: float, aside: float) -> None:
    found = measure_widths(tunnel(width_m), path(y_m=aside * width_m))
    np.testing.assert_allclose(found, width_m, rtol=0.02, atol=0.1)


def test_turning_the_map_changes_nothing() -> None:
    pose = yaw_pose(0.3, (40.0, -7.0, 2.0))
    found = measure_widths(transform(pose, tunnel(5.0)), transform(pose, path()))
    np.testing.assert_allclose(found, 5.0, rtol=0.01, atol=0.05)


def test_a_turned_and_pitched_sensor_measures_the_same() -> None:
    points, positions = tunnel(9.0), path()
    level = make_pose(translation=positions)
    tilted = make_pose(Rotation.from_euler("zyx", (100.0, 20.0, 5.0), degrees=True).as_matrix()[None], positions)
    np.testing.assert_array_equal(radii(points, tilted), radii(points, level))


def test_a_junction_and_a_parked_vehicle_change_nothing() -> None:
    points = tunnel(5.0, mouths_m=((25.0, 30.0),))
    np.testing.assert_allclose(measure_widths(points, path()), 5.0, atol=0.1)
    vehicle = np.concatenate([wall((40.0, -0.9), (45.0, -0.9)), wall((40.0, -0.9), (40.0, -2.5))])
    is_behind = (points[:, 1] < -0.9) & (points[:, 0] > 40.0) & (points[:, 0] < 45.0)
    hidden = np.concatenate([points[~is_behind], vehicle])
    np.testing.assert_allclose(measure_widths(hidden, path()), 5.0, atol=0.1)


def test_the_width_follows_the_drift_from_a_narrow_stretch_to_a_wide_one() -> None:
    wide = tunnel(11.0) + np.array([60.0, 0.0, 0.0])
    found = measure_widths(np.concatenate([tunnel(5.0), wide]), path(120.0))
    np.testing.assert_allclose(found[[10, 100]], [5.0, 11.0], atol=0.1)
    assert (np.diff(found) > -0.1).all()


def test_a_standing_session_measures_the_drift_it_stands_in() -> None:
    jitter = np.random.default_rng(0).normal(0.0, 0.01, (5, 3))
    across = make_pose(
        Rotation.from_euler("z", 90.0, degrees=True).as_matrix()[None], jitter + np.array([30.0, 0.5, 0.0])
    )
    np.testing.assert_allclose(measure_widths(tunnel(5.0), across[:, :3, 3]), 5.0, atol=0.1)
    np.testing.assert_array_equal(radii(tunnel(5.0), across), np.full(5, 4.5))


def test_a_keyframe_without_points_has_the_smaller_radius_and_an_open_hall_the_larger_one() -> None:
    points = tunnel(11.0)
    positions = np.concatenate([path(), [(30.0, 500.0, 0.0)]])
    assert np.isnan(measure_widths(points, positions)[-1])
    assert radii(points, make_pose(translation=positions))[[0, -1]].tolist() == [10.0, 4.5]
    hall = floor((-30.0, 30.0), (-30.0, 30.0))  # no wall in reach
    assert measure_widths(hall, np.zeros((1, 3))).tolist() == [np.inf]
    assert radii(hall, make_pose(translation=np.zeros((1, 3)))).tolist() == [10.0]
    for nothing in (np.zeros((0, 3)), points):
        assert measure_widths(nothing, np.zeros((0, 3))).shape == (0,)
    assert np.isnan(measure_widths(np.zeros((0, 3)), path())).all()


def test_one_keyframe_without_points_has_the_width_of_its_neighbours() -> None:
    found = measure_widths(tunnel(5.0), np.concatenate([path(), [(30.0, 0.0, 50.0)]]))
    assert np.isnan(found[-1])
    near = measure_widths(tunnel(5.0), np.concatenate([path()[:5], [(1.0, -7.0, 11.9)]]))
    np.testing.assert_allclose(near[:5], 5.0, atol=0.1)


@pytest.mark.parametrize(
    ("width_m", "radius_m", "score_m"),
    # the middle of 8 and 10.5 m has the middle of 4.5 and 10 m; for scores the range is 7 to 8.5 m
    [(2.5, 4.5, 4.5), (6.6, 4.5, 4.5), (7.75, 4.5, 7.25), (9.25, 7.25, 10.0), (12.0, 10.0, 10.0)],
)
def test_radii_by_hand(width_m: float, radius_m: float, score_m: float) -> None:
    poses = make_pose(translation=path())
    np.testing.assert_allclose(radii(tunnel(width_m), poses), radius_m, atol=0.15)
    of_scores = score_radii(*session(tunnel(width_m), poses), QueryConfig(radius_m="width"))
    np.testing.assert_allclose(of_scores, score_m, atol=0.25)


def test_a_fixed_radius_asks_for_no_map() -> None:
    poses = make_pose(translation=path())
    np.testing.assert_array_equal(radii(np.zeros((0, 3)), poses, 6.0), np.full(len(poses), 6.0))
