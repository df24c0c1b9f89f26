"""DUFOMap (Duberg, Zhang, Jia, Jensfelt 2024), extra `dufomap`: what stands where the other session's rays saw a void.

DUFOMap cleans a map of what moved: it casts the rays of each scan, marks the voxels in which, localisation errors
considered, nothing can have been (void), and drops all points that lie in a voxel that was void at any time. For two
sessions the scans of one are integrated and the map points of the other are asked about, in both directions.
"""

# ruff: noqa: PLC0415 - dufomap is an extra, and everybody else must be able to import this

from __future__ import annotations

import os
from typing import Any

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array
from cdpipe.core.threads import THREADS
from cdpipe.methods.registry import require_extra
from cdpipe.methods.whole_map import PlacedMaps, whole_map
from cdpipe.model.config import DufomapConfig, PipelineConfig
from cdpipe.model.report import ChangeReport
from cdpipe.model.types import DescriptorSet, MergedMaps, PointMap, SessionName

# d_p, as its authors have it: a voxel is void if its neighbours were seen too. Without, half of a tunnel is new.
_UNKNOWN_VOXELS = 1


def dufomap(merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig) -> ChangeReport:
    """Compare the maps by `whole_map`: new is what stands where the other session saw a void (`void_mask`).

    Raises:
        InputError: The extra `dufomap` is not installed.
    """
    require_extra("dufomap")
    return whole_map(merged, before, after, config, void_mask)


def void_mask(maps: PlacedMaps, session: SessionName, other: SessionName, config: PipelineConfig) -> BoolArray:
    """Mark the map points of `session` that lie in a voxel which `other` saw to be void.

    Rays are cast in the other session's own odom frame, so that its returns need not be moved; the points are.

    Args:
        maps: Both maps, and the returns of every scan.
        session: Whose points are asked about.
        other: Whose rays are cast.
        config: `dufomap` and `query.radius_m` are used; points farther than that from the other path, which nobody will
            ask for, are not looked up.

    Returns:
        (N,) mask of the points of `session`.
    """
    points = maps.points[session]
    asked = np.flatnonzero(maps.is_comparable(points, other, config.query.radius_m))
    cast_from, asked_odom = maps.merged.before, points[asked]
    if other == "after":
        cast_from, asked_odom = maps.merged.after, maps.merged.alignment.to_odom(points[asked])
    is_void = np.zeros(len(points), dtype=np.bool_)
    is_void[asked] = _in_void(cast_from, asked_odom, config.dufomap)
    return is_void


def _in_void(cast_from: PointMap, points_odom: Float64Array, config: DufomapConfig) -> BoolArray:
    void_map = loaded_dufomap().dufomap(config.voxel_m, config.hit_inflation_m, _UNKNOWN_VOXELS, THREADS)
    for scan in range(0, len(cast_from.odom_T_sensor), config.every_scan):
        returns = np.arange(*cast_from.scan_offsets[scan : scan + 2])
        void_map.run(cast_from.positions_of(returns), _origin_pose(cast_from.odom_T_sensor[scan, :3, 3]), False)
    return np.asarray(void_map.segment(points_odom, _origin_pose(np.zeros(3)), False), dtype=np.bool_)


def _origin_pose(origin_odom: Float64Array) -> list[float]:
    """Return the sensor's position as the package takes it, unturned: the points are in the odom frame already."""
    return [*origin_odom.tolist(), 1.0, 0.0, 0.0, 0.0]


def loaded_dufomap() -> Any:
    """Return the module dufomap, silent."""
    # its C++ part would write its settings to standard error each time; read when it is loaded
    os.environ.setdefault("GLOG_minloglevel", "2")
    import dufomap

    return dufomap
