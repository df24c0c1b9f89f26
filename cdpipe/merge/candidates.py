"""Merge hypotheses from descriptor correspondences: FRAME's closest pair, or a vote among many pairs.

FRAME (arXiv 2301.09213) uses only the pair of keyframes with the smallest descriptor distance. In a mine of similar
drifts most pairs are wrong, the closest one included. Correct pairs imply the same motion between the sessions, so
every pair votes for every other. Two pairs agree if their keyframes are equally far apart in both sessions, in the
direction that the yaw of the pair predicts, and if their yaws agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, invert, yaw_pose
from cdpipe.descriptors.yaw import relative_yaws_rad
from cdpipe.merge.registration import motion_between
from cdpipe.model.config import MergeConfig
from cdpipe.model.types import DescriptorSet, MappedSession

# At most this many after keyframes are queried; neighbours and yaws for each. The vote is quadratic in the pairs.
_MAX_QUERIES = 100
_NEAREST = 2
_N_YAWS = 2
# Keyframes of a short session that are compared first.
_FEWEST = 10
# Yaws to try without orientation vectors: GICP converges from about 60 degrees, so quarter turns cover the circle.
_BLIND_YAWS_RAD = np.array([0.0, np.pi, np.pi / 2, -np.pi / 2])
# Tolerance of the distance between two pairs: keyframes of one place are up to 2 m apart; drift grows with distance.
_APART_M = 2.0
_APART_SHARE = 0.02
# Heights may differ by this share of the distance: 4 degrees of pitch between two odometries.
_RISE_SHARE = 0.07
_YAW_RAD = np.deg2rad(20.0)
# Motions closer than this converge to the same registration.
_SAME_M = 3.0
# Decay length of a vote: drift bends the path between distant pairs.
_VOTE_REACH_M = 40.0


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A merge hypothesis: a before and an after keyframe that may be the same place.

    Attributes:
        before_keyframe: Index of the before keyframe.
        after_keyframe: Index of the after keyframe.
        descriptor_distance: Euclidean distance of their place vectors.
        before_T_after: (4, 4) initial guess of the alignment, after odom to before odom.
    """

    before_keyframe: int
    after_keyframe: int
    descriptor_distance: float
    before_T_after: Float64Array


def find_closest_pair(before: MappedSession, after: MappedSession) -> list[Candidate]:
    """Return FRAME's only candidate, the closest of all descriptor pairs; empty if a session has no descriptor."""
    rows = np.arange(len(before.descriptors.q)), np.arange(len(after.descriptors.q))
    pairs = _match_descriptors(before.descriptors, after.descriptors, rows, nearest=1, n_yaws=1)
    if len(pairs.i) == 0:
        return []
    best = int(np.argmin(pairs.distances))
    before_poses, after_poses = _poses(before), _poses(after)
    i, j = int(pairs.i[best]), int(pairs.j[best])
    guess = before_poses[i] @ yaw_pose(float(pairs.yaws_rad[best])) @ invert(after_poses[j])
    return [Candidate(i, j, float(pairs.distances[best]), guess)]


