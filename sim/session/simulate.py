"""A pair of sessions with its truth, from a drawn scenario to files or into memory."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float32Array, Float64Array
from cdpipe.core.plugins import extra_version, require_extra
from cdpipe.core.progress import Progress, report_nothing
from cdpipe.core.spooled import SpooledArray
from cdpipe.core.whole_file import hidden_folder
from cdpipe.core.yamlfile import setting_lines
from cdpipe.io.session import CHUNK_SCANS, ScanChunk, Session, SessionWriter, fit_chunk
from cdpipe.mapping.poses.odometry import Image
from scenarios.library import load_scenario
from scenarios.references import file_digests
from scenarios.schema import Scenario
from sim.drive.odometry import register_scans, start_pose
from sim.geometry.backends import name_backend, require_backend
from sim.session.planning import plan_drives
from sim.session.revolution import CHANNELS, SURFACE_CHANNELS, Drive, Revolution, simulate_revolution, tally_revolution
from sim.session.truth import (
    Int16Array,
    MoverTrack,
    MoverTruth,
    PairTruth,
    SessionName,
    write_labels,
    write_mover_track,
    write_pair_truth,
    write_surface_labels,
    write_true_poses,
)

THREADS = 2
# Bytes of each channel of a session that are held in memory until KISS-ICP has its poses; more are in a temporary file.
_HELD_BYTES = 1 << 25


def simulate(
    scenario: Scenario | Path | str,
    seed: int,
    out: Path | str,
    settings: Iterable[str] | Mapping[str, Any] | None = None,
) -> Path:
    """Simulate a pair of sessions with its truth, as `tunnelcd simulate` does.

    Args:
        scenario: A name such as "smoke/one_box", the path of a YAML file, or a scenario as drawn.
        seed: Draws every distribution of the scenario and all noise.
        out: A folder that does not exist or is empty.
        settings: Written over the YAML: `["sensor.dropouts=false"]`, `{"sensor.dropouts": False}` or
            `{"sensor": {"dropouts": False}}`.

    Returns:
        The folder: `before`, `after` and `truth` stand in it.

    Raises:
        InputError: As `simulate_pair`; or settings are given for a scenario that is drawn already.
        ScenarioError: The scenario is unknown, has mistakes, or contradicts itself.
    """
    if not isinstance(scenario, Scenario):
        scenario = load_scenario(str(scenario), seed, setting_lines(settings or ()))
    elif settings:
        raise InputError("settings: this scenario is drawn already: give its name or its file")
    simulate_pair(scenario, seed, Path(out))
    return Path(out)


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
        InputError: `out` is not empty, cannot be written or another writes it, the sensor profile or a trajectory
            cannot be read, or KISS-ICP is asked for and not installed.
        ScenarioError: The world contradicts itself.
    """
    report = on_progress or report_nothing
    if (out.exists() or out.is_symlink()) and not (out.is_dir() and not any(out.iterdir())):
        raise InputError(f"{out}: exists and is not an empty folder: name a new one or remove it")
    planned = _plan(scenario, seed, report)
    home = Path(os.path.realpath(out))  # a link to an empty folder is that folder
    try:
        with hidden_folder(home, out) as partial:
            _write(scenario, seed, *planned, partial, report)
            partial.replace(home)
    except OSError as error:
        raise InputError(f"{out}: cannot write there: {error.strerror or error}") from error


def write_pair(scenario: Scenario, seed: int, folder: Path, report: Progress = report_nothing) -> None:
    """Write `before`, `after` and `truth` into an empty folder that the caller holds, as `simulate_pair` does.

    Raises:
        InputError, ScenarioError: As `simulate_pair`.
    """
    planned = _plan(scenario, seed, report)
    try:
        _write(scenario, seed, *planned, folder, report)
    except OSError as error:
        raise InputError(f"{folder}: cannot write there: {error.strerror or error}") from error


def _write(
    scenario: Scenario, seed: int, drives: Sequence[Drive], files: Mapping[str, str], folder: Path, report: Progress
) -> None:
    with ThreadPoolExecutor(min(THREADS, os.cpu_count() or 1)) as pool:
        for drive in drives:
            write_session(drive, folder / drive.name, pool, report)
    write_pair_truth(folder, collect_truth(scenario, seed, drives, files))


def collect_truth(scenario: Scenario, seed: int, drives: Sequence[Drive], files: Mapping[str, str]) -> PairTruth:
    """Return the truth of a pair after both sessions were simulated."""
    changes = tuple(tally.finished() for tally in drives[0].tallies)
    drawn = scenario.model_dump(mode="json")
    movers = tuple(mover for drive in drives for mover in _list_movers(drive))
    told = scenario.family, seed, scenario.score_radius_m, changes, drawn, dict(files), movers
    return PairTruth(*told, drives[0].surface_changes)


