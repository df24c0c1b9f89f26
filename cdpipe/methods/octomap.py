"""OctoMap (Hornung, Wurm, Bennewitz, Stachniss, Burgard 2013) by pyoctomap, extra `octomap`: what stands in free space.

OctoMap keeps the probability that a voxel is occupied. A return raises that of its voxel, a ray lowers that of the
voxels on its way. For two sessions, the scans of one fill the map and the map points of the other are looked up in it,
in both directions: a point in a free voxel is new, one in a voxel that no ray met is not.
"""

# ruff: noqa: PLC0415 - pyoctomap is an extra, and everybody else must be able to import this

from __future__ import annotations

from typing import Any

import numpy as np

from cdpipe.core.geometry import BoolArray
from cdpipe.core.geometry.voxel import thin
from cdpipe.methods.whole_map import PlacedMaps, WholeMap
from cdpipe.model.config import PipelineConfig
from cdpipe.model.types import SessionName

# What pyoctomap calls a voxel that was met and is less probable than the limit.
_FREE = 0


@WholeMap
def octomap(maps: PlacedMaps, session: SessionName, other: SessionName, config: PipelineConfig) -> BoolArray:
    """Mark the map points of `session` in a voxel that is free in the occupancy map of `other`.

    Rays are cast in the other session's own odom frame, one to each voxel with a return of the scan; the points are
    transformed into it. Probabilities of a hit (0.7) and a miss (0.4) and their bounds are the authors'.

    Args:
        maps: Both maps, and the returns of every scan.
        session: The session whose points are marked.
        other: The session whose rays are cast.
        config: `octomap` and `query.radius_m` are used. Points farther than that from the other path are not compared,
            so they are not looked up.

    Returns:
        (N,) mask of the points of `session`.
    """
    compared, points_odom = maps.compared_in_odom(session, other)
    settings = config.octomap
    tree = load_pyoctomap().OcTree(settings.voxel_m)
    tree.setOccupancyThres(settings.free_below)
    for odom_T_sensor, returns_odom in maps.scans(other, settings.every_scan):
        tree.insertPointCloud(thin(returns_odom, settings.voxel_m), odom_T_sensor[:3, 3].copy(), lazy_eval=True)
    is_free = np.zeros(len(maps.points[session]), dtype=np.bool_)
    is_free[compared] = tree.getLabels(points_odom) == _FREE
    return is_free


def load_pyoctomap() -> Any:
    """Return the module pyoctomap."""
    import pyoctomap

    return pyoctomap
