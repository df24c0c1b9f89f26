"""A tiny pair of sessions with truth, written through the real writers: scoring needs no simulation."""

import importlib
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.geometry import invert, make_pose, yaw_pose
from cdpipe.io.session import ScanChunk, SessionWriter
from cdpipe.sensor.ouster import SensorMetadata
from eval.cli.main import main
from sim.session.truth import PairTruth, write_labels, write_pair_truth, write_true_poses
from tests.eval.changes import change

N_SCANS, CHUNK_SCANS, HEIGHT, WIDTH = 14, 5, 4, 64
WALL_MM, THING_MM = 4000, 2500
ODOM_T_WORLD = {"before": yaw_pose(0.6, (2.0, -1.0, 0.3)), "after": yaw_pose(-2.0, (-4.0, 7.0, 0.0))}

SENSOR = SensorMetadata(
    product="test",
    serial="0",
    mode=f"{WIDTH}x10",
    altitude_deg=np.array([24.0, 8.0, -8.0, -24.0]),
    azimuth_deg=np.zeros(HEIGHT),
    beam_origin_m=0.0,
    sensor_T_lidar=np.eye(4),
    pixel_shift=(0,) * HEIGHT,
)

# change -> session, kind, partner, columns it is seen in, scans it is seen in
THINGS = {
    1: ("after", "added", None, slice(4, 14), range(2, 5)),
    2: ("before", "moved", 3, slice(30, 40), range(8, 12)),
    3: ("after", "moved", 2, slice(44, 54), range(9, 13)),
}


def true_poses() -> np.ndarray:
    return np.stack([make_pose(translation=(1.5 * i, 0.0, 1.0)) for i in range(N_SCANS)])


def write_session(path: Path, name: str, *, has_changes: bool, stretch: float) -> None:
    """Walls 4 m away on every side of each scan, things 2.5 m away; one pixel of each scan is a miss."""
    shape = (N_SCANS, HEIGHT, WIDTH)
    range_mm = np.full(shape, WALL_MM, dtype=np.uint32)
    labels = np.zeros(shape, dtype=np.int16)
    for number, (session, _, _, columns, scans) in THINGS.items():
        if has_changes and session == name:
            range_mm[scans.start : scans.stop, 1:3, columns] = THING_MM
            labels[scans.start : scans.stop, 1:3, columns] = number
    range_mm[:, 0, 0] = 0
    range_mm[:, 0, 1] += np.arange(N_SCANS, dtype=np.uint32)  # no two scans of a sensor are the same
    identity = np.tile(np.array([0, 0, 0, 0, 0, 0, 1], dtype=np.float32), (N_SCANS, WIDTH, 1))
    stamps = np.zeros((N_SCANS, WIDTH), dtype=np.int64)
    with SessionWriter(path, SENSOR, CHUNK_SCANS, {}) as writer:
        for index, first in enumerate(range(0, N_SCANS, CHUNK_SCANS)):
            part = slice(first, first + CHUNK_SCANS)
            zeros = np.zeros_like(range_mm[part], dtype=np.uint8)
            writer.add(ScanChunk(range_mm[part], zeros, zeros.astype(np.uint16), stamps[part], identity[part]))
            instance = np.where(range_mm[part] == 0, -1, labels[part]).astype(np.int16)
            write_labels(writer.folder, index, instance, labels[part])
        write_true_poses(writer.folder, true_poses())
        believed = true_poses()
        believed[:, 0, 3] *= stretch
        writer.close(ODOM_T_WORLD[name] @ believed)


def write_pair(pair: Path, *, has_changes: bool = True, stretch: float = 1.0) -> Path:
    """Write a pair with an added and a moved thing, or one without changes; odometry stretches the way."""
    pair.mkdir()
    changes = [
        change(number, session, kind, partner=partner) for number, (session, kind, partner, _, _) in THINGS.items()
    ]
    for name in ("before", "after"):
        write_session(pair / name, name, has_changes=has_changes, stretch=stretch)
    write_pair_truth(pair, PairTruth("test", 7, 3.0, tuple(changes) if has_changes else (), {}))
    return pair


@pytest.fixture(scope="session", autouse=True)
def stages_are_called_once(request: pytest.FixtureRequest) -> None:
    """Let no run repeat a stage for the clock, if a collected test imports the stages: that takes seconds by itself."""
    if "eval.running.stages.pair_stages" in sys.modules:
        request.getfixturevalue("usual_repeat_below_s")


@pytest.fixture(scope="session")
def training_data(tmp_path_factory: pytest.TempPathFactory, shards_once: Callable[..., list[bytes]]) -> Path:
    """Training data of two tunnels, one of each split. Tests read it only."""
    dataset_run = importlib.import_module("eval.training.dataset_run")  # needs torch
    folder = tmp_path_factory.mktemp("training") / "data"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset_run, "make_shards", shards_once)
        for seeds in ("3:4", "10003:10004"):
            dataset_run.make_dataset(["smoke/one_box"], seeds, dataset_run.Recipe(draws=2), folder, command="test")
    return folder


@pytest.fixture(name="write_tiny_pair")
def write_tiny_pair_fixture(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes the tiny pair."""
    return lambda **options: write_pair(tmp_path / "pair", **options)


@pytest.fixture(name="tiny_pair")
def tiny_pair_fixture(tmp_path: Path) -> Path:
    """Return the folder of the tiny pair; its odometry does not drift."""
    return write_pair(tmp_path / "pair")


@pytest.fixture(scope="module", name="lasting_pair")
def lasting_pair_fixture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a tiny pair that all tests of a module share."""
    return write_pair(tmp_path_factory.mktemp("lasting") / "pair")


@pytest.fixture(name="tiny_merge")
def tiny_merge_fixture() -> np.ndarray:
    """Return the true before_T_after of the tiny pair."""
    return ODOM_T_WORLD["before"] @ invert(ODOM_T_WORLD["after"])


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Run the command line; returns exit code, standard output and standard error."""

    def call(*argv: str | Path) -> tuple[int, str, str]:
        capsys.readouterr()
        with pytest.raises(SystemExit) as caught:
            main([str(word) for word in argv])
        out, err = capsys.readouterr()
        return int(caught.value.code or 0), out, err

    return call
