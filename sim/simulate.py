"""A pair of sessions with its truth, from a drawn scenario to files."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from cdpipe.errors import InputError
from cdpipe.geometry import Float64Array, Int64Array
from cdpipe.ouster import SensorMetadata, load_profile
from cdpipe.session import ScanChunk, SessionWriter
from scenarios.schema import Scenario, SessionPlan
from sim.labels import Tally, claim_returns, count_other, list_changes
from sim.lidar import Rays, Scan, revolution_rays, scan
from sim.odometry import odom_start, registered, require_kiss_icp
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
        on_progress: Called with the stage ("world", "before", "after"; "odometry before", "odometry after" first where
            KISS-ICP estimates it), and how much of how much is done.

    Raises:
        InputError: `out` is not empty or cannot be written, the sensor profile or a trajectory cannot be read, or
            KISS-ICP is asked for and not installed.
        ScenarioError: The world contradicts itself.
    """
    report = on_progress or (lambda stage, done, total: None)
    _refuse_taken(out)
    if "kiss-icp" in (scenario.before.odometry.source, scenario.after.odometry.source):
        require_kiss_icp()
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
                _write_session(_with_own_odometry(drive, pool, report), partial / drive.name, pool, report)
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


def _with_own_odometry(drive: _Drive, pool: Executor, report: Progress) -> _Drive:
    """Let KISS-ICP estimate the drive, where the session asks for it, from the very scans that will be written."""
    plan: SessionPlan = getattr(drive.scenario, drive.name)
    if plan.odometry.source != "kiss-icp":
        return drive
    trajectory = drive.trajectory
    start = odom_start(trajectory.true, float(trajectory.revolution_s[0]))
    estimated = registered(
        _range_images(drive, pool, report),
        drive.sensor,
        trajectory.revolution_s,
        trajectory.column_s,
        start,
        drive.name,
    )
    return replace(drive, trajectory=replace(trajectory, estimated=estimated))


def _range_images(drive: _Drive, pool: Executor, report: Progress) -> Iterator[npt.NDArray[np.uint32]]:
    n_scans = drive.trajectory.n_scans
    for start in range(0, n_scans, CHUNK_SCANS):
        report(f"odometry {drive.name}", start, n_scans)
        numbers = range(start, min(start + CHUNK_SCANS, n_scans))
        yield from pool.map(lambda number: _cast(drive, number)[1].range_mm, numbers)
    report(f"odometry {drive.name}", n_scans, n_scans)


def _write_session(drive: _Drive, folder: Path, pool: Executor, report: Progress) -> None:
    n_scans = drive.trajectory.n_scans
    provenance = {
        "made_by": "tunnelcd simulate",
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
                np.stack([each.scan.signal for each in revolutions]),
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
    rays, result = _cast(drive, number)
    distance_m = np.where(result.geom >= 0, result.true_range_m - drive.sensor.beam_origin_m, 0.0).T
    owner = drive.scene.instance[result.geom]
    hits, ghost_rays = {}, {}
    for tally in drive.tallies:
        change = tally.change
        if change.session != drive.name:
            ghost_rays[change.id] = tally.ghost.count(rays, distance_m)
        row, column = np.nonzero((owner == change.instance) & (result.geom >= 0))
        if len(row):
            reach = distance_m[column, row][:, None]
            points_world = rays.origins[column, row] + reach * rays.directions[column, row]
            hits[change.id] = (row, column, points_world)
    return _Revolution(result, hits, ghost_rays)


def _cast(drive: _Drive, number: int) -> tuple[Rays, Scan]:
    world_T_column = drive.trajectory.world_T_column(slice(number, number + 1))[0]
    rays = revolution_rays(drive.sensor, world_T_column)
    return rays, scan(drive.scene, drive.sensor, drive.scenario.sensor, rays, drive.seed, drive.name, number)


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
                if tally.change.session != drive.name:
                    count_other(tally, points_odom)
                    continue
                belongs = claim_returns(tally, points_world, points_odom)
                change[place, row[belongs], column[belongs]] = change_id
    return instance, change


def _measured(drive: _Drive, number: int, result: Scan, row: Int64Array, column: Int64Array) -> Float64Array:
    """Place (N, 3) of some returns of a revolution as the session has them, odom frame."""
    sensor, trajectory = drive.sensor, drive.trajectory
    reach = result.range_mm[row, column][:, None] / 1000.0 - sensor.beam_origin_m
    points_sensor = sensor.origins[row, column] + reach * sensor.directions[row, column]
    poses = trajectory.odom_T_column(number, column)
    return np.asarray(np.einsum("nij,nj->ni", poses[:, :3, :3], points_sensor) + poses[:, :3, 3])
