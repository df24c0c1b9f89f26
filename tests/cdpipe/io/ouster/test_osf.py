"""Sessions leave as what the vendor's SDK opens."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import make_pose
from cdpipe.io.ouster.osf import sensor_info, write_osf
from cdpipe.io.ouster.recording import import_recording
from cdpipe.io.session import Session, chunk_path, read_session
from tests.cdpipe.recordings import (
    SENSOR,
    START_NS,
    frames,
    info_of,
    left,
    on_a_small_disk,
    osf,
    our_points,
    said,
    vendor_points,
    write_frames,
)


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
            np.testing.assert_array_equal(frame.packet_timestamp, frame.timestamp[:: info.format.columns_per_packet])
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
    assert "field LABEL is (64, 32, 4)" in said(lambda: write_osf(session, tmp_path / "out.osf", short))
    odd = replace(session, sensor=replace(SENSOR, mode="64x10"))
    assert "the vendor's SDK does not take its sensor" in said(lambda: write_osf(odd, tmp_path / "out.osf"))
    assert left(tmp_path) == []


@pytest.mark.parametrize("n_bytes", [0, 1000, 3_000_000])
def test_a_full_disk_is_one_line_and_leaves_nothing(session: Session, tmp_path: Path, n_bytes: int) -> None:
    """The SDK's writer writes once more as it is destroyed: into nothing, and without ending the process."""
    call = "write_osf(read_session(Path(sys.argv[1])), Path(sys.argv[2]))"
    code, told, more = on_a_small_disk(call, n_bytes, session.path, tmp_path / "out.osf")
    assert (code, more, told.count("\n")) == (0, "", 1)
    assert told.startswith(f"{tmp_path / 'out.osf'}: cannot be written")
    assert told.endswith("give it a disk with room and a folder you may write to\n")
    assert left(tmp_path) == []


def test_the_sdk_logs_nothing_beside_our_line(
    session: Session, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(RuntimeError):
        osf.Writer(str(tmp_path / "none" / "out.osf"), sensor_info(session))
    assert capfd.readouterr() == ("", "")

    def read_only(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "mkdir", read_only)
    assert "Read-only file system" in said(lambda: write_osf(session, tmp_path / "out.osf"))


def test_stamps_that_do_not_rise_are_named(session: Session, tmp_path: Path) -> None:
    shutil.copytree(session.path, tmp_path / "s")
    path = chunk_path(tmp_path / "s", 1)
    arrays = dict(np.load(path))
    arrays["column_stamps_ns"][2] = arrays["column_stamps_ns"][0]
    np.savez(path, **arrays)
    told = said(lambda: write_osf(read_session(tmp_path / "s"), tmp_path / "out.osf"))
    assert f"{tmp_path / 's'}: revolution 66 does not come after the one before it" in told
    assert left(tmp_path) == ["s"]
