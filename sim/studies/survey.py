"""Figures of the worlds of a family. The worlds are built and their paths planned, but no scan is simulated."""

from __future__ import annotations

import csv
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from cdpipe.core.errors import InputError, TunnelcdError
from cdpipe.core.geometry import Float64Array
from cdpipe.core.isolation import ProcessDiedError, run_isolated
from cdpipe.core.progress import Progress, report_nothing
from cdpipe.core.whole_file import whole_file
from scenarios.library import load_scenario
from sim.drive.trajectory import load_sensor, plan_trajectory
from sim.geometry.raycast import Caster
from sim.placement.contact import interpenetration_m
from sim.placement.placing import standing_middle
from sim.props.heap import flank_angle_deg
from sim.rock.axis import UP
from sim.rock.centreline import headings_of, left_of
from sim.scene import World, build_world
from sim.session.labels import list_changes
from sim.studies.contour import contour_roughness

_KEYFRAME_M = 1.0
_FIT_M = 8.0  # longer features along a drift of a foreign mesh belong to its section

_KINDS = ("added", "removed", "moved", "reshaped")


@dataclass(frozen=True, slots=True)
class WorldFigures:
    """The figures of one world; NaN without measurements.

    Attributes:
        family: Scenario family.
        seed: Its seed.
        before_path_m, after_path_m: Horizontal length of the path of the sensor.
        width_m, height_m: Void to the sides of the sensor and above and below it, median over the before path.
        n_added, n_removed, n_moved, n_reshaped: Changes by kind; a moved prop counts once.
        hull_m3: Hull volume of every change.
        distractors_per_100m: Unchanged props within two score radii of the before path, per 100 m of it.
        far_share: Share of the before path's keyframes, a metre apart, farther than two score radii from the middle of
            every change; 1 without changes.
        repose_deg: Angle of repose of every pile, measured on its surface.
        roughness_m: Contour roughness of the walls.
        interpenetration_m: Deepest that any settled prop is in rock or another prop.
        n_triangles: Triangles of the before scene.
        build_s: CPU time of the world and both lines through it.
    """

    family: str
    seed: int
    before_path_m: float
    after_path_m: float
    width_m: float
    height_m: float
    n_added: int
    n_removed: int
    n_moved: int
    n_reshaped: int
    hull_m3: tuple[float, ...]
    distractors_per_100m: float
    far_share: float
    repose_deg: tuple[float, ...]
    roughness_m: float
    interpenetration_m: float
    n_triangles: int
    build_s: float

    @property
    def n_changes(self) -> int:
        """Number of changed props."""
        return self.n_added + self.n_removed + self.n_moved + self.n_reshaped


@dataclass(frozen=True, slots=True)
class Failure:
    """A seed whose world could not be built or driven, with the reason."""

    family: str
    seed: int
    reason: str


@dataclass(frozen=True, slots=True)
class Survey:
    """The worlds of some seeds of one family, in the order of the seeds.

    Attributes:
        family: Name or file of the scenario.
        worlds: Those that could be built.
        failures: Those that could not.
    """

    family: str
    worlds: tuple[WorldFigures, ...]
    failures: tuple[Failure, ...]


def survey(family: str, seeds: Sequence[int], workers: int = 1, on_progress: Progress | None = None) -> Survey:
    """Build and measure the worlds of a family. A seed that fails is recorded with its reason.

    Args:
        family: Name of a scenario, or a YAML file.
        seeds: The seeds.
        workers: Number of processes; only `build_s` depends on it.
        on_progress: Called with the family, the seeds done and their number.

    Raises:
        ScenarioError: The scenario is unknown, or its file has mistakes.
    """
    report = on_progress or report_nothing
    load_scenario(family, seeds[0])  # mistakes in the file concern all seeds
    report(family, 0, len(seeds))
    found: dict[int, WorldFigures | Failure] = {}
    for result in _results(family, seeds, workers):
        found[result.seed] = result
        report(family, len(found), len(seeds))
    in_order = [found[seed] for seed in seeds]
    return Survey(
        family,
        tuple(result for result in in_order if isinstance(result, WorldFigures)),
        tuple(result for result in in_order if isinstance(result, Failure)),
    )


