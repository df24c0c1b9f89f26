from collections.abc import Sequence

import numpy as np
import pytest

from cdpipe.core.geometry import BoolArray, Float64Array, make_pose, stream, transform, yaw_pose
from cdpipe.methods.erasor import erasor, flat_column_mask, ground_mask
from cdpipe.methods.whole_map import PlacedMaps
from cdpipe.model.config import ErasorConfig, load_config
from cdpipe.model.types import MergedMaps, PointMap, SessionName

SPACING_M = 0.2
SENSOR = (0.0, 0.0, 1.0)
ROOF_M = 2.6
PUBLISHED = ErasorConfig()
AS_PUBLISHED = ("erasor.max_range_m=80", "erasor.max_height_m=3")


def grid(low: Sequence[float], high: Sequence[float]) -> Float64Array:
    axes = [np.arange(a, b - 1e-9, SPACING_M) + SPACING_M / 2 for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def layer(height_m: float) -> Float64Array:
    """A floor or a roof of 24 by 24 m about the sensor."""
    return grid((-12, -12, height_m - SPACING_M / 2), (12, 12, height_m + SPACING_M / 2))


BOX = grid((5, -0.6, 0.2), (6.2, 0.6, 1.4))
FLOOR, ROOF = layer(0.0), layer(ROOF_M)
IN_THE_OPEN, UNDER_A_ROOF = FLOOR, np.concatenate([FLOOR, ROOF])


def found_of(points: Float64Array, scan_points: Float64Array, settings: ErasorConfig = PUBLISHED) -> BoolArray:
    return flat_column_mask(np.concatenate([BOX, points]), scan_points, settings)


def test_a_box_in_the_open_air_is_found_and_the_floor_under_it_is_reverted() -> None:
    found = found_of(IN_THE_OPEN, IN_THE_OPEN)
    # all of the box is more than 0.15 m above the floor
    assert found[: len(BOX)].all()
    assert not found[len(BOX) :].any()


def test_the_same_box_is_not_found_under_a_roof() -> None:
    assert not found_of(UNDER_A_ROOF, UNDER_A_ROOF).any()
    # not the roof is missing in the scan, but what tells the columns apart: without points above 2 m it is found again
    assert found_of(UNDER_A_ROOF, UNDER_A_ROOF, ErasorConfig(max_height_m=2.0))[: len(BOX)].all()


def test_a_roof_beyond_what_a_scan_sees_is_a_false_change() -> None:
    found = found_of(UNDER_A_ROOF, FLOOR)
    assert found[len(BOX) + len(FLOOR) :].mean() > 0.9


@pytest.mark.parametrize(
    ("scan_ratio", "n_scan", "is_found"),
    # of the box's columns the scan saw half of the height: 0.7 of 1.3 m
    [(0.53, 6, False), (0.55, 6, True), (0.55, 5, False)],
)
def test_the_ratio_of_heights_by_hand(scan_ratio: float, n_scan: int, is_found: bool) -> None:
    points = np.column_stack([np.full(14, 10.0), np.full(14, 0.1), np.arange(14) / 10])
    settings = ErasorConfig(scan_ratio=scan_ratio)
    scan = np.concatenate([points[:1], points[7:8], *[points[3:4]] * (n_scan - 2)])
    assert flat_column_mask(points, scan, settings).any() == is_found


def test_a_column_that_is_lower_than_twenty_centimetres_is_no_object() -> None:
    for top_m, is_found in ((0.21, True), (0.19, False)):
        points = np.concatenate([FLOOR, grid((5, -0.6, top_m - 0.1), (6.2, 0.6, top_m + 0.1))])
        assert flat_column_mask(points, FLOOR, PUBLISHED).any() == is_found


def test_the_ground_of_a_slope_is_reverted() -> None:
    columns = np.repeat([7, 3], 400)
    x, y = stream(1, "slope").uniform(-2, 2, (2, 800))
    points = np.column_stack([x, y, 0.2 * x + np.where(columns == 3, 5.0, 0.0)])
    is_object = np.arange(800) % 10 == 0
    points[is_object, 2] += 0.6
    np.testing.assert_array_equal(ground_mask(points, columns), ~is_object)
    turned = transform(yaw_pose(1.0, (4.0, -7.0, 30.0)), points)
    np.testing.assert_array_equal(ground_mask(turned, columns), ~is_object)


def mapped(points: Float64Array, odom_T_room: Float64Array) -> PointMap:
    """A map of given points, all of which one scan hit."""
    n = len(points)
    pose = odom_T_room @ make_pose(translation=SENSOR)
    return PointMap(
        points=transform(odom_T_room, points),
        nearest_m=np.ones(n, np.float32),
        voxel_m=SPACING_M,
        odom_T_sensor=pose[None],
        keyframe_scans=np.zeros(1, np.int64),
        return_points=np.arange(n, dtype=np.int32),
        return_pixels=np.arange(n, dtype=np.int32),
        scan_offsets=np.array([0, n]),
    )


@pytest.mark.parametrize(("room", "is_found"), [(IN_THE_OPEN, True), (UNDER_A_ROOF, False)])
def test_two_sessions_with_and_without_the_box(room: Float64Array, is_found: bool) -> None:
    before_T_after = yaw_pose(0.7, (30.0, -20.0, 12.0))
    with_box = np.concatenate([BOX, room])
    maps_of = {
        "after": (mapped(room, np.eye(4)), mapped(with_box, np.linalg.inv(before_T_after))),
        "before": (mapped(with_box, np.eye(4)), mapped(room, np.linalg.inv(before_T_after))),
    }
    names: tuple[tuple[SessionName, SessionName], ...] = (("after", "before"), ("before", "after"))
    for session, other in names:
        merged = MergedMaps(*maps_of[session], before_T_after, {}, True)
        points = {name: merged.to_map(name, merged.map_of(name).points) for name in (session, other)}
        path, radii_m = np.array([SENSOR]), np.array([9.0])
        maps = PlacedMaps(merged, points, {session: path, other: path}, {session: radii_m, other: radii_m})
        found = erasor.new_mask(maps, session, other, load_config("erasor", AS_PUBLISHED))
        assert found[: len(BOX)].mean() == pytest.approx(float(is_found), abs=0.05)
        assert not found[len(BOX) :].any()


def test_far_from_the_other_session_nothing_is_new() -> None:
    far = mapped(np.concatenate([BOX, FLOOR]), make_pose(translation=(500.0, 0.0, 0.0)))
    merged = MergedMaps(mapped(FLOOR, np.eye(4)), far, np.eye(4), {}, True)
    path, radii_m = np.array([SENSOR]), np.array([9.0])
    names: tuple[SessionName, SessionName] = ("before", "after")
    maps = PlacedMaps(
        merged,
        {name: merged.map_of(name).points for name in names},
        dict.fromkeys(names, path),
        dict.fromkeys(names, radii_m),
    )
    for session, other in (names, names[::-1]):
        assert not erasor.new_mask(maps, session, other, load_config("erasor", AS_PUBLISHED)).any()
