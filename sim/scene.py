"""The world as MuJoCo models: props dropped once and frozen, then one static model for each session."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.errors import ScenarioError
from cdpipe.geometry import Float32Array, Float64Array, Int32Array, make_pose, rotation_angle_rad
from scenarios.schema import Scenario
from sim.centreline import Centreline, build_centreline
from sim.mesh import Mesh
from sim.placing import PROBE_UP_M, Standing, floor_heights, place_props
from sim.props import Shape, Solid, shape_of
from sim.raycast import Caster, model_meshes
from sim.tunnel import mesh_tunnel

_BITS = {"before": 1, "after": 2}
_DROP_M = 0.02
# MuJoCo keeps at most 50 contacts of a geom with a height field and drops the rest: a large box on a fine grid tips.
_PATCH_STEPS_PER_LENGTH = 3.5
_TIMESTEP_S = 0.002
_LONGEST_S = 8.0
# At rest: mean speed over a window; MuJoCo's soft contacts leave a creep of a fraction of a millimetre per second.
_REST_MPS = 2e-3
_REST_RADPS = 1e-2
_WINDOW_S = 0.2
_DRAG_HZ = (2.0, 20.0)  # of speed and of turning


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What stands in the tunnel in one session.

    Attributes:
        model: Compiled MuJoCo model; geom 0 is the wall.
        data: Its forward state.
        meshes: Surface of every geom, world frame, by geom id.
        caster: Embree over the same geoms under the same ids.
        instance: (G,) prop number (1-based, order of the scenario) of each geom, 0 for the wall.
        reflectivity: (G,) share of light sent back.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    meshes: tuple[Mesh, ...]
    caster: Caster
    instance: Int32Array
    reflectivity: Float32Array


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """A scenario built.

    Attributes:
        centreline: Where the drifts run.
        walls: Ray caster of the bare tunnel.
        standing: Every prop at each of its places, settled.
        shapes: Shape of each prop by name.
        before, after: The two scenes.
    """

    centreline: Centreline
    walls: Caster
    standing: tuple[Standing, ...]
    shapes: dict[str, Shape]
    before: Scene
    after: Scene


def build_world(scenario: Scenario, seed: int) -> World:
    """Mesh the tunnel, set the props down and compile both sessions' models.

    Raises:
        ScenarioError: The tunnel cannot be meshed, or a prop does not fit, does not come to rest or falls away.
    """
    centreline = build_centreline(scenario.tunnel, seed)
    wall = mesh_tunnel(scenario.tunnel, centreline, seed)
    walls = Caster([wall])
    shapes = {prop.name: shape_of(prop, seed) for prop in scenario.props}
    standing = settle(place_props(scenario, centreline, walls), shapes, walls)
    scenes = [compile_scene(scenario, wall, standing, shapes, session) for session in ("before", "after")]
    return World(centreline, walls, tuple(standing), shapes, scenes[0], scenes[1])


def settle(standing: Sequence[Standing], shapes: dict[str, Shape], walls: Caster) -> list[Standing]:
    """Drop the props on the floor until they rest, and return them at their frozen poses.

    All drop in one simulation, each on a height field cast from the wall mesh: the wall itself would collide as its
    convex hull, a solid plug. Props that never share a session pass through one another.

    Raises:
        ScenarioError: A prop is not at rest after 8 s, fell through the floor, or rolled away.
    """
    falling = [item for item in standing if shapes[item.prop.name].is_settled]
    if not falling:
        return list(standing)
    spec = mujoco.MjSpec()
    spec.option.timestep = _TIMESTEP_S
    spec.option.impratio = 10.0
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    for number, item in enumerate(falling):
        bits = sum(_BITS[session] for session in item.sessions)
        _add_patch(spec, number, item, walls)
        pose = item.world_T_object.copy()
        pose[2, 3] = _drop_height(item, walls)
        body = spec.worldbody.add_body(name=f"prop{number}", pos=pose[:3, 3], quat=_quaternion(pose))
        body.add_freejoint()
        for solid in shapes[item.prop.name].solids:
            _add_solid(body, solid, contype=bits, conaffinity=bits, density=300.0, friction=[1.0, 0.01, 0.001])
    model = spec.compile()
    # Drag ends the rocking that stiff contacts keep alive; it changes no resting pose.
    bodies = slice(1, 1 + len(falling))
    drag = np.concatenate([np.repeat(model.body_mass[bodies, None], 3, axis=1), model.body_inertia[bodies]], axis=1)
    model.dof_damping[:] = (drag * ([_DRAG_HZ[0]] * 3 + [_DRAG_HZ[1]] * 3)).ravel()
    data = mujoco.MjData(model)
    _run_to_rest(model, data, falling)
    settled = iter(
        replace(item, world_T_object=_frozen_pose(data, number, item)) for number, item in enumerate(falling)
    )
    return [next(settled) if shapes[item.prop.name].is_settled else item for item in standing]


def compile_scene(
    scenario: Scenario, wall: Mesh, standing: Sequence[Standing], shapes: dict[str, Shape], session: str
) -> Scene:
    """Compile the static model of one session: the wall, then every prop that stands in it."""
    spec = mujoco.MjSpec()
    spec.add_mesh(
        name="wall",
        uservert=wall.vertices.ravel(),
        userface=wall.faces.ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    spec.worldbody.add_geom(name="wall", type=mujoco.mjtGeom.mjGEOM_MESH, meshname="wall", contype=0, conaffinity=0)
    numbers = {prop.name: number for number, prop in enumerate(scenario.props, start=1)}
    instance, reflectivity = [0], [scenario.tunnel.reflectivity]
    for item in standing:
        if session not in item.sessions:
            continue
        pose = item.world_T_object
        body = spec.worldbody.add_body(name=item.prop.name, pos=pose[:3, 3], quat=_quaternion(pose))
        for index, solid in enumerate(shapes[item.prop.name].solids):
            if solid.mesh is not None:
                spec.add_mesh(
                    name=f"{item.prop.name}/{index}",
                    uservert=solid.mesh.vertices.ravel(),
                    userface=solid.mesh.faces.ravel(),
                    inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
                )
            _add_solid(body, solid, mesh_name=f"{item.prop.name}/{index}", contype=0, conaffinity=0)
            instance.append(numbers[item.prop.name])
            reflectivity.append(item.prop.reflectivity)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    meshes = model_meshes(model, data)
    return Scene(
        model,
        data,
        tuple(meshes),
        Caster(meshes),
        np.array(instance, np.int32),
        np.array(reflectivity, np.float32),
    )


def _add_solid(body: mujoco.MjsBody, solid: Solid, mesh_name: str = "", **options: object) -> None:
    pose = solid.object_T_solid
    common = {"pos": pose[:3, 3], "quat": _quaternion(pose), **options}
    if solid.mesh is not None:
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh_name, **common)
    else:
        kind = mujoco.mjtGeom.mjGEOM_BOX if solid.kind == "box" else mujoco.mjtGeom.mjGEOM_CYLINDER
        body.add_geom(type=kind, size=solid.size_m, **common)


def _add_patch(spec: mujoco.MjSpec, number: int, item: Standing, walls: Caster) -> None:
    """Put a height field of the real floor under a prop; rock is level with the floor beside it."""
    half_m = 0.5 * float(np.hypot(*item.prop.size_m[:2])) + 0.4
    count = 2 * int(np.ceil(half_m * _PATCH_STEPS_PER_LENGTH / max(item.prop.size_m[:2]))) + 1
    x, y, z = item.world_T_object[:3, 3]
    axis = np.linspace(-half_m, half_m, count)
    grid = np.stack(np.meshgrid(x + axis, y + axis), axis=-1).reshape(-1, 2)  # rows along y, as MuJoCo wants
    heights = floor_heights(walls, np.column_stack([grid, np.full(len(grid), z + PROBE_UP_M)]))
    heights = np.where(np.isnan(heights) | (np.abs(heights - z) > 0.5), z, heights)
    low, span = heights.min(), max(float(np.ptp(heights)), 1e-3)
    spec.add_hfield(
        name=f"floor{number}",
        size=[half_m, half_m, span, 0.5],
        nrow=count,
        ncol=count,
        userdata=((heights - low) / span).astype(np.float32),
    )
    bits = sum(_BITS[session] for session in item.sessions)
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname=f"floor{number}",
        pos=[x, y, low],
        contype=bits,
        conaffinity=bits,
    )


def _drop_height(item: Standing, walls: Caster) -> float:
    """Height of a prop's origin just above the highest floor under its footprint."""
    pose = item.world_T_object
    share = np.linspace(-0.5, 0.5, 15)
    grid = np.stack(np.meshgrid(share * item.prop.size_m[0], share * item.prop.size_m[1]), axis=-1).reshape(-1, 2)
    xy = grid @ pose[:2, :2].T + pose[:2, 3]
    heights = floor_heights(walls, np.column_stack([xy, np.full(len(xy), pose[2, 3] + PROBE_UP_M)]))
    near = heights[np.abs(heights - pose[2, 3]) < 0.5]
    return float(near.max(initial=pose[2, 3])) + _DROP_M


