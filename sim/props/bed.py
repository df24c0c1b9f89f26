"""The bed of a muck pile: a height for each node of a grid, at the angle of repose from an irregular outline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, stream
from sim.geometry.mesh import Mesh, drop_unused_vertices
from sim.geometry.noise import smooth_noise
from sim.props.shapes import BELOW_FLOOR_M, Size

# How far a banked pile goes on behind its plane: walls are rough.
BEHIND_M = 0.6
_MOST_NODES = 4000
_FINEST_M = 0.08
_SKIRT_M = 0.05
# Standard deviation of the surface between the fragments.
_FINES_M = 0.015


@dataclass(frozen=True, slots=True, eq=False)
class Bed:
    """The pile under its fragments, as heights on a grid.

    Attributes:
        x, y: Coordinates of the nodes along each axis, metres.
        z: (len(x), len(y)) heights, metres; below the floor outside the outline.
        is_cell: (len(x) - 1, len(y) - 1) cells that are part of the surface.
    """

    x: Float64Array
    y: Float64Array
    z: Float64Array
    is_cell: BoolArray

    def heights(self, xy: Float64Array) -> Float64Array:
        """Return the height at places (N, 2), those off the grid at its edge."""
        inside = np.clip(xy, (self.x[0], self.y[0]), (self.x[-1], self.y[-1]))
        return np.asarray(RegularGridInterpolator((self.x, self.y), self.z)(inside))


def build_bed(size_m: Size, repose_deg: float, is_banked: bool, seed: int, name: str) -> Bed:
    """Return the bed of a pile of at most this size; see `sim.props.heap.build_heap`."""
    length, width, height = size_m
    slope = float(np.tan(np.deg2rad(repose_deg)))
    outline, centre = _outline(length, width, is_banked, stream(seed, "props", name, "outline"))
    margin_m = BELOW_FLOOR_M / slope
    low = np.array([-length / 2, -width / 2]) - margin_m
    high = np.array([length / 2 + margin_m, width / 2 + (BEHIND_M if is_banked else margin_m)])
    numbers = np.ceil((high - low) / max(_FINEST_M, np.sqrt((high - low).prod() / _MOST_NODES))).astype(int) + 1
    x, y = (np.linspace(*limits) for limits in zip(low, high, numbers, strict=True))
    grid = np.stack(np.meshgrid(x, np.minimum(y, width / 2) if is_banked else y, indexing="ij"), axis=-1)
    line = slope * _depth(grid.reshape(-1, 2), outline, centre).reshape(grid.shape[:2])
    soft_m = 0.05 * height
    z = -soft_m * np.logaddexp(-line / soft_m, -0.97 * height / soft_m)
    step_m = float(x[1] - x[0])
    # Rounds the ridge where flanks meet; a plane stays what it is.
    z = gaussian_filter(z, np.clip(0.04 * min(length, width), 0.04, 0.2) / step_m, mode="nearest")
    key = int(stream(seed, "props", name, "bed").integers(2**31))
    wave = smooth_noise((x, y), 0.3 * min(length, width), key) * np.clip(line / (0.3 * height), 0.0, 1.0)
    fines = smooth_noise((x, y), max(0.2, 2.0 * step_m), key + 1)
    z += 0.01 * height * np.clip(wave, -2, 2) + _FINES_M * np.clip(fines, -2, 2) * np.clip(line / 0.15, 0.0, 1.0)
    z = np.maximum(z, -BELOW_FLOOR_M)
    corners = np.stack([z[:-1, :-1], z[1:, :-1], z[1:, 1:], z[:-1, 1:]])
    return Bed(x, y, z, corners.max(axis=0) > -BELOW_FLOOR_M)


def _outline(
    length: float, width: float, is_banked: bool, generator: np.random.Generator
) -> tuple[Float64Array, Float64Array]:
    """Draw a closed outline (K, 2) that touches the sides of the footprint and is star-shaped about a centre (2,).

    The outline of a banked pile is twice as wide and its centre lies on the wall: half of it is behind the wall.
    """
    angle = np.arange(1440) * (2 * np.pi / 1440)
    radius = np.ones_like(angle)
    for wave in range(2, 9):
        radius += generator.normal(0.0, 0.11 / wave) * np.cos(wave * (angle - generator.uniform(0, 2 * np.pi)))
    points = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    near = points[points[:, 1] <= 0.0] if is_banked else points
    low, high = near.min(axis=0), near.max(axis=0)
    scale = np.array([length, width]) / (high - low)
    centre = np.array([-(low[0] + high[0]) / 2 * scale[0], width / 2 if is_banked else -width / 2 - low[1] * scale[1]])
    return points * scale + centre, centre


def _depth(xy: Float64Array, outline: Float64Array, centre: Float64Array) -> Float64Array:
    """Distance of places (N, 2) to the outline, negative outside."""
    distance, _ = cKDTree(outline).query(xy)
    turn = np.arctan2(*(outline - centre).T[::-1])
    reach = np.hypot(*(outline - centre).T)
    order = np.argsort(turn)
    offset = xy - centre
    limit = np.interp(np.arctan2(offset[:, 1], offset[:, 0]), turn[order], reach[order], period=2 * np.pi)
    return np.asarray(np.where(np.hypot(*offset.T) < limit, distance, -distance))


def bed_mesh(bed: Bed) -> Mesh:
    """Return the bed as a closed surface that faces outwards, with upright sides and a flat bottom below the floor."""
    nodes = np.arange(bed.z.size).reshape(bed.z.shape)
    a, b, c, d = (part[bed.is_cell] for part in (nodes[:-1, :-1], nodes[1:, :-1], nodes[1:, 1:], nodes[:-1, 1:]))
    top = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    start, end = top.ravel(), np.roll(top, -1, axis=1).ravel()
    is_rim = ~np.isin(start * nodes.size + end, end * nodes.size + start)
    start, end = start[is_rim], end[is_rim]
    # The rim has a copy at the bottom, numbered after the nodes.
    rim = np.unique(start)
    low_start, low_end = (nodes.size + np.searchsorted(rim, each) for each in (start, end))
    bottom = np.full(len(start), nodes.size + len(rim))
    sides = [np.stack(part, axis=1) for part in ((end, start, low_start), (end, low_start, low_end))]
    floor = np.stack([low_end, low_start, bottom], axis=1)
    x, y = np.meshgrid(bed.x, bed.y, indexing="ij")
    vertices = np.column_stack([x.ravel(), y.ravel(), bed.z.ravel()])
    low = vertices[rim] * (1, 1, 0) - (0, 0, BELOW_FLOOR_M + _SKIRT_M)
    vertices = np.concatenate([vertices, low, low.mean(axis=0, keepdims=True)])
    return drop_unused_vertices(vertices, np.concatenate([top, *sides, floor]))
