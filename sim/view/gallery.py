"""The pictures of the README: every family from inside, and every kind of prop in every posture from two metres.

python -m sim.view.gallery OUT            all of them
python -m sim.view.gallery OUT narrow box only these
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, stream, yaw_pose, yaw_rad
from cdpipe.core.yamlfile import suggest
from scenarios import load_scenario, scenario_names
from scenarios.schema import Air, Drift, Place, Prop, Roughness, Scenario, Section, SessionPlan, Tunnel
from sim.displacement.displace import Displacement
from sim.geometry.mesh import move_mesh
from sim.geometry.raycast import Caster
from sim.movers.trails import raise_dust
from sim.placement.placing import Posture, Standing, standing_box, standing_middle
from sim.scene import WALL_GEOM, Scene, World, build_world
from sim.sensor.air import AirVolume, air_around
from sim.session.planning import plan_drives
from sim.session.revolution import Drive
from sim.view.picture import render
from sim.view.rock import STEPS_M, face_tints

SEED = 20000
SIZES: dict[str, tuple[float, float, float]] = {
    "box": (0.8, 0.6, 0.6),
    "crate": (1.2, 0.8, 0.9),
    "chair": (0.5, 0.5, 0.9),
    "trolley": (0.6, 0.55, 1.2),
    "barrel": (0.58, 0.58, 0.9),
    "cone": (0.36, 0.36, 0.75),
    "railing": (3.0, 0.3, 1.1),
    "pallet": (1.2, 0.8, 0.145),
    "rock": (1.1, 0.9, 0.7),
    "vehicle": (4.6, 1.9, 1.9),
    "muck_pile": (4.0, 3.2, 1.2),
}
_SHEET_PX = (480, 360)
_FAMILY_PX = (1200, 750)
_DISTANCE_M = 2.0
_EYE_M = 1.6
_FRACTIONS = (0.5, 0.4, 0.6, 0.3)
_QUALITY = 82
_FIRST_GUEST = 20_000  # number of the first mover or puddle of a picture
_DARKER = ", ".join(f"{100 * step_m:g}" for step_m in STEPS_M[1:])
_ROCK_CAPTION = (
    f"rock that moved: red into the void, blue into the rock, darker from {_DARKER} cm on; "
    f"white less than {100 * STEPS_M[0]:g} cm"
)
Pixels = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class _Case:
    """One prop of a sheet: its caption, its posture, and what happens to it."""

    caption: str
    posture: Posture = "upright"
    loaded_share: float | None = None


_CASES = (_Case("upright"), _Case("tipped", "tipped"), _Case("leaning", "leaning"))
_PILE_CASES = (_Case("in the open"), _Case("against a wall", "leaning"), _Case("partly loaded away", loaded_share=0.45))
_FIXED_CASES = (_Case("upright"),)


def draw_gallery(out: Path, only: Sequence[str] = ()) -> list[Path]:
    """Write `family-NAME.jpg` and `prop-KIND.jpg` into a folder, and return their paths.

    Args:
        out: Made if it is not there.
        only: Names of families and kinds; empty for all.

    Raises:
        ScenarioError: A name is neither a family nor a kind that has a size here, or a family cannot be built.
    """
    families = [name for name in scenario_names() if not name.startswith(("smoke/", "unchanged/"))]
    for name in only:
        if name not in families and name not in SIZES:
            raise ScenarioError(f"{name}: neither a family nor a kind of prop{suggest(name, [*families, *SIZES])}")
    out.mkdir(parents=True, exist_ok=True)
    written = []
    for name in [name for name in (*families, *SIZES) if not only or name in only]:
        is_prop = name in SIZES
        pictures = prop_pictures(name) if is_prop else [_captioned(load_scenario(name, SEED), SEED)]
        written.append(out / f"{'prop' if is_prop else 'family'}-{name.replace('/', '-')}.jpg")
        _save(written[-1], pictures)
    return written


def _captioned(scenario: Scenario, seed: int) -> tuple[Pixels, str]:
    """Return the picture of a family, and what its colours mean where rock changed."""
    return family_picture(scenario, seed), _ROCK_CAPTION if scenario.surface else ""


def family_picture(scenario: Scenario, seed: int) -> Pixels:
    """Return a picture of a world in the after session, from the place that shows most of the changes.

    With movers or puddles it shows most of these, movers where they are in the middle of the session. Rock that moved
    is coloured by its displacement. Mist and dust are those of the middle of the session.
    """
    world = build_world(scenario, seed)
    if scenario.movers or scenario.puddles or scenario.after.air is not None:
        drive = plan_drives(scenario, seed)[1]
        air = partial(_air_at, drive)
        if scenario.movers or scenario.puddles:
            scene, places = _with_guests(drive)
            guests = set(range(_FIRST_GUEST, _FIRST_GUEST + len(places)))
            return _best_view(world, scene, places, guests, nearest_m=5.0, air_at=air)
    else:
        air = None
    if world.displacement is not None:
        return _best_view(world, world.after, _rock_places(world.displacement), set(), nearest_m=4.0)
    changed = [item for item in world.standing if item.prop.change != "none" and "after" in item.sessions]
    # a little above a low prop, so that walls and roof come into the picture
    targets = [standing_middle(item) + np.array([0.0, 0.0, 0.6]) for item in changed or world.standing]
    numbers = {prop.name: number for number, prop in enumerate(scenario.props, start=1)}
    return _best_view(world, world.after, targets, {numbers[item.prop.name] for item in changed}, air_at=air)


def _rock_places(displacement: Displacement) -> list[Float64Array]:
    """Return the middle (3,) of each change of the after walls."""
    walls = displacement.walls
    faces = [walls.faces[displacement.label == patch.number] for patch in displacement.patches]
    return [walls.after[each].mean(axis=(0, 1)) for each in faces]


def _air_at(drive: Drive, eye_m: Float64Array) -> AirVolume:
    """Return the mist and dust around an eye (3,) in the middle of a session."""
    middle_s = float(drive.trajectory.revolution_s[drive.trajectory.n_scans // 2])
    puffs = raise_dust(drive.moving.movers, middle_s)
    air = drive.scenario.plan(drive.session).air or Air()
    return air_around(air, eye_m, float(eye_m[2]) - _EYE_M, middle_s, drive.seed, drive.session, puffs)


def _with_guests(drive: Drive) -> tuple[Scene, list[Float64Array]]:
    """Return a session's scene with its movers and puddles, and a place to look at of each, (3,)."""
    middle_s = drive.trajectory.revolution_s[[drive.trajectory.n_scans // 2]]
    pools = drive.water.pools if drive.water is not None else ()
    guests = [([pool.sheet()], ["water"], pool.centre) for pool in pools]
    for body in drive.moving.movers:
        poses = body.world_T_links(middle_s)[:, 0]
        meshes = [
            move_mesh(mesh, pose) for limb, pose in zip(body.figure.limbs, poses, strict=True) for mesh in limb.meshes
        ]
        place = body.world_T_root(middle_s)[0, :3, 3] + np.array([0.0, 0.0, 0.6])
        guests.append((meshes, list(body.figure.materials), place))
    scene = drive.scene
    parts, materials, every, instance = list(scene.parts), list(scene.materials), list(scene.meshes), [scene.instance]
    for number, (meshes, of_solids, _) in enumerate(guests):
        every += meshes
        materials += of_solids
        parts += [f"guest-{number}"] * len(meshes)
        instance.append(np.full(len(meshes), _FIRST_GUEST + number, np.int32))
    shares = np.concatenate([scene.reflectivity, np.ones(len(every) - len(scene.meshes), np.float32)])
    shown = Scene(tuple(every), Caster(every), np.concatenate(instance), shares, tuple(parts), tuple(materials))
    return shown, [place for _, _, place in guests]


def _best_view(
    world: World,
    scene: Scene,
    targets: Sequence[Float64Array],
    wanted: set[int],
    nearest_m: float = 3.0,
    air_at: Callable[[Float64Array], AirVolume] | None = None,
) -> Pixels:
    """Return a picture of a scene towards one of some places (3,), from where most of the wanted objects are seen.

    Of rock that moved, every change is wanted, and coloured.
    """
    moved = world.displacement
    label = None if moved is None else moved.label
    tints = None if moved is None else face_tints(world)
    if moved is not None:
        wanted = wanted | {_FIRST_GUEST + patch.number for patch in moved.patches}
    stations = np.concatenate([line.points[::10] for line in world.centreline.drifts]) + np.array([0.0, 0.0, _EYE_M])
    views = [(stations[0], stations[1], -1.0)]
    for target in targets:
        distance_m = np.linalg.norm(stations - target, axis=1)
        eyes = stations[(distance_m > nearest_m) & (distance_m < nearest_m + 6.0)]
        views += [(eye, target, _score(scene, eye, target, wanted, label)) for eye in eyes]
    eye, target, _ = max(views, key=lambda view: view[2])
    air = None if air_at is None else air_at(eye)
    return render(scene, eye, target, *_FAMILY_PX, field_of_view_deg=78.0, samples=2, tints=tints, air=air)


def prop_pictures(kind: str) -> list[tuple[Pixels, str]]:
    """Return a picture and a caption for each posture of a kind of prop, from two metres away.

    Raises:
        ScenarioError: No posture is possible.
    """
    cases = _PILE_CASES if kind == "muck_pile" else _FIXED_CASES if kind in ("railing", "vehicle") else _CASES
    pictures: list[tuple[Pixels, str]] = []
    refused: list[str] = []
    for case in cases:
        world = _first_world(kind, case, refused)
        if world is None:
            continue
        session = "before" if case.loaded_share is None else "after"
        item = next(item for item in world.standing if session in item.sessions)
        scene = world.before if session == "before" else world.after
        pictures.append((_close_up(world, scene, item), f"{kind.replace('_', ' ')}, {case.caption}"))
    if not pictures:
        raise ScenarioError(refused[0])
    return pictures


def _first_world(kind: str, case: _Case, refused: list[str]) -> World | None:
    """Return a world with the prop at the first place where it rests; else None, with the reasons in `refused`."""
    for fraction in _FRACTIONS:
        try:
            return build_world(_stage(kind, case, fraction), SEED)
        except ScenarioError as error:  # too squat to lean, or the wall is too rough just there
            refused.append(str(error))
    return None


def _stage(kind: str, case: _Case, fraction: float) -> Scenario:
    """Return a short drift with one prop."""
    lateral, yaw_deg = (0.95, 0.0) if case.posture == "leaning" else (0.1, 20.0)
    place = Place(between=("a", "b"), fraction=fraction, lateral=lateral, yaw_deg=yaw_deg, posture=case.posture)
    change: Literal["none", "reshaped"] = "none" if case.loaded_share is None else "reshaped"
    prop = Prop(name=kind, kind=kind, size_m=SIZES[kind], place=place, change=change, loaded_share=case.loaded_share)
    tunnel = Tunnel(
        nodes={"a": (0, 0, 0), "b": (18, 0, 0)},
        drifts=(Drift(nodes=("a", "b")),),
        section=Section(width_m=7.0, height_m=4.5),
        roughness=(Roughness(amplitude_m=0.15, length_m=2.5), Roughness(amplitude_m=0.06, length_m=0.7)),
        resolution_m=0.12,
    )
    plan = SessionPlan(route=("a", "b"))
    return Scenario(family="gallery", tunnel=tunnel, props=(prop,), before=plan, after=plan)


def _close_up(world: World, scene: Scene, item: Standing) -> Pixels:
    """Return an oblique picture of a prop, two metres from its side, taken from a free place."""
    middle, half_m = standing_middle(item), np.ptp(standing_box(item), axis=0) / 2
    gone = standing_middle(world.standing[0]) - middle  # where a loaded pile is missing something
    best = (-1.0, middle + 1.0)
    for azimuth in np.deg2rad(np.arange(-180.0, 180.0, 15.0)):
        away = yaw_pose(azimuth)[:3, 0]
        # where the line out of the bounding box's middle leaves the box, and two metres on
        edge_m = float(np.min(half_m[:2] / np.maximum(np.abs(away[:2]), 1e-9)))
        eye = middle + (edge_m + _DISTANCE_M) * away
        eye[2] = max(_EYE_M, middle[2] + half_m[2] + 0.2)
        free_m = _free_m(world, eye)
        # three quarters on: neither end nor side alone
        turned = azimuth - yaw_rad(item.world_T_object)
        oblique = 1.0 - abs(abs(np.sin(turned)) - np.sin(np.deg2rad(55.0)))
        score = min(free_m, 1.0) + oblique + 0.5 * float(np.sign(away @ gone)) if free_m > 0.2 else -1.0
        if score > best[0]:
            best = (score, eye)
    eye = best[1]
    spread = np.linalg.norm(half_m) / np.linalg.norm(eye - middle)
    field_deg = float(np.clip(np.rad2deg(2.3 * np.arctan(spread)), 35.0, 95.0))
    return render(scene, eye, middle, *_SHEET_PX, field_of_view_deg=field_deg, samples=3)


def _score(
    scene: Scene, eye: Float64Array, target: Float64Array, wanted: set[int], label: npt.NDArray[np.int16] | None
) -> float:
    """Return the score of a view: the number of changed props and patches of rock in it, and the area they cover.

    Args:
        scene: The scene.
        eye: (3,) the camera.
        target: (3,) what it looks at.
        wanted: Instances; of a patch of rock its number plus that of the first guest.
        label: (M,) number of the patch that each face of the walls belongs to, 0 for none; None where no rock moved.
    """
    forward = (target - eye) / np.linalg.norm(target - eye)
    side = np.cross(forward, (0.0, 0.0, 1.0))
    up = np.cross(side, forward)
    across, along = np.meshgrid(np.linspace(-0.75, 0.75, 40), np.linspace(-0.45, 0.45, 24))
    rays = forward + across.reshape(-1, 1) * side + along.reshape(-1, 1) * up
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    ranges_m, geom, _ = scene.caster.cast(eye, rays)
    if np.isinf(ranges_m).any() or (ranges_m < 0.4).mean() > 0.02:
        return -1.0
    seen = scene.instance[geom]
    if label is not None:
        _, _, face = scene.caster.faces(eye, rays)
        patch = np.where(geom == WALL_GEOM, label[np.where(geom == WALL_GEOM, face, 0)], 0)
        seen = np.where(patch > 0, _FIRST_GUEST + patch, seen)
    sizes = [min(float((seen == number).mean()), 0.15) for number in wanted]
    return sum(1.0 + 20.0 * size for size in sizes if size > 0.003) + 0.1 * len(set(seen.tolist()))


def _free_m(world: World, eye: Float64Array) -> float:
    """Return the distance from a place to the nearest rock or fixture, 0 outside the tunnel."""
    rays = stream(0, "gallery").normal(size=(64, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    ranges_m, _, normals = world.fixed.hits(eye, rays)
    is_inside = np.isfinite(ranges_m).all() and ((normals * rays).sum(axis=1) < 0).all()
    return float(ranges_m.min()) if is_inside else 0.0


def _save(path: Path, pictures: Sequence[tuple[Pixels, str]]) -> None:
    """Write pictures side by side as one JPEG, each with its caption below it."""
    height, width = pictures[0][0].shape[:2]
    caption_px = 26 if any(caption for _, caption in pictures) else 0
    dpi = 100
    figure = Figure(figsize=(width * len(pictures) / dpi, (height + caption_px) / dpi), dpi=dpi, facecolor="white")
    share = 1.0 / len(pictures)
    for index, (pixels, caption) in enumerate(pictures):
        bottom = caption_px / (height + caption_px)
        axes = figure.add_axes((index * share, bottom, share, 1.0 - bottom))
        axes.imshow(pixels, aspect="auto", interpolation="nearest")
        axes.set_axis_off()
        figure.text((index + 0.5) * share, bottom / 2, caption, ha="center", va="center", fontsize=10)
    figure.savefig(path, dpi=dpi, pil_kwargs={"quality": _QUALITY, "optimize": True})


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit("usage: python -m sim.view.gallery OUT [FAMILY or KIND ...]")
    try:
        for file in draw_gallery(Path(sys.argv[1]), sys.argv[2:]):
            sys.stdout.write(f"{file}\n")
    except ScenarioError as error:
        sys.exit(f"error: {error}")
