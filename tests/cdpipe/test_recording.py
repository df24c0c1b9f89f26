"""Recordings made with the vendor's SDK come in as sessions, and sessions leave as what it opens."""

from __future__ import annotations

import builtins
import importlib.util
import json
import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from cdpipe.captures import open_recording
from cdpipe.errors import InputError
from cdpipe.geometry import Float64Array, make_pose, transform, yaw_pose
from cdpipe.osf import write_osf
from cdpipe.ouster import SensorMetadata, load_profile
from cdpipe.ply import read_ply_points
from cdpipe.readers import open_scans
from cdpipe.recording import import_recording
from cdpipe.session import Session, read_session
from cdpipe.tum import motion_along

core = pytest.importorskip("ouster.sdk.core", reason="pip install 'tunnelcd[ouster]'")
from ouster.sdk import osf, pcap  # noqa: E402 - only where the extra is installed

needs_kiss_icp = pytest.mark.skipif(
    importlib.util.find_spec("kiss_icp") is None, reason="needs the extra `odometry`: KISS-ICP"
)
ROOT = Path(os.environ.get("TUNNELCD_REAL_DATA", "")) / "ouster"
needs_real_data = pytest.mark.skipif(
    "TUNNELCD_REAL_DATA" not in os.environ, reason="real recordings: TUNNELCD_REAL_DATA is not set"
)
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
    return [transform(scan.odom_T_sensor, scan.points_sensor) for scan in open_scans(path).scans()]


