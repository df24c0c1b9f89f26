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
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.core.threads import THREADS
from cdpipe.methods.whole_map import PlacedMaps, WholeMap
from cdpipe.model.config import M3C2Config, PipelineConfig
from cdpipe.model.types import SessionName
from cdpipe.query.query import query_nearest

# Core points move this share of the cylinder's half length along their normals.
_OFF_SLABS = 1e-6


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
    core, found = measure_distances(maps, session, other, config.m3c2)
    is_new = np.zeros(len(maps.points[session]), dtype=np.bool_)
    # NaN where there is no distance, and where the points are too few to tell its error
    is_new[core] = found.behind_m > np.fmax(found.levels_m, config.m3c2.distance_m)
    return is_new


@dataclass(frozen=True, slots=True, eq=False)
class Distances:
    """What M3C2 measured at C core points of an own cloud.

    Attributes:
        behind_m: (C,) how far the other cloud's surface lies behind the own one, seen from the void, metres; NaN where
            a cylinder holds no point of either, or too few points tell a normal.
        levels_m: (C,) 95 % level of detection by the roughness of both surfaces, metres; may be NaN.
        normals: (C, 3) unit normals, NaN where too few points tell one; their sign means nothing.
        n_own: (C,) points of the own cloud in the cylinder.
        n_other: (C,) points of the other cloud in it.
    """

    behind_m: Float64Array
    levels_m: Float64Array
    normals: Float64Array
    n_own: Int64Array
    n_other: Int64Array


def measure_distances(
    maps: PlacedMaps, session: SessionName, other: SessionName, settings: M3C2Config
) -> tuple[Int64Array, Distances]:
    """Measure the distances of the compared map points of `session` to `other` along their normals.

    Returns:
        (C,) index of each core point among the session's map points, and what was measured there; the void is on the
        side of the session's path.
    """
    points = maps.points[session]
    core = np.flatnonzero(maps.is_compared(session, other))
    seen_from = maps.path[session][query_nearest(points[core], maps.path[session])[1]]
    return core, compare_clouds(points[core], seen_from - points[core], points, maps.points[other], settings)


def compare_clouds(
    core_points: Float64Array, into_void: Float64Array, own: Float64Array, other: Float64Array, settings: M3C2Config
) -> Distances:
    """Measure the distances between two clouds along the normals of the own one, without an error of registration.

    Args:
        core_points: (C, 3) where to measure, metres.
        into_void: (C, 3) directions, of any length, towards the void in front of the own cloud. They only say which of
            its two directions a normal has.
        own: (N, 3) cloud that normals are estimated in.
        other: (M, 3) cloud, same frame.
        settings: Radii of normals and cylinder, and half of its length.
    """
    n = len(core_points)
    if min(n, len(own), len(other)) == 0:
        unknown, no_counts = np.full(n, np.nan), np.zeros(n, dtype=np.int64)
        return Distances(unknown, unknown, np.full((n, 3), np.nan), no_counts, no_counts)
    py4dgeo = load_py4dgeo()
    centre = core_points.mean(axis=0)  # far from its origin py4dgeo is off: some of its numbers are of single precision
    epochs = py4dgeo.Epoch(own - centre), py4dgeo.Epoch(other - centre)
    core_points = core_points - centre
    normals = py4dgeo.M3C2(epochs=epochs, corepoints=core_points, normal_radii=[settings.normal_m]).directions()
    # py4dgeo cuts its cylinder into slabs; a point on the plane between two counts once, twice or not at all. That
    # plane often holds the core point itself, which is one of the own cloud.
    algorithm = py4dgeo.M3C2(
        epochs=epochs,
        corepoints=core_points + _OFF_SLABS * settings.depth_m * normals,
        corepoint_normals=normals,
        cyl_radius=settings.cylinder_m,
        max_distance=settings.depth_m,
    )
    distances_m, uncertainties = algorithm.run()
    # fewer than three points tell no normal; py4dgeo returns zeros, or any normal to the line through two
    third_m = np.asarray(cKDTree(own).query(core_points + centre, k=3)[0])[:, 2]
    has_normal = third_m <= settings.normal_m
    is_into_void = np.einsum("ij,ij->i", normals, into_void) > 0
    return Distances(
        np.where(has_normal, np.where(is_into_void, -distances_m, distances_m), np.nan),
        np.where(has_normal, uncertainties["lodetection"], np.nan),
        np.where(has_normal[:, None], normals, np.nan),
        *(np.where(has_normal, uncertainties[f"num_samples{epoch}"], 0).astype(np.int64) for epoch in (1, 2)),
    )


def load_py4dgeo() -> Any:
    """Return the module py4dgeo, silent and held to one thread."""
    with warnings.catch_warnings():  # its import silences every warning of the process
        import py4dgeo

    # it logs to standard output and into a file in the working folder
    logging.getLogger("py4dgeo").setLevel(logging.CRITICAL)
    if "OMP_NUM_THREADS" not in os.environ:
        py4dgeo.set_num_threads(THREADS)
    return py4dgeo
