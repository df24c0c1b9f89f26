from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, invert, make_pose, stream, transform, travelled_m, yaw_pose
from cdpipe.mapping.poses import loops as loops_module
from cdpipe.mapping.poses.consistency import make_consistent
from cdpipe.mapping.poses.loops import Loop, _find_candidates, _is_confirmed, close_loops, find_loops
from cdpipe.mapping.poses.scan_registration import Samples
from tests.cdpipe.conftest import CloudScans

RADIUS_M, HALF_M = 14.0, 2.2
ROUND_M = 2 * np.pi * RADIUS_M


def ring(rough_m: float, seed: int = 0) -> CloudScans:
    """1.3 rounds through a ring of a drift, a scan every metre, with true poses."""
    rng = stream(seed, "ring")
    around, across = rng.uniform(0, 2 * np.pi, 120_000), rng.uniform(0, 2 * np.pi, 120_000)
    phases = stream(0, "ring's relief").uniform(0, 2 * np.pi, (8, 2))
    relief = sum(np.sin((7 + 3 * k) * around + a) * np.sin((k % 3 + 1) * across + b) for k, (a, b) in enumerate(phases))
    section_m = HALF_M + rough_m * relief
    radius_m = RADIUS_M + section_m * np.cos(across)
    points = np.column_stack([radius_m * np.cos(around), radius_m * np.sin(around), section_m * np.sin(across)])
    clouds, poses = [], []
    for way_m in np.arange(0, 1.3 * ROUND_M):
        angle = way_m / RADIUS_M
        pose = yaw_pose(angle + np.pi / 2, (RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle), 0.0))
        near = np.flatnonzero(np.linalg.norm(points - pose[:3, 3], axis=1) < 8.0)
        seen = points[rng.choice(near, 4000, replace=False)] + rng.normal(0, 0.01, (4000, 3))
        clouds.append(transform(invert(pose), seen))
        poses.append(pose)
    return CloudScans("ring", np.array(poses), clouds)


def drifting(source: CloudScans, scale: float, yaw_deg_per_m: float) -> CloudScans:
    """The session with odometry that is too long and turns."""
    steps = invert(source.odom_T_sensor[:-1]) @ source.odom_T_sensor[1:]
    steps[:, :3, 3] *= scale
    steps[:, :3, :3] = steps[:, :3, :3] @ Rotation.from_euler("z", yaw_deg_per_m, degrees=True).as_matrix()
    poses = [source.odom_T_sensor[0]]
    for step in steps:
        poses.append(poses[-1] @ step)
    return CloudScans("ring", np.array(poses), [source.scan(k).points_sensor for k in range(len(poses))])


def between_passes_m(poses: Float64Array, true: Float64Array) -> Float64Array:
    """How far the second pass is off the first, at every scan that comes through a known place."""
    n = round(ROUND_M)
    errors = invert(invert(true[:-n]) @ true[n:]) @ invert(poses[:-n]) @ poses[n:]
    return np.asarray(np.linalg.norm(errors[:, :3, 3], axis=1))


@pytest.fixture(scope="module")
def rough() -> CloudScans:
    return ring(0.06)


def test_a_ring_is_closed(rough: CloudScans) -> None:
    source = drifting(rough, 1.01, 0.05)
    true = rough.odom_T_sensor
    loops = find_loops(Samples(source), source.odom_T_sensor)
    assert len(loops) >= 4
    for loop in loops:
        assert loop.scan - loop.other > 0.9 * ROUND_M
        error = invert(invert(true[loop.other]) @ true[loop.scan]) @ loop.other_T_scan
        assert np.linalg.norm(error[:3, 3]) < 0.1
    closed = make_consistent(source, has_loops=True)
    assert between_passes_m(source.odom_T_sensor, true).max() > 0.8
    assert np.median(between_passes_m(closed.odom_T_sensor, true)) < 0.03
    assert between_passes_m(closed.odom_T_sensor, true).max() < 0.15


def test_a_session_without_loops_stays(rough: CloudScans) -> None:
    n = round(0.7 * ROUND_M)
    part = CloudScans("part", rough.odom_T_sensor[:n], [rough.scan(k).points_sensor for k in range(n)])
    assert find_loops(Samples(part), part.odom_T_sensor) == ()
    np.testing.assert_array_equal(make_consistent(part, has_loops=True).odom_T_sensor, part.odom_T_sensor)


def test_a_smooth_ring_tells_no_place_and_closes_nothing() -> None:
    smooth = drifting(ring(0.0), 1.01, 0.0)
    assert find_loops(Samples(smooth), smooth.odom_T_sensor) == ()


def test_drifts_beside_one_another_are_no_loop(rough: CloudScans) -> None:
    # the second round is another drift, which the odometry takes for the first one
    other = ring(0.06, seed=1)
    n = round(ROUND_M)
    upside_down = make_pose(Rotation.from_euler("x", 180, degrees=True).as_matrix(), np.zeros(3))
    turned = [transform(upside_down, other.scan(k).points_sensor) for k in range(n, len(other.odom_T_sensor))]
    clouds = [rough.scan(k).points_sensor for k in range(n)] + turned
    source = CloudScans("two drifts", rough.odom_T_sensor, clouds)
    assert find_loops(Samples(source), source.odom_T_sensor) == ()