def _run_to_rest(model: mujoco.MjModel, data: mujoco.MjData, falling: Sequence[Standing]) -> None:
    """Step until no prop has moved for two windows; contacts chatter from step to step even under a prop at rest."""
    calm = 0
    for _ in range(int(_LONGEST_S / _WINDOW_S)):
        start = data.qpos.reshape(-1, 7).copy()
        for _ in range(round(_WINDOW_S / _TIMESTEP_S)):
            mujoco.mj_step(model, data)
        end = data.qpos.reshape(-1, 7)
        speed_mps = np.linalg.norm(end[:, :3] - start[:, :3], axis=1) / _WINDOW_S
        turn = (
            Rotation.from_quat(end[:, 3:], scalar_first=True)
            * Rotation.from_quat(start[:, 3:], scalar_first=True).inv()
        )
        restlessness = np.maximum(speed_mps / _REST_MPS, turn.magnitude() / _WINDOW_S / _REST_RADPS)
        calm = calm + 1 if restlessness.max() < 1.0 else 0
        if calm == 2:
            return
    raise ScenarioError(
        f"prop {falling[int(np.argmax(restlessness))].prop.name!r} does not come to rest within {_LONGEST_S:g} s: "
        "place it on more level floor, or give it a wider footprint"
    )


def _frozen_pose(data: mujoco.MjData, number: int, item: Standing) -> Float64Array:
    body = data.body(f"prop{number}")
    # A thousandth of a millimetre: both sessions, and the truth, hold the very same numbers.
    rotation = Rotation.from_quat(np.round(body.xquat, 9), scalar_first=True).as_matrix()
    pose = make_pose(rotation, np.round(body.xpos, 6))
    start = item.world_T_object
    sunk_m = start[2, 3] - pose[2, 3]
    slid_m = float(np.linalg.norm(pose[:2, 3] - start[:2, 3]))
    if sunk_m > 0.5 or slid_m > 0.5:
        raise ScenarioError(
            f"prop {item.prop.name!r} moved {slid_m:.2f} m sideways and {sunk_m:.2f} m down while settling: "
            "place it on more level floor"
        )
    if rotation_angle_rad(np.linalg.inv(start) @ pose) > np.deg2rad(45.0):
        raise ScenarioError(f"prop {item.prop.name!r} falls over where it stands: place it on more level floor")
    return pose


def _quaternion(pose: Float64Array) -> Float64Array:
    return np.asarray(Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True))
