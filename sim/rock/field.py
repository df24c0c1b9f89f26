"""The rock as a signed field, negative in the void: drifts and niches united, then roughness added.

The void of a tunnel is the smallest of its drifts' section functions, each in the frame of its own centreline, and of
its niches. So no face lies inside the void. Edges are rounded: where drifts meet, the corners of a pillar over half a
metre or so; along floors and faces, over two cells, which is what marching cubes draw without teeth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cdpipe.core.geometry import Float32Array, Float64Array, Int64Array, stream
from scenarios.schema import Section, Tunnel
from sim.geometry.noise import smooth_noise
from sim.rock.centreline import Centreline, Recess
from sim.rock.floor import floor_heights, level_share, smooth_step
from sim.rock.frame import DriftFrame, Frame
from sim.rock.sections import cave_floor_m, profile_distance

_LIMIT_SIGMA = 4.0
# Roughness may take at most this share of the smallest half width or half height: no drift closes.
_CLOSING_SHARE = 0.7
_PILLAR_ROUNDING = 0.12  # of a drift's width, and of a niche's
_EDGE_ROUNDING_CELLS = 2.0
# Lobes of a cave: standard deviation and correlation length as shares of the smaller and of the mean of its two sizes.
_LOBE_AMPLITUDE = 0.05
_LOBE_LENGTH = 0.4
_LOBE_LIMIT_SIGMA = 2.5
# The rock of a cave turns from floor to wall between these shares of its height.
_CAVE_FLOOR_UP = (0.05, 0.35)
_CAVE_SILL = 0.6  # of the half width, where the level floor of a niche begins
_CAVE_FLOOR_FADE = 0.5  # of the height, above which crossfall and ruts no longer bend a cave's walls


@dataclass(frozen=True, slots=True, eq=False)
class _Grid:
    """A block of the grid: its axes, its columns (M, 2) and its roughness, positive where rock stands out.

    `wall` is (M, K), `floor` (M,).
    """

    x_m: Float64Array
    y_m: Float64Array
    z_m: Float64Array
    columns: Float64Array
    wall: Float64Array
    floor: Float64Array


class Field:
    """The field of a tunnel, evaluated block by block.

    Attributes:
        margin_m: How far outside its smooth walls a drift still matters.
        frames: The drifts, in the order of the centreline.
    """

    def __init__(self, tunnel: Tunnel, centreline: Centreline, seed: int) -> None:
        lines = centreline.drifts
        sigma_m = float(np.sqrt(sum(octave.amplitude_m**2 for octave in tunnel.roughness)))
        self._tunnel = tunnel
        self._cell_m = tunnel.resolution_m
        self._limit_m = _LIMIT_SIGMA * sigma_m
        smallest_m = min(min(float(line.width_m.min()), float(line.height_m.min())) for line in lines)
        self._closing_m = _CLOSING_SHARE * smallest_m / 2
        lobes_m = max([0.0, *(_lobes(line.section)[0] for line in lines if line.section.shape == "cave")])
        rounding_m = _PILLAR_ROUNDING * max(line.section.width_m for line in lines)
        self.margin_m = self._limit_m + _LOBE_LIMIT_SIGMA * lobes_m + 1.25 * rounding_m + 3 * self._cell_m
        keys = stream(seed, "tunnel", "roughness").integers(2**63, size=(len(tunnel.roughness), 2))
        self._keys: list[tuple[int, int]] = [(int(wall), int(floor)) for wall, floor in keys]
        self._lobe_key = int(stream(seed, "tunnel", "lobes").integers(2**63))
        self.frames = [
            DriftFrame(line, [each for each in centreline.recesses if each.drift == index], self.margin_m)
            for index, line in enumerate(lines)
        ]

    def evaluate(self, x_m: Float64Array, y_m: Float64Array) -> tuple[Float32Array, Int64Array]:
        """Return the field (len(x), len(y), K) on the grid and the K heights it was taken at, in cells."""
        near = [frame for drift in self.frames if (frame := drift.place(x_m, y_m)) is not None]
        if not near:
            return np.empty((0, 0, 0), np.float32), np.empty(0, np.int64)
        shares = [[level_share(mine, other) for other in near] for mine in near]
        floors = floor_heights(near, shares, self._tunnel.floor)
        iz = self._levels(near, floors)
        grid = self._grid(x_m, y_m, iz.astype(np.float64) * self._cell_m)
        edge_m = _EDGE_ROUNDING_CELLS * self._cell_m
        walls = [self._smooth_walls(frame, floor_m, grid, edge_m) for frame, floor_m in zip(near, floors, strict=True)]
        field = np.full(walls[0].shape, self.margin_m)
        for index, (frame, floor_m) in enumerate(zip(near, floors, strict=True)):
            wall_m = self._opened(index, near, walls, shares[index])
            if frame.line.section.shape == "cave":
                rock_m = wall_m + self._cave_roughness(frame, grid)
            else:
                rock_m = smooth_max(wall_m + grid.wall, (floor_m + grid.floor)[:, None] - grid.z_m, edge_m)
            rock_m[~frame.is_near] = self.margin_m
            np.minimum(field, rock_m, out=field)
        # A zero on a grid node would put one vertex on several edges.
        smallest_m = 1e-3 * self._cell_m
        field = np.clip(field, -2 * self._cell_m, 2 * self._cell_m)
        field[np.abs(field) < smallest_m] = smallest_m
        return field.reshape(len(x_m), len(y_m), len(iz)).astype(np.float32), iz

    def _levels(self, near: Sequence[Frame], floors: Sequence[Float64Array]) -> Int64Array:
        low_m = min(floor_m[frame.is_near].min() for frame, floor_m in zip(near, floors, strict=True))
        high_m = max((frame.level_m + frame.height_m)[frame.is_near].max() for frame in near)
        first, last = (low_m - self.margin_m) / self._cell_m, (high_m + self.margin_m) / self._cell_m
        return np.arange(np.floor(first), np.ceil(last) + 1).astype(np.int64)

    def _grid(self, x_m: Float64Array, y_m: Float64Array, z_m: Float64Array) -> _Grid:
        wall = np.zeros((len(x_m), len(y_m), len(z_m)))
        floor = np.zeros((len(x_m), len(y_m)))
        for octave, (wall_key, floor_key) in zip(self._tunnel.roughness, self._keys, strict=True):
            if octave.amplitude_m > 0:
                wall += octave.amplitude_m * smooth_noise((x_m, y_m, z_m), octave.length_m, wall_key)
                floor += octave.amplitude_m * smooth_noise((x_m, y_m), octave.length_m, floor_key)
        high_m = min(self._limit_m, self._closing_m)
        wall, floor = (np.clip(each, -self._limit_m, high_m) for each in (wall, floor))
        columns = np.stack(np.meshgrid(x_m, y_m, indexing="ij"), axis=-1).reshape(-1, 2)
        share = self._tunnel.floor.roughness
        return _Grid(x_m, y_m, z_m, columns, wall.reshape(-1, len(z_m)), share * floor.ravel())

    def _smooth_walls(self, frame: Frame, floor_m: Float64Array, grid: _Grid, edge_m: float) -> Float64Array:
        """Distance (M, K) to walls, roof, faces and niches of one drift; in a cave the floor too."""
        shape, half_m, height_m = frame.line.section.shape, frame.half_m[:, None], frame.height_m[:, None]
        up_m = grid.z_m - frame.level_m[:, None]
        section_up_m = up_m
        if shape == "cave":
            bend = 1.0 - smooth_step(up_m / height_m / _CAVE_FLOOR_FADE)
            section_up_m = up_m - (floor_m - frame.level_m)[:, None] * bend
        wall_m = profile_distance(shape, half_m, height_m, frame.side_m[:, None], section_up_m)
        if np.isfinite(frame.beyond_m).any():
            wall_m = smooth_max(wall_m, frame.beyond_m[:, None], edge_m)
        for recess in frame.recesses:
            recess_m = _recess_distance(recess, frame, grid.columns, section_up_m, edge_m)
            wall_m = -smooth_max(-wall_m, -recess_m, _PILLAR_ROUNDING * recess.width_m)
        wall_m[~frame.is_near] = self.margin_m
        return wall_m

    def _opened(
        self, index: int, near: Sequence[Frame], walls: Sequence[Float64Array], shares: Sequence[Float64Array]
    ) -> Float64Array:
        """Walls of one drift, set back along the edges to others on its level, so that their union is rounded."""
        back_m = np.zeros_like(walls[index])
        for number, other in enumerate(near):
            if number != index:
                width_m = min(near[index].line.section.width_m, other.line.section.width_m)
                rounded_m = _rounding(walls[index], walls[number], _PILLAR_ROUNDING * width_m)
                back_m = np.maximum(back_m, shares[number][:, None] * rounded_m)
        return walls[index] - back_m

    def _cave_roughness(self, frame: Frame, grid: _Grid) -> Float64Array:
        """Roughness (M, K) of a cave: lobes and overbreak above, the floor's below."""
        amplitude_m, length_m = _lobes(frame.line.section)
        lobes = smooth_noise((grid.x_m, grid.y_m, grid.z_m), length_m, self._lobe_key).reshape(grid.wall.shape)
        lobed_m = grid.wall + amplitude_m * np.clip(lobes, -_LOBE_LIMIT_SIGMA, _LOBE_LIMIT_SIGMA)
        low, high = _CAVE_FLOOR_UP
        share = (grid.z_m - frame.level_m[:, None]) / frame.height_m[:, None]
        floor_m = grid.floor[:, None]
        return floor_m + smooth_step((share - low) / (high - low)) * (np.minimum(lobed_m, self._closing_m) - floor_m)