def survey_seed(family: str, seed: int) -> WorldFigures:
    """Build and measure one world.

    Raises:
        ScenarioError: It cannot be built or driven.
    """
    scenario = load_scenario(family, seed)
    start_s = time.process_time()
    world = build_world(scenario, seed)
    before, after = (
        plan_trajectory(world, scenario, load_sensor(scenario, name), seed, name).true.points
        for name in ("before", "after")
    )
    build_s = time.process_time() - start_s
    changes = {tally.change.name: tally.change for tally in list_changes(scenario, world)}
    kinds = [change.kind for change in changes.values()]
    places, headings = keyframes(before)
    width_m, height_m = void_size_m(world.walls, places, headings)
    far_m = 2 * scenario.score_radius_m
    return WorldFigures(
        family=scenario.family,
        seed=seed,
        before_path_m=float(_way_m(before)[-1]),
        after_path_m=float(_way_m(after)[-1]),
        width_m=width_m,
        height_m=height_m,
        n_added=kinds.count("added"),
        n_removed=kinds.count("removed"),
        n_moved=kinds.count("moved"),
        n_reshaped=kinds.count("reshaped"),
        hull_m3=tuple(change.hull_volume_m3 for change in changes.values()),
        distractors_per_100m=distractors_per_100m(world, places, far_m),
        far_share=far_share(world, places, far_m),
        repose_deg=_repose_deg(world),
        roughness_m=contour_roughness(world.walls, world.centreline, _FIT_M if scenario.tunnel.mesh else None).rms_m,
        interpenetration_m=_deepest_m(world),
        n_triangles=sum(len(mesh.faces) for mesh in world.before.meshes),
        build_s=build_s,
    )


def far_share(world: World, places: Float64Array, far_m: float) -> float:
    """Return the share of places (N, 3) farther than `far_m` from the middle of every changed prop."""
    middles = [standing_middle(item) for item in world.standing if item.prop.change != "none"]
    if not middles:
        return 1.0
    distance_m = np.linalg.norm(places[:, None] - np.array(middles)[None], axis=2)
    return float((distance_m.min(axis=1) > far_m).mean())


def distractors_per_100m(world: World, places: Float64Array, near_m: float) -> float:
    """Return the unchanged props within `near_m` of a path, per 100 m of it; places (N, 3) stand for a metre each."""
    middles = [standing_middle(item) for item in world.standing if item.prop.change == "none"]
    near = [bool(np.linalg.norm(places - middle, axis=1).min() <= near_m) for middle in middles]
    return 100.0 * float(sum(near)) / (len(places) * _KEYFRAME_M)


