"""The check of a refined alignment: points that the refinement did not use choose between it and the rigid merge.

The misfit of a point is d^2 / (d^2 + (0.1 m)^2) of its distance d to the before surface, and 1 without a surface near.
A place keeps the refined alignment if the held-out points around it and its two neighbours have a lower misfit under it
than under the rigid merge. Between two places the share of the refined alignment changes linearly.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, make_pose, transform, transform_each, travelled_m
from cdpipe.core.geometry.grid_index import GridIndex
from cdpipe.merge.evidence import plane_distances, sample_evenly
from cdpipe.merge.registration import IndexedMap, search_nearest

# One of so many after points is held out.
HELD_OUT_EVERY = 5
# Points that judge a place, and the fewest of them.
_JUDGES, _MIN_JUDGES = 600, 50
# Scale of the misfit: half the points of a good merge are within 1 cm, and changed objects must not decide.
_MISFIT_M = 0.1


def choose_alignment(
    before: IndexedMap,
    held_out: Float64Array,
    odom_T_keyframe: Float64Array,
    places: Int64Array,
    refined: Float64Array,
    given: Float64Array,
    radius_m: float,
    within_m: float,
) -> tuple[Float64Array | None, dict[str, float]]:
    """Return the alignment that fits the held-out points better, place by place, and the evidence.

    Evidence: `n_judged` places, `n_kept` of them with the refined alignment, `rigid_misfit` and `refined_misfit`, the
    mean over the places; `n_beyond` places that fit better refined but farther away than the limit, if there is one.

    Args:
        before: The before map, indexed as a target.
        held_out: (N, 3) after points that the refinement did not use, after odom frame, metres.
        odom_T_keyframe: (K, 4, 4) poses of the after keyframes.
        places: (A,) keyframes to judge at, rising.
        refined: (K, 4, 4) refined `before_T_after` at each keyframe.
        given: (4, 4) `before_T_after` without the refinement, or (K, 4, 4) at each keyframe.
        radius_m: Points within this distance judge a place, metres.
        within_m: A place that the refinement moves farther keeps the given merge, metres.

    Returns:
        (K, 4, 4) alignments, None if the given merge is to be kept at every place.
    """
    given = np.broadcast_to(given, refined.shape)
    positions, path_m = odom_T_keyframe[:, :3, 3], travelled_m(odom_T_keyframe)
    index = GridIndex(held_out)
    points = [sample_evenly(index.points_within(centre, radius_m), _JUDGES) for centre in positions[places]]
    is_judged = np.array([len(each) >= _MIN_JUDGES for each in points], dtype=np.bool_)
    if not is_judged.any():
        return None, {"n_judged": 0.0, "n_kept": 0.0}
    places, points = places[is_judged], [each for each in points if len(each) >= _MIN_JUDGES]
    misfits = np.array(
        [
            [_measure_misfit(before, poses[place], own) for poses in (given, refined)]
            for place, own in zip(places, points, strict=True)
        ]
    )
    moved_m = np.linalg.norm(transform_each(refined, positions) - transform_each(given, positions), axis=1)
    is_better, is_near = _is_refined_better(misfits), moved_m[places] <= within_m
    is_kept = is_better & is_near
    rigid_misfit, refined_misfit = misfits.mean(axis=0).tolist()
    evidence = {
        "n_judged": float(len(places)),
        "n_kept": float(np.count_nonzero(is_kept)),
        "rigid_misfit": rigid_misfit,
        "refined_misfit": refined_misfit,
    }
    if np.isfinite(within_m):
        evidence["n_beyond"] = float(np.count_nonzero(is_better & ~is_near))
    if not is_kept.any():
        return None, evidence
    return _blend(given, refined, np.interp(path_m, path_m[places], is_kept), positions), evidence


def _measure_misfit(before: IndexedMap, before_T_after: Float64Array, own: Float64Array) -> float:
    """Return the mean misfit of (N, 3) after points, in [0, 1]."""
    surface, moved = before.target, transform(before_T_after, own)
    found, squared_m2 = search_nearest(surface.tree, moved)
    distances_m = plane_distances(moved, surface.points[found], surface.normals[found], squared_m2)
    return float(np.mean(1 - 1 / (1 + (distances_m / _MISFIT_M) ** 2)))


def _is_refined_better(misfits: Float64Array) -> BoolArray:
    """Return for (A, 2) misfits, rigid and refined, whether the refined sum of a place and its neighbours is lower."""
    gains = np.pad(misfits[:, 0] - misfits[:, 1], 1)
    return np.asarray(gains[:-2] + gains[1:-1] + gains[2:] > 0)


def _blend(given: Float64Array, refined: Float64Array, shares: Float64Array, positions: Float64Array) -> Float64Array:
    """Return the (K, 4, 4) poses between the given and the refined ones, by (K,) shares of the refined ones."""
    turns = Rotation.from_matrix(given[:, :3, :3].swapaxes(1, 2) @ refined[:, :3, :3]).as_rotvec()
    rotations = given[:, :3, :3] @ Rotation.from_rotvec(shares[:, None] * turns).as_matrix()
    first, last = (transform_each(poses, positions) for poses in (given, refined))
    moved = (1 - shares[:, None]) * first + shares[:, None] * last
    return make_pose(rotations, moved - np.einsum("kij,kj->ki", rotations, positions))
