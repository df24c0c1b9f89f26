"""The centreline of a foreign mesh set down on the floor that the mesh has below it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from cdpipe.core.geometry import Float64Array
from sim.geometry.raycast import Caster
from sim.rock.centreline import STEP_M, Centreline, DriftLine

# Heights from which rays look down, in heights of the drift: the straight line between nodes may lie in rock.
_FROM = np.arange(-2.0, 2.1, 0.25)
_MOST = 1.5  # a floor farther than this from the line, in heights of the drift, is another level's
_SOFT_M = 0.5
_SAME_M = 1e-3  # a line on the floor stays as it is


def set_on_floor(centreline: Centreline, walls: Caster) -> Centreline:
    """Return a centreline whose points lie on the floor nearest to them, smoothed; gaps are bridged.

    Whatever looks for walls, floor or roof from the line (drives, props, movers, furniture) then starts where the drift
    is, also between two nodes of a drift that is curved upwards or downwards.

    Args:
        centreline: The straight or rounded lines between nodes.
        walls: The bare rock.
    """
    return replace(centreline, drifts=tuple(_set_down(line, walls) for line in centreline.drifts))


def _set_down(line: DriftLine, walls: Caster) -> DriftLine:
    z = line.points[:, 2]
    floor_m = _nearest_floor(line, walls)
    known = np.flatnonzero(np.isfinite(floor_m))
    if len(known) == 0:
        return line
    rise_m = np.interp(np.arange(len(z)), known, floor_m[known] - z[known])
    rise_m = gaussian_filter1d(rise_m, _SOFT_M / STEP_M, mode="nearest")
    points = line.points.copy()
    points[:, 2] = np.where(np.abs(rise_m) < _SAME_M, z, z + rise_m)
    return replace(line, points=points)


def _nearest_floor(line: DriftLine, walls: Caster) -> Float64Array:
    """Return the height (N,) of the floor nearest to each point; NaN where there is none near.

    A ray that starts in rock comes to the back of a roof, or to nothing, so it finds no floor.
    """
    height_m = line.section.height_m
    nearest = np.full(len(line.points), np.nan)
    for share in _FROM:
        origins = line.points + np.array([0.0, 0.0, share * height_m])
        ranges_m, _, normals = walls.hits(origins, (0.0, 0.0, -1.0))
        floor_m = np.where(np.isfinite(ranges_m) & (normals[:, 2] > 0.1), origins[:, 2] - ranges_m, np.nan)
        off_m, best_m = (np.abs(each - line.points[:, 2]) for each in (floor_m, nearest))
        is_nearer = (off_m < _MOST * height_m) & ~(off_m >= best_m)
        nearest = np.where(is_nearer, floor_m, nearest)
    return nearest
