"""The map of a session or recording: its returns in the odom frame, one a cell, with their values."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import BoolArray, Float64Array, transform
from cdpipe.core.geometry.voxel import UniqueCells, cell_keys, require_reachable
from cdpipe.core.progress import Progress
from cdpipe.io.out.scans import Outgoing, OutScan


@dataclass(frozen=True, slots=True, eq=False)
class PointMap:
    """Points (N, 3), metres, and values (N,) of each by name; values of 64 bits are times."""

    points: Float64Array
    scalars: dict[str, npt.NDArray[Any]]


def gather_map(outgoing: Outgoing, cell_m: float, report: Progress) -> PointMap:
    """Return the first return of each cell, and of each `change` in it, in the odom frame.

    The values are the scalars of the scans, NaN in scans without, `time` (seconds of the recording's clock) and `scan`;
    the last two not for a whole map, which has no scans.

    Raises:
        InputError: A scan cannot be read, or lies too far away.
    """
    cells: defaultdict[int, UniqueCells] = defaultdict(UniqueCells)
    points: list[Float64Array] = []
    scalars: list[dict[str, npt.NDArray[Any]]] = []
    for scan in outgoing.scans(report):
        points_odom = transform(scan.odom_T_sensor, scan.points)
        farthest_m = float(np.abs(points_odom).max(initial=0.0))
        require_reachable(f"{outgoing.name}: scan {scan.index}", farthest_m, cell_m)
        is_first = _find_first(scan, points_odom, cells, cell_m)
        points.append(points_odom[is_first])
        found = scan.scalars | (_recorded(scan) if outgoing.has_scans else {})
        scalars.append({name: values[is_first] for name, values in found.items()})
    return PointMap(np.concatenate(points), join_scalars(scalars, [len(part) for part in points]))


def join_scalars(
    scalars: Sequence[Mapping[str, npt.NDArray[Any]]], lengths: Sequence[int]
) -> dict[str, npt.NDArray[Any]]:
    """Return the values of all parts by name, NaN for the points of parts without: whole numbers become floats there.

    Args:
        scalars: Values (N,) by name, of each part.
        lengths: Points N of each part.
    """
    parts = list(zip(scalars, lengths, strict=True))
    names = dict.fromkeys(name for found in scalars for name in found)
    return {
        name: np.concatenate([found.get(name, np.full(n, np.nan, np.float32)) for found, n in parts]) for name in names
    }


def _find_first(scan: OutScan, points: Float64Array, cells: dict[int, UniqueCells], cell_m: float) -> BoolArray:
    is_first = np.zeros(len(points), np.bool_)
    changes = scan.scalars.get("change", np.zeros(len(points), np.int32))
    for change in np.unique(changes).tolist():
        rows = np.flatnonzero(changes == change)
        n_known = len(cells[change])
        ids, first = np.unique(cells[change].add(cell_keys(points[rows], cell_m)), return_index=True)
        is_first[rows[first[ids >= n_known]]] = True
    return is_first


def _recorded(scan: OutScan) -> dict[str, npt.NDArray[Any]]:
    """Return when each return was recorded, and in which scan."""
    n = len(scan.points)
    time_ns = np.full(n, scan.stamp_ns) if scan.offset_ns is None else scan.stamp_ns + scan.offset_ns
    return {"time": time_ns / 1e9, "scan": np.full(n, scan.index, np.int32)}
