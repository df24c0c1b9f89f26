"""Cloud-to-cloud distance (C2C): from each place to the nearest cell of the after session."""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry import Float64Array
from cdpipe.model.config import PipelineConfig
from cdpipe.surface.cells import NearReturns, SurfaceCells, make_cells
from cdpipe.surface.method import Measured
from cdpipe.surface.places import SurfacePlaces

# Neighbours of the nearest cell that tell how densely the after session sampled its surface.
_NEIGHBOURS = 8


def measure_c2c(
    before: SurfaceCells, after: NearReturns, places: SurfacePlaces, chainage_m: Float64Array, config: PipelineConfig
) -> Measured:
    """Measure the distance to the nearest after cell, positive if that lies on the void's side of the place.

    The distance of points scattered at random over an unchanged surface, lambda of them per square metre, is at most r
    with probability 1 - exp(-lambda pi r^2) (Clark & Evans 1954). Its 95 % quantile sqrt(ln(20) / (pi lambda)) is the
    level: C2C cannot tell a smaller displacement from the spacing of the cloud. The density is that of the eight cells
    around the nearest one. The noise of ranges is not in the level; the mean of a cell has much less of it.

    Arguments as of `Method`; `surface.reach_m` is used. Places farther than that from every after cell are not
    measured.
    """
    cells = make_cells(after)
    n = len(places.points)
    if min(n, len(cells.points)) == 0:
        unknown = np.full(n, np.nan)
        return Measured(unknown, unknown, unknown)
    distance_m, nearest = cells.tree.query(places.points)
    towards = np.einsum("ij,ij->i", cells.points[nearest] - places.points, places.normals)
    is_near = distance_m <= config.surface.reach_m
    displacement_m = np.where(is_near, np.where(towards < 0, -distance_m, distance_m), np.nan)
    around_m = np.asarray(cells.tree.query(cells.points[nearest], k=_NEIGHBOURS + 1)[0])[:, -1]
    density = _NEIGHBOURS / (np.pi * around_m**2)  # 0 where the cloud has fewer cells: the level is infinite
    with np.errstate(divide="ignore"):
        level_m = np.where(is_near, np.sqrt(np.log(20.0) / (np.pi * density)), np.nan)
    return Measured(displacement_m, displacement_m, level_m)
