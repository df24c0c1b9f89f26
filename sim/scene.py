"""The world as MuJoCo models: props dropped once and frozen, then one static model for each session."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from cdpipe.geometry import Float32Array, Int32Array
from scenarios.schema import Scenario
from sim.centreline import Centreline, build_centreline
from sim.mesh import Mesh
from sim.placing import Standing, place_props
from sim.props import Shape, shape_of
from sim.raycast import Caster, model_meshes
from sim.settling import add_solid, quaternion, settle
from sim.tunnel import mesh_tunnel


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
        body = spec.worldbody.add_body(name=item.prop.name, pos=pose[:3, 3], quat=quaternion(pose))
        for index, solid in enumerate(shapes[item.prop.name].solids):
            if solid.mesh is not None:
                spec.add_mesh(
                    name=f"{item.prop.name}/{index}",
                    uservert=solid.mesh.vertices.ravel(),
                    userface=solid.mesh.faces.ravel(),
                    inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
                )
            add_solid(body, solid, mesh_name=f"{item.prop.name}/{index}", contype=0, conaffinity=0)
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
