"""Trajectories: time, true pose and estimated pose of each column of each recorded revolution."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float32Array, Float64Array, Int64Array
from cdpipe.core.geometry.motion import Motion, rotation_matrices
from cdpipe.sensor.ouster import SensorMetadata, load_profile
from scenarios.schema import Platform, Scenario
from sim.drive.obstacles import check_clearance
from sim.drive.odometry import drift_motion, read_odometry, walk_motion
from sim.drive.path import plan_path
from sim.drive.ride import ride
from sim.placement.recorded import check_inside, read_drive
from sim.scene import Scene, World

# Tolerance for comparing times and distances, so that rounding drops no revolution.
_SLACK = 1e-6
_MOST_TURNS = 10_000_000  # eleven days at 10 Hz


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """One session's drive.

    Attributes:
        true: Movement of the sensor in the world frame.
        estimated: The movement that the session's odometry estimates, in its odom frame.
        revolution_s: (S,) time of the middle column of each recorded revolution.
        column_s: (W,) time of each column's pose after the middle one's; all 0 where the scan does not roll.
        column_offsets_ns: (W,) time of each column from the start of its revolution.
    """

    true: Motion
    estimated: Motion
    revolution_s: Float64Array
    column_s: Float64Array
    column_offsets_ns: Float64Array

    @property
    def n_scans(self) -> int:
        """Number of revolutions S."""
        return len(self.revolution_s)

    def world_T_column(self, scans: slice) -> Float64Array:
        """Return the true poses (s, W, 4, 4) of every column of some revolutions."""
        return self.true.poses(self.revolution_s[scans, None] + self.column_s)

    def odom_T_column(self, scan: int, columns: Int64Array) -> Float64Array:
        """Return odometry's poses (N, 4, 4) of some columns (N,) of one revolution."""
        return self.estimated.poses(self.revolution_s[scan] + self.column_s[columns])

    def sensor_T_column(self, scans: slice) -> Float32Array:
        """Return odometry's column poses (s, W, 7) in the frame of their revolution: x, y, z, qx, qy, qz, qw."""
        points, quaternions = self.estimated.sample(self.revolution_s[scans, None] + self.column_s)
        origins, middles = self.estimated.sample(self.revolution_s[scans])
        out = np.empty((*points.shape[:2], 7), dtype=np.float32)
        odom_R_sensor = rotation_matrices(middles)[:, None]
        offsets = points - origins[:, None]
        for axis in range(3):
            column = odom_R_sensor[..., axis]
            out[..., axis] = sum(column[..., row] * offsets[..., row] for row in range(3))
        out[..., 3:] = _from(middles[:, None], quaternions)
        return out

    def column_stamps_ns(self, scans: slice) -> Int64Array:
        """Return the time (s, W) of every column since the first one of the session."""
        start_ns = (self.revolution_s[scans] - self.revolution_s[0]) * 1e9
        return np.asarray(np.rint(start_ns[:, None] + self.column_offsets_ns), dtype=np.int64)

    @property
    def world_T_sensor(self) -> Float64Array:
        """(S, 4, 4) true pose of each revolution, at its middle column."""
        return self.true.poses(self.revolution_s)

    @property
    def odom_T_sensor(self) -> Float64Array:
        """(S, 4, 4) pose of each revolution as odometry has it."""
        return self.estimated.poses(self.revolution_s)


def _from(start: Float64Array, end: Float64Array) -> Float64Array:
    """Return the turn `start`^-1 `end` of unit quaternions x, y, z, w (..., 4), its w not negative."""
    x1, y1, z1, w1 = (start[..., axis] for axis in range(4))
    x2, y2, z2, w2 = (end[..., axis] for axis in range(4))
    turn = np.stack(
        [
            w1 * x2 - x1 * w2 - y1 * z2 + z1 * y2,
            w1 * y2 - y1 * w2 - z1 * x2 + x1 * z2,
            w1 * z2 - z1 * w2 - x1 * y2 + y1 * x2,
            w1 * w2 + x1 * x2 + y1 * y2 + z1 * z2,
        ],
        axis=-1,
    )
    return np.asarray(np.where(turn[..., 3:] < 0, -turn, turn))


def load_sensor(scenario: Scenario, session: str) -> SensorMetadata:
    """Return the sensor of one session.

    Raises:
        InputError: Its profile cannot be read.
    """
    settings = scenario.of(session).sensor
    return load_profile(settings.profile, settings.mode)


