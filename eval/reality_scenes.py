"""What the sensor is held against: the real revolution, and simulated revolutions of a world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cdpipe.captures import open_recording
from cdpipe.errors import InputError
from cdpipe.geometry import Float64Array
from cdpipe.ouster import SensorMetadata
from eval.sensor_measures import Revolutions, destaggered
from scenarios.library import load_scenario
from scenarios.schema import Scenario, Sensor
from sim.lidar import Scan, scan
from sim.rays import revolution_rays
from sim.scene import Scene, build_world
from sim.trajectory import Trajectory, plan_trajectory

RECORDING = "OS-1-32-G_v2.1.1_1024x10"


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """One session of a simulated world.

    Attributes:
        scenario: As drawn.
        seed: Its seed.
        scene: What the session's sensor meets.
        sensor: Its beam table.
        trajectory: Its way.
    """

    scenario: Scenario
    seed: int
    scene: Scene
    sensor: SensorMetadata
    trajectory: Trajectory


def find_recording(folder: Path | None) -> Path:
    """Return the path of the real revolution's PCAP below a folder, its metadata beside it.

    Raises:
        InputError: No folder is given, or it does not hold the two files.
    """
    wanted = f"{RECORDING}.pcap and {RECORDING}.json (both from the vendor's SDK repository, BSD-3)"
    if folder is None:
        raise InputError(f"no real recording: give --data or set TUNNELCD_REAL_DATA to a folder with {wanted}")
    for path in (folder / f"{RECORDING}.pcap", folder / "ouster" / f"{RECORDING}.pcap"):
        if path.is_file() and path.with_suffix(".json").is_file():
            return path
    raise InputError(f"{folder}: no real recording in it: expected {wanted}, there or in its folder ouster")


def real_revolution(pcap: Path) -> Revolutions:
    """Read the first revolution of a capture, destaggered.

    Raises:
        InputError: The extra `ouster` is not installed, or the capture is damaged or holds no whole revolution.
    """
    recording = open_recording(pcap)
    first = next(recording.revolutions())
    images = [destaggered(recording.sensor, each)[None] for each in (first.range_mm, first.signal, first.reflectivity)]
    return Revolutions(recording.sensor, images[0] / 1000.0, images[1], images[2])


def drive_of(family: str, seed: int, sensor: SensorMetadata, profile: str) -> Drive:
    """Build the world of a family's seed and plan its before session with a sensor.

    Raises:
        ScenarioError: The world cannot be built.
    """
    settings = [f"sensor.profile={profile}", f"sensor.mode={sensor.mode}"]
    scenario = load_scenario(family, seed, settings)
    world = build_world(scenario, seed)
    return Drive(scenario, seed, world.before, sensor, plan_trajectory(world, scenario, sensor, seed, "before"))


def column_poses(drive: Drive, number: int, is_rolling: bool = True) -> Float64Array:
    """Return the true poses (W, 4, 4) of a revolution's columns; not rolling: all as the middle one."""
    poses = drive.trajectory.world_T_column(slice(number, number + 1))[0]
    return poses if is_rolling else np.broadcast_to(poses[len(poses) // 2], poses.shape).copy()


def simulated(scene: Scene, sensor: SensorMetadata, settings: Sensor, poses: Float64Array, number: int) -> Scan:
    """Return what a sensor reports whose columns have poses (W, 4, 4)."""
    return scan(scene, sensor, settings, revolution_rays(sensor, poses), 0, "before", number)


def as_revolutions(sensor: SensorMetadata, scans: Sequence[Scan]) -> Revolutions:
    """Return simulated revolutions, destaggered."""
    ranges_mm, signal, reflectivity = (
        destaggered(sensor, np.stack([getattr(each, name) for each in scans]))
        for name in ("range_mm", "signal", "reflectivity")
    )
    return Revolutions(sensor, ranges_mm / 1000.0, signal, reflectivity)


def world_points(sensor: SensorMetadata, result: Scan, poses: Float64Array) -> Float64Array:
    """Return the reported points (N, 3) of a revolution, world frame, each column at its true pose."""
    points = sensor.project(result.range_mm / 1000.0).swapaxes(0, 1)
    turned = points @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
    return np.asarray(turned[result.range_mm.T > 0])
