"""A session's own estimate of its movement: truth with a systematic drift, or KISS-ICP on its own scans."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.core.geometry import Float64Array, stream
from cdpipe.core.motion import Motion, make_motion
from cdpipe.mapping.odometry import estimate_motion
from cdpipe.sensor.ouster import SensorMetadata
from scenarios.schema import Odometry


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


def register_scans(
    range_images: Iterable[npt.NDArray[np.uint32]],
    sensor: SensorMetadata,
    revolution_s: Float64Array,
    column_s: Float64Array,
    odom_T_first: Float64Array,
    session: str,
) -> Motion:
    """Return the movement that KISS-ICP finds in a session's revolutions: `cdpipe.mapping.odometry.estimate_motion`.

    Raises:
        ScenarioError: A pose is not finite; the message names the session.
    """
    try:
        return estimate_motion(range_images, sensor, revolution_s, column_s, odom_T_first)
    except InputError as error:
        raise ScenarioError(
            f"{session}: {error}: give another odometry.source, or a smaller platform.scan_spacing_m"
        ) from error
