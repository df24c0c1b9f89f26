"""The alignment of an answer: where the places of the after session lie in the map frame."""

from __future__ import annotations

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, require_poses
from cdpipe.model.alignment import PathAlignment
from cdpipe.model.report import ChangeReport


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
