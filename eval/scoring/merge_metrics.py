"""Errors of a merge between places of both sessions that are close to each other in the world.

Both odometries drift, so no single transform is right everywhere. The error is that of the relative pose of an after
place and its truly nearest before place. The places are the judged scans of the sessions, whatever an answer names.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, invert, travelled_m
from eval.core.statistics import median
from eval.truth.ground_truth import SessionTruth

PAIR_RADIUS_M = 5.0
EVIDENCE = (
    "overlap", "inlier_share", "residual_m", "hessian_ratio", "agreement", "distinctness", "descriptor_distance",
    "n_hypotheses", "is_fallback", "n_refined", "refined_inlier_share", "max_correction_m",
)  # fmt: skip
_CHORD_M = 1.0
_STEP_M = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class MergeErrors:
    """Errors of P pairs of judged scans.

    Attributes:
        metres: (P,) length of the translation of E = (true i_T_j)^-1 (estimated i_T_j).
        degrees: (P,) angle of its rotation.
        along_m: (P,) size of its translation along the tunnel; NaN where the robot never moved.
    """

    metres: Float64Array
    degrees: Float64Array
    along_m: Float64Array


def compute_merge_errors(before: SessionTruth, after: SessionTruth, before_T_after: Float64Array) -> MergeErrors:
    """Compare estimated and true relative poses.

    Args:
        before: The before session.
        after: The after session.
        before_T_after: The merge: pose of the after odom frame in the before odom frame, (4, 4) for the whole map or
            (J, 4, 4) for each judged scan of the after session.

    Returns:
        One error for every judged after scan with a judged before scan within 5 m of it in the world.
    """
    scans_i, scans_j = before.judged_scans, after.judged_scans
    world_T_j = after.world_T_sensor[scans_j]
    distance_m, nearest = cKDTree(before.world_T_sensor[scans_i, :3, 3]).query(world_T_j[:, :3, 3])
    is_paired = np.asarray(distance_m) <= PAIR_RADIUS_M
    before_T_after = np.broadcast_to(before_T_after, (len(scans_j), 4, 4))[is_paired]
    scans_i, scans_j, world_T_j = scans_i[np.asarray(nearest)[is_paired]], scans_j[is_paired], world_T_j[is_paired]

    true_i_T_j = invert(before.world_T_sensor[scans_i]) @ world_T_j
    estimated_i_T_j = invert(before.odom_T_sensor[scans_i]) @ before_T_after @ after.odom_T_sensor[scans_j]
    errors = invert(true_i_T_j) @ estimated_i_T_j
    # rotate the tunnel axis into the frame of scan j, that of E's translation
    axes_world = find_travel_directions(after.world_T_sensor)[scans_j]
    axes_j = np.einsum("pji,pj->pi", world_T_j[:, :3, :3], axes_world)
    return MergeErrors(
        metres=np.linalg.norm(errors[:, :3, 3], axis=1),
        degrees=np.rad2deg(Rotation.from_matrix(errors[:, :3, :3]).magnitude()) if len(errors) else np.zeros(0),
        along_m=np.abs(np.einsum("pi,pi->p", errors[:, :3, 3], axes_j)),
    )


def measure_overlap(before_world_T_sensor: Float64Array, after_world_T_sensor: Float64Array) -> float:
    """Return the share of the after trajectory's length that lies within 5 m of the before trajectory.

    Both are the true poses, (S, 4, 4) in the world, joined by straight lines. NaN where the after session never moved.
    """
    after = _along(after_world_T_sensor)
    if len(after) == 0:
        return float("nan")
    before = np.concatenate([before_world_T_sensor[:, :3, 3], _along(before_world_T_sensor)])
    distance_m, _ = cKDTree(before).query(after, distance_upper_bound=2 * PAIR_RADIUS_M)
    return float(np.mean(np.asarray(distance_m) <= PAIR_RADIUS_M))


def _along(poses: Float64Array) -> Float64Array:
    """Return the (N, 3) middles of equal steps of at most 0.1 m along a path."""
    along = travelled_m(poses)
    n_steps = int(np.ceil(along[-1] / _STEP_M))
    middles = (np.arange(n_steps) + 0.5) * along[-1] / max(n_steps, 1)
    return np.stack([np.interp(middles, along, poses[:, axis, 3]) for axis in range(3)], axis=1)


def list_evidence(evidence: Mapping[str, float]) -> dict[str, float]:
    """Return the merge's evidence, accepted or refused; NaN where a figure is missing or not finite."""
    values = {name: float(evidence.get(name, np.nan)) for name in EVIDENCE}
    return {f"evidence_{name}": value if np.isfinite(value) else float("nan") for name, value in values.items()}


def find_travel_directions(poses: Float64Array) -> Float64Array:
    """Return the (S, 3) unit direction of travel at each of (S, 4, 4) poses: the chord over 1 m of path around it.

    NaN where the path has no length.
    """
    along = travelled_m(poses)
    last = len(poses) - 1
    first = np.maximum(np.searchsorted(along, along - _CHORD_M / 2, side="right") - 1, 0)
    second = np.minimum(np.searchsorted(along, along + _CHORD_M / 2), last)
    chords = poses[second, :3, 3] - poses[first, :3, 3]
    lengths = np.linalg.norm(chords, axis=1, keepdims=True)
    return np.asarray(np.divide(chords, lengths, out=np.full_like(chords, np.nan), where=lengths > 0))


def summarise_merge_errors(errors: MergeErrors | None) -> dict[str, float]:
    """Return the columns of results.csv: median and 95th percentile of each error; NaN without pairs or answer."""
    columns: dict[str, float] = {}
    for name, part in (("m", "metres"), ("deg", "degrees"), ("along_m", "along_m")):
        values = np.zeros(0) if errors is None else getattr(errors, part)
        values = values[~np.isnan(values)]
        columns[f"merge_error_{name}"] = median(values)
        columns[f"merge_error_{name}_p95"] = float(np.percentile(values, 95)) if len(values) else float("nan")
    columns["n_merge_pairs"] = 0 if errors is None else len(errors.metres)
    return columns
