"""The alignment of an answer: where the places of the after session lie in the map frame."""

from __future__ import annotations

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, Int64Array, invert, require_poses
from cdpipe.model.alignment import PathAlignment
from cdpipe.model.report import ChangeReport

# Most by which odometry errs between two keyframes that has not lost its way: KISS-ICP by 0.7 m in a sharp turn.
LEAP_M = 1.0
_DRIFT_SHARE = 0.05  # of the way between two keyframes: drift, and bends of it


def alignment_of(report: ChangeReport, after_odom_T_sensor: Float64Array) -> PathAlignment:
    """Return the alignment of the after odom frame in the map frame, as a report states it.

    Args:
        report: The answer; its merge is rigid, or given at each after keyframe (at each scan where it names none).
        after_odom_T_sensor: (S, 4, 4) pose of every scan of the after session.

    Raises:
        InputError: The report's local merge is not rigid poses, or does not fit the session.
    """
    local = report.local_before_T_after
    if local is None:
        return PathAlignment.rigid(report.before_T_after)
    scans = report.keyframe_scans[1] if len(report.keyframe_scans[1]) else np.arange(len(after_odom_T_sensor))
    n_scans = len(after_odom_T_sensor)
    if len(local) != len(scans) or not len(scans) or scans.min() < 0 or scans.max() >= n_scans:
        raise InputError(
            f"the answer's local_before_T_after has {len(local)} poses for {len(scans)} of {n_scans} scans "
            "of the after session: is it an answer to this pair?"
        )
    try:
        require_poses("local_before_T_after", local)
    except ValueError as error:
        raise InputError(f"the answer's {error}") from error
    return PathAlignment(after_odom_T_sensor[scans, :3, 3], local)


def merge_at_scans(report: ChangeReport, scans: Int64Array) -> Float64Array:
    """Return the (N, 4, 4) merge that a report states at each of (N,) after scans: that at the nearest keyframe.

    Where an odometry lost its way, its path lies over itself: there the scan tells the merge, and the place does not.
    """
    local, keyframes = report.local_before_T_after, report.keyframe_scans[1]
    if local is None:
        return np.broadcast_to(report.before_T_after, (len(scans), 4, 4))
    if len(keyframes) == 0:
        return local[scans]
    order = np.argsort(keyframes)
    between = (keyframes[order][1:] + keyframes[order][:-1]) / 2
    return np.asarray(local[order[np.searchsorted(between, scans)]])


def is_torn(report: ChangeReport, after_odom_T_sensor: Float64Array) -> bool:
    """Return whether the after odometry lost its way: between two places of the merge it errs by more than a metre."""
    scans = aligned_scans(report, len(after_odom_T_sensor))
    if report.local_before_T_after is None or len(scans) < 2:
        return False
    odom_T_keyframe = after_odom_T_sensor[scans]
    map_T_keyframe = merge_at_scans(report, scans) @ odom_T_keyframe
    recorded, found = (invert(each[:-1]) @ each[1:] for each in (odom_T_keyframe, map_T_keyframe))
    err_m = np.linalg.norm(recorded[:, :3, 3] - found[:, :3, 3], axis=1)
    return bool(np.any(err_m > LEAP_M + _DRIFT_SHARE * np.linalg.norm(recorded[:, :3, 3], axis=1)))


def aligned_scans(report: ChangeReport, n_scans: int) -> Int64Array:
    """Return the after scans at which a report states its merge, in order: its keyframes, all where it names none."""
    named = report.keyframe_scans[1]
    return np.sort(named) if len(named) else np.arange(n_scans)
