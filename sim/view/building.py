"""The world, the drives, the movers and the puddles of a view, built again from a scenario and its seed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from cdpipe.core.errors import InputError, ScenarioError
from scenarios.schema import Scenario
from sim.drive.trajectory import Trajectory, load_sensor, plan_trajectory
from sim.movers.mover import MovingBody
from sim.movers.planning import plan_movers
from sim.placement.puddles import Pool, lay_puddles
from sim.scene import World, build_world
from sim.session.truth import SESSIONS, PairTruth, SessionName
from sim.story.pairs import rebuild_pair


def plan_drives(world: World, scenario: Scenario, seed: int) -> tuple[dict[SessionName, Trajectory], list[str]]:
    """Return the drive of each session, and a note for one that cannot be driven."""
    drives: dict[SessionName, Trajectory] = {}
    notes = []
    for session in SESSIONS:
        try:
            drives[session] = plan_trajectory(world, scenario, load_sensor(scenario, session), seed, session)
        except ScenarioError as error:
            notes.append(f"no path {session}: {error}")
    return drives, notes


@dataclass(frozen=True, slots=True, eq=False)
class PlacedMover:
    """A mover of a session at one time of it."""

    session: SessionName
    time_s: float
    body: MovingBody

    @property
    def name(self) -> str:
        """The name of its group."""
        return f"movers/{self.session}/{self.body.mover.name}"


def place_movers(
    world: World, scenario: Scenario, drives: Mapping[SessionName, Trajectory], seed: int
) -> list[PlacedMover]:
    """Return the movers of each session that is driven, in the middle of its drive."""
    planned = plan_movers(world, scenario, {name: drive.true for name, drive in drives.items()}, seed)
    return [PlacedMover(name, _middle_s(drives[name]), body) for name, bodies in planned.items() for body in bodies]


def _middle_s(drive: Trajectory) -> float:
    return float(drive.revolution_s[drive.n_scans // 2])


def list_pools(world: World, scenario: Scenario, seed: int) -> dict[str, Pool]:
    """Return every puddle by its name; the name of one says the session where the other has none, or another floor.

    Raises:
        ScenarioError: There is no floor under a puddle.
    """
    found: dict[str, Pool] = {}
    for session in SESSIONS:
        for pool in lay_puddles(scenario, world.centreline, world.of(session).walls, session, seed):
            is_alike = pool.puddle.sessions == "both" and not scenario.surface
            found[pool.puddle.name if is_alike else f"{pool.puddle.name} ({session})"] = pool
    return found


@dataclass(frozen=True, slots=True, eq=False)
class BuiltPair:
    """A simulated pair, built again.

    Attributes:
        world: Its world.
        drives: The drives of its sessions; empty where nothing moves in them.
        movers: Its movers.
        pools: Its puddles by name.
    """

    world: World
    drives: dict[SessionName, Trajectory]
    movers: list[PlacedMover]
    pools: dict[str, Pool]


def build_pair(pair: Path, truth: PairTruth) -> BuiltPair:
    """Build a pair again from its truth.

    Raises:
        InputError: Its scenario is not one of this version.
        ScenarioError: Its world cannot be built.
    """
    if truth.story is not None:
        return _build_story_pair(pair, truth)
    scenario = _scenario_of(pair, truth)
    world = build_world(scenario, truth.seed)
    drives = plan_drives(world, scenario, truth.seed)[0] if scenario.movers else {}
    movers = place_movers(world, scenario, drives, truth.seed)
    return BuiltPair(world, drives, movers, list_pools(world, scenario, truth.seed))


def _build_story_pair(pair: Path, truth: PairTruth) -> BuiltPair:
    try:
        world, planned = rebuild_pair(truth)
    except ScenarioError:
        raise
    except InputError as error:
        raise InputError(f"{pair / 'truth' / 'changes.json'}: {error}: view its sessions one by one") from error
    named = list(zip(SESSIONS, planned, strict=True))
    drives = {name: session.trajectory for name, session in named}
    movers = [PlacedMover(name, _middle_s(drives[name]), body) for name, session in named for body in session.movers]
    return BuiltPair(world, drives, movers, {pool.puddle.name: pool for session in planned for pool in session.pools})


def _scenario_of(pair: Path, truth: PairTruth) -> Scenario:
    try:
        return Scenario.model_validate(truth.scenario)
    except ValidationError as error:
        raise InputError(
            f"{pair / 'truth' / 'changes.json'}: its scenario is not one of this version "
            f"({error.errors()[0]['msg']}): simulate the pair again, or view its sessions one by one"
        ) from error
