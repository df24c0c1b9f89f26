"""Recordings in formats of others, written by their libraries: scans lie on the walls of the box they were taken in."""

from __future__ import annotations

import os
import shutil
import sqlite3
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("pypcd4", reason="pip install 'tunnelcd[formats]'")
pytest.importorskip("rosbags", reason="pip install 'tunnelcd[formats]'")

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.geometry import make_pose, transform
from cdpipe.io.foreign import HowToRead, convert_recording, folder_of_options, guess_format, read_poses
from cdpipe.io.foreign.bags import _compose, _Edge
from cdpipe.io.foreign.clouds import point_times
from cdpipe.io.foreign.points_files import read_e57
from cdpipe.io.ply import read_ply
from cdpipe.io.readers import open_session
from cdpipe.mapping.session_check import check_session
from cdpipe.model.config import MapConfig
from tests.cdpipe.io import foreign_files
from tests.cdpipe.io.foreign_files import (
    START_NS,
    drive,
    odom_T_sensor,
    off_walls_m,
    write_bag,
    write_e57,
    write_kitti,
    write_lases,
    write_pcds,
    write_trajectory,
)

MADE, STANDING = drive(), drive(sweep_s=0.0)
FINE_S = np.arange(0.3, 1.4, 0.013)


def worst_m(path: Path, how: HowToRead | None = None) -> float:
    """Return the largest distance of a return from the walls."""
    source = open_session(path, how)
    scans = list(source.scans())
    assert len(scans) == len(MADE.stamps_s) == len(source.odom_T_sensor)
    np.testing.assert_allclose(source.odom_T_sensor, odom_T_sensor(MADE.stamps_s), atol=1e-4)
    return max(float(off_walls_m(transform(scan.odom_T_sensor, scan.points_sensor)).max()) for scan in scans)


def said(path: Path, how: HowToRead | None = None) -> str:
    with pytest.raises(InputError) as caught:
        list(open_session(path, how).scans())
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd_scans_are_deskewed_by_their_own_times(tmp_path: Path, encoding: str) -> None:
    folder = write_pcds(tmp_path / "run", MADE, encoding)
    write_trajectory(folder / "t.tum", MADE.stamps_s)
    assert worst_m(folder) < 0.01  # the poses between the scans are interpolated
    assert worst_m(folder, HowToRead(deskew=False)) > 0.3


def test_laz_scans_with_gps_times(tmp_path: Path) -> None:
    folder = write_lases(tmp_path / "run", MADE)
    write_trajectory(folder / "t.csv", MADE.stamps_s, "csv")
    assert worst_m(folder) < 0.01


