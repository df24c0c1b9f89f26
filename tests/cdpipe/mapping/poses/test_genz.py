"""GenZ-ICP: the way through a room, the same bytes whatever the process registered before, and one line without it."""

import importlib.util
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import stream
from cdpipe.io.foreign.opening import HowToRead, open_recording
from cdpipe.mapping.poses.odometry import estimate_cloud_motion

STEP_M = np.array([0.2, 0.05, 0.0])
N_SCANS = 6


def clouds() -> Iterator[tuple[np.ndarray, None]]:
    """Yield what a sensor sees that moves by `STEP_M` a scan through a room of 12 x 8 x 4 m."""
    half = np.array([6.0, 4.0, 2.0])
    for number in range(N_SCANS):
        draw = stream(number, "genz")
        points = draw.uniform(-half, half, (6000, 3))
        axis = draw.integers(0, 3, len(points))
        points[np.arange(len(points)), axis] = half[axis] * draw.choice((-1.0, 1.0), len(points))
        yield points - number * STEP_M, None


def test_the_way_through_a_room_is_found_and_is_the_same_twice() -> None:
    pytest.importorskip("genz_icp", reason="pip install 'tunnelcd[genz]'")
    stamps_s = 0.1 * np.arange(N_SCANS)
    first, again = (estimate_cloud_motion(clouds(), stamps_s, "genz-icp") for _ in range(2))
    np.testing.assert_allclose(first[:, :3, 3], np.arange(N_SCANS)[:, None] * STEP_M, atol=0.03)
    assert first.tobytes() == again.tobytes()
    assert not np.array_equal(first, estimate_cloud_motion(clouds(), stamps_s, "kiss-icp"))


def test_without_the_package_one_line_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr("cdpipe.core.plugins.find_spec", lambda name: None if name == "genz_icp" else found(name))
    for number in range(2):
        np.zeros((64, 4), dtype="<f4").tofile(tmp_path / f"{number:06d}.bin")
    with pytest.raises(InputError, match=r"--odometry genz-icp needs .* pip install 'tunnelcd\[genz\]'"):
        open_recording(tmp_path, HowToRead(odometry="genz-icp"), lambda stage, done, total: None)
    with pytest.raises(InputError, match="--odometry lio: expected kiss-icp or genz-icp"):
        HowToRead(odometry="lio")


def _die(document: Any) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_death_of_its_process_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cdpipe.mapping.poses.genz.register_stored", _die)
    with pytest.raises(InputError, match=r"^the process of GenZ-ICP died \(signal 9\) before 3 scans [^\n]*$"):
        estimate_cloud_motion(((np.ones((4, 3)), None) for _ in range(3)), np.arange(3.0), "genz-icp")
