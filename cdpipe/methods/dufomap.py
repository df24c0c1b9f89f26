"""DUFOMap (Duberg, Zhang, Jia, Jensfelt 2024), extra `dufomap`: what stands where the other session's rays saw a void.

DUFOMap removes moving objects from a map. It casts the rays of each scan, marks the voxels that must have been empty
(void) despite localisation errors, and drops every point in a voxel that was void at any time. For two sessions, the
scans of one mark the void voxels and the map points of the other are looked up in them, in both directions.
"""

# ruff: noqa: PLC0415 - dufomap is an extra, and everybody else must be able to import this

from __future__ import annotations

import os
from typing import Any

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array
from cdpipe.core.threads import THREADS
from cdpipe.methods.whole_map import PlacedMaps, WholeMap
from cdpipe.model.config import PipelineConfig
from cdpipe.model.types import SessionName

# d_p, the authors' value: a voxel is void only if its neighbours were seen too. With 0, half of a tunnel is new.
UNKNOWN_VOXELS = 1


@WholeMap
def dufomap(maps: PlacedMaps, session: SessionName, other: SessionName, config: PipelineConfig) -> BoolArray:
    """Mark the map points of `session` in a voxel that `other` saw to be void.

    Rays are cast in the other session's own odom frame; the points are transformed into it.

    Args:
        maps: Both maps, and the returns of every scan.
        session: The session whose points are marked.
        other: The session whose rays are cast.
        config: `dufomap` and `query.radius_m` are used. Points farther than that from the other path are not compared,
            so they are not looked up.

    Returns:
        (N,) mask of the points of `session`.
    """
    compared, points_odom = maps.compared_in_odom(session, other)
    settings = config.dufomap
    void_map = load_dufomap().dufomap(settings.voxel_m, settings.hit_inflation_m, UNKNOWN_VOXELS, THREADS)
    for odom_T_sensor, returns_odom in maps.scans(other, settings.every_scan):
        void_map.run(returns_odom, origin_pose(odom_T_sensor[:3, 3]), False)
    is_void = np.zeros(len(maps.points[session]), dtype=np.bool_)
    is_void[compared] = void_map.segment(points_odom, origin_pose(np.zeros(3)), False)
    return is_void


def origin_pose(origin_odom: Float64Array) -> list[float]:
    """Return a position and the identity quaternion, as the package takes a pose; points are in the odom frame."""
    return [*origin_odom.tolist(), 1.0, 0.0, 0.0, 0.0]


def load_dufomap() -> Any:
    """Return the module dufomap, silent."""
    # its C++ part would write its settings to standard error each time; read when it is loaded
    os.environ.setdefault("GLOG_minloglevel", "2")
    import dufomap

    return dufomap
