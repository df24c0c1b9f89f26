"""Check of a trajectory against the scans: the order of its quaternions, its direction, and the frame of the scans."""

from __future__ import annotations

import warnings

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.geometry import Float64Array, invert, make_pose, transform
from cdpipe.model.types import ScanSource

# Pairs of scans that are compared: how many, how far apart in the order of scans, and the least turn between them.
_N_PAIRS, _FARTHEST_SCANS, _LEAST_TURN_DEG, _LEAST_PAIRS = 5, 40, 8.0, 2
_N_QUERIES, _N_POINTS = 1500, 15_000
# Another way fits this many times better, and fits: metres.
_TIMES_BETTER, _FITS_M = 2.5, 0.3
# Scans that are registered already fit worse by any of these turns about the vertical.
_TURNS_DEG = (-20.0, -10.0, -5.0, 5.0, 10.0, 20.0)


def check_poses(source: ScanSource, where: str) -> None:
    """Refuse quaternions in the order w, x, y, z, inverse poses, and scans that are registered already.

    Turns between poses are the same in either order, so only the scans tell: pairs that the trajectory turns against
    each other are laid over one another with the poses as they are, as they would be otherwise, and not moved at all.
    Neighbours in a drift lie well on one another unmoved, whatever is wrong with the poses; they are said to be
    registered only if every turn makes them fit worse.

    Args:
        source: The scans, with the poses as they were read.
        where: The trajectory, for the message.

    Raises:
        InputError: The scans fit much better in another way. An `InputWarning`: unmoved, and no way explains it.
    """
    poses = source.odom_T_sensor
    pairs = _turned_pairs(poses)
    if len(pairs) < _LEAST_PAIRS:
        return
    ways = (poses, swap_quaternions(poses), invert(poses))
    found = []
    for one, other in pairs:
        fixed, moving = source.scan(one).points_sensor, source.scan(other).points_sensor
        tree = cKDTree(fixed[:: max(1, len(fixed) // _N_POINTS)])
        moved = [_misfit_m(tree, moving, invert(each[one]) @ each[other]) for each in ways]
        turned = [_misfit_m(tree, moving, _turn_about(moving, degrees)) for degrees in (0.0, *_TURNS_DEG)]
        found.append([*moved, turned[0], min(turned[1:])])
    given_m, swapped_m, inverted_m, unmoved_m, turned_m = np.median(np.array(found), axis=0)
    fits_m = min(_FITS_M, given_m / _TIMES_BETTER)
    if min(swapped_m, inverted_m, unmoved_m) >= fits_m:
        return
    apart = f"{where}: the scans lie {given_m:.2f} m apart with "
    if unmoved_m <= min(swapped_m, inverted_m) and unmoved_m < turned_m:
        raise InputError(
            f"{apart}these poses, {unmoved_m:.2f} m as they are: they look registered already, in the frame of the "
            "poses: give them in the frame of the sensor; or are the angles or lengths of the poses in another unit?"
        )
    if swapped_m < fits_m and swapped_m <= inverted_m:
        raise InputError(
            f"{apart}its quaternions as qx qy qz qw, {swapped_m:.2f} m as qw qx qy qz: they look like qw first: move "
            "that column to the end"
        )
    if inverted_m < fits_m:
        raise InputError(
            f"{apart}these poses, {inverted_m:.2f} m with the inverse ones: give those of the sensor in the frame of "
            "the map, and not of the map in the frame of the sensor"
        )
    text = f"{apart}these poses, {unmoved_m:.2f} m without any: are they of these scans, in metres, with angles in the"
    warnings.warn(f"{text} unit that the header says?", InputWarning, stacklevel=3)


def swap_quaternions(poses: Float64Array) -> Float64Array:
    """Return poses (N, 4, 4) as if the numbers of their quaternions x, y, z, w were w, x, y, z."""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return make_pose(Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix(), poses[:, :3, 3])


def _turned_pairs(poses: Float64Array) -> list[tuple[int, int]]:
    """Return pairs of scans, spread over the session, that are turned against each other and near in time."""
    found = []
    for one in np.unique(np.linspace(0, len(poses) - 1, 8 * _N_PAIRS).astype(int)):
        near = poses[one + 1 : one + 1 + _FARTHEST_SCANS, :3, :3]
        if not len(near):
            break
        turns = Rotation.from_matrix(poses[one, :3, :3]).inv() * Rotation.from_matrix(near)
        is_turned = np.degrees(turns.magnitude()) > _LEAST_TURN_DEG
        if is_turned.any():
            found.append((int(one), int(one + 1 + np.argmax(is_turned))))
    # the nearer half: what two scans see of the same rock shrinks with the way between them
    found = sorted(sorted(found, key=lambda pair: pair[1] - pair[0])[: max(_N_PAIRS, len(found) // 2)])
    return [found[each] for each in np.unique(np.linspace(0, len(found) - 1, _N_PAIRS).astype(int))] if found else []


def _turn_about(points: Float64Array, degrees: float) -> Float64Array:
    """Return the (4, 4) turn about the vertical through the median of some points."""
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    middle = np.median(points, axis=0)
    return make_pose(turn, middle - turn @ middle)


def _misfit_m(fixed: cKDTree, moving: Float64Array, fixed_T_moving: Float64Array) -> float:
    """Return the median distance of the moved points to the nearest fixed one, metres."""
    placed = transform(fixed_T_moving, moving[:: max(1, len(moving) // _N_QUERIES)])
    return float(np.median(fixed.query(placed)[0]))
