"""M3C2-EP (Winiwarter, Anders, Höfle 2021), extra `m3c2`: M3C2 with a level of detection by error propagation.

Distances are those of `m3c2`. Their level of detection does not follow from the roughness of the surfaces, but from the
errors of ranges and angles, averaged over the cylinder, and from that of the alignment, which no average reduces. A
point is new if the other map's surface lies behind it by more than this level.
"""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array
from cdpipe.methods.m3c2 import Distances, measure_distances
from cdpipe.methods.whole_map import PlacedMaps, WholeMap
from cdpipe.model.config import M3C2EPConfig, PipelineConfig
from cdpipe.model.types import SessionName
from cdpipe.query.query import query_nearest

# py4dgeo's: fewest points of a cylinder, and the 95 % quantile of chi squared with three degrees of freedom.
_LEAST_POINTS = 5
_CHI_SQUARED = 7.815


@WholeMap
def m3c2_ep(maps: PlacedMaps, session: SessionName, other: SessionName, config: PipelineConfig) -> BoolArray:
    """Mark the map points of `session` in front of the surface of `other`, by more than the level of detection.

    Args:
        maps: Both maps.
        session: The session whose points are marked.
        other: The session they are compared to.
        config: `m3c2`, `m3c2_ep` and `query.radius_m` are used. Points farther than that from the other path are not
            compared, so they are not measured.

    Returns:
        (N,) mask of the points of `session`.
    """
    core, found = measure_distances(maps, session, other, config.m3c2)
    points = maps.points[session]
    levels_m = detection_levels(points[core], maps.path[session], maps.path[other], found, config.m3c2_ep)
    is_new = np.zeros(len(points), dtype=np.bool_)
    is_new[core] = found.behind_m > levels_m
    return is_new


def detection_levels(
    points: Float64Array, path: Float64Array, other_path: Float64Array, found: Distances, settings: M3C2EPConfig
) -> Float64Array:
    """Return the (C,) level of detection of distances, metres; NaN where a cylinder holds too few points.

    The covariance of a mean of n points is that of one point over n; that of the alignment is added.

    Args:
        points: (C, 3) core points.
        path: (K, 3) sensor positions of their session; each point is seen from the nearest.
        other_path: (L, 3) those of the other session.
        found: What M3C2 measured at the core points.
        settings: Standard deviations of ranges, angles and alignment.
    """
    covariances = settings.alignment_m**2 * np.eye(3)[None]
    for positions, counts in ((path, found.n_own), (other_path, found.n_other)):
        seen_from = positions[query_nearest(points, positions)[1]]
        covariances = covariances + _covariances(points - seen_from, settings) / np.maximum(counts, 1)[:, None, None]
    precisions = np.einsum("ni,ni->n", found.normals, np.linalg.solve(covariances, found.normals[:, :, None])[:, :, 0])
    is_enough = np.minimum(found.n_own, found.n_other) >= _LEAST_POINTS
    return np.where(is_enough, np.sqrt(_CHI_SQUARED / precisions), np.nan)


def _covariances(rays: Float64Array, settings: M3C2EPConfig) -> Float64Array:
    """Return the (C, 3, 3) covariance of a return at the end of each of (C, 3) rays; both angles err alike."""
    ranges_m = np.maximum(np.linalg.norm(rays, axis=1), 1e-6)[:, None, None]
    along = np.einsum("ni,nj->nij", rays, rays) / ranges_m**2
    across_m = ranges_m * np.deg2rad(settings.angle_deg)
    return np.asarray(settings.range_m**2 * along + across_m**2 * (np.eye(3) - along))
