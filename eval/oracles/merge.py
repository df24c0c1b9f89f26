"""Merges from the truth, for upper bounds: results of the later stages where the merge is exact or off by E.

For every after keyframe j and its truly nearest before keyframe i, before_T_after(j) = odomB_T_i (true i_T_j) E
(odomA_T_j)^-1, so that `merge_error` at j is E alone. The pipeline's stages receive only the merged maps.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, Int64Array, invert, stream
from cdpipe.core.yamlfile import Settings
from cdpipe.model.alignment import PathAlignment
from cdpipe.model.types import MappedSession, MergedMaps
from eval.scoring.merge_metrics import PAIR_RADIUS_M
from eval.truth.ground_truth import SessionTruth

NO_SECONDS = {"t_index_s": 0.0, "t_merge_s": 0.0, "t_refine_s": 0.0}


class OracleMerge(Settings):
    """Error of the oracle's merge: E of every keyframe has this translation and this angle."""

    noise_m: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    noise_deg: Annotated[float, Field(ge=0, le=180)] = 0.0

    @property
    def settings(self) -> tuple[str, ...]:
        """The noise as `key=value`, both keys; nothing where there is none."""
        if self.noise_m == self.noise_deg == 0:
            return ()
        written = (np.format_float_positional(value, trim="-") for value in (self.noise_m, self.noise_deg))
        return tuple(f"{key}={value}" for key, value in zip(("noise_m", "noise_deg"), written, strict=True))


def merged_by_truth(
    before: MappedSession,
    after: MappedSession,
    truth: tuple[SessionTruth, SessionTruth],
    noise: OracleMerge,
    seed: int,
) -> MergedMaps:
    """Merge two mapped sessions by the truth, plus an error.

    Args:
        before: The before session.
        after: The after session.
        truth: Of both.
        noise: Size of the error; its direction and axis are drawn from (seed, "oracle-merge") and are constant in the
            map frame.
        seed: Seed of the pair.

    Returns:
        The maps with one alignment for each after keyframe as `local`, and that of the middle paired keyframe as
        `before_T_after`. An after keyframe is paired if a before keyframe lies within 5 m; others take the alignment
        of the nearest paired keyframe. The merge is refused where no keyframe is paired.
    """
    scans = before.descriptors.keyframe_scans, after.descriptors.keyframe_scans
    poses = before.map.odom_T_sensor, after.map.odom_T_sensor
    evidence = {"n_hypotheses": 0.0}
    found = align_by_truth(truth, poses, scans, noise, seed)
    if found is None:
        reason = f"by the truth no after keyframe has a before keyframe within {PAIR_RADIUS_M:g} m"
        return MergedMaps(before.map, after.map, np.eye(4), evidence, False, reason, None, NO_SECONDS)
    before_T_after, local = found
    return MergedMaps(before.map, after.map, before_T_after, evidence, True, local=local, seconds=NO_SECONDS)


def align_by_truth(
    truth: tuple[SessionTruth, SessionTruth],
    odom_T_sensor: tuple[Float64Array, Float64Array],
    scans: tuple[Int64Array, Int64Array],
    noise: OracleMerge,
    seed: int,
) -> tuple[Float64Array, PathAlignment] | None:
    """Return the true alignment of two sessions, plus an error; None where no two of the scans are near each other.

    Args:
        truth: Of the before and the after session.
        odom_T_sensor: (S, 4, 4) poses of every scan of either session, in the frame that is aligned.
        scans: (K,) scans of either session that are paired.
        noise: As in `merged_by_truth`.
        seed: Seed of the pair.

    Returns:
        (4, 4) before_T_after of the middle paired scan, and the alignment along the path.
    """
    scans_i, scans_j = scans
    world_T_i, world_T_j = truth[0].world_T_sensor[scans_i], truth[1].world_T_sensor[scans_j]
    distance_m, nearest = (np.asarray(found) for found in cKDTree(world_T_i[:, :3, 3]).query(world_T_j[:, :3, 3]))
    paired = np.flatnonzero(distance_m <= PAIR_RADIUS_M)
    if len(paired) == 0:
        return None
    i = nearest[paired]
    odom_T_i, odom_T_j = odom_T_sensor[0][scans_i[i]], odom_T_sensor[1][scans_j]
    map_T_j = odom_T_i @ invert(world_T_i[i]) @ world_T_j[paired]
    of_paired = _displaced(map_T_j, noise, seed) @ invert(odom_T_j[paired])
    _, taken = cKDTree(world_T_j[paired, :3, 3]).query(world_T_j[:, :3, 3])
    before_T_after = of_paired[np.asarray(taken)]
    before_T_after[paired] = of_paired  # of two keyframes at one place each keeps its own
    return before_T_after[paired[len(paired) // 2]], PathAlignment(odom_T_j[:, :3, 3], before_T_after)


def _displaced(map_T_j: Float64Array, noise: OracleMerge, seed: int) -> Float64Array:
    """Return the (P, 4, 4) poses, translated and rotated about their origins by constant vectors of the map frame."""
    draw = stream(seed, "oracle-merge")
    direction, axis = (vector / np.linalg.norm(vector) for vector in draw.normal(size=(2, 3)))
    turn = Rotation.from_rotvec(np.deg2rad(noise.noise_deg) * axis).as_matrix()
    displaced = map_T_j.copy()
    displaced[:, :3, :3] = turn @ map_T_j[:, :3, :3]
    displaced[:, :3, 3] += noise.noise_m * direction
    return displaced
