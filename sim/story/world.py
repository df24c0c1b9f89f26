"""The world of one session of a story, and of two sessions as a pair."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TypeVar

import numpy as np

from scenarios.schema import Mover, Prop, Puddle, Scenario, SessionPlan
from sim.displacement.displace import Displacement
from sim.displacement.follow import carry, raise_centreline, rubble_points
from sim.displacement.growth import displace_between
from sim.drive.trajectory import load_sensor, plan_trajectory
from sim.geometry.raycast import Caster
from sim.movers.planning import plan_movers
from sim.placement.placing import Standing
from sim.placement.puddles import lay_puddles
from sim.rock.centreline import Centreline
from sim.scene import HEAP_M, Ground, Heaps, World, compile_moved, compile_prop, compile_scene, follow_rock
from sim.session.planning import PlannedSession
from sim.story.schedule import stands_in
from sim.story.state import SessionState

_BEFORE, _AFTER = frozenset({"before"}), frozenset({"after"})
Part = TypeVar("Part", Mover, Puddle)


class OneSession(Scenario):
    """A scenario as one session of a story has it: every session that it is asked for takes the same drive."""

    own: SessionPlan

    def plan(self, session: str) -> SessionPlan:
        """Return the drive."""
        return self.own


def build_session_world(scenario: Scenario, ground: Ground, state: SessionState) -> World:
    """Return the world of one session; `before` and `after` are both its scene.

    Args:
        scenario: The scenario as drawn.
        ground: What is laid.
        state: The session's state.
    """
    items = [replace(item, sessions=_AFTER) for item in ground.standing if stands_in(item, state)]
    told, rock = (ground.centreline, ground.walls, ground.fixed, ground.fixtures), ground.rock
    heaps: Heaps = ()
    moved = _displace_to(ground, state)
    if moved is not None:
        wall = moved.walls.mesh("after")
        bare = Caster([wall])
        level = raise_centreline(ground.centreline, ground.walls, moved)
        told = level, bare, *follow_rock(moved, bare, ground.fixtures)
        items, rock = carry(items, moved), compile_moved(ground, wall, told[3])
        heaps = tuple(rubble_points(moved, HEAP_M))
    scene = compile_scene(scenario, rock, told[3], {item: compile_prop(item) for item in items}, "after")
    here = tuple(replace(item, sessions=frozenset({state.name})) for item in items)
    return World(*told, here, scene, scene, heaps=heaps)


def _displace_to(ground: Ground, state: SessionState) -> Displacement | None:
    if ground.displacement is None:
        return None
    return displace_between(ground.displacement, dict.fromkeys(state.shares, 0.0), state.shares)


def plan_session(scenario: Scenario, ground: Ground, world: World, state: SessionState, seed: int) -> PlannedSession:
    """Plan the drive of one session; its own name keys every draw.

    Raises:
        InputError: The sensor profile or a trajectory cannot be read.
        ScenarioError: The drive or a mover finds no way.
    """
    return plan_alone(scenario, ground.centreline, world, (state.name, state.plan), seed)


def plan_alone(
    scenario: Scenario, centreline: Centreline, world: World, session: tuple[str, str], seed: int
) -> PlannedSession:
    """Plan the drive of a session under a name of its own, which keys every draw.

    Args:
        scenario: The scenario as drawn.
        centreline: The drifts, by which puddles are laid.
        world: The session's world; both of its scenes are the session's.
        session: Its name, and the session of the scenario whose drive it takes.
        seed: Draws everything the scenario leaves open.

    Raises:
        InputError: The sensor profile or a trajectory cannot be read.
        ScenarioError: The drive or a mover finds no way.
    """
    name, plan = session
    values = {field: getattr(scenario, field) for field in Scenario.model_fields}
    for part in ("movers", "puddles"):
        values[part] = tuple(_give(item, plan) for item in values[part])
    own = OneSession.model_construct(**values, own=scenario.plan(plan))
    sensor = load_sensor(own, name)
    trajectory = plan_trajectory(world, own, sensor, seed, name)
    movers = plan_movers(world, own, {name: trajectory.true}, seed)[name]
    pools = lay_puddles(own, centreline, world.walls, name, seed)
    return PlannedSession(own.of(name), world.before, sensor, trajectory, movers, pools, seed, name)


def _give(item: Part, plan: str) -> Part:
    """Return a mover or puddle; one that the scenario gives to the session with this plan alone is there."""
    return item.model_copy(update={"sessions": "both"}) if item.sessions == plan else item


def pair_worlds(
    scenario: Scenario, ground: Ground, states: tuple[SessionState, SessionState], worlds: tuple[World, World]
) -> tuple[Scenario, World]:
    """Return two sessions of a story as a scenario and a world of two sessions, before first.

    Args:
        scenario: The scenario as drawn.
        ground: What is laid.
        states: The states of both sessions.
        worlds: Their worlds.
    """
    paired = pair_scenario(scenario, *states)
    moved = None
    if ground.displacement is not None:
        moved = displace_between(ground.displacement, states[0].shares, states[1].shares)
    before, after = worlds
    told = before.centreline, before.walls, before.fixed, before.fixtures
    changed = after.centreline, after.walls, after.fixed, after.fixtures, after.heaps
    standing = tuple(_join_standing(paired, before, after))
    world = World(*told, standing, before.before, after.before, moved, None if moved is None else changed)
    return paired, replace(world, heaps=before.heaps)


def _join_standing(paired: Scenario, before: World, after: World) -> Iterator[Standing]:
    """Yield the props of both sessions in the order of the scenario; one that stands in both as it is appears once."""
    for prop in paired.props:
        pair = [[item for item in world.standing if item.prop.name == prop.name] for world in (before, after)]
        for start in pair[0]:
            twins = [end for end in pair[1] if _stands_alike(start, end)]
            pair[1] = [end for end in pair[1] if end not in twins]
            yield replace(start, prop=prop, sessions=_BEFORE | _AFTER if twins else _BEFORE)
        for end in pair[1]:
            yield replace(end, prop=prop, sessions=_AFTER)


def _stands_alike(one: Standing, other: Standing) -> bool:
    return one.shape is other.shape and np.array_equal(one.world_T_object, other.world_T_object)


def pair_scenario(scenario: Scenario, before: SessionState, after: SessionState) -> Scenario:
    """Return the scenario of two sessions of a story: their drives, and what changes between them.

    A prop that stands in neither session keeps its place in the list, which numbers the instances.
    """
    parts = {
        part: tuple(_share(item, before.plan, after.plan) for item in getattr(scenario, part))
        for part in ("movers", "puddles")
    }
    surface = [each for each in scenario.surface if before.shares[each.name] != after.shares[each.name]]
    told = {"before": scenario.plan(before.plan), "after": scenario.plan(after.plan), "surface": tuple(surface)}
    props = tuple(_change(prop, before, after) for prop in scenario.props)
    return scenario.model_copy(update={**told, **parts, "props": props})


def _share(item: Part, before: str, after: str) -> Part:
    """Return a mover or puddle with the sessions of the pair in which it is."""
    is_here = [item.sessions in ("both", plan) for plan in (before, after)]
    if not any(is_here):
        return item
    return item.model_copy(update={"sessions": "both" if all(is_here) else "before" if is_here[0] else "after"})


def _change(prop: Prop, before: SessionState, after: SessionState) -> Prop:
    """Return a prop with what happens to it between two sessions."""
    start, end = before.places.get(prop.name, "before"), after.places.get(prop.name, "before")
    if start == end == "absent" or (prop.aged is not None and start != end):
        return prop
    places = {"before": prop.place, "after": prop.to or prop.place}
    still = {"change": "none", "to": None, "shift": None, "aged": None, "loaded_share": None}
    if start == end:
        return prop.model_copy(update=still | {"place": places[start]})
    if start == "absent":
        return prop.model_copy(update=still | {"change": "added", "place": places[end]})
    if end == "absent":
        return prop.model_copy(update=still | {"change": "removed", "place": places[start]})
    if prop.change != "moved" or prop.to is None:
        return prop
    return prop.model_copy(update={"place": places[start], "to": places[end]})
