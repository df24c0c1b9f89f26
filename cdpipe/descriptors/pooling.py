"""From the sectors of single keyframes to the score of a place: what neighbours agree on, and the best in reach."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array

# Keyframes farther apart than this along the path look at different stretches.
_NEIGHBOUR_M = 2.5


def agreed(logits: Float64Array, positions: Float64Array) -> Float64Array:
    """Return (K, S) log-odds, each averaged with the same sector of the keyframes before and after, which weigh half.

    Neighbours a metre apart see most of the same wall: what only one of them calls changed is noise. A neighbour that
    is missing (the end of the path, a gap in it) is replaced by the keyframe itself.

    Args:
        logits: (K, S), in the order of the path.
        positions: (K, 3) of the keyframes, metres.
    """
    is_apart = np.linalg.norm(np.diff(positions, axis=0), axis=1) > _NEIGHBOUR_M
    here = np.arange(len(logits))
    before = np.where(np.concatenate([[True], is_apart]), here, here - 1) if len(here) else here
    after = np.where(np.concatenate([is_apart, [True]]), here, here + 1) if len(here) else here
    return np.asarray((logits[before] + 2 * logits + logits[after]) / 4)


def best_in_reach(scores: Float64Array, positions: Float64Array, reach_m: float) -> Float64Array:
    """Return the (K,) highest of the scores of the keyframes within `reach_m` of each, the border included."""
    if len(scores) == 0:
        return scores
    near = cKDTree(positions).query_ball_point(positions, reach_m)
    return np.array([scores[found].max() for found in near])
