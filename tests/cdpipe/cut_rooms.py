"""Pairs of rooms with boxes, scanned and cut by the surface rule."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

from cdpipe.extract.objects import PointGroup
from cdpipe.extract.surface_rule import cut_by_surface
from cdpipe.model.config import ExtractConfig
from cdpipe.model.types import MergedMaps, PointMap
from tests.cdpipe.rooms import PATH, Box, RoomScans, room_regions

CONFIG = ExtractConfig()
CRATE: Box = ((1.0, 1.5, 0.0), (2.0, 2.3, 0.8))
MIDDLE = (0.0, 0.0, 1.0)

Scanned = tuple[RoomScans, PointMap]


@cache
def scanned(boxes: tuple[Box, ...], sample: int, path: tuple[tuple[float, float, float], ...] = PATH) -> Scanned:
    scans = RoomScans(boxes, sample, path)
    return scans, scans.mapped()


def cut(
    before: Scanned,
    after: Scanned,
    centres: Sequence[tuple[float, float, float]] = (MIDDLE,),
    radius_m: float = 4.5,
    config: ExtractConfig = CONFIG,
) -> list[PointGroup]:
    pair = MergedMaps(before[1], after[1], np.eye(4), {}, True)
    return cut_by_surface(pair, room_regions(centres, radius_m), config)


def returns_of(point_map: PointMap, group: PointGroup) -> set[tuple[int, int]]:
    assert group.returns is not None
    scans = np.searchsorted(point_map.scan_offsets, group.returns, side="right") - 1
    return set(zip(scans.tolist(), point_map.return_pixels[group.returns].tolist(), strict=True))


def iou(one: set[tuple[int, int]], other: set[tuple[int, int]]) -> float:
    return len(one & other) / len(one | other)