def test_semantic_kitti(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path / "00", STANDING)
    assert worst_m(folder) < 1e-4
    (folder / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 -1 0\n")
    assert "calib.txt:1: Tr mirrors" in said(folder)
    (folder / "velodyne" / "000002.bin").write_bytes(b"x" * 30)
    (folder / "calib.txt").unlink()
    with pytest.warns(InputWarning, match="no calib.txt beside it: its poses are taken for those of the lidar"):
        assert "000002.bin: 30 bytes: expected x, y, z, intensity" in said(folder)


def test_e57_has_the_poses_of_its_scanner(tmp_path: Path) -> None:
    pytest.importorskip("pye57")
    assert worst_m(write_e57(tmp_path / "a.e57", STANDING)) < 1e-4


def test_an_e57_in_spherical_coordinates_with_intensities(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pye57 = pytest.importorskip("pye57")
    path = write_e57(tmp_path / "a.e57", STANDING)  # pye57 reads spherical coordinates, and writes none

    def spherical(file: object, index: int, **options: bool) -> dict[str, np.ndarray]:
        assert options["intensity"]
        x, y, z = STANDING.clouds[index][0].T
        range_m = np.sqrt(x * x + y * y + z * z)
        turned = {"sphericalRange": range_m, "sphericalAzimuth": np.arctan2(y, x)}
        return {**turned, "sphericalElevation": np.arcsin(z / range_m), "intensity": np.full(len(x), 0.5)}

    monkeypatch.setattr(pye57.E57, "read_scan", spherical)
    ((_, arrays),) = read_e57(str(path), 2)
    np.testing.assert_allclose(arrays["points"], STANDING.clouds[2][0], atol=1e-9)
    assert set(arrays["intensity"]) == {0.5}


def test_names_that_are_stamps_need_no_zeros(tmp_path: Path) -> None:
    folder = write_pcds(tmp_path / "run", STANDING)
    for index, share in enumerate(("05", "15", "2", "3", "45", "5")):
        (folder / f"{index:06d}.pcd").rename(folder / f"{START_NS // 10**9}.{share}.pcd")
    poses = write_trajectory(tmp_path / "t.tum", np.array([0.05, 0.15, 0.2, 0.3, 0.45, 0.5]))
    assert len(list(open_session(folder, HowToRead(trajectory=poses, deskew=False)).scans())) == 6
    for index in (2, 15):
        shutil.copy(folder / f"{START_NS // 10**9}.2.pcd", tmp_path / f"{index}.pcd")
    assert "numbered without leading zeros" in said(tmp_path, HowToRead(trajectory=poses, format="pcd"))


def test_viewpoints_are_poses_in_the_sub_folder_pcd_alone(tmp_path: Path) -> None:
    for name in ("pcd", "scans"):
        folder = write_pcds(tmp_path / name / name, STANDING, "ascii", with_time=False)
        for file, stamp_s in zip(sorted(folder.glob("*.pcd")), STANDING.stamps_s, strict=True):
            file.write_text(file.read_text().replace("VIEWPOINT 0.0 0.0 0.0", f"VIEWPOINT {stamp_s} 0.0 0.0"))
    assert len(list(open_session(tmp_path / "pcd").scans())) == 6
    assert "expected exactly one trajectory" in said(tmp_path / "scans")


def test_times_of_points_count_from_the_nearer_of_stamp_and_zero() -> None:
    sweep_s = np.linspace(0.0, 0.1, 5)
    for stamp_s in (0.5, 5.0, 1.7e9):
        for first_s in (stamp_s, 0.0, 77.0):
            found = point_times(first_s + sweep_s, stamp_s)
            assert found is not None
            np.testing.assert_allclose(found, sweep_s, atol=1e-6)
    assert point_times(20.0 * sweep_s, 5.0) is None


def test_scans_that_cannot_be_deskewed_are_told(tmp_path: Path) -> None:
    long = drive(sweep_s=2.0)
    folder = write_pcds(tmp_path / "run", long)
    poses = write_trajectory(folder / "t.tum", long.stamps_s)
    with pytest.warns(
        InputWarning, match=r"run: 6 of 6 scans are not deskewed, .*: they span no sweep, 0\.004 to 1\.5 s"
    ):
        list(open_session(folder).scans())
    list(open_session(folder, HowToRead(deskew=False)).scans())
    lines = poses.read_text().splitlines()
    poses.write_text("\n".join([lines[0], lines[0].split()[0] + lines[1][len(lines[0].split()[0]) :], *lines[2:]]))
    with pytest.warns(
        InputWarning, match="6 of 6 scans are not deskewed, .*: there are no two poses with times that rise"
    ):
        list(open_session(folder).scans())


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


def test_a_folder_without_scans_tells_what_it_holds(tmp_path: Path) -> None:
    assert "no scans in it (it is empty): expected" in said(tmp_path)
    for name in ("a.json", "b.json", "README"):
        (tmp_path / name).write_text("{}")
    assert "(there are 2 *.json, 1 without suffix): expected" in said(tmp_path)
    (tmp_path / "a.osf").write_text("")
    assert "1 *.osf; name one of them): expected" in said(tmp_path)


def test_a_las_that_was_cut_short_names_a_way_out(tmp_path: Path) -> None:
    path = write_lases(tmp_path / "run", MADE, ".las") / "000000.las"
    path.write_bytes(path.read_bytes()[:-7])
    assert said(path).endswith(": copy or export it again")


def test_a_bag_that_is_none_says_so(tmp_path: Path) -> None:
    for number, content in enumerate((b"x", b"")):
        path = tmp_path / f"{number}.bag"
        path.write_bytes(content)
        assert "not a readable bag: it begins with none of b'#ROSBAG'" in said(path)
        assert "copy or record it again" in said(path)


def test_intensities_and_times_of_a_bag_become_those_of_its_scans(tmp_path: Path) -> None:
    folder = write_pcds(tmp_path / "run", MADE)
    write_trajectory(folder / "t.tum", MADE.stamps_s)
    convert_recording(folder, tmp_path / "out", HowToRead(), lambda *_: None)
    for index, scan in enumerate(open_session(folder).scans()):
        points, scalars = read_ply(tmp_path / "out" / f"{index:06d}.ply", ("intensity", "time"))
        np.testing.assert_allclose(points, scan.points_sensor, atol=1e-5)
        np.testing.assert_array_equal(scalars["intensity"], 7.0)
        np.testing.assert_allclose(scalars["time"], MADE.clouds[index][1], atol=1e-6)
    assert worst_m(tmp_path / "out") < 0.01  # they are not deskewed again


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
    still = _Edge("map", np.array([5.0]), make_pose(np.eye(3), (1.0, 2.0, 4.0))[None])
    found = _compose("tf", [still, _Edge("base_link", np.array([5.0]), make_pose(np.eye(3), (0.0, 0.0, 0.5))[None])])
    assert found is not None
    np.testing.assert_allclose(found.poses[:, :3, 3], [[1.0, 2.0, 4.5]])


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


def test_times_of_a_trajectory_and_of_its_scans_agree(tmp_path: Path) -> None:
    folder = write_pcds(tmp_path / "run", MADE)
    write_trajectory(folder / "t.tum", MADE.stamps_s)
    np.savetxt(folder / "times.txt", START_NS / 1e9 + MADE.stamps_s - 0.09, fmt="%.6f")
    assert len(list(open_session(folder).scans())) == 6
    np.savetxt(folder / "times.txt", START_NS / 1e9 + MADE.stamps_s - 50.0, fmt="%.6f")
    assert "t.tum: its times and those of the scans of" in said(folder)
    assert "differ by 50.000 s" in said(folder)


def test_descriptors_of_other_options_lie_apart(tmp_path: Path) -> None:
    assert folder_of_options(tmp_path, HowToRead()) == tmp_path
    hows = [HowToRead(deskew=False), HowToRead(topics=("/a",)), HowToRead(topics=("/b",)), HowToRead(format="las")]
    folders = {folder_of_options(tmp_path, how) for how in hows}
    assert len(folders) == 4
    assert {folder.parent for folder in folders} == {tmp_path}
    assert folder_of_options(tmp_path, hows[0]) == folder_of_options(tmp_path, HowToRead(deskew=False))


def test_a_bag_beside_scans_is_one_of_two_formats(tmp_path: Path) -> None:
    folder = write_pcds(tmp_path / "run", MADE)
    bag = write_bag(folder / "stray.bag", MADE)
    with pytest.raises(InputError, match=r"several formats \(6 pcd, 1 bag\): name one, --format pcd or bag"):
        guess_format(folder)
    for file in sorted(folder.glob("*.pcd"))[1:]:
        file.unlink()
    assert guess_format(folder) == guess_format(bag) == "bag"  # one cloud is a map


def test_a_bag_becomes_a_folder_that_goes_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    source = open_session(write_bag(tmp_path / "a.bag", MADE))
    assert source.name == str(tmp_path / "a.bag")
    assert len(list(tmp_path.glob("tunnelcd-read-*/scans/*.ply"))) == 6
    del source
    assert not list(tmp_path.glob("tunnelcd-read-*"))


def test_what_is_no_recording_is_named(tmp_path: Path) -> None:
    assert "no such file or folder" in said(tmp_path / "gone.bag")
    (tmp_path / "a.txt").write_text("x")
    assert "expected a session folder, or a recording (.ply" in said(tmp_path / "a.txt")
    folder = write_pcds(tmp_path / "run", MADE)
    assert "exactly one trajectory" in said(folder)
    assert "a map without its scans" in said(folder / "000000.pcd")
    write_lases(folder, MADE)
    assert "scans of several formats (6 pcd, 6 las): name one, --format pcd or las" in said(folder)
    write_trajectory(folder / "t.tum", MADE.stamps_s)
    assert worst_m(folder, HowToRead(format="las")) < 0.01
    with pytest.raises(InputError, match="--format las7: expected one of session, ply"):
        HowToRead(format="las7")


def test_millimetres_are_named(tmp_path: Path) -> None:
    in_mm = [(1000.0 * points, offset_s) for points, offset_s in STANDING.clouds]
    folder = write_pcds(tmp_path / "run", type(STANDING)(STANDING.stamps_s, in_mm), with_time=False)
    write_trajectory(folder / "t.tum", STANDING.stamps_s)
    with pytest.raises(InputError, match=r"look like millimetres: scale by 0\.001"):
        check_session(open_session(folder), MapConfig())


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1 2 3\n", "3 fields: expected eight numbers"),
        ("a,b,c\n1,2,3\n", "its header names a, b, c"),
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


@pytest.mark.skipif(sys.platform == "win32", reason="there are no pipes in folders")
@pytest.mark.parametrize(("write", "name"), [(write_pcds, "pcd"), (write_lases, "las")])
def test_a_pipe_in_the_place_of_a_scan_is_not_waited_for(write: Callable[..., Path], name: str, tmp_path: Path) -> None:
    folder = write(tmp_path / "run", MADE)
    scan = sorted(path for path in folder.iterdir() if path.suffix in (".pcd", ".las", ".laz"))[1]
    scan.unlink()
    os.mkfifo(scan)
    write_trajectory(tmp_path / "poses.txt", MADE.stamps_s)
    assert "it is a device or a pipe" in said(folder, HowToRead(format=name, trajectory=tmp_path / "poses.txt"))
