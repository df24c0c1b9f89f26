"""Recognition of each descriptor in one pair of sessions, and its cost: bytes per keyframe, milliseconds to compute it.

Descriptors of scans are measured by the places and headings that they recognise (`find_places`), `sphere` by changes:
the AUROC of the before keyframes, after the pipeline's own merge, with its numbers kept as float32 and as int8.
Milliseconds are CPU time of the one thread that describes, without reading, so that other programs have no effect.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from time import thread_time
from typing import Any, get_args

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, require_poses
from cdpipe.core.ranking import auroc
from cdpipe.descriptors import anchor_frames, checkpoint_digest, describe_map, describe_scan, relative_yaws_rad
from cdpipe.mapping.mapping import build_map
from cdpipe.merge.merge import merge_maps
from cdpipe.model.config import DescriptorConfig, PipelineConfig, load_config
from cdpipe.model.types import DescriptorSet, MappedSession, MergedMaps, PointMap, ScanSource
from cdpipe.query.query import find_regions
from eval.core.statistics import mean, median
from eval.scoring.region_metrics import label_keyframes
from eval.truth.adapters import pipeline_input
from eval.truth.ground_truth import SESSIONS, GroundTruth, load_ground_truth

POSE_BYTES = 7 * 4
POINT_BYTES = 3 * 4
SPHERE = "sphere"
METHODS: tuple[str, ...] = get_args(DescriptorConfig.model_fields["method"].annotation)
PRECISIONS: tuple[str, ...] = get_args(DescriptorConfig.model_fields["precision"].annotation)
Row = dict[str, Any]
Described = tuple[DescriptorSet, Float64Array]


def measure_pair(pair: Path, settings: Iterable[str] = ()) -> list[Row]:
    """Return one row for each descriptor of scans, and one for each precision of `sphere`.

    Args:
        pair: Folder of a simulated pair.
        settings: Over those of `tunnelcd`.

    Raises:
        InputError: A session or its truth is missing or damaged.
    """
    truth = load_ground_truth(pair)
    config = load_config("tunnelcd", settings)
    sources = {name: pipeline_input(pair, name) for name in SESSIONS}
    maps = {name: build_map(sources[name], config.map) for name in SESSIONS}
    weights = config.descriptor.weights
    described = {name: describe_keyframes(sources[name], maps[name], METHODS, weights) for name in SESSIONS}
    rows = [measure_scans(method, described["before"][method], described["after"][method], truth) for method in METHODS]
    method = config.descriptor.method
    mapped = [MappedSession(maps[name], described[name][method][0]) for name in SESSIONS]
    merged = merge_maps(mapped[0], mapped[1], config.merge)
    return rows + measure_spheres(merged, mapped[0].descriptors, mapped[1].descriptors, truth, config)


def describe_keyframes(
    source: ScanSource, thin_map: PointMap, methods: Iterable[str], weights: str = ""
) -> Mapping[str, Described]:
    """Describe every keyframe of a session by several descriptors of scans, reading each scan once.

    Args:
        source: The session.
        thin_map: Its map.
        methods: The descriptors.
        weights: File of the weights of `3deg`, "" for the shipped ones.

    Returns:
        By method, the descriptors and the seconds that each keyframe took.
    """
    configs = {method: DescriptorConfig(method=method, weights=weights) for method in methods}
    parts: dict[str, list[tuple[Any, Any, float]]] = {method: [] for method in configs}
    for index in thin_map.keyframe_scans.tolist():
        scan = source.scan(index)
        for method, config in configs.items():
            start = thread_time()
            q, w = describe_scan(scan, config)
            parts[method].append((q, w, thread_time() - start))
    found = {}
    for method, config in configs.items():
        qs, ws, seconds = zip(*parts[method], strict=True)
        vectors = np.stack(qs), np.stack(ws), thin_map.keyframe_scans, method, checkpoint_digest(config)
        found[method] = DescriptorSet(*vectors), np.array(seconds)
    return found


def measure_scans(method: str, before: Described, after: Described, truth: GroundTruth) -> Row:
    """Return what a descriptor of scans recognises, and its price; its vectors are q and w, kept with a pose each."""
    (own, own_s), (other, other_s) = before, after
    poses = truth.before.world_T_sensor[own.keyframe_scans], truth.after.world_T_sensor[other.keyframe_scans]
    return {
        "descriptor": method,
        "precision": own.q.dtype.name,
        "status": "ok",
        "bytes_per_keyframe": POSE_BYTES + _bytes_each(own.q) + _bytes_each(own.w),
        "ms_per_keyframe": 1000 * float(np.median([*own_s, *other_s])),
        **score_places(own, other, *poses),
    }


def measure_spheres(
    merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, truth: GroundTruth, config: PipelineConfig
) -> list[Row]:
    """Return what `sphere` finds with its numbers kept in each precision, and what is kept against the thinned map.

    Args:
        merged: Both maps; where the merge was refused there is no AUROC.
        before: Keyframes of the before map; what the map around them looks like is described here.
        after: Those of the after map.
        truth: The pair's truth.
        config: All settings; the precision is replaced.
    """
    poses = anchor_frames(merged.before, merged.before.keyframe_scans, config.sphere)
    world = truth.before.world_T_sensor[before.keyframe_scans, :3, 3]
    labels = label_keyframes(world, truth.centroids_world, truth.is_observable, truth.pair.score_radius_m)
    used = labels >= 0
    describe_map(merged.before, poses[:1], config.descriptor, config.sphere)  # loads the network
    rows = []
    for precision in PRECISIONS:
        start = thread_time()
        of_precision = config.descriptor.model_copy(update={"precision": precision})
        spheres = describe_map(merged.before, poses, of_precision, config.sphere)
        described = replace(before, spheres=spheres)
        scores = find_regions(merged, described, after, config).keyframe_scores
        seconds = thread_time() - start
        rows.append(
            {
                "descriptor": SPHERE,
                "precision": precision,
                "status": "ok" if merged.is_accepted else "merge_refused",
                "bytes_per_keyframe": POSE_BYTES + _bytes_each(spheres),
                "ms_per_keyframe": 1000 * seconds / len(poses),
                "map_bytes_per_keyframe": POINT_BYTES * len(merged.before.points) / len(poses),
                "region_auroc": auroc(scores[used], labels[used] == 1) if merged.is_accepted else float("nan"),
                "n_positive": int(np.count_nonzero(labels == 1)),
                "n_negative": int(np.count_nonzero(labels == 0)),
            }
        )
    return rows


SAME_PLACE_M = 3.0
FLIPPED_DEG = 90.0


def find_places(
    before: DescriptorSet, after: DescriptorSet, world_T_before: Float64Array, world_T_after: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Look every after keyframe up among the before keyframes, and compare with the truth.

    Args:
        before: Descriptors of the before session's Kb keyframes.
        after: Descriptors of the after session's Ka keyframes, of the same kind.
        world_T_before: (Kb, 4, 4) true poses of the before keyframes.
        world_T_after: (Ka, 4, 4) true poses of the after keyframes.

    Returns:
        Of the P after keyframes with a before keyframe within 3 m, in the world: (P,) distance in metres to the place
        that was found; (P,) absolute error in degrees of the yaw against the nearest before keyframe, NaN where the
        orientation vectors have no peak, or the descriptor has none.
    """
    require_poses("world_T_before", world_T_before)
    require_poses("world_T_after", world_T_after)
    if len(before.q) != len(world_T_before) or len(after.q) != len(world_T_after):
        raise ValueError(
            f"{len(before.q)} and {len(after.q)} descriptors for {len(world_T_before)} and {len(world_T_after)} poses"
        )
    if len(before.q) == 0 or len(after.q) == 0:
        return np.zeros(0), np.zeros(0)
    places_b, places_a = world_T_before[:, :3, 3], world_T_after[:, :3, 3]
    gaps_m, neighbours = cKDTree(places_b).query(places_a)
    j = np.flatnonzero(np.asarray(gaps_m) <= SAME_PLACE_M)
    i = np.asarray(neighbours)[j]
    found = np.asarray(cKDTree(before.q.astype(np.float64)).query(after.q[j].astype(np.float64))[1], dtype=np.int64)
    errors_deg = np.full(len(j), np.nan)
    if before.w is not None and after.w is not None and len(j):
        true_rad = _heading_rad(world_T_after[j]) - _heading_rad(world_T_before[i])
        off_rad = relative_yaws_rad(before.w[i], after.w[j], n=1)[:, 0] - true_rad
        errors_deg = np.abs(np.rad2deg(np.angle(np.exp(1j * off_rad))))
    return np.linalg.norm(places_b[found] - places_a[j], axis=1), errors_deg


def score_places(
    before: DescriptorSet, after: DescriptorSet, world_T_before: Float64Array, world_T_after: Float64Array
) -> dict[str, float]:
    """Return recall at 1, median yaw error and share of flipped yaws of one pair, NaN where nothing was asked.

    Arguments as `find_places`.
    """
    found_m, errors_deg = find_places(before, after, world_T_before, world_T_after)
    known_deg = errors_deg[~np.isnan(errors_deg)]
    return {
        "place_recall_at_1": mean(found_m <= SAME_PLACE_M),
        "yaw_error_deg": median(known_deg),
        "yaw_flip_share": mean(known_deg > FLIPPED_DEG),
        "n_places": float(len(found_m)),
        "n_yaws": float(len(known_deg)),
    }


def _heading_rad(poses: Float64Array) -> Float64Array:
    return np.asarray(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))


def _bytes_each(vectors: Any) -> int:
    return 0 if vectors is None else vectors.nbytes // max(len(vectors), 1)
