"""Where rock changes: coordinates along and around a drift, and windows over them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array
from sim.rock.centreline import DriftLine, left_of

# Rock farther from the axis than this many sizes of the drift does not move; windows fade out before it.
_FADE_FROM, _FADE_TO = 0.8, 1.2
_FLAT = 0.5  # share of a window over which it is 1
_MARGIN_M = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Around:
    """Places (N,) as seen from the axis of a drift.

    Attributes:
        along_m: Distance along the drift from the middle of a change.
        left_m: Distance to the left of the axis.
        up_m: Height above the floor of the centreline.
        angle_deg: About the axis, half the drift's height up: 0 the crown, 90 the left wall, +-180 the floor.
        share: 1 on rock near the axis, fading to 0 beyond; another drift that near moves as well.
    """

    along_m: Float64Array
    left_m: Float64Array
    up_m: Float64Array
    angle_deg: Float64Array
    share: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class Zone:
    """A stretch of one drift.

    Attributes:
        line: The drift.
        sample: Number of its sample in the middle of the change.
        length_m: Length of the change along the drift.
        where: The place, in words.
    """

    line: DriftLine
    sample: int
    length_m: float
    where: str

    @property
    def reach_m(self) -> float:
        """How far from the middle any rock of this zone may lie."""
        return float(np.hypot(self.length_m / 2 + 2.0, 1.3 * self._size_m))

    @property
    def _size_m(self) -> float:
        return float(max(self.line.width_m[self.sample], self.line.height_m[self.sample]))

    @property
    def middle(self) -> Float64Array:
        """The middle of the change on the axis (3,), world frame."""
        return np.asarray(self.line.points[self.sample] + [0.0, 0.0, self.line.height_m[self.sample] / 2])

    def around(self, places: Float64Array) -> Around:
        """Return places (N, 3), world frame, as seen from the axis."""
        line = self.line
        steps_m = np.linalg.norm(np.diff(line.points[:, :2], axis=0), axis=1)
        station_m = np.concatenate([[0.0], np.cumsum(steps_m)])
        station_m -= station_m[self.sample]
        near = np.flatnonzero(np.abs(station_m) <= self.length_m / 2 + _MARGIN_M)
        _, nearest = cKDTree(line.points[near, :2]).query(places[:, :2])
        at = near[nearest]
        delta = places - line.points[at]
        heading = line.headings[at]
        along_m = station_m[at] + (delta[:, :2] * heading).sum(axis=1)
        left_m = (delta[:, :2] * left_of(heading)).sum(axis=1)
        height_m = line.height_m[at]
        above_m = delta[:, 2] - height_m / 2
        angle_deg = np.rad2deg(np.arctan2(left_m, above_m))
        far = np.maximum(np.abs(left_m) / line.width_m[at], np.abs(above_m) / height_m)
        share = np.clip((_FADE_TO - far) / (_FADE_TO - _FADE_FROM), 0.0, 1.0)
        return Around(along_m, left_m, delta[:, 2], angle_deg, share)


def window(offset: Float64Array) -> Float64Array:
    """Return 1 up to half way, then half a cosine down to 0 at 1: Tukey's window over offsets (N,) from its middle."""
    share = np.clip((np.abs(offset) - _FLAT) / (1.0 - _FLAT), 0.0, 1.0)
    return np.asarray(0.5 * (1.0 + np.cos(np.pi * share)))


def sector_offset(angle_deg: Float64Array, sector_deg: tuple[float, float]) -> Float64Array:
    """Return how far angles (N,) lie from the middle of a sector, in half sectors; 0 everywhere for the whole round."""
    low, high = sector_deg
    if high - low >= 360.0:
        return np.zeros_like(angle_deg)
    apart = (angle_deg - (low + high) / 2 + 180.0) % 360.0 - 180.0
    return np.asarray(apart / ((high - low) / 2))
