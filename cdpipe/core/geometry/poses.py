"""Poses, and points and paths that they move."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry.arrays import Float64Array, require_shape

FARTHEST_M = 1e7  # a quarter of the way around the Earth: nothing lies farther from its origin


def require_poses(name: str, poses: npt.NDArray[Any]) -> None:
    """Raise `ValueError` unless `poses` is (N, 4, 4), finite and rigid to 1e-6."""
    require_shape(name, poses, (None, 4, 4))
    finite = np.isfinite(poses).all(axis=(1, 2))
    if not finite.all():
        raise ValueError(f"{name}[{int(np.argmin(finite))}] is not finite")
    rotations = poses[:, :3, :3]
    defect = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    rigid = (defect < 1e-6) & (np.linalg.det(rotations) > 0) & (poses[:, 3] == (0, 0, 0, 1)).all(axis=1)
    if not rigid.all():
        raise ValueError(f"{name}[{int(np.argmin(rigid))}] is not a rigid transform")


def make_pose(rotation: npt.ArrayLike | None = None, translation: npt.ArrayLike = (0.0, 0.0, 0.0)) -> Float64Array:
    """Return (..., 4, 4) poses from (..., 3, 3) rotations (identity by default) and (..., 3) translations in metres."""
    translation = np.asarray(translation, dtype=np.float64)
    poses = np.zeros((*translation.shape[:-1], 4, 4))
    poses[..., :3, :3] = np.eye(3) if rotation is None else rotation
    poses[..., :3, 3] = translation
    poses[..., 3, 3] = 1.0
    return poses


def yaw_pose(yaw_rad: float, translation: npt.ArrayLike = (0.0, 0.0, 0.0)) -> Float64Array:
    """Return the (4, 4) pose with a rotation by `yaw_rad` about z and a translation in metres."""
    return make_pose(Rotation.from_euler("z", yaw_rad).as_matrix(), translation)


def invert(poses: Float64Array) -> Float64Array:
    """Return the inverse of one (4, 4) pose or of a stack (..., 4, 4)."""
    rotations = np.swapaxes(poses[..., :3, :3], -1, -2)
    return make_pose(rotations, -(rotations @ poses[..., :3, 3:])[..., 0])


def transform(dst_T_src: Float64Array, points: Float64Array) -> Float64Array:
    """Return (N, 3) points of frame src in frame dst."""
    return points @ dst_T_src[:3, :3].T + dst_T_src[:3, 3]


def transform_each(dst_T_src: Float64Array, points: Float64Array) -> Float64Array:
    """Transform each of (N, 3) points by its own pose of (N, 4, 4) from frame src into frame dst."""
    moved = np.einsum("nij,nj->ni", dst_T_src[:, :3, :3], points) + dst_T_src[:, :3, 3]
    return np.asarray(moved, dtype=np.float64)


def fit_rigid(positions: Float64Array, dst_T_src: Float64Array) -> Float64Array:
    """Return the (4, 4) rigid transform that best fits several local transforms.

    Each transform moves its position and three points 5 m along the axes; the fit is least squares over all of them.
    The extra points determine the roll on a straight path.

    Args:
        positions: (A, 3) where each transform holds, source frame, metres.
        dst_T_src: (A, 4, 4) local transforms.
    """
    probes = positions[:, None] + np.concatenate([np.zeros((1, 3)), 5.0 * np.eye(3)])[None]
    moved = np.einsum("aij,apj->api", dst_T_src[:, :3, :3], probes) + dst_T_src[:, None, :3, 3]
    source, target = probes.reshape(-1, 3), moved.reshape(-1, 3)
    source_centre, target_centre = source.mean(axis=0), target.mean(axis=0)
    u, _, v = np.linalg.svd((target - target_centre).T @ (source - source_centre))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v
    return make_pose(rotation, target_centre - rotation @ source_centre)


def yaw_rad(pose: Float64Array) -> float:
    """Return the heading of a (4, 4) pose: the angle of its x axis in the x-y plane, in (-pi, pi]."""
    return float(np.arctan2(pose[1, 0], pose[0, 0]))


def travelled_m(poses: Float64Array) -> Float64Array:
    """Return the (N,) path length from the first of (N, 4, 4) poses to each of them, metres."""
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def plane_jacobian(offsets: Float64Array, normals: Float64Array) -> Float64Array:
    """Return the (N, 6) derivative of each point's displacement along its normal by rotation, then translation.

    Args:
        offsets: (N, 3) points relative to the centre of rotation.
        normals: (N, 3) normals in the same axes.
    """
    (x, y, z), (a, b, c) = offsets.T, normals.T
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a, a, b, c], axis=1)
