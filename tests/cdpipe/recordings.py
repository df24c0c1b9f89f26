"""Recordings made with the vendor's SDK, for tests: importing this skips them where it is not installed."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, transform, yaw_pose
from cdpipe.io.readers import open_session
from cdpipe.sensor.ouster import SensorMetadata, load_profile

core = pytest.importorskip("ouster.sdk.core", reason="pip install 'tunnelcd[ouster]'")
from ouster.sdk import osf, pcap  # noqa: E402 - only where the extra is installed

HALF_ROOM_M = np.array([6.0, 4.0, 2.5])
START_NS = 987_654_321_000
SENSOR = load_profile("os1-32-g", "512x10")
FIELDS = (("RANGE", np.uint32), ("REFLECTIVITY", np.uint8), ("SIGNAL", np.uint16))


def odom_T_sensor(time_s: float) -> Float64Array:
    """A drive along a bend: 2 m/s, 0.4 rad/s."""
    return yaw_pose(0.4 * time_s, (2.0 * time_s, 0.3 * time_s**2, 0.1))


def info_of(sensor: SensorMetadata, profile: str = "RNG19_RFL8_SIG16_NIR16") -> Any:
    info = core.SensorInfo(json.dumps(sensor.to_json()))
    info.format.udp_profile_lidar = getattr(core.UDPProfileLidar, profile)
    return info


def frames(info: Any, n: int = 3, pose: Callable[[float], Float64Array] = odom_T_sensor) -> list[Any]:
    """Revolutions without gap, every column with its own pose; every third return missing."""
    draw = np.random.default_rng(11)
    made = []
    for number in range(n):
        frame = core.LidarFrame(info, [core.FieldType(name, kind) for name, kind in FIELDS])
        frame.frame_id = 7 + number
        for name, kind in FIELDS:
            frame.field(name)[:] = (
                draw.integers(500, min(60_000, np.iinfo(kind).max + 1), (frame.h, frame.w))
                if (kind is not np.uint8)
                else draw.integers(0, 256, (frame.h, frame.w))
            )
        frame.field("RANGE")[draw.random((frame.h, frame.w)) < 0.3] = 0
        time_s = 0.1 * number + np.arange(frame.w) * 0.1 / frame.w
        frame.timestamp[:] = START_NS + np.round(time_s * 1e9).astype(np.int64)
        frame.packet_timestamp[:] = frame.timestamp[:: info.format.columns_per_packet]
        frame.measurement_id[:] = np.arange(frame.w)
        frame.status[:] = 1
        frame.body_to_world[:] = np.stack([pose(t) for t in time_s])
        made.append(frame)
    return made


def write_frames(path: Path, info: Any, made: list[Any]) -> Path:
    with osf.Writer(str(path), info) as writer:
        for frame in made:
            writer.save(0, frame)
    return path


def record(path: Path, info: Any, made: list[Any], serial: int = 0) -> Path:
    """A capture of the frames' packets, and the metadata beside it."""
    packets = []
    for frame in made:
        some = core.frame_to_packets(frame, core.PacketFormat.from_info(info), 0, serial)
        for number, packet in enumerate(some):
            packet.host_timestamp = int(frame.timestamp[16 * number])
        packets += some
    pcap.record(packets, str(path))
    path.with_suffix(".json").write_text(info.to_json_string())
    return path


def vendor_points(path: Path) -> list[Float64Array]:
    """Points of every revolution in the frame of its poses, as the SDK computes them."""
    clouds = []
    with osf.OsfFrameSetSource(str(path)) as source:
        lut = core.XYZLut(source.sensor_info[0], use_extrinsics=True)
        for (frame,) in source:
            points = core.dewarp(np.ascontiguousarray(lut(frame)), frame.body_to_world)
            clouds.append(points[frame.field("RANGE") > 0])
    return clouds


def our_points(path: Path) -> list[Float64Array]:
    return [transform(scan.odom_T_sensor, scan.points_sensor) for scan in open_session(path).scans()]


def said(call: Callable[[], object]) -> str:
    with pytest.raises(InputError) as caught:
        call()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def left(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def in_a_room(made: list[Any], world_T_sensor: Callable[[float], Float64Array]) -> None:
    """Give revolutions the ranges to the walls of a box of 12 x 8 x 5 m, each column from where the sensor then is."""
    for number, frame in enumerate(made):
        poses = np.stack([world_T_sensor(0.1 * number + 0.1 * column / frame.w) for column in range(frame.w)])
        directions = np.einsum("cij,hcj->hci", poses[:, :3, :3], SENSOR.directions)
        origins = np.einsum("cij,hcj->hci", poses[:, :3, :3], SENSOR.origins) + poses[:, :3, 3]
        with np.errstate(divide="ignore"):
            reach = ((np.sign(directions) * HALF_ROOM_M - origins) / directions).min(axis=-1)
        frame.field("RANGE")[:] = np.round(1000.0 * (reach + SENSOR.beam_origin_m))


def on_a_small_disk(call: str, n_bytes: int, *argv: str | Path) -> tuple[int, str, str]:
    """Run a call in a process of its own that can make no file longer than so many bytes.

    Returns its exit code, the `InputError` it raised, and what else the process wrote.
    """
    script = f"""
import resource, sys
from pathlib import Path
from cdpipe.core.errors import InputError
from cdpipe.io.ouster.osf import write_osf
from cdpipe.io.ouster.recording import import_recording
from cdpipe.io.session import read_session
resource.setrlimit(resource.RLIMIT_FSIZE, ({n_bytes}, {n_bytes}))
try:
    {call}
except InputError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", script, *argv], capture_output=True, text=True, check=False)
    return done.returncode, done.stdout, done.stderr


def write_tum(path: Path, first_s: float, last_s: float, rate_hz: float = 100.0) -> Path:
    lines = []
    for time_s in np.arange(first_s, last_s, 1 / rate_hz):
        pose = odom_T_sensor(time_s)
        numbers = [START_NS / 1e9 + time_s, *pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        lines.append(" ".join(f"{number:.9f}" for number in numbers))
    path.write_text("\n".join(lines) + "\n")
    return path
