"""Columns of a grid in the frame of a drift: distance to the side, height of the floor, width of the drift.

Distances to walls are measured from the nearest sample of the centreline. All other values are Gaussian-weighted means
over the samples nearby. The value of the nearest sample alone would jump where two samples are equally near (inside a
bend, beyond a corner, at the end of a drift), and floor and walls would jump with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from sim.rock.centreline import STEP_M, DriftLine, Recess

MOUTH_SHARE = 1.3  # of the half width: within this distance a drift takes part in the floor of other drifts
_EVERY = 3  # samples of the centreline that take part in the mean
_KERNEL_SHARE = 0.15  # of the width
_SMALLEST_KERNEL_M = 0.45  # 1.5 times the distance of those samples: their sum is smooth to 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Columns (M,) of a grid in the frame of one drift.

    Attributes:
        line: The drift.
        recesses: Its niches near the columns.
        is_near: Whether the drift's void and margin reach the column; elsewhere the other values are undefined.
        side_m: Distance to the centreline, positive to the left.
        lateral_m: The same, but smooth also beyond the end of a line.
        beyond_m: Distance behind the face of a blind end, negative before it, -inf far from one.
        level_m: Height of the drift's floor, without crossfall and ruts.
        half_m, height_m: Half width and height of the drift.
        mouth: 1 on the centreline, falling smoothly to 0 at 1.3 half widths.
    """

    line: DriftLine
    recesses: tuple[Recess, ...]
    is_near: BoolArray
    side_m: Float64Array
    lateral_m: Float64Array
    beyond_m: Float64Array
    level_m: Float64Array
    half_m: Float64Array
    height_m: Float64Array
    mouth: Float64Array


class DriftFrame:
    """One drift, ready to place columns in its frame."""

    def __init__(self, line: DriftLine, recesses: Sequence[Recess], margin_m: float) -> None:
        self._line = line
        self._recesses = tuple(recesses)
        self._tree = cKDTree(line.points[:, :2])
        self._kernel_m = max(_KERNEL_SHARE * line.section.width_m, _SMALLEST_KERNEL_M)
        half_m = float(line.width_m.max()) / 2
        self._margin_m = margin_m
        self._reach_m = max(half_m + margin_m, MOUTH_SHARE * half_m)
        x, y, z = line.points.T
        cosine, sine = line.headings.T
        values = np.stack([np.ones(len(x)), z, line.width_m / 2, line.height_m, cosine, sine, cosine * y - sine * x])
        self._thin = line.points[::_EVERY, :2]
        self._values = values[:, ::_EVERY]
        self._face_samples = round(0.5 * line.section.width_m / STEP_M)

    @property
    def reach_m(self) -> float:
        """How far from the centreline the drift, its margin and its niches may reach."""
        return max([self._reach_m, *(self._recess_reach_m(recess) for recess in self._recesses)])

    def place(self, x_m: Float64Array, y_m: Float64Array) -> Frame | None:
        """Return the columns of the grid x by y, flattened, or None if the drift is far from all of them."""
        columns = np.stack(np.meshgrid(x_m, y_m, indexing="ij"), axis=-1).reshape(-1, 2)
        recesses = tuple(recess for recess in self._recesses if self._touches(recess, x_m, y_m))
        reach_m = max([self._reach_m, *(self._recess_reach_m(recess) for recess in recesses)])
        distance_m, nearest = self._tree.query(columns, distance_upper_bound=reach_m)
        is_near = np.isfinite(distance_m)
        if not is_near.any():
            return None
        nearest = np.where(is_near, nearest, 0)
        distance_m = np.where(is_near, distance_m, reach_m)
        level_m, half_m, height_m, cosine, sine, offset = self._means(x_m, y_m, reach_m)
        # Both are 0 where no sample is near enough to take part in the mean.
        half_m, height_m = np.maximum(half_m, 1e-3), np.maximum(height_m, 1e-3)
        lateral_m = cosine * columns[:, 1] - sine * columns[:, 0] - offset
        across_m, beyond_m = self._at_faces(columns, nearest, distance_m)
        mouth = np.maximum(1.0 - (distance_m / (MOUTH_SHARE * half_m)) ** 2, 0.0) ** 2
        side_m = np.copysign(across_m, lateral_m)
        return Frame(self._line, recesses, is_near, side_m, lateral_m, beyond_m, level_m, half_m, height_m, mouth)

    def _means(self, x_m: Float64Array, y_m: Float64Array, reach_m: float) -> Float64Array:
        """Weighted means (6, M) of what the centreline's samples carry."""
        low = np.array([x_m[0], y_m[0]]) - reach_m - 5 * self._kernel_m
        high = np.array([x_m[-1], y_m[-1]]) + reach_m + 5 * self._kernel_m
        takes_part = ((self._thin >= low) & (self._thin <= high)).all(axis=1)
        points, values = self._thin[takes_part], self._values[:, takes_part]
        over_x = np.exp(-(((x_m[:, None] - points[:, 0]) / self._kernel_m) ** 2))
        over_y = np.exp(-(((y_m[:, None] - points[:, 1]) / self._kernel_m) ** 2))
        # einsum, not matmul: its sums do not depend on the number of threads
        sums = np.stack([np.einsum("is,js->ij", over_x, over_y * row) for row in values])
        sums = sums.reshape(len(values), -1)
        return np.asarray(sums[1:] / np.maximum(sums[0], 1e-300))

    def _at_faces(
        self, columns: Float64Array, nearest: Int64Array, distance_m: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Distance from the line, continued straight beyond blind ends, and how far behind the face of one."""
        line = self._line
        across_m = distance_m
        beyond_m = np.full(len(columns), -np.inf)
        last = len(line.points) - 1
        for is_blind, end, sign in zip(line.is_blind, (0, last), (-1.0, 1.0), strict=True):
            is_close = np.abs(nearest - end) <= self._face_samples
            if not is_blind or not is_close.any():
                continue
            delta, heading = columns - line.points[end, :2], line.headings[end]
            along_m = sign * (delta @ heading)
            side_m = np.abs(heading[0] * delta[:, 1] - heading[1] * delta[:, 0])
            across_m = np.where(nearest == end, side_m, across_m)
            beyond_m = np.where(is_close, np.maximum(along_m, beyond_m), beyond_m)
        return across_m, beyond_m

    def _recess_reach_m(self, recess: Recess) -> float:
        return float(np.hypot(recess.back_m, recess.width_m / 2)) + self._margin_m

    def _touches(self, recess: Recess, x_m: Float64Array, y_m: Float64Array) -> bool:
        reach_m = self._recess_reach_m(recess)
        x, y = recess.point[:2]
        return bool(x_m[0] - reach_m < x < x_m[-1] + reach_m and y_m[0] - reach_m < y < y_m[-1] + reach_m)
