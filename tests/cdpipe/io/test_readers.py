from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pytest

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.geometry import yaw_pose
from cdpipe.io.readers import open_session
from cdpipe.io.session import ScanChunk, Session, SessionWriter
from cdpipe.sensor.ouster import load_profile


def write_scan(path: Path, points: np.ndarray) -> None:
    meshio.ply.write(path, meshio.Mesh(points, []))


def recording(folder: Path, n_scans: int = 3, trajectory: str | None = None) -> Path:
    folder.mkdir()
    for index in range(n_scans):
        write_scan(folder / f"scan_{index:03d}.ply", np.arange(6.0).reshape(2, 3) + index)
    lines = [f"{100 + index / 10} {index} 0 0.5 0 0 0 1" for index in range(n_scans)]
    (folder / "trajectory.txt").write_text(trajectory if trajectory is not None else "\n".join(lines) + "\n")
    return folder


def session(path: Path, n_scans: int = 5, column_pose: tuple[float, ...] = (0, 0, 0, 0, 0, 0, 1)) -> Path:
    sensor = load_profile("os1-32-u0", "512x10")
    shape = (2, sensor.height, sensor.width)
    with SessionWriter(path, sensor, chunk_scans=2, provenance={}) as writer:
        for start in range(0, n_scans, 2):
            n = min(2, n_scans - start)
            ranges = np.full(shape, 4000, dtype=np.uint32)[:n]
            ranges[:, 0, 0] = np.arange(start, start + n) + 5000
            columns = np.tile(np.array(column_pose, dtype=np.float32), (n, sensor.width, 1))
            writer.add(
                ScanChunk(
                    ranges,
                    np.zeros(shape, np.uint8)[:n],
                    np.zeros(shape, np.uint16)[:n],
                    np.zeros((n, sensor.width), np.int64),
                    columns,
                )
            )
        writer.close(np.array([yaw_pose(0.1 * index, (index, 0, 0)) for index in range(n_scans)]))
    return path


def said(path: Path, read: bool = False) -> str:
    with pytest.raises(InputError) as caught:
        source = open_session(path)
        if read:
            list(source.scans())
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_ply_scans_with_a_trajectory(tmp_path: Path) -> None:
    text = "# stamp tx ty tz qx qy qz qw\n100.0 0 0 0 0 0 0 1\n\n100.5 1 2 3 0 0 0.70710678 0.70710678\n"
    source = open_session(recording(tmp_path / "run", 2, text))
    np.testing.assert_allclose(source.odom_T_sensor[1], yaw_pose(np.pi / 2, (1, 2, 3)), atol=1e-8)
    first, second = source.scans()
    np.testing.assert_array_equal(second.points_sensor, first.points_sensor + 1)
    np.testing.assert_array_equal(second.pixels, [0, 1])
    np.testing.assert_array_equal(second.stamps_ns, [500_000_000, 500_000_000])


def test_unpadded_numbers_would_pair_scans_with_wrong_poses(tmp_path: Path) -> None:
    folder = recording(tmp_path / "run", 3)
    (folder / "scan_000.ply").rename(folder / "scan_10.ply")
    (folder / "scan_001.ply").rename(folder / "scan_9.ply")
    assert "pad the numbers to equal length" in said(folder)


def test_each_chunk_is_read_once_when_read_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = open_session(session(tmp_path / "session"))
    reads: list[int] = []
    original = Session.chunk

    def counted(self: Session, index: int) -> ScanChunk:
        reads.append(index)
        return original(self, index)

    monkeypatch.setattr(Session, "chunk", counted)
    firsts = [np.linalg.norm(scan.points_sensor[0]) for scan in source.scans()]
    assert reads == [0, 1, 2]
    np.testing.assert_allclose(np.diff(firsts), 1e-3, atol=1e-5)
    assert source.scan(1).index == 1


def test_missing_folder_and_folder_without_scans(tmp_path: Path) -> None:
    assert "nowhere: " in said(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    assert "session.json" in said(tmp_path / "empty")


def test_counts_of_scans_and_poses_must_match(tmp_path: Path) -> None:
    folder = recording(tmp_path / "run", 3)
    (folder / "scan_002.ply").unlink()
    assert "trajectory.txt: 3 poses for 2 *.ply scans" in said(folder)


def test_no_trajectory_and_two_of_them(tmp_path: Path) -> None:
    folder = recording(tmp_path / "run")
    (folder / "other.tum").write_text("")
    assert "exactly one trajectory" in said(folder)
    assert "found other.tum, trajectory.txt" in said(folder)
    for name in ("other.tum", "trajectory.txt"):
        (folder / name).unlink()
    assert "found none" in said(folder)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("1 nan 0 0 0 0 0 1", "trajectory.txt:2: the pose"),
        ("nan 0 0 0 0 0 0 1", "trajectory.txt:2: the stamp"),
        ("1 0 0 0 0 0 0 2", "trajectory.txt:2: the quaternion's length is 2"),
        ("1 0 0 0 0 0 0", "trajectory.txt:2: 7 fields"),
        ("1 0 0 zero 0 0 0 1", "trajectory.txt:2: "),
    ],
)
def test_a_bad_line_of_the_trajectory_is_named(tmp_path: Path, line: str, expected: str) -> None:
    assert expected in said(recording(tmp_path / "run", 2, f"0 0 0 0 0 0 0 1\n{line}\n"))


