"""Physics, once: props dropped on the floor until they rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.errors import ScenarioError
from cdpipe.geometry import Float64Array, make_pose
from sim.placing import PROBE_UP_M, Standing, floor_heights
from sim.props import Shape, Solid
from sim.raycast import Caster

_BITS = {"before": 1, "after": 2}
_DROP_M = 0.02
# MuJoCo keeps at most 50 contacts of a geom with a height field and drops the rest: a large box on a fine grid tips.
_PATCH_STEPS_PER_LENGTH = 3.5
_TIMESTEP_S = 0.002
_LONGEST_S = 8.0
# At rest: mean speed over a window; MuJoCo's soft contacts leave a creep of a fraction of a millimetre per second.
_REST_MPS = 2e-3
_REST_RADPS = 1e-2
_FALLEN_DEG = 45.0
_WINDOW_S = 0.2
# Rough ground, and contacts damped beyond critical, or a box on three points rocks for ever.
_CONTACT: dict[str, Any] = {"friction": [1.0, 0.01, 0.001], "solref": [0.02, 2.0]}
_DRAG_HZ = (2.0, 20.0)  # of speed and of turning


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
        body = spec.worldbody.add_body(name=f"prop{number}", pos=pose[:3, 3], quat=quaternion(pose))
        body.add_freejoint()
        for solid in shapes[item.prop.name].solids:
            add_solid(body, solid, contype=bits, conaffinity=bits, density=300.0, **_CONTACT)
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


def add_solid(body: mujoco.MjsBody, solid: Solid, mesh_name: str = "", **options: object) -> None:
    """Add a primitive to a body that has the object frame; a mesh must be in the spec under `mesh_name`."""
    pose = solid.object_T_solid
    common = {"pos": pose[:3, 3], "quat": quaternion(pose), **options}
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
        **_CONTACT,
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
        _refuse_fallen(end, falling)
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


def _refuse_fallen(placed: Float64Array, falling: Sequence[Standing]) -> None:
    upright = Rotation.from_quat(placed[:, 3:], scalar_first=True).as_matrix()[:, 2, 2]
    if upright.min() < np.cos(np.deg2rad(_FALLEN_DEG)):
        name = falling[int(np.argmin(upright))].prop.name
        raise ScenarioError(f"prop {name!r} falls over where it stands: place it on more level floor")


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
    return pose


def quaternion(pose: Float64Array) -> Float64Array:
    """Return a pose's rotation as MuJoCo writes it: w, x, y, z."""
    return np.asarray(Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True))
