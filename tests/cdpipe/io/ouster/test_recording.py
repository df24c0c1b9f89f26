"""Recordings made with the vendor's SDK come in as sessions."""

from __future__ import annotations

import importlib.util
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputWarning
from cdpipe.core.geometry import Float64Array, make_pose, transform, yaw_pose
from cdpipe.io.ouster.captures import open_recording
from cdpipe.io.ouster.recording import import_recording
from cdpipe.io.ply import read_ply_points
from cdpipe.io.readers import HowToRead, import_ouster
from cdpipe.io.session import read_session
from cdpipe.io.tum import motion_along
from tests.cdpipe.recordings import (
    HALF_ROOM_M,
    SENSOR,
    START_NS,
    core,
    frames,
    in_a_room,
    info_of,
    left,
    odom_T_sensor,
    on_a_small_disk,
    osf,
    our_points,
    pcap,
    said,
    vendor_points,
    write_frames,
    write_tum,
)

needs_kiss_icp = pytest.mark.skipif(
    importlib.util.find_spec("kiss_icp") is None, reason="needs the extra `odometry`: KISS-ICP"
)
ROOT = Path(os.environ.get("TUNNELCD_REAL_DATA", "")) / "ouster"
needs_real_data = pytest.mark.skipif(
    "TUNNELCD_REAL_DATA" not in os.environ, reason="real recordings: TUNNELCD_REAL_DATA is not set"
)


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


