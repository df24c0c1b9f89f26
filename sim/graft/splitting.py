"""One recording as two sessions: two passes of one way, two halves, or every other revolution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, Int64Array, travelled_m
from scenarios.grafted import SplitName

NEAR_M = 2.0  # a place counts as driven again when the sensor comes this near to it
_PASS_M = 5.0  # least length of a pass
_COVERED = 0.7  # least share of either pass that the other covers
_CUTS = 200
_AS_GOOD = 0.02  # of cuts this close to the best one that in the middle is taken


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """Which revolutions of a recording make which session.

    Attributes:
        name: "passes", "halves" or "alternate".
        before, after: (A,) and (B,) numbers of revolutions, rising.
    """

    name: str
    before: Int64Array
    after: Int64Array


def split_scans(odom_T_sensor: Float64Array, how: SplitName, name: str) -> Split:
    """Split the revolutions of a recording.

    `passes` cuts where both parts cover each other best: within 2 m of the other part's path. `auto` takes passes where
    70 % of either are covered and either is 5 m long, else every other revolution, which sees the same from the same
    places.

    Args:
        odom_T_sensor: (S, 4, 4) poses.
        how: What is asked for.
        name: Of the recording, for messages.

    Raises:
        ScenarioError: There is one revolution, or there are no two passes.
    """
    n_scans = len(odom_T_sensor)
    if n_scans < 2:
        raise ScenarioError(f"{name}: one revolution makes no pair: give a second recording of the same place")
    numbers = np.arange(n_scans)
    if how in ("auto", "passes"):
        cut = _find_passes(odom_T_sensor)
        if cut is not None:
            return Split("passes", numbers[:cut], numbers[cut:])
        if how == "passes":
            raise ScenarioError(
                f"{name}: no way is driven twice: no cut leaves two parts of {_PASS_M:g} m of which "
                f"{_COVERED:.0%} lie within {NEAR_M:g} m of the other: --split alternate or halves"
            )
    if how == "halves":
        return Split("halves", numbers[: n_scans // 2], numbers[n_scans // 2 :])
    return Split("alternate", numbers[::2], numbers[1::2])


def _find_passes(odom_T_sensor: Float64Array) -> int | None:
    """Return the first revolution of the second pass of a way; None where no way is driven twice."""
    way_m, places = travelled_m(odom_T_sensor), odom_T_sensor[:, :3, 3]
    cuts = np.unique(np.searchsorted(way_m, np.linspace(_PASS_M, way_m[-1] - _PASS_M, _CUTS)))
    if way_m[-1] < 2 * _PASS_M:
        return None
    # a scan counts half of the ways from the one before and to the next: where the sensor stood, there are many scans
    own_m = np.diff(way_m, prepend=way_m[0]) / 2 + np.diff(way_m, append=way_m[-1]) / 2
    shares = np.array([_covered_share(places, own_m, cut) for cut in cuts])
    good = cuts[(shares >= _COVERED) & (shares >= shares.max() - _AS_GOOD)]
    if not len(good):
        return None
    return int(good[np.abs(way_m[good] - way_m[-1] / 2).argmin()])


def _covered_share(places: Float64Array, own_m: Float64Array, cut: int) -> float:
    """Return the share of the way of either part of a path within `NEAR_M` of the other part, the smaller of both.

    The metres on either side of the cut are near each other on any path, and count for nothing.

    Args:
        places: (N, 3) of the scans.
        own_m: (N,) length of the way that each stands for.
        cut: The first scan of the second part.
    """
    if not 0 < cut < len(places):
        return 0.0
    is_asked = np.linalg.norm(places - places[cut - 1], axis=1) > NEAR_M
    one, other = np.flatnonzero(is_asked[:cut]), cut + np.flatnonzero(is_asked[cut:])
    if not own_m[one].any() or not own_m[other].any():
        return 0.0
    shares = []
    for part, towards in ((one, other), (other, one)):
        is_near = np.asarray(cKDTree(places[towards]).query(places[part])[0]) <= NEAR_M
        shares.append(float(np.average(is_near, weights=own_m[part])))
    return min(shares)
