"""Placing of all props of a scenario: first those with a given place, then those whose place the seed draws."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, make_pose, stream, yaw_pose
from scenarios.schema import Place, Prop, Scenario
from sim.placement.fitting import Spot, place_prop
from sim.placement.lanes import Lane, build_lanes
from sim.placement.placing import (
    Standing,
    Surroundings,
    bounding_rectangle,
    grow_rectangle,
    rectangles_overlap,
    standing_corners,
    standing_middle,
)
from sim.placement.settling import settle
from sim.placement.stations import PLACE_TRIES, Stations, draw_areas, drawn_spots, given_spot, way
from sim.props.props import shape_of
from sim.props.shapes import Shape
from sim.rock.centreline import Centreline

# Between a drawn prop and its neighbours.
_BETWEEN_M = 0.15
# A prop that does not come to rest is tried at this many drawn places.
_DROPS = 8
_BEFORE, _AFTER = frozenset(("before",)), frozenset(("after",))
_BOTH = _BEFORE | _AFTER
Outline = Callable[[Standing], Float64Array]


@dataclass(slots=True, eq=False)
class _Board:
    """The tunnel, the props placed so far, and for each lane the offsets that each of them blocks."""

    scenario: Scenario
    centreline: Centreline
    around: Surroundings
    seed: int
    lanes: tuple[Lane, ...]
    standing: list[Standing] = field(default_factory=list)
    taken: list[list[Float64Array]] = field(default_factory=list)

    def add(self, items: Sequence[Standing]) -> None:
        self.standing.extend(items)
        self.taken.extend([lane.taken_by(item) for lane in self.lanes] for item in items)

    def clash(
        self, items: Sequence[Standing], apart_m: float, outline: Outline = standing_corners
    ) -> tuple[str, str, str] | None:
        """Return the first placed prop within `apart_m` of one of the items, that item, and the session."""
        for item in items:
            corners = grow_rectangle(outline(item), apart_m)
            for other in self.standing:
                shared = item.sessions & other.sessions
                if shared and rectangles_overlap(corners, outline(other)):
                    return other.prop.name, item.prop.name, max(shared)
        return None

    def barred_by(self, items: Sequence[Standing]) -> str | None:
        """Return the surface change in whose place one of the items would stand; None if there is none."""
        for item in items:
            may_ride = item.posture == "upright" and item.shape.is_settled
            for place in self.around.barred:
                if not (may_ride and place.may_be_carried) and rectangles_overlap(
                    standing_corners(item), place.corners
                ):
                    return place.name
        return None

    def is_passable(self, items: Sequence[Standing]) -> bool:
        return all(
            lane.is_open([*(each[number] for each in self.taken), lane.taken_by(item)])
            for item in items
            for number, lane in enumerate(self.lanes)
        )


def place_props(scenario: Scenario, centreline: Centreline, around: Surroundings, seed: int) -> list[Standing]:
    """Return every prop at rest at each of its places, in the scenario's order; a moved or reshaped one appears twice.

    Props with a given place come first. A drawn place is drawn again until the prop fits between the walls, stands
    clear of the others, leaves the robot a way and comes to rest. There are 80 tries, 80 at the opposite wall, and for
    a place in an area 160 more on a stretch three times as long. A leaning prop gets 160 further tries at places where
    humps of the floor hide a part of the wall. The draws of one prop do not depend on other props.

    Raises:
        ScenarioError: A prop does not fit, stands in another, does not come to rest, or finds no place.
    """
    board = _Board(scenario, centreline, around, seed, build_lanes(scenario, centreline, around.fixed, around.after))
    areas = draw_areas(scenario, centreline, seed)
    anywhere = way(scenario, centreline)
    found: dict[tuple[str, bool], list[Standing]] = {}
    jobs = list(chain.from_iterable(_jobs(prop, seed) for prop in scenario.props))
    spots = [given_spot(job.place, scenario, centreline) for job in jobs]
    for job, spot in zip(jobs, spots, strict=True):
        if spot is not None:
            found[job.key] = _set_down(job, spot, board)
            board.add(found[job.key])
    for job, spot in zip(jobs, spots, strict=True):
        if spot is None:
            stretches = (anywhere,) if job.place.area is None else areas[job.place.area]
            found[job.key] = _find_place(job, stretches, board)
            board.add(found[job.key])
    return [aged for job in jobs for item in found[job.key] for aged in age(item)]


def age(item: Standing) -> list[Standing]:
    """Return a prop at rest; one that ages, as it stands in either session."""
    aged = item.prop.aged
    if aged is None:
        return [item]
    if item.posture == "upright":
        turned = make_pose(Rotation.from_euler("ZX", [aged.turn_deg, aged.lean_deg], degrees=True).as_matrix())
        pose = item.world_T_object @ turned
    else:  # its own z axis lies
        upright = yaw_pose(np.deg2rad(aged.turn_deg), standing_middle(item))
        leant = make_pose(Rotation.from_euler("X", aged.lean_deg, degrees=True).as_matrix())
        pose = upright @ yaw_pose(0.0, -standing_middle(item)) @ item.world_T_object @ leant
    heading = np.deg2rad(aged.heading_deg)
    pose[:3, 3] += (aged.shift_m * np.cos(heading), aged.shift_m * np.sin(heading), -aged.sag_m)
    return [replace(item, sessions=_BEFORE), replace(item, sessions=_AFTER, world_T_object=pose)]


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """A prop for one of its places, and the rest of it in the after session if it is reshaped."""

    prop: Prop
    place: Place
    sessions: frozenset[str]
    shape: Shape
    rest: Shape | None = None
    is_goal: bool = False

    @property
    def key(self) -> tuple[str, bool]:
        return self.prop.name, self.is_goal


def _jobs(prop: Prop, seed: int) -> list[_Job]:
    sessions = {"none": _BOTH, "added": _AFTER}.get(prop.change, _BEFORE)
    is_banked, share = _is_banked(prop, prop.place), prop.loaded_share
    rest = None if share is None else shape_of(prop, seed, is_banked=is_banked, loaded_share=share)
    jobs = [_Job(prop, prop.place, sessions, shape_of(prop, seed, is_banked=is_banked), rest)]
    if prop.to is not None:
        shape = shape_of(prop, seed, is_banked=_is_banked(prop, prop.to))
        jobs.append(_Job(prop, prop.to, _AFTER, shape, is_goal=True))
    return jobs


def _is_banked(prop: Prop, place: Place) -> bool:
    return place.posture == "leaning" and prop.kind == "muck_pile"


def _at_spot(job: _Job, spot: Spot, board: _Board) -> list[Standing]:
    """Return the prop before it settles; with a short shift or reshaped, also as it stands after."""
    prop, place, shape = job.prop, job.place, job.shape
    pose, wall = place_prop(prop, shape, place, spot, board.around, board.seed)
    items = [Standing(prop, shape, job.sessions, pose, place.posture, wall)]
    if job.rest is not None:
        items.append(replace(items[0], shape=job.rest, sessions=_AFTER))
    if prop.shift is not None:
        heading = np.arctan2(spot.heading[1], spot.heading[0]) + np.deg2rad(prop.shift.heading_deg)
        way_m = prop.shift.distance_m * np.array([np.cos(heading), np.sin(heading)])
        moved = np.append(way_m, np.deg2rad(prop.shift.turn_deg))
        pose, wall = place_prop(prop, shape, place, spot, board.around, board.seed, moved)
        items.append(Standing(prop, shape, _AFTER, pose, place.posture, wall))
    return items


def _set_down(job: _Job, spot: Spot, board: _Board) -> list[Standing]:
    items = _at_spot(job, spot, board)
    _refuse_overlap(items, board)
    rested = [settle(item, board.around) for item in items]
    _refuse_overlap([item for item in rested if item.posture != "upright"], board)
    if why := _touching(rested, board):
        raise ScenarioError(f"prop {job.prop.name!r} cannot come to rest there: {why}: set them farther apart")
    return rested


def _refuse_overlap(items: Sequence[Standing], board: _Board) -> None:
    if clash := board.clash(items, 0.0):
        raise ScenarioError(
            f"props {clash[0]!r} and {clash[1]!r} stand in one another in the {clash[2]} session: "
            "give one another fraction or lateral"
        )
    if name := board.barred_by(items):
        raise ScenarioError(
            f"prop {items[0].prop.name!r} stands where surface {name!r} changes the rock: give one another place"
        )


def _find_place(job: _Job, stretches: Sequence[Stations], board: _Board) -> list[Standing]:
    where = "on the way of the sessions" if job.place.area is None else f"in area {job.place.area!r}"
    if len(stretches[0]) == 0:
        raise ScenarioError(f"prop {job.prop.name!r}: a mesh without drifts has no stations to draw: give `place.at`")
    opposite = replace(job, place=job.place.model_copy(update={"lateral": -job.place.lateral}))
    rounds = [(stations, wanted, False) for stations in stretches for wanted in (job, opposite)]
    if job.place.posture == "leaning":
        rounds += [(stretches[-1], wanted, True) for wanted in (job, opposite)]
    if job.prop.kind == "rock" and job.place.posture == "upright":  # it may have no face to stand on that way
        lying = [replace(each, place=each.place.model_copy(update={"posture": "tipped"})) for each in (job, opposite)]
        rounds += [(stretches[-1], wanted, False) for wanted in lying]
    why = ""
    for number, (stations, wanted, over_humps) in enumerate(rounds):
        purpose = ("to" if job.is_goal else "place") + (f"-{number}" if number else "")
        purposes = ("props", job.prop.name, purpose)
        spots = drawn_spots(stream(board.seed, *purposes), stations, board.scenario, board.centreline, over_humps)
        items, why = _first_fit(wanted, spots, board)
        if items:
            return items
    n_tries = len(rounds) * PLACE_TRIES
    raise ScenarioError(
        f"prop {job.prop.name!r} finds no place {where} in {n_tries} tries, at the last because {why}: "
        "make it smaller, give it another lateral, or place fewer props"
    )


def _first_fit(job: _Job, spots: Iterable[Spot], board: _Board) -> tuple[list[Standing], str]:
    """Return the prop at rest at the first suitable spot, or an empty list and why the last spot failed."""
    why, drops = "every one lies in the mouth of a junction", 0
    for spot in spots:
        try:
            items = _at_spot(job, spot, board)
            why = _clash(items, board)
            if why:
                continue
            drops += 1
            items = [settle(item, board.around) for item in items]
            why = _clash([item for item in items if item.posture != "upright"], board) or _touching(items, board)
            if not why:
                return items, ""
        except ScenarioError as error:
            why = str(error)
        if drops >= _DROPS:
            break
    return [], why


def _touching(items: Sequence[Standing], board: _Board) -> str:
    """Return which prop a prop at rest collides with after tilting on its floor; "" if none."""
    clash = board.clash(items, 0.0, bounding_rectangle)
    return f"prop {clash[0]!r} is in the way" if clash else ""


def _clash(items: Sequence[Standing], board: _Board) -> str:
    if clash := board.clash(items, _BETWEEN_M):
        return f"prop {clash[0]!r} stands there"
    if name := board.barred_by(items):
        return f"surface {name!r} changes the rock there"
    return "" if board.is_passable(items) else "the robot could not get by"
