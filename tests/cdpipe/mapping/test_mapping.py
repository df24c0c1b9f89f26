from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, invert, make_pose, transform, yaw_pose
from cdpipe.mapping.free_space import render_view
from cdpipe.mapping.mapping import build_map, choose_keyframes
from cdpipe.model.config import MapConfig
from cdpipe.model.types import PLACES, PointMap, PosedScan, ScanSource


class RandomScans:
    """Seven scans of random points along a curve; the last of each scan lies far out."""

    name = "random"

    def __init__(self, offset_m: float = 0.0) -> None:
        self.odom_T_sensor = np.array([yaw_pose(0.3 * k, (offset_m + 0.6 * k, 0.1 * k, 0)) for k in range(7)])

    def scan(self, index: int) -> PosedScan:
        points = np.random.default_rng(index).uniform(-2, 2, (400 + index, 3))
        points[-1] = (0, 10.01, 0)
        rows = np.arange(len(points))
        return PosedScan(index, points, self.odom_T_sensor[index], rows.astype(np.int64), (rows * 3).astype(np.int32))

    def scans(self) -> Iterator[PosedScan]:
        return (self.scan(index) for index in range(7))


def brute_force(source: ScanSource, voxel_m: float, max_range_m: float) -> dict[tuple[int, ...], list[tuple]]:
    """(scan, pixel, point, range) of the returns of every occupied cell."""
    cells: dict[tuple[int, ...], list[tuple]] = {}
    for scan in source.scans():
        for pixel, sensor_point in zip(scan.pixels.tolist(), scan.points_sensor, strict=True):
            range_m = float(np.linalg.norm(sensor_point))
            if range_m <= max_range_m:
                point = transform(scan.odom_T_sensor, sensor_point[None])[0]
                cell = tuple(np.floor(point / voxel_m).astype(int).tolist())
                cells.setdefault(cell, []).append((scan.index, pixel, point, range_m))
    return cells


def returns_of(point_map: PointMap, index: int) -> list[list[int]]:
    """[scan, pixel] of every return behind one map point."""
    scans = np.repeat(np.arange(len(point_map.odom_T_sensor)), np.diff(point_map.scan_offsets))
    chosen = point_map.return_points == index
    return np.column_stack([scans[chosen], point_map.return_pixels[chosen]]).tolist()


@pytest.mark.parametrize("batch_scans", [1, 3, 64])
def test_the_map_equals_a_dict_of_cells(batch_scans: int) -> None:
    source = RandomScans()
    point_map = build_map(source, MapConfig(voxel_m=0.5, max_range_m=10.0), batch_scans)
    cells = brute_force(source, 0.5, 10.0)
    assert len(point_map.points) == len(cells)
    assert len(point_map.return_points) == sum(len(found) for found in cells.values()) == sum(399 + k for k in range(7))
    for index, point in enumerate(point_map.points):
        found = cells.pop(tuple(np.floor(point / 0.5).astype(int).tolist()))
        ranges_m = np.maximum([range_m for *_, range_m in found], 1.0)
        mean = np.average([entry[2] for entry in found], axis=0, weights=ranges_m**-2)
        np.testing.assert_allclose(point, mean, atol=1e-12)
        sensors = [source.odom_T_sensor[scan, :3, 3] for scan, *_ in found]
        assert point_map.seen_from is not None
        np.testing.assert_allclose(
            point_map.seen_from[index], np.average(sensors, axis=0, weights=ranges_m**-2), atol=1e-5
        )
        assert point_map.nearest_m[index] == pytest.approx(ranges_m.min(), rel=1e-6)
        assert returns_of(point_map, index) == [[scan, pixel] for scan, pixel, *_ in found]
    assert not cells


def test_batches_do_not_change_the_map() -> None:
    config = MapConfig(voxel_m=0.5)
    one, other = (build_map(RandomScans(), config, batch_scans) for batch_scans in (2, 64))
    np.testing.assert_allclose(one.points, other.points, atol=1e-12)
    np.testing.assert_array_equal(one.return_points, other.return_points)
    np.testing.assert_array_equal(one.return_offsets, other.return_offsets)
    assert one.views is not None
    assert other.views is not None
    np.testing.assert_array_equal(one.views.ranges_m, other.views.ranges_m)
    np.testing.assert_array_equal(one.views.sensor_T_odom, other.views.sensor_T_odom)
    again = build_map(RandomScans(), config, 2)
    np.testing.assert_array_equal(again.points, one.points)


@pytest.mark.parametrize("batch_scans", [2, 64])
def test_every_return_keeps_its_place_to_a_256th_of_a_cell(batch_scans: int) -> None:
    source = RandomScans()
    point_map = build_map(source, MapConfig(voxel_m=0.5, max_range_m=10.0), batch_scans)
    places = [
        transform(scan.odom_T_sensor, scan.points_sensor[np.linalg.norm(scan.points_sensor, axis=1) <= 10.0])
        for scan in source.scans()
    ]
    returns = np.arange(len(point_map.return_points))
    gaps_m = np.abs(point_map.positions_of(returns) - np.concatenate(places))
    assert PLACES == 256
    assert 0.9 * 0.5 / 512 < gaps_m.max() <= 0.5 / 512 + 1e-9
    some = np.array([700, 3, 3])
    np.testing.assert_array_equal(point_map.positions_of(some), point_map.positions_of(returns)[some])