def said(call: Callable[[], object]) -> str:
    with pytest.raises(InputError) as caught:
        call()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def left(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def write_tum(path: Path, first_s: float, last_s: float, rate_hz: float = 100.0) -> Path:
    lines = []
    for time_s in np.arange(first_s, last_s, 1 / rate_hz):
        pose = odom_T_sensor(time_s)
        numbers = [START_NS / 1e9 + time_s, *pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        lines.append(" ".join(f"{number:.9f}" for number in numbers))
    path.write_text("\n".join(lines) + "\n")
    return path


# Coming in: OSF


def test_an_osf_with_poses_maps_to_the_points_of_the_vendor(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    info.sensor_to_body = make_pose(Rotation.from_euler("xyz", [0.1, -0.2, 3.0]).as_matrix(), (0.5, 0.2, 1.0))
    path = write_frames(tmp_path / "r.osf", info, frames(info))
    imported = import_recording(path, tmp_path / "s")
    assert (imported.n_scans, imported.poses) == (3, "own")
    for ours, vendor in zip(our_points(tmp_path / "s"), vendor_points(path), strict=True):
        np.testing.assert_allclose(ours, vendor, atol=2e-5)  # column poses are stored in float32
    session = read_session(tmp_path / "s")
    assert session.provenance["sensor_clock_start_ns"] == START_NS
    chunk = session.chunk(0)
    with osf.OsfFrameSetSource(str(path)) as source:
        for number, (frame,) in enumerate(source):
            np.testing.assert_array_equal(chunk.range_mm[number], frame.field("RANGE"))
            np.testing.assert_array_equal(chunk.reflectivity[number], frame.field("REFLECTIVITY"))
            np.testing.assert_array_equal(chunk.signal[number], frame.field("SIGNAL"))
            np.testing.assert_array_equal(chunk.column_stamps_ns[number] + START_NS, frame.timestamp)
    middle = info.w // 2
    np.testing.assert_allclose(
        session.odom_T_sensor[1], odom_T_sensor(0.1 + 0.1 * middle / info.w) @ info.sensor_to_body, atol=1e-9
    )


def test_missing_columns_have_no_returns_and_stamps_and_poses_in_between(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    made = frames(info, 2)
    gone = np.r_[0:5, 240:270, 500:512]  # the ends, and the middle whose pose is the revolution's
    whole_ns = made[1].timestamp.copy()
    made[1].status[gone] = 0
    made[1].timestamp[gone] = 0
    made[1].body_to_world[gone] = 0.0
    path = write_frames(tmp_path / "r.osf", info, made)
    import_recording(path, tmp_path / "s")
    session = read_session(tmp_path / "s")
    chunk = session.chunk(0)
    assert (chunk.range_mm[1][:, gone] == 0).all()
    assert (chunk.signal[1][:, gone] == 0).all()
    assert (np.delete(chunk.range_mm[1], gone, axis=1) == np.delete(made[1].field("RANGE"), gone, axis=1)).all()
    np.testing.assert_allclose(chunk.column_stamps_ns[1] + START_NS, whole_ns, atol=1)
    np.testing.assert_allclose(session.odom_T_sensor[1], odom_T_sensor(0.1 + 0.05), atol=1e-5)
    ends = chunk.column_poses[1][[0, 511]]
    expected = [np.linalg.inv(odom_T_sensor(0.15)) @ odom_T_sensor(0.1 + 0.1 * at / 512) for at in (0, 511)]
    np.testing.assert_allclose(ends[:, :3], [pose[:3, 3] for pose in expected], atol=1e-4)


def test_revolutions_cut_by_the_ends_of_the_recording_are_left_out(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    made = frames(info, 3)
    made[0].status[:300] = 0
    made[2].status[200:] = 0
    assert import_recording(write_frames(tmp_path / "r.osf", info, made), tmp_path / "s").n_scans == 1
    for frame in made:
        frame.status[250:] = 0
    path = write_frames(tmp_path / "cut.osf", info, made)
    assert "no whole revolution: of none of its 3 more than half" in said(
        lambda: import_recording(path, tmp_path / "t")
    )


def test_without_poses_it_says_what_to_give(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    path = write_frames(tmp_path / "r.osf", info, frames(info, 2, lambda _: np.eye(4)))
    told = said(lambda: import_recording(path, tmp_path / "s"))
    assert "no poses in it: give --trajectory FILE.tum" in told
    assert "--odometry kiss-icp" in told
    assert left(tmp_path) == ["r.osf"]
    tum = tmp_path / "t.tum"
    assert "leave one out" in said(lambda: import_recording(path, tmp_path / "s", trajectory=tum, odometry="kiss-icp"))
    assert "expected kiss-icp" in said(lambda: import_recording(path, tmp_path / "s", odometry="lio"))


def test_a_trajectory_is_interpolated_to_every_column(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    path = write_frames(tmp_path / "r.osf", info, frames(info, 3, lambda _: np.eye(4)))
    tum = write_tum(tmp_path / "t.tum", -0.05, 0.4)
    assert import_recording(path, tmp_path / "s", trajectory=tum).poses == "trajectory t.tum"
    session = read_session(tmp_path / "s")
    chunk = session.chunk(0)
    for scan, column in ((0, 0), (1, 77), (2, 511)):
        x, y, z, *quaternion = chunk.column_poses[scan, column]
        got = session.odom_T_sensor[scan] @ make_pose(Rotation.from_quat(quaternion).as_matrix(), (x, y, z))
        # between poses 10 ms apart a straight line leaves the bend by 0.3 / 4 * 0.01^2 m
        np.testing.assert_allclose(got, odom_T_sensor(0.1 * scan + 0.1 * column / 512), atol=1e-5)


def test_a_pose_per_revolution_at_its_first_column_is_enough(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    path = write_frames(tmp_path / "r.osf", info, frames(info, 3))
    tum = write_tum(tmp_path / "t.tum", 0.0, 0.25, rate_hz=10.0)
    import_recording(path, tmp_path / "s", trajectory=tum)
    np.testing.assert_allclose(read_session(tmp_path / "s").odom_T_sensor[2], odom_T_sensor(0.25), atol=5e-3)


@pytest.mark.parametrize(
    ("first_s", "last_s", "rate_hz", "expected"),
    [
        (-0.1, 0.1, 100.0, "covers 987.554 to 987.744 s, the recording 987.654 to 987.954 s of the sensor's clock"),
        (0.2, 0.5, 100.0, "the stamps must be of that clock and span the recording"),
        (-5.0, 5.0, 0.5, "no pose for 2.00 s before it, in the middle of the recording"),
        (0.0, 0.01, 100.0, "1 poses: a trajectory needs two lines"),
    ],
)
def test_a_trajectory_that_leaves_time_out_is_named(
    tmp_path: Path, first_s: float, last_s: float, rate_hz: float, expected: str
) -> None:
    tum = write_tum(tmp_path / "t.tum", first_s, last_s, rate_hz)
    assert expected in said(lambda: motion_along(tum, START_NS, START_NS + 300_000_000, 0.15))


def test_a_trajectory_whose_stamps_do_not_rise_is_named(tmp_path: Path) -> None:
    (tmp_path / "t.tum").write_text("# x\n0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    assert "t.tum:4: the stamp does not come after" in said(lambda: motion_along(tmp_path / "t.tum", 0, 10, 0.1))


@needs_kiss_icp
def test_kiss_icp_finds_the_way_through_a_room(tmp_path: Path) -> None:
    """A sensor that steps 0.2 m between revolutions through a box of 12 x 8 x 5 m, standing still in each."""
    info = info_of(SENSOR)
    made = frames(info, 4, lambda _: np.eye(4))
    half = np.array([6.0, 4.0, 2.5])
    for number, frame in enumerate(made):
        origins = SENSOR.origins + np.array([0.2 * number, 0.0, 0.0])
        with np.errstate(divide="ignore"):
            reach = ((np.sign(SENSOR.directions) * half - origins) / SENSOR.directions).min(axis=-1)
        frame.field("RANGE")[:] = np.round(1000.0 * (reach + SENSOR.beam_origin_m))
    path = write_frames(tmp_path / "r.osf", info, made)
    assert import_recording(path, tmp_path / "s", odometry="kiss-icp").poses == "kiss-icp"
    found = read_session(tmp_path / "s").odom_T_sensor
    np.testing.assert_array_equal(found[0], np.eye(4))
    # deskewing takes the steps for a movement, which these revolutions do not have: 0.1 m at the columns farthest off
    np.testing.assert_allclose(found[:, 0, 3], [0.0, 0.2, 0.4, 0.6], atol=0.1)
    assert len(our_points(tmp_path / "s")) == 4


def test_damaged_and_foreign_osf_files_are_named(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    whole = write_frames(tmp_path / "whole.osf", info, frames(info)).read_bytes()
    path = tmp_path / "cut.osf"
    for n_bytes, expected in (
        (0, "not an OSF file"),
        (20, "never finished|cut short|not an OSF"),
        (len(whole) // 2, "cut short: .* bytes are there"),
        (len(whole) - 1, "cut short"),
    ):
        path.write_bytes(whole[:n_bytes])
        with pytest.raises(InputError, match=expected):
            import_recording(path, tmp_path / "s")
    path.write_bytes(b"PNG" * 1000)
    assert "not an OSF file" in said(lambda: import_recording(path, tmp_path / "s"))
    hole = len(whole) // 2
    path.write_bytes(whole[:hole] + bytes(2000) + whole[hole + 2000 :])
    assert "damaged: " in said(lambda: import_recording(path, tmp_path / "s"))
    assert left(tmp_path) == ["cut.osf", "whole.osf"]


def test_an_osf_of_two_sensors_is_refused(tmp_path: Path) -> None:
    infos = [info_of(replace(SENSOR, serial=serial)) for serial in ("1001", "1002")]
    path = tmp_path / "two.osf"
    with osf.Writer(str(path), infos) as writer:
        for stream, info in enumerate(infos):
            writer.save(stream, frames(info, 1)[0])
    told = said(lambda: import_recording(path, tmp_path / "s"))
    assert "expected the recording of one sensor, it holds 2 (OS-1-32-G 1001, OS-1-32-G 1002)" in told


def test_what_an_osf_cannot_hold_is_named(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    backwards, bent, no_range = (
        frames(info, 2),
        frames(info, 1),
        core.LidarFrame(info, [core.FieldType("SIGNAL", "u2")]),
    )
    backwards[1].timestamp[:] = backwards[0].timestamp
    told = said(lambda: import_recording(write_frames(tmp_path / "a.osf", info, backwards), tmp_path / "s"))
    assert "revolution 1 does not come after the one before it: the sensor's clock was set" in told
    bent[0].body_to_world[:, :3, :3] *= 1.1
    told = said(lambda: import_recording(write_frames(tmp_path / "b.osf", info, bent), tmp_path / "s"))
    assert "revolution 0: its column poses[0] is not a rigid transform" in told
    no_range.status[:] = 1
    no_range.timestamp[:] = np.arange(512)
    told = said(lambda: import_recording(write_frames(tmp_path / "c.osf", info, [no_range]), tmp_path / "s"))
    assert "has no channel RANGE (there is SIGNAL)" in told
    shuffled = frames(info, 1)
    shuffled[0].timestamp[:] = shuffled[0].timestamp[::-1].copy()
    told = said(lambda: import_recording(write_frames(tmp_path / "d.osf", info, shuffled), tmp_path / "s"))
    assert "the stamps of its columns do not rise" in told
    assert left(tmp_path) == ["a.osf", "b.osf", "c.osf", "d.osf"]


def test_another_height_and_wider_channels_come_in(tmp_path: Path) -> None:
    """An OS0-128 whose reflectivity and signal are wider than ours: what does not fit is the largest that does."""
    n = 128
    wide = replace(
        SENSOR, product="OS-0-128", altitude_deg=np.linspace(45, -45, n), azimuth_deg=np.zeros(n), pixel_shift=(0,) * n
    )
    info = info_of(wide)
    frame = core.LidarFrame(info, [core.FieldType("RANGE", "u4"), core.FieldType("REFLECTIVITY", "u2")])
    frame.field("RANGE")[:] = 5000
    frame.field("REFLECTIVITY")[:] = 300
    frame.timestamp[:] = np.arange(512) * 195_312 + 1
    frame.status[:] = 1
    frame.body_to_world[:] = odom_T_sensor(1.0)
    import_recording(write_frames(tmp_path / "r.osf", info, [frame]), tmp_path / "s")
    chunk = read_session(tmp_path / "s").chunk(0)
    assert chunk.range_mm.shape == (1, n, 512)
    assert (chunk.reflectivity == 255).all()
    assert (chunk.signal == 0).all()


# Coming in: PCAP


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    info = info_of(SENSOR)
    return record(tmp_path / "c.pcap", info, frames(info))


def pcapng_of(path: Path) -> Path:
    """The same packets in the newer container: a section, an interface, a block for each packet."""
    data = path.read_bytes()
    blocks, at = [struct.pack("<IIIHHqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28)], 24
    blocks.append(struct.pack("<IIHHII", 1, 20, 1, 0, 65535, 20))
    while at < len(data):
        length = struct.unpack_from("<I", data, at + 8)[0]
        body = data[at + 16 : at + 16 + length] + bytes(-length % 4)
        size = 32 + len(body)
        blocks.append(
            struct.pack("<IIIIIII", 6, size, 0, 0, len(blocks), length, length) + body + struct.pack("<I", size)
        )
        at += 16 + length
    out = path.with_suffix(".pcapng")
    out.write_bytes(b"".join(blocks))
    return out


def test_a_pcap_with_its_metadata_comes_in(capture: Path, tmp_path: Path) -> None:
    tum = write_tum(tmp_path / "t.tum", -0.05, 0.4)
    made = frames(info_of(SENSOR))
    for number, source in enumerate((capture, pcapng_of(capture))):
        out = tmp_path / f"s{number}"
        assert import_recording(source, out, trajectory=tum).n_scans == 3
        chunk = read_session(out).chunk(0)
        for row, frame in enumerate(made):
            np.testing.assert_array_equal(chunk.range_mm[row], frame.field("RANGE"))
            np.testing.assert_array_equal(chunk.signal[row], frame.field("SIGNAL"))
            np.testing.assert_array_equal(chunk.column_stamps_ns[row] + START_NS, frame.timestamp)


def test_a_pcap_that_lost_packets_keeps_the_rest(capture: Path, tmp_path: Path) -> None:
    info = info_of(SENSOR)
    made = frames(info)
    for frame in made:
        frame.status[64:96] = 0  # two packets
    path = record(tmp_path / "lost.pcap", info, made)
    import_recording(path, tmp_path / "s", trajectory=write_tum(tmp_path / "t.tum", -0.05, 0.4))
    chunk = read_session(tmp_path / "s").chunk(0)
    assert (chunk.range_mm[:, :, 64:96] == 0).all()
    assert chunk.range_mm[0, :, 96:].any()
    np.testing.assert_allclose(np.diff(chunk.column_stamps_ns[0]), 195_312, atol=2)


def test_metadata_of_a_pcap(capture: Path, tmp_path: Path) -> None:
    moved = tmp_path / "elsewhere.json"
    capture.with_suffix(".json").rename(moved)
    assert "c.json is not beside it: give the sensor's metadata .json with --metadata" in said(
        lambda: open_recording(capture)
    )
    assert len(list(open_recording(capture, moved).revolutions())) == 3
    fewer = tmp_path / "fewer.json"
    fewer.write_text(info_of(load_profile("os1-32-g", "1024x10")).to_json_string())
    assert "no whole revolution" in said(lambda: list(open_recording(capture, fewer).revolutions()))
    wide = load_profile("os1-32-g", "1024x10")
    other = record(tmp_path / "wide.pcap", info_of(wide), frames(info_of(wide), 1))
    assert "count columns up to 1023: it is the metadata of another mode" in said(lambda: open_recording(other, moved))
    n = 128
    tall = replace(
        SENSOR, product="OS-1-128", altitude_deg=np.linspace(20, -20, n), azimuth_deg=np.zeros(n), pixel_shift=(0,) * n
    )
    fewer.write_text(info_of(tall).to_json_string())
    told = said(lambda: list(open_recording(capture, fewer).revolutions()))
    assert "no lidar packet of the sensor in" in told
    assert "OS-1-128" in told
    fewer.write_text(json.dumps({"lasers": [], "num_lasers": 16}))
    assert "fewer.json: beam_altitude_angles is missing" in said(lambda: open_recording(capture, fewer))
    assert "none.json: no such sensor metadata" in said(lambda: open_recording(capture, tmp_path / "none.json"))


def test_a_capture_cut_anywhere_is_named(capture: Path, tmp_path: Path) -> None:
    metadata = capture.with_suffix(".json")
    for source in (capture, pcapng_of(capture)):
        whole = source.read_bytes()
        path = tmp_path / f"part{source.suffix}"
        for n_bytes in (0, 10, 25, 400, len(whole) // 2, len(whole) - 1):
            path.write_bytes(whole[:n_bytes])
            told = said(lambda path=path: open_recording(path, metadata))
            assert told.startswith(f"{path}: ")
            assert ("not a PCAP file" if n_bytes < 24 else "cut short or damaged after") in told
        path.write_bytes(b"GIF89a" + bytes(100))
        assert "neither PCAP nor PCAPNG" in said(lambda path=path: open_recording(path, metadata))


def test_a_capture_of_another_makers_sensor(tmp_path: Path) -> None:
    """Sixteen-beam packets of 1206 bytes to port 2368, as another maker's sensors send."""
    udp = struct.pack(">HHHH", 2368, 2368, 8 + 1206, 0) + bytes(1206)
    ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0, bytes([192, 168, 1, 2]), bytes(4))
    packet = bytes(12) + b"\x08\x00" + ip + udp
    records = b"".join(struct.pack("<IIII", 1, n, len(packet), len(packet)) + packet for n in range(200))
    path = tmp_path / "other.pcap"
    path.write_bytes(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1) + records)
    path.with_suffix(".json").write_text(info_of(SENSOR).to_json_string())
    told = said(lambda: import_recording(path, tmp_path / "s", odometry=None))
    assert "no lidar packet of the sensor in" in told


def test_names_that_are_no_recording(tmp_path: Path) -> None:
    (tmp_path / "folder.osf").mkdir()
    (tmp_path / "scan.bag").write_bytes(b"x")
    assert "is a folder" in said(lambda: open_recording(tmp_path / "folder.osf"))
    assert "no such file" in said(lambda: open_recording(tmp_path / "none.pcap"))
    assert "expected a recording, .osf, .pcap, .pcapng" in said(lambda: open_recording(tmp_path / "scan.bag"))
    assert "leave --metadata out" in said(lambda: open_recording(_empty(tmp_path / "a.osf"), tmp_path / "m.json"))


def _empty(path: Path) -> Path:
    path.write_bytes(b"")
    return path


def test_without_the_sdk_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real_import = builtins.__import__

    def no_ouster(name: str, *rest: Any) -> Any:
        if name.startswith("ouster"):
            raise ImportError(name)
        return real_import(name, *rest)

    monkeypatch.setattr(builtins, "__import__", no_ouster)
    for call in (lambda: open_recording(tmp_path / "a.osf"), lambda: write_osf(_none(), tmp_path / "a.osf")):
        assert "need the vendor's SDK: pip install 'tunnelcd[ouster]'" in said(call)


def _none() -> Any:
    return None


# Leaving


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """70 revolutions in two chunks, with own poses."""
    folder = tmp_path_factory.mktemp("session")
    info = info_of(SENSOR)
    import_recording(write_frames(folder / "r.osf", info, frames(info, 70)), folder / "s")
    return read_session(folder / "s")


def labels(session: Session) -> Iterator[dict[str, np.ndarray]]:
    for number, chunk in enumerate(session.chunks()):
        draw = np.random.default_rng(number)
        yield {
            "LABEL": draw.integers(0, 70, chunk.range_mm.shape).astype(np.uint16),
            "INSTANCE": draw.integers(-2, 500, chunk.range_mm.shape).astype(np.int16),
        }


def test_the_vendor_reads_what_a_session_holds(session: Session, tmp_path: Path) -> None:
    path = tmp_path / "out.osf"
    told: list[tuple[str, int, int]] = []
    write_osf(session, path, labels(session), lambda *stage: told.append(stage))
    assert told[0] == ("write", 0, 70)
    assert told[-1] == ("write", 70, 70)
    assert left(tmp_path) == ["out.osf"]
    chunks, fields = list(session.chunks()), list(labels(session))
    poses = np.concatenate([chunk.column_poses for chunk in chunks]).astype(np.float64)
    with osf.OsfFrameSetSource(str(path)) as source:
        info = source.sensor_info[0]
        assert len(source) == 70
        for number, (frame,) in enumerate(source):
            at = divmod(number, session.chunk_scans)
            assert frame.complete()
            np.testing.assert_array_equal(frame.field("RANGE"), chunks[at[0]].range_mm[at[1]])
            np.testing.assert_array_equal(frame.field("REFLECTIVITY"), chunks[at[0]].reflectivity[at[1]])
            np.testing.assert_array_equal(frame.field("SIGNAL"), chunks[at[0]].signal[at[1]])
            np.testing.assert_array_equal(frame.field("LABEL"), fields[at[0]]["LABEL"][at[1]])
            np.testing.assert_array_equal(frame.field("INSTANCE"), fields[at[0]]["INSTANCE"][at[1]])
            np.testing.assert_array_equal(frame.timestamp, chunks[at[0]].column_stamps_ns[at[1]] + START_NS)
            for column in (0, 300):
                relative = make_pose(
                    Rotation.from_quat(poses[number, column, 3:]).as_matrix(), poses[number, column, :3]
                )
                np.testing.assert_allclose(
                    frame.body_to_world[column], session.odom_T_sensor[number] @ relative, atol=1e-12
                )
    assert (info.prod_line, info.w, info.h) == ("OS-1-32-G", 512, 32)
    assert json.loads(info.user_data)["tunnelcd"]["made_by"] == "tunnelcd convert"
    for ours, vendor in zip(our_points(session.path), vendor_points(path), strict=True):
        np.testing.assert_allclose(ours, vendor, atol=1e-6)


def test_there_and_back_is_the_same_session(session: Session, tmp_path: Path) -> None:
    write_osf(session, tmp_path / "out.osf", labels(session))
    import_recording(tmp_path / "out.osf", tmp_path / "back")
    back = read_session(tmp_path / "back")
    np.testing.assert_allclose(back.odom_T_sensor, session.odom_T_sensor, atol=1e-6)
    np.testing.assert_allclose(back.sensor.directions, session.sensor.directions, atol=1e-12)
    assert back.chunk_scans == session.chunk_scans
    for one, other in zip(session.chunks(), back.chunks(), strict=True):
        for name in ("range_mm", "reflectivity", "signal", "column_stamps_ns"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        np.testing.assert_allclose(one.column_poses, other.column_poses, atol=1e-6)
    assert not (tmp_path / "back" / "truth").exists()


def test_an_osf_is_never_overwritten_and_never_half_written(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "out.osf"
    path.write_text("mine")
    assert "out.osf exists already" in said(lambda: write_osf(session, path))
    assert path.read_text() == "mine"
    path.unlink()
    whole = Session.chunk

    def interrupted(self: Session, index: int) -> Any:
        if index == 1:
            raise KeyboardInterrupt
        return whole(self, index)

    monkeypatch.setattr(Session, "chunk", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_osf(session, path)
    assert left(tmp_path) == []


def test_what_cannot_leave_is_named(session: Session, tmp_path: Path) -> None:
    assert "there is no folder" in said(lambda: write_osf(session, tmp_path / "none" / "out.osf"))
    short = ({"LABEL": each["LABEL"][:, :, :4]} for each in labels(session))
    assert "field LABEL is (64, 32, 4) where ranges are (64, 32, 512)" in said(
        lambda: write_osf(session, tmp_path / "out.osf", short)
    )
    odd = replace(session, sensor=replace(SENSOR, mode="64x10"))
    assert "the vendor's SDK does not take its sensor" in said(lambda: write_osf(odd, tmp_path / "out.osf"))
    assert left(tmp_path) == []


# Real recordings


@needs_real_data
@needs_kiss_icp
def test_the_real_capture_comes_in(tmp_path: Path) -> None:
    path = ROOT / "OS-1-32-G_v2.1.1_1024x10.pcap"
    assert "no poses in it" in said(lambda: import_recording(path, tmp_path / "s"))
    import_recording(path, tmp_path / "s", odometry="kiss-icp")
    session = read_session(tmp_path / "s")
    assert (session.n_scans, session.sensor.product) == (1, "OS-1-32-G")
    assert np.count_nonzero(session.chunk(0).range_mm) == 27310
    (points,) = our_points(tmp_path / "s")
    with pcap.PcapFrameSetSource(str(path), meta=[str(path.with_suffix(".json"))]) as source:
        (frame,) = next(iter(source))
        vendor = core.XYZLut(frame.sensor_info, use_extrinsics=False)(frame)[frame.field("RANGE") > 0]
    np.testing.assert_allclose(points, vendor, atol=1e-6)


@needs_real_data
def test_the_real_osf_lands_on_the_vendors_map(tmp_path: Path) -> None:
    name = "OS-1-128_v2.3.0_1024x10_lb_n3"
    path = ROOT / f"{name}.osf"
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3] = np.loadtxt(ROOT / f"{name}_poses_kitti.txt").reshape(3, 3, 4)
    vendor = read_ply_points(ROOT / f"{name}_map-000.ply")
    recording = open_recording(path)
    revolutions = list(recording.revolutions())
    # The vendor's map holds each revolution at one pose: so do we first.
    rigid = [
        transform(pose, recording.sensor.project(each.range_mm / 1000.0)[each.range_mm > 0])
        for pose, each in zip(poses, revolutions, strict=True)
    ]
    distances_m, _ = KDTree(np.concatenate(rigid)).query(vendor[::5])
    assert np.median(distances_m) < 0.026
    assert np.percentile(distances_m, 95) < 0.095
    lines = []
    for pose, each in zip(poses, revolutions, strict=True):
        numbers = [each.column_stamps_ns[512] / 1e9, *pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        lines.append(" ".join(f"{number:.9f}" for number in numbers))
    (tmp_path / "t.tum").write_text("\n".join(lines))
    import_recording(path, tmp_path / "s", trajectory=tmp_path / "t.tum")
    np.testing.assert_allclose(read_session(tmp_path / "s").odom_T_sensor, poses, atol=1e-6)
    distances_m, _ = KDTree(np.concatenate(our_points(tmp_path / "s"))).query(vendor[::5])
    assert np.median(distances_m) < 0.04
