"""A pair of sessions with its truth, from a drawn scenario to files."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from cdpipe.errors import InputError
from cdpipe.geometry import Float64Array, Int64Array
from cdpipe.ouster import SensorMetadata, load_profile
from cdpipe.session import ScanChunk, SessionWriter
from scenarios.schema import Scenario
from sim.labels import Tally, claim_returns, list_changes
from sim.lidar import Scan, revolution_rays, scan
from sim.scene import Scene, World, build_world
from sim.trajectory import Trajectory, plan_trajectory
from sim.truth import Int16Array, PairTruth, write_labels, write_pair_truth, write_true_poses

CHUNK_SCANS = 64
_THREADS = 2

Progress = Callable[[str, int, int], None]
SessionName = Literal["before", "after"]


@dataclass(frozen=True, slots=True, eq=False)
class _Revolution:
    """One simulated revolution: the scan, where changed props were hit, and how many rays met each ghost."""

    scan: Scan
    hits: dict[int, tuple[Int64Array, Int64Array, Float64Array]]
    ghost_rays: dict[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class _Drive:
    """Everything that stays the same while one session is simulated."""

    name: SessionName
    scenario: Scenario
    scene: Scene
    sensor: SensorMetadata
    trajectory: Trajectory
    tallies: tuple[Tally, ...]
    seed: int


def simulate_pair(scenario: Scenario, seed: int, out: Path, on_progress: Progress | None = None) -> None:
    """Write `out/before`, `out/after` and `out/truth`; `out` appears under its name only when it is complete.

    The same scenario and seed give the same bytes, whatever the number of threads.

    Args:
        scenario: The scenario as drawn.
        seed: Draws everything the scenario leaves open: rock, noise, signs of drift.
        out: A folder that does not exist or is empty.
        on_progress: Called with the stage ("world", "before", "after"), and how much of how much is done.

    Raises:
        InputError: `out` is not empty or cannot be written, or the sensor profile cannot be read.
        ScenarioError: The world contradicts itself.
    """
    report = on_progress or (lambda stage, done, total: None)
    _refuse_taken(out)
    sensor = load_profile(scenario.sensor.profile, scenario.sensor.mode)
    report("world", 0, 1)
    world = build_world(scenario, seed)
    drives = _drives(scenario, world, sensor, seed)
    report("world", 1, 1)
    home = out.absolute()
    partial = home.with_name(f".{home.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir(parents=True)
        with ThreadPoolExecutor(min(_THREADS, os.cpu_count() or 1)) as pool:
            for drive in drives:
                _write_session(drive, partial / drive.name, pool, report)
        changes = tuple(tally.finished() for tally in drives[0].tallies)
        drawn = scenario.model_dump(mode="json")
        write_pair_truth(partial, PairTruth(scenario.family, seed, scenario.score_radius_m, changes, drawn))
        partial.replace(home)
    except OSError as error:
        raise InputError(f"{out}: cannot write there: {error.strerror or error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _refuse_taken(out: Path) -> None:
    if out.is_dir() and not any(out.iterdir()):
        return
    if out.exists() or out.is_symlink():
        raise InputError(f"{out}: exists and is not an empty folder: name a new one or remove it")


def _drives(scenario: Scenario, world: World, sensor: SensorMetadata, seed: int) -> list[_Drive]:
    tallies = tuple(list_changes(scenario, world))
    names: tuple[SessionName, SessionName] = ("before", "after")
    scenes = (world.before, world.after)
    return [
        _Drive(name, scenario, scene, sensor, plan_trajectory(world, scenario, sensor, seed, name), tallies, seed)
        for name, scene in zip(names, scenes, strict=True)
    ]


def _write_session(drive: _Drive, folder: Path, pool: Executor, report: Progress) -> None:
    n_scans = drive.trajectory.n_scans
    provenance = {
        "made_by": "tunnelcd simulate",
        "family": drive.scenario.family,
        "seed": drive.seed,
        "session": drive.name,
        "sensor_profile": drive.scenario.sensor.profile,
    }
    report(drive.name, 0, n_scans)
    with SessionWriter(folder, drive.sensor, CHUNK_SCANS, provenance) as writer:
        for index, start in enumerate(range(0, n_scans, CHUNK_SCANS)):
            scans = slice(start, min(start + CHUNK_SCANS, n_scans))
            revolutions = list(pool.map(lambda number: _revolution(drive, number), range(scans.start, scans.stop)))
            chunk = ScanChunk(
                np.stack([each.scan.range_mm for each in revolutions]),
                np.stack([each.scan.reflectivity for each in revolutions]),
                drive.trajectory.column_stamps_ns(scans),
                drive.trajectory.sensor_T_column(scans),
            )
            writer.add(chunk)
            instance, change = _labels(drive, scans, revolutions)
            write_labels(writer.folder, index, instance, change)
            report(drive.name, scans.stop, n_scans)
        write_true_poses(writer.folder, drive.trajectory.world_T_sensor)
        writer.close(drive.trajectory.odom_T_sensor)


def _revolution(drive: _Drive, number: int) -> _Revolution:
    """Simulate one revolution; depends on nothing but its number, so any thread may do it."""
    world_T_column = drive.trajectory.world_T_column(slice(number, number + 1))[0]
    rays = revolution_rays(drive.sensor, world_T_column)
    result = scan(drive.scene, drive.sensor, drive.scenario.sensor, rays, drive.seed, drive.name, number)
    distance_m = np.where(result.geom >= 0, result.true_range_m - drive.sensor.beam_origin_m, 0.0).T
    owner = drive.scene.instance[result.geom]
    hits, ghost_rays = {}, {}
    for tally in drive.tallies:
        change = tally.change
        if change.session != drive.name:
            ghost_rays[change.id] = tally.ghost.count(rays, distance_m)
            continue
        row, column = np.nonzero((owner == change.instance) & (result.geom >= 0))
        if len(row):
            reach = distance_m[column, row][:, None]
            points_world = rays.origins[column, row] + reach * rays.directions[column, row]
            hits[change.id] = (row, column, points_world)
    return _Revolution(result, hits, ghost_rays)


def _labels(drive: _Drive, scans: slice, revolutions: list[_Revolution]) -> tuple[Int16Array, Int16Array]:
    """Label every return of a chunk (s, H, W) with its prop and its change, and add to the tallies."""
    geom = np.stack([each.scan.geom for each in revolutions])
    instance = np.where(geom >= 0, drive.scene.instance[geom], -1).astype(np.int16)
    change = np.zeros_like(instance)
    for tally in drive.tallies:
        change_id = tally.change.id
        tally.n_ghost_rays += sum(each.ghost_rays.get(change_id, 0) for each in revolutions)
        for place, each in enumerate(revolutions):
            if change_id in each.hits:
                row, column, points_world = each.hits[change_id]
                points_odom = _measured(drive, scans.start + place, each.scan, row, column)
                belongs = claim_returns(tally, points_world, points_odom)
                change[place, row[belongs], column[belongs]] = change_id
    return instance, change


def _measured(drive: _Drive, number: int, result: Scan, row: Int64Array, column: Int64Array) -> Float64Array:
    """Place (N, 3) of some returns of a revolution as the session has them, odom frame."""
    sensor, trajectory = drive.sensor, drive.trajectory
    reach = result.range_mm[row, column][:, None] / 1000.0 - sensor.beam_origin_m
    points_sensor = sensor.origins[row, column] + reach * sensor.directions[row, column]
    poses = trajectory.estimated.poses(trajectory.revolution_m[number] + trajectory.column_m[column])
    return np.asarray(np.einsum("nij,nj->ni", poses[:, :3, :3], points_sensor) + poses[:, :3, 3])
