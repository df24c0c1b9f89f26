"""A room with boxes in it, scanned by rays cast at planes: what every return hit is known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from cdpipe.core.geometry import Float64Array, Int64Array, make_pose, stream, transform, yaw_pose
from cdpipe.mapping.mapping import build_map
from cdpipe.model.config import MapConfig
from cdpipe.model.report import ChangeRegions
from cdpipe.model.types import PointMap, PosedScan

Box = tuple[tuple[float, float, float], tuple[float, float, float]]  # its lowest and its highest corner

ROOM: Box = ((-5.0, -4.0, 0.0), (5.0, 4.0, 3.0))
PATH = tuple((x, 0.0, 1.5) for x in np.arange(-3.0, 3.01, 1.0).tolist())
_ROWS, _COLUMNS, _ELEVATION_RAD = 64, 640, np.deg2rad(44.0)
_NOISE_M = 0.003
WALLS = -1


class RoomScans:
    """A session in the room: a scan source, and what each pixel of each scan hit."""

    def __init__(
        self,
        boxes: Sequence[Box],
        sample: int,
        path: Sequence[tuple[float, float, float]] = PATH,
        odom_T_room: Float64Array | None = None,
        room: Box = ROOM,
    ) -> None:
        rng = stream(sample, "room")
        self.name = f"room {sample}"
        self.hits: list[Int64Array] = []
        self._clouds: list[Float64Array] = []
        poses = []
        odom_T_room = make_pose() if odom_T_room is None else odom_T_room
        for position in path:
            room_T_sensor = yaw_pose(rng.uniform(-np.pi, np.pi), position)
            directions = _directions(rng.uniform(-0.5, 0.5, (_ROWS * _COLUMNS, 2)))
            ranges_m, hits = cast(np.array(position), directions @ room_T_sensor[:3, :3].T, boxes, room)
            ranges_m += rng.normal(0, _NOISE_M, len(ranges_m))
            self._clouds.append(ranges_m[:, None] * directions)
            self.hits.append(hits)
            poses.append(odom_T_room @ room_T_sensor)
        self.odom_T_sensor = np.array(poses)

    def scan(self, index: int) -> PosedScan:
        cloud = self._clouds[index]
        rows = np.arange(len(cloud))
        return PosedScan(index, cloud, self.odom_T_sensor[index], rows.astype(np.int64), rows.astype(np.int32))

    def scans(self) -> Iterator[PosedScan]:
        return (self.scan(index) for index in range(len(self._clouds)))

    def mapped(self) -> PointMap:
        """The session's map."""
        return build_map(self, MapConfig())

    def returns_on(self, box: int) -> set[tuple[int, int]]:
        """(scan, pixel) of what hit a box."""
        return {(scan, int(pixel)) for scan, hits in enumerate(self.hits) for pixel in np.flatnonzero(hits == box)}

    def places(self, returns: set[tuple[int, int]]) -> Float64Array:
        """(N, 3) where returns lie, the session's odom frame."""
        return np.array(
            [transform(self.odom_T_sensor[scan], self._clouds[scan][pixel][None])[0] for scan, pixel in sorted(returns)]
        ).reshape(-1, 3)


def _directions(jitter: Float64Array) -> Float64Array:
    row, column = np.divmod(np.arange(_ROWS * _COLUMNS), _COLUMNS)
    elevation = _ELEVATION_RAD * (1 - 2 * (row + 0.5 + jitter[:, 0]) / _ROWS)
    azimuth = 2 * np.pi * (column + jitter[:, 1]) / _COLUMNS
    flat = np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def cast(
    origin: Float64Array, directions: Float64Array, boxes: Sequence[Box], room: Box = ROOM
) -> tuple[Float64Array, Int64Array]:
    """Return (N,) how far rays from inside of the room go, and the box that each hits, or WALLS."""
    _, ranges_m = _slabs(origin, directions, room)
    hits = np.full(len(directions), WALLS)
    for number, box in enumerate(boxes):
        enters_m, leaves_m = _slabs(origin, directions, box)
        is_hit = (enters_m > 0) & (enters_m < leaves_m) & (enters_m < ranges_m)
        ranges_m = np.where(is_hit, enters_m, ranges_m)
        hits = np.where(is_hit, number, hits)
    return ranges_m, hits


def _slabs(origin: Float64Array, directions: Float64Array, box: Box) -> tuple[Float64Array, Float64Array]:
    """Return (N,) where rays enter and leave a box."""
    ways = (np.array(box)[:, None, :] - origin) / directions
    return np.asarray(ways.min(axis=0).max(axis=1)), np.asarray(ways.max(axis=0).min(axis=1))


def room_regions(centres: Sequence[tuple[float, float, float]], radius_m: float = 4.5) -> ChangeRegions:
    """Return regions about some centres, all reported, best first."""
    n = len(centres)
    return ChangeRegions(
        np.array(centres, dtype=np.float64).reshape(-1, 3),
        radius_m,
        -np.arange(n, dtype=np.float64),
        np.zeros((n, 2), np.int64),
        np.ones(n, np.bool_),
        np.zeros(0),
    )
