"""The content of a view of a world, a simulated pair or a session: named surfaces, lines, points and labels.

A name is a path. Its first word is the group that a viewer shows or hides as a whole, e.g. `changes/added/box`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.core.geometry import Float64Array
from cdpipe.io.session import is_session, read_session
from scenarios.schema import Scenario
from sim.drive.trajectory import Trajectory
from sim.geometry.mesh import Mesh, cylinder_mesh, drop_unused_vertices, join_meshes, move_mesh
from sim.graft.rebuild import outline_rock, rebuild_props
from sim.placement.placing import Standing, standing_box
from sim.placement.puddles import Pool
from sim.props.shapes import solid_mesh
from sim.scene import WALL_GEOM, World, build_world
from sim.session.truth import SESSIONS, PairTruth, SessionName, read_pair_truth, read_true_poses
from sim.story.state import is_story
from sim.view.building import PlacedMover, build_pair, list_pools, place_movers, plan_drives
from sim.view.picture import material_colour
from sim.view.returns import CHANGE_RGB, SESSION_RGB, Cloud, Revolutions, Rgb, move_near, points_cloud, session_cloud
from sim.view.rock import ROCK_RGB, class_name, displacement_classes, outline_rgb

_N_BANDS = 10
_WATER_RGB: Rgb = (70, 120, 170)
# Groups of the rock that changes between the sessions.
ROCK_BEFORE, ROCK_AFTER = "rock/before", "rock/after"


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A mesh in one colour, world frame, metres; a band of the walls begins `from_m` above the floor."""

    name: str
    mesh: Mesh
    rgb: Rgb
    from_m: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A path (N, 3), world frame, metres."""

    name: str
    points: Float64Array
    rgb: Rgb


@dataclass(frozen=True, slots=True, eq=False)
class Label:
    """A text at a place (3,), world frame, metres."""

    name: str
    position: Float64Array
    text: str


Play = Callable[[float], tuple[tuple[Surface, ...], tuple[Cloud, ...]]]


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The parts of a view. Movers are shown where they are in the middle of their session.

    Attributes:
        title: Its heading.
        bands: The walls in bands of height above the floor, lowest first; each ends where the next begins. Rock that
            changes is not among them.
        surfaces: Fixtures, unchanged props, changed props, movers, puddles, and rock that changes: as it was, and as
            it is in the after session by class of displacement.
        lines: Paths of the sensor, and the stretches on which movers go to and fro.
        clouds: Returns of sessions.
        labels: Names of the props.
        eye, target: (3,) position of the camera, and the point it looks at.
        notes: Parts that could not be shown, with the reason.
        play: Returns what is elsewhere at another share of the drives, 0 to 1: the surfaces of movers and of sensors,
            and the returns of one revolution; None where nothing is driven.
        legend: Colours and what they mean; empty for those of changes, paths and rock that the view holds.
    """

    title: str
    bands: tuple[Surface, ...]
    surfaces: tuple[Surface, ...]
    lines: tuple[Line, ...]
    clouds: tuple[Cloud, ...]
    labels: tuple[Label, ...]
    eye: Float64Array
    target: Float64Array
    notes: tuple[str, ...] = ()
    play: Play | None = None
    legend: tuple[tuple[Rgb, str], ...] = ()


def is_pair(path: Path) -> bool:
    """Tell whether a folder holds a simulated pair with its truth."""
    return (path / "truth" / "changes.json").is_file()


def view_scenario(scenario: Scenario, seed: int) -> View:
    """Return the world of a drawn scenario with the paths of both sessions.

    A path that cannot be driven becomes a note, so that the obstacle is visible.

    Raises:
        ScenarioError: The world cannot be built.
        InputError: The sensor profile cannot be read.
    """
    world = build_world(scenario, seed)
    drives, notes = plan_drives(world, scenario, seed)
    lines = [
        Line(f"paths/{session}", drive.world_T_sensor[:, :3, 3], SESSION_RGB[session])
        for session, drive in drives.items()
    ]
    try:
        movers = place_movers(world, scenario, drives, seed)
    except ScenarioError as error:
        movers, notes = [], [*notes, f"no movers: {error}"]
    pools = list_pools(world, scenario, seed)
    view = _world_view(f"{scenario.family}, seed {seed}", world, lines, (), movers, pools, tuple(notes))
    poses = [(session, drive.world_T_sensor) for session, drive in drives.items()]
    return replace(view, play=_player(poses, movers, drives, ())) if drives else view


