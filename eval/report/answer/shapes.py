"""Colours and outlines of the maps, paths and regions that 3-D views and pages show."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array
from sim.view.returns import Rgb

BEFORE_RGB: Rgb = (120, 165, 205)
AFTER_RGB: Rgb = (222, 180, 110)
REGION_RGB: Rgb = (90, 90, 90)
WRONG_RGB: Rgb = (200, 16, 46)
# what is higher than this over the sensor's path is roof, and hides the rest from above
_ROOF_M = 1.2


def roof_mask(points: Float64Array, path: Float64Array) -> BoolArray:
    """Mark the (N, 3) points that are more than 1.2 m higher than the nearest place of a (P, 3) path."""
    if len(points) == 0:
        return np.zeros(0, dtype=np.bool_)
    _, nearest = cKDTree(path[:, :2]).query(points[:, :2])
    return np.asarray(points[:, 2] > path[nearest, 2] + _ROOF_M, dtype=np.bool_)


def box_path(low: Float64Array, high: Float64Array) -> Float64Array:
    """Return (16, 3) corners in an order that draws all twelve edges of a box in one stroke."""
    corners = np.array([[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], dtype=np.float64)
    order = [0, 1, 2, 3, 0, 4, 5, 1, 5, 6, 2, 6, 7, 3, 7, 4]
    return low + corners[order] * (high - low)


def sphere_path(centre: Float64Array, radius_m: float) -> Float64Array:
    """Return (N, 3) points of three circles around a centre, drawn in one stroke."""
    turn = np.linspace(0.0, 2.0 * np.pi, 49)
    quarter, zero = turn[:13], np.zeros_like
    level = np.column_stack([np.cos(turn), np.sin(turn), zero(turn)])
    upright = np.column_stack([np.cos(turn), zero(turn), np.sin(turn)])
    across = np.column_stack([np.cos(quarter), np.sin(quarter), zero(quarter)])
    other = np.column_stack([zero(turn), np.cos(turn), np.sin(turn)])
    return centre + radius_m * np.concatenate([level, upright, across, other])