@pytest.mark.parametrize("missing", [(0.0, 0.0, 0.0), (0.0, -0.0, 0.0), (np.nan, np.nan, np.nan)])
def test_missing_returns_of_organised_clouds_are_dropped_and_said(tmp_path: Path, missing: tuple[float, ...]) -> None:
    folder = recording(tmp_path / "run")
    write_scan(folder / "scan_001.ply", np.array([missing, (1.0, 2.0, 3.0), missing, (0.0, 0.0, 4.0)]))
    source = open_session(folder)
    with pytest.warns(InputWarning) as caught:
        _, scan, _ = source.scans()
    told = f"{folder}: 2 of 8 points are (0, 0, 0) or not finite: taken for missing returns and left out"
    assert [str(each.message) for each in caught] == [told]
    np.testing.assert_array_equal(scan.points_sensor, [(1, 2, 3), (0, 0, 4)])
    # a return is named by the row of its file
    np.testing.assert_array_equal(scan.pixels, [1, 3])
    assert len(scan.stamps_ns) == 2
    np.testing.assert_array_equal(source.scan(1).pixels, [1, 3])
    write_scan(folder / "scan_001.ply", np.array([missing, missing]))
    assert "scan_001.ply: holds no return" in said(folder, read=True)
    # a point that lacks one coordinate is no missing return
    write_scan(folder / "scan_001.ply", np.array([missing, (1.0, np.nan, 3.0)]))
    assert "scan_001.ply: vertex 1 is not finite (1 are not)" in said(folder, read=True)


def test_bad_scans_are_named(tmp_path: Path) -> None:
    folder = recording(tmp_path / "run")
    bad = folder / "scan_001.ply"
    write_scan(bad, np.array([[0.0, 1, 2], [np.nan, 1, 2], [np.inf, 1, 2]]))
    assert "scan_001.ply: vertex 1 " in said(folder, read=True)
    write_scan(bad, np.zeros((0, 3)))
    assert "scan_001.ply: " in said(folder, read=True)
    bad.write_text("not a scan")
    assert "scan_001.ply: " in said(folder, read=True)


def test_bad_sessions_are_named(tmp_path: Path) -> None:
    nan = session(tmp_path / "nan", column_pose=(np.nan, 0, 0, 0, 0, 0, 1))
    assert "00000.npz: scan 0, column 0: the pose" in said(nan, read=True)
    zero = session(tmp_path / "zero", column_pose=(0, 0, 0, 0, 0, 0, 0))
    assert "00000.npz: scan 0, column 0: the quaternion" in said(zero, read=True)
    dark = session(tmp_path / "dark")
    chunk = dict(np.load(dark / "chunks" / "00001.npz"))
    chunk["range_mm"][1] = 0
    np.savez(dark / "chunks" / "00001.npz", **chunk)
    assert "00001.npz: scan 3 " in said(dark, read=True)


def test_a_scan_recorded_twice_is_named(tmp_path: Path) -> None:
    folder = recording(tmp_path / "run")
    (folder / "scan_002.ply").write_bytes((folder / "scan_000.ply").read_bytes())
    expected = "scan_002.ply repeats scan_000.ply: the same returns to the last bit, recorded twice: remove one"
    assert expected in said(folder, read=True)
    twice = session(tmp_path / "twice")
    chunk = dict(np.load(twice / "chunks" / "00001.npz"))
    chunk["range_mm"][0] = np.load(twice / "chunks" / "00000.npz")["range_mm"][1]
    np.savez(twice / "chunks" / "00001.npz", **chunk)
    assert "00001.npz: scan 2 repeats scan 1" in said(twice, read=True)


def test_standing_still_without_noise_is_no_repetition(tmp_path: Path) -> None:
    standing = "\n".join(f"{stamp} 0 0 0 0 0 0 1" for stamp in (0.0, 0.1)) + "\n0.2 0.05 0 0 0 0 0 1"
    folder = recording(tmp_path / "run", trajectory=standing)
    for index in (1, 2):
        (folder / f"scan_00{index}.ply").write_bytes((folder / "scan_000.ply").read_bytes())
    assert len(list(open_session(folder).scans())) == 3
    # at the same time it is the same scan
    (folder / "trajectory.txt").write_text("\n".join(["0 0 0 0 0 0 0 1"] * 3))
    assert "scan_001.ply repeats scan_000.ply" in said(folder, read=True)
