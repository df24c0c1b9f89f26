"""Settling by physics: each prop is dropped on the floor once and comes to rest."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, make_pose, transform
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster
from sim.placement.contact import find_way_out, surface_points
from sim.placement.placing import PROBE_UP_M, Standing, Surroundings, floor_heights
from sim.props.shapes import Solid

DEEPEST_M = 0.01  # of any point of a prop at rest in rock
_DROP_M = 0.02
# MuJoCo keeps at most 50 contacts of a geom with a height field and drops the rest: a large box on a fine grid tips.
_PATCH_STEPS_PER_LENGTH = 3.5
_MOST_PATCH_STEPS = 200  # of a prop of 7 mm
_WALL_STEP_M = 0.15
_TIMESTEP_S = 0.002
_LONGEST_S = 8.0
# At rest: mean speed over a window; MuJoCo's soft contacts leave a creep of a fraction of a millimetre per second.
_REST_MPS = 2e-3
_REST_RADPS = 1e-2
_FALLEN_DEG = 45.0
_WINDOW_S = 0.2
# Rough ground, with overdamped contacts: otherwise a box on three points rocks for ever. Rolling friction stands for
# the stones that keep a lying or leaning barrel from rolling away.
_CONTACT: dict[str, Any] = {"friction": [1.0, 0.01, 0.001], "solref": [0.02, 2.0]}
_CHOCKED: dict[str, Any] = {"friction": [1.0, 0.05, 0.1], "solref": [0.02, 2.0], "condim": 6}
_DRAG_HZ = {"upright": (2.0, 20.0), "leaning": (2.0, 8.0), "tipped": (2.0, 5.0)}  # of speed and of turning
_TOUCH_M = 0.002
# A leaning prop this near the true wall, the error of the field, is moved to it.
_NEAR_WALL_M = 0.08
_LEANING_GAP_M = 0.02


def settle(item: Standing, around: Surroundings) -> Standing:
    """Drop a prop on the floor until it rests, and return it at its final pose; props set into the floor keep theirs.

    Each prop drops alone, so that its pose depends on no other prop. Height fields measured by rays stand for the floor
    below it and the wall it leans against, because MuJoCo would collide with the convex hull of the wall mesh. The
    fields are coarser than the rock. At the end the prop is moved until its true surface touches the true rock.

    Raises:
        ScenarioError: It falls over, is not at rest after 8 s, rolls away, or cannot be freed from the rock.
    """
    if not item.shape.is_settled:
        return item
    points = surface_points(item.shape)
    model = _model(item, points, around)
    data = mujoco.MjData(model)
    _run_to_rest(model, data, item)
    return replace(item, world_T_object=_freeze_pose(data, item, points, around))


def add_mesh(spec: mujoco.MjSpec, name: str, mesh: Mesh, is_hull: bool = False) -> None:
    """Add a surface to a spec, with the mass of its convex hull or of its shell."""
    inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX if is_hull else mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.add_mesh(name=name, uservert=mesh.vertices.ravel(), userface=mesh.faces.ravel(), inertia=inertia)


def add_solid(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, solid: Solid, name: str, is_hull: bool = False, **options: object
) -> None:
    """Add a primitive to a body that has the object frame, a mesh under this name and as `add_mesh` does."""
    pose = solid.object_T_solid
    common = {"pos": pose[:3, 3], "quat": quaternion(pose), **options}
    if solid.mesh is not None:
        add_mesh(spec, name, solid.mesh, is_hull)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **common)
    else:
        kind = mujoco.mjtGeom.mjGEOM_BOX if solid.kind == "box" else mujoco.mjtGeom.mjGEOM_CYLINDER
        body.add_geom(type=kind, size=solid.size_m, **common)


def quaternion(pose: Float64Array) -> Float64Array:
    """Return a pose's rotation as MuJoCo writes it: w, x, y, z."""
    return np.array(_remember_quaternion(np.ascontiguousarray(pose[:3, :3], np.float64).tobytes()))


@lru_cache(maxsize=512)
def _remember_quaternion(rotation: bytes) -> tuple[float, ...]:
    """Return the quaternion of a matrix (3, 3) of float64: most solids of a prop share their rotation with others."""
    matrix = np.frombuffer(rotation).reshape(3, 3).copy()  # scipy's lowest version takes no read-only one
    return tuple(Rotation.from_matrix(matrix).as_quat(scalar_first=True).tolist())


