from __future__ import annotations

import importlib.util
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, make_pose
from cdpipe.core.geometry.motion import make_motion
from scenarios.schema import GAITS, Odometry
from sim.drive.odometry import walk_motion
from sim.studies.drift import (
    ROLLOUTS,
    estimate_poses,
    fit_walk,
    main,
    measure_gait,
    read_rollouts,
    relative_errors,
    tabulate_errors,
)

needs_real_data = pytest.mark.skipif(
    "TUNNELCD_REAL_DATA" not in os.environ, reason="real rollouts: TUNNELCD_REAL_DATA is not set"
)


def straight_poses(n_scans: int, step_m: float = 0.5) -> Float64Array:
    turns = Rotation.from_euler("z", np.full((n_scans, 1), 0.7)).as_matrix()
    way_m = step_m * np.arange(n_scans)[:, None]
    return make_pose(turns, way_m * [np.cos(0.7), np.sin(0.7), 0.0] + [4.0, 5.0, 6.0])


def test_relative_errors_by_hand() -> None:
    true = straight_poses(100)
    # 1 % too long, and one degree of yaw at the last pose alone
    estimated = straight_poses(100, 0.505)
    estimated[-1, :3, :3] = Rotation.from_euler("z", 1.0, degrees=True).as_matrix() @ estimated[-1, :3, :3]
    errors = relative_errors(true, estimated, 20.0)
    assert len(errors) == 60
    np.testing.assert_allclose(errors[:, :3], np.tile([0.2, 0.0, 0.0], (60, 1)), atol=1e-9)
    np.testing.assert_allclose(errors[:-1, 3:], 0.0, atol=1e-9)
    np.testing.assert_allclose(errors[-1, 3:], (1.0, 0.0, 0.0), atol=1e-9)
    assert len(relative_errors(true, estimated, 0.0)) == 99
    assert np.isnan(tabulate_errors([(true, estimated)])[-1]).all()  # no 100 m in 49.5 m


def test_a_fit_finds_the_figures_of_a_random_walk() -> None:
    figures = {
        "scale_percent": 0.8,
        "scale_length_m": 15.0,
        "yaw_deg_per_m": 0.02,
        "yaw_length_m": 10.0,
        "tilt_deg": 0.6,
        "tilt_length_m": 30.0,
        "jitter_along_m": 0.02,
        "jitter_across_m": 0.02,
        "jitter_yaw_deg": 0.05,
        "jitter_roll_deg": 0.2,
        "jitter_pitch_deg": 0.1,
    }
    way_m = np.arange(0.0, 301.0, 0.5)
    level = Rotation.from_euler("z", np.zeros((len(way_m), 1)))
    true = make_motion(way_m, way_m, way_m[:, None] * [1.0, 0.0, 0.0], level)
    odometry = Odometry.model_validate({"source": "random-walk", **figures})
    middle_s = way_m[1:-1]
    drawn = [walk_motion(true, middle_s, np.array([-0.05, 0.05]), odometry, seed, "before") for seed in range(30)]
    found = fit_walk(tabulate_errors([(true.poses(middle_s), one.poses(middle_s)) for one in drawn]), 0.5)
    assert found.keys() == figures.keys()
    # a length is known less well than a spread: 9 km hold some 600 of them
    ratios = {key: found[key] / value for key, value in figures.items()}
    assert all(0.6 < ratios[key] < 1.6 for key in figures if key.endswith("length_m")), ratios
    assert all(0.85 < ratios[key] < 1.15 for key in figures if not key.endswith("length_m")), ratios


def test_nothing_is_fitted_where_nothing_drifts() -> None:
    true = straight_poses(300)
    assert all(
        value == pytest.approx(0.0, abs=1e-6)
        for key, value in fit_walk(tabulate_errors([(true, true)]), 0.5).items()
        if not key.endswith("length_m")
    )


