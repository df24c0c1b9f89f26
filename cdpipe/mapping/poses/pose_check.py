"""Check of a trajectory against the scans: the order of its quaternions, and the frame that the scans are in."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, invert, make_pose, transform
from cdpipe.model.types import ScanSource

# Pairs of scans that are compared: how many, how far apart in the order of scans, and the least turn between them.
_N_PAIRS, _FARTHEST_SCANS, _LEAST_TURN_DEG, _LEAST_PAIRS = 5, 40, 8.0, 2
_N_QUERIES, _N_POINTS = 1500, 15_000
# The other order fits this many times better, and fits: metres.
_TIMES_BETTER, _FITS_M = 2.5, 0.3


def check_poses(source: ScanSource, where: str) -> None:
    """Refuse quaternions in the order w, x, y, z where x, y, z, w is expected, and scans that are registered already.

    Turns between poses are the same in both orders, so only the scans tell: pairs that the trajectory turns against
    each other are laid over one another with the poses as they are, as they would be in the other order, and not moved
    at all.

    Args:
        source: The scans, with the poses as they were read.
        where: The trajectory, for the message.

    Raises:
        InputError: The scans fit much better in the other order, or where they are.
    """
    poses = source.odom_T_sensor
    swapped, unmoved = swap_quaternions(poses), np.broadcast_to(np.eye(4), poses.shape)
    pairs = list(islice(_turned_pairs(poses), _N_PAIRS))
    if len(pairs) < _LEAST_PAIRS:
        return
    found = []
    for one, other in pairs:
        fixed, moving = source.scan(one).points_sensor, source.scan(other).points_sensor
        ways = (poses, swapped, unmoved)
        found.append([_misfit_m(fixed, moving, invert(each[one]) @ each[other]) for each in ways])
    given_m, swapped_m, unmoved_m = np.median(np.array(found), axis=0)
    best_m = min(swapped_m, unmoved_m)
    if best_m >= _FITS_M or given_m <= _TIMES_BETTER * best_m:
        return
    if unmoved_m <= swapped_m:
        raise InputError(
            f"{where}: the scans lie {given_m:.2f} m apart with these poses, {unmoved_m:.2f} m as they are: they look "
            "registered already, in the frame of the poses: give them in the frame of the sensor"
        )
    raise InputError(
        f"{where}: the scans lie {given_m:.2f} m apart with its quaternions as qx qy qz qw, {swapped_m:.2f} m as "
        "qw qx qy qz: they look like qw first: move that column to the end"
    )


def swap_quaternions(poses: Float64Array) -> Float64Array:
    """Return poses (N, 4, 4) as if the numbers of their quaternions x, y, z, w were w, x, y, z."""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return make_pose(Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix(), poses[:, :3, 3])


def _turned_pairs(poses: Float64Array) -> Iterator[tuple[int, int]]:
    """Yield pairs of scans, spread over the session, that are turned against each other and near in time."""
    for one in np.unique(np.linspace(0, len(poses) - 1, 8 * _N_PAIRS).astype(int)):
        near = poses[one + 1 : one + 1 + _FARTHEST_SCANS, :3, :3]
        if not len(near):
            return
        turns = Rotation.from_matrix(poses[one, :3, :3]).inv() * Rotation.from_matrix(near)
        is_turned = np.degrees(turns.magnitude()) > _LEAST_TURN_DEG
        if is_turned.any():
            yield int(one), int(one + 1 + np.argmax(is_turned))


def _misfit_m(fixed: Float64Array, moving: Float64Array, fixed_T_moving: Float64Array) -> float:
    """Return the median distance of the moved points to the nearest fixed one, metres."""
    tree = cKDTree(fixed[:: max(1, len(fixed) // _N_POINTS)])
    placed = transform(fixed_T_moving, moving[:: max(1, len(moving) // _N_QUERIES)])
    return float(np.median(tree.query(placed)[0]))
