"""From a prop's place in a scenario to a pose on the floor: across the free width, clear of walls and other props."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from cdpipe.errors import ScenarioError
from cdpipe.geometry import Float64Array, yaw_pose
from scenarios.schema import Place, Prop, Scenario, Tunnel
from sim.centreline import Centreline
from sim.props import footprint
from sim.raycast import Caster

# Kept between prop and wall, beside one cell of the mesh: marching cubes bevels the foot of a wall over a cell.
_WALL_GAP_M = 0.05
# Rays down to the floor start this far above the centreline, below any roof and above any bump.
PROBE_UP_M = 1.2


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """A prop at one of its places.

    Attributes:
        prop: The prop.
        sessions: The sessions in which it stands here.
        world_T_object: (4, 4) pose; before settling upright with its origin at floor level.
    """

    prop: Prop
    sessions: frozenset[str]
    world_T_object: Float64Array


def place_props(scenario: Scenario, centreline: Centreline, walls: Caster) -> list[Standing]:
    """Return every prop at each of its places, upright; a moved prop appears twice.

    Raises:
        ScenarioError: A prop does not fit between the walls, or two stand in one another.
    """
    both = frozenset(("before", "after"))
    found = []
    for prop in scenario.props:
        first = {"added": frozenset(("after",)), "none": both}.get(prop.change, frozenset(("before",)))
        found.append(Standing(prop, first, _pose(prop, prop.place, scenario.tunnel, centreline, walls)))
        if prop.to is not None:
            found.append(
                Standing(prop, frozenset(("after",)), _pose(prop, prop.to, scenario.tunnel, centreline, walls))
            )
    for a, b in combinations(found, 2):
        shared = a.sessions & b.sessions
        if shared and _overlap(_corners(a), _corners(b)):
            raise ScenarioError(
                f"props {a.prop.name!r} and {b.prop.name!r} stand in one another in the {max(shared)} session: "
                "give one another fraction or lateral"
            )
    return found


def floor_heights(walls: Caster, points: Float64Array) -> Float64Array:
    """Return the floor's z (N,) under points (N, 3) that lie in the void; NaN where no floor faces up below them."""
    down = np.tile([0.0, 0.0, -1.0], (len(points), 1))
    ranges_m, _, normals = walls.hits(points, down)
    return np.where(np.isfinite(ranges_m) & (normals[:, 2] > 0.1), points[:, 2] - ranges_m, np.nan)


def free_width(
    walls: Caster, points: Float64Array, left: Float64Array, heights_m: Float64Array, limit_m: float
) -> tuple[Float64Array, Float64Array]:
    """Return how far the void reaches to the right and to the left (N,) of points on the floor line.

    Args:
        walls: The tunnel.
        points: (N, 3) points of a centreline.
        left: (N, 2) unit vectors to the left.
        heights_m: Heights above the points at which rays are cast; the nearest wall counts.
        limit_m: What counts as far enough.
    """
    origins = points[:, None] + heights_m[None, :, None] * np.array([0.0, 0.0, 1.0])
    level = np.concatenate([left, np.zeros((len(left), 1))], axis=1)
    reach = []
    for side in (-1.0, 1.0):
        directions = np.broadcast_to(side * level[:, None], origins.shape).reshape(-1, 3)
        ranges_m, _, _ = walls.cast(origins.reshape(-1, 3), directions)
        reach.append(np.minimum(ranges_m.reshape(origins.shape[:2]).min(axis=1), limit_m).astype(np.float64))
    return reach[0], reach[1]


def standing_corners(standing: Standing) -> Float64Array:
    """Return the corners (4, 2) of a standing prop's bounding rectangle on the floor, world frame."""
    return _corners(standing)


def _pose(prop: Prop, place: Place, tunnel: Tunnel, centreline: Centreline, walls: Caster) -> Float64Array:
    point, heading, section = centreline.at(*place.between, place.fraction)
    left = np.array([-heading[1], heading[0]])
    yaw = float(np.arctan2(heading[1], heading[0]) + np.deg2rad(place.yaw_deg))
    turn = yaw_pose(np.deg2rad(place.yaw_deg))[:2, :2]
    extent = np.abs(footprint(prop.size_m) @ turn.T).max(axis=0)  # half size along and across the drift
    stations = point[:2] + np.linspace(-extent[0], extent[0], 7)[:, None] * heading
    origins = np.column_stack([stations, np.full(len(stations), point[2])])
    top = min(prop.size_m[2], 0.5 * section.height_m)
    heights = np.linspace(0.25, max(0.3, top), 4)
    sides = free_width(walls, origins, np.tile(left, (len(origins), 1)), heights, section.width_m / 2)
    right_m, left_m = (float(side.min()) - _WALL_GAP_M - tunnel.resolution_m for side in sides)
    if right_m + left_m < 2 * extent[1]:
        raise ScenarioError(
            f"prop {prop.name!r} is {2 * extent[1]:.2f} m across, but between {place.between[0]!r} and "
            f"{place.between[1]!r} at {place.fraction:.2f} only {right_m + left_m:.2f} m are free: "
            "make it smaller, turn it, or place it elsewhere"
        )
    low, high = extent[1] - right_m, left_m - extent[1]
    across = (low + high) / 2 + place.lateral * (high - low) / 2
    position = point[:2] + across * left
    floor_m = _floor_under(prop, position, yaw, float(point[2]), walls)
    return yaw_pose(yaw, (position[0], position[1], floor_m))


def _floor_under(prop: Prop, position: Float64Array, yaw: float, level_m: float, walls: Caster) -> float:
    share = np.linspace(-0.5, 0.5, 7)
    grid = np.stack(np.meshgrid(share * prop.size_m[0], share * prop.size_m[1]), axis=-1).reshape(-1, 2)
    xy = grid @ yaw_pose(yaw)[:2, :2].T + position
    heights = floor_heights(walls, np.column_stack([xy, np.full(len(xy), level_m + PROBE_UP_M)]))
    if np.isnan(heights).all():
        raise ScenarioError(f"prop {prop.name!r}: there is no floor where it should stand")
    return float(np.nanmedian(heights))


def _corners(standing: Standing) -> Float64Array:
    pose = standing.world_T_object
    return np.asarray(footprint(standing.prop.size_m) @ pose[:2, :2].T + pose[:2, 3])


def _overlap(a: Float64Array, b: Float64Array) -> bool:
    """Separating axes of two rectangles given by their corners."""
    for corners in (a, b):
        for edge in (corners[1] - corners[0], corners[2] - corners[1]):
            first, second = a @ edge, b @ edge
            if first.max() <= second.min() or second.max() <= first.min():
                return False
    return True