def _model(item: Standing, points: Float64Array, around: Surroundings) -> mujoco.MjModel:
    """Return the model of one prop above its floor, with the wall it leans against."""
    spec = mujoco.MjSpec()
    spec.option.timestep = _TIMESTEP_S
    spec.option.impratio = 10.0
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    contact = _CONTACT if item.posture == "upright" else _CHOCKED
    _add_floor(spec, item, points, around.walls, contact)
    if item.wall is not None:
        _add_wall(spec, item.wall, transform(item.world_T_object, points), around.fixed, contact)
    pose = item.world_T_object.copy()
    pose[2, 3] += _DROP_M - _floor_gap_m(pose, points, around.walls)
    body = spec.worldbody.add_body(name="prop", pos=pose[:3, 3], quat=quaternion(pose))
    body.add_freejoint()
    for index, solid in enumerate(item.shape.solids):
        # The hull of a mesh collides and gives the mass, which also works for open surfaces.
        add_solid(spec, body, solid, str(index), is_hull=True, density=300.0, **contact)
    model = spec.compile()
    # Drag ends the rocking that stiff contacts keep alive; it changes no resting pose.
    speed_hz, turn_hz = _DRAG_HZ[item.posture]
    model.dof_damping[:3] = speed_hz * model.body_mass[1]
    model.dof_damping[3:] = turn_hz * model.body_inertia[1]
    return model


def _add_floor(
    spec: mujoco.MjSpec, item: Standing, points: Float64Array, walls: Caster, contact: dict[str, Any]
) -> None:
    """Add a height field of the real floor below a prop; rock beside it is set to the level of the floor."""
    world = transform(item.world_T_object, points)
    size = np.ptp(world, axis=0)
    # One that is not upright may yet turn on any side.
    reach = size[:2] if item.posture == "upright" else np.full(2, np.ptp(points, axis=0).max())
    half_m = 0.5 * float(np.hypot(*reach)) + 0.4
    n_steps = half_m * _PATCH_STEPS_PER_LENGTH / max(item.shape.size_m[:2])
    if n_steps > _MOST_PATCH_STEPS:
        raise ScenarioError(
            f"props.{item.prop.name}.size_m = {list(item.prop.size_m or ())}: too small to come to rest on the floor: "
            "make it larger"
        )
    count = 2 * int(np.ceil(n_steps)) + 1
    x, y = (world[:, :2].min(axis=0) + world[:, :2].max(axis=0)) / 2
    z = world[:, 2].min()
    axis = np.linspace(-half_m, half_m, count)
    grid = np.stack(np.meshgrid(x + axis, y + axis), axis=-1).reshape(-1, 2)  # rows along y, as MuJoCo wants
    heights = floor_heights(walls, np.column_stack([grid, np.full(len(grid), z + PROBE_UP_M)]))
    heights = np.where(np.isnan(heights) | (np.abs(heights - z) > 0.5), z, heights)
    low = float(heights.min())
    field = heights.reshape(count, count)
    _add_field(spec, "floor", (half_m, half_m), field, low, pos=[x, y, low], **contact)


def _add_wall(
    spec: mujoco.MjSpec, wall: Float64Array, world: Float64Array, fixed: Caster, contact: dict[str, Any]
) -> None:
    """Add a height field of the wall and its fixtures, as level rays from the prop, `world` (N, 3), measure them."""
    low, high = world.min(axis=0), world.max(axis=0)
    middle = (low + high) / 2
    out = np.append(-wall, 0.0)
    aside = np.array([wall[1], -wall[0], 0.0])  # aside x up = out of the wall
    half = np.array([np.ptp(world @ aside) / 2 + 0.3, (high[2] - low[2]) / 2 + 0.25])
    columns, rows = (2 * int(np.ceil(extent / _WALL_STEP_M)) + 1 for extent in half)
    u, v = np.meshgrid(np.linspace(-half[0], half[0], columns), np.linspace(-half[1], half[1], rows))
    origins = middle + u.reshape(-1, 1) * aside + v.reshape(-1, 1) * [0.0, 0.0, 1.0]
    ranges_m, _, normals = fixed.hits(origins, -out)
    is_wall = ((normals * -out).sum(axis=1) < 0) & (ranges_m < 3.0)
    depth_m = ranges_m.astype(np.float64)
    far_m = float(depth_m[is_wall].max(initial=0.5)) + 0.01
    depth_m = np.where(is_wall, depth_m, far_m)  # below the floor, or through an opening
    frame = make_pose(np.stack([aside, [0.0, 0.0, 1.0], out], axis=1))
    pose = {"pos": middle - far_m * out, "quat": quaternion(frame)}
    _add_field(spec, "wall", (half[0], half[1]), -depth_m.reshape(rows, columns), -far_m, **pose, **contact)


def _add_field(
    spec: mujoco.MjSpec, name: str, half_m: tuple[float, float], heights: Float64Array, low: float, **options: object
) -> None:
    """Add a height field (rows, columns) whose lowest height is `low`."""
    span = max(float(heights.max()) - low, 1e-3)
    data = ((heights - low) / span).astype(np.float32).ravel()
    rows, columns = heights.shape
    spec.add_hfield(name=name, size=[*half_m, span, 0.5], nrow=rows, ncol=columns, userdata=data)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=name, **options)


