"""Where and when each mover of a session moves: on a free stretch, and never near the robot."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, stream, transform
from cdpipe.core.geometry.motion import Motion
from scenarios.schema import Mover, Scenario
from sim.movers.body import Reach
from sim.movers.course import Course, stay
from sim.movers.kinds import build_body
from sim.movers.line import Stand, drive_along, hang, lay_line, walk_along
from sim.movers.mover import Figure, MovingBody, make_figure
from sim.placement.contact import find_way_out
from sim.placement.placing import grow_rectangle, rectangles_overlap, standing_box, standing_corners
from sim.placement.stations import Stations, draw_areas, way
from sim.scene import World

Name = TypeVar("Name", bound=str)  # of a session
_TRIES = 80  # places that the seed draws, as for a prop
_SHORTER = (1.0, 0.5, 0.25, 0.1)  # shares of its length that a drawn stretch has, each for so many places
_STARTS = 8  # times at which it may start, at each place
_ROWS = {"before": 0, "after": 1}
_PROP_GAP_M = 0.1
_ALONG_M = 0.25  # between the places at which a mover is checked against props, and four times that against rock
_WATCH_S = 0.1  # between the times at which its distance to the sensor is measured
_DEEPEST_M = 0.05  # of a corner of it in rock, feet and tyres aside
_FOOT_M = 0.25
_OTHER_LEVEL_M = 4.0  # what is farther above or below a mover than this is on another level of the mine
_SWAY_RAD = np.deg2rad(1.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Site:
    """What a mover of one session has around it."""

    world: World
    scenario: Scenario
    session: str
    robot_s: Float64Array
    robot: Float64Array  # (N, 3) sensor at these times (N,)


def plan_movers(
    world: World, scenario: Scenario, robots: Mapping[Name, Motion], seed: int
) -> dict[Name, tuple[MovingBody, ...]]:
    """Return the movers of each session, in the scenario's order, each with its course.

    The seed draws what a mover leaves open: its stretch, its place across the drift, and when it starts. It draws again
    until the mover passes between the walls, touches no prop, and keeps `platform.clearance_m` from the sensor at all
    times. The draws of one mover depend on no other mover. Movers may meet each other. A curtain hangs at one place in
    all of its sessions, because a curtain that hangs elsewhere is a change; all others have a course for each session.

    Args:
        world: The world.
        scenario: Its movers, and the platform's clearance.
        robots: True movement of the sensor in each session.
        seed: Seed of the draws.

    Raises:
        ScenarioError: A mover finds no way.
    """
    sites = [_watch(world, scenario, session, robot) for session, robot in robots.items()] if scenario.movers else []
    planned: dict[str, list[MovingBody]] = {session: [] for session in robots}
    for number, mover in enumerate(scenario.movers, start=len(scenario.props) + 1):
        here = [site for site in sites if mover.sessions in ("both", site.session)]
        for together in [here] if mover.kind == "curtain" and here else [[site] for site in here]:
            for site, body in zip(together, _plan(mover, number, together, seed), strict=True):
                planned[site.session].append(body)
    return {session: tuple(planned[session]) for session in robots}


def _watch(world: World, scenario: Scenario, session: str, robot: Motion) -> _Site:
    time_s = np.arange(robot.time_s[0], robot.time_s[-1] + _WATCH_S, _WATCH_S)
    return _Site(world.of(session), scenario.of(session), session, time_s, robot.sample(time_s)[0])


def _plan(mover: Mover, instance: int, sites: Sequence[_Site], seed: int) -> list[MovingBody]:
    """Return a mover in one session, or in several at the same place.

    Raises:
        ScenarioError: It finds no way.
    """
    sessions = " and ".join(site.session for site in sites)
    generator = stream(seed, sites[0].session if mover.kind != "curtain" else "pair", "mover", mover.name)
    figure = make_figure(build_body(mover), mover.reflectivity)
    refusal = "there is no stretch to be on"
    for stand in _draw_stands(mover, sites[0], seed, generator):
        lateral = float(generator.uniform(-1.0, 1.0)) if mover.path.lateral is None else mover.path.lateral
        starts = generator.random((2, _STARTS))
        facing = float(generator.uniform(-np.pi, np.pi))
        try:
            body = MovingBody(mover, instance, *_settle(mover, figure, stand, lateral, facing, sites[0]))
            return [_fit(body, _starts_in(site.session, starts, mover, seed), site) for site in sites]
        except ScenarioError as error:
            refusal = str(error)
    raise ScenarioError(
        f"{sessions}: mover {mover.name!r} finds no way: {refusal}: give it another path or lateral, or lower "
        "platform.clearance_m"
    )


def _starts_in(session: str, starts: Float64Array, mover: Mover, seed: int) -> Float64Array:
    """Return the phases to try in a session: a row (T,) of (2, T) `starts` in a pair, own draws in further sessions."""
    if session in _ROWS:
        return np.asarray(starts[_ROWS[session]])
    return stream(seed, session, "mover", mover.name, "phase").random(_STARTS)


def _fit(body: MovingBody, starts: Float64Array, site: _Site) -> MovingBody:
    """Return a mover that touches nothing in a session and starts when it keeps clear of the robot.

    Raises:
        ScenarioError: It cannot.
    """
    reach = body.figure.reach
    _refuse_contact(body, reach, site)
    return _start_clear(body, reach, starts, site)


def _draw_stands(mover: Mover, site: _Site, seed: int, generator: np.random.Generator) -> Iterator[Stand]:
    """Yield the stretch that a mover's path names; or those that the seed draws, shorter ones after 80, 160 and 240."""
    path = mover.path
    if path.between is not None and path.fractions is not None:
        is_fixed = path.lateral is not None
        for _ in range(1 if is_fixed else _TRIES):
            yield Stand(path.between, *path.fractions)
        return
    stations = way(site.scenario, site.world.centreline)
    if path.area is not None:
        stations = draw_areas(site.scenario, site.world.centreline, seed)[path.area][1]
    for share in _SHORTER:
        for place in (generator.random(_TRIES) * len(stations)).astype(int).tolist():
            stand = _stretch_at(stations, place, share * path.length_m)
            yield stand if generator.random() < 0.5 else Stand(stand.edge, stand.end, stand.start)