def view_pair(pair: Path) -> View:
    """Return the world of a simulated pair, its true paths, and a sample of the returns of both sessions.

    Raises:
        InputError: The pair or its truth is missing, damaged, or of a version whose scenario cannot be built here.
    """
    truth = read_pair_truth(pair)
    poses = {session: read_true_poses(pair / session) for session in SESSIONS}
    lines = [Line(f"paths/{session}", poses[session][:, :3, 3], SESSION_RGB[session]) for session in SESSIONS]
    kinds = {change.id: change.kind for change in truth.changes}
    clouds = tuple(
        session_cloud(f"returns/{session}", read_session(pair / session), poses[session], kinds) for session in SESSIONS
    )
    title = f"{pair}: {truth.family}, seed {truth.seed}"
    revolutions = [
        Revolutions(f"revolution/{session}", read_session(pair / session), poses[session], kinds)
        for session in SESSIONS
    ]
    if truth.graft is not None:
        view = _grafted_view(title, truth, lines, clouds)
        return replace(view, play=_player(poses.items(), (), {}, revolutions))
    built = build_pair(pair, truth)
    world, drives, movers = built.world, built.drives, built.movers
    view = _world_view(title, world, lines, clouds, movers, built.pools, ())
    return replace(view, play=_player(poses.items(), movers, drives, revolutions))


