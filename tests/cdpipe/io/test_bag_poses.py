"""Poses in bags: the frames of tf that tell the sensor's way, messages that hold none, and pauses."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="pip install 'tunnelcd[formats]'")

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.geometry import make_pose, transform
from cdpipe.io.foreign import bag_files
from cdpipe.io.foreign.frames import Edge, compose, find_chain, is_base, is_fixed
from cdpipe.io.readers import open_session
from tests.cdpipe.io.foreign_files import (
    MADE,
    START_NS,
    RosMessages,
    drive,
    odom_T_sensor,
    off_walls_m,
    said,
    worst_m,
    write_bag,
)


def test_a_joint_of_the_robot_is_no_way_of_the_sensor(tmp_path: Path) -> None:
    text = said(write_bag(tmp_path / "leg.bag", MADE, "leg"))
    assert "no poses of the sensor in it" in text
    assert "tf moves os_lidar in base_footprint alone, a part of the robot: give --trajectory FILE" in text
    path = write_bag(tmp_path / "spin.bag", MADE, "spin")
    with pytest.warns(InputWarning, match="tf moves os_lidar in spin_base alone, .* give --odometry kiss-icp"):
        open_session(path)


def test_frames_are_known_by_their_names() -> None:
    assert all(map(is_fixed, ("odom", "camera_init", "robot/map", "lidar_odom")))
    assert not any(map(is_fixed, ("spin_base", "base_link", "modem", "mapper")))
    assert all(map(is_base, ("base_link", "robot/base_footprint"))) and not is_base("spin_base")


def test_the_fixed_frame_is_the_first_in_which_the_sensor_moves(tmp_path: Path) -> None:
    assert worst_m(write_bag(tmp_path / "a.bag", MADE, "merged")) < 1e-3
    time_s = np.array([0.0, 1.0])
    moving = make_pose(np.eye(3)[None].repeat(2, axis=0), np.array([[0.0, 0, 0], [1, 0, 0]]))
    still = np.eye(4)[None].repeat(2, axis=0)
    edges = {"odom": Edge("map", time_s, moving), "lidar": Edge("odom", time_s, still)}
    assert [edge.parent for edge in find_chain(edges, "lidar")] == ["map", "odom"]
    assert find_chain(edges, "odom") == []  # its clouds are registered
    assert [edge.parent for edge in find_chain({**edges, "odom": Edge("map", time_s, still)}, "lidar")] == ["odom"]
    assert [edge.parent for edge in find_chain({"lidar": Edge("odom", time_s, moving)}, "lidar")] == ["odom"]
    assert compose("tf", find_chain(edges, "lidar")) is not None


def spoil_poses(monkeypatch: pytest.MonkeyPatch, spoilt: set[int], w: float) -> None:
    """Let the quaternion of some Odometry messages be that of a message which nobody filled in."""
    odometry, numbers = RosMessages.odometry, iter(range(10_000))

    def change(self: RosMessages, *given: Any) -> Any:
        message = odometry(self, *given)
        if next(numbers) in spoilt:
            message.pose.pose.orientation = self.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, w)
        return message

    monkeypatch.setattr(RosMessages, "odometry", change)


@pytest.mark.parametrize("w", [0.0, np.nan])
def test_messages_without_a_pose_are_left_out_where_they_are_few(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, w: float
) -> None:
    spoil_poses(monkeypatch, {0, 7}, w)
    path = write_bag(tmp_path / "a.bag", MADE, "odometry")
    with pytest.warns(InputWarning, match=r"base_link in odom: 2 of \d+ messages hold no poses, and are left out"):
        assert worst_m(path) < 1e-3


def test_messages_without_a_pose_are_refused_where_they_are_many(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoil_poses(monkeypatch, {0, 7, 8, 9}, 0.0)
    assert "pose 0: the quaternion's length is 0" in said(write_bag(tmp_path / "a.bag", MADE, "odometry"))
    spoil_poses(monkeypatch, set(range(10_000)), 0.0)
    assert "pose 0: the quaternion's length is 0" in said(write_bag(tmp_path / "b.bag", MADE, "odometry"))


def test_a_message_that_nobody_filled_in_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    everything = RosMessages.all

    def with_empty(self: RosMessages, *given: Any) -> Any:
        empty = self.odometry(0.0, np.eye(4))
        empty.header.frame_id, empty.child_frame_id, empty.pose.pose.orientation.w = "", "", 0.0
        empty.header.stamp.sec, empty.header.stamp.nanosec = 0, 0
        return [("/odom", "nav_msgs/msg/Odometry", 0.0, empty), *everything(self, *given)]

    monkeypatch.setattr(RosMessages, "all", with_empty)
    path = write_bag(tmp_path / "a.bag", MADE, "odometry")
    with pytest.warns(InputWarning, match="1 of 1 messages hold no poses, and are left out"):
        assert worst_m(path) < 1e-3


def drop_poses(db3: Path, from_s: float, to_s: float) -> None:
    with closing(sqlite3.connect(db3)) as base, base:
        at = "topic_id = (SELECT id FROM topics WHERE name = '/odom') AND timestamp BETWEEN ? AND ?"
        base.execute(f"DELETE FROM messages WHERE {at}", [START_NS + round(s * 1e9) for s in (from_s, to_s)])


def test_clouds_in_a_pause_of_the_poses_of_a_bag_are_left_out(tmp_path: Path) -> None:
    made = drive(30, n_points=300)  # 0.5 to 3.4 s
    (db3,) = write_bag(tmp_path / "ros2", made, "odometry").glob("*.db3")
    drop_poses(db3, 1.25, 2.35)
    told = "11 of 30 clouds lie before or after its poses, or where these pause for more than 1 s, and are left out"
    with pytest.warns(InputWarning, match=told):
        source = open_session(db3)
    kept_s = np.concatenate([made.stamps_s[:8], made.stamps_s[19:]])
    np.testing.assert_allclose(source.odom_T_sensor, odom_T_sensor(kept_s), atol=1e-4)
    for scan, time_s in zip(source.scans(), kept_s, strict=True):
        if not 1.15 < time_s < 2.35:  # the sweep ends in the pause
            assert off_walls_m(transform(scan.odom_T_sensor, scan.points_sensor)).max() < 1e-3
    drop_poses(db3, 0.42, 3.58)
    assert "all of its 30 clouds lie before or after its poses, or where these pause" in said(db3)


def test_joints_elsewhere_on_a_robot_take_no_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_bag(tmp_path / "a.bag", MADE, "wheel")
    pairs = {(about["parent"], about["child"]) for about, _ in bag_files.read_transforms(str(path), ["/tf"])}
    assert pairs == {("odom", "base_link"), ("base_link", "os_lidar"), ("base_link", "wheel")}
    found = list(bag_files.read_transforms(str(path), ["/tf"], "os_lidar"))
    assert {(about["parent"], about["child"]) for about, _ in found} == pairs - {("base_link", "wheel")}
    n_poses = max(len(arrays["stamps"]) for _, arrays in found)
    monkeypatch.setattr(bag_files, "_MOST_POSES", n_poses)
    assert len(list(bag_files.read_transforms(str(path), ["/tf"], "os_lidar"))) == 2
    monkeypatch.setattr(bag_files, "_MOST_POSES", n_poses - 1)
    with pytest.raises(InputError, match=r"more than \d+ poses of base_link in odom: give --trajectory FILE, or --od"):
        list(bag_files.read_transforms(str(path), ["/tf"], "os_lidar"))


def test_frames_beside_the_sensor_are_kept_for_odometry(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag", MADE, "imu")
    found = bag_files.read_transforms(str(path), ["/tf_static"], "os_lidar")
    assert {about["child"] for about, _ in found} == {"os_lidar", "os_imu"}
