from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, make_pose
from cdpipe.core.geometry.path_frames import path_frames


def poses_at(positions: Float64Array, seed: int | None = None) -> Float64Array:
    """Poses at (S, 3) positions, level and ahead along x, or rolled, pitched and turned at random."""
    rotations = (
        Rotation.identity(len(positions)) if seed is None else Rotation.random(len(positions), random_state=seed)
    )
    return make_pose(rotations.as_matrix(), positions)


def along(x_m: Float64Array) -> Float64Array:
    return np.column_stack([x_m, np.zeros_like(x_m), np.zeros_like(x_m)])


def every(poses: Float64Array) -> Float64Array:
    return path_frames(poses, np.arange(len(poses)))


def degrees_between(one: Float64Array, other: Float64Array) -> Float64Array:
    return np.degrees(Rotation.from_matrix(np.swapaxes(one[:, :3, :3], 1, 2) @ other[:, :3, :3]).magnitude())


def test_rolling_pitching_and_turning_the_sensor_changes_nothing() -> None:
    angle = np.linspace(0, 1.5, 80)
    bend = np.column_stack([20 * np.sin(angle), 20 * (1 - np.cos(angle)), 0.1 * 20 * angle])
    frames = every(poses_at(bend))
    for seed in (1, 2):
        np.testing.assert_array_equal(every(poses_at(bend, seed)), frames)
    np.testing.assert_array_equal(frames[:, :3, 3], bend)
    np.testing.assert_allclose(frames[:, 2, 1], 0.0, atol=1e-12)  # y is horizontal
    assert (frames[:, 2, 2] > 0.99).all()
    tangents = np.column_stack([np.cos(angle), np.sin(angle), np.full(80, 0.1)]) / np.hypot(1, 0.1)
    off_deg = np.degrees(np.arccos(np.einsum("ij,ij->i", frames[:, :3, 0], tangents).clip(-1, 1)))
    assert off_deg[8:-8].max() < 0.2 and off_deg.max() < 4  # at the ends the line is fitted to one side only


def test_gait_does_not_count() -> None:
    x_m = np.arange(0, 40, 0.1)
    sway = 0.07 * np.sin(2 * np.pi * x_m / 1.4), 0.05 * np.sin(2 * np.pi * x_m / 0.7)
    frames = every(poses_at(np.column_stack([x_m, *sway]), 3))
    assert degrees_between(frames, every(poses_at(along(x_m)))).max() < 4


def test_a_robot_that_reverses_stands_and_turns_back_keeps_its_direction() -> None:
    jitter = np.random.default_rng(0).normal(0, 0.02, (200, 3))
    legs = [np.arange(0, 20, 0.25), np.arange(20, 12, -0.25), np.full(200, 12.0), np.arange(12, 30, 0.25)]
    path = along(np.concatenate(legs))
    path[len(legs[0]) + len(legs[1]) :][:200] += jitter
    frames = every(poses_at(path, 4))
    np.testing.assert_allclose(frames[:, :3, 0], np.broadcast_to([1.0, 0.0, 0.0], (len(path), 3)), atol=0.06)
    back = every(poses_at(along(np.concatenate([np.arange(0, 3, 0.25), np.arange(3, -20, -0.25)]))))
    np.testing.assert_allclose(back[:, 0, 0], -1.0)  # most of the path leads along -x


@pytest.mark.parametrize("n", [1, 50])
def test_a_standing_sensor_has_its_own_heading_levelled(n: int) -> None:
    rotation = Rotation.from_euler("ZYX", [40, 20, -30], degrees=True).as_matrix()
    jitter = np.random.default_rng(1).normal(0, 0.01, (n, 3))
    frames = every(make_pose(np.repeat(rotation[None], n, axis=0), jitter))
    level = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    np.testing.assert_allclose(frames[:, :3, :3], np.broadcast_to(level, (n, 3, 3)), atol=1e-12)
    upright = every(make_pose(Rotation.from_euler("y", -90, degrees=True).as_matrix(), jitter[:1]))
    np.testing.assert_allclose(upright[0, :3, 0], [-1.0, 0.0, 0.0], atol=1e-12)  # its z axis looks back


def test_a_shaft_keeps_the_direction_of_its_foot() -> None:
    x_m, z_m = np.arange(0, 15, 0.25), np.arange(0.25, 20, 0.25)
    path = np.vstack([along(x_m), np.column_stack([np.full_like(z_m, x_m[-1]), np.zeros_like(z_m), z_m])])
    frames = every(poses_at(path, 5))
    assert frames[:, 2, 2].min() > 0.3  # the path tips up before the shaft
    assert degrees_between(frames[-60:-1], frames[-59:]).max() < 1e-6


def test_scans_farther_apart_than_the_line_is_long() -> None:
    frames = every(poses_at(along(np.arange(0.0, 40, 4)), 6))
    np.testing.assert_allclose(frames[:, :3, :3], np.broadcast_to(np.eye(3), (10, 3, 3)), atol=1e-12)
