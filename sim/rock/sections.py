"""Cross-sections of drifts: signed distance to walls and roof, negative in the void.

| shape | outline |
|---|---|
| horseshoe | half circle over walls that curve inwards to the floor: the modified horseshoe |
| d | half circle over upright walls |
| arch | flat segmental arch, rising a fifth of the width, over upright walls |
| rectangle | flat roof over upright walls |
| cave | half ellipse over a flat-bottomed bowl, no corner anywhere; the rock adds its lobes |

Horseshoe and d are widest where the crown begins. Where the height leaves less than 35 % of itself below a half circle
the crown is a half ellipse over walls of that height.
"""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry import Float64Array
from scenarios.schema import Section

_LEAST_WALL = 0.35  # of the height, below the crown
_ARCH_RISE = 0.2  # of the width; at most 40 % of the height
_WALL_LEAN = 0.1  # of the width: what each wall of a tall horseshoe may come in
_CAVE_WIDEST = 0.42  # of the height
_CAVE_BOWL = 3.0  # exponent of the superellipse below: 2 would be a round trough
_TINY = 1e-9

Sizes = Float64Array | float


def profile_distance(
    shape: str, half_m: Sizes, height_m: Sizes, side_m: Float64Array, up_m: Float64Array
) -> Float64Array:
    """Return the distance to walls and roof (not to a flat floor), exact on the surface and near it.

    Args:
        shape: Shape of the section.
        half_m: Half its width; like `height_m` one number, or one for each point.
        height_m: Its height.
        side_m: Distance from the middle, positive to the left.
        up_m: Height above the floor, broadcastable against `side_m`.
    """
    across_m = np.abs(side_m)
    if shape == "rectangle":
        return np.maximum(across_m - half_m, up_m - height_m)
    if shape == "arch":
        return _arch(half_m, height_m, across_m, up_m)
    if shape == "cave":
        widest_m = _CAVE_WIDEST * np.asarray(height_m)
        above = _superellipse(across_m, up_m - widest_m, half_m, height_m - widest_m, 2.0)
        return np.where(up_m > widest_m, above, _superellipse(across_m, widest_m - up_m, half_m, widest_m, _CAVE_BOWL))
    spring_m = np.maximum(np.asarray(height_m) - half_m, _LEAST_WALL * np.asarray(height_m))
    crown = _superellipse(across_m, np.maximum(up_m - spring_m, 0.0), half_m, height_m - spring_m, 2.0)
    wall = across_m - half_m if shape == "d" else _leaning_wall(half_m, spring_m, across_m, up_m)
    return np.where(up_m > spring_m, crown, wall)


def cave_floor_m(section: Section, across_m: float) -> float:
    """Return the height of a cave's bowl at a distance from its middle."""
    share = min(2 * across_m / section.width_m, 1.0)
    return float(_CAVE_WIDEST * section.height_m * (1.0 - (1.0 - share**_CAVE_BOWL) ** (1 / _CAVE_BOWL)))


def _arch(half_m: Sizes, height_m: Sizes, across_m: Float64Array, up_m: Float64Array) -> Float64Array:
    rise_m = np.minimum(2 * _ARCH_RISE * np.asarray(half_m), 0.4 * np.asarray(height_m))
    radius_m = (np.asarray(half_m) ** 2 + rise_m**2) / (2 * rise_m)
    above_m = np.maximum(up_m - (height_m - radius_m), 0.0)
    return np.asarray(np.maximum(across_m - half_m, np.hypot(across_m, above_m) - radius_m))


def _leaning_wall(half_m: Sizes, spring_m: Float64Array, across_m: Float64Array, up_m: Float64Array) -> Float64Array:
    """Arc about a point at spring height: twice the crown's radius, as in the standard horseshoe of hydraulics.

    Taller walls than that suits get a larger radius.
    """
    radius_m = np.maximum(2 * np.asarray(half_m), spring_m**2 / (4 * _WALL_LEAN * np.asarray(half_m)))
    return np.asarray(np.hypot(across_m + (radius_m - half_m), up_m - spring_m) - radius_m)


def _superellipse(
    across_m: Float64Array, above_m: Float64Array, half_m: Sizes, rise_m: Sizes, exponent: float
) -> Float64Array:
    """First-order distance to |across / half|^p + |above / rise|^p = 1, in the quadrant of `above_m` >= 0."""
    a, b = np.broadcast_arrays(across_m / half_m, np.maximum(above_m, 0.0) / rise_m)
    level = np.maximum((a**exponent + b**exponent) ** (1 / exponent), _TINY)
    steepness = np.hypot((a / level) ** (exponent - 1) / half_m, (b / level) ** (exponent - 1) / rise_m)
    return np.asarray((level - 1.0) / np.maximum(steepness, _TINY))
