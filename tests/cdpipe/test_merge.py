from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cdpipe.config import MergeConfig
from cdpipe.geometry import Float64Array, invert, make_pose, rotation_angle_rad, stream, transform, yaw_pose
from cdpipe.merge import closest_pairs, merge_maps, pair_support, register
from cdpipe.ply import read_ply_points
from cdpipe.types import DescriptorSet, MappedSession

FINE = MergeConfig(voxel_m=0.25)


def map_error_m(found: Float64Array, true: Float64Array, points_after: Float64Array) -> float:
    """Largest displacement of any point of the after map."""
    return float(np.linalg.norm(transform(found, points_after) - transform(true, points_after), axis=1).max())


def moved(session: MappedSession, new_T_old: Float64Array) -> MappedSession:
    point_map = replace(
        session.map,
        points=transform(new_T_old, session.map.points),
        odom_T_sensor=new_T_old @ session.map.odom_T_sensor,
    )
    return MappedSession(point_map, session.descriptors)


def test_the_true_transform_is_found(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array
) -> None:
    merged = merge_maps(tunnel_before, tunnel_after, FINE)
    assert merged.is_accepted
    assert merged.reason == ""
    assert map_error_m(merged.before_T_after, true_before_T_after, tunnel_after.map.points) < 0.05
    assert merged.evidence["inlier_share"] > 0.97
    assert merged.evidence["overlap"] > 0.97
    assert merged.evidence["residual_m"] < 0.1
    assert merged.evidence["n_hypotheses"] == 1


def test_refining_on_the_whole_map_does_no_harm(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array
) -> None:
    merged = merge_maps(tunnel_before, tunnel_after, FINE.model_copy(update={"refine_map": True}))
    assert merged.is_accepted
    assert map_error_m(merged.before_T_after, true_before_T_after, tunnel_after.map.points) < 0.05
    assert merged.evidence["overlap"] >= merged.evidence["overlap_before_refinement"]


def test_moving_both_sessions_moves_the_answer(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array
) -> None:
    g, h = yaw_pose(-2.1, (400.0, -90.0, 7.0)), yaw_pose(1.3, (-50.0, 800.0, -3.0))
    merged = merge_maps(moved(tunnel_before, g), moved(tunnel_after, h), FINE)
    expected = g @ true_before_T_after @ invert(h)
    assert map_error_m(merged.before_T_after, expected, transform(h, tunnel_after.map.points)) < 0.05


def test_the_same_input_gives_the_same_bits(tunnel_before: MappedSession, tunnel_after: MappedSession) -> None:
    one, other = (merge_maps(tunnel_before, tunnel_after, MergeConfig()) for _ in range(2))
    np.testing.assert_array_equal(one.before_T_after, other.before_T_after)
    assert one.evidence == other.evidence


def test_without_orientation_vectors_quarter_turns_are_tried(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array
) -> None:
    blind = [MappedSession(s.map, replace(s.descriptors, w=None)) for s in (tunnel_before, tunnel_after)]
    turned = MappedSession(moved(blind[1], yaw_pose(2.0)).map, blind[1].descriptors)
    merged = merge_maps(blind[0], turned, FINE)
    assert merged.is_accepted
    assert map_error_m(merged.before_T_after, true_before_T_after @ yaw_pose(-2.0), turned.map.points) < 0.05


def test_another_tunnel_is_refused_with_a_reason(tunnel_before: MappedSession, other_tunnel: MappedSession) -> None:
    merged = merge_maps(tunnel_before, other_tunnel, MergeConfig())
    assert not merged.is_accepted
    assert "the sessions may not overlap" in merged.reason
    assert merged.evidence["inlier_share"] < 0.9
    assert merged.evidence["n_hypotheses"] >= MergeConfig().n_candidates