def view_session(folder: Path) -> View:
    """Return the path of a session and a sample of its returns, in its odom frame, or near it (`move_near`).

    Raises:
        InputError: The session is missing or damaged.
    """
    session = read_session(folder)
    poses, _, notes = move_near(session.odom_T_sensor)
    cloud = session_cloud("returns/session", session, poses, None)
    middle = poses[len(poses) // 2, :3, 3]
    line = Line("paths/session", poses[:, :3, 3], SESSION_RGB["after"])
    eye = middle + np.array([-8.0, -8.0, 10.0])
    play = _player([("session", poses)], (), {}, [Revolutions("revolution/session", session, poses, None)])
    return View(str(folder), (), (), (line,), (cloud,), (), eye, middle, notes, play)


def view_points(title: str, points: Float64Array, poses: Float64Array) -> View:
    """Return the path (S, 4, 4) and a sample of the returns (N, 3) of a recording, as `view_session`, metres."""
    poses, place, notes = move_near(poses)
    cloud = points_cloud("returns/session", points - place)
    middle = poses[len(poses) // 2, :3, 3]
    line = Line("paths/session", poses[:, :3, 3], SESSION_RGB["after"])
    play = _player([("session", poses)], (), {}, [])
    return View(title, (), (), (line,), (cloud,), (), middle + np.array([-8.0, -8.0, 10.0]), middle, notes, play)


def _player(
    poses: Iterable[tuple[str, Float64Array]],
    movers: Sequence[PlacedMover],
    drives: Mapping[SessionName, Trajectory],
    revolutions: Sequence[Revolutions],
) -> Play:
    """Return what shows movers, sensors and returns at a share of the drives.

    Args:
        poses: Name of each session, and the (S, 4, 4) poses of its sensor.
        movers: The movers.
        drives: The drive of every session that has movers.
        revolutions: The returns of each session.
    """
    paths = tuple(poses)

    def play(share: float) -> tuple[tuple[Surface, ...], tuple[Cloud, ...]]:
        surfaces = []
        for session, world_T_sensor in paths:
            here = world_T_sensor[min(int(share * len(world_T_sensor)), len(world_T_sensor) - 1)]
            rgb = SESSION_RGB.get(session, SESSION_RGB["after"])
            surfaces.append(Surface(f"sensor/{session}", move_mesh(cylinder_mesh(0.06, 0.06, 24), here), rgb))
        for placed in movers:
            time_s = drives[placed.session].revolution_s
            now = replace(placed, time_s=float(time_s[min(int(share * len(time_s)), len(time_s) - 1)]))
            surfaces += _mover_surfaces(now)
        return tuple(surfaces), tuple(cloud for each in revolutions for cloud in each.at(share))

    return play


def view_folder(folder: Path) -> View:
    """Return the view of a folder that holds a simulated pair or a session.

    Raises:
        InputError: It holds neither, or what it holds is damaged.
    """
    if is_pair(folder):
        return view_pair(folder)
    if is_session(folder):
        return view_session(folder)
    if is_session(folder / "before"):
        raise InputError(f"{folder}: a pair without truth: view {folder / 'before'} or {folder / 'after'}")
    if is_story(folder):
        raise InputError(f"{folder}: a story: view {folder / 'session-01'}, or a pair that `tunnelcd pair` makes of it")
    raise InputError(f"{folder}: neither a simulated pair nor a session: expected truth/changes.json or session.json")


def wall_bands(wall: Mesh, floor_points: Float64Array, n_bands: int = _N_BANDS) -> tuple[Surface, ...]:
    """Cut walls into bands of equal height above the floor (N, 3) nearest to each face, lowest first."""
    centres = wall.vertices[wall.faces].mean(axis=1)
    # A face belongs to the floor below it even where another level runs above.
    _, nearest = cKDTree(floor_points).query(centres - (0.0, 0.0, 1.0))
    height_m = centres[:, 2] - floor_points[nearest, 2]
    top_m = float(np.percentile(height_m, 99.5))
    step_m = max(0.1, round(top_m / n_bands, 1))
    number = np.clip(np.floor(height_m / step_m), 0, n_bands - 1).astype(int)
    rgb = _rgb(material_colour("wall", "rock"))
    bands = []
    for band in np.unique(number).tolist():
        mesh = drop_unused_vertices(wall.vertices, wall.faces[number == band])
        bands.append(Surface(f"walls/from {band * step_m:.1f} m", mesh, rgb, band * step_m))
    return tuple(bands)


def _mover_surfaces(placed: PlacedMover) -> Iterator[Surface]:
    """Yield a mover by material."""
    figure = placed.body.figure
    poses = placed.body.world_T_links(np.array([placed.time_s]))[:, 0]
    limbs = zip(figure.limbs, poses, strict=True)
    meshes = [move_mesh(mesh, pose) for limb, pose in limbs for mesh in limb.meshes]
    parts: dict[str, list[Mesh]] = {}
    for material, mesh in zip(figure.materials, meshes, strict=True):
        parts.setdefault(material, []).append(mesh)
    for material, of_material in parts.items():
        rgb = _rgb(material_colour(placed.body.mover.name, material))
        yield Surface(f"{placed.name}/{material}", join_meshes(of_material), rgb)


def _world_view(
    title: str,
    world: World,
    lines: Sequence[Line],
    clouds: tuple[Cloud, ...],
    movers: Sequence[PlacedMover],
    pools: Mapping[str, Pool],
    notes: tuple[str, ...],
) -> View:
    wall = world.before.meshes[0]
    floor = [line.points for line in world.centreline.drifts]
    floor += [] if floor else [path.points - (0.0, 0.0, 1.0) for path in lines]
    floor_points = np.concatenate(floor) if floor else wall.vertices[[int(np.argmin(wall.vertices[:, 2]))]]
    fixtures = []
    for fixture in world.fixtures:
        kind = re.split(r"[\W_]*\d", fixture.name, maxsplit=1)[0]
        rgb = _rgb(material_colour(fixture.name, fixture.material))
        fixtures.append(Surface(f"fixtures/{kind}/{fixture.name}", fixture.mesh, rgb))
    props = [surface for item in world.standing for surface in _prop_surfaces(item)]
    changed = [item for item in world.standing if item.prop.change != "none"]
    if changed:
        target = changed[0].world_T_object[:3, 3]
    else:
        target = lines[0].points[len(lines[0].points) // 2] if lines else wall.vertices.mean(axis=0)
    labels = tuple(_label(item) for item in world.standing)
    eye = target + np.array([-6.0, -6.0, 8.0])
    moving = [surface for placed in movers for surface in _mover_surfaces(placed)]
    stretches = [
        Line(f"{placed.name}/stretch", placed.body.course.points, SESSION_RGB[placed.session])
        for placed in movers
        if placed.body.course.is_moving
    ]
    puddles = [Surface(f"puddles/{name}", pool.sheet(), _WATER_RGB) for name, pool in pools.items()]
    rock = _rock_surfaces(world)
    surfaces, all_lines = (*fixtures, *props, *moving, *puddles, *rock), (*lines, *stretches)
    if world.displacement is not None:
        wall = Mesh(wall.vertices, wall.faces[world.displacement.label == 0])
        if not changed and len(rock) > 1:
            target = rock[-1].mesh.vertices.mean(axis=0)
            eye = target + np.array([-6.0, -6.0, 8.0])
    return View(title, wall_bands(wall, floor_points), surfaces, all_lines, clouds, labels, eye, target, notes)


def _grafted_view(title: str, truth: PairTruth, lines: Sequence[Line], clouds: tuple[Cloud, ...]) -> View:
    """Return the view of a grafted pair, whose walls are known by their returns alone, with outlines of moved rock."""
    standing, rock = rebuild_props(truth), outline_rock(truth)
    surfaces = tuple(surface for item in standing for surface in _prop_surfaces(item))
    target = lines[0].points[len(lines[0].points) // 2]
    outlines = [Line(f"rock/{each.told.name}", each.ring, outline_rgb(each)) for each in rock]
    labels = [Label(f"labels/rock {each.told.name}", each.ring[:4].mean(axis=0), each.text) for each in rock]
    eye = target + np.array([-6.0, -6.0, 8.0])
    return View(title, (), surfaces, (*lines, *outlines), clouds, (*map(_label, standing), *labels), eye, target)


def _rock_surfaces(world: World) -> list[Surface]:
    """Return the rock that changes as it was before, in the colour of rock, and as it is after, by its displacement."""
    if world.displacement is None:
        return []
    before, after = world.before.meshes[WALL_GEOM], world.after.meshes[WALL_GEOM]
    was = drop_unused_vertices(before.vertices, before.faces[world.displacement.label > 0])
    surfaces = [Surface(ROCK_BEFORE + "/rock", was, _rgb(material_colour("wall", "rock")))]
    classes = displacement_classes(world)
    for number in np.unique(classes[classes >= 0]).tolist():
        mesh = drop_unused_vertices(after.vertices, after.faces[classes == number])
        surfaces.append(Surface(f"{ROCK_AFTER}/{class_name(number)}", mesh, ROCK_RGB[number]))
    return surfaces


def _prop_surfaces(item: Standing) -> Iterator[Surface]:
    """Yield an unchanged prop by material, a changed one as one surface in the colour of its change."""
    name, change = item.prop.name, item.prop.change
    parts: dict[str, list[Mesh]] = {}
    for solid in item.shape.solids:
        parts.setdefault(solid.material, []).append(move_mesh(solid_mesh(solid), item.world_T_object))
    if change != "none":
        whole = join_meshes([mesh for meshes in parts.values() for mesh in meshes])
        yield Surface(f"changes/{change}/{name}{_where(item)}", whole, CHANGE_RGB[change])
        return
    for material, meshes in parts.items():
        yield Surface(
            f"props/{name}{_where(item)}/{material}", join_meshes(meshes), _rgb(material_colour(name, material))
        )


def _label(item: Standing) -> Label:
    low, high = standing_box(item)
    change = "" if item.prop.change == "none" else f", {item.prop.change}{_where(item)}"
    position = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, high[2] + 0.1])
    return Label(f"labels/{item.prop.name}{_where(item)}", position, f"{item.prop.name}{change}")


def _where(item: Standing) -> str:
    """Return the session in brackets for both places of a moved, aged or carried prop, and shapes of a reshaped one."""
    is_twice = item.prop.change in ("moved", "reshaped") or item.prop.aged is not None
    is_twice |= item.prop.change == "none" and len(item.sessions) == 1
    return f" ({min(item.sessions)})" if is_twice else ""


def _rgb(colour: tuple[float, float, float]) -> Rgb:
    red, green, blue = (round(255 * value) for value in colour)
    return red, green, blue