def first_keyframes(n_keyframes: int, every: int, is_after: bool) -> Int64Array:
    """Return the keyframes of a session that are compared first: indices, rising.

    They are every `every`-th of a before session, so that each place has one nearby, and half as many of an after
    session, which only have to be enough for a vote; 100 of it at most, because no more are queried. Short sessions
    have ten, if they have ten keyframes. With `every` = 1 they are all that are ever compared.

    Args:
        n_keyframes: Number of keyframes of the session.
        every: `merge.first_every`.
        is_after: Whether the session is the after session.
    """
    if is_after and every > 1:
        every *= 2
    chosen = np.arange(0, n_keyframes, max(1, min(every, n_keyframes // _FEWEST)))
    return chosen[_spread(len(chosen), _MAX_QUERIES)] if is_after else chosen


def list_tries(before: MappedSession, after: MappedSession, config: MergeConfig) -> tuple[int, ...]:
    """Return every which keyframe to compare, one try after the other: all of short sessions at once."""
    n_before, n_after = len(before.descriptors.q), len(after.descriptors.q)

    def count(every: int) -> tuple[int, int]:
        return len(first_keyframes(n_before, every, False)), len(first_keyframes(n_after, every, True))

    return (1,) if count(config.first_every) == count(1) else (config.first_every, 1)


def find_candidates(
    before: MappedSession, after: MappedSession, config: MergeConfig, every: int = 1
) -> list[Candidate]:
    """Return up to `n_candidates` pairs in falling order of votes, each with a different motion.

    The initial guess of a pair is the motion that best fits all pairs that agree with it. Pairs that agree with a
    chosen pair, or have the same motion, are left out.

    Args:
        before: The before session.
        after: The after session.
        config: Settings of the merge.
        every: Only the `first_keyframes` of both sessions are compared; 1: all of them.
    """
    described = before.descriptors, after.descriptors
    rows = first_keyframes(len(described[0].q), every, False), first_keyframes(len(described[1].q), every, True)
    pairs = _match_descriptors(*described, rows, _NEAREST, _N_YAWS)
    before_poses, after_poses = _poses(before)[pairs.i], _poses(after)[pairs.j]
    agrees, votes = count_votes(before_poses, after_poses, pairs.yaws_rad)
    is_open = np.ones(len(pairs.i), dtype=np.bool_)
    chosen: list[Candidate] = []
    for pair in np.lexsort((pairs.distances, -votes)).tolist():
        if not is_open[pair]:
            continue
        is_open &= ~agrees[pair]
        guess = _fit_common_motion(before_poses, after_poses, pairs.yaws_rad, agrees[pair], pair)
        motions = [motion_between(guess, other.before_T_after, after_poses[pair, :3, 3]) for other in chosen]
        if any(apart_m < _SAME_M and apart_rad < _YAW_RAD for apart_m, apart_rad in motions):
            continue
        chosen.append(Candidate(int(pairs.i[pair]), int(pairs.j[pair]), float(pairs.distances[pair]), guess))
        if len(chosen) == config.n_candidates:
            break
    return chosen


def count_votes(
    before_poses: Float64Array, after_poses: Float64Array, yaws_rad: Float64Array
) -> tuple[BoolArray, Float64Array]:
    """Return the agreement of P pairs, (P, P), and the votes of each, (P,); every pair agrees with itself.

    Args:
        before_poses: (P, 4, 4) before keyframe of each pair, its session's odom frame.
        after_poses: (P, 4, 4) after keyframe of each pair, likewise.
        yaws_rad: (P,) yaw of the after keyframe in the before keyframe, about the sensor's own axis.
    """
    turns_rad = _turns_rad(before_poses, after_poses, yaws_rad)
    before_xy, after_xy = before_poses[:, :2, 3], after_poses[:, :2, 3]
    before_m, after_m = cdist(before_xy, before_xy), cdist(after_xy, after_xy)
    cosines, sines = np.cos(turns_rad), np.sin(turns_rad)
    # compare the cosine of the angle between two rotations
    directions = np.column_stack([cosines, sines])
    is_same_turn = directions @ directions.T > np.cos(_YAW_RAD)
    # few pairs pass both tests; only these are tested by direction
    before_m -= after_m
    is_as_far = np.abs(before_m, out=before_m) < _APART_M + _APART_SHARE * after_m
    one, other = np.divmod(np.flatnonzero(is_same_turn & is_as_far), len(turns_rad))
    apart_m = after_m[one, other]
    before_x, before_y = (before_xy[other] - before_xy[one]).T
    after_x, after_y = (after_xy[other] - after_xy[one]).T
    # difference between the before offset and the after offset rotated by the pair's yaw
    miss_x = before_x - (cosines[one] * after_x - sines[one] * after_y)
    miss_y = before_y - (sines[one] * after_x + cosines[one] * after_y)
    tolerance_m = _APART_M + (_APART_SHARE + np.sin(_YAW_RAD)) * apart_m
    is_agreed = miss_x**2 + miss_y**2 < tolerance_m**2
    # the turns of a decline and the levels of a mine lie above one another
    before_z, after_z = before_poses[:, 2, 3], after_poses[:, 2, 3]
    miss_z = (before_z[other] - before_z[one]) - (after_z[other] - after_z[one])
    is_agreed &= np.abs(miss_z) < _APART_M + _RISE_SHARE * apart_m
    one, other, apart_m = one[is_agreed], other[is_agreed], apart_m[is_agreed]
    agrees = np.zeros((len(yaws_rad),) * 2, dtype=np.bool_)
    agrees[one, other] = True
    votes: Float64Array = np.bincount(one, np.exp(-apart_m / _VOTE_REACH_M), len(yaws_rad)).astype(np.float64)
    return agrees, votes


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """P descriptor correspondences: before keyframe i, after keyframe j, distance of q, yaw of j in i, (P,) each."""

    i: Int64Array
    j: Int64Array
    distances: Float64Array
    yaws_rad: Float64Array


def _match_descriptors(
    before: DescriptorSet, after: DescriptorSet, rows: tuple[Int64Array, Int64Array], nearest: int, n_yaws: int
) -> _Pairs:
    """Pair each of some after keyframes with its nearest ones of some before keyframes; `rows` are the indices."""
    searched, queried = rows
    if len(searched) == 0 or len(queried) == 0:
        return _Pairs(*(np.zeros(0, dtype=np.int64),) * 2, *(np.zeros(0),) * 2)
    ranks = [*range(1, min(nearest, len(searched)) + 1)]
    found = cKDTree(before.q[searched]).query(after.q[queried], k=ranks)
    distances, i = np.asarray(found[0]).ravel(), searched[np.asarray(found[1], dtype=np.int64).ravel()]
    j = np.repeat(queried, len(ranks))
    if before.w is None or after.w is None:
        yaws_rad = np.repeat(_BLIND_YAWS_RAD[None], len(i), axis=0)
    else:
        yaws_rad = relative_yaws_rad(before.w[i], after.w[j], n_yaws)
        is_blind = np.isnan(yaws_rad).all(axis=1)
        if is_blind.all():  # no orientation vector has a peak
            yaws_rad = np.repeat(_BLIND_YAWS_RAD[None], len(i), axis=0)
    which = np.repeat(np.arange(len(i)), yaws_rad.shape[1])
    is_there = ~np.isnan(yaws_rad.ravel())
    which = which[is_there]
    return _Pairs(i[which], j[which], distances[which], yaws_rad.ravel()[is_there])


def _spread(n: int, most: int) -> Int64Array:
    """Return up to `most` of the indices of n items, evenly spread."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(np.int64))


def _fit_common_motion(
    before_poses: Float64Array, after_poses: Float64Array, yaws_rad: Float64Array, agrees: BoolArray, pair: int
) -> Float64Array:
    """Return the (4, 4) before_T_after, yaw and translation, that best fits a pair and the pairs that agree with it.

    Near pairs weigh more. The yaw is the weighted mean of the pairs' yaws and of the directions between their places.
    """
    before_xyz, after_xyz = before_poses[agrees, :3, 3], after_poses[agrees, :3, 3]
    weights = np.exp(-np.linalg.norm(after_xyz - after_poses[pair, :3, 3], axis=1) / _VOTE_REACH_M)
    weights /= weights.sum()
    before_centre, after_centre = weights @ before_xyz, weights @ after_xyz
    before_shift, after_shift = before_xyz - before_centre, after_xyz - after_centre
    directions = (after_shift[:, 0] - 1j * after_shift[:, 1]) * (before_shift[:, 0] + 1j * before_shift[:, 1])
    turns_rad = _turns_rad(before_poses[agrees], after_poses[agrees], yaws_rad[agrees])
    # standard deviations: 1 m of a place, 5 degrees of a yaw
    evidence = weights @ directions / 1.0**2 + weights @ np.exp(1j * turns_rad) / np.deg2rad(5.0) ** 2
    turn = yaw_pose(float(np.angle(evidence)))
    turn[:3, 3] = before_centre - turn[:3, :3] @ after_centre
    return turn


def _poses(session: MappedSession) -> Float64Array:
    """Return the (K, 4, 4) `odom_T_sensor` of the keyframes of a session that have descriptors."""
    return session.map.odom_T_sensor[session.descriptors.keyframe_scans]


def _turns_rad(before_poses: Float64Array, after_poses: Float64Array, yaws_rad: Float64Array) -> Float64Array:
    """Return the (P,) yaw of the after odom frame in the before odom frame that each pair implies.

    It is not the sum of yaw and headings: an upside-down sensor measures yaw with the opposite sign.
    """
    cosines, sines = np.cos(yaws_rad), np.sin(yaws_rad)
    x, y, z = np.moveaxis(before_poses[:, :3, :3], 2, 0)
    yawed = np.stack([cosines[:, None] * x + sines[:, None] * y, cosines[:, None] * y - sines[:, None] * x, z], axis=2)
    turns = yawed @ after_poses[:, :3, :3].transpose(0, 2, 1)
    # the rotation about z that is nearest to the full rotation
    return np.asarray(np.arctan2(turns[:, 1, 0] - turns[:, 0, 1], turns[:, 0, 0] + turns[:, 1, 1]))
