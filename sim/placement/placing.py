"""A prop at its pose, its footprint on the floor, and the rock around it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from cdpipe.core.geometry import Float64Array, transform
from scenarios.schema import Prop
from sim.geometry.raycast import Caster
from sim.props.shapes import Shape, footprint_corners, shape_mesh
from sim.rock.centreline import Centreline

Posture = Literal["upright", "tipped", "leaning"]

# Kept between prop and wall, beside one cell of the mesh: marching cubes bevels the foot of a wall over a cell.
WALL_GAP_M = 0.05
# Rays down to the floor start this far above the centreline, below any roof and above any bump.
PROBE_UP_M = 1.2
_REMEMBERED = 128  # shapes and props whose corners are asked for again and again; their arrays cannot be written


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """A prop at one of its places.

    Attributes:
        prop: The prop.
        shape: What it is made of here; a reshaped pile has another shape in each session.
        sessions: The sessions in which it stands here.
        world_T_object: (4, 4) pose; before settling with its lowest point about at floor level.
        posture: How it was put there.
        wall: (2,) unit direction of the wall it leans against or is banked up against, else None.
        is_carried: Whether a floor that heaved moved it here; that is no change of the prop.
    """

    prop: Prop
    shape: Shape
    sessions: frozenset[str]
    world_T_object: Float64Array
    posture: Posture = "upright"
    wall: Float64Array | None = None
    is_carried: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Barred:
    """A place where rock changes, and no prop stands.

    Attributes:
        name: The surface change.
        corners: (4, 2) rectangle, world frame, metres.
        may_be_carried: Whether an upright prop that settled there may stand on it and move with it.
    """

    name: str
    corners: Float64Array
    may_be_carried: bool


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """The surroundings in which props are placed.

    Attributes:
        walls: The bare rock, whose floor carries them.
        fixed: Rock and furniture, from which they keep clear.
        gap_m: Distance between a prop and the side of the drift.
        barred: Where rock changes and props stay away.
        after: Centreline and `fixed` of the after session, where they differ.
    """

    walls: Caster
    fixed: Caster
    gap_m: float
    barred: tuple[Barred, ...] = ()
    after: tuple[Centreline, Caster] | None = None


def floor_heights(walls: Caster, points: Float64Array) -> Float64Array:
    """Return the floor's z (N,) under points (N, 3) that lie in the void; NaN where no floor faces up below them."""
    ranges_m, _, normals = walls.hits(points, (0.0, 0.0, -1.0))
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


@lru_cache(maxsize=_REMEMBERED)
def standing_points(standing: Standing) -> Float64Array:
    """Return the corners (N, 3) of a standing prop's surface, world frame; without those set into the floor."""
    local = corners_object(standing.shape)
    if not standing.shape.is_settled:
        local = local[local[:, 2] >= -0.05]
    points = transform(standing.world_T_object, local)
    points.setflags(write=False)
    return points


def standing_box(standing: Standing) -> tuple[Float64Array, Float64Array]:
    """Return the low and the high corner (3,) of a standing prop's bounding box above the floor, world frame."""
    points = standing_points(standing)
    return points.min(axis=0), points.max(axis=0)


def standing_middle(standing: Standing) -> Float64Array:
    """Return the middle (3,) of that box."""
    low, high = standing_box(standing)
    return np.asarray((low + high) / 2)


@lru_cache(maxsize=_REMEMBERED)
def standing_corners(standing: Standing) -> Float64Array:
    """Return the corners (4, 2) of a standing prop's bounding rectangle on the floor, world frame.

    The rectangle keeps the object's own direction; of a prop that lies or leans it is that of what is seen from above.
    """
    pose = standing.world_T_object
    if standing.posture != "upright":
        return bounding_rectangle(standing)
    corners = np.asarray(footprint_corners(standing.shape.size_m) @ pose[:2, :2].T + pose[:2, 3])
    corners.setflags(write=False)
    return corners


@lru_cache(maxsize=_REMEMBERED)
def bounding_rectangle(standing: Standing) -> Float64Array:
    """Return the corners (4, 2) of the rectangle about all of a prop as it tilts on its floor, world frame."""
    pose = standing.world_T_object
    # Of the object's axes the one that lies flattest gives the direction of the rectangle.
    axis = pose[:2, int(np.argmin(np.abs(pose[2, :3])))]
    along = axis / np.linalg.norm(axis)
    frame = np.stack([along, [-along[1], along[0]]])
    points = standing_points(standing)[:, :2] @ frame.T
    low, high = points.min(axis=0), points.max(axis=0)
    rectangle = np.array([[high[0], high[1]], [low[0], high[1]], [low[0], low[1]], [high[0], low[1]]])
    corners = np.asarray(rectangle @ frame)
    corners.setflags(write=False)
    return corners


def standing_height_m(standing: Standing) -> float:
    """Return how high a standing prop reaches above its foot."""
    if standing.posture == "upright":
        return standing.shape.size_m[2]
    return float(np.ptp(standing_points(standing)[:, 2]))


def rectangles_overlap(a: Float64Array, b: Float64Array) -> bool:
    """Tell whether the interiors of two rectangles, given by their corners (4, 2), meet: separating axis test."""
    for corners in (a, b):
        for edge in (corners[1] - corners[0], corners[2] - corners[1]):
            first, second = a @ edge, b @ edge
            if first.max() <= second.min() or second.max() <= first.min():
                return False
    return True


def grow_rectangle(corners: Float64Array, by_m: float) -> Float64Array:
    """Return the corners (4, 2) of a rectangle grown on every side."""
    centre = corners.mean(axis=0)
    edges = np.stack([corners[0] - corners[1], corners[1] - corners[2]])
    edges /= np.maximum(np.linalg.norm(edges, axis=1, keepdims=True), 1e-9)
    sign = np.sign(np.round((corners - centre) @ edges.T, 9))
    return np.asarray(corners + by_m * sign @ edges)


@lru_cache(maxsize=_REMEMBERED)
def corners_object(shape: Shape) -> Float64Array:
    """Return the corners (N, 3) of all of a prop's primitives, object frame."""
    return shape_mesh(shape).vertices
