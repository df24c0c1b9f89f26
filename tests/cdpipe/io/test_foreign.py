"""Recordings in formats of others, written by their libraries: scans lie on the walls of the box they were taken in."""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pypcd4", reason="pip install 'tunnelcd[formats]'")
pytest.importorskip("rosbags", reason="pip install 'tunnelcd[formats]'")

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.io.foreign import HowToRead, convert_recording, folder_of_options, guess_format
from cdpipe.io.foreign.clouds import point_times, stamps_of_names
from cdpipe.io.foreign.points_files import cloud_reader, read_e57, read_e57_heads
from cdpipe.io.foreign.sniff import find_scans
from cdpipe.io.out.kitti import write_kitti as write_kitti_out
from cdpipe.io.out.scans import Outgoing
from cdpipe.io.ply import read_ply
from cdpipe.io.readers import open_session
from cdpipe.mapping.session_check import check_session
from cdpipe.model.config import MapConfig
from tests.cdpipe.io.foreign_files import (
    MADE,
    STANDING,
    START_NS,
    Drive,
    drive,
    said,
    worst_m,
    write_bag,
    write_copc,
    write_e57,
    write_kitti,
    write_lases,
    write_merged_e57,
    write_pcds,
    write_trajectory,
)

FINE_S = np.arange(0.3, 1.4, 0.013)


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd_scans_are_deskewed_by_their_own_times(tmp_path: Path, encoding: str) -> None:
    folder = write_pcds(tmp_path / "run", MADE, encoding)
    write_trajectory(folder / "t.tum", MADE.stamps_s)
    assert worst_m(folder) < 0.01  # the poses between the scans are interpolated
    assert worst_m(folder, HowToRead(deskew=False)) > 0.3


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("folder", ["run", "run/pcd"])
def test_a_name_of_a_field_that_cuts_the_header_is_refused(tmp_path: Path, encoding: str, folder: str) -> None:
    files = sorted(write_pcds(tmp_path / folder, MADE, encoding).glob("*.pcd"))
    for file in files:
        file.write_bytes(file.read_bytes().replace(b" intensity time", b" C2C_absolute_distances[<0.3] time", 1))
    if folder == "run":
        write_trajectory(tmp_path / "run" / "t.tum", MADE.stamps_s)
    assert "000000.pcd: 4 of the names of its 5 fields can be read: a bracket, # or <" in said(tmp_path / "run")
    assert said(files[0]).endswith(": rename the field")


def test_points_of_a_pcd_without_one_coordinate_are_missing_returns(tmp_path: Path) -> None:
    clouds = [(points.copy(), offset_s) for points, offset_s in MADE.clouds]
    clouds[2][0][[3, 5, 7]] = [(np.nan, 1, 2), (np.inf, 1, 2), (np.nan, np.nan, np.nan)]
    folder = write_pcds(tmp_path / "run", Drive(MADE.stamps_s, clouds))
    write_trajectory(folder / "t.tum", MADE.stamps_s)
    with pytest.warns(InputWarning, match="3 of 5400 points are .* not finite: taken for missing returns and left out"):
        assert worst_m(folder) < 0.01


def test_laz_scans_with_gps_times(tmp_path: Path) -> None:
    folder = write_lases(tmp_path / "run", MADE)
    write_trajectory(folder / "t.csv", MADE.stamps_s, "csv")
    assert worst_m(folder) < 0.01


