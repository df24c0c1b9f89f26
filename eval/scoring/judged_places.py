"""What an answer says of the places at which every answer is judged, whatever keyframes it names itself.

The places are the scans at every metre of each session's odometry (`SessionTruth.judged_scans`). A method that names
few keyframes, or only those that it is sure of, is judged on the same places as every other method.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, Int64Array, travelled_m
from cdpipe.model.report import ChangeReport
from eval.truth.ground_truth import SessionTruth

# A keyframe speaks for this much path to either side: half of the widest spacing in plan `ablation`, and a step.
COVERED_M = 2.5
_TIE_M = 1e-6  # scans of a robot at rest lie at one place: the one nearer in time is taken


def find_nearest_keyframes(session: SessionTruth, keyframe_scans: Int64Array) -> tuple[Int64Array, Float64Array]:
    """Return, for each of the J judged places of a session, the nearest named keyframe along the path.

    Args:
        session: The session.
        keyframe_scans: (K,) scans that the answer names; if it names none, every scan is a keyframe.

    Returns:
        (J,) indices into the keyframes, and (J,) metres of path between place and keyframe.
    """
    path_m = travelled_m(session.odom_T_sensor)
    named = keyframe_scans if len(keyframe_scans) else np.arange(len(path_m))
    positions = np.column_stack([path_m, _TIE_M * np.arange(len(path_m))])
    _, nearest = cKDTree(positions[named]).query(positions[session.judged_scans])
    return np.asarray(nearest, dtype=np.int64), np.abs(path_m[named[nearest]] - path_m[session.judged_scans])


def carry_scores(report: ChangeReport | None, before: SessionTruth) -> Float64Array:
    """Return (J,) the keyframe score at each judged place of the before session; NaN where the answer states none.

    A place takes the score of the nearest keyframe, up to 2.5 m of path away. NaN ranks below every number.
    """
    if report is None or len(report.regions.keyframe_scores) == 0:
        return np.full(len(before.judged_scans), np.nan)
    nearest, gaps_m = find_nearest_keyframes(before, report.keyframe_scans[0])
    return np.where(gaps_m <= COVERED_M, report.regions.keyframe_scores[nearest], np.nan)


def carry_merge(report: ChangeReport, after: SessionTruth) -> Float64Array:
    """Return the merge at the judged places of the after session: (4, 4) for all, or (J, 4, 4) for each.

    A place takes the local alignment of the nearest keyframe, however far it is.
    """
    if report.local_before_T_after is None:
        return report.before_T_after
    nearest, _ = find_nearest_keyframes(after, report.keyframe_scans[1])
    return report.local_before_T_after[nearest]
