"""Where the example box may stand: on floor without holes, the most level places of a route first."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from cdpipe.core.geometry import Float64Array
from sim.geometry.raycast import Caster
from sim.rock.centreline import Centreline, left_of
from sim.trace.rays import floor_below

_FRACTIONS = (0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8)
_LATERALS = (0.7, -0.7, 0.5, -0.5)
_FROM_M = 1.2  # height above the line from which the floor is looked for
_RAYS = 15  # along each side of the footprint
_MARGIN_M = 0.1  # about it


@dataclass(frozen=True, slots=True, eq=False)
class BoxSpot:
    """A place for a box: between two nodes, how far along, how far to the side, and how large the box is.

    Attributes:
        edge, fraction, lateral: As `scenarios.schema.Place` has them.
        side_m: Width and height of the box; it is 1.2 times as long.
        rough_m: Standard deviation of the floor about a plane below it; infinite over a hole.
    """

    edge: tuple[str, str]
    fraction: float
    lateral: float
    side_m: float
    rough_m: float


def find_spots(centreline: Centreline, route: tuple[str, ...], caster: Caster, side_m: float) -> list[BoxSpot]:
    """Return places along a route, the ones with the most level floor first.

    Args:
        centreline: The drifts, on the floor.
        route: Nodes; its first and last edge only count if there are no others.
        caster: The walls.
        side_m: Width of the box.
    """
    edges = list(pairwise(route))
    inner = edges[1:-1] or edges
    longest = sorted(inner, key=lambda edge: -len(centreline.edge(*edge)[0]))[:6]
    spots = [
        BoxSpot(edge, fraction, lateral, side_m, _roughness_m(centreline, caster, edge, fraction, lateral, side_m))
        for edge in longest
        for fraction in _FRACTIONS
        for lateral in _LATERALS
    ]
    return sorted(spots, key=lambda spot: spot.rough_m)


def _roughness_m(
    centreline: Centreline, caster: Caster, edge: tuple[str, str], fraction: float, lateral: float, side_m: float
) -> float:
    point, heading, section = centreline.at(*edge, fraction)
    left = left_of(heading[None])[0]
    # about where the simulator puts it: a share of the width that the box leaves
    middle = point[:2] + lateral * (0.45 * section.width_m - side_m / 2) * left
    reach = np.linspace(-0.5, 0.5, _RAYS)
    size_m = np.array([1.2 * side_m, side_m]) + 2 * _MARGIN_M
    along, across = (each.ravel() for each in np.meshgrid(reach * size_m[0], reach * size_m[1]))
    xy = middle + along[:, None] * heading + across[:, None] * left
    floor_m = floor_below(caster, np.column_stack([xy, np.full(len(xy), point[2] + _FROM_M)]))
    if not np.isfinite(floor_m).all() or np.abs(floor_m - point[2]).max() > _FROM_M:
        return float("inf")
    return _off_plane_m(along, across, floor_m)


def _off_plane_m(along: Float64Array, across: Float64Array, floor_m: Float64Array) -> float:
    design = np.column_stack([along, across, np.ones(len(along))])
    fitted, *_ = np.linalg.lstsq(design, floor_m, rcond=None)
    return float(np.std(floor_m - design @ fitted))
