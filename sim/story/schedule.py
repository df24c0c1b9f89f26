"""The states of a story: which prop stands where in which session, and how far rock has crept by then."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from cdpipe.core.errors import InputWarning
from cdpipe.core.geometry import Float64Array, stream
from scenarios.schema import Prop, Scenario
from sim.displacement.growth import CREEPING
from sim.placement.lanes import LANE_STEP_M, SPARE_M, Lane, build_lanes
from sim.placement.placing import Standing, bounding_rectangle, grow_rectangle, rectangles_overlap
from sim.scene import Ground
from sim.story.state import SessionState, Where, changing_props, name_session, possible_places

_TRIES = 40
_APART_M = 0.05
_LEAST_STEP = 0.3  # a creep's step is this much, and up to 1 more, before all are scaled to end at 1


def draw_states(scenario: Scenario, ground: Ground, seed: int, n_sessions: int) -> tuple[SessionState, ...]:
    """Draw the states of a story of N sessions.

    Session 1 is the scenario's before session and session N its after session. Between them a prop that is added,
    removed or moved is drawn anew for each session: present or absent, at either of its places. A pile is loaded away,
    and a prop ages, at one session. Convergence, heave and fill grow in every session; other rock changes at one.

    A session in which two props would stand in each other, or bar the way, is drawn again, up to 40 times. If none
    fits, props that come, go or move are as in the scenario's before session, it takes that drive, and a warning tells
    it. The way is barred where the gap is less than what the placing of props keeps free and less than what the first
    and the last session leave there.

    Args:
        scenario: The scenario as drawn.
        ground: Its props at all of their places.
        seed: Seed of the draws, which also depend on N.
        n_sessions: N.
    """
    shares = _draw_shares(scenario, seed, n_sessions)
    fixed = {prop.name: _draw_turn(prop, seed, n_sessions) for prop in changing_props(scenario) if _happens_once(prop)}
    steps = [{name: each[number] for name, each in shares.items()} for number in range(n_sessions)]
    first = _end_state(scenario, 1, steps[0], is_first=True)
    last = _end_state(scenario, n_sessions, steps[-1], is_first=False)
    ways = _measure_ways(scenario, ground, first, last)
    states = [first]
    for number in range(2, n_sessions):
        once: dict[str, Where] = {name: "before" if number < turn else "after" for name, turn in fixed.items()}
        states.append(_draw_state(scenario, ground, ways, (seed, n_sessions, number), steps[number - 1], once))
    return (*states, last)


def stands_in(item: Standing, state: SessionState) -> bool:
    """Tell whether a prop stands at one of its places in a session."""
    if len(item.sessions) > 1:
        return True
    return state.places[item.prop.name] in item.sessions


def _happens_once(prop: Prop) -> bool:
    return prop.change == "reshaped" or prop.aged is not None


def _end_state(scenario: Scenario, number: int, shares: dict[str, float], *, is_first: bool) -> SessionState:
    places: dict[str, Where] = {}
    for prop in changing_props(scenario):
        missing = "added" if is_first else "removed"
        places[prop.name] = "absent" if prop.change == missing else "before" if is_first else "after"
    return SessionState(name=name_session(number), plan="before" if is_first else "after", places=places, shares=shares)


def _draw_state(
    scenario: Scenario,
    ground: Ground,
    ways: Sequence[_Way],
    key: tuple[int, int, int],
    shares: dict[str, float],
    once: Mapping[str, Where],
) -> SessionState:
    """Return the state of a session between the first and the last; the key is the seed, N and its number."""
    seed, n_sessions, number = key
    name = name_session(number)
    purpose = "story", str(n_sessions), name
    free = [prop for prop in changing_props(scenario) if prop.name not in once]
    is_early = bool(stream(seed, *purpose, "plan").random() < 0.5)
    for attempt in range(_TRIES):
        places: dict[str, Where] = dict(once)
        for prop in free:
            choices = possible_places(prop)
            drawn = stream(seed, *purpose, "prop", prop.name, str(attempt)).random()
            places[prop.name] = choices[int(drawn * len(choices))]
        state = SessionState(name=name, plan="before" if is_early else "after", places=places, shares=shares)
        if _has_room([item for item in ground.standing if stands_in(item, state)], ways, state):
            return state
    warnings.warn(
        f"{name}: in {_TRIES} draws its props stood in one another or barred the way: those that come, go or move are "
        "as in the before session: set them farther apart, or lower platform.clearance_m",
        InputWarning,
        stacklevel=3,
    )
    first = _end_state(scenario, number, shares, is_first=True)
    return first.model_copy(update={"places": first.places | dict(once)})


def _has_room(standing: Sequence[Standing], ways: Sequence[_Way], state: SessionState) -> bool:
    """Tell whether no prop stands in another one, and the robot gets by."""
    outlines = {id(item): bounding_rectangle(item) for item in standing}
    for one, other in combinations(standing, 2):
        # those that share a session of the scenario were placed clear of each other
        if not one.sessions & other.sessions and rectangles_overlap(
            grow_rectangle(outlines[id(one)], _APART_M), outlines[id(other)]
        ):
            return False
    own = [way for way in ways if way.lane.session == state.plan]
    return all((_gaps_m(way.lane, standing) >= way.needed_m).all() for way in own)


@dataclass(frozen=True, slots=True, eq=False)
class _Way:
    """A lane, and the gap (N,) that props are to leave at each of its stations."""

    lane: Lane
    needed_m: Float64Array


def _measure_ways(scenario: Scenario, ground: Ground, first: SessionState, last: SessionState) -> list[_Way]:
    """Return the lanes of both drives on the rock of either session; the first and the last state are known to fit.

    The placing of props tests no lane for those at given places: the drive through them shows that a robot gets by.
    """
    lanes = build_lanes(scenario, ground.centreline, ground.around.fixed)
    if ground.around.after is not None:
        lanes += build_lanes(scenario, *ground.around.after)
    driven = []
    for lane, state in ((lanes[0], first), (lanes[-1], last)):
        gaps_m = _gaps_m(lane, [item for item in ground.standing if stands_in(item, state)])
        driven += [(lane, point, gap_m) for point, gap_m in zip(lane.points, gaps_m, strict=True) if gap_m < SPARE_M]
    ways = [_Way(lane, np.full(len(lane.points), SPARE_M)) for lane in lanes]
    for way in ways:
        for lane, point, gap_m in driven:
            if way.lane.clearance_m <= lane.clearance_m:
                is_near = np.linalg.norm(way.lane.points - point, axis=1) < LANE_STEP_M
                way.needed_m[is_near] = np.minimum(way.needed_m[is_near], gap_m)
    return ways


def _gaps_m(lane: Lane, standing: Sequence[Standing]) -> Float64Array:
    """Return the gap (N,) that props leave at each station of a lane; infinite where they block nothing."""
    gaps_m = np.full(len(lane.points), np.inf)
    if standing:
        taken = [lane.taken_by(replace(item, sessions=frozenset({"before", "after"}))) for item in standing]
        is_barred = np.asarray(np.isfinite(np.stack(taken)[:, :, 0]).any(axis=0))
        gaps_m[is_barred] = lane.gaps_m(taken, is_barred)
    return gaps_m


def _draw_shares(scenario: Scenario, seed: int, n_sessions: int) -> dict[str, list[float]]:
    """Return how much of each surface change has happened in each session."""
    found = {}
    for change in scenario.surface:
        generator = stream(seed, "story", str(n_sessions), "surface", change.name)
        if change.kind in CREEPING:
            grown = np.cumsum(_LEAST_STEP + generator.random(n_sessions - 1))
            found[change.name] = [0.0, *(grown[:-1] / grown[-1]).tolist(), 1.0]
        else:
            turn = int(generator.integers(2, n_sessions + 1))
            found[change.name] = [float(number >= turn) for number in range(1, n_sessions + 1)]
    return found


def _draw_turn(prop: Prop, seed: int, n_sessions: int) -> int:
    """Return the session, 1-based, from which a prop is as in the scenario's after session."""
    return int(stream(seed, "story", str(n_sessions), "turn", prop.name).integers(2, n_sessions + 1))
