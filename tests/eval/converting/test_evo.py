"""evo reads the trajectories that `convert` writes, in an environment of its own (`make test-evo`)."""

from __future__ import annotations

import json
import os
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cdpipe.io.session import read_session
from scenarios import load_scenario
from sim.session.truth import read_true_poses

EVO = os.environ.get("TUNNELCD_EVO", "")
pytestmark = pytest.mark.skipif(not EVO, reason="TUNNELCD_EVO names no folder with evo's commands: make test-evo")
Run = Callable[..., Path]


@pytest.fixture(scope="module")
def session(simulated_once: Callable[..., Path]) -> Path:
    drift = ("before.odometry.translation_percent=1.0", "before.odometry.yaw_deg_per_100m=5.0")
    small = ("sensor.mode=512x10", "platform.scan_spacing_m=0.9", *drift)
    return simulated_once(load_scenario("smoke/one_box", 5, small), 5) / "before"


@pytest.fixture(name="run_evo")
def run_evo_fixture(tmp_path: Path) -> Run:
    def run(program: str, *arguments: object) -> Path:
        """Run one of evo's commands in a folder of its own, which is returned; it may write no settings elsewhere."""
        environment = {"HOME": str(tmp_path), "PATH": os.environ["PATH"], "MPLBACKEND": "Agg"}
        command = [str(Path(EVO).resolve() / program), *map(str, arguments), "--no_warnings"]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return tmp_path

    return run


@pytest.mark.parametrize(("kind", "program"), [("tum", "evo_ape"), ("kitti", "evo_ape"), ("kitti", "evo_rpe")])
def test_evo_computes_the_drift_that_the_poses_have(
    kind: str, program: str, session: Path, tmp_path: Path, command: Callable[..., tuple[int, str, str]], run_evo: Run
) -> None:
    assert command("convert", session, tmp_path / f"a.{kind}", "--with-truth")[0] == 0
    run_evo(program, kind, f"a.true.{kind}", f"a.{kind}", "--save_results", "found.zip")
    with zipfile.ZipFile(tmp_path / "found.zip") as found:
        said = json.loads(found.read("stats.json"))
    true, own = read_true_poses(session), read_session(session).odom_T_sensor
    if program == "evo_rpe":  # from one pose to the next
        true, own = (np.linalg.inv(poses[:-1]) @ poses[1:] for poses in (true, own))
        error = (np.linalg.inv(true) @ own)[:, :3, 3]
    else:
        error = own[:, :3, 3] - true[:, :3, 3]
    lengths_m = np.linalg.norm(error, axis=1)
    assert lengths_m.max() > 1e-3  # the poses do drift
    expected = {"rmse": np.sqrt((lengths_m**2).mean()), "max": lengths_m.max(), "mean": lengths_m.mean()}
    assert {name: said[name] for name in expected} == pytest.approx(expected, abs=1e-5)
