"""What stays the same while a session is simulated: both drives of a pair, planned in its world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cdpipe.sensor.ouster import SensorMetadata
from scenarios.schema import Scenario
from sim.drive.trajectory import Trajectory, load_sensor, plan_trajectory
from sim.geometry.backends import make_sensor_caster
from sim.movers.casting import MovingScene
from sim.movers.mover import MovingBody
from sim.movers.planning import plan_movers
from sim.placement.puddles import Pool, lay_puddles
from sim.scene import Scene, World, build_world
from sim.sensor.glass import Panes
from sim.sensor.optics import as_white
from sim.sensor.water import Water
from sim.session.labels import Tally, list_changes
from sim.session.revolution import Drive
from sim.session.surface import MovedRock, list_surface_changes
from sim.session.truth import SESSIONS, SessionName, SurfaceChangeTruth


@dataclass(frozen=True, slots=True, eq=False)
class PlannedSession:
    """A session whose drive is planned; nothing in it depends on the other session of a pair.

    Attributes:
        scenario: The scenario, with the sensor and the platform of this session.
        scene: Its surfaces.
        sensor: Its sensor.
        trajectory: Its drive.
        movers: What moves in it.
        pools: Its puddles.
        seed: Draws its noise.
        own_name: As in `Drive`.
    """

    scenario: Scenario
    scene: Scene
    sensor: SensorMetadata
    trajectory: Trajectory
    movers: tuple[MovingBody, ...]
    pools: tuple[Pool, ...]
    seed: int
    own_name: str = ""


def plan_drives(scenario: Scenario, seed: int, sensor: SensorMetadata | None = None) -> list[Drive]:
    """Build the world and plan both sessions; only the parts of the world that they need stay in memory.

    Args:
        scenario: The scenario as drawn.
        seed: Draws everything the scenario leaves open.
        sensor: The sensor of both sessions in place of the scenario's.

    Raises:
        InputError: A trajectory cannot be read.
        ScenarioError: The world contradicts itself, or a mover finds no way.
    """
    return plan_drives_in(build_world(scenario, seed), scenario, seed, sensor)


def plan_drives_in(world: World, scenario: Scenario, seed: int, sensor: SensorMetadata | None = None) -> list[Drive]:
    """Plan both sessions in their world, see `plan_drives`."""
    sensors = {name: sensor or load_sensor(scenario, name) for name in SESSIONS}
    tallies = list_changes(scenario, world)
    trajectories = {name: plan_trajectory(world, scenario, sensors[name], seed, name) for name in SESSIONS}
    movers = plan_movers(world, scenario, {name: each.true for name, each in trajectories.items()}, seed)
    planned = []
    for name, scene in zip(SESSIONS, (world.before, world.after), strict=True):
        pools = lay_puddles(scenario, world.centreline, world.of(name).walls, name, seed)
        told = scenario.of(name), scene, sensors[name], trajectories[name], movers[name], pools, seed
        planned.append(PlannedSession(*told))
    return pair_drives(world, planned, tallies)


def pair_drives(world: World, planned: Sequence[PlannedSession], tallies: Sequence[Tally]) -> list[Drive]:
    """Return the drives of a pair's two sessions, before first.

    Args:
        world: The world of the pair.
        planned: Its two sessions, before first.
        tallies: The changes between them.
    """
    rocks: dict[SessionName, MovedRock] = {}
    surface_changes: tuple[SurfaceChangeTruth, ...] = ()
    if world.displacement is not None:
        rocks = {name: MovedRock(world, world.displacement, name) for name in SESSIONS}
        surface_changes = list_surface_changes(world, world.displacement, rocks["before"])
    return [
        make_drive(name, session, tuple(tallies), rocks.get(name), surface_changes)
        for name, session in zip(SESSIONS, planned, strict=True)
    ]


def make_drive(
    name: SessionName,
    planned: PlannedSession,
    tallies: tuple[Tally, ...] = (),
    rock: MovedRock | None = None,
    surface_changes: tuple[SurfaceChangeTruth, ...] = (),
) -> Drive:
    """Return the drive of a session in its part of a pair; without tallies and rock it is a session alone."""
    scene, trajectory, own = planned.scene, planned.trajectory, planned.scenario
    moving = MovingScene(scene, planned.movers, make_sensor_caster(own.sim.backend, scene.meshes, scene.caster))
    labels = np.append(moving.instance, [-5, -4, -3, -2, -1]).astype(np.int16)
    held = [tally.change.instance for tally in tallies if tally.change.session == name]
    owners = np.where(np.isin(moving.instance, held), moving.instance, np.int32(0))
    seen = np.zeros((len(moving.movers), trajectory.n_scans, 4))
    diffuse = as_white(scene.reflectivity)
    water = Water(planned.pools, scene.caster, diffuse) if planned.pools else None
    is_glass = np.array(scene.materials) == "glass"
    panes = Panes(scene.caster, diffuse, owners, is_glass) if own.sensor.glass and is_glass.any() else None
    told = labels, owners, planned.sensor, trajectory, tallies, planned.seed, moving, seen, water, panes
    return Drive(name, own, scene, *told, rock, surface_changes, planned.own_name)
