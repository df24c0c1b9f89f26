"""A smooth round tunnel, as returns with known noise: what moved between two sessions of it is known exactly."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array, make_pose, stream
from cdpipe.core.geometry.voxel import cell_keys
from cdpipe.surface.cells import CELL_M, NearReturns, SurfaceCells, make_cells, number_cells
from cdpipe.surface.places import SurfacePlaces, choose_places
from cdpipe.surface.unrolled import unroll

RADIUS_M, LENGTH_M = 2.0, 12.0
NOISE_M = 0.005
# The tunnel runs along x; the path is 0.5 m below its axis.
PATH = make_pose(translation=np.column_stack([np.arange(0.0, LENGTH_M, 0.25), np.zeros(48), np.full(48, -0.5)]))
_PER_M2 = 2400.0  # six returns in a cell of 0.05 m
_SEEN_FROM_M = 3.0

Moved = Callable[[Float64Array, Float64Array], Float64Array]
"""`moved(x_m, angle_deg)` is how far the rock came into the void; the angle is about the axis, 0 the crown."""


def nowhere(x_m: Float64Array, angle_deg: Float64Array) -> Float64Array:
    return np.zeros(len(x_m))


def left_wall(x_m: Float64Array, angle_deg: Float64Array) -> Float64Array:
    """A patch of 3 m by 60 degrees comes 20 mm into the void."""
    return np.where((np.abs(x_m - 6.0) < 1.5) & (np.abs(angle_deg - 90.0) < 30.0), 0.02, 0.0)


def tunnel(sample: int, moved: Moved = nowhere, noise_m: float = NOISE_M, stretch_noise_m: float = 0.0) -> NearReturns:
    """The returns of a session, spread at random; their scans are within 3 m along the path.

    Scans of a metre of path err together: on each block of rock, 0.6 m wide, by `stretch_noise_m` (one sigma).
    """
    rng = stream(sample, "tunnel")
    n = int(2 * np.pi * RADIUS_M * LENGTH_M * _PER_M2)
    x_m, angle_deg = rng.uniform(0.0, LENGTH_M, n), rng.uniform(-180.0, 180.0, n)
    path_m = np.clip(x_m + rng.uniform(-_SEEN_FROM_M, _SEEN_FROM_M, n), 0.0, LENGTH_M - 0.25)
    block = np.floor(x_m / 0.6) * 21 + np.floor((angle_deg + 180.0) / 360.0 * 21)
    _, errs_with = np.unique(np.floor(path_m) * 1000 + block, return_inverse=True)
    noise = rng.normal(0.0, noise_m, n) + rng.normal(0.0, stretch_noise_m, int(errs_with.max()) + 1)[errs_with]
    radius_m = RADIUS_M - moved(x_m, angle_deg) + noise
    points = np.column_stack([x_m, radius_m * np.sin(np.deg2rad(angle_deg)), radius_m * np.cos(np.deg2rad(angle_deg))])
    return single_returns(points, path_m, np.full(n, 1.0 / NOISE_M**2))


def single_returns(points: Float64Array, path_m: Float64Array, weights: Float64Array) -> NearReturns:
    """Near returns of which none are averaged."""
    cell_of = number_cells(cell_keys(points, CELL_M))
    return NearReturns(points, path_m, weights, np.ones(len(points), dtype=np.int32), cell_of, PATH)


def surveyed(returns: NearReturns) -> tuple[SurfaceCells, SurfacePlaces, Float64Array]:
    """Cells, places and their chainage, as `measure_surface` makes them by default."""
    cells = make_cells(returns)
    places = choose_places(cells, returns, 0.25, 0.3)
    return cells, places, unroll(places.points, PATH)[0]


def true_displacement(places: SurfacePlaces, moved: Moved) -> Float64Array:
    """(Q,) how far the rock moved at the places."""
    return moved(places.points[:, 0], about_axis_deg(places.points))


def about_axis_deg(points: Float64Array) -> Float64Array:
    return np.asarray(np.rad2deg(np.arctan2(points[:, 1], points[:, 2])))


def is_inner(places: SurfacePlaces, rim_m: float = 0.5) -> BoolArray:
    """Places that are not near an end of the tunnel, nor near the edge of what `left_wall` moves."""
    x_m, angle_deg = places.points[:, 0], about_axis_deg(places.points)
    beside_m = np.abs(np.abs(x_m - 6.0) - 1.5)
    around_m = np.abs(np.abs(angle_deg - 90.0) - 30.0) * np.deg2rad(RADIUS_M)
    return np.asarray((np.abs(x_m - 6.0) < 6.0 - rim_m) & (beside_m > rim_m) & (around_m > rim_m))