def plan_trajectory(world: World, scenario: Scenario, sensor: SensorMetadata, seed: int, session: str) -> Trajectory:
    """Return the drive of one session.

    For KISS-ICP, which needs the scans, `estimated` is the true movement relative to the first revolution.

    Raises:
        InputError: The trajectory or the odometry file cannot be read.
        ScenarioError: The route leaves no room, the trajectory leaves the tunnel, or revolutions are too far apart.
    """
    scenario, world = scenario.of(session), world.of(session)
    plan = scenario.plan(session)
    scene = world.after if session == "after" else world.before
    if plan.trajectory is not None:
        true, lines = read_drive(Path(plan.trajectory))
        check_inside(true, scene.caster, f"{session}: {plan.trajectory}", lines)
    else:
        true = _drive_route(world, scene, scenario, seed, session)
    return record(true, scenario, sensor, seed, session)


def _drive_route(
    world: World, scene: Scene, scenario: Scenario, seed: int, session: str, is_wary: bool = False
) -> Motion:
    """Drive the path of a session; if it comes too near a surface, try a wary path."""
    path = plan_path(world, scenario, seed, session, is_wary)
    true = ride(path, world.fixed, scene.caster, scenario, seed, session)
    try:
        on_path = np.searchsorted(true.way_m, path.distance_m)  # a walk has further samples in between
        check_clearance(world, scenario, session, path.distance_m, true.points[on_path])
    except ScenarioError as too_near:
        if is_wary:
            raise
        try:
            return _drive_route(world, scene, scenario, seed, session, is_wary=True)
        except ScenarioError:
            raise too_near from None
    return true


def record(true: Motion, scenario: Scenario, sensor: SensorMetadata, seed: int, session: str) -> Trajectory:
    """Choose the revolutions to be recorded and let odometry estimate the movement.

    Raises:
        InputError: The odometry file cannot be read, or does not cover the drive.
        ScenarioError: The drive is shorter than a revolution, or `scan_spacing_m` asks for more revolutions than turn.
    """
    plan = scenario.plan(session)
    revolution_s = recorded(true, scenario.platform, sensor.rate_hz, session)
    column_s: Float64Array = np.arange(sensor.width, dtype=np.float64) - sensor.width // 2
    column_s /= sensor.rate_hz * sensor.width
    if not scenario.sensor.rolling_scan:
        column_s[:] = 0.0
    offsets_ns, odometry = sensor.column_offsets_ns(), plan.odometry
    if odometry.file is not None:
        estimated = read_odometry(Path(odometry.file), revolution_s, offsets_ns, session)
    elif odometry.source == "random-walk":
        estimated = walk_motion(true, revolution_s, column_s, odometry, seed, session)
    else:
        estimated = drift_motion(true, float(revolution_s[0]), odometry, seed, session)
    return Trajectory(true, estimated, revolution_s, column_s, offsets_ns)


def recorded(true: Motion, platform: Platform, rate_hz: float, session: str) -> Float64Array:
    """Return the time (S,) at the middle of each revolution that is kept.

    The head turns all the time, from the start of the drive on; of its revolutions the first one is kept, and then the
    first one at or after every further `scan_spacing_m` of way.
    """
    duration_s = true.time_s[-1] - true.time_s[0]
    n_turns = int(np.floor(duration_s * rate_hz + _SLACK))
    if n_turns < 1:
        raise ScenarioError(
            f"{session}: the drive takes {duration_s:.3f} s, less than one revolution at {rate_hz:g} Hz: "
            "give a longer route or trajectory"
        )
    if n_turns > _MOST_TURNS:
        raise ScenarioError(
            f"{session}: the drive takes {duration_s:.3g} s, {n_turns:.3g} revolutions at {rate_hz:g} Hz: at most "
            f"{_MOST_TURNS} are simulated: drive faster"
        )
    middle_s = true.time_s[0] + (np.arange(n_turns, dtype=np.float64) + 0.5) / rate_hz
    way_m = np.interp(middle_s, true.time_s, true.way_m)
    steps_m = np.diff(way_m)
    if platform.scan_spacing_m < steps_m.max(initial=0.0) * (1 - _SLACK):
        fastest = int(np.argmax(steps_m))
        speed_mps = steps_m[fastest] * rate_hz
        raise ScenarioError(
            f"{session}: platform.scan_spacing_m = {platform.scan_spacing_m:g}: at {speed_mps:.3g} m/s, "
            f"{way_m[fastest]:.1f} m along the way, and {rate_hz:g} Hz revolutions are {steps_m[fastest]:.3g} m apart: "
            "give at least that, or drive slower"
        )
    n_wanted = 1 + int(np.floor((way_m[-1] - way_m[0]) / platform.scan_spacing_m + _SLACK))
    wanted_m = way_m[0] + np.arange(n_wanted, dtype=np.float64) * platform.scan_spacing_m
    return np.asarray(middle_s[np.unique(np.minimum(np.searchsorted(way_m, wanted_m - _SLACK), n_turns - 1))])