def keyframes(points: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return places (K, 3) and unit headings (K, 2) a metre apart along a finely sampled path (N, 3)."""
    way_m = _way_m(points)
    stations_m: Float64Array = np.arange(0.0, way_m[-1], _KEYFRAME_M)
    places = np.stack([np.interp(stations_m, way_m, points[:, axis]) for axis in range(3)], axis=1)
    return places, headings_of(places)


def void_size_m(walls: Caster, places: Float64Array, headings: Float64Array) -> tuple[float, float]:
    """Return the median width and height of the void about places (N, 3) on a path."""
    left = np.column_stack([left_of(headings), np.zeros(len(headings))])
    reach_m = [walls.cast(places, way)[0] for way in (left, -left, UP, -UP)]
    return float(np.median(reach_m[0] + reach_m[1])), float(np.median(reach_m[2] + reach_m[3]))


def _results(family: str, seeds: Sequence[int], workers: int) -> Iterator[WorldFigures | Failure]:
    if workers == 1:
        yield from (_try_seed(family, seed) for seed in seeds)
        return
    with ThreadPoolExecutor(workers) as pool:
        for task in as_completed([pool.submit(_try_isolated, family, seed) for seed in seeds]):
            yield task.result()


def _try_isolated(family: str, seed: int) -> WorldFigures | Failure:
    """Try a seed in a process of its own."""
    try:
        return _RESULT.validate_python(run_isolated(try_document, [family, seed]))
    except ProcessDiedError as death:
        return Failure(family, seed, f"the process died: {death}")


def try_document(document: list[Any]) -> dict[str, Any]:
    """Try a seed, given [family, seed], and return the fields of its result."""
    return asdict(_try_seed(*document))


_RESULT: TypeAdapter[WorldFigures | Failure] = TypeAdapter(WorldFigures | Failure)


def _try_seed(family: str, seed: int) -> WorldFigures | Failure:
    try:
        return survey_seed(family, seed)
    except TunnelcdError as error:
        return Failure(family, seed, " ".join(str(error).split()))
    except Exception as error:  # a bug with one seed is a result of the survey, recorded with its type
        return Failure(family, seed, f"{type(error).__name__}: {' '.join(str(error).split())}")


def _way_m(points: Float64Array) -> Float64Array:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1))])


def _repose_deg(world: World) -> tuple[float, ...]:
    """Return the angles of repose of all whole piles; partly loaded ones are left out."""
    whole = {item.prop.name: item for item in reversed(world.standing) if item.prop.kind == "muck_pile"}
    return tuple(flank_angle_deg(item.shape) for item in whole.values())


def _deepest_m(world: World) -> float:
    """Return the largest depth of a settled prop in rock or another prop of its session; piles may overlap."""
    depths = [0.0]
    for index, item in enumerate(world.standing):
        others = [
            other
            for other in world.standing[index + 1 :]
            if item.sessions & other.sessions and (item.shape.is_settled or other.shape.is_settled)
        ]
        depths.append(interpenetration_m(item, world.walls, others))
    return max(depths)


def write_csv(path: Path, surveys: Sequence[Survey]) -> None:
    """Write one row per seed, failures with their reason; lists are written as their smallest, median and largest.

    Raises:
        InputError: The file cannot be written.
    """
    rows = [_csv_row(world) for one in surveys for world in one.worlds]
    rows += [
        {"family": lost.family, "seed": lost.seed, "failure": lost.reason} for one in surveys for lost in one.failures
    ]
    names = list(dict.fromkeys(name for row in rows for name in row))
    try:
        path.parent.stat()  # a new folder is not made
        with whole_file(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, [*(name for name in names if name != "failure"), "failure"])
            writer.writeheader()
            writer.writerows(rows)
    except OSError as error:
        raise InputError(f"{path}: cannot write there: {error.strerror}") from error


def summary(one: Survey) -> dict[str, str]:
    """Return a family's row of the table: column to text, "-" where nothing was measured."""
    worlds = one.worlds
    n_seeds = len(worlds) + len(one.failures)
    kinds = {kind: sum(getattr(world, f"n_{kind}") for world in worlds) for kind in _KINDS}
    counts = [float(world.n_changes) for world in worlds]
    hulls = [volume for world in worlds for volume in world.hull_m3]
    deepest = [1000 * world.interpenetration_m for world in worlds]
    return {
        "family": one.family,
        "worlds": f"{len(worlds)} of {n_seeds}",
        "path before, m": _range([world.before_path_m for world in worlds], ".0f"),
        "path after, m": _range([world.after_path_m for world in worlds], ".0f"),
        "width, m": _range([world.width_m for world in worlds], ".1f"),
        "height, m": _range([world.height_m for world in worlds], ".1f"),
        "changes": _range(counts, ".0f"),
        "added, removed, moved, reshaped": ", ".join(str(kinds[kind]) for kind in _KINDS),
        "hull, m3": _range(hulls, ".2f"),
        "distractors per 100 m": _range([world.distractors_per_100m for world in worlds], ".1f"),
        "far keyframes": _mean_and_least([world.far_share for world in worlds]),
        "repose, deg": _range([angle for world in worlds for angle in world.repose_deg], ".1f"),
        "roughness, m": _range([world.roughness_m for world in worlds], ".3f"),
        "deepest in rock, mm": f"{max(deepest):.1f}" if deepest else "-",
        "triangles, 1000": _range([world.n_triangles / 1000 for world in worlds], ".0f"),
        "build, CPU s": _range([world.build_s for world in worlds], ".1f"),
    }


def markdown(surveys: Sequence[Survey]) -> str:
    """Return the table of some families in Markdown, one row each; three figures are least - median - largest."""
    rows = [summary(one) for one in surveys]
    lines = [list(rows[0]), ["---"] * len(rows[0]), *([f"`{row['family']}`", *list(row.values())[1:]] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _csv_row(world: WorldFigures) -> dict[str, object]:
    row: dict[str, object] = {}
    for name, value in asdict(world).items():
        if not isinstance(value, tuple):
            row[name] = value
            continue
        spread = (min(value), float(np.median(value)), max(value)) if value else ("", "", "")
        row |= dict(zip((f"{name}_min", f"{name}_median", f"{name}_max"), spread, strict=True))
    return row


def _range(values: Sequence[float], form: str) -> str:
    known = [value for value in values if not np.isnan(value)]
    if not known:
        return "-"
    return " - ".join(format(value, form) for value in (min(known), float(np.median(known)), max(known)))


def _mean_and_least(shares: Sequence[float]) -> str:
    return f"{100 * np.mean(shares):.0f} %, least {100 * min(shares):.0f} %" if shares else "-"
