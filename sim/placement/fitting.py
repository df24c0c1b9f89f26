"""The pose of a prop on the floor from its place in a scenario: across the free width, clear of rock and furniture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float32Array, Float64Array, make_pose, stream, yaw_pose
from scenarios.schema import Place, Prop
from sim.geometry.mesh import split_triangles
from sim.placement.placing import PROBE_UP_M, WALL_GAP_M, Surroundings, corners_object, floor_heights, free_width
from sim.props.bed import BEHIND_M
from sim.props.shapes import Shape, footprint_corners, shape_mesh, solid_mesh

# A prop may lean on a wall that is this even; at a drift's mouth it is not.
_UNEVEN_WALL_M = 0.8
# Surfaces with a steeper normal are floor; at least half of the rays must reach the wall over it.
_FLOOR_UP = 0.7
_SEEN_SHARE = 0.5
_LEAN_GAP_M = 0.01
_BULGE_M = 0.15  # of rock that a leaning prop may meet between its corners
_LEAN_DEG = (10.0, 25.0)
# Beyond the lean at which the centre of mass is above the foot; otherwise a prop falls back upright.
_BEYOND_BALANCE_DEG = 6.0
_STEEP_DEG, _STEEPEST_LEAN_DEG = 28.0, 40.0
_FOOT_M = 0.03
_ASKEW_DEG = 12.0  # of a tipped prop against lying square on a side


@dataclass(frozen=True, slots=True, eq=False)
class Spot:
    """A station in the tunnel.

    Attributes:
        point: (3,) on the centreline at floor level, or a given point above the floor.
        heading: (2,) direction of the drift; of the x axis for a given point.
        width_m, height_m: Nominal size of the drift.
        where: Its name in messages.
        is_line: Whether `lateral` places the prop across the drift; else it stands at the point itself.
        over_humps: Whether an uneven wall is checked again without the rays that humps of the floor block.
    """

    point: Float64Array
    heading: Float64Array
    width_m: float
    height_m: float
    where: str
    is_line: bool = True
    over_humps: bool = False


def place_prop(
    prop: Prop,
    shape: Shape,
    place: Place,
    spot: Spot,
    around: Surroundings,
    seed: int,
    moved: Float64Array | None = None,
) -> tuple[Float64Array, Float64Array | None]:
    """Return the pose (4, 4) of a prop at a spot before it settles, and the direction (2,) of its wall, if it has one.

    Args:
        prop: The prop.
        shape: What it is made of there.
        place: Its sideways place, yaw and posture.
        spot: Where along the tunnel.
        around: The tunnel.
        seed: Draws on which side a tipped prop lies and how far one leans.
        moved: (3,) for a prop moved a little: how far its middle moves along x and y, and its turn in radians.

    Raises:
        ScenarioError: It does not fit there.
    """
    yaw = float(np.arctan2(spot.heading[1], spot.heading[0]) + np.deg2rad(place.yaw_deg))
    if place.posture == "leaning":
        pose, wall = _at_wall(prop, shape, place, spot, around, seed, yaw, None)
        if moved is None:
            return pose, wall
        return _at_wall(prop, shape, place, spot, around, seed, yaw + float(moved[2]), pose[:2, 3] + moved[:2])
    yaw += 0.0 if moved is None else float(moved[2])
    rotation = draw_rotation(prop.name, shape, place.posture, seed)
    low, high = box = _bounds(shape, rotation, place.posture)
    position = _across(prop, (high - low) / 2, place, spot, around) if spot.is_line else spot.point[:2]
    if moved is not None:
        position = position + moved[:2]
    if moved is not None or not spot.is_line:
        _require_clear(prop, high - low, yaw, position, spot, around)
    floor_m = _floor_under(prop, box, position, yaw, spot, around)
    centre = np.append((low[:2] + high[:2]) / 2, low[2])
    pose = yaw_pose(yaw)
    origin = np.append(position, floor_m) - pose[:3, :3] @ centre
    return make_pose(pose[:3, :3] @ rotation, origin), None


def _bounds(shape: Shape, rotation: Float64Array, posture: str) -> Float64Array:
    """Return the low and high corner (2, 3) of a prop in its posture; upright without the part below the floor."""
    if posture == "upright":
        length, width, height = shape.size_m
        return np.array([[-length / 2, -width / 2, 0.0], [length / 2, width / 2, height]])
    return _span(corners_object(shape) @ rotation.T)


def _across(prop: Prop, half: Float64Array, place: Place, spot: Spot, around: Surroundings) -> Float64Array:
    """Return the middle (2,) of a prop of this half size (3,) at its place across the drift."""
    left = np.array([-spot.heading[1], spot.heading[0]])
    turn = yaw_pose(np.deg2rad(place.yaw_deg))[:2, :2]
    # Half sizes along and across the drift.
    extent = np.abs(footprint_corners((2 * half[0], 2 * half[1], 0.0)) @ turn.T).max(axis=0)
    stations = spot.point[:2] + np.linspace(-extent[0], extent[0], max(7, int(extent[0] / 0.1)))[:, None] * spot.heading
    origins = np.column_stack([stations, np.full(len(stations), spot.point[2])])
    top = min(2 * half[2], 0.5 * spot.height_m)
    heights = np.linspace(0.25, max(0.3, top), max(4, int(top / 0.08)))
    sides = free_width(around.fixed, origins, np.tile(left, (len(origins), 1)), heights, spot.width_m / 2)
    right_m, left_m = (float(side.min()) - around.gap_m for side in sides)
    if right_m + left_m < 2 * extent[1]:
        raise ScenarioError(
            f"prop {prop.name!r} is {2 * extent[1]:.2f} m across, but {spot.where} only "
            f"{max(right_m + left_m, 0.0):.2f} m are free: make it smaller, turn it, or place it elsewhere"
        )
    low, high = extent[1] - right_m, left_m - extent[1]
    return np.asarray(spot.point[:2] + ((low + high) / 2 + place.lateral * (high - low) / 2) * left)


def _require_clear(
    prop: Prop, size_m: Float64Array, yaw: float, position: Float64Array, spot: Spot, around: Surroundings
) -> None:
    """Cast rays from the middle of a prop to its outline, grown by a gap: they may meet no rock."""
    half = size_m[:2] / 2 + WALL_GAP_M
    share = np.linspace(-1.0, 1.0, 9)
    ends = np.concatenate([np.column_stack([share, np.full(9, side)]) for side in (-1.0, 1.0)])
    outline = np.concatenate([ends, ends[:, ::-1]]) * half @ yaw_pose(yaw)[:2, :2].T
    reach_m = np.linalg.norm(outline, axis=1)
    floor = floor_heights(around.walls, np.array([[*position, spot.point[2] + PROBE_UP_M / 2]]))[0]
    if np.isnan(floor):
        raise ScenarioError(f"prop {prop.name!r}: there is no floor {spot.where}, looked for from 0.6 m above it")
    for height in np.linspace(0.25, max(0.3, float(size_m[2])), 5):
        directions = np.column_stack([outline / reach_m[:, None], np.zeros(len(outline))])
        if (around.fixed.cast([*position, floor + height], directions)[0] < reach_m).any():
            raise ScenarioError(f"prop {prop.name!r} does not fit {spot.where}: it would stand in rock or pipes")


def _floor_under(
    prop: Prop, box: Float64Array, position: Float64Array, yaw: float, spot: Spot, around: Surroundings
) -> float:
    """Return the median height of the floor below a box (2, 3) whose middle stands at a position (2,)."""
    share = np.linspace(-0.5, 0.5, 7)
    size = box[1] - box[0]
    grid = np.stack(np.meshgrid(share * size[0], share * size[1]), axis=-1).reshape(-1, 2)
    xy = grid @ yaw_pose(yaw)[:2, :2].T + position
    heights = floor_heights(around.walls, np.column_stack([xy, np.full(len(xy), spot.point[2] + PROBE_UP_M)]))
    if np.isnan(heights).all():
        raise ScenarioError(f"prop {prop.name!r}: there is no floor where it should stand, looked for from 1.2 m above")
    return float(np.nanmedian(heights))


def _at_wall(
    prop: Prop,
    shape: Shape,
    place: Place,
    spot: Spot,
    around: Surroundings,
    seed: int,
    yaw: float,
    start: Float64Array | None,
) -> tuple[Float64Array, Float64Array]:
    """Return the pose of a prop that leans almost in contact with the nearer wall, or of a pile against it."""
    base = np.array([*(spot.point[:2] if start is None else start), spot.point[2]])
    wall = _nearer_wall(prop, place, spot, base, around)
    aside = np.array([-wall[1], wall[0]])
    if shape.is_settled:
        rotation = lean_towards(prop.name, shape, wall, yaw, seed)
        mesh = shape_mesh(shape)
        points = split_triangles(mesh.vertices[mesh.faces], _BULGE_M).reshape(-1, 3) @ rotation.T
    else:
        rotation = yaw_pose(float(np.arctan2(wall[1], wall[0]) - np.pi / 2))[:3, :3]  # +y faces the wall
        points = _back(shape) @ rotation.T
    foot_m = points[:, 2].min()
    level_m = _floor_under(prop, _span(points), base[:2], 0.0, spot, around)
    along = (points[:, :2] @ aside)[:, None] * aside
    origins = np.column_stack([base[:2] + along, level_m + np.maximum(points[:, 2] - foot_m, 0.1)])
    is_pile = prop.kind == "muck_pile"
    caster = around.walls if is_pile else around.fixed
    reach_m, _, normals = caster.hits(origins, [*wall, 0.0])
    if not _is_even(reach_m, is_pile, spot):
        # Under a long prop the floor may rise above its foot: a ray from there starts in rock, or meets the floor.
        is_wall = np.isfinite(reach_m) & (normals[:, :2] @ wall < 0) & (normals[:, 2] < _FLOOR_UP)
        is_seen = spot.over_humps and is_wall.mean() >= _SEEN_SHARE
        if not (is_seen and _is_even(reach_m[is_wall], is_pile, spot)):
            raise ScenarioError(f"prop {prop.name!r}: there is no even wall to lean against {spot.where}")
        reach_m, points = reach_m[is_wall], points[is_wall]
    room_m = reach_m - points[:, :2] @ wall
    # A pile's flat back lies in the mean line of the wall and goes on into the rock; all else stays out of it.
    position = base[:2] + float(room_m.mean() if is_pile else room_m.min() - _LEAN_GAP_M) * wall
    if shape.is_settled:
        return make_pose(rotation, np.append(position, level_m - foot_m)), wall
    half = np.array([*shape.size_m[:2], 0.0]) / 2
    yaw = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
    floor_m = _floor_under(prop, np.stack([-half, half]), position, yaw, spot, around)
    return make_pose(rotation, np.append(position, floor_m)), wall


def _is_even(reach_m: Float32Array, is_pile: bool, spot: Spot) -> bool:
    """Tell whether a wall at these distances (N,) is even enough to lean on; a ray without a hit is infinite."""
    if not np.isfinite(reach_m).all() or reach_m.max() > spot.width_m + 2.0:
        return False
    # A pile goes on behind its plane, which is put at the mean of the wall.
    if is_pile:
        return bool(reach_m.max() - reach_m.mean() <= BEHIND_M)
    return bool(np.ptp(reach_m) <= _UNEVEN_WALL_M)


def _back(shape: Shape) -> Float64Array:
    """Return points (N, 3) on the flat back of a prop against a wall, object frame."""
    length, width, height = shape.size_m
    heights, sides = np.linspace(0.1, max(height, 0.2), 5), np.linspace(-0.5, 0.5, 9) * length
    grid = np.stack(np.meshgrid(sides, heights), axis=-1).reshape(-1, 2)
    return np.column_stack([grid[:, 0], np.full(len(grid), width / 2), grid[:, 1]])


def _span(points: Float64Array) -> Float64Array:
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _nearer_wall(prop: Prop, place: Place, spot: Spot, base: Float64Array, around: Surroundings) -> Float64Array:
    """Return the direction (2,) of the wall: the side that `lateral` names in a drift, else the nearest rock."""
    if spot.is_line and place.lateral != 0.0:
        left = np.array([-spot.heading[1], spot.heading[0]])
        return np.asarray(np.sign(place.lateral) * left)
    angle = np.arange(32) * (2 * np.pi / 32)
    if spot.is_line:
        angle = np.arctan2(spot.heading[1], spot.heading[0]) + np.array([-np.pi / 2, np.pi / 2])
    level = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
    reach_m = around.walls.cast(base + np.array([0.0, 0.0, 0.6]), level)[0]
    if not np.isfinite(reach_m).any():
        raise ScenarioError(f"prop {prop.name!r}: there is no wall to lean against {spot.where}")
    return np.asarray(level[int(np.argmin(reach_m)), :2])


def draw_rotation(name: str, shape: Shape, posture: str, seed: int) -> Float64Array:
    """Return the rotation (3, 3) in which a prop is put down before its yaw: none, or on a side that its name draws."""
    if posture == "upright" or not shape.is_settled:
        return np.eye(3)
    generator = stream(seed, "props", name, "tipped")
    axis = np.pi / 2 * generator.integers(4) + np.deg2rad(_ASKEW_DEG) * generator.uniform(-1.0, 1.0)
    return np.asarray(Rotation.from_rotvec(np.pi / 2 * np.array([np.cos(axis), np.sin(axis), 0.0])).as_matrix())


def lean_towards(name: str, shape: Shape, wall: Float64Array, yaw_rad: float, seed: int) -> Float64Array:
    """Return the rotation (3, 3) of a prop that leans towards a wall in direction `wall` (2,).

    A flat one (a pallet) is stood on its longer edge first. Of its four sides it turns that one to the wall which is
    nearest to its yaw, or the next on which it leans more easily. It leans 10-25 degrees, or as far as it takes not to
    rock back upright.

    Raises:
        ScenarioError: It is too squat to lean.
    """
    size = np.array(shape.size_m)
    towards = float(np.arctan2(wall[1], wall[0]))
    stood = np.eye(3)
    if size[2] < 0.5 * size[:2].min():
        is_long_in_x = size[0] >= size[1]
        stood = Rotation.from_euler("x" if is_long_in_x else "y", np.pi / 2).as_matrix()
        yaw_rad = towards - (np.pi / 2 if is_long_in_x else 0.0)  # its thin side faces the wall
    nearest = round((yaw_rad - towards) / (np.pi / 2))
    lean_deg = stream(seed, "props", name, "leaning").uniform(*_LEAN_DEG)
    best, turned = np.inf, stood
    for quarter in (nearest, nearest - 1, nearest + 1, nearest + 2):
        rotation = (Rotation.from_euler("z", towards + quarter * np.pi / 2) * Rotation.from_matrix(stood)).as_matrix()
        balance_deg = _balance_deg(shape, rotation, wall)
        if balance_deg < best:
            best, turned = balance_deg, rotation
        if balance_deg < _STEEP_DEG:
            break
    lean_deg = max(lean_deg, best + _BEYOND_BALANCE_DEG)
    if lean_deg > _STEEPEST_LEAN_DEG:
        raise ScenarioError(
            f"prop {name!r} is too squat to lean against a wall: it would have to lean by {lean_deg:.0f} degrees, "
            f"{_STEEPEST_LEAN_DEG:g} is the most: make it slimmer, or choose another posture"
        )
    aside = np.array([-wall[1], wall[0], 0.0])
    return np.asarray(Rotation.from_rotvec(np.deg2rad(lean_deg) * aside).as_matrix() @ turned)


def _balance_deg(shape: Shape, rotation: Float64Array, wall: Float64Array) -> float:
    """Return the lean at which a prop's centre of mass is above the edge of its foot on the side of the wall."""
    meshes = [solid_mesh(solid) for solid in shape.solids]
    hulls = [trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).convex_hull for mesh in meshes]
    weights = np.array([hull.volume for hull in hulls])
    middle = rotation @ (weights @ np.array([hull.center_mass for hull in hulls]) / weights.sum())
    corners = np.concatenate([mesh.vertices for mesh in meshes]) @ rotation.T
    low_m = float(corners[:, 2].min())
    foot = corners[corners[:, 2] < low_m + _FOOT_M, :2] @ wall
    return float(np.rad2deg(np.arctan2(foot.max() - middle[:2] @ wall, middle[2] - low_m)))
