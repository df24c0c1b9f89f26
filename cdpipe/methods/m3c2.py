"""M3C2 (Lague, Brodu, Leroux 2013) by py4dgeo, extra `m3c2`: how far a surface moved along its own normal.

The normal at a map point is that of the plane through its own map around it. The distance is that between the mean
points of both maps within a cylinder along the normal. A point is new if the distance is larger than its 95 % level of
detection and than `extract.distance_m`, and if the other map's surface lies behind the point, seen from the session's
own path: a crate stands in front of the floor, and the floor under it is hidden, not removed.
"""

# ruff: noqa: PLC0415 - py4dgeo is an extra, and everybody else must be able to import this

from __future__ import annotations

import logging
import os
from typing import Any

import numpy as np

from cdpipe.core.geometry import BoolArray
from cdpipe.core.threads import THREADS
from cdpipe.methods.whole_map import PlacedMaps, WholeMap
from cdpipe.model.config import PipelineConfig
from cdpipe.model.types import SessionName
from cdpipe.query.query import query_nearest


@WholeMap
def m3c2(maps: PlacedMaps, session: SessionName, other: SessionName, config: PipelineConfig) -> BoolArray:
    """Mark the map points of `session` that stand in front of the surface of `other`.

    A point is not new if its cylinder holds no point of the other map, because there is no distance.

    Args:
        maps: Both maps.
        session: The session whose points are marked.
        other: The session they are compared to.
        config: `m3c2`, `extract.distance_m` and `query.radius_m` are used. Points farther than that from the other path
            are not compared, so they are not measured.

    Returns:
        (N,) mask of the points of `session`.
    """
    py4dgeo = load_py4dgeo()
    points = maps.points[session]
    core = np.flatnonzero(maps.is_compared(session, other))
    is_new = np.zeros(len(points), dtype=np.bool_)
    if len(core) == 0:
        return is_new
    algorithm = py4dgeo.M3C2(
        epochs=(py4dgeo.Epoch(points), py4dgeo.Epoch(maps.points[other])),
        corepoints=points[core],
        normal_radii=[config.m3c2.normal_m],
        cyl_radius=config.m3c2.cylinder_m,
        max_distance=config.m3c2.depth_m,
    )
    distances_m, uncertainties = algorithm.run()
    seen_from = maps.path[session][query_nearest(points[core], maps.path[session])[1]]
    is_towards_path = np.einsum("ij,ij->i", algorithm.directions(), seen_from - points[core]) > 0
    behind_m = np.where(is_towards_path, -distances_m, distances_m)
    # NaN where there is no distance, and where the points are too few to tell its error
    limits_m = np.fmax(uncertainties["lodetection"], config.extract.distance_m)
    is_new[core] = behind_m > limits_m
    return is_new


def load_py4dgeo() -> Any:
    """Return the module py4dgeo, silent and held to one thread."""
    import py4dgeo

    # it logs to standard output and into a file in the working folder
    logging.getLogger("py4dgeo").setLevel(logging.CRITICAL)
    if "OMP_NUM_THREADS" not in os.environ:
        py4dgeo.set_num_threads(THREADS)
    return py4dgeo
