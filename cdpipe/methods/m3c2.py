"""M3C2 (Lague, Brodu, Leroux 2013) by py4dgeo, extra `m3c2`: how far a surface moved along its own normal.

The normal at a map point is that of the plane through its own map around it. The distance is that between the mean
points of both maps within a cylinder along the normal. A point is new if the distance is larger than its 95 % level of
detection and than `m3c2.distance_m`, and if the other map's surface lies behind the point, seen from the session's
own path: a crate stands in front of the floor, and the floor under it is hidden, not removed.
"""

# ruff: noqa: PLC0415 - py4dgeo is an extra, and everybody else must be able to import this

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.core.threads import THREADS
from cdpipe.methods.whole_map import PlacedMaps, WholeMap
from cdpipe.model.config import M3C2Config, PipelineConfig
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
        config: `m3c2` and `query.radius_m` are used. Points farther than that from the other path are not compared, so
            they are not measured.

    Returns:
        (N,) mask of the points of `session`.
    """
    found = measure_distances(maps, session, other, config.m3c2)
    is_new = np.zeros(len(maps.points[session]), dtype=np.bool_)
    # NaN where there is no distance, and where the points are too few to tell its error
    is_new[found.core] = found.behind_m > np.fmax(found.levels_m, config.m3c2.distance_m)
    return is_new


@dataclass(frozen=True, slots=True, eq=False)
class Distances:
    """What M3C2 measured at some map points of a session, its core points.

    Attributes:
        core: (C,) index of each among the session's map points.
        behind_m: (C,) how far the other map's surface lies behind the own one, seen from the session's path, metres;
            NaN where a cylinder holds no point.
        levels_m: (C,) 95 % level of detection by the roughness of both surfaces, metres; may be NaN.
        normals: (C, 3) unit normals; their sign means nothing.
        n_own: (C,) points of the own map in the cylinder.
        n_other: (C,) points of the other map in it.
    """

    core: Int64Array
    behind_m: Float64Array
    levels_m: Float64Array
    normals: Float64Array
    n_own: Int64Array
    n_other: Int64Array


def measure_distances(maps: PlacedMaps, session: SessionName, other: SessionName, settings: M3C2Config) -> Distances:
    """Measure the distances of the compared map points of `session` to `other` along their normals."""
    py4dgeo = load_py4dgeo()
    points = maps.points[session]
    core = np.flatnonzero(maps.is_compared(session, other))
    if len(core) == 0:
        none, no_counts = np.zeros(0), np.zeros(0, dtype=np.int64)
        return Distances(core, none, none, np.zeros((0, 3)), no_counts, no_counts)
    algorithm = py4dgeo.M3C2(
        epochs=(py4dgeo.Epoch(points), py4dgeo.Epoch(maps.points[other])),
        corepoints=points[core],
        normal_radii=[settings.normal_m],
        cyl_radius=settings.cylinder_m,
        max_distance=settings.depth_m,
    )
    distances_m, uncertainties = algorithm.run()
    normals = algorithm.directions()
    seen_from = maps.path[session][query_nearest(points[core], maps.path[session])[1]]
    is_towards_path = np.einsum("ij,ij->i", normals, seen_from - points[core]) > 0
    return Distances(
        core,
        np.where(is_towards_path, -distances_m, distances_m),
        uncertainties["lodetection"],
        normals,
        *(uncertainties[f"num_samples{epoch}"].astype(np.int64) for epoch in (1, 2)),
    )


def load_py4dgeo() -> Any:
    """Return the module py4dgeo, silent and held to one thread."""
    import py4dgeo

    # it logs to standard output and into a file in the working folder
    logging.getLogger("py4dgeo").setLevel(logging.CRITICAL)
    if "OMP_NUM_THREADS" not in os.environ:
        py4dgeo.set_num_threads(THREADS)
    return py4dgeo
