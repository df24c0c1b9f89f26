import math

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, stream, transform, yaw_pose
from cdpipe.methods.removert import removert, seen_through_mask
from cdpipe.methods.whole_map import PlacedMaps
from cdpipe.model.config import load_config
from cdpipe.model.types import MergedMaps, PointMap, SessionName
from tests.cdpipe.rooms import RoomScans

ODOM_T_ROOM = yaw_pose(0.7, (3.0, -2.0, 0.5))


def spherical(*rows: tuple[float, float, float]) -> Float64Array:
    """(N, 3) azimuth and polar angle, degrees, and range, as radians."""
    return np.array(rows) * (np.pi / 180, np.pi / 180, 1.0)


@pytest.mark.parametrize(
    ("range_m", "margin", "is_seen"),
    # the scan measured 5 m: 4.0 + 0.2 * 4.0 = 4.8 is less, 4.0 + 0.3 * 4.0 = 5.2 is more
    [(4.0, 0.2, True), (4.0, 0.3, False), (4.99, 0.0, True), (5.01, 0.0, False)],
)
def test_a_point_is_seen_through_by_a_share_of_its_range(range_m: float, margin: float, is_seen: bool) -> None:
    points, returns = spherical((10.2, 90.2, range_m)), spherical((10.8, 90.8, 5.0), (11.2, 90.5, 50.0))
    assert seen_through_mask(points, returns, 1.0, margin).tolist() == [is_seen]


def test_hidden_points_and_pixels_without_a_return_stay() -> None:
    points = spherical((10.2, 90.2, 2.0), (10.8, 90.8, 3.0), (15.5, 90.5, 2.5), (359.9, 179.9, 2.0))
    returns = spherical((10.5, 90.5, 9.0), (359.5, 179.5, 9.0))
    assert seen_through_mask(points, returns, 1.0, 0.1).tolist() == [True, False, False, True]
    # alone in a pixel of 20 degrees, the third point is seen through; a nearer return beside it hides the fourth
    returns = np.concatenate([returns, spherical((341.0, 165.0, 1.0))])
    assert seen_through_mask(points[2:], returns, 20.0, 0.1).tolist() == [True, False]
    assert seen_through_mask(points, returns, 20.0, 0.1).tolist() == [True, False, False, False]


def asked(room_points: Float64Array, scanned: PointMap, *settings: str) -> list[bool]:
    """Whether a session whose odometry started elsewhere in the room sees through points of the room."""
    merged = MergedMaps(scanned, scanned, np.linalg.inv(ODOM_T_ROOM), {}, True)
    names: tuple[SessionName, SessionName] = ("before", "after")
    path, radii_m = np.array([[0.0, 0.0, 1.5]]), np.array([9.0])
    maps = PlacedMaps(merged, *(dict.fromkeys(names, value) for value in (room_points, path, radii_m)))
    config = load_config("removert", ["removert.every_scan=1", *settings])
    return removert.new_mask(maps, "before", "after", config).tolist()


def test_in_front_of_the_wall_at_it_and_behind_it() -> None:
    # the wall is at x = 5; a point at 4.6 m must be passed by 0.46 m or by 0.09 m
    x_m = np.array([2.0, 4.4, 4.6, 5.0, 5.5])
    points = np.column_stack([x_m, np.arange(5) - 2.0, np.full(5, 1.5)])
    scanned = RoomScans([], 1, path=[(0.0, 0.0, 1.5)], odom_T_room=ODOM_T_ROOM).mapped()
    assert asked(points, scanned, "removert.margin=0.1") == [True, True, False, False, False]
    assert asked(points, scanned, "removert.margin=0.02") == [True, True, True, False, False]


def nearest_by_pixel(points: Float64Array, pixel_deg: float) -> dict[tuple[int, int], tuple[float, int]]:
    """Range and number of the nearest point of each pixel, one point after the other."""
    found: dict[tuple[int, int], tuple[float, int]] = {}
    for number, (x, y, z) in enumerate(points.tolist()):
        azimuth, polar = math.degrees(math.atan2(-y, -x)) + 180, math.degrees(math.atan2(math.hypot(x, y), z))
        pixel = math.floor(azimuth / pixel_deg), math.floor(polar / pixel_deg)
        found[pixel] = min(found.get(pixel, (math.inf, -1)), (math.dist((x, y, z), (0, 0, 0)), number))
    return found


def test_both_resolutions_of_all_scans_agree_with_a_slow_reference() -> None:
    boxes = [((1.0, 1.2, 0.0), (1.8, 2.2, 0.9)), ((-2.0, -0.2, 0.0), (-1.8, 0.2, 3.0))]
    scanned = RoomScans(boxes, 2, path=[(x, 0.5, 1.5) for x in (-3.0, 0.0, 2.5)], odom_T_room=ODOM_T_ROOM).mapped()
    points = stream(3, "asked").uniform((-4.5, -3.5, 0.2), (4.5, 3.5, 2.8), (300, 3))
    is_seen = np.zeros((2, len(points)), dtype=bool)
    for scan, odom_T_sensor in enumerate(scanned.odom_T_sensor):
        sensor_T_odom = np.linalg.inv(odom_T_sensor)
        returns = scanned.positions_of(np.arange(*scanned.scan_offsets[scan : scan + 2]))
        for level, pixel_deg in enumerate((2.0, 5.0)):
            of_scan = nearest_by_pixel(transform(sensor_T_odom, returns), pixel_deg)
            for pixel, (range_m, number) in nearest_by_pixel(
                transform(sensor_T_odom @ ODOM_T_ROOM, points), pixel_deg
            ).items():
                is_seen[level, number] |= pixel in of_scan and of_scan[pixel][0] > 1.1 * range_m
    found = asked(points, scanned, "removert.pixel_deg=2", "removert.margin=0.1")
    assert found == is_seen.all(axis=0).tolist()
    # either resolution alone sees through more
    assert 100 < sum(found) < is_seen.sum(axis=1).min()
