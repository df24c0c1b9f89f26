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
    shares = np.array([_covered_share(places[:cut], places[cut:]) for cut in cuts])
    good = cuts[(shares >= _COVERED) & (shares >= shares.max() - _AS_GOOD)]
    if not len(good):
        return None
    return int(good[np.abs(way_m[good] - way_m[-1] / 2).argmin()])


def _covered_share(one: Float64Array, other: Float64Array) -> float:
    """Return the share of either path (N, 3), (M, 3) within `NEAR_M` of the other, the smaller of both.

    The metres on either side of the cut are near each other on any path, and count for nothing.
    """
    if not len(one) or not len(other):
        return 0.0
    joint = one[-1]
    shares = []
    for path, towards in ((one, other), (other, one)):
        far = towards[np.linalg.norm(towards - joint, axis=1) > NEAR_M]
        asked = path[np.linalg.norm(path - joint, axis=1) > NEAR_M]
        if not len(far) or not len(asked):
            return 0.0
        shares.append(float(np.mean(cKDTree(far).query(asked)[0] <= NEAR_M)))
    return min(shares)
