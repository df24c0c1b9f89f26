"""What the sensor is held against: the real revolution, and simulated revolutions of a world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array
from cdpipe.io.ouster.captures import open_recording
from cdpipe.sensor.ouster import SensorMetadata
from eval.studies.reality.sensor_measures import Revolutions, destaggered
from scenarios.library import load_scenario
from scenarios.schema import Sensor
from sim.drive.trajectory import record
from sim.scene import Scene
from sim.sensor.lidar import Scan, scan
from sim.sensor.rays import revolution_rays
from sim.session.revolution import Drive
from sim.session.simulate import plan_drives

RECORDING = "OS-1-32-G_v2.1.1_1024x10"


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
    return plan_drives(load_scenario(family, seed, settings), sensor, seed)[0]


def with_effects(drive: Drive, settings: Sensor) -> Drive:
    """Return the same drive recorded with other effects: where the scan does not roll, its columns have one pose."""
    scenario = drive.scenario.model_copy(update={"sensor": settings})
    trajectory = record(drive.trajectory.true, scenario, drive.sensor, drive.seed, drive.name)
    return replace(drive, scenario=scenario, trajectory=trajectory)


def standing(drive: Drive, number: int, n_revolutions: int) -> Drive:
    """Return revolutions all recorded where a drive recorded the middle column of one, the sensor standing still."""
    still = replace(
        drive.trajectory,
        revolution_s=np.full(n_revolutions, drive.trajectory.revolution_s[number]),
        column_s=np.zeros(drive.sensor.width),
    )
    return replace(drive, trajectory=still)


def cast_at_origin(scene: Scene, sensor: SensorMetadata, settings: Sensor, number: int) -> Scan:
    """Return a revolution of a sensor that stands still at the origin of a scene."""
    poses = np.broadcast_to(np.eye(4), (sensor.width, 4, 4))
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
