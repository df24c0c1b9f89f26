"""Points of what moved within a session are dropped; a session in which nothing moves keeps its map."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace

import numpy as np
import pytest

from cdpipe.core.geometry import BoolArray, Float64Array
from cdpipe.mapping import movers
from cdpipe.mapping.mapping import build_map
from cdpipe.mapping.movers import _stand_up, drop_movers
from cdpipe.model.config import MapConfig, load_config
from cdpipe.model.types import PointMap, PosedScan, ScanSource

N_SCANS = 12
AZIMUTH, ELEVATION = (
    angles.ravel()
    for angles in np.meshgrid(np.deg2rad(np.arange(0, 360, 0.7)), np.deg2rad(np.arange(-44, 45, 1.4)), indexing="ij")
)
RAYS = np.column_stack([np.cos(ELEVATION) * np.cos(AZIMUTH), np.cos(ELEVATION) * np.sin(AZIMUTH), np.sin(ELEVATION)])


class Room(ScanSource):
    """Scans from the way through a ball-shaped room, 9 m in radius, past a column, 1 m wide.

    `stands(scan)` tells where along y the column is.
    """

    name = "room"

    def __init__(self, stands: dict[int, float], usual: float | None = None) -> None:
        self._stands, self._usual = stands, usual

    @property
    def odom_T_sensor(self) -> Float64Array:
        poses = np.tile(np.eye(4), (N_SCANS, 1, 1))
        poses[:, 0, 3] = np.linspace(-3.0, 3.0, N_SCANS)
        return poses

    def scan(self, index: int) -> PosedScan:
        pose = self.odom_T_sensor[index]
        origin, along = pose[:3, 3], RAYS
        towards = along @ origin
        ranges_m = -towards + np.sqrt(towards**2 + 81.0 - origin @ origin)
        place = self._stands.get(index, self._usual)
        if place is not None:
            from_m, square = origin[:2] - (0.0, place), (along[:, :2] ** 2).sum(axis=1)
            half = along[:, :2] @ from_m
            inside = half**2 - square * (from_m @ from_m - 0.25)
            hit_m = (-half - np.sqrt(np.maximum(inside, 0.0))) / square
            is_hit = (inside > 0) & (hit_m > 0) & (hit_m < ranges_m) & (np.abs(hit_m * along[:, 2]) < 1.0)
            ranges_m = np.where(is_hit, hit_m, ranges_m)
        n = len(along)
        return PosedScan(index, ranges_m[:, None] * along, pose, np.zeros(n, np.int64), np.arange(n, dtype=np.int32))

    def scans(self) -> Iterator[PosedScan]:
        return map(self.scan, range(N_SCANS))


CONFIG = MapConfig(keyframe_spacing_m=0.5)
WALKS = {scan: 2.0 + 0.3 * scan for scan in range(N_SCANS)}


def near_column(points: Float64Array) -> BoolArray:
    return np.linalg.norm(points, axis=1) < 7.5


def mapped(stands: dict[int, float], usual: float | None = None) -> PointMap:
    return build_map(Room(stands, usual), CONFIG)


def test_a_column_that_moves_is_dropped_and_the_wall_stays() -> None:
    kept = mapped(WALKS)
    left = drop_movers(kept)
    n_column, n_left = (np.count_nonzero(near_column(each.points)) for each in (kept, left))
    assert n_column > 200
    assert n_left < 0.1 * n_column
    walls = [each.points[~near_column(each.points)] for each in (kept, left)]
    assert np.array_equal(walls[1], walls[0])


def test_a_map_tells_what_was_dropped_of_which_scan() -> None:
    kept = mapped(WALKS)
    left = drop_movers(kept)
    assert left.mover_points is not None and left.mover_scans is not None
    assert (np.diff(left.mover_scans) >= 0).all()
    # the column of each scan, and nothing else
    for scan, distance_m in WALKS.items():
        points = left.mover_points[left.mover_scans == scan]
        assert len(points) > 10 and np.abs(np.linalg.norm(points[:, :2], axis=1) - distance_m).max() < 0.5, scan
    hits = {(tuple(point), scan) for point, scan in zip(left.mover_points.tolist(), left.mover_scans, strict=True)}
    assert len(hits) == len(left.mover_scans)


def test_a_map_without_movers_is_the_same_map() -> None:
    for usual in (None, 3.0):
        kept = mapped({}, usual)
        assert drop_movers(kept) is kept


def test_what_comes_for_a_moment_is_dropped_and_what_leaves_for_a_moment_stays() -> None:
    moment = drop_movers(mapped({5: 3.0, 6: 3.0}))
    assert not near_column(moment.points).any()
    away = mapped({5: 20.0, 6: 20.0}, 3.0)
    assert drop_movers(away) is away


class Pool(Room):
    """The empty room with a floor 1.5 m below the sensor; all scans but two see the roof mirrored in a puddle.

    The floor rises by `leans` along -y.
    """

    def __init__(self, leans: float = 0.0) -> None:
        super().__init__({})
        self._leans = leans

    def scan(self, index: int) -> PosedScan:
        scan = super().scan(index)
        down = -RAYS[:, 2] - self._leans * RAYS[:, 1]
        floor_m, range_m = 1.5 / np.maximum(down, 1e-3), np.linalg.norm(scan.points_sensor, axis=1)
        feet = scan.odom_T_sensor[:3, 3] + floor_m[:, None] * RAYS
        mirrors = (np.hypot(feet[:, 0], feet[:, 1] - 4.0) < 2.0) & (index not in (5, 6))
        is_floor = (floor_m < range_m) & ~mirrors
        return replace(scan, points_sensor=np.where(is_floor, floor_m, range_m)[:, None] * RAYS)


def test_a_floor_under_water_stays_and_a_leaning_sheet_that_comes_and_goes_does_not() -> None:
    wet = build_map(Pool(), CONFIG)
    assert np.count_nonzero(np.abs(wet.points[:, 2] + 1.5) < 0.1) > 500
    assert drop_movers(wet) is wet
    leaning = build_map(Pool(leans=0.7), CONFIG)
    assert len(drop_movers(leaning).points) < len(leaning.points) - 100


def test_floor_that_is_dropped_with_the_foot_of_a_thing_has_not_moved() -> None:
    x, y = (each.ravel() for each in np.meshgrid(np.arange(0, 8, 0.2), np.arange(0, 4, 0.2)))
    floor = np.column_stack([x, y, 0.05 * np.sin(x)])
    foot = np.column_stack([np.full(20, 1.0), np.full(20, 1.0), np.linspace(0.0, 1.0, 20)])
    truck = np.column_stack([20.0 + x[x < 2], y[x < 2], 2.0 * np.abs(np.sin(5 * y[x < 2]))])
    standing = _stand_up(np.concatenate([floor, foot, truck]), 0.2)
    assert standing.tolist() == [False] * (len(floor) + len(foot)) + [True] * len(truck)
    assert _stand_up(np.zeros((0, 3)), 0.2).shape == (0,)


def test_returns_go_with_their_points(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = mapped(WALKS)
    left = drop_movers(kept)
    n_blocks = 7
    monkeypatch.setattr(movers, "_BLOCK_RETURNS", len(kept.return_points) // n_blocks)
    in_blocks = drop_movers(kept)
    for each in fields(left):
        own, other = getattr(left, each.name), getattr(in_blocks, each.name)
        assert own is other or np.array_equal(own, other), each.name
    assert left.return_offsets is not None and len(left.return_offsets) == len(left.return_points)
    assert left.scan_offsets[0] == 0 and left.scan_offsets[-1] == len(left.return_points) < len(kept.return_points)
    # each scan has the returns of its kept points, in their order
    place = {tuple(point): index for index, point in enumerate(left.points)}
    for scan in range(N_SCANS):
        own = slice(*kept.scan_offsets[scan : scan + 2])
        points = kept.points[kept.return_points[own]]
        known = np.array([place.get(tuple(point), -1) for point in points])
        mine = slice(*left.scan_offsets[scan : scan + 2])
        assert np.array_equal(known[known >= 0], left.return_points[mine])
        assert np.array_equal(kept.return_pixels[own][known >= 0], left.return_pixels[mine])
    assert len(place) == len(left.points) and place.keys() < {tuple(point) for point in kept.points}


def test_the_setting_decides_and_presets_with_consistent_maps_have_it() -> None:
    kept, left = (build_map(Room(WALKS), replace_movers(each)) for each in ("keep", "drop"))
    assert len(left.points) < len(kept.points)
    assert load_config("paper").map.movers == "keep"
    assert load_config("tunnelcd").map.movers == load_config("dufomap").map.movers == "drop"
    assert "movers" not in load_config("paper").model_dump(mode="json")["map"]
    with pytest.raises(ValueError, match="views"):
        drop_movers(replace(kept, views=None))


def replace_movers(movers: str) -> MapConfig:
    return MapConfig.model_validate({**CONFIG.model_dump(), "movers": movers})
