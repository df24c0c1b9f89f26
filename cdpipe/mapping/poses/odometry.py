"""Odometry from the revolutions of a session: KISS-ICP (arXiv 2209.15397), or GenZ-ICP (`genz`)."""

# ruff: noqa: PLC0415 - both are extras, and everybody else must be able to import this

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import BoolArray, Float64Array, invert, travelled_m
from cdpipe.core.geometry.motion import Motion, make_motion, rotation_matrices
from cdpipe.core.isolation import ProcessDiedError, run_isolated
from cdpipe.sensor.air import find_clear_pixels
from cdpipe.sensor.ouster import SensorMetadata

# Smaller than KISS-ICP's defaults, which are for streets: a drift is 4 to 9 m wide.
_VOXEL_M = 0.5
_MAX_RANGE_M = 50.0
_POINTS_PER_VOXEL = 20
_FIRST_THRESHOLD_M = 2.0
_LEAST_MOTION_M = 0.1
_MAX_ITERATIONS = 500
_CONVERGED = 1e-4
# Name of an odometry -> the extra that installs it.
ODOMETRIES = {"kiss-icp": "odometry", "genz-icp": "genz"}
_GENZ = "genz-icp"
Image = tuple[npt.NDArray[np.uint32], npt.NDArray[np.uint16]]


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """A scan before it is deskewed.

    Attributes:
        deskew: Returns its points (N, 3), deskewed at a velocity (6,): metres and radians a second.
        flatten: Returns its points (N, 3), metres, and the time (N,) of each after the stamp, seconds; (0,) for none.
    """

    deskew: Callable[[Float64Array], Float64Array]
    flatten: Callable[[], tuple[Float64Array, Float64Array]]


def estimate_motion(
    revolutions: Iterable[Image],
    sensor: SensorMetadata,
    revolution_s: Float64Array,
    column_s: Float64Array,
    odom_T_first: Float64Array,
    odometry: str = "kiss-icp",
) -> Motion:
    """Return the motion that an odometry estimates, with one sample at the middle column of each revolution.

    Each revolution is first deskewed to its middle column at the velocity of the preceding step. The odometry's own
    deskewing is off, because it assumes revolutions without gaps. A single revolution gives a motion at rest.
    Returns of mist and dust are left out (`cdpipe.sensor.air`): they travel with the sensor, so it would seem to
    stand.

    Args:
        revolutions: For each the staggered ranges (R, W), millimetres, R as in a session, 0 for a miss, and the
            signal (R, W), photons, all 0 if there is none.
        sensor: Beam table.
        revolution_s: (S,) time of each middle column.
        column_s: (W,) time of each column after the middle one.
        odom_T_first: (4, 4) pose of the first revolution, the origin of the estimated frame.
        odometry: One of `ODOMETRIES`.

    Raises:
        InputError: A pose is not finite, or the process of GenZ-ICP died.
    """
    frames = (
        _columns_frame(sensor.project(range_mm / 1000.0), _is_clear(range_mm, signal, sensor), column_s)
        for range_mm, signal in revolutions
    )
    poses = _register(frames, revolution_s, "revolution", odometry)
    odom_T_sensor = odom_T_first @ poses
    if len(odom_T_sensor) == 1:
        odom_T_sensor = np.repeat(odom_T_sensor, 2, axis=0)
        revolution_s = revolution_s + np.array([0.0, 1.0])
    positions, rotations = odom_T_sensor[:, :3, 3], Rotation.from_matrix(odom_T_sensor[:, :3, :3])
    return make_motion(revolution_s, travelled_m(odom_T_sensor), positions, rotations)


def estimate_cloud_motion(
    clouds: Iterable[tuple[Float64Array, Float64Array | None]], stamps_s: Float64Array, odometry: str = "kiss-icp"
) -> Float64Array:
    """Return the poses (S, 4, 4) that an odometry estimates for clouds of any sensor; the first is the identity.

    Args:
        clouds: For each scan its points (N, 3), metres, and the time (N,) of each after the stamp, seconds; None where
            they are deskewed or have no times.
        stamps_s: (S,) rising time of each scan.
        odometry: One of `ODOMETRIES`.

    Raises:
        InputError: A pose is not finite, or the process of GenZ-ICP died.
    """
    return _register((cloud_frame(points, time_s) for points, time_s in clouds), stamps_s, "scan", odometry)