def _floor_gap_m(pose: Float64Array, points: Float64Array, walls: Caster) -> float:
    """Return the least height of a prop's lower points above the true floor, floor far from its foot left out."""
    world = transform(pose, points)
    foot = world[:, 2].min()
    world = world[world[:, 2] < foot + 0.3]
    heights = floor_heights(walls, np.column_stack([world[:, :2], np.full(len(world), foot + PROBE_UP_M)]))
    near = np.abs(heights - foot) < 0.5
    return float((world[near, 2] - heights[near]).min(initial=0.5))


def _wall_gap_m(pose: Float64Array, wall: Float64Array, points: Float64Array, fixed: Caster) -> float:
    """Return the least horizontal distance from a prop's upper two thirds to the true wall."""
    world = transform(pose, points)
    world = world[world[:, 2] > world[:, 2].min() + np.ptp(world[:, 2]) / 3]
    return float(fixed.cast(world, [*wall, 0.0])[0].min())


def _run_to_rest(model: mujoco.MjModel, data: mujoco.MjData, item: Standing) -> None:
    """Step until the prop does not move for two windows; single steps show contact noise even at rest."""
    calm = 0
    up = np.asarray(Rotation.from_quat(model.body("prop").quat, scalar_first=True).as_matrix()).T[:, 2]
    for _ in range(int(_LONGEST_S / _WINDOW_S)):
        start = data.qpos.copy()
        mujoco.mj_step(model, data, round(_WINDOW_S / _TIMESTEP_S))
        turned = Rotation.from_quat(data.qpos[3:], scalar_first=True)
        # Tipped props may roll; the up axis of all others stays up.
        if item.posture != "tipped" and (turned.as_matrix() @ up)[2] < np.cos(np.deg2rad(_FALLEN_DEG)):
            raise ScenarioError(f"prop {item.prop.name!r} falls over where it stands: place it on more level floor")
        speed_mps = np.linalg.norm(data.qpos[:3] - start[:3]) / _WINDOW_S
        turn = (turned * Rotation.from_quat(start[3:], scalar_first=True).inv()).magnitude() / _WINDOW_S
        calm = calm + 1 if speed_mps < _REST_MPS and turn < _REST_RADPS else 0
        if calm == 2:
            return
    raise ScenarioError(
        f"prop {item.prop.name!r} does not come to rest within {_LONGEST_S:g} s: "
        "place it on more level floor, or give it a wider footprint"
    )


def _freeze_pose(data: mujoco.MjData, item: Standing, points: Float64Array, around: Surroundings) -> Float64Array:
    body = data.body("prop")
    rotation = Rotation.from_quat(np.round(body.xquat, 9), scalar_first=True).as_matrix()
    pose = _bring_to_contact(make_pose(rotation, body.xpos), item, points, around)
    # A thousandth of a millimetre: both sessions, and the truth, hold the very same numbers.
    pose[:3, 3] = np.round(pose[:3, 3], 6)
    start, end = (transform(each, points) for each in (item.world_T_object, pose))
    sunk_m = float(start[:, 2].min() - end[:, 2].min())
    slid_m = float(np.linalg.norm(end[:, :2].mean(axis=0) - start[:, :2].mean(axis=0)))
    if abs(sunk_m) > 0.5 or slid_m > 0.5:
        raise ScenarioError(
            f"prop {item.prop.name!r} moved {slid_m:.2f} m sideways and {sunk_m:.2f} m down while settling: "
            "place it on more level floor"
        )
    if item.wall is not None and _wall_gap_m(pose, item.wall, points, around.fixed) > _LEANING_GAP_M:
        raise ScenarioError(
            f"prop {item.prop.name!r} does not come to rest against the wall: place it where wall and floor are evener"
        )
    deepest_m = float(find_way_out(end, around.fixed)[0].max(initial=0.0))
    if deepest_m > DEEPEST_M:
        raise ScenarioError(
            f"prop {item.prop.name!r} rests {deepest_m:.2f} m deep in rock: place it on more level floor, "
            "or farther from the wall"
        )
    return pose


def _bring_to_contact(pose: Float64Array, item: Standing, points: Float64Array, around: Surroundings) -> Float64Array:
    """Move a prop to the true floor and wall, then the shortest way out of rock until it only touches it.

    The distance is the error of the height fields, a few centimetres.
    """
    pose = pose.copy()
    pose[2, 3] -= max(_floor_gap_m(pose, points, around.walls), 0.0)
    if item.wall is not None:
        gap_m = _wall_gap_m(pose, item.wall, points, around.fixed)
        if gap_m < _NEAR_WALL_M:
            pose[:2, 3] += max(gap_m - _TOUCH_M, 0.0) * item.wall
    for _ in range(12):
        depth_m, way_out = find_way_out(transform(pose, points), around.fixed)
        worst = int(np.argmax(depth_m))
        if not _TOUCH_M < depth_m[worst] < 0.3:
            break
        pose[:3, 3] += depth_m[worst] * way_out[worst]
    return pose
