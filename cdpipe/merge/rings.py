"""Short recordings of few beams: their maps are rings that lie apart, and rings fit rings one revolution further, too.

The rings of a sensor have the same places around it in every revolution. Where the neighbourhood of a point is a line,
its normal is not known, so that a registration lays ring onto ring. Over a long path the rings of many revolutions
cover the surface.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, travelled_m
from cdpipe.model.types import MappedSession

# 0.28 to 0.33 was measured on ten revolutions of a real sensor with 8 beams, whose merge slipped by the step of one
# revolution; 0.05 to 0.08 on two single scans of 32 beams, and 0.01 or less on 128 beams and in simulated drifts.
MAX_LINE_SHARE = 0.2
_SHORT_M = 10.0
_RADIUS_M = 1.0
_N_SAMPLES = 1000
# A neighbourhood whose second spread is this share of its first, or less, is a line.
_LINE = 0.3


def measure_rings(before: MappedSession, after: MappedSession, seen_within_m: float) -> dict[str, float]:
    """Return the evidence `line_share` of a pair whose shorter path is below 10 m: the larger share of both maps.

    Args:
        before: The before session.
        after: The after session.
        seen_within_m: Points that were seen from farther away are left out.
    """
    if min(float(travelled_m(each.map.odom_T_keyframe)[-1]) for each in (before, after)) >= _SHORT_M:
        return {}
    near = (each.map.points[each.map.nearest_m <= seen_within_m] for each in (before, after))
    return {"line_share": max(line_share(points) for points in near)}


def line_share(points: Float64Array) -> float:
    """Return the share of (N, 3) points, metres, whose neighbours within 1 m lie along a line; 1 without points."""
    tree = cKDTree(points)
    sampled = points[:: max(1, len(points) // _N_SAMPLES)]
    n_lines = sum(_is_line(points[near]) for near in tree.query_ball_point(sampled, _RADIUS_M))
    return n_lines / len(sampled) if len(sampled) else 1.0


def explain_rings(evidence: Mapping[str, float]) -> str:
    """Return why a pair of short recordings is refused, "" if their surfaces are covered or none was measured."""
    share = evidence.get("line_share", 0.0)
    if share <= MAX_LINE_SHARE:
        return ""
    return (
        f"the beams are so few that {share:.0%} of the points lie on single rings (line_share), which fit one another "
        "at other places too: record a path of ten metres or more, or give the merge (--before-T-after, "
        f"--assume-aligned); at most {MAX_LINE_SHARE:.0%} are accepted"
    )


def _is_line(points: Float64Array) -> bool:
    if len(points) < 3:
        return True
    variances = np.linalg.eigvalsh(np.cov(points.T))
    return bool(variances[1] <= _LINE**2 * variances[2])
