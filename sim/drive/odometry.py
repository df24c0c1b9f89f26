"""A session's own estimate of its movement: truth with a drift or a random walk, a file, or KISS-ICP on its scans."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.core.geometry import Float64Array, Int64Array, stream
from cdpipe.core.geometry.motion import Motion, make_motion
from cdpipe.core.geometry.voxel import require_reachable
from cdpipe.io.tum import motion_beyond, read_trajectory
from cdpipe.mapping.poses.odometry import Image, estimate_motion
from cdpipe.sensor.ouster import SensorMetadata
from scenarios.schema import Odometry

# The errors of a random walk are drawn this far apart along the path.
_WALK_STEP_M = 0.05
# Poses of a file farther apart than this say nothing about a revolution between them.
_LONGEST_GAP_S = 1.0
# The truth numbers the cells that returns fill; no sensor reports more than 524 m.
_CELL_M = 0.1
_REACH_M = 530.0


def start_pose(true: Motion, start_s: float) -> Float64Array:
    """Return odom_T_sensor (4, 4) at `start_s`: upright as gravity shows it, heading and position zero."""
    first = true.poses(np.array([start_s]))[0]
    yaw = np.arctan2(first[1, 0], first[0, 0])
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", -yaw).as_matrix() @ first[:3, :3]
    return pose


def drift_motion(true: Motion, start_s: float, odometry: Odometry, seed: int, session: str) -> Motion:
    """Return the movement with the errors of odometry: scaled increments, and a heading error that grows with the way.

    The odom frame is upright, with its origin at the sensor and its x axis along the sensor's heading at `start_s`.
    The error is the same all along: after 100 m the path is `translation_percent` too long or short and the heading
    `yaw_deg_per_100m` off, exactly. Roll and pitch come from gravity and stay true.
    """
    signs = stream(seed, session, "odometry").choice([-1.0, 1.0], size=2)
    steps = np.diff(true.points, axis=0)
    travelled_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
    travelled_m -= np.interp(start_s, true.time_s, travelled_m)
    drift_rad = signs[1] * np.deg2rad(odometry.yaw_deg_per_100m) * travelled_m / 100.0
    first = true.poses(np.array([start_s]))[0]
    start_yaw_rad = np.arctan2(first[1, 0], first[0, 0])
    turn_rad = (drift_rad[:-1] + drift_rad[1:]) / 2 - start_yaw_rad
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    turned = np.stack([cos * steps[:, 0] - sin * steps[:, 1], sin * steps[:, 0] + cos * steps[:, 1], steps[:, 2]], 1)
    scale = 1.0 + signs[0] * odometry.translation_percent / 100.0
    points = np.concatenate([np.zeros((1, 3)), np.cumsum(scale * turned, axis=0)])
    points -= [np.interp(start_s, true.time_s, points[:, axis]) for axis in range(3)]
    turns = Rotation.from_euler("z", (drift_rad - start_yaw_rad)[:, None])
    return make_motion(true.time_s, true.way_m, points, turns * Rotation.from_quat(true.quaternions))


def walk_motion(
    true: Motion, revolution_s: Float64Array, column_s: Float64Array, odometry: Odometry, seed: int, session: str
) -> Motion:
    """Return the movement with the errors of an odometry that matches scans (`source: random-walk`).

    Scale, yaw rate and tilt have errors that are first-order Gauss-Markov processes over the path. The error of the
    heading is the integral of the yaw rate's. Jitter shifts and turns each revolution as a whole; its axes are those of
    the direction of travel, whatever way the sensor looks.

    Args:
        true: Movement of the sensor in the world frame.
        revolution_s: (S,) time of each middle column.
        column_s: (W,) time of each column after the middle one.
        odometry: Its figures.
        seed: Seed of all draws.
        session: "before" or "after".
    """
    start_s = float(revolution_s[0])
    bounds_s = (revolution_s[:, None] + column_s[[0, -1]]).ravel()
    time_s = np.union1d(true.time_s, bounds_s)
    points, quaternions = true.sample(time_s)
    steps = np.diff(points, axis=0)
    travelled_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
    start_m = float(np.interp(start_s, time_s, travelled_m))

    scale, yaw_rate, roll, pitch = _draw_walks(travelled_m[-1], odometry, seed, session)
    grid_m = _WALK_STEP_M * np.arange(len(scale))
    yaw_rad = np.concatenate([[0.0], np.cumsum(np.deg2rad(yaw_rate[1:] + yaw_rate[:-1]) / 2 * _WALK_STEP_M)])
    yaw_rad -= np.interp(start_m, grid_m, yaw_rad)

    first = true.poses(np.array([start_s]))[0]
    start_yaw_rad = np.arctan2(first[1, 0], first[0, 0])

    def turns_at(way_m: Float64Array) -> Rotation:
        tilt = np.stack([np.interp(way_m, grid_m, values) for values in (np.deg2rad(pitch), np.deg2rad(roll))], axis=1)
        yaw = Rotation.from_euler("z", (np.interp(way_m, grid_m, yaw_rad) - start_yaw_rad)[:, None])
        return yaw * Rotation.from_euler("yx", tilt)

    middle_m = (travelled_m[1:] + travelled_m[:-1]) / 2
    stretched = steps * (1.0 + np.interp(middle_m, grid_m, scale)[:, None] / 100.0)
    walked = np.concatenate([np.zeros((1, 3)), np.cumsum(turns_at(middle_m).apply(stretched), axis=0)])
    walked -= [np.interp(start_s, time_s, walked[:, axis]) for axis in range(3)]
    rotations = turns_at(travelled_m) * Rotation.from_quat(quaternions)

    shifts_m, twists_rad = _draw_jitter(len(revolution_s), odometry, seed, session)
    middles = np.stack([np.interp(revolution_s, time_s, walked[:, axis]) for axis in range(3)], axis=1)
    heading_rad = np.interp(revolution_s, time_s, _headings_rad(walked, travelled_m))
    level = Rotation.from_euler("z", heading_rad[:, None])
    # constant within each revolution
    jitter = np.repeat(np.concatenate([middles, level.apply(shifts_m), level.apply(twists_rad)], axis=1), 2, axis=0)
    middle, shift, twist = np.split(np.stack([np.interp(time_s, bounds_s, one) for one in jitter.T], axis=1), 3, axis=1)
    turn = Rotation.from_rotvec(twist)
    way_m = np.interp(time_s, true.time_s, true.way_m)
    return make_motion(time_s, way_m, middle + shift + turn.apply(walked - middle), turn * rotations)


def _draw_walks(length_m: float, odometry: Odometry, seed: int, session: str) -> list[Float64Array]:
    """Return the errors of scale (percent), yaw rate (degrees per metre), roll and pitch (degrees) every 0.05 m."""
    n_steps = int(np.ceil(length_m / _WALK_STEP_M)) + 2
    walks = []
    for word, sigma, correlation_m in (
        ("scale", odometry.scale_percent, odometry.scale_length_m),
        ("yaw", odometry.yaw_deg_per_m, odometry.yaw_length_m),
        ("roll", odometry.tilt_deg, odometry.tilt_length_m),
        ("pitch", odometry.tilt_deg, odometry.tilt_length_m),
    ):
        white = stream(seed, session, "odometry", word).standard_normal(n_steps)
        kept = np.exp(-_WALK_STEP_M / (correlation_m or np.inf))
        white[1:] *= np.sqrt(1.0 - kept**2)
        walks.append((sigma or 0.0) * np.asarray(lfilter([1.0], [1.0, -kept], white)))
    return walks


def _draw_jitter(n_scans: int, odometry: Odometry, seed: int, session: str) -> tuple[Float64Array, Float64Array]:
    """Return each pose's shift (S, 3) along, left and up, metres, and its turn (S, 3) about these axes, radians."""
    along, across = odometry.jitter_along_m or 0.0, odometry.jitter_across_m or 0.0
    turns_deg = (odometry.jitter_roll_deg, odometry.jitter_pitch_deg, odometry.jitter_yaw_deg)
    white = stream(seed, session, "odometry", "jitter").standard_normal((n_scans, 6))
    return white[:, :3] * (along, across, across), white[:, 3:] * np.deg2rad([sigma or 0.0 for sigma in turns_deg])


