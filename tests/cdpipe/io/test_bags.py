"""Bags of ROS 1, ROS 2 and MCAP: clouds lie on the walls of the box they were taken in."""

from __future__ import annotations

import os
import shutil
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pypcd4", reason="pip install 'tunnelcd[formats]'")
pytest.importorskip("rosbags", reason="pip install 'tunnelcd[formats]'")

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.geometry import make_pose, transform
from cdpipe.io.foreign import HowToRead, guess_format
from cdpipe.io.foreign.frames import Edge, compose
from cdpipe.io.readers import open_session
from tests.cdpipe.io import foreign_files
from tests.cdpipe.io.foreign_files import (
    MADE,
    START_NS,
    drive,
    odom_T_sensor,
    off_walls_m,
    said,
    worst_m,
    write_bag,
    write_trajectory,
)

FINE_S = np.arange(0.3, 1.4, 0.013)


@pytest.mark.parametrize(
    ("name", "poses"),
    [("a.bag", "tf"), ("a.bag", "pose"), ("ros2", "tf"), ("ros2", "odometry"), ("a.mcap", "tf"), ("a.mcap", "pose")],
)
def test_bags(tmp_path: Path, name: str, poses: str) -> None:
    if name.endswith(".mcap"):
        pytest.importorskip("mcap")
    path = write_bag(tmp_path / name, MADE, poses)
    assert guess_format(path) == "bag"
    assert worst_m(path) < 1e-3


