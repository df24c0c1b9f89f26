"""OctoMap (Hornung, Wurm, Bennewitz, Stachniss, Burgard 2013) by pyoctomap, extra `octomap`: what stands in free space.

OctoMap keeps the probability that a voxel is occupied. A return raises that of its voxel, a ray lowers that of the
voxels on its way. For two sessions, the scans of one fill the map and the map points of the other are looked up in it,
in both directions: a point in a free voxel is new, one in a voxel that no ray met is not.
"""

# ruff: noqa: PLC0415 - pyoctomap is an extra, and everybody else must be able to import this

from __future__ import annotations

from typing import Any

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array
from cdpipe.core.geometry.voxel import thin
from cdpipe.methods.whole_map import PlacedMaps, WholeMap
from cdpipe.model.config import PipelineConfig
from cdpipe.model.types import SessionName

# What pyoctomap calls a voxel that was met and is less probable than the limit.
_FREE = 0
# Paths beyond this get an origin of their own.
_FAR_M = 1000.0


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
    origin = _near_origin(maps.merged.map_of(other).odom_T_sensor[:, :3, 3], settings.voxel_m)
    for odom_T_sensor, returns_odom in maps.scans(other, settings.every_scan):
        position = odom_T_sensor[:3, 3] - origin
        tree.insertPointCloud(thin(returns_odom - origin, settings.voxel_m), position, lazy_eval=True)
    is_free = np.zeros(len(maps.points[session]), dtype=np.bool_)
    is_free[compared] = tree.getLabels(points_odom - origin) == _FREE
    return is_free


def _near_origin(path: Float64Array, voxel_m: float) -> Float64Array:
    """Return an origin (3,) on the grid near a (S, 3) path, because voxels have numbers of 16 bits; 0 within 1 km."""
    centre = path.mean(axis=0) if len(path) else np.zeros(3)
    return np.asarray(np.round(centre / voxel_m) * voxel_m if np.linalg.norm(centre) > _FAR_M else np.zeros(3))


def load_pyoctomap() -> Any:
    """Return the module pyoctomap."""
    import pyoctomap

    return pyoctomap