def test_copc_scans(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    for index, (points, _) in enumerate(STANDING.clouds):
        path = write_copc(tmp_path / f"{index:06d}.copc.laz", points)
        with laspy.CopcReader.open(path) as whole, laspy.CopcReader.open(path) as top:
            assert len(whole.query()) == len(points) > len(top.query(level=0)) > len(points) / 2
    write_trajectory(tmp_path / "t.tum", STANDING.stamps_s)
    assert worst_m(tmp_path) < 2e-4
    for scan, (points, _) in zip(open_session(tmp_path).scans(), STANDING.clouds, strict=True):
        np.testing.assert_allclose(np.sort(scan.points_sensor, axis=0), np.sort(points, axis=0), atol=6e-5)


def test_semantic_kitti(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path / "00", STANDING)
    assert worst_m(folder) < 1e-4
    (folder / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 -1 0\n")
    assert "calib.txt:1: Tr mirrors" in said(folder)
    (folder / "velodyne" / "000002.bin").write_bytes(b"x" * 30)
    (folder / "calib.txt").unlink()
    with pytest.warns(InputWarning, match="no calib.txt beside it: its poses are taken for those of the lidar"):
        assert "000002.bin: 30 bytes: expected x, y, z, intensity" in said(folder)


def test_an_e57_without_a_coordinate_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pye57 = pytest.importorskip("pye57")
    file = write_e57(tmp_path / "scans.e57", STANDING)

    def lack_z(*_: object, **__: object) -> None:
        raise Exception("unsupported point field ['cartesianX', 'cartesianY']")

    monkeypatch.setattr(pye57.E57, "read_scan", lack_z)
    with pytest.raises(
        InputError, match=r"scans.e57: not a readable E57 file: .*cartesianY.*: copy or export it again"
    ):
        list(read_e57(str(file), 0))


def test_e57_has_the_poses_of_its_scanner(tmp_path: Path) -> None:
    pytest.importorskip("pye57")
    assert worst_m(write_e57(tmp_path / "a.e57", STANDING)) < 1e-4


def test_a_pose_of_an_e57_that_lacks_a_number_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scan_header = pytest.importorskip("pye57.scan_header")
    file = write_e57(tmp_path / "a.e57", STANDING)
    assert all(head["pose"] is not None for head, _ in read_e57_heads(str(file)))
    monkeypatch.setattr(scan_header.ScanHeader, "translation", property(lambda _: np.zeros(2)))
    assert all(head["pose"] is None for head, _ in read_e57_heads(str(file)))


def test_a_folder_of_e57_stations_has_the_poses_of_its_scanners(tmp_path: Path) -> None:
    pytest.importorskip("pye57")
    for number in range(6):
        station = Drive(STANDING.stamps_s[number : number + 1], STANDING.clouds[number : number + 1])
        write_e57(tmp_path / f"station {number + 7}.e57", station)  # 7 to 12, without leading zeros
    assert guess_format(tmp_path) == "e57"
    assert worst_m(tmp_path) < 1e-4
    poses = write_trajectory(tmp_path / "t.tum", STANDING.stamps_s)
    assert "numbered without leading zeros" in said(tmp_path, HowToRead(trajectory=poses))
    write_pcds(tmp_path, STANDING)
    assert "several formats (6 pcd, 6 e57): name one, --format pcd or e57" in said(tmp_path)


def test_a_merged_e57_without_a_pose_is_a_whole_map(tmp_path: Path) -> None:
    pytest.importorskip("pye57")
    points = np.random.default_rng(3).uniform((0, -2, 0), (24, 2, 0), (20_000, 3))
    path = write_merged_e57(tmp_path / "a.e57", np.concatenate([points, points + np.array((0, 0, 3))]))
    source = open_session(path, HowToRead(origin_m=(100.0, 0.0, 0.0)))
    assert source.is_whole_map and len(source.odom_T_sensor) > 3
    read = np.concatenate([scan.points_sensor + scan.odom_T_sensor[:3, 3] for scan in source.scans()])
    assert len(read) == 40_000 and -100 <= read[:, 0].min() < -99 and -77 < read[:, 0].max() <= -76
    with pytest.raises(InputError, match=r"a\.e57: a map without its scans has no poses or times: name a new \.laz"):
        write_kitti_out(tmp_path, Outgoing(source), (), lambda *_: None)
    assert len(list(tmp_path.iterdir())) == 1
    poses = write_trajectory(tmp_path / "t.tum", STANDING.stamps_s[:1])
    assert len(list(open_session(path, HowToRead(trajectory=poses)).scans())) == 1  # somebody says that it is a scan


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


def write_bins(folder: Path, made: Drive, n_more: int) -> Path:
    """Write scans of x, y, z, an intensity and more columns: the first a ring, as nuScenes has it."""
    (folder / "velodyne").mkdir(parents=True)
    for index, (points, _) in enumerate(made.clouds):
        more = [np.full(len(points), 90.0), np.arange(len(points)) % 32, *[points[:, 0]] * (n_more - 1)]
        rows = np.column_stack([points, *more]).astype("<f4")
        rows[: len(rows) // 16 * 16].tofile(folder / "velodyne" / f"{index:06d}.bin")
    write_trajectory(folder / "t.tum", made.stamps_s)
    return folder


def test_scans_of_other_numbers_a_point_are_read_with_a_ring_and_refused_otherwise(tmp_path: Path) -> None:
    assert worst_m(write_bins(tmp_path / "nuscenes", STANDING, 1)) < 1e-4
    assert re.search(
        r"\d+% of its intensities are negative.* of another layout", said(write_bins(tmp_path / "x", STANDING, 2))
    )


def test_kitti_as_it_is_distributed(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path / "00", STANDING)
    (folder / "times.txt").unlink()
    whole = [f"2011-09-26 13:02:{25 + time_s:012.9f}" for time_s in STANDING.stamps_s]
    (folder / "velodyne" / "timestamps.txt").write_text("\n".join(whole) + "\n")
    assert worst_m(folder) < 1e-4
    source = open_session(folder)
    np.testing.assert_allclose(np.diff(source.stamps_s), np.diff(STANDING.stamps_s), atol=1e-6)
    never = [*whole[:1], "2011-02-31 13:02:26.0", *whole[2:]]
    (folder / "velodyne" / "timestamps.txt").write_text("\n".join(never) + "\n")
    assert "timestamps.txt:2: 2011-02-31 13:02:26.0: no such date and time" in said(folder)
    (folder / "velodyne" / "timestamps.txt").write_text("\n".join(whole) + "\n")
    tum = write_trajectory(tmp_path / "t.txt", STANDING.stamps_s, "kitti")
    with pytest.warns(InputWarning, match=r"calib.txt: is not applied to a trajectory from elsewhere"):
        assert worst_m(folder, HowToRead(trajectory=tum)) < 1e-4


def test_counters_in_names_are_no_stamps(tmp_path: Path) -> None:
    files = [tmp_path / f"frame_{index:09d}_0.ply" for index in range(3)]
    assert stamps_of_names(files) is None


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


def test_a_pair_and_an_answer_are_told_from_a_session(tmp_path: Path) -> None:
    for name in ("before", "after"):
        (tmp_path / "pair" / name).mkdir(parents=True)
    assert said(tmp_path / "pair").endswith(f"no session: name {tmp_path}/pair/before and {tmp_path}/pair/after")
    (tmp_path / "answer").mkdir()
    for name in ("answer.json", "objects.csv", "objects.ply", "regions.csv", "surface.ply"):
        (tmp_path / "answer" / name).write_text("")
    assert said(tmp_path / "answer").endswith("an answer, no session: name the session that it was made from")
    # an answer that was saved beside scans, or into a session
    (tmp_path / "answer" / "000000.ply").write_text("")
    assert guess_format(tmp_path / "answer") == "ply"
    assert [each.name for each in find_scans(tmp_path / "answer", "ply")] == ["000000.ply"]
    (tmp_path / "answer" / "session.json").write_text("{}")
    assert guess_format(tmp_path / "answer") == "session"


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


@pytest.mark.skipif(sys.platform == "win32", reason="there are no pipes in folders")
@pytest.mark.parametrize(("write", "name"), [(write_pcds, "pcd"), (write_lases, "las")])
def test_a_pipe_in_the_place_of_a_scan_is_not_waited_for(write: Callable[..., Path], name: str, tmp_path: Path) -> None:
    folder = write(tmp_path / "run", MADE)
    scan = sorted(path for path in folder.iterdir() if path.suffix in (".pcd", ".las", ".laz"))[1]
    scan.unlink()
    os.mkfifo(scan)
    write_trajectory(tmp_path / "poses.txt", MADE.stamps_s)
    assert "it is a device or a pipe" in said(folder, HowToRead(format=name, trajectory=tmp_path / "poses.txt"))


@pytest.mark.parametrize("year", [2010, 2023])
def test_a_real_las_of_another_program_reads_as_with_laspy(year: int) -> None:
    if "TUNNELCD_REAL_DATA" not in os.environ:
        pytest.skip("TUNNELCD_REAL_DATA is unset: real scans are not at hand")
    laspy = pytest.importorskip("laspy")
    path = Path(os.environ["TUNNELCD_REAL_DATA"]) / "two_epochs" / f"autzen-bmx-{year}.las"
    theirs = laspy.read(path)
    cloud = cloud_reader("las", path.parent)(path)
    assert len(cloud.points) > 600
    np.testing.assert_array_equal(cloud.points, theirs.xyz)
    np.testing.assert_array_equal(cloud.intensity, theirs.intensity)


def test_a_format_that_the_content_contradicts_is_refused(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "a.mcap", MADE)
    for name in ("pcd", "las", "kitti", "osf"):
        with pytest.raises(
            InputError, match=rf"a\.mcap: --format {name}: begins as a ROS 1 bag, .* leave --format out$"
        ):
            guess_format(bag, name)
    assert guess_format(bag, "bag") == "bag"
    plain = tmp_path / "a.bin"
    plain.write_bytes(bytes(64))
    assert guess_format(plain, "las") == "las"  # nothing in it says otherwise
