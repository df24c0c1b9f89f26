"""What rays tell at points of a line: the floor below, the roof above, the walls to the sides."""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry import Float64Array
from sim.geometry.raycast import Caster

UP = np.array([0.0, 0.0, 1.0])
_CHORDS = 16  # directions over half a turn


def narrowest_chord_m(caster: Caster, point: Float64Array, most_m: float) -> float:
    """Return the shortest level line through a point (3,) from wall to wall, at most `most_m`."""
    angle = np.arange(2 * _CHORDS) * (np.pi / _CHORDS)
    ways = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    ranges_m = np.minimum(caster.cast(point, ways)[0], most_m)
    return float(min((ranges_m[:_CHORDS] + ranges_m[_CHORDS:]).min(), most_m))


def floor_below(caster: Caster, points: Float64Array) -> Float64Array:
    """Return the height (N,) of the floor below points (N, 3) of the void; NaN where none faces up."""
    ranges_m, _, normals = caster.hits(points, -UP)
    return np.where(np.isfinite(ranges_m) & (normals[:, 2] > 0.1), points[:, 2] - ranges_m, np.nan)


def roof_above(caster: Caster, points: Float64Array) -> Float64Array:
    """Return the height (N,) of the roof above points (N, 3) of the void; NaN where none faces down."""
    ranges_m, _, normals = caster.hits(points, UP)
    return np.where(np.isfinite(ranges_m) & (normals[:, 2] < -0.1), points[:, 2] + ranges_m, np.nan)


def to_sides(caster: Caster, points: Float64Array, left: Float64Array, most_m: float) -> tuple[Float64Array, ...]:
    """Return the room (N,) to the right and to the left of points (N, 3), at most `most_m`; `left` is (N, 2)."""
    level = np.insert(left, 2, 0.0, axis=1)
    right_m, left_m = (np.minimum(caster.cast(points, side * level)[0], most_m) for side in (-1.0, 1.0))
    return right_m.astype(np.float64), left_m.astype(np.float64)


def fill_gaps(values: Float64Array) -> Float64Array:
    """Return values (N,) with NaN bridged by straight lines; all NaN stay."""
    known = np.flatnonzero(np.isfinite(values))
    return np.interp(np.arange(len(values)), known, values[known]) if len(known) else values
