"""How much room there is round a point."""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array
from sim.geometry.raycast import Caster


def room_about(caster: Caster, points: Float64Array, directions: Float64Array) -> tuple[Float64Array, BoolArray]:
    """Return how near the surfaces round some points come, and which points lie in rock or outside everything.

    Args:
        caster: Surfaces that face the void.
        points: (N, 3) world.
        directions: (M, 3) unit vectors to look along from every point.

    Returns:
        (N,) smallest distance along the directions, metres; (N,) whether most of what is seen is seen from behind, or
        nothing at all is seen. Thin fixtures and foreign meshes show their backs here and there, so most must.
    """
    rays = np.tile(directions, (len(points), 1))
    ranges_m, _, normals = caster.hits(np.repeat(points, len(directions), axis=0), rays)
    facing = -(normals * rays).sum(axis=1).reshape(len(points), -1)
    n_before, n_behind = (facing > 0).sum(axis=1), (facing < 0).sum(axis=1)
    gap_m = np.maximum(ranges_m.reshape(len(points), -1).min(axis=1), 0.0)  # on the surface Embree may say -0
    return gap_m.astype(np.float64), n_behind >= n_before