def _stretch_at(stations: Stations, place: int, length_m: float) -> Stand:
    """Return the stretch about a station, cut off where its edge, or the part of it that may be used, ends."""
    number = stations.edge[place]
    rows = np.flatnonzero(stations.edge == number)
    steps_m = np.linalg.norm(np.diff(stations.points[rows], axis=0), axis=1)
    along_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    middle_m = along_m[int(np.flatnonzero(rows == place)[0])]
    length_m = min(length_m, float(along_m[-1]))
    start_m = float(np.clip(middle_m - length_m / 2, 0.0, along_m[-1] - length_m))
    shares = np.interp([start_m, start_m + length_m], along_m, stations.fraction[rows])
    return Stand(stations.edges[number], float(shares[0]), float(shares[1]))


def _settle(
    mover: Mover, figure: Figure, stand: Stand, lateral: float, facing: float, site: _Site
) -> tuple[Figure, Course]:
    """Return the body of a mover at a place, where a curtain is as long as its roof is high, and its course."""
    fixed, centreline = site.world.fixed, site.world.centreline
    is_staying = not mover.speed_mps
    stand = Stand(stand.edge, stand.start, stand.start) if is_staying else stand
    extent = figure.extent
    half_m = float(max(extent.high[1], -extent.low[1]))
    if mover.kind == "curtain":
        path = lay_line(stand, lateral, half_m, 1.8, centreline, fixed)
        point, hang_m = hang(path, half_m, fixed)
        return make_figure(build_body(mover, hang_m), mover.reflectivity), stay(point, float(path.yaw_rad[0]), 0.0)
    height_m = float(extent.high[2])
    path = lay_line(stand, lateral, half_m, height_m, centreline, fixed)
    if is_staying:  # a person: no machine stays
        return figure, stay(path.points[0], float(path.yaw_rad[0]) + facing, 0.0, _SWAY_RAD)
    assert mover.speed_mps is not None and mover.pause_s is not None
    if mover.kind == "person":
        return figure, walk_along(path, mover.speed_mps, mover.pause_s)
    return figure, drive_along(path, mover.speed_mps, mover.pause_s, extent, fixed)


def _refuse_contact(body: MovingBody, reach: Reach, site: _Site) -> None:
    """Refuse a course on which a mover touches a prop of its session, or reaches into rock.

    Raises:
        ScenarioError: With the prop, or the depth.
    """
    footprints = sweep_footprints(body.course, reach, _ALONG_M)
    level_m = body.course.points[:, 2]
    lowest_m = level_m.min() + reach.low[:, 2].min() - _OTHER_LEVEL_M
    highest_m = level_m.max() + reach.high[:, 2].max() + _OTHER_LEVEL_M
    for item in site.world.standing:
        if site.session not in item.sessions:
            continue
        low, high = standing_box(item)
        if high[2] < lowest_m or low[2] > highest_m:
            continue
        outline = grow_rectangle(standing_corners(item), _PROP_GAP_M)
        if any(rectangles_overlap(footprint, outline) for footprint in footprints):
            raise ScenarioError(f"prop {item.prop.name!r} stands in its way")
    depth_m = _measure_depth(body, site)
    if depth_m > _DEEPEST_M:
        raise ScenarioError(f"it would reach {depth_m:.2f} m into rock or furniture")