class OneCloud:
    """One scan at the origin of points that are given."""

    name = "one"
    odom_T_sensor = np.eye(4)[None]

    def __init__(self, points: Float64Array) -> None:
        self._points = points

    def scan(self, index: int) -> PosedScan:
        rows = np.arange(len(self._points))
        return PosedScan(index, self._points, np.eye(4), rows.astype(np.int64), rows.astype(np.int32))

    def scans(self) -> Iterator[PosedScan]:
        return iter([self.scan(0)])


@pytest.mark.parametrize("voxel_m", [0.2, 0.3, 0.1])
def test_returns_on_the_borders_of_cells_keep_their_places(voxel_m: float) -> None:
    # multiples of the cell, and the next numbers below and above them: where rounding may tip a mean into a neighbour
    along = np.arange(-40, 41) * voxel_m
    along = np.concatenate([along, np.nextafter(along, np.inf), np.nextafter(along, -np.inf), [-1e-18, 1e-18]])
    others = np.random.default_rng(0).permutation(along)
    points = np.column_stack([along, others, others[::-1]])
    point_map = build_map(OneCloud(points), MapConfig(voxel_m=voxel_m))
    gaps_m = np.abs(point_map.positions_of(np.arange(len(points))) - points)
    assert gaps_m.max() <= voxel_m / 512 + 1e-9


def test_a_map_that_kept_no_places_says_so() -> None:
    point_map = replace(build_map(RandomScans(), MapConfig()), return_offsets=None)
    with pytest.raises(ValueError, match="return_offsets is None"):
        point_map.positions_of(np.zeros(1, np.int64))


def test_keyframes_keep_what_they_saw() -> None:
    source = RandomScans()
    point_map = build_map(source, MapConfig(max_range_m=1.5), batch_scans=2)
    assert point_map.keyframe_scans.tolist() == [0, 2, 4, 6]
    assert point_map.views is not None
    np.testing.assert_array_equal(point_map.views.sensor_T_odom, invert(source.odom_T_sensor[[0, 2, 4, 6]]))
    for image, scan in zip(point_map.views.ranges_m, (0, 2, 4, 6), strict=True):
        # a return that is not mapped was seen through to all the same
        np.testing.assert_array_equal(image, render_view(source.scan(scan).points_sensor))
        assert image.max() == 10.01 or image.max() == np.float16(10.01)


def test_keyframes_by_hand() -> None:
    # steps of 0.4 m along x: 1 m of path is complete at scans 3, 6, 9
    poses = np.array([make_pose(translation=(0.4 * k, 0, 0)) for k in range(10)])
    assert choose_keyframes(poses, 1.0).tolist() == [0, 3, 6, 9]
    # steps that divide the spacing: rounding must not delay a keyframe
    poses = np.array([make_pose(translation=(0.2 * k, 0, 0)) for k in range(21)])
    assert choose_keyframes(poses, 0.8).tolist() == [0, 4, 8, 12, 16, 20]
    assert choose_keyframes(poses[:1], 1.0).tolist() == [0]


def test_a_stop_makes_no_keyframes() -> None:
    # 2 m in steps of 0.5 m, 600 scans of a sensor that jitters by 1 cm (6 m of path), and 2 m more
    x_m = np.concatenate([np.arange(5) * 0.5, 2 + 0.01 * (np.arange(600) % 2), 2.01 + np.arange(1, 5) * 0.5])
    poses = make_pose(translation=np.column_stack([x_m, np.zeros((len(x_m), 2))]))
    assert choose_keyframes(poses, 1.0).tolist() == [0, 2, 4, 605, 607]


def test_a_map_of_one_point() -> None:
    class OneScan(RandomScans):
        def scans(self) -> Iterator[PosedScan]:
            point = np.array([[1.0, 2.0, 3.0]])
            yield PosedScan(0, point, np.eye(4), np.zeros(1, np.int64), np.array([5], np.int32))

    source = OneScan()
    source.odom_T_sensor = np.eye(4)[None]
    point_map = build_map(source, MapConfig())
    np.testing.assert_array_equal(point_map.points, [[1.0, 2.0, 3.0]])
    assert returns_of(point_map, 0) == [[0, 5]]


def test_nothing_within_range_and_poses_too_far_out() -> None:
    with pytest.raises(InputError, match=r"random: .*map\.max_range_m = 0\.001 m"):
        build_map(RandomScans(), MapConfig(max_range_m=0.001))
    with pytest.raises(InputError, match=r"random: .* 40000\d\d m"):
        build_map(RandomScans(offset_m=4_000_000.0), MapConfig())
    # what the cells of the map could number, and the finer ones of the extraction cannot
    with pytest.raises(
        InputError, match=r"random: .* 600\d\d m, cells of 0\.05 m can be numbered up to 52429 m.*--origin"
    ):
        build_map(RandomScans(offset_m=60_000.0), MapConfig())
