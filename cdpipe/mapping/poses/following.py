"""Poses of scans, each found from its neighbour's, and the odometry mended where it lost its way.

KISS-ICP expects each scan where the last motion would lead. Where a robot turns by 60 degrees between two scans and
then drives straight on, it may find no counterpart and spin on to the end. Its steps are wrong from there, and so are
scans that they deskewed. A scan that the odometry lays beside the walls is therefore looked for anew (`_find_again`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

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
    moved_m,
    orthonormal,
    register_scan,
    sample_rows,
)
from cdpipe.model.types import PosedScan

# A scan is followed in the map of the scans within this way behind it, which is made anew once per metre.
_BEHIND_M, _RENEWED_M = 10.0, 1.0
FOLLOWING = Registration(voxel_m=0.3, correspondence_m=1.0, robust_m=0.2, step_m=0.2, step_rad=0.02)
# A scan is looked for anew if so many more of its points are off the walls than of the scans before it: of 99 scans in
# 100 with poses of KISS-ICP 0.05 are, of those that it lays 0.8 m off 0.2 and more. It is found where half as many are,
# and so many more of all points lie on walls.
_OFF_SHARE, _GAIN = 0.1, 0.1
_USUAL_SCANS = 20
# The step to a scan that is found anew is wrong if the odometry errs by more. A scan before a wrong step is half
# deskewed by it, and the step to it is right.
_WRONG_M = 0.1
_SEEKING = Registration(voxel_m=0.3, correspondence_m=2.0, robust_m=0.5, step_m=0.5, step_rad=0.5)
_HEADINGS = 18


def follow(scans: Samples, on_scan: Callable[[], None]) -> tuple[Float64Array, BoolArray]:
    """Return the (S, 4, 4) poses of scans, and which (S - 1,) steps of the odometry are wrong.

    Each scan is found from its neighbour, from one on that keeps its recorded pose. Scans to which a step is wrong are
    deskewed anew in `scans`, if times tell how.

    Args:
        scans: The scans.
        on_scan: Called after each.
    """
    found, path_m = scans.odometry.copy(), scans.path_m
    n, start = len(found), _choose_start(scans)
    is_wrong = np.zeros(n - 1, dtype=np.bool_)
    for way in (range(start + 1, n), range(start - 1, -1, -1)):
        target, made_m, misfits = None, np.inf, deque([0.0], _USUAL_SCANS)
        for index in way:
            last = index - way.step
            guess = found[last] @ invert(scans.odometry[last]) @ scans.odometry[index]
            if target is None or abs(path_m[index] - made_m) >= _RENEWED_M:
                behind = np.arange(start, index, way.step)
                near = behind[np.abs(path_m[behind] - path_m[index]) <= _BEHIND_M]
                made_m = path_m[index]
                target = Target(scans, found, near if len(near) else behind[-1:], guess[:3, 3], FOLLOWING.voxel_m)
            at = register_scan(scans.of_scan(index), guess, [guess], target, FOLLOWING)
            if at.misfit > np.median(misfits) + _OFF_SHARE:  # where all scans are off, none is looked for
                again = _find_again(scans, found, last, guess, index, target)
                if again.on_share > at.on_share + _GAIN and again.misfit < at.misfit / 2:
                    at, is_wrong[min(last, index)] = again, moved_m(guess[None], again.pose[None])[0] > _WRONG_M
                    scans.replace(index, _deskewed(scans, scans.source.scan(index), found, last, at.pose).points_sensor)
            misfits.append(at.misfit)
            found[index] = at.pose
            on_scan()
    return found, is_wrong


def _choose_start(scans: Samples) -> int:
    """Return the middle scan, or one at an eighth of the session if the odometry is lost in the middle.

    It is one with which the next scan agrees. The middle it is, too, where there is none.
    """
    n = len(scans.odometry)
    for eighth in (4, 2, 6, 1, 7, 3, 5):
        start = min(n * eighth // 8, n - 2)
        target = Target(scans, scans.odometry, np.array([start]), scans.odometry[start, :3, 3], FOLLOWING.voxel_m)
        guess = scans.odometry[start + 1]
        at = register_scan(scans.of_scan(start + 1), guess, [guess], target, FOLLOWING)
        if at.misfit <= _OFF_SHARE:
            return start
    return n // 2


def _find_again(
    scans: Samples, found: Float64Array, last: int, predicted: Float64Array, index: int, target: Target
) -> Registered:
    """Return the pose that lays most points of a scan on the walls, deskewed by the motion from the last scan to it.

    It is looked for at the pose that the odometry predicts, where the last motion leads, and at the last scan, with all
    headings if need be.
    """
    scan, before = scans.source.scan(index), 2 * last - index
    scan = scan.keep(sample_rows(scan.points_sensor)[1])

    def registered(guess: Float64Array) -> Registered:
        for settings in (_SEEKING, FOLLOWING):
            points = _deskewed(scans, scan, found, last, guess).points_sensor
            at = register_scan(points, guess, [guess], target, settings)
            guess = at.pose
        return at

    moving = found[last] @ invert(found[before]) @ found[last] if 0 <= before < len(found) else found[last]
    moving = orthonormal(moving[None])[0]  # rounding would double from scan to scan
    best = max(map(registered, (predicted, moving, found[last])), key=lambda at: at.on_share)
    if best.misfit <= _OFF_SHARE:
        return best
    headings = Rotation.from_euler("z", np.arange(1, _HEADINGS)[:, None] * 360.0 / _HEADINGS, degrees=True).as_matrix()
    turned = make_pose(headings @ found[last, :3, :3], np.repeat(found[last, None, :3, 3], len(headings), axis=0))
    return max([best, *map(registered, turned)], key=lambda at: at.on_share)


def _deskewed(scans: Samples, scan: PosedScan, found: Float64Array, last: int, pose: Float64Array) -> PosedScan:
    """Return a scan, deskewed by the motion between the pose of its neighbour and a pose of its own."""
    if scans.motion is None:
        return scan
    time_s, poses = scans.motion.time_s[[last, scan.index]], np.stack([found[last], pose])
    order = np.argsort(time_s)
    return deskew_anew(scan, scans.motion, motion_through(time_s[order], poses[order]))


@dataclass(frozen=True, slots=True, eq=False)
class Mended:
    """An odometry that lost its way, mended.

    Attributes:
        is_deskewed_anew: (S,) scans at both ends of the wrong steps.
        motion: That through the recorded poses; None where it deskewed no points.
    """

    is_deskewed_anew: BoolArray
    motion: Motion | None

    def deskewed(self, scan: PosedScan, poses: Float64Array) -> PosedScan:
        """Return a scan as the motion through (S, 4, 4) poses deskews it, if the odometry was lost there.

        Then it tells no mist: nobody knows when its airborne returns were seen.
        """
        if self.motion is None or not self.is_deskewed_anew[scan.index]:
            return scan
        around = slice(max(scan.index - 1, 0), scan.index + 2)
        anew = deskew_anew(scan, self.motion, motion_through(self.motion.time_s[around], poses[around]))
        return replace(anew, airborne_sensor=None)


def mend_odometry(scans: Samples, found: Float64Array, is_wrong: BoolArray) -> Mended:
    """Mend the wrong steps of the odometry, and deskew the scans at both ends of these anew.

    Args:
        scans: The scans; their odometry and points change.
        found: (S, 4, 4) poses of `follow`.
        is_wrong: (S - 1,) steps that are wrong.
    """
    steps, odometry = invert(scans.odometry[:-1]) @ scans.odometry[1:], scans.odometry.copy()
    steps[is_wrong] = (invert(found[:-1]) @ found[1:])[is_wrong]
    for index, step in enumerate(steps):
        odometry[index + 1] = odometry[index] @ step
    at_ends = np.append(is_wrong, False) | np.append(False, is_wrong)
    mended = Mended(at_ends, scans.motion)
    scans.mend(odometry)
    for index in np.flatnonzero(at_ends).tolist():
        scans.replace(index, mended.deskewed(scans.source.scan(index), found).points_sensor)
    return mended
