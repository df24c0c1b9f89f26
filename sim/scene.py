"""The world as MuJoCo compiles it: props dropped once and frozen, then the surfaces of each session's static scene.

One kilometre of drift under wire mesh has five million triangles. MuJoCo needs 0.65 kB per triangle while it compiles
and 0.2 kB afterwards. The fixed meshes are therefore compiled one by one, once for both sessions, and only the compiled
surfaces are kept. Their order is the order of the geoms in a single model of the whole scene.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float32Array, Float64Array, Int32Array
from scenarios.grafted import GraftScenario
from scenarios.schema import Scenario
from sim.displacement.displace import Displacement, displace
from sim.displacement.follow import (
    barred_places,
    carry,
    covered_outlines,
    follow,
    leave_out_broken,
    raise_centreline,
    rubble_points,
)
from sim.furniture.furniture import Fixture, furnish
from sim.furniture.stones import strew_stones
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster, model_meshes
from sim.materials import REFLECTIVITY
from sim.placement.arranging import place_props
from sim.placement.placing import WALL_GAP_M, Standing, Surroundings, grow_rectangle, standing_corners
from sim.placement.settling import add_mesh, add_solid, quaternion
from sim.rock.centreline import Centreline, build_centreline
from sim.rock.foreign import tunnel_mesh
from sim.rock.grounding import set_on_floor
from sim.rock.tunnel import mesh_tunnel
from sim.size import require_memory, require_size

WALL = "wall"
WALL_GEOM = 0
Heaps = tuple[tuple[str, Float64Array], ...]
HEAP_M = 0.15  # rubble higher than this is driven round
_STONE_FREE_M = 0.1  # round the footprint of every prop


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The surfaces of one session. Geom 0 is the wall; the fixtures follow, then the props.

    Attributes:
        meshes: Compiled surface of every geom, world frame, by geom id; both sessions share the fixed ones.
        caster: Ray caster over the same geoms with the same ids.
        instance: (G,) prop number (1-based, order of the scenario) of each geom, 0 for the wall and the fixtures.
        reflectivity: (G,) share of the light that each geom reflects.
        parts: The owner of each geom: "wall", a fixture's name, or a prop's name.
        materials: Material of each geom, keys of `sim.materials.REFLECTIVITY`.
    """

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
        centreline: The drifts.
        walls: Ray caster of the bare tunnel.
        fixed: Ray caster of the tunnel with furniture and stones, the obstacles of a robot.
        fixtures: Furniture and stones.
        standing: Every prop at each of its places, settled.
        before, after: The two scenes.
        displacement: The walls of both sessions where rock changes; None where it does not.
        changed: Drifts, tunnel, obstacles and furniture as they are in the after session where rock changes, in the
            order centreline, walls, fixed, fixtures, heaps.
        heaps: Name and places (N, 3) of the rubble of this session that a robot drives round.
    """

    centreline: Centreline
    walls: Caster
    fixed: Caster
    fixtures: tuple[Fixture, ...]
    standing: tuple[Standing, ...]
    before: Scene
    after: Scene
    displacement: Displacement | None = None
    changed: tuple[Centreline, Caster, Caster, tuple[Fixture, ...], Heaps] | None = None
    heaps: Heaps = ()

    def of(self, session: str) -> World:
        """Return the world as a session meets it: its floor, its rock, its furniture."""
        if session != "after" or self.changed is None:
            return self
        centreline, walls, fixed, fixtures, heaps = self.changed
        return replace(self, centreline=centreline, walls=walls, fixed=fixed, fixtures=fixtures, heaps=heaps)


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """A scenario built, but for the two scenes: rock, furniture, stones, and the props at all of their places.

    Attributes:
        centreline: The drifts.
        walls: Ray caster of the bare tunnel before any rock changes.
        fixed: Ray caster of the same tunnel with furniture and stones.
        fixtures: Furniture and stones.
        standing: Every prop at each of its places, settled on the floor before any rock changes.
        rock: The wall and the fixtures after compilation, in this order.
        around: What the props were placed in: rock and furniture without stones.
        displacement: The walls of both sessions; None where no rock changes.
        after: Centreline and bare tunnel of the after session where rock changes.
    """

    centreline: Centreline
    walls: Caster
    fixed: Caster
    fixtures: tuple[Fixture, ...]
    standing: tuple[Standing, ...]
    rock: tuple[Mesh, ...]
    around: Surroundings
    displacement: Displacement | None = None
    after: tuple[Centreline, Caster] | None = None


def build_world(scenario: Scenario, seed: int) -> World:
    """Mesh the tunnel, furnish it, set the props down and compile both sessions' scenes.

    Raises:
        ScenarioError: The tunnel cannot be meshed, or a prop does not fit, does not come to rest or falls away.
    """
    ground = lay_ground(scenario, seed)
    standing, displacement = list(ground.standing), ground.displacement
    changed, rock_after = None, ground.rock
    if displacement is not None and ground.after is not None:
        level, bare_after = ground.after
        standing = carry(standing, displacement)
        fixed_after, fixtures_after = follow_rock(displacement, bare_after, ground.fixtures)
        heaps = tuple(rubble_points(displacement, HEAP_M))
        changed = level, bare_after, fixed_after, fixtures_after, heaps
        rock_after = compile_moved(ground, displacement.walls.mesh("after"), fixtures_after)
    bodies = {item: compile_prop(item) for item in standing}
    before, after = (
        compile_scene(scenario, own, ground.fixtures, bodies, session)
        for own, session in ((ground.rock, "before"), (rock_after, "after"))
    )
    told = ground.centreline, ground.walls, ground.fixed, ground.fixtures, tuple(standing), before, after
    return World(*told, displacement, changed)


def lay_ground(scenario: Scenario, seed: int) -> Ground:
    """Mesh the tunnel, furnish it and set the props down.

    Raises:
        ScenarioError: As `build_world`; or the scenario's world is a recording.
    """
    if isinstance(scenario, GraftScenario):
        raise ScenarioError(
            f"{scenario.family}: its world is a recording: `tunnelcd simulate` makes a pair, which other commands read"
        )
    tunnel = scenario.tunnel
    centreline = build_centreline(tunnel, seed)
    require_size(scenario, centreline)
    require_memory(tunnel, centreline)
    wall = mesh_tunnel(tunnel, centreline, seed) if tunnel.mesh is None else tunnel_mesh(tunnel.mesh)
    if tunnel.mesh is not None:
        centreline = set_on_floor(centreline, Caster([wall]))
    displacement = displace(scenario, centreline, wall, seed)
    if displacement is not None:
        wall = displacement.walls.mesh("before")
    walls = Caster([wall])
    furniture = furnish(tunnel, centreline, walls, seed)
    if displacement is not None:
        furniture = leave_out_broken(furniture, displacement)
    # Compiling takes the most memory, so it is done before the other ray casters exist.
    rock = [compile_mesh(mesh) for mesh in (wall, *(fixture.mesh for fixture in furniture))]
    hung = Caster([wall, *(fixture.mesh for fixture in furniture)], onto=walls) if furniture else walls
    gap_m = WALL_GAP_M + (tunnel.resolution_m if tunnel.mesh is None else 0.0)
    around, outlines, after = Surroundings(walls, hung, gap_m), [], None
    if displacement is not None:
        after = raise_centreline(centreline, walls, displacement), Caster([displacement.walls.mesh("after")])
        hung_after, _ = follow_rock(displacement, after[1], furniture)
        around = replace(around, barred=barred_places(displacement), after=(after[0], hung_after))
        outlines = covered_outlines(displacement)
    standing = place_props(scenario, centreline, around, seed)
    outlines += [grow_rectangle(standing_corners(item), _STONE_FREE_M) for item in standing]
    stones = strew_stones(tunnel, centreline, walls, outlines, seed)
    if stones is None:
        fixtures, fixed = furniture, hung
    else:
        fixtures = (*furniture, stones)
        rock.append(compile_mesh(stones.mesh))
        fixed = Caster([wall, *(fixture.mesh for fixture in fixtures)], onto=hung)
    return Ground(centreline, walls, fixed, fixtures, tuple(standing), tuple(rock), around, displacement, after)


def follow_rock(
    displacement: Displacement, bare_after: Caster, fixtures: tuple[Fixture, ...]
) -> tuple[Caster, tuple[Fixture, ...]]:
    """Return obstacles and furniture as they are in the after session, given its bare tunnel."""
    moved = follow(fixtures, displacement)
    wall = displacement.walls.mesh("after")
    return (Caster([wall, *(fixture.mesh for fixture in moved)], onto=bare_after) if moved else bare_after), moved


def compile_moved(ground: Ground, wall: Mesh, fixtures: Sequence[Fixture]) -> tuple[Mesh, ...]:
    """Compile a wall and the fixtures that followed it; a fixture that nothing moved is compiled already."""
    pairs = zip(ground.fixtures, fixtures, ground.rock[1:], strict=True)
    return (compile_mesh(wall), *(own if old is new else compile_mesh(new.mesh) for old, new, own in pairs))


def compile_scene(
    scenario: Scenario,
    rock: Sequence[Mesh],
    fixtures: Sequence[Fixture],
    bodies: Mapping[Standing, tuple[Mesh, ...]],
    session: str,
) -> Scene:
    """Return the scene of one session: the wall, the fixtures, then every prop that stands in this session.

    Args:
        scenario: Numbers the props and says how bright the rock is.
        rock: The wall and the fixtures after compilation, see `compile_mesh`.
        fixtures: The fixtures, in the order of `rock[1:]`.
        bodies: Props at their places, of both sessions, each with its geoms, see `compile_prop`.
        session: "before" or "after".
    """
    shares = REFLECTIVITY | {"rock": scenario.tunnel.reflectivity}  # loose stones were blasted from the walls
    numbers = {prop.name: number for number, prop in enumerate(scenario.props, start=1)}
    parts, materials = [WALL, *(each.name for each in fixtures)], ["rock", *(each.material for each in fixtures)]
    instance, reflectivity = [0] * len(rock), [shares[material] for material in materials]
    here = [item for item in bodies if session in item.sessions]
    for item in here:
        for solid in item.shape.solids:
            parts.append(item.prop.name)
            instance.append(numbers[item.prop.name])
            reflectivity.append(item.prop.reflectivity or shares[solid.material])
            materials.append(solid.material)
    meshes = (*rock, *(mesh for item in here for mesh in bodies[item]))
    return Scene(
        meshes,
        Caster(meshes),
        np.array(instance, np.int32),
        np.array(reflectivity, np.float32),
        tuple(parts),
        tuple(materials),
    )


def compile_mesh(mesh: Mesh) -> Mesh:
    """Return a fixed mesh after MuJoCo compiled it, world frame: float32 vertices relative to the mesh's centre."""
    return model_meshes(*compile_model([mesh], []))[0]


def compile_prop(item: Standing) -> tuple[Mesh, ...]:
    """Return the geoms of a prop at its place after MuJoCo compiled it, world frame."""
    return tuple(model_meshes(*compile_model([], [item])))


def compile_model(fixed: Iterable[Mesh], standing: Iterable[Standing]) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Compile a static model and compute its poses: one geom for each fixed mesh, then the geoms of every prop.

    A compiled geom does not depend, to the bit, on the other geoms of the model.
    """
    spec = mujoco.MjSpec()
    for number, mesh in enumerate(fixed):
        name = f"fixed/{number}"
        add_mesh(spec, name, mesh)
        spec.worldbody.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, contype=0, conaffinity=0)
    for item in standing:
        pose = item.world_T_object
        body = spec.worldbody.add_body(name=f"prop/{item.prop.name}", pos=pose[:3, 3], quat=quaternion(pose))
        for index, solid in enumerate(item.shape.solids):
            add_solid(spec, body, solid, f"prop/{item.prop.name}/{index}", contype=0, conaffinity=0)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data