def _headings_rad(points: Float64Array, travelled_m: Float64Array) -> Float64Array:
    """Return the direction of travel (N,) at each point (N, 3) of a path, over half a metre of it, unwrapped."""
    ahead, behind = (
        np.stack([np.interp(travelled_m + side, travelled_m, points[:, axis]) for axis in (0, 1)])
        for side in (0.25, -0.25)
    )
    return np.unwrap(np.arctan2(ahead[1] - behind[1], ahead[0] - behind[0]))


def walk_sigma(sigma: float, length_m: float, way_m: float) -> float:
    """Return the standard deviation of the integral over `way_m` of a Gauss-Markov process.

    The process has the standard deviation `sigma` and the correlation length `length_m`. Far below it the integral
    grows with the way, far beyond it with its root, as a random walk does.
    """
    share = way_m / length_m
    return float(sigma * length_m * np.sqrt(2.0 * (share - 1.0 + np.exp(-share))))


def read_odometry(
    path: Path, revolution_s: Float64Array, column_offsets_ns: Float64Array | Int64Array, session: str
) -> Motion:
    """Return the movement of a TUM file of odom_T_sensor, interpolated in time.

    Stamps are seconds of the session's clock, which is 0 at the first column of its first revolution. Beyond the file's
    ends the movement goes on as it was over the nearest revolution.

    Args:
        path: The file.
        revolution_s: (S,) time of each middle column in the drive.
        column_offsets_ns: (W,) time of each column from the start of its revolution.
        session: "before" or "after".

    Raises:
        InputError: The file is no trajectory, has no poses near one of the revolutions, or is too far from its origin.
    """
    rows, numbers = read_trajectory(path)
    require_reachable(f"{session}: {path}", float(np.abs(rows[:, 1:4]).max()) + _REACH_M, _CELL_M)
    middle_s = revolution_s - revolution_s[0] + column_offsets_ns[len(column_offsets_ns) // 2] / 1e9
    slack_s = float(column_offsets_ns[-1]) / 1e9
    stamps = rows[:, 0]
    if stamps[0] > middle_s[0] + slack_s or stamps[-1] < middle_s[-1] - slack_s:
        raise InputError(
            f"{session}: {path}: covers {stamps[0]:.3f} to {stamps[-1]:.3f} s, the session {middle_s[0]:.3f} to "
            f"{middle_s[-1]:.3f} s: stamps are seconds from the first column of its first revolution"
        )
    after = np.clip(np.searchsorted(stamps, middle_s), 1, len(stamps) - 1)
    away_s = np.minimum(np.abs(middle_s - stamps[after - 1]), np.abs(stamps[after] - middle_s))
    is_bare = (stamps[after] - stamps[after - 1] > _LONGEST_GAP_S) & (away_s > slack_s)
    if is_bare.any():
        bad = int(np.argmax(is_bare))
        raise InputError(
            f"{session}: {path}:{numbers[after[bad]]}: no pose for {stamps[after[bad]] - stamps[after[bad] - 1]:.2f} s "
            f"before it, and the session has a revolution at {middle_s[bad]:.3f} s: give a pose for each revolution, "
            f"or one every {_LONGEST_GAP_S:g} s at least"
        )
    return motion_beyond(rows, middle_s[0] - revolution_s[0], slack_s)


def register_scans(
    revolutions: Iterable[Image],
    sensor: SensorMetadata,
    revolution_s: Float64Array,
    column_s: Float64Array,
    odom_T_first: Float64Array,
    session: str,
) -> Motion:
    """Return the movement that KISS-ICP finds in a session's revolutions (`cdpipe.mapping.estimate_motion`).

    Raises:
        ScenarioError: A pose is not finite; the message names the session.
    """
    try:
        return estimate_motion(revolutions, sensor, revolution_s, column_s, odom_T_first)
    except InputError as error:
        raise ScenarioError(
            f"{session}: {error}: give another odometry.source, or a smaller platform.scan_spacing_m"
        ) from error