def test_a_hall_without_a_point_near_the_path_closes_nothing() -> None:
    rng = stream(0, "hall")
    along, across = rng.uniform(-20, 60, (4, 60_000)), rng.uniform(-9.5, 9.5, (4, 60_000))
    out = 9.5 + 0.15 * np.sin(3 * along) * np.sin(4 * across)
    sides = [(along[0], out[0], across[0]), (along[1], -out[1], across[1])]
    sides += [(along[2], across[2], out[2]), (along[3], across[3], -out[3])]
    walls = np.concatenate([np.column_stack(side) for side in sides])
    x_m = np.concatenate([np.arange(0.0, 30.0), np.arange(30.0, 0.0, -1.0)])
    true = make_pose(np.repeat(np.eye(3)[None], 60, axis=0), np.column_stack([x_m, 0 * x_m, 0 * x_m]))
    clouds = []
    for pose in true:
        seen = np.flatnonzero(np.linalg.norm(walls - pose[:3, 3], axis=1) < 18)
        clouds.append(transform(invert(pose), walls[rng.choice(seen, 4000, replace=False)]))
    off = true.copy()
    off[:, 1, 3] = np.linspace(0, 1.5, 60)
    assert find_loops(Samples(CloudScans("hall", off, clouds)), off) == ()


def test_the_candidates_of_many_passes_grow_with_the_path() -> None:
    counts = []
    for n_passes in (10, 20):
        along_m = np.abs((np.arange(60.0 * n_passes) + 60) % 120 - 60)  # to and fro
        poses = np.array([yaw_pose(0.0, (x, 0.0, 0.0)) for x in along_m])
        found = _find_candidates(np.arange(len(poses), dtype=np.float64), poses)
        assert {scan - other >= 25 for scan, other in found} == {True}
        counts.append(len(found))
    assert counts[1] < 2.6 * counts[0]


def test_a_stop_tells_the_way_ahead_and_a_loop_is_compared_with_its_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    # 2 x 500 m along x, 4 m apart; on the first pass the sensor stands for 20 scans every 100 m, and jitters in z
    there_m = np.repeat(np.arange(0.0, 500.0), np.where(np.arange(500) % 100 == 50, 20, 1))
    x_m, y_m = np.concatenate([there_m, np.arange(500.0, 0.0, -1.0)]), np.repeat([0.0, 4.0], [len(there_m), 500])
    z_m = np.concatenate([0.01 * (np.arange(len(there_m)) % 2), np.zeros(500)])
    poses = make_pose(translation=np.column_stack([x_m, y_m, z_m]))
    ways, compared = [], []

    def register(_: Samples, poses: Float64Array, scan: int, other: int, ahead: Float64Array) -> Float64Array:
        ways.append(ahead)
        return np.asarray(invert(poses[other]) @ poses[scan])

    def is_confirmed(loop: Loop, nearby: list[Loop], path_m: Float64Array, poses: Float64Array) -> bool:
        compared.append(len(nearby))
        return _is_confirmed(loop, nearby, path_m, poses)

    monkeypatch.setattr(loops_module, "_register_places", register)
    monkeypatch.setattr(loops_module, "_is_confirmed", is_confirmed)
    found = find_loops(SimpleNamespace(path_m=travelled_m(poses)), poses)  # type: ignore[arg-type]
    assert len(found) == len(ways) > 100
    np.testing.assert_allclose(np.abs(np.array(ways) @ [1.0, 0.0, 0.0]), 1.0, atol=1e-3)
    assert min(compared) >= 3 and max(compared) <= 7


def test_the_pose_graph_shares_an_error_out_over_the_round() -> None:
    # a square, driven once; at its end the odometry is off by a known motion
    true = [yaw_pose(0.0)]
    for _ in range(4):
        for _ in range(10):
            true.append(true[-1] @ make_pose(translation=(1.0, 0, 0)))
        true[-1] = true[-1] @ yaw_pose(np.pi / 2)
    poses, off = np.array(true), yaw_pose(0.0004, (0.01, 0.002, 0.001))
    odometry = poses[:1]
    for step in invert(poses[:-1]) @ poses[1:]:
        odometry = np.concatenate([odometry, odometry[-1:] @ step @ off])
    path_m = np.arange(len(poses), dtype=np.float64)
    loops = (Loop(40, 0, invert(poses[0]) @ poses[40]), Loop(38, 0, invert(poses[0]) @ poses[38]))
    closed = close_loops(path_m, odometry, loops)
    np.testing.assert_allclose(closed[0], odometry[0], atol=1e-6)
    off_m = np.linalg.norm((invert(invert(poses[0]) @ poses[40]) @ invert(closed[0]) @ closed[40])[:3, 3])
    was_m = np.linalg.norm((invert(invert(poses[0]) @ poses[40]) @ invert(odometry[0]) @ odometry[40])[:3, 3])
    assert off_m < 0.1 * was_m
    left_m, were_m = (np.linalg.norm((each - poses)[:, :3, 3], axis=1).max() for each in (closed, odometry))
    assert left_m < were_m
    steps, measured = invert(closed[:-1]) @ closed[1:], invert(odometry[:-1]) @ odometry[1:]
    assert np.abs((steps - measured)[:, :3, 3]).max() < 0.06  # nowhere a jump