def test_a_gait_is_measured_from_the_poses_of_a_walk() -> None:
    time_s = np.arange(0.0, 60.0, 0.1)
    step, stride = 2 * np.pi * 1.5 * time_s, 2 * np.pi * 0.75 * time_s
    points = np.column_stack([1.1 * time_s, 0.03 * np.sin(stride), 0.04 * np.sin(step)])
    angles = np.column_stack([0.7 * np.sin(stride), 0.6 * np.sin(step), 0.5 * np.cos(stride)])
    found = measure_gait(make_pose(Rotation.from_euler("ZYX", angles, degrees=True).as_matrix(), points))
    assert found["step_hz"] == pytest.approx(1.5, abs=0.1)
    expected = {"bob_m": 0.04, "sway_m": 0.03, "pitch_deg": 0.6, "roll_deg": 0.5, "yaw_deg": 0.7}
    assert {key: found[key] for key in expected} == pytest.approx(expected, rel=0.1)


def test_a_command_without_words_tells_its_usage() -> None:
    with pytest.raises(SystemExit, match=r"sim.studies.drift kiss narrow:10001"):
        main([])


def test_rollouts_are_reported_level_by_level(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "hall" / "sequence_1"
    folder.mkdir(parents=True)
    for name, step_m in (
        ("none", 0.5),
        ("light_1", 0.505),
        ("moderate_1", 0.51),
        ("strong_1", 0.52),
        ("severe_1", 0.55),
    ):
        poses = straight_poses(300, step_m)
        quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        np.savetxt(folder / f"{name}.csv", np.column_stack([poses[:, :3, 3], quaternions]), delimiter=", ")
    main(["rollouts", str(tmp_path)])
    told = capsys.readouterr().out
    assert [line.split(":")[0] for line in told.splitlines() if "sessions" in line] == list(ROLLOUTS)
    # 1, 2, 4 and 10 % of 100 m
    assert [line.split()[1] for line in told.splitlines() if line.lstrip().startswith("100 ")] == [
        "1.0000",
        "2.0000",
        "4.0000",
        "10.0000",
    ]


@pytest.mark.skipif(importlib.util.find_spec("kiss_icp") is None, reason="needs the extra `odometry`: KISS-ICP")
def test_kiss_icp_is_measured_on_both_sessions_of_a_pair() -> None:
    sessions = estimate_poses("smoke/one_box", 3, ["platform.scan_spacing_m=1.5", "sensor.mode=512x10"])
    assert len(sessions) == 2
    for true, found in sessions:
        assert true.shape == found.shape
        errors = relative_errors(true, found, 0.0)
        assert 1e-3 < np.sqrt((errors[:, :3] ** 2).mean()) < 0.2


@needs_real_data
def test_the_gait_of_a_hand_and_the_drift_of_its_family_are_those_of_real_walks() -> None:
    folder = Path(os.environ["TUNNELCD_REAL_DATA"]) / "odometry_rollouts"
    rollouts = read_rollouts(folder)
    assert [len(rollouts[level]) for level in ROLLOUTS] == [6, 6, 3, 3]
    strong = fit_walk(tabulate_errors(rollouts["strong"]), 0.32)
    assert strong["scale_percent"] == pytest.approx(0.75, rel=0.05)
    assert strong["scale_length_m"] == pytest.approx(6.7, rel=0.05)
    assert strong["jitter_along_m"] < 1e-3
    walks = [truth for truth, _ in rollouts["severe"]][:2]  # the third has too many gaps
    gaits = [measure_gait(walk) for walk in walks]
    for key, value in GAITS["handheld"].items():
        assert min(gait[key] for gait in gaits) * 0.85 < value < max(gait[key] for gait in gaits) * 1.15, key


@pytest.mark.parametrize("text", ["1,2\n", "x,y\n", "1,2,3,0,0,0,0\n"])
def test_rollouts_that_are_none_are_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "none.csv").write_text(text)
    with pytest.raises(InputError, match=r"none\.csv: .*: expected lines of x, y, z and a quaternion"):
        main(["walk", str(tmp_path)])
