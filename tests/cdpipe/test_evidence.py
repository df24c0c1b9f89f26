from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cdpipe.config import MergeConfig
from cdpipe.evidence import MapCheck, Place, sphere_fit, why_refused
from cdpipe.geometry import Float64Array, make_pose
from cdpipe.types import MappedSession

CONFIG = MergeConfig(sphere_radius_m=10.0, inlier_m=0.3, voxel_m=0.1)


def floor(half_m: float = 12.0, step_m: float = 0.5) -> Float64Array:
    axis = np.arange(-half_m, half_m + 1e-9, step_m)
    return np.stack(np.meshgrid(axis, axis, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)


def shifted(points: Float64Array, x_m: float = 0.0, z_m: float = 0.0) -> Float64Array:
    return points + np.array([x_m, 0.0, z_m])


def place(after_points: Float64Array) -> Place:
    return Place(floor(), after_points, np.zeros(3), np.zeros(3), 0.0)


@pytest.mark.parametrize(("lift_m", "share"), [(0.0, 1.0), (0.29, 1.0), (0.31, 0.0)])
def test_a_lifted_floor_fits_up_to_the_inlier_distance(lift_m: float, share: float) -> None:
    found_share, residual_m = sphere_fit(place(floor()), make_pose(translation=(0, 0, lift_m)), CONFIG)
    assert found_share == share
    assert residual_m == pytest.approx(lift_m)


def test_both_directions_count_alike() -> None:
    # the after map has a second storey 1 m up: its points miss, those of the before map all fit
    both = np.concatenate([floor(), shifted(floor(), z_m=1.0)])
    n = [np.count_nonzero(np.linalg.norm(shifted(floor(), z_m=lift), axis=1) <= 9.7) for lift in (0, 1)]
    share, _ = sphere_fit(place(both), make_pose(), CONFIG)
    assert share == pytest.approx((n[0] / (n[0] + n[1]) + 1.0) / 2)


def test_spheres_that_do_not_meet_have_no_inliers() -> None:
    share, residual_m = sphere_fit(place(floor(2.0)), make_pose(translation=(300.0, 0, 0)), CONFIG)
    assert (share, residual_m) == (0.0, np.inf)


def test_overlap_counts_the_after_map_within_a_metre(tunnel_before: MappedSession) -> None:
    # 22 points on a line against 11 of them: the 11 and the one at -0.9 m lie within a metre
    line = np.column_stack([np.arange(11.0) * 2, np.zeros(11), np.zeros(11)])
    before = replace(tunnel_before.map, points=line)
    after = replace(tunnel_before.map, points=np.concatenate([line, shifted(line, x_m=-20.9)]))
    assert MapCheck(before, after).overlap(make_pose()) == 12 / 22
    assert MapCheck(before, after).overlap(make_pose(translation=(0, 0, 1.5))) == 0.0


def test_agreement_asks_along_both_paths_and_only_where_both_were(tunnel_before: MappedSession) -> None:
    same = tunnel_before.map
    assert MapCheck(same, same).agreement(make_pose()) == 1.0
    assert MapCheck(same, same).agreement(make_pose(translation=(500.0, 0, 0))) == 0.0
    # a session that saw the first half alone agrees with one that saw all of it
    x_m, middle_m = same.points[:, 0], np.median(same.points[:, 0])
    is_driven = same.odom_T_keyframe[:, 0, 3] < middle_m - 6.0
    half = replace(same, points=same.points[x_m <= middle_m], keyframe_scans=same.keyframe_scans[is_driven])
    assert MapCheck(same, half).agreement(make_pose()) == 1.0
    # lifted by 0.6 m the floor misses, and it was seen from both paths
    assert MapCheck(same, same).agreement(make_pose(translation=(0, 0, 0.6))) < 0.93


def test_reasons_in_plain_words() -> None:
    config = MergeConfig(min_inlier_share=0.9, min_hessian_ratio=0.01)
    assert why_refused({"inlier_share": 0.9, "hessian_ratio": 0.01}, config) == ""
    assert why_refused({"inlier_share": 0.5, "hessian_ratio": 0.0}, config).startswith("only 50% of the points")
    alike = {"inlier_share": 1.0, "hessian_ratio": 0.1, "agreement": 0.75}
    assert "only 75% of the points do" in why_refused(alike, config)
    assert why_refused({**alike, "agreement": 0.965}, config) == ""
    assert "two places that look alike" in why_refused({**alike, "agreement": 0.95}, config)
    assert "0.0050" in why_refused({"inlier_share": 1.0, "hessian_ratio": 0.005}, config)