def _list_movers(drive: Drive) -> Iterator[MoverTruth]:
    """Yield the truth of every mover of a session that was simulated."""
    time_s = drive.trajectory.revolution_s
    for mover, sightings in zip(drive.moving.movers, drive.sightings, strict=True):
        course = mover.course
        share = float((course.moment(time_s).activity > 0).mean()) if course.is_moving else 0.0
        n_returns = int(sightings[:, 0].sum())
        name, kind = mover.mover.name, mover.mover.kind
        yield MoverTruth(name, kind, mover.instance, drive.name, course.length_m, share, n_returns)


def track_movers(drive: Drive) -> MoverTrack | None:
    """Return where the movers of a session that was simulated were, and what was seen of them; None without movers."""
    if not drive.moving.movers:
        return None
    poses = np.stack([mover.world_T_root(drive.trajectory.revolution_s) for mover in drive.moving.movers])
    return MoverTrack(poses, drive.sightings[..., 0].astype(np.int32), drive.sightings[..., 1:])


def _plan(scenario: Scenario, seed: int, report: Progress) -> tuple[list[Drive], dict[str, str]]:
    """Return both drives and the digests of the scenario's files; refuse what cannot be simulated."""
    if "kiss-icp" in (scenario.before.odometry.source, scenario.after.odometry.source):
        require_extra("odometry", "odometry.source = kiss-icp")
    require_backend(scenario.sim.backend)
    files = file_digests(scenario)
    report("world", 0, 1)
    drives = plan_drives(scenario, seed)
    report("world", 1, 1)
    return drives, files


def write_session(drive: Drive, folder: Path, pool: Executor, report: Progress) -> None:
    """Simulate one session with its truth into `folder`, the revolutions in the threads of `pool`.

    Raises:
        OSError: It cannot be written.
    """
    n_scans = drive.trajectory.n_scans
    profile = drive.scenario.sensor.profile
    provenance = {"made_by": "tunnelcd simulate", "session": drive.session, "sensor_profile": profile}
    plan = drive.scenario.plan(drive.session)
    if drive.scenario.sim.backend != "embree":
        provenance["casting"] = name_backend(drive.moving.caster)
    if plan.odometry.source == "kiss-icp":
        provenance["odometry"] = f"kiss-icp {extra_version('kiss-icp')}"
    with (
        SessionWriter(folder, drive.sensor, _chunk_scans(drive), provenance, drive.scenario.sensor.n_returns) as writer,
        closing(_simulate_revolutions(drive, pool)) as revolutions,
    ):
        drive, kept = _estimate_odometry(drive, revolutions, report)
        report(drive.session, 0, n_scans)
        for index, (chunk, instance, change, surface) in enumerate(_fill_chunks(drive, kept)):
            writer.add(chunk)
            write_labels(writer.folder, index, instance, change)
            if surface is not None:
                write_surface_labels(writer.folder, index, *surface)
            report(drive.session, index * _chunk_scans(drive) + len(instance), n_scans)
        write_true_poses(writer.folder, drive.trajectory.world_T_sensor)
        if (track := track_movers(drive)) is not None:
            write_mover_track(writer.folder, track)
        writer.close(drive.trajectory.odom_T_sensor)


def _simulate_revolutions(drive: Drive, pool: Executor) -> Generator[Revolution]:
    """Yield the revolutions in order; as many as a chunk holds are simulated while the caller uses one."""
    ahead: deque[Future[Revolution]] = deque()
    try:
        for number in range(drive.trajectory.n_scans):
            ahead.append(pool.submit(simulate_revolution, drive, number))
            if len(ahead) > _chunk_scans(drive):
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
    finally:
        for each in ahead:
            each.cancel()


def _estimate_odometry(
    drive: Drive, revolutions: Iterator[Revolution], report: Progress
) -> tuple[Drive, Iterator[Revolution]]:
    """Let KISS-ICP estimate the poses of a session that asks for it, from the scans that will be written.

    Until the last pose is known the revolutions are kept in temporary files.

    Args:
        drive: The session's drive.
        revolutions: All its revolutions.
        report: Called with the stage "odometry before" or "odometry after".

    Returns:
        The drive with these poses, and all its revolutions.
    """
    plan = drive.scenario.plan(drive.session)
    if plan.odometry.source != "kiss-icp":
        return drive, revolutions
    trajectory = drive.trajectory
    shape = drive.sensor.height * drive.scenario.sensor.n_returns, drive.sensor.width
    kinds = CHANNELS | (SURFACE_CHANNELS if drive.rock is not None else {})
    channels = {name: SpooledArray(dtype, shape, _HELD_BYTES) for name, dtype in kinds.items()}
    ghost_rays, sightings = [], []

    def keep() -> Iterator[Image]:
        for number, revolution in enumerate(revolutions):
            if number % CHUNK_SCANS == 0:
                report(f"odometry {drive.session}", number, trajectory.n_scans)
            for name, spooled in channels.items():
                spooled.append(getattr(revolution, name))
            ghost_rays.append(revolution.ghost_rays)
            sightings.append(revolution.sightings)
            yield revolution.range_mm, revolution.signal
        report(f"odometry {drive.session}", trajectory.n_scans, trajectory.n_scans)

    start = start_pose(trajectory.true, float(trajectory.revolution_s[0]))
    estimated = register_scans(keep(), drive.sensor, trajectory.revolution_s, trajectory.column_s, start, drive.session)
    stored = zip(*(spooled.finish() for spooled in channels.values()), ghost_rays, sightings, strict=True)
    kept = (Revolution(**dict(zip((*channels, "ghost_rays", "sightings"), each, strict=True))) for each in stored)
    return replace(drive, trajectory=replace(trajectory, estimated=estimated)), kept


