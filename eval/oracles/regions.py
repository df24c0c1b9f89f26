"""Regions from the truth, for upper bounds: results of the extraction where every change has a region around it.

The pipeline's stages receive only the regions.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, Int64Array
from cdpipe.model.config import QueryConfig
from cdpipe.model.report import ChangeRegions
from cdpipe.query.query import query_nearest, rank_regions
from eval.scoring.region_metrics import transform_to_map
from eval.truth.ground_truth import GroundTruth


def regions_by_truth(
    truth: GroundTruth, keyframe_scans: tuple[Int64Array, Int64Array], radii_m: Float64Array, config: QueryConfig
) -> ChangeRegions:
    """Return a region around each observable change, except those that the region of a larger change suppresses.

    A centre is the centroid of the change's truth, transformed into the map frame by the true pose of the judged before
    scan truly nearest to it; its pair are the keyframes truly nearest to it. Changes with more cells of truth come
    first, because a smaller change is more likely to lie inside the sphere of a larger one than the reverse.

    Args:
        truth: The pair's truth.
        keyframe_scans: Scans of the before and of the after keyframes, at least one of each.
        radii_m: (Kb,) radius of a region at each before keyframe.
        config: `suppression` is used.

    Returns:
        The regions, all reported with score 1. A before keyframe scores the less the farther its nearest change is.
    """
    n_cells = np.array([len(rows) for rows in truth.change_rows], dtype=np.int64)
    chosen = np.flatnonzero(truth.is_observable)
    chosen = chosen[np.argsort(-n_cells[chosen], kind="stable")]
    places_world = truth.centroids_world[chosen].reshape(-1, 3)
    nearest = [
        np.asarray(cKDTree(session.world_T_sensor[scans, :3, 3]).query(places_world)[1], dtype=np.int64)
        for session, scans in zip((truth.before, truth.after), keyframe_scans, strict=True)
    ]
    keyframes_world = truth.before.world_T_sensor[keyframe_scans[0], :3, 3]
    gaps_m, _ = query_nearest(keyframes_world, places_world)
    return rank_regions(
        centres_map=transform_to_map(places_world, truth.before),
        scores=np.ones(len(chosen)),
        pairs=np.column_stack(nearest),
        radii_m=radii_m[nearest[0]],
        keyframe_scores=np.where(np.isfinite(gaps_m), -gaps_m, np.nan),
        config=config.model_copy(update={"threshold": 1.0, "n_regions": None}),
    )