def test_a_smooth_straight_corridor_is_refused_because_it_slides(tunnel_before: MappedSession) -> None:
    sessions = []
    for sample in (0, 1):
        rng = stream(sample, "corridor")
        along, section = rng.uniform(-20, 20, 60_000), rng.uniform(-1, 1, (60_000, 2))
        wall = rng.integers(0, 2, 60_000)
        section[np.arange(60_000), wall] = np.sign(section[np.arange(60_000), wall])
        points = np.column_stack([along, 3 * section]) + rng.normal(0, 0.01, (60_000, 3))
        poses = np.array([make_pose(translation=(x, 0, 0)) for x in (-1.0, 0.0, 1.0)])
        point_map = replace(
            tunnel_before.map,
            points=points,
            odom_T_sensor=poses,
            keyframe_scans=np.arange(3),
            scan_offsets=np.zeros(4, np.int64),
        )
        q = np.eye(3, 64, dtype=np.float32)
        sessions.append(MappedSession(point_map, DescriptorSet(q, None, np.arange(3), "place", "")))
    merged = merge_maps(*sessions, MergeConfig())
    assert not merged.is_accepted
    assert "can slide" in merged.reason
    assert merged.evidence["inlier_share"] > 0.9
    assert merged.evidence["hessian_ratio"] < 0.005


def test_maps_too_small_to_register_are_refused(tunnel_before: MappedSession) -> None:
    no_keyframe = replace(
        tunnel_before.descriptors,
        q=np.zeros((0, 64), np.float32),
        w=np.zeros((0, 64), np.float32),
        keyframe_scans=np.zeros(0, np.int64),
    )
    few_points = replace(tunnel_before.map, points=tunnel_before.map.points[:1])
    for after in (
        MappedSession(tunnel_before.map, no_keyframe),
        MappedSession(few_points, tunnel_before.descriptors),
    ):
        merged = merge_maps(tunnel_before, after, MergeConfig())
        assert not merged.is_accepted
        assert "enough points" in merged.reason
        np.testing.assert_array_equal(merged.before_T_after, np.eye(4))


def test_only_right_pairs_support_one_another() -> None:
    # three right pairs, turned by 90 degrees and moved; two wrong ones
    before = np.array([[0.0, 0, 0], [10, 0, 0], [25, 5, 0], [40, 0, 0], [7, 0, 0]])
    after = transform(yaw_pose(np.pi / 2, (100, 50, 1)), before)
    after[3:] = [[130.0, 20, 0], [101, 95, 0]]
    assert pair_support(before, after).tolist() == [3, 3, 3, 1, 1]
    # 2 m and 1 % of the distance are tolerated, more is not
    line = np.array([[0.0, 0, 0], [100, 0, 0]])
    for stretch_m, n in ((2.9, 2), (3.2, 1)):
        assert pair_support(line, line + np.array([[0.0, 0, 0], [stretch_m, 0, 0]])).tolist() == [n, n]


def test_pairs_are_nearest_in_descriptor_space_and_apart(
    tunnel_before: MappedSession, tunnel_after: MappedSession
) -> None:
    pairs = closest_pairs(tunnel_before, tunnel_after, MergeConfig(n_candidates=4))
    assert len(pairs) == 4
    q_before, q_after = tunnel_before.descriptors.q, tunnel_after.descriptors.q
    all_distances = np.linalg.norm(q_before[:, None] - q_after[None], axis=2)
    for i, j, distance in pairs:
        assert distance == pytest.approx(all_distances[i, j], abs=1e-6)
        assert distance == pytest.approx(all_distances[:, j].min(), abs=1e-6)
    # keyframes are a metre apart on a tunnel without loops: half a sphere is five of them
    before_keyframes = sorted(i for i, _, _ in pairs)
    assert min(np.diff(before_keyframes)) >= 4


def test_the_real_pair_is_solved() -> None:
    if "TUNNELCD_REAL_DATA" not in os.environ:
        pytest.skip("TUNNELCD_REAL_DATA is unset: the real registration pair is not at hand")
    folder = Path(os.environ["TUNNELCD_REAL_DATA"]) / "registration_pair"
    source, target = read_ply_points(folder / "source.ply"), read_ply_points(folder / "target.ply")
    true = np.loadtxt(folder / "T_target_source.txt")
    found = register(source, target, np.eye(4), MergeConfig())
    error = invert(true) @ found.target_T_source
    assert np.linalg.norm(error[:3, 3]) < 0.02
    assert np.degrees(rotation_angle_rad(error)) < 0.5
