"""How well a descriptor of scans recognises places and headings, between two sessions of one tunnel.

Asked are the after keyframes with a before keyframe within 3 m in the world. A keyframe is recognised if the nearest of
all before descriptors is of a place within 3 m. The yaw is judged at true neighbours, so that it does not depend on the
place being found: the best peak of the two orientation vectors' correlation against the true relative yaw.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, require_poses
from cdpipe.descriptors import relative_yaws_rad
from cdpipe.model.types import DescriptorSet

SAME_PLACE_M = 3.0
FLIPPED_DEG = 90.0


@dataclass(frozen=True, slots=True, eq=False)
class PlaceOutcomes:
    """What became of the places of one pair of sessions.

    Attributes:
        found_m: (P,) how far the place that was found lies from each asked after keyframe, in the world.
        yaw_error_deg: (P,) absolute error of the yaw between each and its true neighbour; NaN where the orientation
            vectors have no peak, or the descriptor has none.
    """

    found_m: Float64Array
    yaw_error_deg: Float64Array

    @property
    def columns(self) -> dict[str, float]:
        """The figures; NaN where nothing was asked."""
        n = len(self.found_m)
        known_deg = self.yaw_error_deg[~np.isnan(self.yaw_error_deg)]
        return {
            "place_recall_at_1": float(np.mean(self.found_m <= SAME_PLACE_M)) if n else float("nan"),
            "yaw_error_deg": float(np.median(known_deg)) if len(known_deg) else float("nan"),
            "yaw_flip_share": float(np.mean(known_deg > FLIPPED_DEG)) if len(known_deg) else float("nan"),
            "n_places": float(n),
            "n_yaws": float(len(known_deg)),
        }


def place_outcomes(
    before: DescriptorSet, after: DescriptorSet, world_T_before: Float64Array, world_T_after: Float64Array
) -> PlaceOutcomes:
    """Look every after keyframe up among the before keyframes, and compare with the truth.

    Args:
        before: Descriptors of the before session's Kb keyframes.
        after: Descriptors of the after session's Ka keyframes, of the same kind.
        world_T_before: (Kb, 4, 4) true poses of the before keyframes.
        world_T_after: (Ka, 4, 4) true poses of the after keyframes.
    """
    require_poses("world_T_before", world_T_before)
    require_poses("world_T_after", world_T_after)
    if len(before.q) != len(world_T_before) or len(after.q) != len(world_T_after):
        raise ValueError(
            f"{len(before.q)} and {len(after.q)} descriptors for {len(world_T_before)} and {len(world_T_after)} poses"
        )
    if len(before.q) == 0 or len(after.q) == 0:
        return PlaceOutcomes(np.zeros(0), np.zeros(0))
    places_b, places_a = world_T_before[:, :3, 3], world_T_after[:, :3, 3]
    gaps_m, neighbours = cKDTree(places_b).query(places_a)
    j = np.flatnonzero(np.asarray(gaps_m) <= SAME_PLACE_M)
    i = np.asarray(neighbours)[j]
    found = np.asarray(cKDTree(before.q.astype(np.float64)).query(after.q[j].astype(np.float64))[1], dtype=np.int64)
    errors_deg = np.full(len(j), np.nan)
    if before.w is not None and after.w is not None and len(j):
        true_rad = _heading_rad(world_T_after[j]) - _heading_rad(world_T_before[i])
        off_rad = relative_yaws_rad(before.w[i], after.w[j], n=1)[:, 0] - true_rad
        errors_deg = np.abs(np.rad2deg(np.angle(np.exp(1j * off_rad))))
    return PlaceOutcomes(np.linalg.norm(places_b[found] - places_a[j], axis=1), errors_deg)


def place_scores(
    before: DescriptorSet, after: DescriptorSet, world_T_before: Float64Array, world_T_after: Float64Array
) -> dict[str, float]:
    """Return recall at 1, median yaw error and share of flipped yaws of one pair; arguments as `place_outcomes`."""
    return place_outcomes(before, after, world_T_before, world_T_after).columns


def _heading_rad(poses: Float64Array) -> Float64Array:
    return np.asarray(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