def _is_clear(range_mm: npt.NDArray[np.uint32], signal: npt.NDArray[np.uint16], sensor: SensorMetadata) -> BoolArray:
    return find_clear_pixels(range_mm, signal, range_mm.size // 2 if len(range_mm) == 2 * sensor.height else None)


def _columns_frame(points: Float64Array, is_hit: BoolArray, column_s: Float64Array) -> _Frame:
    return _Frame(
        lambda twist: deskew_at_constant_velocity(points, twist[:3], twist[3:], column_s)[is_hit],
        lambda: (points[is_hit], np.broadcast_to(column_s, is_hit.shape)[is_hit]),
    )


def cloud_frame(points: Float64Array, time_s: Float64Array | None) -> _Frame:
    """Return the frame of (N, 3) points with the time (N,) of each after the stamp, or deskewed ones without times."""
    if time_s is None:
        return _Frame(lambda twist: points, lambda: (points, np.zeros(0)))
    return _Frame(
        lambda twist: deskew_at_constant_velocity(points[None], twist[:3], twist[3:], time_s)[0],
        lambda: (points, time_s),
    )


def _register(frames: Iterable[_Frame], stamps_s: Float64Array, what: str, odometry: str) -> Float64Array:
    """Return the pose (S, 4, 4) of each frame."""
    if odometry != _GENZ:
        return register_frames(_kiss_icp(), "KISS-ICP", frames, stamps_s, what)
    from cdpipe.mapping.poses.genz import register_stored, stored_scan

    with TemporaryDirectory(prefix="tunnelcd-") as folder:
        for number, frame in enumerate(frames):
            points, time_s = frame.flatten()
            np.savez(stored_scan(Path(folder), number), allow_pickle=False, points=points, time_s=time_s)
        stored = {"folder": folder, "stamps_s": stamps_s.tolist(), "what": what}
        try:
            return np.asarray(run_isolated(register_stored, stored))
        except ProcessDiedError as death:
            raise InputError(
                f"the process of GenZ-ICP died ({death}) before {len(stamps_s)} {what}s were registered, as it does "
                "without memory: take --odometry kiss-icp"
            ) from death


def register_frames(icp: Any, name: str, frames: Iterable[_Frame], stamps_s: Float64Array, what: str) -> Float64Array:
    """Return the pose (S, 4, 4) of each frame, which is deskewed at the velocity (6,) of the preceding step.

    Args:
        icp: The odometry, which has `register_frame` and `last_pose`.
        name: What it is called.
        frames: The scans in order.
        stamps_s: (S,) rising time of each.
        what: What a scan is called.

    Raises:
        InputError: A pose is not finite.
    """
    poses = np.tile(np.eye(4), (len(stamps_s), 1, 1))
    twist = np.zeros(6)
    for number, frame in enumerate(frames):
        icp.register_frame(np.ascontiguousarray(frame.deskew(twist)), np.zeros(0))
        poses[number] = icp.last_pose
        if not np.isfinite(poses[number]).all():
            raise InputError(f"{name} has no finite pose for {what} {number}, {stamps_s[number]:.1f} s on the way")
        if number + 1 < len(stamps_s) and number > 0:
            elapsed_s = stamps_s[number] - stamps_s[number - 1]
            delta = invert(poses[number - 1]) @ poses[number]
            twist = np.concatenate([delta[:3, 3], Rotation.from_matrix(delta[:3, :3]).as_rotvec()]) / elapsed_s
    return poses


def deskew_at_constant_velocity(
    points: Float64Array, velocity_mps: Float64Array, turn_rad_s: Float64Array, column_s: Float64Array
) -> Float64Array:
    """Return the (H, W, 3) points of a revolution, each column in its own frame, in the frame of the middle column.

    Args:
        points: (H, W, 3) points, metres.
        velocity_mps: (3,) velocity, sensor frame, m/s.
        turn_rad_s: (3,) angular velocity as a rotation vector, rad/s.
        column_s: (W,) time of each column after the middle one.
    """
    matrices = rotation_matrices(Rotation.from_rotvec(column_s[:, None] * turn_rad_s).as_quat())
    turned = [sum(matrices[:, row, axis] * points[..., axis] for axis in range(3)) for row in range(3)]
    return np.stack(turned, axis=-1) + column_s[:, None] * velocity_mps


def _kiss_icp() -> Any:
    """Return KISS-ICP with every setting explicit, so that its environment variables have no effect."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.config.config import AdaptiveThresholdConfig, DataConfig, MappingConfig, RegistrationConfig
    from kiss_icp.kiss_icp import KissICP

    return KissICP(
        KISSConfig(
            data=DataConfig(max_range=_MAX_RANGE_M, min_range=0.0, deskew=False),
            mapping=MappingConfig(voxel_size=_VOXEL_M, max_points_per_voxel=_POINTS_PER_VOXEL),
            registration=RegistrationConfig(
                max_num_iterations=_MAX_ITERATIONS,
                convergence_criterion=_CONVERGED,
                max_num_threads=1,  # deterministic summation order
            ),
            adaptive_threshold=AdaptiveThresholdConfig(
                fixed_threshold=None, initial_threshold=_FIRST_THRESHOLD_M, min_motion_th=_LEAST_MOTION_M
            ),
        )
    )
