"""The world as MuJoCo models: props dropped once and frozen, then one static model for each session."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from cdpipe.geometry import Float32Array, Int32Array
from scenarios.schema import Scenario
from sim.arranging import place_props
from sim.centreline import Centreline, build_centreline
from sim.foreign import tunnel_mesh
from sim.furniture import Fixture, furnish
from sim.materials import REFLECTIVITY
from sim.mesh import Mesh
from sim.placing import WALL_GAP_M, Standing, Surroundings, grown, standing_corners
from sim.raycast import Caster, model_meshes
from sim.settling import add_solid, quaternion
from sim.stones import strew_stones
from sim.tunnel import mesh_tunnel

WALL = "wall"
_STONE_FREE_M = 0.1  # round the footprint of every prop


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What stands in the tunnel in one session.

    Attributes:
        model: Compiled MuJoCo model; geom 0 is the wall, then come the fixtures, then the props.
        data: Its forward state.
        meshes: Surface of every geom, world frame, by geom id.
        caster: Embree over the same geoms under the same ids.
        instance: (G,) prop number (1-based, order of the scenario) of each geom, 0 for the wall and what is fixed.
        reflectivity: (G,) share of light sent back.
        parts: Whose each geom is: "wall", a fixture's name, or a prop's name.
        materials: What each geom is made of, keys of `sim.materials.REFLECTIVITY`.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    meshes: tuple[Mesh, ...]
    caster: Caster
    instance: Int32Array
    reflectivity: Float32Array
    parts: tuple[str, ...]
    materials: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """A scenario built.

    Attributes:
        centreline: Where the drifts run.
        walls: Ray caster of the bare tunnel.
        fixed: Ray caster of the tunnel and everything fixed to it, stones included: what a robot must respect.
        fixtures: Furniture and stones.
        standing: Every prop at each of its places, settled.
        before, after: The two scenes.
    """

    centreline: Centreline
    walls: Caster
    fixed: Caster
    fixtures: tuple[Fixture, ...]
    standing: tuple[Standing, ...]
    before: Scene
    after: Scene


def build_world(scenario: Scenario, seed: int) -> World:
    """Mesh the tunnel, furnish it, set the props down and compile both sessions' models.

    Raises:
        ScenarioError: The tunnel cannot be meshed, or a prop does not fit, does not come to rest or falls away.
    """
    tunnel = scenario.tunnel
    centreline = build_centreline(tunnel, seed)
    wall = mesh_tunnel(tunnel, centreline, seed) if tunnel.mesh is None else tunnel_mesh(tunnel.mesh)
    walls = Caster([wall])
    furniture = furnish(tunnel, centreline, walls, seed)
    hung = Caster([wall, *(fixture.mesh for fixture in furniture)]) if furniture else walls
    gap_m = WALL_GAP_M + (tunnel.resolution_m if tunnel.mesh is None else 0.0)
    standing = place_props(scenario, centreline, Surroundings(walls, hung, gap_m), seed)
    outlines = [grown(standing_corners(item), _STONE_FREE_M) for item in standing]
    stones = strew_stones(tunnel, centreline, walls, outlines, seed)
    fixtures = furniture if stones is None else (*furniture, stones)
    fixed = hung if stones is None else Caster([wall, *(fixture.mesh for fixture in fixtures)])
    scenes = [compile_scene(scenario, wall, standing, session, fixtures) for session in ("before", "after")]
    return World(centreline, walls, fixed, fixtures, tuple(standing), scenes[0], scenes[1])


def compile_scene(
    scenario: Scenario, wall: Mesh, standing: Sequence[Standing], session: str, fixtures: Sequence[Fixture] = ()
) -> Scene:
    """Compile the static model of one session: the wall, what is fixed to it, then every prop that stands in it."""
    spec = mujoco.MjSpec()
    shares = REFLECTIVITY | {"rock": scenario.tunnel.reflectivity}  # what lies loose was blasted from the walls
    numbers = {prop.name: number for number, prop in enumerate(scenario.props, start=1)}
    parts, materials, instance, reflectivity = [WALL], ["rock"], [0], [scenario.tunnel.reflectivity]
    _add_fixed(spec, WALL, wall)
    for fixture in fixtures:
        _add_fixed(spec, f"fixture/{fixture.name}", fixture.mesh)
        parts.append(fixture.name)
        instance.append(0)
        reflectivity.append(shares[fixture.material])
        materials.append(fixture.material)
    for item in standing:
        if session not in item.sessions:
            continue
        pose = item.world_T_object
        body = spec.worldbody.add_body(name=f"prop/{item.prop.name}", pos=pose[:3, 3], quat=quaternion(pose))
        for index, solid in enumerate(item.shape.solids):
            name = f"prop/{item.prop.name}/{index}"
            if solid.mesh is not None:
                _add_mesh(spec, name, solid.mesh)
            add_solid(body, solid, mesh_name=name, contype=0, conaffinity=0)
            parts.append(item.prop.name)
            instance.append(numbers[item.prop.name])
            reflectivity.append(item.prop.reflectivity or shares[solid.material])
            materials.append(solid.material)
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
        tuple(parts),
        tuple(materials),
    )


def _add_fixed(spec: mujoco.MjSpec, name: str, mesh: Mesh) -> None:
    _add_mesh(spec, name, mesh)
    spec.worldbody.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, contype=0, conaffinity=0)


def _add_mesh(spec: mujoco.MjSpec, name: str, mesh: Mesh) -> None:
    spec.add_mesh(
        name=name,
        uservert=mesh.vertices.ravel(),
        userface=mesh.faces.ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
