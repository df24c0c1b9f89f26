"""The merge that a method of others is given: by the truth, or by `tunnelcd`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from cdpipe.core.errors import MergeFailedError
from cdpipe.core.geometry import Float64Array
from cdpipe.io.known_merge import write_alignment
from cdpipe.model.alignment import PathAlignment
from cdpipe.model.config import load_config
from eval.oracles.merge import OracleMerge, align_by_truth
from eval.running.stages.pair_stages import PairStages
from eval.truth.ground_truth import GroundTruth

MergeMode = Literal["given", "ours", "own"]
PRESET = "tunnelcd"


def write_merge(path: Path, mode: MergeMode, stages: PairStages, truth: GroundTruth) -> None:
    """Write the merge of a pair that a method is given; nothing where it brings its own.

    Args:
        path: The file.
        mode: "given" by the truth, at every metre of the after path; "ours" as preset `tunnelcd` merges; or "own".
        stages: The pair.
        truth: Its truth.

    Raises:
        MergeFailedError: No part of the paths is near the other, or `tunnelcd` refuses the merge.
    """
    if mode == "given":
        before_T_after, along = _merge_by_truth(truth)
        write_alignment(path, before_T_after, along, "truth")
    elif mode == "ours":
        report = stages.answer(load_config(PRESET), until="merge")
        along = PathAlignment.rigid(report.before_T_after)
        if report.local_before_T_after is not None:
            scans = report.keyframe_scans[1]
            along = PathAlignment(truth.after.odom_T_sensor[scans, :3, 3], report.local_before_T_after)
        write_alignment(path, report.before_T_after, along, PRESET)


def _merge_by_truth(truth: GroundTruth) -> tuple[Float64Array, PathAlignment]:
    sessions = truth.before, truth.after
    poses = truth.before.odom_T_sensor, truth.after.odom_T_sensor
    judged = truth.before.judged_scans, truth.after.judged_scans
    found = align_by_truth(sessions, poses, judged, OracleMerge(), truth.pair.seed)
    if found is None:
        raise MergeFailedError("by the truth no part of the after path is near the before path", {})
    return found