def sweep_footprints(course: Course, reach: Reach, step_m: float) -> Float64Array:
    """Return the outlines (N, 4, 2) of a mover every `step_m` along its course, in both directions."""
    places = np.unique(np.append(np.arange(0.0, course.length_m, step_m), course.length_m))
    x, y, yaw = (np.interp(places, course.distance_m, each) for each in (*course.points.T[:2], course.yaw_rad))
    turned = np.concatenate([yaw, yaw + np.pi]) if course.is_turning or not course.is_moving else yaw
    middle = np.tile(np.column_stack([x, y]), (len(turned) // len(yaw), 1))
    bend_per_m = np.tile(np.interp(places, course.distance_m, course.bend_per_m), len(turned) // len(yaw))
    return _outlines(*reach.at(bend_per_m), middle, turned)


def _outlines(low: Float64Array, high: Float64Array, middle: Float64Array, yaw_rad: Float64Array) -> Float64Array:
    """Return the corners (N, 4, 2) of boxes (N, 3) from above at places (N, 2) turned by angles (N,)."""
    cos, sin = np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
    x = np.stack([high[:, 0], low[:, 0], low[:, 0], high[:, 0]], axis=1)
    y = np.stack([high[:, 1], high[:, 1], low[:, 1], low[:, 1]], axis=1)
    return np.stack([middle[:, :1] + cos * x - sin * y, middle[:, 1:] + sin * x + cos * y], axis=-1)


def _measure_depth(body: MovingBody, site: _Site) -> float:
    """Return how deep any corner of a mover reaches into rock on its course, feet and tyres aside, metres."""
    course = body.course
    n_places = max(2, int(np.ceil(course.length_m / (4 * _ALONG_M))))
    time_s = course.period_s * (np.arange(n_places) + 0.5) / n_places  # in the pauses, too
    if course.is_moving:
        time_s = np.concatenate([time_s, course.pass_times(4 * _ALONG_M)])
    corners = []
    for limb, poses in zip(body.figure.limbs, body.world_T_links(time_s), strict=True):
        of_limb = np.concatenate([mesh.vertices for mesh in limb.meshes])
        corners += [transform(pose, of_limb[:: max(1, len(of_limb) // 64)]) for pose in poses]
    points = np.concatenate(corners)
    if body.mover.kind != "curtain":
        nearest = np.linalg.norm(points[:, None, :2] - course.points[None, ::5, :2], axis=2).argmin(axis=1)
        points = points[points[:, 2] > course.points[::5][nearest, 2] + _FOOT_M]
    return float(find_way_out(points, site.world.fixed)[0].max(initial=0.0))


def _start_clear(body: MovingBody, reach: Reach, starts: Float64Array, site: _Site) -> MovingBody:
    """Return a mover that starts when it keeps clear of the robot; each start is a share of its period.

    Raises:
        ScenarioError: It never does; with the best distance and where it is.
    """
    needed_m = site.scenario.platform.clearance_m
    best_m, best = -1.0, site.robot[0]
    for start in starts.tolist():
        course = replace(body.course, offset_s=float(start * body.course.period_s))
        gap_m = measure_gaps(course, reach, site.robot_s, site.robot)
        worst = int(np.argmin(gap_m))
        if gap_m[worst] >= needed_m:
            return replace(body, course=course)
        if gap_m[worst] > best_m:
            best_m, best = float(gap_m[worst]), site.robot[worst]
    raise ScenarioError(
        f"it comes within {best_m:.2f} m of the sensor at ({best[0]:.1f}, {best[1]:.1f}, {best[2]:.1f}), and "
        f"{needed_m:g} m are needed"
    )


def measure_gaps(course: Course, reach: Reach, time_s: Float64Array, robot: Float64Array) -> Float64Array:
    """Return the level distance (N,) from the robot (N, 3) to a mover's box on its course at times (N,), metres.

    It is infinite while one is on another level of the mine.
    """
    poses = course.world_T_root(time_s)
    delta = robot - poses[:, :3, 3]
    heading = np.stack([poses[:, 0, 0], poses[:, 1, 0]], axis=1)
    heading /= np.linalg.norm(heading, axis=1, keepdims=True)
    x = heading[:, 0] * delta[:, 0] + heading[:, 1] * delta[:, 1]
    y = heading[:, 0] * delta[:, 1] - heading[:, 1] * delta[:, 0]
    low, high = (corner.T for corner in reach.at(course.moment(time_s).bend_per_m))
    outside_x, outside_y, outside_z = (
        np.maximum(np.maximum(low[axis] - along, along - high[axis]), 0.0)
        for axis, along in enumerate((x, y, delta[:, 2]))
    )
    return np.where(outside_z > _OTHER_LEVEL_M, np.inf, np.hypot(outside_x, outside_y))
