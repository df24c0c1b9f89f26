"""A pair of sessions simulated into memory: what `simulate_pair` writes, for those who read it once."""

from __future__ import annotations

import os
from collections.abc import Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cdpipe.core.geometry import Float64Array
from cdpipe.io.session import ScanChunk, Session
from cdpipe.mapping.odometry import require_kiss_icp
from cdpipe.sensor.ouster import load_profile
from scenarios.references import file_digests
from scenarios.schema import Scenario
from sim.session.revolution import Drive, SessionName
from sim.session.simulate import CHUNK_SCANS, labelled_chunks, pair_truth, plan_drives, with_own_odometry
from sim.session.truth import Int16Array, PairTruth


@dataclass(frozen=True, slots=True, eq=False)
class HeldSession(Session):
    """A session whose chunks lie in memory; `path` names it in messages and is no folder."""

    held: tuple[ScanChunk, ...] = ()

    def chunk(self, index: int) -> ScanChunk:
        """Return one chunk."""
        return self.held[index]


@dataclass(frozen=True, slots=True, eq=False)
class LabelledSession:
    """A held session with its truth, which is apart from it as it is on disk.

    Attributes:
        session: What the robot recorded.
        world_T_sensor: (S, 4, 4) true poses.
        instance: (S, H, W) int16 as in `sim.session.truth`.
        change: (S, H, W) int16 as in `sim.session.truth`.
    """

    session: Session
    world_T_sensor: Float64Array
    instance: Int16Array
    change: Int16Array


@dataclass(frozen=True, slots=True, eq=False)
class HeldPair:
    """A pair with its truth, in memory."""

    truth: PairTruth
    sessions: Mapping[SessionName, LabelledSession]


def simulate_in_memory(scenario: Scenario, seed: int, n_threads: int = 1) -> HeldPair:
    """Simulate a pair into memory, about 0.5 MB a revolution; to the byte what `simulate_pair` writes.

    Args:
        scenario: The scenario as drawn.
        seed: Draws everything the scenario leaves open.
        n_threads: Threads that cast revolutions.

    Raises:
        InputError: The sensor profile, a trajectory or another file cannot be read, or KISS-ICP is asked for and not
            installed.
        ScenarioError: The world contradicts itself.
    """
    if "kiss-icp" in (scenario.before.odometry.source, scenario.after.odometry.source):
        require_kiss_icp("odometry.source = kiss-icp")
    files = file_digests(scenario)
    drives = plan_drives(scenario, load_profile(scenario.sensor.profile, scenario.sensor.mode), seed)
    with ThreadPoolExecutor(min(n_threads, os.cpu_count() or 1)) as pool:
        sessions = {drive.name: _held(drive, pool) for drive in drives}
    return HeldPair(pair_truth(scenario, seed, drives, files), sessions)


def _held(drive: Drive, pool: Executor) -> LabelledSession:
    drive = with_own_odometry(drive, pool, lambda stage, done, total: None)
    with closing(labelled_chunks(drive, pool)) as chunks:
        chunk, instance, change = zip(*chunks, strict=True)
    session = HeldSession(
        Path(drive.name), drive.sensor, drive.trajectory.odom_T_sensor, CHUNK_SCANS, {"session": drive.name}, chunk
    )
    return LabelledSession(session, drive.trajectory.world_T_sensor, np.concatenate(instance), np.concatenate(change))
