from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, Int64Array, invert, make_pose, stream, transform, yaw_pose
from eval.studies.wall_thickness import main, measure_thickness_m


def drive(n_scans: int = 30) -> tuple[Float64Array, Int64Array, Float64Array]:
    """Returns of two flat walls and a floor, 6 m around the sensor, in sensor frames; their scans; the true poses."""
    rng = stream(0, "walls")
    poses = np.array([yaw_pose(0.02 * k, (0.3 * k, 0.0, 1.0)) for k in range(n_scans)])
    points, scans = [], []
    for k, pose in enumerate(poses):
        along, z = rng.uniform(-6, 6, 900) + pose[0, 3], rng.uniform(0, 3, 900)
        side = np.column_stack([along[:600], np.repeat([2.0, -2.0], 300), z[:600]])
        floor = np.column_stack([along[600:], rng.uniform(-2, 2, 300), np.zeros(300)])
        points.append(transform(invert(pose), np.concatenate([side, floor])))
        scans.append(np.full(900, k))
    return np.concatenate(points), np.concatenate(scans), poses


def test_true_poses_in_any_frame_make_walls_without_thickness() -> None:
    points, scans, poses = drive()
    for frame in (np.eye(4), yaw_pose(1.0, (30.0, -8.0, 2.0))):
        rms_m = measure_thickness_m(points, scans, frame @ poses, poses)
        assert len(rms_m) > 100 and rms_m.max() < 1e-9


def test_what_shakes_across_a_wall_thickens_it_and_what_slides_along_does_not() -> None:
    points, scans, poses = drive()
    shake = stream(1, "shake").normal(0, 0.02, len(poses))
    none = np.zeros(len(poses))
    across = make_pose(np.repeat(np.eye(3)[None], len(poses), axis=0), np.column_stack([none, shake, none])) @ poses
    along = make_pose(np.repeat(np.eye(3)[None], len(poses), axis=0), np.column_stack([shake, none, none])) @ poses
    # of the cells two thirds are of the walls, which feel it, and one third of the floor
    assert np.percentile(measure_thickness_m(points, scans, across, poses), 80) == pytest.approx(0.02, rel=0.25)
    assert measure_thickness_m(points, scans, along, poses).max() < 1e-9


def test_a_slow_drift_does_not_thicken_walls() -> None:
    points, scans, poses = drive()
    drifting = poses.copy()
    drifting[:, :3, 3] *= 1.01
    assert np.percentile(measure_thickness_m(points, scans, drifting, poses), 95) < 0.002


def test_a_row_for_each_session_and_its_poses(tiny_pair: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main([tiny_pair])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["pair", "session", "poses", "cells", "median_m", "p95_m"]
    assert [line.split()[1:3] for line in lines[1:]] == [
        ["before", "recorded"], ["before", "graph"], ["after", "recorded"], ["after", "graph"],
    ]  # fmt: skip
    assert [line.split()[3:] for line in lines[1:]] == [["0", "nan", "nan"]] * 4  # one place, and too few returns
