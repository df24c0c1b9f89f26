"""How much of the before path an answer compares: where the after session came near, as the answer aligns them."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, transform_each
from cdpipe.merge.walk import SHARED_M
from cdpipe.model.aligned import alignment_of, merge_at_scans
from cdpipe.model.report import ChangeReport, Coverage


def measure_coverage(
    report: ChangeReport, before_odom_T_sensor: Float64Array, after_odom_T_sensor: Float64Array
) -> Coverage:
    """Return how much of the before path the after session came near.

    A scan of the before session is near if a scan of the after session lies within 5 m of it, aligned as the answer
    states: the distance that evidence `overlap` uses. A step between two scans is compared if both are near. A way that
    was driven twice counts twice.

    Args:
        report: The answer.
        before_odom_T_sensor: (S, 4, 4) pose of every scan of the before session, as recorded.
        after_odom_T_sensor: (T, 4, 4) the same of the after session.

    Raises:
        InputError: The answer is not one to these sessions.
    """
    scans = report.keyframe_scans[0]
    if len(scans) and scans.max() >= len(before_odom_T_sensor):
        raise InputError(
            f"the answer names scan {scans.max()} of the before session, which has {len(before_odom_T_sensor)}: "
            "is it an answer to this pair?"
        )
    before = before_odom_T_sensor[:, :3, 3]
    alignment_of(report, after_odom_T_sensor)  # or it is an answer to another pair
    local = merge_at_scans(report, np.arange(len(after_odom_T_sensor)))
    after = transform_each(local, after_odom_T_sensor[:, :3, 3])
    distances_m, _ = cKDTree(after).query(before, distance_upper_bound=SHARED_M)
    is_near = np.isfinite(distances_m)
    steps_m = np.linalg.norm(np.diff(before, axis=0), axis=1)
    is_compared = is_near[1:] & is_near[:-1]
    return Coverage(float(steps_m[is_compared].sum()), float(steps_m[~is_compared].sum()), is_near)