def _chunk_scans(drive: Drive) -> int:
    return fit_chunk(drive.sensor.height * drive.scenario.sensor.n_returns, drive.sensor.width, CHUNK_SCANS)


def _fill_chunks(
    drive: Drive, revolutions: Iterator[Revolution]
) -> Iterator[tuple[ScanChunk, Int16Array, Int16Array, tuple[Float32Array, Int16Array] | None]]:
    """Yield each chunk of a session with the truth of its returns, and update the tallies.

    The truth is instance and change (s, R, W), and where rock changes displacement and surface change (s, R, W).
    """
    trajectory = drive.trajectory
    for start in range(0, trajectory.n_scans, _chunk_scans(drive)):
        held = list(islice(revolutions, _chunk_scans(drive)))
        numbers = range(start, start + len(held))
        for number, revolution in zip(numbers, held, strict=True):
            tally_revolution(drive, number, revolution)
        chunk = ScanChunk(
            np.stack([each.range_mm for each in held]),
            np.stack([each.reflectivity for each in held]),
            np.stack([each.signal for each in held]),
            trajectory.column_stamps_ns(slice(start, start + len(held))),
            np.concatenate([trajectory.sensor_T_column(slice(number, number + 1)) for number in numbers]),
        )
        surface = [(each.displacement, each.surface_change) for each in held]
        moved = [(metres, ids) for metres, ids in surface if metres is not None and ids is not None]
        stacked = (np.stack([metres for metres, _ in moved]), np.stack([ids for _, ids in moved])) if moved else None
        yield chunk, np.stack([each.instance for each in held]), np.stack([each.change for each in held]), stacked


@dataclass(frozen=True, slots=True, eq=False)
class HeldSession(Session):
    """A session whose chunks are in memory; `path` is its name in messages, not a folder."""

    held: tuple[ScanChunk, ...] = ()

    def chunk(self, index: int) -> ScanChunk:
        """Return one chunk."""
        return self.held[index]


@dataclass(frozen=True, slots=True, eq=False)
class LabelledSession:
    """A session in memory and, apart from it, its truth.

    Attributes:
        session: What the robot recorded.
        world_T_sensor: (S, 4, 4) true poses.
        instance: (S, R, W) int16 as in `sim.session.truth`.
        change: (S, R, W) int16 as in `sim.session.truth`.
        displacement: (S, R, W) float32 metres, and
        surface_change: (S, R, W) int16 as in `sim.session.truth`; None where no rock changes.
    """

    session: Session
    world_T_sensor: Float64Array
    instance: Int16Array
    change: Int16Array
    displacement: Float32Array | None = None
    surface_change: Int16Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class HeldPair:
    """A pair with its truth, in memory."""

    truth: PairTruth
    sessions: Mapping[SessionName, LabelledSession]


def simulate_in_memory(scenario: Scenario, seed: int, n_threads: int = 1) -> HeldPair:
    """Simulate a pair into memory, about 0.5 MB per revolution. The arrays equal, to the byte, those on disk.

    Args:
        scenario: The scenario as drawn.
        seed: Draws everything the scenario leaves open.
        n_threads: Threads that cast revolutions.

    Raises:
        InputError: The sensor profile, a trajectory or another file cannot be read, or KISS-ICP is asked for and not
            installed.
        ScenarioError: The world contradicts itself.
    """
    drives, files = _plan(scenario, seed, report_nothing)
    with ThreadPoolExecutor(min(n_threads, os.cpu_count() or 1)) as pool:
        sessions = {drive.name: hold_session(drive, pool) for drive in drives}
    return HeldPair(collect_truth(scenario, seed, drives, files), sessions)


def hold_session(drive: Drive, pool: Executor) -> LabelledSession:
    """Simulate one session with its truth into memory, the revolutions in the threads of `pool`."""
    with closing(_simulate_revolutions(drive, pool)) as revolutions:
        drive, kept = _estimate_odometry(drive, revolutions, report_nothing)
        chunk, instance, change, surface = zip(*_fill_chunks(drive, kept), strict=True)
    session = HeldSession(
        Path(drive.name),
        drive.sensor,
        drive.trajectory.odom_T_sensor,
        _chunk_scans(drive),
        {"session": drive.name},
        chunk,
        n_returns=drive.scenario.sensor.n_returns,
    )
    labels = drive.trajectory.world_T_sensor, np.concatenate(instance), np.concatenate(change)
    moved = [each for each in surface if each is not None]
    if not moved:
        return LabelledSession(session, *labels)
    displacement, surface_change = (np.concatenate([each[part] for each in moved]) for part in (0, 1))
    return LabelledSession(session, *labels, displacement, surface_change)
