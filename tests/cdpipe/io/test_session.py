import errno
import json
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import make_pose
from cdpipe.io.session import ScanChunk, SessionWriter, chunk_path, read_session
from cdpipe.sensor.ouster import SensorMetadata, parse_metadata


def _sensor() -> SensorMetadata:
    return parse_metadata(
        {"beam_altitude_angles": [5.0, 0.0, -5.0], "beam_azimuth_angles": [1.0, 1.0, 1.0], "lidar_mode": "8x10"}, "test"
    )


def _chunk(n_scans: int, seed: int) -> ScanChunk:
    draw = np.random.default_rng(seed)
    return ScanChunk(
        range_mm=draw.integers(0, 9000, size=(n_scans, 3, 8)).astype(np.uint32),
        reflectivity=draw.integers(0, 255, size=(n_scans, 3, 8)).astype(np.uint8),
        signal=draw.integers(0, 4000, size=(n_scans, 3, 8)).astype(np.uint16),
        column_stamps_ns=np.arange(n_scans * 8).reshape(n_scans, 8),
        column_poses=np.tile(np.array([0, 0, 0, 0, 0, 0, 1], dtype=np.float32), (n_scans, 8, 1)),
    )


def _written(path: Path, n_scans: int = 5) -> Path:
    poses = np.stack([make_pose(translation=(k, 0, 0)) for k in range(n_scans)])
    with SessionWriter(path, _sensor(), 2, {"made": "by test"}) as writer:
        for start in range(0, n_scans, 2):
            writer.add(_chunk(min(2, n_scans - start), start))
        writer.close(poses)
    return path


def test_what_was_written_is_read(tmp_path: Path) -> None:
    session = read_session(_written(tmp_path / "s"))
    assert (session.n_scans, session.n_chunks, session.provenance) == (5, 3, {"made": "by test"})
    for index, chunk in enumerate(session.chunks()):
        np.testing.assert_array_equal(chunk.range_mm, _chunk(len(chunk.range_mm), 2 * index).range_mm)
    np.testing.assert_array_equal(session.sensor.altitude_deg, [5, 0, -5])
    np.testing.assert_array_equal(session.odom_T_sensor[3, :3, 3], [3, 0, 0])


def test_an_interrupted_session_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), SessionWriter(tmp_path / "s", _sensor(), 2, {}) as writer:
        writer.add(_chunk(2, 0))
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_not_overwritten(tmp_path: Path) -> None:
    _written(tmp_path / "s")
    with pytest.raises(InputError, match="exists already"):
        _written(tmp_path / "s")


def test_damage_is_named(tmp_path: Path) -> None:
    path = _written(tmp_path / "s")
    chunk = chunk_path(path, 1)
    chunk.write_bytes(chunk.read_bytes()[:100])
    with pytest.raises(InputError, match=r"00001\.npz: unreadable"):
        list(read_session(path).chunks())
    chunk.unlink()
    with pytest.raises(InputError, match=r"00001\.npz: missing"):
        list(read_session(path).chunks())


def test_counts_and_poses_are_checked(tmp_path: Path) -> None:
    path = _written(tmp_path / "s")
    poses = read_session(path).odom_T_sensor.copy()
    np.savez(path / "odometry.npz", odom_T_sensor=poses[:4])
    with pytest.raises(InputError, match="4 poses for 5 scans"):
        read_session(path)
    poses[2, 0, 3] = np.nan
    np.savez(path / "odometry.npz", odom_T_sensor=poses)
    with pytest.raises(InputError, match=r"odom_T_sensor\[2\]"):
        read_session(path)


def test_other_folders_and_versions_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such session folder"):
        read_session(tmp_path / "none")
    with pytest.raises(InputError, match=r"no session\.json"):
        read_session(tmp_path)
    path = _written(tmp_path / "s")
    document = json.loads((path / "session.json").read_text())
    (path / "session.json").write_text(json.dumps({**document, "format_version": 99}))
    with pytest.raises(InputError, match="tunnelcd-session 99: this version reads"):
        read_session(path)


@pytest.mark.parametrize(
    "change",
    [
        {"n_scans": "many"},
        {"n_scans": float("inf")},
        {"chunk_scans": 0},
        {"sensor": None},
        {"provenance": None},
        {"provenance": ["x"]},
        {"provenance": {"sensor_clock_start_ns": "x"}},
        {"provenance": {"sensor_clock_start_ns": None}},
        {"provenance": {"sensor_clock_start_ns": -1}},
        {"provenance": {"sensor_clock_start_ns": 10**30}},
    ],
)
def test_a_damaged_description_is_named(tmp_path: Path, change: dict[str, object]) -> None:
    path = _written(tmp_path / "s")
    document = json.loads((path / "session.json").read_text())
    (path / "session.json").write_text(json.dumps({**document, **change}))
    with pytest.raises(InputError, match=r"session\.json"):
        read_session(path)


def test_what_a_description_lacks_is_named(tmp_path: Path) -> None:
    path = _written(tmp_path / "s")
    document = json.loads((path / "session.json").read_text())
    for key in ("n_scans", "sensor"):
        lacking = {name: value for name, value in document.items() if name != key}
        (path / "session.json").write_text(json.dumps(lacking))
        with pytest.raises(InputError, match=rf"session\.json: {key}: missing.*: expected a session"):
            read_session(path)


@pytest.mark.parametrize("text", [b"", b"\xff\xfe", b"[]", b"[" * 200_000, b'{"format": ' + b"9" * 5000 + b"}"])
def test_a_description_that_is_none_is_named(tmp_path: Path, text: bytes) -> None:
    path = _written(tmp_path / "s")
    (path / "session.json").write_bytes(text)
    with pytest.raises(InputError, match=r"session\.json: damaged"):
        read_session(path)


def test_an_unreadable_description_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = _written(tmp_path / "s")

    def unreadable(*_: object, **__: object) -> str:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "open", unreadable)
    with pytest.raises(InputError, match=r"session\.json: .*Permission denied"):
        read_session(path)


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    path = _written(tmp_path / "s")
    np.savez(path / "odometry.npz", odom_T_sensor=np.array([{"a": 1}] * 5, dtype=object))
    with pytest.raises(InputError, match="unreadable"):
        read_session(path)
