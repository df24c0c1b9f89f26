"""Where grafted props stand: on the recorded floor, clear of the path, of what was recorded there and of each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, make_pose, stream
from scenarios.grafted import GraftScenario
from scenarios.schema import Place, Prop
from sim.graft.surroundings import Floor, Surroundings, in_object_frame
from sim.placement.arranging import age
from sim.placement.placing import Standing, grow_rectangle, rectangles_overlap, standing_corners
from sim.props.props import shape_of
from sim.props.shapes import Shape

TRIES = 900
_BETWEEN_M = 0.15
_AROUND_M = 0.5  # beyond its footprint the floor is looked at
_LEAST_SEEN = 6  # returns of the floor in either session
_ABOVE_FLOOR_M, _BESIDE_M = 0.12, 0.1  # room of a prop that is to hold no return
_MOST_INSIDE = 2  # returns that may be in that room: mixed pixels and dust
_STOREY_M = 3.0
_BOTH = frozenset(("before", "after"))
_SESSIONS = {"added": frozenset(("after",)), "none": _BOTH}


def stand_props(scenario: GraftScenario, around: Surroundings, seed: int) -> list[Standing]:
    """Return every prop at each of its places, in the scenario's order; a moved or reshaped one appears twice.

    Given places come first. The draws of one prop do not depend on other props; where drawn places clash the later
    prop is drawn again.

    Raises:
        ScenarioError: A prop finds no place, or a given place is taken.
    """
    jobs = [job for prop in scenario.props for job in _jobs(prop, seed)]
    placed: list[Standing] = []
    found: dict[int, list[Standing]] = {}
    for number in sorted(range(len(jobs)), key=lambda number: jobs[number][1].at is None):
        items = _find_place(*jobs[number], scenario, around, placed, seed)
        found[number] = [aged for item in items for aged in age(item)]
        placed += found[number]
    return [item for number in range(len(jobs)) for item in found[number]]


def _jobs(prop: Prop, seed: int) -> Iterator[tuple[Standing, Place, str]]:
    """Yield a prop for each of its places, and what that place is called."""
    first = Standing(prop, shape_of(prop, seed), _SESSIONS.get(prop.change, frozenset(("before",))), np.eye(4))
    yield first, prop.place, "place"
    if prop.to is not None:
        yield replace(first, sessions=frozenset(("after",))), prop.to, "to"


def _find_place(
    item: Standing,
    place: Place,
    purpose: str,
    scenario: GraftScenario,
    around: Surroundings,
    placed: Sequence[Standing],
    seed: int,
) -> list[Standing]:
    """Return a prop at one of its places, and after a short shift or a loading there."""
    reasons: dict[str, int] = {}
    spots = _given_spot(place, around) if place.at else _draw_spots(item, place, purpose, scenario, around, seed)
    for spot in spots:
        try:
            items = [_set_down(item, spot, scenario, around, is_given=place.at is not None)]
            if item.prop.shift is not None:
                turned = _shifted(spot, item.prop)
                after = replace(item, sessions=frozenset(("after",)))
                items.append(_set_down(after, turned, scenario, around, is_given=place.at is not None))
            _refuse_clash(items, placed, is_given=place.at is not None)
        except _UnfitError as why:
            reasons[str(why)] = reasons.get(str(why), 0) + 1
            continue
        if item.prop.loaded_share is not None:
            rest = shape_of(item.prop, seed, loaded_share=item.prop.loaded_share)
            items.append(replace(items[0], shape=rest, sessions=frozenset(("after",))))
        return items
    if place.at is not None:
        where = f"{purpose}.at = {list(place.at)}"
        raise ScenarioError(f"prop {item.prop.name!r} cannot stand at {where}: {next(iter(reasons))}")
    told = ", ".join(f"{number} times {why}" for why, number in sorted(reasons.items(), key=lambda each: -each[1]))
    raise ScenarioError(
        f"prop {item.prop.name!r} finds no place in {sum(reasons.values())} tries ({told}): make it smaller, "
        "graft fewer props, raise reach_m (--reach) or lower clearance_m (--clearance) of the recording, or give "
        "place.at"
    )


class _UnfitError(Exception):
    """Why a prop cannot stand at a spot."""


@dataclass(frozen=True, slots=True)
class _Spot:
    """A place as seen from above, metres, a heading in degrees, and the height of the sensor nearby."""

    x_m: float
    y_m: float
    yaw_deg: float
    sensor_z_m: float


def _draw_spots(
    item: Standing, place: Place, purpose: str, scenario: GraftScenario, around: Surroundings, seed: int
) -> Iterator[_Spot]:
    """Yield spots in a ring about places of the sensor, every third of the tries farther out."""
    recording, size_m = scenario.recording, item.shape.size_m
    generator = stream(seed, "graft", item.prop.name, purpose)
    nearest_m = recording.clearance_m + min(size_m[:2]) / 2
    for number in range(TRIES):
        sensor = around.path[generator.integers(len(around.path))]
        share = (1 + number // (TRIES // 3)) / 3
        farthest_m = nearest_m + share * max(recording.reach_m - nearest_m, 0.5)
        distance_m, bearing = generator.uniform(nearest_m, farthest_m), generator.uniform(0, 2 * np.pi)
        yaw_deg = place.yaw_deg + generator.uniform(0, 360)
        x_m, y_m = sensor[:2] + distance_m * np.array([np.cos(bearing), np.sin(bearing)])
        yield _Spot(float(x_m), float(y_m), float(yaw_deg), float(sensor[2]))


def _given_spot(place: Place, around: Surroundings) -> Iterator[_Spot]:
    assert place.at is not None
    nearest = np.linalg.norm(around.path[:, :2] - place.at[:2], axis=1).argmin()
    yield _Spot(place.at[0], place.at[1], place.yaw_deg, float(around.path[nearest, 2]))


def _shifted(spot: _Spot, prop: Prop) -> _Spot:
    assert prop.shift is not None
    way = np.deg2rad(spot.yaw_deg + prop.shift.heading_deg)
    x_m, y_m = (
        spot.x_m + prop.shift.distance_m * float(np.cos(way)),
        spot.y_m + prop.shift.distance_m * float(np.sin(way)),
    )
    return replace(spot, x_m=x_m, y_m=y_m, yaw_deg=spot.yaw_deg + prop.shift.turn_deg)


def _set_down(
    item: Standing, spot: _Spot, scenario: GraftScenario, around: Surroundings, *, is_given: bool
) -> Standing:
    """Return a prop on the floor at a spot. A given spot needs a floor and nothing else.

    Raises:
        _UnfitError: It cannot stand there.
    """
    place, size_m = np.array([spot.x_m, spot.y_m]), item.shape.size_m
    half_m = float(np.hypot(*size_m[:2])) / 2
    if not is_given and _is_on_path(place, spot, min(size_m[:2]) / 2 + scenario.recording.clearance_m, around.path):
        raise _UnfitError("the path is too near")
    floor = around.find_floor(place, half_m + _AROUND_M, spot.sensor_z_m)
    if floor is None:
        raise _UnfitError("there is no even floor")
    standing = replace(item, world_T_object=_pose_on(floor, spot, item.shape))
    if is_given:
        return standing
    if min(floor.n_points) < _LEAST_SEEN:
        raise _UnfitError("one session does not see the floor")
    if _path_gap_m(standing, around.path) < scenario.recording.clearance_m:
        raise _UnfitError("the path is too near")
    local = in_object_frame(standing.world_T_object, around.points(around.near(place, half_m + _BESIDE_M)))
    is_inside = (np.abs(local[:, :2]) < np.array(size_m[:2]) / 2 + _BESIDE_M).all(axis=1)
    is_inside &= (local[:, 2] > _ABOVE_FLOOR_M) & (local[:, 2] < size_m[2] + _BESIDE_M)
    if np.count_nonzero(is_inside) > _MOST_INSIDE:
        raise _UnfitError("something stands there")
    return standing


def _pose_on(floor: Floor, spot: _Spot, shape: Shape) -> Float64Array:
    """Return the pose (4, 4) on a floor; props that are set into the floor stay upright."""
    up = floor.normal if shape.is_settled else np.array([0.0, 0.0, 1.0])
    yaw = np.deg2rad(spot.yaw_deg)
    across = np.cross(up, [np.cos(yaw), np.sin(yaw), 0.0])
    across /= np.linalg.norm(across)
    place = np.round([spot.x_m, spot.y_m, floor.height_m], 6)
    return make_pose(np.column_stack([np.cross(across, up), across, up]), place)


def _is_on_path(place: Float64Array, spot: _Spot, within_m: float, path: Float64Array) -> bool:
    """Return whether the path (P, 3) comes nearer to a place (2,) than any floor there could make good."""
    near = path[np.abs(path[:, 2] - spot.sensor_z_m) < 1.0]
    return bool((np.linalg.norm(near[:, :2] - place, axis=1) < within_m).any())


def _path_gap_m(standing: Standing, path: Float64Array) -> float:
    """Return the least distance between a prop's footprint and the path (P, 3) on the same storey, from above."""
    pose = standing.world_T_object
    near = path[np.abs(path[:, 2] - pose[2, 3]) < _STOREY_M + standing.shape.size_m[2]]
    if not len(near):
        return float("inf")
    local = in_object_frame(pose, near)[:, :2]
    beyond = np.maximum(np.abs(local) - np.array(standing.shape.size_m[:2]) / 2, 0.0)
    return float(np.hypot(*beyond.T).min())


def _refuse_clash(items: Sequence[Standing], placed: Sequence[Standing], *, is_given: bool) -> None:
    for item in items:
        corners = grow_rectangle(standing_corners(item), _BETWEEN_M)
        for other in placed:
            if item.sessions & other.sessions and rectangles_overlap(corners, standing_corners(other)):
                told = f"prop {other.prop.name!r} stands there: give one of them another place"
                raise _UnfitError(told if is_given else "another prop stands there")