def test_revolutions_left_out_are_counted_wherever_they_are(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    made = frames(info, 5)
    made[2].status[:256] = 0
    made[4].status[10:] = 0
    imported = import_recording(write_frames(tmp_path / "r.osf", info, made), tmp_path / "s")
    assert (imported.n_scans, imported.n_left_out) == (3, 2)
    assert read_session(tmp_path / "s").provenance["revolutions_left_out"] == 2
    made[2].status[255] = 1
    imported = import_recording(write_frames(tmp_path / "more.osf", info, made), tmp_path / "t")
    assert (imported.n_scans, imported.n_left_out) == (4, 1)


def test_revolutions_without_poses_among_others_are_refused(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    made = frames(info, 4)
    made[0].body_to_world[:] = np.eye(4)  # where the frame of the others begins
    path = write_frames(tmp_path / "r.osf", info, made)
    import_recording(path, tmp_path / "s")
    np.testing.assert_array_equal(read_session(tmp_path / "s").odom_T_sensor[0], np.eye(4))
    made[2].body_to_world[:] = np.eye(4)
    path = write_frames(tmp_path / "hole.osf", info, made)
    told = said(lambda: import_recording(path, tmp_path / "t"))
    assert "--trajectory FILE (" in told
    import_recording(path, tmp_path / "t", trajectory=write_tum(tmp_path / "t.tum", -0.05, 0.5))


def test_an_import_that_fills_the_disk_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    path = write_frames(tmp_path / "r.osf", info, frames(info))
    call = "import_recording(Path(sys.argv[1]), Path(sys.argv[2]))"
    told = on_a_small_disk(call, 100_000, path, tmp_path / "s")
    assert told == (0, f"{tmp_path / 's'}: cannot write there: File too large\n", "")
    assert left(tmp_path) == ["r.osf"]


def test_without_poses_it_says_what_to_give(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    path = write_frames(tmp_path / "r.osf", info, frames(info, 2, lambda _: np.eye(4)))
    told = said(lambda: import_recording(path, tmp_path / "s"))
    assert "--trajectory FILE (" in told
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


def test_an_origin_is_subtracted_and_no_deskewing_is_told(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    path = write_frames(tmp_path / "r.osf", info, frames(info, 3))
    tum = write_tum(tmp_path / "t.tum", -0.05, 0.4)
    near, far = import_ouster(path, tmp_path / "near", HowToRead(trajectory=tum)), (432_000.0, 5_411_000.0, 300.0)
    rows = np.loadtxt(tum, comments="#")
    rows[:, 1:4] += far
    np.savetxt(tmp_path / "far.tum", rows, fmt="%.9f")
    with pytest.warns(InputWarning, match="deskewed in spite of --no-deskew"):
        import_ouster(path, tmp_path / "far", HowToRead(trajectory=tmp_path / "far.tum", origin_m=far, deskew=False))
    assert near.poses == "trajectory t.tum"
    expected, got = (read_session(tmp_path / name).odom_T_sensor for name in ("near", "far"))
    np.testing.assert_allclose(got, expected, atol=1e-6)
    import_ouster(path, tmp_path / "own", HowToRead(origin_m=far))  # of its own poses, too
    np.testing.assert_allclose(
        read_session(tmp_path / "own").odom_T_sensor[:, 0, 3], expected[:, 0, 3] - far[0], atol=0.1
    )


def test_quaternions_with_w_first_are_refused_and_nothing_stays(tmp_path: Path) -> None:
    def world_T_sensor(time_s: float) -> Float64Array:
        return yaw_pose(2.0 * time_s, (time_s - 2.0, 0.3, 0.1))

    info = info_of(SENSOR)
    made = frames(info, 8, lambda _: np.eye(4))
    in_a_room(made, world_T_sensor)
    made[3].field("RANGE")[:] = 0  # nothing came back
    path = write_frames(tmp_path / "r.osf", info, made)
    time_s = np.arange(-0.05, 0.9, 0.01)
    poses = np.stack([world_T_sensor(each) for each in time_s])
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    for name, order in (("right", turns), ("w_first", np.roll(turns, 1, axis=1))):
        rows = np.column_stack([START_NS / 1e9 + time_s, poses[:, :3, 3], order])
        np.savetxt(tmp_path / f"{name}.tum", rows, fmt="%.9f")
    told = said(lambda: import_recording(path, tmp_path / "s", trajectory=tmp_path / "w_first.tum"))
    assert told.startswith(f"{tmp_path / 'w_first.tum'}: the scans lie ") and "they look like qw first" in told
    assert left(tmp_path) == ["r.osf", "right.tum", "w_first.tum"]
    assert import_recording(path, tmp_path / "s", trajectory=tmp_path / "right.tum").n_scans == 8


def test_a_trajectory_in_millimetres_is_refused(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    made = frames(info, 8, lambda _: np.eye(4))
    in_a_room(made, lambda time_s: make_pose(np.eye(3), np.array([time_s, 0.0, 0.0])))
    path = write_frames(tmp_path / "r.osf", info, made)
    time_s = np.arange(-0.05, 0.9, 0.01)
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (len(time_s), 1))
    places_mm = np.outer(1000.0 * time_s, [1.0, 0.0, 0.0])
    np.savetxt(tmp_path / "mm.tum", np.column_stack([START_NS / 1e9 + time_s, places_mm, turns]), fmt="%.9f")
    told = said(lambda: import_recording(path, tmp_path / "s", trajectory=tmp_path / "mm.tum"))
    assert told.startswith(f"{tmp_path / 'mm.tum'}: neighbouring scans lie ")
    assert "the trajectory looks like millimetres" in told
    assert left(tmp_path) == ["mm.tum", "r.osf"]


def test_a_pose_per_revolution_at_its_first_column_is_enough(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    path = write_frames(tmp_path / "r.osf", info, frames(info, 3))
    tum = write_tum(tmp_path / "t.tum", 0.0, 0.25, rate_hz=10.0)
    import_recording(path, tmp_path / "s", trajectory=tum)
    np.testing.assert_allclose(read_session(tmp_path / "s").odom_T_sensor[2], odom_T_sensor(0.25), atol=5e-3)


def write_kitti(path: Path, times_s: Float64Array) -> Path:
    lines = [" ".join(f"{number:.9f}" for number in odom_T_sensor(time_s)[:3].ravel()) for time_s in times_s]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_kitti_poses_are_those_of_the_revolutions(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    path = write_frames(tmp_path / "r.osf", info, frames(info, 3, lambda _: np.eye(4)))
    import_recording(path, tmp_path / "s", trajectory=write_kitti(tmp_path / "k.txt", np.array([0.0, 0.1, 0.2])))
    np.testing.assert_allclose(read_session(tmp_path / "s").odom_T_sensor[1], odom_T_sensor(0.15), atol=5e-3)
    two = write_kitti(tmp_path / "two.txt", np.array([0.0, 0.1]))
    told = said(lambda: import_recording(path, tmp_path / "t", trajectory=two))
    assert "2 poses without times for 3 revolutions: one for each is needed" in told


def test_a_csv_with_times_is_interpolated_as_a_tum_file_is(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    path = write_frames(tmp_path / "r.osf", info, frames(info, 3, lambda _: np.eye(4)))
    tum = write_tum(tmp_path / "t.tum", -0.05, 0.4)
    rows = tum.read_text().replace(" ", ",")
    (tmp_path / "t.csv").write_text("time,x,y,z,qx,qy,qz,qw\n" + rows)
    import_recording(path, tmp_path / "a", trajectory=tum)
    import_recording(path, tmp_path / "b", trajectory=tmp_path / "t.csv")
    expected, got = (read_session(tmp_path / name).odom_T_sensor for name in "ab")
    np.testing.assert_allclose(got, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("first_s", "last_s", "rate_hz", "expected"),
    [
        (-0.1, 0.1, 100.0, "987.554 to 987.744 s, the recording 987.654 to 987.954 s"),
        (0.2, 0.5, 100.0, "the stamps must be of that clock and span the recording"),
        (-5.0, 5.0, 0.5, "no pose for 2.00 s before it, in the middle of the recording"),
        (0.0, 0.01, 100.0, "1 poses: "),
    ],
)
def test_a_trajectory_that_leaves_time_out_is_named(
    tmp_path: Path, first_s: float, last_s: float, rate_hz: float, expected: str
) -> None:
    tum = write_tum(tmp_path / "t.tum", first_s, last_s, rate_hz)
    assert expected in said(lambda: motion_along(tum, START_NS, START_NS + 300_000_000, 0.15))


@pytest.mark.parametrize(("last_s", "is_enough"), [(0.19, True), (0.12, False)])
def test_a_trajectory_may_end_a_revolution_and_a_half_short(tmp_path: Path, last_s: float, is_enough: bool) -> None:
    info = info_of(SENSOR)
    path = write_frames(tmp_path / "r.osf", info, frames(info, 3))
    tum = write_tum(tmp_path / "t.tum", 0.0, last_s)
    if is_enough:
        assert import_recording(path, tmp_path / "s", trajectory=tum).n_scans == 3
        return
    assert "span the recording" in said(lambda: import_recording(path, tmp_path / "s", trajectory=tum))


def test_a_trajectory_may_have_gaps_before_and_after_the_recording(tmp_path: Path) -> None:
    whole = write_tum(tmp_path / "whole.tum", -4.0, 4.0)
    lines = whole.read_text().splitlines()
    time_s = np.array([float(line.split()[0]) for line in lines]) - START_NS / 1e9
    kept = (np.abs(time_s) < 1.0) | (np.abs(time_s) > 3.0)
    tum = tmp_path / "t.tum"
    tum.write_text("\n".join(line for line, keep in zip(lines, kept, strict=True) if keep))
    motion = motion_along(tum, START_NS, START_NS + 300_000_000, 0.15)
    np.testing.assert_allclose(motion.poses(np.array(0.2)), odom_T_sensor(0.2), atol=1e-5)


def test_a_trajectory_goes_on_beyond_its_ends_as_over_the_nearest_revolution(tmp_path: Path) -> None:
    tum = write_tum(tmp_path / "t.tum", 0.09, 0.215, 100.0)  # the last pose at 0.21 s
    rows = np.loadtxt(tum)
    rows[[1, -2], 3] += 0.003  # a slope over 10 ms, carried on for 0.09 s, would be 27 mm off
    np.savetxt(tum, rows, fmt="%.9f")
    motion = motion_along(tum, START_NS, START_NS + 300_000_000, 0.15)
    inside, outside = odom_T_sensor(0.18)[:3, 3], motion.poses(np.array(0.0))[:3, 3]
    np.testing.assert_allclose(outside, 2 * odom_T_sensor(0.09)[:3, 3] - inside, atol=1e-6)
    inside, outside = odom_T_sensor(0.12)[:3, 3], motion.poses(np.array(0.3))[:3, 3]
    np.testing.assert_allclose(outside, 2 * odom_T_sensor(0.21)[:3, 3] - inside, atol=1e-6)


def test_a_trajectory_whose_stamps_do_not_rise_is_named(tmp_path: Path) -> None:
    (tmp_path / "t.tum").write_text("# x\n0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    assert "t.tum:4: " in said(lambda: motion_along(tmp_path / "t.tum", 0, 10, 0.1))


@needs_kiss_icp
def test_kiss_icp_finds_the_way_through_a_room(tmp_path: Path) -> None:
    """A sensor that steps 0.2 m between revolutions through a box of 12 x 8 x 5 m, standing still in each."""
    info = info_of(SENSOR)
    made = frames(info, 4, lambda _: np.eye(4))
    in_a_room(made, lambda time_s: make_pose(translation=(0.2 * int(10 * time_s + 1e-9), 0.0, 0.0)))
    path = write_frames(tmp_path / "r.osf", info, made)
    assert import_recording(path, tmp_path / "s", odometry="kiss-icp").poses == "kiss-icp"
    found = read_session(tmp_path / "s").odom_T_sensor
    np.testing.assert_array_equal(found[0], np.eye(4))
    # deskewing takes the steps for a movement, which these revolutions do not have: 0.1 m at the columns farthest off
    np.testing.assert_allclose(found[:, 0, 3], [0.0, 0.2, 0.4, 0.6], atol=0.1)
    assert len(our_points(tmp_path / "s")) == 4


@needs_kiss_icp
def test_a_revolution_on_the_move_is_deskewed_before_it_is_registered(tmp_path: Path) -> None:
    """The sensor stands, then drives and turns fast: skewed revolutions meet a map that is not."""

    def world_T_sensor(time_s: float) -> Float64Array:
        moved_s = max(time_s - 0.3, 0.0)
        return yaw_pose(4.0 * moved_s, (-2.0 + 4.0 * moved_s, 0.3, 0.1))

    info = info_of(SENSOR)
    made = frames(info, 6, lambda _: np.eye(4))
    in_a_room(made, world_T_sensor)
    import_recording(write_frames(tmp_path / "r.osf", info, made), tmp_path / "s", odometry="kiss-icp")
    world = [transform(world_T_sensor(0.0), points) for points in our_points(tmp_path / "s")]
    off_the_walls_m = [np.abs(np.abs(points) - HALF_ROOM_M).min(axis=1).mean() for points in world]
    assert off_the_walls_m[0] < 0.001
    assert max(off_the_walls_m[4:]) < 0.06  # 0.10 and 0.15 m where every column is taken to be the middle one


def test_what_an_osf_cannot_hold_is_named(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    backwards, bent, no_range = (
        frames(info, 2),
        frames(info, 1),
        core.LidarFrame(info, [core.FieldType("SIGNAL", "u2")]),
    )
    backwards[1].timestamp[:] = backwards[0].timestamp
    told = said(lambda: import_recording(write_frames(tmp_path / "a.osf", info, backwards), tmp_path / "s"))
    assert "revolution 1 " in told
    bent[0].body_to_world[:, :3, :3] *= 1.1
    told = said(lambda: import_recording(write_frames(tmp_path / "b.osf", info, bent), tmp_path / "s"))
    assert "revolution 0: its column poses[0]" in told
    no_range.status[:] = 1
    no_range.timestamp[:] = np.arange(512)
    told = said(lambda: import_recording(write_frames(tmp_path / "c.osf", info, [no_range]), tmp_path / "s"))
    assert "RANGE (there is SIGNAL)" in told
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


@needs_real_data
def test_the_real_dual_return_capture_keeps_its_second_returns() -> None:
    name = "OS-0-32-U1_v2.2.0_1024x10"
    recording = open_recording(ROOT / f"{name}.pcap", ROOT / f"{name}.json")
    (revolution,) = recording.revolutions()
    assert revolution.range_mm.shape == revolution.signal.shape == (64, 1024)
    first, second = np.split(revolution.range_mm.astype(np.int64), 2)
    is_second = (second > 0) & (first > 0)
    # as published: one beam in 380 has a second return, never stronger than the first, most of them behind it
    assert is_second.sum() / (first > 0).sum() == pytest.approx(0.0026, abs=0.0001)
    signals = np.split(revolution.signal, 2)
    assert (signals[1][is_second] <= signals[0][is_second]).all()
    assert 0.6 < (second > first)[is_second].mean() < 0.66
