"""From a path to poses: when and where each column of each recorded revolution was taken, and where odometry had it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.errors import ScenarioError
from cdpipe.geometry import Float32Array, Float64Array, Int64Array, invert, stream
from cdpipe.ouster import SensorMetadata
from scenarios.schema import Odometry, Platform, Scenario
from sim.noise import smooth_noise
from sim.path import Path, plan_path
from sim.scene import World

_TILT_LENGTH_M = 2.5


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A movement over travelled distance: linear between samples, so that any column can be asked for.

    Attributes:
        distance_m: (N,) horizontal distance travelled.
        points: (N, 3) position, metres.
        angles_rad: (N, 3) yaw (unwrapped), pitch and roll, applied in this order about moving axes.
    """

    distance_m: Float64Array
    points: Float64Array
    angles_rad: Float64Array

    def poses(self, distance_m: Float64Array) -> Float64Array:
        """Return the poses (..., 4, 4) at distances (...)."""
        flat = distance_m.ravel()
        columns = [np.interp(flat, self.distance_m, self.points[:, axis]) for axis in range(3)]
        angles = [np.interp(flat, self.distance_m, self.angles_rad[:, axis]) for axis in range(3)]
        poses = np.zeros((len(flat), 4, 4))
        poses[:, :3, :3] = _rotations(*angles)
        poses[:, :3, 3] = np.stack(columns, axis=1)
        poses[:, 3, 3] = 1.0
        return poses.reshape(*distance_m.shape, 4, 4)


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """One session's drive.

    Attributes:
        true: Movement of the sensor in the world frame.
        estimated: The same as the session's odometry has it, in its odom frame.
        revolution_m: (S,) distance travelled at the middle column of each recorded revolution.
        column_m: (W,) distance travelled at each column, from the middle one.
        speed_mps: Speed.
        column_offsets_ns: (W,) time of each column from the start of its revolution.
    """

    true: Motion
    estimated: Motion
    revolution_m: Float64Array
    column_m: Float64Array
    speed_mps: float
    column_offsets_ns: Float64Array

    @property
    def n_scans(self) -> int:
        """Number of revolutions S."""
        return len(self.revolution_m)

    def world_T_column(self, scans: slice) -> Float64Array:
        """Return the true poses (s, W, 4, 4) of every column of some revolutions."""
        return self.true.poses(self.revolution_m[scans, None] + self.column_m)

    def sensor_T_column(self, scans: slice) -> Float32Array:
        """Return odometry's column poses (s, W, 7) in the frame of their revolution: x, y, z, qx, qy, qz, qw."""
        odom_T_column = self.estimated.poses(self.revolution_m[scans, None] + self.column_m)
        sensor_T_odom = invert(self.odom_T_sensor[scans])
        relative = np.einsum("sij,swjk->swik", sensor_T_odom, odom_T_column)
        quaternions = Rotation.from_matrix(relative[..., :3, :3].reshape(-1, 3, 3)).as_quat(canonical=True)
        return np.concatenate(
            [relative[..., :3, 3], quaternions.reshape(*relative.shape[:2], 4)], axis=2, dtype=np.float32
        )

    def column_stamps_ns(self, scans: slice) -> Int64Array:
        """Return the time (s, W) of every column since the first one of the session."""
        start_ns = (self.revolution_m[scans] - self.revolution_m[0]) / self.speed_mps * 1e9
        return np.asarray(np.rint(start_ns[:, None] + self.column_offsets_ns), dtype=np.int64)

    @property
    def world_T_sensor(self) -> Float64Array:
        """(S, 4, 4) true pose of each revolution, at its middle column."""
        return self.true.poses(self.revolution_m)

    @property
    def odom_T_sensor(self) -> Float64Array:
        """(S, 4, 4) pose of each revolution as odometry has it."""
        return self.estimated.poses(self.revolution_m)


def plan_trajectory(world: World, scenario: Scenario, sensor: SensorMetadata, seed: int, session: str) -> Trajectory:
    """Return the drive of one session.

    Raises:
        ScenarioError: The route leaves no room, or the sensor cannot record that often.
    """
    path = plan_path(world, scenario, session)
    true = true_motion(path, scenario.platform, seed, session)
    return record(true, getattr(scenario, session).odometry, scenario.platform, sensor, seed, session)