def smooth_max(a: Float64Array, b: Float64Array, rounding_m: float) -> Float64Array:
    """Return the larger of two distances, the edge between them rounded where they differ by less than `rounding_m`.

    The quadratic smooth maximum (Quilez, smooth minimum), at most a quarter of `rounding_m` above the sharp one.
    """
    return np.maximum(a, b) + _rounding(a, b, rounding_m)


def _rounding(a: Float64Array, b: Float64Array, rounding_m: float) -> Float64Array:
    return np.asarray(np.maximum(rounding_m - np.abs(a - b), 0.0) ** 2 / (4 * rounding_m))


def _recess_distance(
    recess: Recess, frame: Frame, columns: Float64Array, up_m: Float64Array, edge_m: float
) -> Float64Array:
    """Distance (M, K) to a niche's walls; its void starts inside the drift, in a cave where the floor has risen."""
    delta = columns - recess.point[:2]
    along_m, out_m = delta @ recess.heading, delta @ recess.outward
    section = frame.line.section
    is_cave = section.shape == "cave"
    start_m = _CAVE_SILL * section.width_m / 2 if is_cave else 0.0
    wall_m = profile_distance("arch", recess.width_m / 2, recess.height_m, along_m[:, None], up_m)
    wall_m = smooth_max(wall_m, np.maximum(out_m - recess.back_m, start_m - out_m)[:, None], edge_m)
    return smooth_max(wall_m, cave_floor_m(section, start_m) - up_m, edge_m) if is_cave else wall_m


def _lobes(section: Section) -> tuple[float, float]:
    """Return standard deviation and correlation length of a cave's lobes, metres."""
    sizes = section.width_m, section.height_m
    return _LOBE_AMPLITUDE * min(sizes), _LOBE_LENGTH * sum(sizes) / 2
