"""Trajectories of others: TUM, KITTI and CSV, units, orders and columns, and what is none."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("pypcd4", reason="pip install 'tunnelcd[formats]'")
pytest.importorskip("rosbags", reason="pip install 'tunnelcd[formats]'")

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.geometry import transform
from cdpipe.io.foreign import HowToRead, convert_recording, read_poses
from cdpipe.io.readers import open_session
from cdpipe.io.tum import read_tum
from tests.cdpipe.io.foreign_files import (
    MADE,
    START_NS,
    drive,
    odom_T_sensor,
    said,
    worst_m,
    write_bag,
    write_pcds,
    write_trajectory,
)

FINE_S = np.arange(0.3, 1.4, 0.013)


def test_a_trajectory_at_another_rate_is_interpolated(tmp_path: Path) -> None:
    folder = write_pcds(tmp_path / "run", MADE)
    np.savetxt(folder / "times.txt", START_NS / 1e9 + MADE.stamps_s, fmt="%.6f")
    for kind in ("tum", "csv"):
        assert worst_m(folder, HowToRead(trajectory=write_trajectory(tmp_path / f"t.{kind}", FINE_S, kind))) < 1e-3
    short = write_trajectory(tmp_path / "short.tum", FINE_S[FINE_S < 0.75])
    assert "2 scans lie up to 0.258 s outside, more than one period (0.100 s)" in said(
        folder, HowToRead(trajectory=short)
    )
    other = write_trajectory(tmp_path / "other.tum", FINE_S + 100.0)
    other.write_text("".join(f"{float(line.split()[0]) + 500:.6f} {line.split(maxsplit=1)[1]}\n"
                             for line in other.read_text().splitlines()))  # fmt: skip
    assert "the clocks differ by 599.8" in said(folder, HowToRead(trajectory=other))
    (folder / "times.txt").unlink()
    assert "the scans have none (add times.txt" in said(folder, HowToRead(trajectory=tmp_path / "t.tum"))
    kitti = write_trajectory(tmp_path / "k.txt", MADE.stamps_s, "kitti")
    with pytest.warns(InputWarning, match="6 of 6 scans are not deskewed, .*: there are no two poses with times"):
        assert worst_m(folder, HowToRead(trajectory=kitti)) > 0.3
    assert worst_m(folder, HowToRead(trajectory=kitti, deskew=False)) > 0.3


def test_an_origin_is_subtracted_from_poses_alone(tmp_path: Path) -> None:
    folder = write_pcds(tmp_path / "run", MADE, "binary")
    far_m = np.array([432_000.0, 5_411_000.0, 300.0])
    poses = odom_T_sensor(MADE.stamps_s)
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    stamps = START_NS / 1e9 + MADE.stamps_s
    np.savetxt(tmp_path / "t.tum", np.column_stack([stamps, poses[:, :3, 3] + far_m, turns]), fmt="%.9f")
    assert worst_m(folder, HowToRead(trajectory=tmp_path / "t.tum", origin_m=(432_000.0, 5_411_000.0, 300.0))) < 0.01


def test_quaternions_with_w_first_are_noticed(tmp_path: Path) -> None:
    dense = drive(n_points=40_000, sweep_s=0.0)
    folder = write_pcds(tmp_path / "run", dense, with_time=False)
    write_trajectory(folder / "t.tum", dense.stamps_s, order="wxyz")
    assert "they look like qw first" in said(folder)
    write_trajectory(folder / "t.tum", dense.stamps_s)
    assert worst_m(folder) < 1e-4


@pytest.mark.parametrize("kind", ["tum", "kitti"])
def test_scans_that_are_registered_already_are_noticed(tmp_path: Path, kind: str) -> None:
    dense = drive(n_points=40_000, sweep_s=0.0)
    poses = odom_T_sensor(dense.stamps_s)
    clouds = [(transform(pose, points), offset_s) for pose, (points, offset_s) in zip(poses, dense.clouds, strict=True)]
    folder = write_pcds(tmp_path / "run", replace(dense, clouds=clouds), with_time=False)
    write_trajectory(folder / "t.tum" if kind == "tum" else folder / "poses.txt", dense.stamps_s, kind)
    told = said(folder)
    assert "they look registered already, in the frame of the poses: give them in the frame of the sensor" in told
    assert "qw first" not in told


def test_quaternions_with_w_first_are_noticed_where_a_bag_is_converted(tmp_path: Path) -> None:
    dense = drive(n_points=40_000, sweep_s=0.0)
    bag = write_bag(tmp_path / "a.mcap", dense)
    for order, is_right in (("wxyz", False), ("xyzw", True)):
        path = write_trajectory(tmp_path / f"{order}.tum", dense.stamps_s, order=order)
        with nullcontext() if is_right else pytest.raises(InputError, match="they look like qw first"):
            convert_recording(bag, tmp_path / order, HowToRead(trajectory=path), lambda *_: None)


@pytest.mark.parametrize("write", [write_bag, write_pcds])
def test_a_trajectory_in_millimetres_is_noticed_where_a_recording_is_converted(
    write: Callable[..., Path], tmp_path: Path
) -> None:
    recording = write(tmp_path / ("a.mcap" if write is write_bag else "run"), MADE)
    if recording.is_dir():
        np.savetxt(recording / "times.txt", START_NS / 1e9 + MADE.stamps_s, fmt="%.6f")
    rows = np.loadtxt(write_trajectory(tmp_path / "t.tum", FINE_S))
    rows[:, 1:4] *= 1000.0
    np.savetxt(tmp_path / "mm.tum", rows, fmt="%.9f")
    with pytest.raises(InputError, match=r"mm\.tum: neighbouring scans lie .* the trajectory looks like millimetres"):
        convert_recording(recording, tmp_path / "out", HowToRead(trajectory=tmp_path / "mm.tum"), lambda *_: None)


def test_a_file_that_begins_with_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    path = write_trajectory(tmp_path / "t.tum", FINE_S)
    poses = read_poses(path).poses
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    np.testing.assert_array_equal(read_poses(path).poses, poses)


def test_times_of_a_trajectory_and_of_its_scans_agree(tmp_path: Path) -> None:
    folder = write_pcds(tmp_path / "run", MADE)
    write_trajectory(folder / "t.tum", MADE.stamps_s)
    np.savetxt(folder / "times.txt", START_NS / 1e9 + MADE.stamps_s - 0.09, fmt="%.6f")
    assert len(list(open_session(folder).scans())) == 6
    np.savetxt(folder / "times.txt", START_NS / 1e9 + MADE.stamps_s - 50.0, fmt="%.6f")
    assert "t.tum: its times and those of the scans of" in said(folder)
    assert "differ by 50.000 s" in said(folder)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1 2 3\n", "3 fields: expected eight numbers"),
        ("a,b,c\n1,2,3\n", "its header names a, b, c"),
        ("a,b\x0cc,d\n1,2,3\n", r"its header names a, b\x0cc, d: expected"),
        ("x,y,z,qx,qy,qz,qw\n1,2,3,0,0,0,2\n", "the quaternion's length is 2"),
        ("1 0 0 0 0 1 0 0 0 0 2 0\n", "t.txt:1: the first three columns of its 3x4 matrix are no rotation"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0\n", "t.txt:2: 3 fields, 12 in the first line"),
        ("", "no poses in it"),
        ("x,y,z,roll,pitch,yaw\n1,2,3,0,0,0.1\n1,,3,0,0,0.1\n", "t.txt:3: a number is missing or not finite"),
        ("x,y,z,roll,pitch,yaw\n1,2,3,0,0,5\n", "in the header, as roll_deg,pitch_deg,yaw_deg"),
        ("time,x,y,z,qx,qy,qz,qw\n1,2,3,4,0,0,0,1\n,2,3,4,0,0,0,1\n", "t.txt:3: a number is missing or not finite"),
        ("time,x,y,z,qx,qy,qz,qw\ninf,2,3,4,0,0,0,1\n", "t.txt:2: a number is missing or not finite"),
        ("time,x,y,z,qx,qy,qz,qw\n5,2,3,4,0,0,0,1\n5,2,3,4,0,0,0,1\n", "time 2 does not come after the last"),
        ("x,y,z,qx,qy,qz,qw\n1,2,3,0,0,0,a\n", "t.txt:2: expected numbers"),
    ],
)
def test_wrong_trajectories_are_named(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(InputError) as caught:
        read_poses(tmp_path / "t.txt")
    assert expected in str(caught.value)


def test_columns_of_a_csv_are_found_by_their_names(tmp_path: Path) -> None:
    turned = odom_T_sensor(np.array([1.0]))[0]
    header = "seq,stamp_ns,pose.position.x,pose.position.y,pose.position.z,yaw [deg],pitch,roll,twist.linear.x"
    yaw, pitch, roll = np.degrees([0.5, 0.05 * np.sin(1.0), 0.0])
    at = ",".join(map(str, turned[:3, 3]))
    (tmp_path / "t.csv").write_text(f"{header}\n7,1700000000500000000,{at},{yaw},{pitch},{roll},9\n")
    found = read_poses(tmp_path / "t.csv")
    np.testing.assert_allclose(found.poses[0], turned, atol=1e-9)
    assert found.time_s is not None
    assert found.time_s[0] == pytest.approx(1_700_000_000.5)


@pytest.mark.parametrize(
    "header",
    ["vel_x,vel_y,vel_z,{}", "a_x,a_y,a_z,{}", "linear_velocity.x,acc_y,sigma_z,{}", "std_x,omega_y,bias_z,{}"],
)
def test_velocities_of_a_csv_are_no_positions(tmp_path: Path, header: str) -> None:
    (tmp_path / "t.csv").write_text(f"time,{header.format('x,y,z,qx,qy,qz,qw')}\n1,7,8,9,1,2,3,0,0,0,1\n")
    np.testing.assert_array_equal(read_poses(tmp_path / "t.csv").poses[0, :3, 3], [1, 2, 3])


@pytest.mark.parametrize("names", ["euler_{}", "imu_{}", "magnetic_field_{}", "target_{}"])
def test_positions_of_a_csv_come_before_three_numbers_of_something_else(tmp_path: Path, names: str) -> None:
    other = ",".join(names.format(axis) for axis in "xyz")
    header = f"time,{other},position_x,position_y,position_z,q_x,q_y,q_z,q_w"
    (tmp_path / "t.csv").write_text(f"{header}\n1,7,8,9,1,2,3,0,0,0,1\n")
    np.testing.assert_array_equal(read_poses(tmp_path / "t.csv").poses[0, :3, 3], [1, 2, 3])


def test_two_positions_in_a_csv_are_refused(tmp_path: Path) -> None:
    header = "time,gps_x,gps_y,gps_z,lidar_x,lidar_y,lidar_z,qx,qy,qz,qw"
    (tmp_path / "t.csv").write_text(f"{header}\n1,7,8,9,1,2,3,0,0,0,1\n")
    with pytest.raises(InputError, match="positions may be those of gps or lidar: leave the other columns out"):
        read_poses(tmp_path / "t.csv")


@pytest.mark.parametrize(
    ("names", "stamp"),
    [("%time,field.header.stamp", "1700000000580000000,1700000000500000000"),
     ("Time,header.stamp.secs,header.stamp.nsecs", "1700000000.58,1700000000,500000000")],
)  # fmt: skip
def test_the_stamp_of_a_header_comes_before_the_time_of_recording(tmp_path: Path, names: str, stamp: str) -> None:
    (tmp_path / "t.csv").write_text(f"{names},x,y,z,qx,qy,qz,qw\n{stamp},1,2,3,0,0,0,1\n")
    np.testing.assert_allclose(read_poses(tmp_path / "t.csv").time_s, [1_700_000_000.5])


def test_a_csv_of_rostopic_echo_is_read(tmp_path: Path) -> None:
    head = ["field.header.seq", "field.header.stamp", "field.header.frame_id", "field.child_frame_id"]
    place = [f"field.pose.pose.position.{axis}" for axis in "xyz"]
    turn = [f"field.pose.pose.orientation.{axis}" for axis in "xyzw"]
    twist = [f"field.twist.twist.{kind}.{axis}" for kind in ("linear", "angular") for axis in "xyz"]
    spreads = [[f"field.{kind}.covariance{number}" for number in range(36)] for kind in ("pose", "twist")]
    names = ["%time", *head, *place, *turn, *spreads[0], *twist, *spreads[1]]
    stamp_ns = 1_700_000_000_500_000_000
    numbers = [1, 2, 3, 0, 0, 0.6, 0.8, *[0.01] * 36, *[9.0] * 6, *[0.02] * 36]
    rows = [
        f"{n + 80_000_000},7,{n},odom,base_link,{','.join(map(str, numbers))}" for n in (stamp_ns, stamp_ns + 10**8)
    ]
    (tmp_path / "t.csv").write_text("\n".join([",".join(names), *rows]) + "\n")
    found = read_poses(tmp_path / "t.csv")
    np.testing.assert_allclose(found.time_s, [1_700_000_000.5, 1_700_000_000.6])
    np.testing.assert_array_equal(found.poses[0, :3, 3], [1, 2, 3])
    np.testing.assert_allclose(found.poses[0, :3, 0], [0.8**2 - 0.6**2, 2 * 0.6 * 0.8, 0.0], atol=1e-12)


def test_a_commented_header_without_commas_tells_the_order(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("# from SLAM\n# timestamp tx ty tz qw qx qy qz\n1 1 2 3 0.6 0 0 0.8\n")
    (pose,) = read_poses(tmp_path / "t.txt").poses
    np.testing.assert_allclose(pose[:3, 0], [0.6**2 - 0.8**2, 2 * 0.6 * 0.8, 0.0], atol=1e-12)
    (tmp_path / "t.txt").write_text("# timestamp tx ty tz qx qy qz qw\n1 1 2 3 0 0 0.8 0.6\n")
    found = read_poses(tmp_path / "t.txt")
    assert found.is_tum
    np.testing.assert_allclose(found.poses[0], pose, atol=1e-12)


@pytest.mark.parametrize("names", ["secs,nsecs", "header.stamp.sec,header.stamp.nanosec"])
def test_seconds_and_nanoseconds_are_added_and_words_are_passed_over(tmp_path: Path, names: str) -> None:
    rows = "7,250000000,odom,1,2,3,0,0,0,1\n7,750000000,odom,1,2,3,0,0,0,1\n"
    (tmp_path / "t.csv").write_text(f"{names},frame_id,x,y,z,qx,qy,qz,qw\n{rows}")
    np.testing.assert_allclose(read_poses(tmp_path / "t.csv").time_s, [7.25, 7.75])


@pytest.mark.parametrize(
    ("name", "scale"),
    [("time_ms", 1e3), ("timestamp_us", 1e6), ("time [ms]", 1e3), ("stamp_ns", 1e9), ("t (us)", 1e6), ("time_s", 1.0),
     ("timestamp [ns]", 1e9)],
)  # fmt: skip
def test_the_unit_of_times_is_that_of_the_header(tmp_path: Path, name: str, scale: float) -> None:
    rows = "".join(f"{time_s * scale:.0f},1,2,3,0,0,0,1\n" for time_s in (0, 1, 60))
    (tmp_path / "t.csv").write_text(f"{name},x,y,z,qx,qy,qz,qw\n{rows}")
    np.testing.assert_allclose(read_poses(tmp_path / "t.csv").time_s, [0, 1, 60])


def test_the_unit_of_angles_is_that_of_the_header(tmp_path: Path) -> None:
    def yaw_rad(unit: str, yaw: float) -> float:
        (tmp_path / "t.csv").write_text(f"x,y,z,roll{unit},pitch{unit},yaw{unit}\n1,2,3,0,0,{yaw}\n")
        (pose,) = read_poses(tmp_path / "t.csv").poses
        return float(np.arctan2(pose[1, 0], pose[0, 0]))

    assert yaw_rad("_deg", 5.0) == pytest.approx(np.radians(5.0))
    assert yaw_rad("_rad", 6.0) == pytest.approx(6.0 - 2 * np.pi)
    assert yaw_rad("", 90.0) == pytest.approx(np.pi / 2)
    with pytest.warns(InputWarning, match="are taken for radians"):
        assert yaw_rad("", 0.5) == pytest.approx(0.5)


@pytest.mark.parametrize("mount_deg", [0.0, 90.0, -160.0])
@pytest.mark.parametrize("is_backwards", [False, True])
@pytest.mark.parametrize(
    ("unit", "scale", "said"),
    [
        ("_deg", 1.0, None),
        ("_rad", np.pi / 180.0, None),
        ("_deg", np.pi / 180.0, "likely they are radians, taken for degrees"),
        ("_rad", 1.0, "likely they are degrees, taken for radians"),
        ("_deg", -1.0, "likely they grow clockwise"),
    ],
)
def test_yaws_that_do_not_turn_as_the_path_does_are_refused_with_the_likely_mend(
    tmp_path: Path, unit: str, scale: float, said: str | None, mount_deg: float, is_backwards: bool
) -> None:
    rng = np.random.default_rng(3)
    turns_rad = np.linspace(0.0, np.pi / 2.0, 200)
    yaws = (np.degrees(turns_rad) + mount_deg + rng.normal(0.0, 2.0, 200)) * scale
    rows = np.column_stack([20.0 * np.sin(turns_rad), 20.0 * (1.0 - np.cos(turns_rad)), np.zeros((200, 3)), yaws])
    path = tmp_path / "curve.csv"
    text = "\n".join(",".join(f"{number:.6f}" for number in row) for row in (rows[::-1] if is_backwards else rows))
    path.write_text(f"x,y,z,roll{unit},pitch{unit},yaw{unit}\n{text}\n")
    if said is None:
        assert len(read_poses(path).poses) == 200
    else:
        with pytest.raises(InputError, match=f"curve.csv: the yaws do not turn as the path does, .*{said}"):
            read_poses(path)


@pytest.mark.parametrize("kind", ["sways", "looks around", "stands"])
def test_yaws_that_tell_nothing_of_their_unit_are_taken_as_they_are(tmp_path: Path, kind: str) -> None:
    rng = np.random.default_rng(4)
    yaws = rng.uniform(-180.0, 180.0, 100) if kind == "looks around" else rng.normal(0.0, 3.0, 100)
    step_m = 0.0 if kind == "stands" else 1.0
    rows = "".join(f"{place * step_m},{rng.normal(0.0, 0.01)},0,0,0,{yaw}\n" for place, yaw in enumerate(yaws))
    path = tmp_path / "walk.csv"
    path.write_text(f"x,y,z,roll_deg,pitch_deg,yaw_deg\n{rows}")
    assert len(read_poses(path).poses) == 100
    path.write_text(f"x,y,z,roll_rad,pitch_rad,yaw_rad\n{rows}")
    if kind == "sways":  # by three radians, which no path along a line has
        with pytest.raises(InputError, match="likely they are degrees, taken for radians"):
            read_poses(path)
    else:
        assert len(read_poses(path).poses) == 100


def test_a_header_right_before_the_poses_holds_behind_many_comments(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    path.write_text("# note\n" * 300 + "# time x y z qw qx qy qz\n0 1 2 3 1 0 0 0\n1 1 2 4 1 0 0 0\n")
    found = read_poses(path)
    np.testing.assert_allclose(found.poses[0][:3, :3], np.eye(3), atol=1e-12)


def test_the_longest_line_is_read(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    path.write_text("0 0 0 0 0 0 0 1\n" + ("#" + "x" * 49_999 + "\n") * 2 + "1 0 0 0 0 0 0 1\n")
    assert len(read_tum(path)[0]) == 2


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1 " * 400_000, ":1: more than 50000 letters"),
        ("0 0 0 0 0 0 0 1\n# " + "x," * 400_000, ":2: more than 50000 letters"),
        (",".join(f"c{column}" for column in range(1_001)), ":1: 1001 fields: expected at most 1000"),
        ("\n" * 1_500_001, ": more than 1500000 lines"),
        ("#\n" * 1_500_001, ": more than 1500000 lines"),
    ],
)
def test_a_file_that_no_trajectory_can_be_is_refused_early(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(text)
    for read in (read_poses, read_tum):
        if read is read_poses or "fields" not in said:
            with pytest.raises(InputError) as caught:
                read(path)
            assert str(caught.value).startswith(f"{path}{said}") and "\n" not in str(caught.value)


def test_reading_poses_takes_no_multiple_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("0.123456789,0.123456789,0.123456789,0.000000000,0.000000000,0.000000000,1.0\n" * 50_000 + "1,2")
    tracemalloc.start()
    with pytest.raises(InputError, match=r":50001: 2 fields, 7 in the first line"):
        read_poses(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * path.stat().st_size
