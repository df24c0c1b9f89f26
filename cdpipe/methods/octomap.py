"""OctoMap (Hornung, Wurm, Bennewitz, Stachniss, Burgard 2013) by pyoctomap, extra `octomap`: what stands in free space.

OctoMap keeps the probability that a voxel is occupied. A return raises that of its voxel, a ray lowers that of the
voxels on its way. For two sessions, the scans of one fill the map and the map points of the other are looked up in it,
in both directions: a point in a free voxel is new, one in a voxel that no ray met is not.
"""

# ruff: noqa: PLC0415 - pyoctomap is an extra, and everybody else must be able to import this

from __future__ import annotations

from typing import Any

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import BoolArray, Float64Array
from cdpipe.core.geometry.voxel import thin
from cdpipe.methods.whole_map import PlacedMaps, WholeMap
from cdpipe.model.config import PipelineConfig
from cdpipe.model.types import PointMap, SessionName

# What pyoctomap calls a voxel that was met and is less probable than the limit.
_FREE = 0
# Paths beyond this get an origin of their own.
_FAR_M = 1000.0
# So many voxels have numbers on either side of an origin.
_REACH = (1 << 15) - 1


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
    origin = near_origin(maps.merged.map_of(other), settings.voxel_m, other)
    for odom_T_sensor, returns_odom in maps.scans(other, settings.every_scan):
        position = odom_T_sensor[:3, 3] - origin
        tree.insertPointCloud(thin(returns_odom - origin, settings.voxel_m), position, lazy_eval=True)
    is_free = np.zeros(len(maps.points[session]), dtype=np.bool_)
    is_free[compared] = tree.getLabels(points_odom - origin) == _FREE
    return is_free


def near_origin(point_map: PointMap, voxel_m: float, session: SessionName) -> Float64Array:
    """Return an origin (3,) on the grid about which voxels, which have numbers of 16 bits, hold a map and its path.

    It is 0 for a path within 1 km, or else the middle of the path; where the map does not fit then, the middle of all.

    Raises:
        InputError: The map is larger than the voxels.
    """
    path = point_map.odom_T_sensor[:, :3, 3]
    centre = path.mean(axis=0) if len(path) else np.zeros(3)
    places = np.concatenate([path, point_map.points])
    low, high = (end(places, axis=0) if len(places) else centre for end in (np.min, np.max))
    low, high = low - point_map.voxel_m, high + point_map.voxel_m  # a point is the mean of the returns of its cell
    for middle in (centre if np.linalg.norm(centre) > _FAR_M else np.zeros(3), (low + high) / 2):
        origin = np.asarray(np.round(middle / voxel_m) * voxel_m)
        if max((high - origin).max(), (origin - low).max()) < _REACH * voxel_m:
            return origin
    across_m = float((high - low).max())
    least_m = np.ceil(50 * across_m / _REACH) / 100 + 0.01
    raise InputError(
        f"octomap.voxel_m = {voxel_m:g}: the {session} session is {across_m:.0f} m across, and OctoMap can number "
        f"{2 * _REACH * voxel_m:.0f} m of such voxels: expected at least {least_m:.2f}"
    )


def load_pyoctomap() -> Any:
    """Return the module pyoctomap."""
    import pyoctomap

    return pyoctomap