def test_a_bag_is_looked_through_with_its_progress(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag", drive(n_scans=120, n_points=40))
    told: list[tuple[str, int, int]] = []
    source = open_session(path, report=lambda *step: told.append(step))
    assert [done for name, done, total in told if name == "look through" and total == 120] == [0, 50, 100, 120, 120]
    assert told[-1] == ("write", 120, 120)
    np.testing.assert_allclose(np.diff(source.stamps_s), 0.1, atol=1e-6)


def test_a_lone_db3_is_a_bag(tmp_path: Path) -> None:
    shutil.copy(next(write_bag(tmp_path / "ros2", MADE).glob("*.db3")), tmp_path / "lone.db3")
    assert worst_m(tmp_path / "lone.db3") < 1e-3


@pytest.mark.parametrize("has_index", [True, False])
def test_an_mcap_without_chunks(tmp_path: Path, has_index: bool) -> None:
    from mcap.writer import IndexType  # noqa: PLC0415 - only where the extra is installed

    bare = {} if has_index else {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False}
    path = write_bag(tmp_path / "a.mcap", MADE, use_chunking=False, **bare)
    assert worst_m(path) < 1e-3


def test_an_mcap_that_begins_at_time_0_keeps_all_its_clouds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_reader = pytest.importorskip("mcap.reader").make_reader
    later = write_bag(tmp_path / "later.mcap", MADE, chunk_size=4096)
    with closing(later.open("rb")) as file:
        first_ns = min(message.log_time for *_, message in make_reader(file).iter_messages())
    monkeypatch.setattr(foreign_files, "START_NS", START_NS - first_ns)
    path = write_bag(tmp_path / "a.mcap", MADE, chunk_size=4096)
    assert worst_m(path) < 1e-3


def test_clouds_that_are_announced_and_cannot_be_read_are_told(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "ros2", MADE)
    about = path / "metadata.yaml"
    text = about.read_text()
    assert text.count("message_count: 6") == 1
    about.write_text(text.replace("message_count: 6", "message_count: 9"))
    with pytest.warns(InputWarning, match="/ouster/points: 6 of 9 clouds can be read: the bag is cut short or damaged"):
        assert worst_m(path) < 1e-3


def shuffle_clouds(db3: Path, order: list[int], repeats: int = 0) -> None:
    """Let the clouds of a bag arrive in another order, the first ones again at the end; their headers stay."""
    with closing(sqlite3.connect(db3)) as base, base:
        (topic,) = base.execute("SELECT id FROM topics WHERE name = '/ouster/points'").fetchone()
        asked = "SELECT id, timestamp, data FROM messages WHERE topic_id = ? ORDER BY timestamp"
        rows = base.execute(asked, (topic,)).fetchall()
        for place, (_, stamp_ns, _) in zip(order, rows, strict=True):
            base.execute("UPDATE messages SET timestamp = ? WHERE id = ?", (stamp_ns, rows[place][0]))
        late = [(topic, rows[-1][1] + 1 + n, rows[n][2]) for n in range(repeats)]
        base.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", late)


def test_clouds_of_a_bag_are_sorted_by_their_stamps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_bag(tmp_path / "ros2", MADE)
    (db3,) = path.glob("*.db3")
    shuffle_clouds(db3, [0, 3, 1, 2, 5, 4])
    with pytest.warns(InputWarning, match="2 clouds come after one with a later stamp, and are sorted by header.stamp"):
        assert worst_m(db3) < 1e-3
    monkeypatch.setattr("cdpipe.io.foreign.bags._MOST_WAITING", 0)
    assert "its clouds are up to 1 places out of the order of their stamps" in said(db3)


def test_clouds_of_a_bag_that_repeat_a_stamp_are_left_out(tmp_path: Path) -> None:
    (db3,) = write_bag(tmp_path / "ros2", MADE).glob("*.db3")
    shuffle_clouds(db3, list(range(6)), repeats=2)
    with pytest.warns(InputWarning, match="2 of 8 clouds have the stamp of another one, and are left out"):
        assert worst_m(db3) < 1e-3
    unset = type(MADE)(np.full(6, 0.5), MADE.clouds)
    text = said(write_bag(tmp_path / "unset.bag", unset, "none"), HowToRead(trajectory=tmp_path / "t.tum"))
    assert "too few stamps (1 on 6 clouds): header.stamp was not set" in text


def test_a_bag_that_is_none_says_so(tmp_path: Path) -> None:
    for number, content in enumerate((b"x", b"")):
        path = tmp_path / f"{number}.bag"
        path.write_bytes(content)
        assert "not a readable bag: it begins with none of b'#ROSBAG'" in said(path)
        assert "copy or record it again" in said(path)
    whole = write_bag(tmp_path / "whole.bag", MADE)
    (tmp_path / "cut.bag").write_bytes(whole.read_bytes()[:-2000])
    assert "cut.bag: not a readable bag: " in said(tmp_path / "cut.bag")
    assert "if it was cut short, `rosbag reindex FILE`" in said(tmp_path / "cut.bag")


@pytest.mark.parametrize(("suffix", "told"), [(".mcap", "mcap recover"), (".db3", "sqlite3 FILE .recover")])
def test_a_cut_bag_of_ros_2_names_what_mends_it(tmp_path: Path, suffix: str, told: str) -> None:
    if suffix == ".mcap":
        pytest.importorskip("mcap")
        whole = write_bag(tmp_path / "whole.mcap", MADE)
    else:
        whole = next(write_bag(tmp_path / "whole", MADE).glob("*.db3"))
    cut = tmp_path / f"cut{suffix}"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    assert "cut" in said(cut) and f"if it was cut short, `{told}" in said(cut)


def test_topics_and_poses_that_a_bag_lacks_are_listed(tmp_path: Path) -> None:
    bare = write_bag(tmp_path / "bare.bag", MADE, "none")
    text = said(bare)
    assert "no poses of the sensor in it (it holds /ouster/points (PointCloud2, 6))" in text
    assert "--trajectory FILE" in text
    assert "--odometry kiss-icp" in text
    assert worst_m(bare, HowToRead(trajectory=write_trajectory(tmp_path / "t.tum", FINE_S))) < 1e-3
    two = write_bag(tmp_path / "two.bag", MADE, "tf", ("/a/points", "/b/points"))
    assert "--topic /a/points or /b/points" in said(two)
    assert worst_m(two, HowToRead(topics=("/b/points",))) < 1e-3
    assert "--topic /c: not in it" in said(two, HowToRead(topics=("/c",)))


def test_clouds_outside_the_poses_of_a_bag_are_left_out(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag", MADE, "odometry", last_pose_s=0.7)
    with pytest.warns(InputWarning, match="3 of 6 clouds lie before or after"):
        source = open_session(path)
    assert len(list(source.scans())) == len(source.odom_T_sensor) == 3


def test_tf_within_the_robot_is_no_way_where_odometry_is(tmp_path: Path) -> None:
    assert worst_m(write_bag(tmp_path / "a.bag", MADE, "footprint")) < 1e-3


def test_a_tf_that_repeats_itself_is_no_movement(tmp_path: Path) -> None:
    assert worst_m(write_bag(tmp_path / "a.bag", MADE, "standing")) < 1e-3
    assert "no poses of the sensor in it" in said(write_bag(tmp_path / "b.bag", MADE, "mounting"))
    still = Edge("map", np.array([5.0]), make_pose(np.eye(3), (1.0, 2.0, 4.0))[None])
    found = compose("tf", [still, Edge("base_link", np.array([5.0]), make_pose(np.eye(3), (0.0, 0.0, 0.5))[None])])
    assert found is not None
    np.testing.assert_allclose(found.poses[:, :3, 3], [[1.0, 2.0, 4.5]])


def test_poses_of_a_part_beside_the_sensor_are_led_to_it_by_tf(tmp_path: Path) -> None:
    assert worst_m(write_bag(tmp_path / "a.bag", MADE, "imu")) < 1e-3


def test_poses_that_name_no_frame_are_the_sensors_with_a_warning(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag", MADE, "unnamed")
    told = "the poses of /slam/pose name no frame, and tf has os_lidar on base_link: they are taken for those of the"
    with pytest.warns(InputWarning, match=told):
        open_session(path)


def test_a_mounting_that_tf_repeats_bounds_no_time(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag", MADE, "twice")
    assert worst_m(path) < 1e-3 and len(open_session(path).odom_T_sensor) == len(MADE.clouds)


def test_transforms_of_a_robot_that_are_no_poses_are_left_out(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag", MADE, "wheel")
    with pytest.warns(InputWarning, match=r"base_link in odom: 1 of \d+ transforms are no poses, and are left out"):
        assert worst_m(path) < 1e-3


def test_clouds_of_two_sensors_on_one_topic_are_refused(tmp_path: Path) -> None:
    text = said(write_bag(tmp_path / "a.bag", MADE, "frames"))
    assert "its clouds are of several frames (os_lidar, rear), and so of several sensors: record one topic" in text


def test_a_compressed_bag_is_known_by_the_files_beside_its_metadata(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    (tmp_path / "run_0.db3.zstd").write_bytes(b"")
    assert guess_format(tmp_path) == "bag"
    (tmp_path / "run_0.db3.zstd").unlink()
    assert "no scans in it" in said(tmp_path)


def test_a_sensor_that_stands_in_its_tf_stands_with_a_warning(tmp_path: Path) -> None:
    (db3,) = write_bag(tmp_path / "ros2", MADE, "standing").glob("*.db3")
    with closing(sqlite3.connect(db3)) as base, base:
        base.execute("DELETE FROM messages WHERE topic_id = (SELECT id FROM topics WHERE name = '/odom')")
    with pytest.warns(InputWarning, match="by its tf os_lidar stands in map, and so does the sensor"):
        assert np.ptp(open_session(db3).odom_T_sensor, axis=0).max() == 0


def test_registered_clouds_of_a_bag_are_moved_back(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag", MADE, "registered")
    with pytest.warns(InputWarning, match="its clouds are in odom, the frame of the poses of /odom: they are taken as"):
        source = open_session(path, HowToRead(origin_m=(0.0, 0.0, -50.0)))
    np.testing.assert_allclose(source.odom_T_sensor[:, 2, 3], 50.0, atol=1.0)
    for scan in source.scans():
        found = transform(scan.odom_T_sensor, scan.points_sensor) - (0.0, 0.0, 50.0)
        assert off_walls_m(found).max() < 1e-3
    tum = write_trajectory(tmp_path / "t.tum", FINE_S)
    with pytest.warns(InputWarning, match="/ouster/points: its frame is odom, which does not move with the sensor"):
        open_session(path, HowToRead(trajectory=tum))


def test_clouds_of_a_bag_without_a_return_are_left_out(tmp_path: Path) -> None:
    made = drive(8)
    clouds = list(made.clouds)
    clouds[1] = (np.zeros((0, 3)), np.zeros(0))
    clouds[3] = (np.full((5, 3), np.nan), np.linspace(0.0, 0.1, 5))
    path = write_bag(tmp_path / "a.bag", type(made)(made.stamps_s, clouds), "odometry", last_pose_s=1.05)
    with pytest.warns(InputWarning) as caught:
        source = open_session(path)
    told = [str(each.message) for each in caught]
    assert any("2 of 8 clouds hold no return, and are left out" in each for each in told)
    assert any("1 of 6 clouds lie before or after" in each for each in told)
    scans = list(source.scans())
    assert len(scans) == 5
    np.testing.assert_allclose(source.odom_T_sensor[:4], odom_T_sensor(made.stamps_s[[0, 2, 4, 5]]), atol=1e-4)
    assert max(off_walls_m(transform(each.odom_T_sensor, each.points_sensor)).max() for each in scans[:3]) < 1e-3
    empty = write_bag(tmp_path / "b.bag", type(MADE)(MADE.stamps_s, [clouds[1]] * 6))
    assert "none of its 6 clouds holds a return" in said(empty)


def test_a_bag_becomes_a_folder_that_goes_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    source = open_session(write_bag(tmp_path / "a.bag", MADE))
    assert source.name == str(tmp_path / "a.bag")
    assert len(list(tmp_path.glob("tunnelcd-read-*/scans/*.ply"))) == 6
    del source
    assert not list(tmp_path.glob("tunnelcd-read-*"))


@pytest.mark.skipif(sys.platform == "win32", reason="there are no pipes in folders")
@pytest.mark.parametrize("name", ["r.mcap", "r/r.mcap", "r/r_0.db3"])
def test_a_pipe_in_the_place_of_a_bag_is_not_waited_for(name: str, tmp_path: Path) -> None:
    (tmp_path / "r").mkdir()
    os.mkfifo(tmp_path / name)
    if name.endswith(".db3"):
        (tmp_path / "r" / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    path = tmp_path / name.partition("/")[0]
    with pytest.raises(InputError, match="it is a device or a pipe"):
        open_session(path, HowToRead(format="bag"))
