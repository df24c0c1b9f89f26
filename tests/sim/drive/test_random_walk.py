"""The random walk of odometry has the statistics that its figures ask for."""

from __future__ import annotations

from functools import cache, partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, invert, yaw_rad
from cdpipe.core.geometry.motion import Motion, make_motion
from scenarios.schema import FITTED_WALK, Odometry
from sim.drive.odometry import walk_motion

LENGTH_M = 240.0
COLUMN_S = (np.arange(64) - 32) / 640
REVOLUTION_S = np.arange(0.1, LENGTH_M - 0.1, 0.5)
NOTHING = dict.fromkeys((key for key in FITTED_WALK if not key.endswith("length_m")), 0.0)


def straight() -> Motion:
    """A straight and level drive at 1 m/s."""
    way_m = np.linspace(0.0, LENGTH_M, round(LENGTH_M / 0.05) + 1)
    points = way_m[:, None] * [np.cos(0.4), np.sin(0.4), 0.0] + [3.0, -2.0, 1.0]
    return make_motion(way_m, way_m, points, Rotation.from_euler("z", np.full((len(way_m), 1), 0.4)))


def walk(seed: int, session: str = "before", **figures: float) -> Motion:
    odometry = Odometry.model_validate({"source": "random-walk", **NOTHING, **figures})
    return walk_motion(straight(), REVOLUTION_S, COLUMN_S, odometry, seed, session)


def steps_over(poses: Float64Array, way_m: float) -> Float64Array:
    """Relative poses over a distance; windows do not overlap."""
    n_scans = round(way_m / 0.5)
    return np.asarray(invert(poses[:-n_scans:n_scans]) @ poses[n_scans::n_scans])


def integrated_sigma(sigma: float, length_m: float, way_m: float) -> float:
    # the double integral of sigma^2 exp(-|a - b| / length) over [0, way]^2, midpoint rule
    at_m = (np.arange(1000) + 0.5) * way_m / 1000
    return float(sigma * np.sqrt(np.exp(-np.abs(at_m[:, None] - at_m) / length_m).mean()) * way_m)


@cache
def walked_poses() -> list[Float64Array]:
    drawn = {"scale_percent": 0.8, "scale_length_m": 10.0, "yaw_deg_per_m": 0.01, "yaw_length_m": 30.0}
    white = {"jitter_along_m": 0.02, "jitter_across_m": 0.01, "jitter_yaw_deg": 0.03}
    return [walk(seed, **drawn, **white).poses(REVOLUTION_S) for seed in range(60)]


@pytest.mark.parametrize("way_m", [0.5, 5.0, 20.0, 100.0])
def test_errors_over_a_step_and_5_20_and_100_m_are_those_that_were_asked_for(way_m: float) -> None:
    along: list[float] = []
    turns: list[float] = []
    for poses in walked_poses():
        steps = steps_over(poses, way_m)
        along += (np.linalg.norm(steps[:, :3, 3], axis=1) - way_m).tolist()
        turns += [np.rad2deg(yaw_rad(step)) for step in steps]
    expected_m = np.hypot(np.sqrt(2) * 0.02, integrated_sigma(0.008, 10.0, way_m))
    expected_deg = np.hypot(np.sqrt(2) * 0.03, integrated_sigma(0.01, 30.0, way_m))
    tolerance = 4.0 / np.sqrt(2 * len(along))  # four standard errors of a standard deviation
    assert np.std(along) == pytest.approx(expected_m, rel=max(tolerance, 0.05))
    assert np.std(turns) == pytest.approx(expected_deg, rel=max(tolerance, 0.05))


def test_gravity_bounds_roll_and_pitch() -> None:
    walks = [walk(seed, tilt_deg=0.5, tilt_length_m=10.0).poses(REVOLUTION_S[::40]) for seed in range(60)]
    up = np.rad2deg([poses[:, :2, 2] for poses in walks])
    # as large at the end as at the start, about either axis
    np.testing.assert_allclose(np.std(up, axis=0), 0.5, rtol=0.35)
    np.testing.assert_allclose(np.std(up, axis=(0, 1)), 0.5, rtol=0.12)


def test_jitter_turns_and_shifts_each_revolution_as_a_whole_and_does_not_add_up() -> None:
    true = straight()
    jittered = walk(
        3, jitter_along_m=0.05, jitter_across_m=0.02, jitter_yaw_deg=0.2, jitter_roll_deg=0.3, jitter_pitch_deg=0.1
    )
    columns_s = REVOLUTION_S[:, None] + COLUMN_S
    wanted, found = (
        invert(motion.poses(REVOLUTION_S))[:, None] @ motion.poses(columns_s) for motion in (true, jittered)
    )
    np.testing.assert_allclose(found, wanted, atol=1e-9)
    first = invert(true.poses(REVOLUTION_S[:1]))
    errors = jittered.poses(REVOLUTION_S) - first @ true.poses(REVOLUTION_S)
    np.testing.assert_allclose(errors[:, :3, 3].std(axis=0), (0.05, 0.02, 0.02), rtol=0.1)
    assert np.abs(np.corrcoef(errors[1:, 0, 3], errors[:-1, 0, 3])[0, 1]) < 0.15
    assert np.rad2deg(errors[:, 1, 0].std()) == pytest.approx(0.2, rel=0.1)
    np.testing.assert_allclose(np.rad2deg(errors[:, 2, :2].std(axis=0)), (0.1, 0.3), rtol=0.1)


def test_without_figures_it_is_the_truth_seen_from_the_first_revolution() -> None:
    true = straight().poses(REVOLUTION_S)
    np.testing.assert_allclose(walk(5).poses(REVOLUTION_S), invert(true[0]) @ true, atol=1e-9)


def test_seed_and_session_draw_it_and_nothing_else_does() -> None:
    default = partial(walk, **FITTED_WALK)

    def content(motion: Motion) -> bytes:
        return motion.points.tobytes() + motion.quaternions.tobytes()

    assert content(default(7)) == content(default(7))
    assert len({content(default(7)), content(default(8)), content(default(7, "after"))}) == 3
    # another figure leaves the other draws alone
    heading = [walk(7, yaw_deg_per_m=0.01, scale_percent=scale).quaternions for scale in (0.0, 2.0)]
    np.testing.assert_array_equal(*heading)


def test_a_sensor_that_does_not_roll_jitters_all_the_same() -> None:
    odometry = Odometry.model_validate({"source": "random-walk", **NOTHING, "jitter_along_m": 0.05})
    motion = walk_motion(straight(), REVOLUTION_S, np.zeros(64), odometry, 1, "before")
    assert np.isfinite(motion.points).all()
    errors_m = motion.poses(REVOLUTION_S)[:, 0, 3] - (REVOLUTION_S - REVOLUTION_S[0])
    assert errors_m.std() == pytest.approx(0.05, rel=0.1)


def test_a_standing_sensor_has_jitter_alone() -> None:
    time_s = np.array([0.0, 1.0, 2.0])
    still = make_motion(time_s, np.zeros(3), np.ones((3, 3)), Rotation.from_quat(np.tile([0.0, 0.0, 0.0, 1.0], (3, 1))))
    odometry = Odometry.model_validate(
        {"source": "random-walk", **NOTHING, **{"scale_percent": 5, "jitter_yaw_deg": 1}}
    )
    poses = walk_motion(still, np.array([0.5, 1.5]), COLUMN_S, odometry, 1, "before").poses(np.array([0.5, 1.5]))
    np.testing.assert_allclose(poses[:, :3, 3], 0.0, atol=1e-9)
    assert (np.abs(poses[:, 1, 0]) > 1e-4).all()