def true_motion(path: Path, platform: Platform, seed: int, session: str) -> Motion:
    """Add the tilt of the platform: smooth noise, and on wheels the slope of the floor."""
    keys = stream(seed, session, "tilt").integers(2**63, size=2).tolist()
    pitch, roll = (
        np.deg2rad(platform.tilt_deg) * smooth_noise((path.distance_m,), _TILT_LENGTH_M, key) for key in keys
    )
    if platform.kind == "ground_robot":
        pitch = pitch - np.arctan(path.slope)
    return Motion(path.distance_m, path.points, np.stack([path.yaw_rad, pitch, roll], axis=1))


def record(
    true: Motion, odometry: Odometry, platform: Platform, sensor: SensorMetadata, seed: int, session: str
) -> Trajectory:
    """Choose the revolutions to be recorded and let odometry estimate the movement.

    Raises:
        ScenarioError: The path is shorter than a revolution, or `scan_spacing_m` asks for more revolutions than turn.
    """
    turn_m = platform.speed_mps / sensor.rate_hz
    if platform.scan_spacing_m < turn_m * (1 - 1e-9):
        raise ScenarioError(
            f"platform.scan_spacing_m = {platform.scan_spacing_m:g}: at {platform.speed_mps:g} m/s and "
            f"{sensor.rate_hz:g} Hz revolutions are {turn_m:g} m apart: give at least that"
        )
    usable_m = true.distance_m[-1] - turn_m
    if usable_m < 0:
        raise ScenarioError(f"{session}: the path of {true.distance_m[-1]:.2f} m is shorter than one revolution")
    n_scans = 1 + int(np.floor(usable_m / platform.scan_spacing_m))
    revolution_m: Float64Array = turn_m / 2 + np.arange(n_scans, dtype=np.float64) * platform.scan_spacing_m
    column_m: Float64Array = (np.arange(sensor.width, dtype=np.float64) - sensor.width // 2) * (turn_m / sensor.width)
    estimated = estimate(true, float(revolution_m[0]), odometry, seed, session)
    return Trajectory(true, estimated, revolution_m, column_m, platform.speed_mps, sensor.column_offsets_ns())


def estimate(true: Motion, start_m: float, odometry: Odometry, seed: int, session: str) -> Motion:
    """Return the movement as odometry has it: its increments scaled, its heading drifting with the way.

    The odom frame is upright, with its origin at the sensor and its x axis along the sensor's heading after `start_m`.
    The error is the same all along: after 100 m the path is `translation_percent` too long or short and the heading
    `yaw_deg_per_100m` off, exactly. Roll and pitch come from gravity and stay true.
    """
    signs = stream(seed, session, "odometry").choice([-1.0, 1.0], size=2)
    steps = np.diff(true.points, axis=0)
    travelled_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
    travelled_m -= np.interp(start_m, true.distance_m, travelled_m)
    drift_rad = signs[1] * np.deg2rad(odometry.yaw_deg_per_100m) * travelled_m / 100.0
    start_yaw_rad = np.interp(start_m, true.distance_m, true.angles_rad[:, 0])
    turn_rad = (drift_rad[:-1] + drift_rad[1:]) / 2 - start_yaw_rad
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    turned = np.stack([cos * steps[:, 0] - sin * steps[:, 1], sin * steps[:, 0] + cos * steps[:, 1], steps[:, 2]], 1)
    scale = 1.0 + signs[0] * odometry.translation_percent / 100.0
    points = np.concatenate([np.zeros((1, 3)), np.cumsum(scale * turned, axis=0)])
    points -= [np.interp(start_m, true.distance_m, points[:, axis]) for axis in range(3)]
    angles = true.angles_rad.copy()
    angles[:, 0] += drift_rad - start_yaw_rad
    return Motion(true.distance_m, points, angles)


def _rotations(yaw: Float64Array, pitch: Float64Array, roll: Float64Array) -> Float64Array:
    """Rz(yaw) Ry(pitch) Rx(roll), (N, 3, 3)."""
    cy, sy, cp, sp, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)
