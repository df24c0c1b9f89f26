"""Poses of scans, each found from its neighbour's, and the odometry mended where it lost its way.

KISS-ICP expects each scan where the last motion would lead. Where a robot turns by 60 degrees between two scans and
then drives straight on, it may find no counterpart and spin on to the end. Its steps are wrong from there, and so are
scans that they deskewed. A scan that the odometry lays beside the walls is therefore looked for anew, from the motion
of the poses found so far, from rest, and with all headings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import BoolArray, Float64Array, invert, make_pose
from cdpipe.core.geometry.motion import Motion
from cdpipe.mapping.deskew import deskew_anew
from cdpipe.mapping.poses.scan_registration import (
    Registered,
    Registration,
    Samples,
    Target,
    motion_through,
    orthonormal,
    register_scan,
    sample_points,
)
from cdpipe.model.types import PosedScan

# A scan is followed in the map of the scans within this way behind it, which is made anew once per metre.
_BEHIND_M, _RENEWED_M = 10.0, 1.0
FOLLOWING = Registration(voxel_m=0.3, correspondence_m=1.0, robust_m=0.2, step_m=0.2, step_rad=0.02)
# A scan is looked for anew if so many of its points are off the walls: 0.05 at most of 99 scans in 100 with poses of
# KISS-ICP, 0.2 and more where that is off by 0.8 m. It is found if so many more of all points lie on walls there.
_OFF_SHARE, _GAIN = 0.1, 0.1
_SEEKING = Registration(voxel_m=0.3, correspondence_m=2.0, robust_m=0.5, step_m=0.5, step_rad=0.5)
_HEADINGS = 18
# So many scans more are looked for in vain than are found: a scan takes a second, and some recordings agree nowhere.
_IN_VAIN = 10


def follow(scans: Samples, on_scan: Callable[[], None]) -> tuple[Float64Array, BoolArray]:
    """Return the (S, 4, 4) poses of scans, and which (S,) scans the odometry lost.

    Each is found from its neighbour's; the middle scan keeps its recorded pose. Lost ones are deskewed anew.

    Args:
        scans: The scans.
        on_scan: Called after each.
    """
    found, path_m = scans.odometry.copy(), scans.path_m
    n, middle = len(found), len(found) // 2
    is_lost = np.zeros(n, dtype=np.bool_)
    n_sought = 0
    for way in (range(middle + 1, n), range(middle - 1, -1, -1)):
        target, made_m = None, np.inf
        for index in way:
            last = index - way.step
            guess = found[last] @ invert(scans.odometry[last]) @ scans.odometry[index]
            if target is None or abs(path_m[index] - made_m) >= _RENEWED_M:
                behind = np.arange(middle, index, way.step)
                near = behind[np.abs(path_m[behind] - path_m[index]) <= _BEHIND_M]
                made_m = path_m[index]
                target = Target(scans, found, near if len(near) else behind[-1:], guess[:3, 3], FOLLOWING.voxel_m)
            at = register_scan(scans.of_scan(index), guess, [guess], target, FOLLOWING)
            is_off = at.off_share > _OFF_SHARE or at.on_share == 0
            if is_off and n_sought < 2 * np.count_nonzero(is_lost) + _IN_VAIN:
                n_sought += 1
                again = _find_again(scans, found, last, index, target)
                is_better = at.on_share == 0 or again.off_share < at.off_share / 2  # loose points lie off anywhere
                if is_better and again.on_share > at.on_share + _GAIN:
                    at, is_lost[index] = again, True
                    scans.replace(index, _deskew(scans, scans.source.scan(index), found[last], last, at.pose))
            found[index] = at.pose
            on_scan()
    return found, is_lost


def _find_again(scans: Samples, found: Float64Array, last: int, index: int, target: Target) -> Registered:
    """Return the pose that lays most points of a scan on the walls, deskewed by the motion from the last scan to it."""
    scan, before = scans.source.scan(index), 2 * last - index

    def registered(guess: Float64Array) -> Registered:
        for settings in (_SEEKING, FOLLOWING):
            points = sample_points(_deskew(scans, scan, found[last], last, guess))[1]
            at = register_scan(points, guess, [guess], target, settings)
            guess = at.pose
        return at

    moving = found[last] @ invert(found[before]) @ found[last] if 0 <= before < len(found) else found[last]
    moving = orthonormal(moving[None])[0]  # rounding would double from scan to scan
    best = max(map(registered, (moving, found[last])), key=lambda at: at.on_share)
    if best.off_share <= _OFF_SHARE:
        return best
    headings = Rotation.from_euler("z", np.arange(1, _HEADINGS)[:, None] * 360.0 / _HEADINGS, degrees=True).as_matrix()
    turned = make_pose(headings @ found[last, :3, :3], np.repeat(found[last, None, :3, 3], len(headings), axis=0))
    return max([best, *map(registered, turned)], key=lambda at: at.on_share)


def _deskew(scans: Samples, scan: PosedScan, last_pose: Float64Array, last: int, pose: Float64Array) -> Float64Array:
    """Return the (N, 3) points of a scan, deskewed by the motion between its neighbour's pose and one of its own."""
    if scans.motion is None:
        return scan.points_sensor
    time_s, poses = scans.motion.time_s[[last, scan.index]], np.stack([last_pose, pose])
    order = np.argsort(time_s)
    return deskew_anew(scan, scans.motion, motion_through(time_s[order], poses[order])).points_sensor


@dataclass(frozen=True, slots=True, eq=False)
class Mended:
    """An odometry that lost its way, mended.

    Attributes:
        is_turned: (S,) scans that the recorded motion deskewed otherwise.
        motion: The recorded motion; None where it deskewed none.
    """

    is_turned: BoolArray
    motion: Motion | None

    def deskewed(self, scan: PosedScan, poses: Float64Array) -> PosedScan:
        """Return a scan as the motion through (S, 4, 4) poses deskews it, if the odometry was lost there."""
        if self.motion is None or not self.is_turned[scan.index]:
            return scan
        around = slice(max(scan.index - 1, 0), scan.index + 2)
        return deskew_anew(scan, self.motion, motion_through(self.motion.time_s[around], poses[around]))


def mend_odometry(scans: Samples, found: Float64Array, is_lost: BoolArray) -> Mended:
    """Mend the steps of the odometry to lost scans, and deskew the scans at both ends of these anew.

    Args:
        scans: The scans; their odometry and points change.
        found: (S, 4, 4) poses of `follow`.
        is_lost: (S,) scans that are lost.
    """
    n, middle, lost = len(found), len(found) // 2, np.flatnonzero(is_lost)
    wrong = lost - (lost > middle)  # steps; each scan was found from its neighbour on the side of the middle
    steps, odometry = invert(scans.odometry[:-1]) @ scans.odometry[1:], scans.odometry.copy()
    steps[wrong] = invert(found[wrong]) @ found[wrong + 1]
    for index in range(middle + 1, n):
        odometry[index] = odometry[index - 1] @ steps[index - 1]
    for index in range(middle - 1, -1, -1):
        odometry[index] = odometry[index + 1] @ invert(steps[index])
    is_turned = np.zeros(n, dtype=np.bool_)
    is_turned[[*wrong, *(wrong + 1)]] = True
    mended = Mended(is_turned, scans.motion)
    scans.mend(odometry)
    for index in np.flatnonzero(is_turned).tolist():
        scans.replace(index, mended.deskewed(scans.source.scan(index), found).points_sensor)
    return mended
