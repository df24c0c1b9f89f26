from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.geometry import Float64Array, invert, make_pose, stream, transform, yaw_pose
from cdpipe.io.ply import read_ply_points
from cdpipe.merge import merge
from cdpipe.merge.candidates import first_keyframes
from cdpipe.merge.evidence import explain_refusal, measure_fit
from cdpipe.merge.global_registration import is_kiss_matcher_installed
from cdpipe.merge.hypotheses import Hypothesis, Start, judge
from cdpipe.merge.merge import merge_maps, take_known_merge
from cdpipe.merge.registration import IndexedMap, register
from cdpipe.merge.walk import Walk
from cdpipe.model.config import MergeConfig, load_config
from cdpipe.model.types import DescriptorSet, MappedSession, MergedMaps
from cdpipe.pipeline import detect
from tests.cdpipe.conftest import AFTER_ODOM_T_WORLD, CloudScans, bend, mapped, tunnel_points

CONFIG = MergeConfig(fallback=False)
Bend = Callable[[MappedSession, float], tuple[MappedSession, Float64Array]]
FRAME = load_config("frame").merge


def map_error_m(found: Float64Array, true: Float64Array, points_after: Float64Array) -> float:
    """Largest displacement of any point of the after map."""
    return float(np.linalg.norm(transform(found, points_after) - transform(true, points_after), axis=1).max())


def moved(session: MappedSession, new_T_old: Float64Array) -> MappedSession:
    assert session.map.seen_from is not None
    point_map = replace(
        session.map,
        points=transform(new_T_old, session.map.points),
        seen_from=transform(new_T_old, session.map.seen_from).astype(np.float32),
        odom_T_sensor=new_T_old @ session.map.odom_T_sensor,
    )
    return MappedSession(point_map, session.descriptors)


def path_error_m(merged: MergedMaps, true: Float64Array) -> float:
    """Largest displacement of any point of the after path."""
    path = merged.after.odom_T_sensor[:, :3, 3]
    return float(np.linalg.norm(merged.alignment.to_map(path) - transform(true, path), axis=1).max())


def test_the_true_transform_is_found(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array
) -> None:
    merged = merge_maps(tunnel_before, tunnel_after, CONFIG)
    assert merged.is_accepted
    assert merged.reason == ""
    assert map_error_m(merged.before_T_after, true_before_T_after, tunnel_after.map.points) < 0.05
    assert path_error_m(merged, true_before_T_after) < 0.02
    assert merged.evidence["inlier_share"] > 0.95
    assert merged.evidence["agreement"] > 0.95
    assert merged.evidence["overlap"] == 1.0
    assert merged.evidence["residual_m"] < 0.03
    assert merged.evidence["n_hypotheses"] == 1
    assert merged.evidence["is_fallback"] == 0
    assert set(merged.seconds) == {"t_index_s", "t_merge_s", "t_refine_s"}


def test_a_long_map_is_indexed_where_it_is_looked_at(
    tunnel_before: MappedSession, tunnel_after: MappedSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = CONFIG.model_copy(update={"refine": "none", "first_every": 2})
    whole = merge_maps(tunnel_before, tunnel_after, config)
    made: list[IndexedMap] = []

    class Recorded(IndexedMap):
        def __init__(self, *args: Any, **settings: Any) -> None:
            super().__init__(*args, **settings)
            made.append(self)

    monkeypatch.setattr(merge, "IndexedMap", Recorded)
    monkeypatch.setattr(merge, "_LONG_M", 1.0)
    merged = merge_maps(tunnel_before, tunnel_after, config)
    assert merged.is_accepted and whole.is_accepted
    assert map_error_m(merged.before_T_after, whole.before_T_after, tunnel_after.map.points) < 1e-3
    assert merged.evidence == pytest.approx(whole.evidence, rel=1e-2)
    before, after = made
    assert before.local_s > 0 and after.local_s > 0
    with pytest.raises(ValueError, match="not indexed as a target"):
        _ = before.target  # the whole was never indexed
    # far off the map the nearest point may be anywhere
    nearest, squared_m2 = after.nearest_near(np.full(3, 500.0), 1.0, np.full((1, 3), 500.0))
    apart_m = np.linalg.norm(after.points - 500.0, axis=1)
    np.testing.assert_allclose(np.sqrt(squared_m2), apart_m.min())
    np.testing.assert_array_equal(nearest[0], after.points[apart_m.argmin()])
    merge_maps(tunnel_before, tunnel_after, CONFIG.model_copy(update={"refine": "none"}))
    assert made[2].target is not None and made[2].local_s == 0.0  # as published: at once


def test_the_other_keyframes_are_described_only_after_a_refusal(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array
) -> None:
    config = CONFIG.model_copy(update={"refine": "none", "first_every": 3})
    asked: list[str] = []

    def first_only(session: MappedSession, name: str, *, is_after: bool, is_wrong: bool = False) -> MappedSession:
        whole, q = session.descriptors, np.zeros_like(session.descriptors.q)
        rows = first_keyframes(len(q), config.first_every, is_after)
        q[rows] = whole.q[rows[::-1]] if is_wrong else whole.q[rows]

        def rest() -> DescriptorSet:
            asked.append(name)
            return whole

        return MappedSession(session.map, replace(whole, q=q), rest)

    before = first_only(tunnel_before, "before", is_after=False)
    merged = merge_maps(before, first_only(tunnel_after, "after", is_after=True), config)
    assert merged.is_accepted and asked == []
    assert map_error_m(merged.before_T_after, true_before_T_after, tunnel_after.map.points) < 0.1
    # the same from the vectors of all keyframes: laziness changes nothing
    known = merge_maps(tunnel_before, tunnel_after, config)
    np.testing.assert_array_equal(known.before_T_after, merged.before_T_after)
    # where the first keyframes mislead, all decide, as if none had been compared first
    misled = merge_maps(before, first_only(tunnel_after, "after", is_after=True, is_wrong=True), config)
    assert misled.is_accepted and asked == ["before", "after"]
    at_once = merge_maps(tunnel_before, tunnel_after, config.model_copy(update={"first_every": 1}))
    np.testing.assert_array_equal(misled.before_T_after, at_once.before_T_after)
    assert misled.evidence["n_hypotheses"] > at_once.evidence["n_hypotheses"]


def test_without_refinement_one_transform_holds_everywhere(
    tunnel_before: MappedSession, tunnel_after: MappedSession
) -> None:
    merged = merge_maps(tunnel_before, tunnel_after, CONFIG.model_copy(update={"refine": "none"}))
    assert merged.is_accepted
    assert merged.local is None
    assert "n_refined" not in merged.evidence
    assert merged.seconds["t_refine_s"] == 0.0


def test_maps_that_bend_apart_are_aligned_along_the_path(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array, bent: Bend
) -> None:
    # the after odometry turns by 2 degrees over its 52 m: no single transform is nearer than decimetres at both ends
    drifting, true_at = bent(tunnel_after, np.deg2rad(2.0))
    merged = merge_maps(tunnel_before, drifting, CONFIG)
    assert merged.is_accepted
    path = drifting.map.odom_T_keyframe[:, :3, 3]
    true_path = transform(true_before_T_after, np.einsum("kij,kj->ki", true_at[:, :3, :3], path) + true_at[:, :3, 3])
    errors_m = np.linalg.norm(merged.alignment.to_map(path) - true_path, axis=1)
    rigid_m = np.linalg.norm(transform(merged.before_T_after, path) - true_path, axis=1)
    assert rigid_m.max() > 0.1
    assert np.percentile(errors_m, 95) < 0.05


def test_a_start_where_the_tunnel_was_filled_up_is_judged_by_the_rest_of_the_path(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array
) -> None:
    points, start = tunnel_after.map.points.copy(), len(tunnel_after.map.keyframe_scans) // 2
    centre = tunnel_after.map.odom_T_keyframe[start, :3, 3]
    is_near = np.linalg.norm(points - centre, axis=1) < 5.5
    floor_m = transform(AFTER_ODOM_T_WORLD, np.zeros((1, 3)))[0, 2]
    points[is_near & (points[:, 2] < floor_m + 1.0), 2] += 0.7
    filled = replace(tunnel_after.map, points=points)
    maps = IndexedMap(tunnel_before.map, CONFIG, is_target=True), IndexedMap(filled, CONFIG, is_target=False)
    at_start = measure_fit(*maps, true_before_T_after, points[is_near], centre, 5.5).inlier_share(CONFIG.inlier_m)
    assert at_start < 0.7
    evidence = judge(Start(start, true_before_T_after, {}), maps, CONFIG).evidence
    assert evidence["inlier_share"] > 0.9 and explain_refusal(evidence, CONFIG) == ""


def test_frame_as_published_takes_whatever_it_finds(tunnel_before: MappedSession, other_tunnel: MappedSession) -> None:
    merged = merge_maps(tunnel_before, other_tunnel, FRAME)
    assert merged.is_accepted
    assert merged.local is None
    assert merged.evidence["n_hypotheses"] == 1
    assert explain_refusal(merged.evidence, CONFIG)


def test_frame_finds_the_tunnel_too(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array
) -> None:
    merged = merge_maps(tunnel_before, tunnel_after, FRAME)
    assert map_error_m(merged.before_T_after, true_before_T_after, tunnel_after.map.points) < 0.3


@pytest.mark.skipif(not is_kiss_matcher_installed(), reason="needs the extra `kiss`: KISS-Matcher")
def test_what_is_refused_is_left_to_kiss_matcher(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array
) -> None:
    # descriptors that name the wrong places, too far off for any registration
    wrong = replace(tunnel_after.descriptors, q=np.roll(tunnel_after.descriptors.q, 26, axis=0), w=None)
    lost = MappedSession(tunnel_after.map, wrong)
    assert not merge_maps(tunnel_before, lost, CONFIG).is_accepted
    merged = merge_maps(tunnel_before, lost, MergeConfig())
    assert merged.is_accepted
    assert (merged.evidence["is_fallback"], merged.evidence["kiss_matcher"]) == (1, 1)
    # who is not asked leaves no trace
    assert "kiss_matcher" not in merge_maps(tunnel_before, tunnel_after, MergeConfig()).evidence
    assert "kiss_matcher" not in merge_maps(tunnel_before, lost, CONFIG).evidence
    assert path_error_m(merged, true_before_T_after) < 0.02


def test_without_the_extra_the_refusal_says_what_was_not_tried(
    tunnel_before: MappedSession, other_tunnel: MappedSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cdpipe.merge.merge.is_kiss_matcher_installed", lambda: False)
    merged = merge_maps(tunnel_before, other_tunnel, MergeConfig())
    assert not merged.is_accepted
    assert "pip install 'tunnelcd[kiss]'" in merged.reason
    assert merged.evidence["kiss_matcher"] == 0


def test_moving_both_sessions_moves_the_answer(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array
) -> None:
    g, h = yaw_pose(-2.1, (400.0, -90.0, 7.0)), yaw_pose(1.3, (-50.0, 800.0, -3.0))
    merged = merge_maps(moved(tunnel_before, g), moved(tunnel_after, h), CONFIG)
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
    merged = merge_maps(blind[0], turned, CONFIG)
    assert merged.is_accepted
    assert map_error_m(merged.before_T_after, true_before_T_after @ yaw_pose(-2.0), turned.map.points) < 0.05


def test_another_tunnel_is_refused_with_a_reason(tunnel_before: MappedSession, other_tunnel: MappedSession) -> None:
    merged = merge_maps(tunnel_before, other_tunnel, CONFIG)
    assert not merged.is_accepted
    assert "merge.min_" in merged.reason
    assert merged.local is None
    assert merged.evidence["agreement"] < 0.6


def test_a_smooth_straight_corridor_is_refused_because_it_slides(tunnel_before: MappedSession) -> None:
    sessions, along_m = [], np.arange(-9.0, 10.0, 3.0)
    for sample in (0, 1):
        rng = stream(sample, "corridor")
        along, section = rng.uniform(-20, 20, 60_000), rng.uniform(-1, 1, (60_000, 2))
        wall = rng.integers(0, 2, 60_000)
        section[np.arange(60_000), wall] = np.sign(section[np.arange(60_000), wall])
        points = np.column_stack([along, 3 * section]) + rng.normal(0, 0.01, (60_000, 3))
        poses = np.array([make_pose(translation=(x, 0, 0)) for x in along_m])
        point_map = replace(
            tunnel_before.map,
            points=points,
            nearest_m=np.full(len(points), 3.0, np.float32),
            odom_T_sensor=poses,
            keyframe_scans=np.arange(len(poses)),
            scan_offsets=np.zeros(len(poses) + 1, np.int64),
            seen_from=None,
        )
        q = np.eye(len(poses), 64, dtype=np.float32)
        sessions.append(MappedSession(point_map, DescriptorSet(q, None, np.arange(len(poses)), "place", "")))
    merged = merge_maps(*sessions, CONFIG)
    assert not merged.is_accepted
    assert "both_ways_m" not in merged.evidence  # judged along its path: one place of a smooth drift has its own test
    assert "can slide" in merged.reason
    assert merged.evidence["inlier_share"] > 0.9
    assert merged.evidence["hessian_ratio"] < CONFIG.min_hessian_ratio


def test_maps_too_small_to_register_are_refused(tunnel_before: MappedSession) -> None:
    no_keyframe = replace(
        tunnel_before.descriptors,
        q=np.zeros((0, 64), np.float32),
        w=np.zeros((0, 64), np.float32),
        keyframe_scans=np.zeros(0, np.int64),
    )
    one, points = tunnel_before.map.nearest_m[:1], tunnel_before.map.points[:1]
    few_points = MappedSession(
        replace(tunnel_before.map, points=points, nearest_m=one, seen_from=None), tunnel_before.descriptors
    )
    far_off = replace(tunnel_before.map, nearest_m=np.full(len(tunnel_before.map.points), 40.0, np.float32))
    for before, after in (
        (tunnel_before, MappedSession(tunnel_before.map, no_keyframe)),
        (tunnel_before, few_points),
        (few_points, tunnel_before),
        (tunnel_before, MappedSession(far_off, tunnel_before.descriptors)),
    ):
        merged = merge_maps(before, after, CONFIG)
        assert not merged.is_accepted
        assert "enough points" in merged.reason
        assert set(merged.seconds) == {"t_index_s", "t_merge_s", "t_refine_s"}
        assert merged.seconds["t_refine_s"] == 0.0
        np.testing.assert_array_equal(merged.before_T_after, np.eye(4))


def test_a_known_merge_is_taken_as_it_is_or_refined(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array
) -> None:
    known = make_pose(translation=(0.1, 0.1, 0.0)) @ true_before_T_after
    rigid = take_known_merge(tunnel_before, tunnel_after, known, CONFIG.model_copy(update={"refine": "none"}))
    assert rigid.is_accepted and rigid.local is None
    np.testing.assert_array_equal(rigid.before_T_after, known)
    assert (rigid.evidence["is_known"], rigid.evidence["n_hypotheses"]) == (1, 0)
    assert rigid.evidence["agreement"] > 0.95
    refined = take_known_merge(tunnel_before, tunnel_after, known, CONFIG)
    assert refined.is_accepted and refined.local is not None
    assert path_error_m(rigid, true_before_T_after) > 0.1
    assert path_error_m(refined, true_before_T_after) < 0.02
    assert set(refined.seconds) == {"t_index_s", "t_merge_s", "t_refine_s"}


@pytest.mark.parametrize("refine", ["local", "checked"])
def test_a_checked_refinement_moves_a_known_merge_by_a_metre_at_most(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array, refine: str
) -> None:
    config = CONFIG.model_copy(update={"refine": refine})
    for off_m in (0.8, 1.2):
        known = make_pose(translation=(0.0, off_m, 0.0)) @ true_before_T_after
        with nullcontext() if off_m < 1 else pytest.warns(InputWarning, match="1.2 m beside it"):
            merged = take_known_merge(tunnel_before, tunnel_after, known, config)
        if refine == "local" or off_m < 1:
            assert path_error_m(merged, true_before_T_after) < 0.03
        else:
            assert merged.local is None and merged.evidence["n_kept"] == 0
            np.testing.assert_array_equal(merged.before_T_after, known)
    # of one place as well
    before, after = stand(30.0, 0, np.eye(4)), stand(30.6, 1, AFTER_ODOM_T_WORLD)
    far = make_pose(translation=(0.0, 1.2, 0.0)) @ invert(AFTER_ODOM_T_WORLD)
    with pytest.warns(InputWarning, match="1.2 m beside it"):
        merged = take_known_merge(before, after, far, config)
    if refine == "checked":
        np.testing.assert_array_equal(merged.before_T_after, far)
    else:
        assert path_error_m(merged, invert(AFTER_ODOM_T_WORLD)) < 0.02


def test_no_gate_is_asked_about_a_known_merge(tunnel_before: MappedSession, other_tunnel: MappedSession) -> None:
    for far_m in (0.0, 1000.0):
        known = make_pose(translation=(0.0, far_m, 0.0))
        with pytest.warns(InputWarning, match="do not come within 5 m" if far_m else r"only \d+% of the points fit"):
            merged = take_known_merge(tunnel_before, other_tunnel, known, CONFIG)
        assert merged.is_accepted and merged.local is None
        np.testing.assert_array_equal(merged.before_T_after, known)
        assert explain_refusal(merged.evidence, CONFIG)
    one, points = tunnel_before.map.nearest_m[:1], tunnel_before.map.points[:1]
    small = replace(tunnel_before.map, points=points, nearest_m=one, seen_from=None)
    merged = take_known_merge(MappedSession(small, tunnel_before.descriptors), other_tunnel, np.eye(4), CONFIG)
    assert merged.is_accepted and merged.evidence == {"n_hypotheses": 0.0, "is_known": 1.0}


@pytest.mark.parametrize(
    ("off_m", "told"),
    [(0.0, None), (0.8, None), (1.5, r"fit 1\.5 m beside it"), (30.0, "do not come within 5 m")],
)
@pytest.mark.parametrize("refine", ["none", "checked"])
def test_a_known_merge_that_the_scans_contradict_is_told(
    tunnel_before: MappedSession,
    tunnel_after: MappedSession,
    true_before_T_after: Float64Array,
    off_m: float,
    told: str | None,
    refine: str,
) -> None:
    known = make_pose(translation=(0.0, off_m, 0.0)) @ true_before_T_after
    config = CONFIG.model_copy(update={"refine": refine})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        take_known_merge(tunnel_before, tunnel_after, known, config)
    assert [each.category for each in caught] == ([] if told is None else [InputWarning])
    assert told is None or re.match(f"known merge: .*{told}.*one frame", str(caught[0].message))


@pytest.mark.parametrize(("end_off_m", "is_told"), [(0.9, False), (1.05, True)])
def test_a_known_merge_that_is_off_at_the_end_of_the_path_alone_is_told(
    tunnel_before: MappedSession,
    tunnel_after: MappedSession,
    true_before_T_after: Float64Array,
    end_off_m: float,
    is_told: bool,
) -> None:
    places = transform(true_before_T_after, tunnel_after.map.odom_T_keyframe[:, :3, 3])
    turn = yaw_pose(end_off_m / float(np.linalg.norm(places[-1] - places[0])), (0.0, 0.0, 0.0))
    around_start = make_pose(translation=places[0]) @ turn @ make_pose(translation=-places[0])
    config = CONFIG.model_copy(update={"refine": "checked"})
    told = pytest.warns(InputWarning, match=r"known merge: \d of \d+ places fit more than 1\.0 m beside it")
    with told if is_told else nullcontext():
        take_known_merge(tunnel_before, tunnel_after, around_start @ true_before_T_after, config)


def test_a_right_known_merge_of_stations_that_lie_apart_is_told_to_be_unchecked() -> None:
    true = invert(AFTER_ODOM_T_WORLD)
    for apart_m, told in ((3.0, None), (5.5, "do not come within 5 m of each other under it, so it was not checked")):
        stations = stand(30.0, 0, np.eye(4)), stand(30.0 + apart_m, 1, AFTER_ODOM_T_WORLD)
        with nullcontext() if told is None else pytest.warns(InputWarning, match=told):
            take_known_merge(*stations, true, CONFIG)


@pytest.mark.parametrize(
    ("moved_m", "ratio", "told"),
    [
        ([0.02] * 9, 1.0, None),
        ([0.02] * 8 + [1.28], 1.0, None),
        ([0.02] * 7 + [1.28, 1.32], 1.0, r"fit 1\.3 m beside it, at 2 of 9 places"),
        ([1.5] * 9, 1.0, r"fit 1\.5 m beside it, at 9 of 9 places"),
        ([1.5] * 9, 0.01, None),  # the walk slid along a smooth drift
        ([0.02] * 39 + [1.5] * 3, 1.0, None),
        ([0.02] * 37 + [1.5] * 5, 1.0, "at 5 of 42 places"),
        ([1.5], 1.0, "at 1 of 1 places"),
        ([], 1.0, None),
    ],
)
def test_the_places_that_contradict_a_known_merge(moved_m: list[float], ratio: float, told: str | None) -> None:
    n = len(moved_m)
    # of one more keyframe the walk came near the path and nothing fits
    poses = make_pose(translation=np.column_stack([np.zeros((n + 1, 2)), [*moved_m, 40.0]]))
    fits = np.append(np.full(n, 0.9), 0.2)
    walked = Walk(np.arange(n + 1), poses, np.zeros((n + 1, 6, 6)), fits, np.zeros(n + 1))
    found = Hypothesis(np.eye(4), walked, {"inlier_share": 0.9, "hessian_ratio": ratio})
    known = np.repeat(np.eye(4)[None], n + 1, axis=0)
    with nullcontext() if told is None else pytest.warns(InputWarning, match=told):
        merge._warn_of_misfit(found, known, np.zeros((n + 1, 3)), 1.0, CONFIG)


def stand(
    along_m: float, sample: int, odom_T_world: Float64Array, n_scans: int = 5, jitter_m: float = 0.0
) -> MappedSession:
    """A sensor that stands in the tunnel at `along_m` and sees 6000 of the points within 12 m in each scan.

    Its odometry says that it jumps to and fro by `jitter_m`.
    """
    rng = stream(sample, "standing")
    points = tunnel_points(0, sample)
    world_T_sensor = yaw_pose(rng.uniform(-1, 1), (along_m, bend(np.array(along_m), 0), 1.5))
    near = points[np.linalg.norm(points - world_T_sensor[:3, 3], axis=1) < 12.0]
    clouds = [transform(invert(world_T_sensor), rng.choice(near, 6000, replace=False)) for _ in range(n_scans)]
    poses = np.repeat((odom_T_world @ world_T_sensor)[None], n_scans, axis=0)
    poses[1::2, 0, 3] += jitter_m
    return mapped(CloudScans("standing", poses, clouds), odom_T_world)


@pytest.mark.parametrize("n_scans", [1, 5])
def test_a_standing_sensor_is_merged_by_what_there_is(n_scans: int) -> None:
    true = invert(AFTER_ODOM_T_WORLD)
    before, after = stand(30.0, 0, np.eye(4), n_scans), stand(30.6, 1, AFTER_ODOM_T_WORLD, n_scans)
    merged = merge_maps(before, after, CONFIG)
    assert merged.is_accepted, merged.reason
    assert path_error_m(merged, true) < 0.02
    assert merged.evidence["agreement"] > 0.9
    assert merged.evidence["both_ways_m"] < 0.02 and merged.evidence["both_ways_deg"] < 0.3
    # a known merge of it is refined by that registration, or stays where it is
    off = make_pose(translation=(0.2, 0.1, 0.0)) @ true
    assert path_error_m(take_known_merge(before, after, off, CONFIG), true) < 0.02
    as_it_is = take_known_merge(before, after, off, CONFIG.model_copy(update={"refine": "none"}))
    np.testing.assert_array_equal(as_it_is.before_T_after, off)


def test_a_standing_sensor_with_jittering_odometry_is_judged_as_one_place() -> None:
    before, after = (stand(30.0, sample, np.eye(4), n_scans=12, jitter_m=0.5) for sample in (0, 1))
    assert len(before.map.keyframe_scans) > 3
    merged = merge_maps(before, after, CONFIG)
    assert "both_ways_m" in merged.evidence
    assert (
        "record a path of ten metres or more" in merge_maps(before, stand(44.0, 1, np.eye(4), 12, 0.5), CONFIG).reason
    )


def test_a_short_recording_of_single_rings_is_refused_and_a_known_merge_of_it_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before, after = stand(30.0, 0, np.eye(4)), stand(30.6, 1, AFTER_ODOM_T_WORLD)
    assert merge_maps(before, after, CONFIG).evidence["line_share"] < 0.05
    monkeypatch.setattr("cdpipe.merge.rings.MAX_LINE_SHARE", -1.0)  # as if these were rings
    merged = merge_maps(before, after, CONFIG)
    assert not merged.is_accepted and "line_share" in merged.reason
    assert merge_maps(before, after, CONFIG.model_copy(update={"accept_all": True})).is_accepted
    off = make_pose(translation=(0.2, 0.1, 0.0)) @ invert(AFTER_ODOM_T_WORLD)
    known = take_known_merge(before, after, off, CONFIG)
    assert known.is_accepted
    np.testing.assert_array_equal(known.before_T_after, off)


def test_a_long_path_is_not_asked_for_rings(tunnel_before: MappedSession, tunnel_after: MappedSession) -> None:
    assert "line_share" not in merge_maps(tunnel_before, tunnel_after, CONFIG).evidence


def test_a_standing_sensor_finds_its_place_in_a_drive(tunnel_before: MappedSession) -> None:
    true = invert(AFTER_ODOM_T_WORLD)
    merged = merge_maps(tunnel_before, stand(30.6, 1, AFTER_ODOM_T_WORLD), CONFIG)
    assert merged.is_accepted, merged.reason
    assert path_error_m(merged, true) < 0.02


def test_two_standing_sensors_at_other_places_are_refused() -> None:
    before = stand(14.0, 0, np.eye(4))
    for along_m in (26.0, 44.0):
        merged = merge_maps(before, stand(along_m, 1, AFTER_ODOM_T_WORLD), CONFIG)
        assert not merged.is_accepted
        assert "record a path of ten metres or more" in merged.reason and "nan" not in merged.reason


def test_one_place_of_a_smooth_drift_is_refused_because_it_slides() -> None:
    sessions = []
    for sample in (0, 1):
        rng = stream(sample, "smooth")
        along, section = rng.uniform(-12, 12, 30_000), rng.uniform(-1, 1, (30_000, 2))
        wall = rng.integers(0, 2, 30_000)
        section[np.arange(30_000), wall] = np.sign(section[np.arange(30_000), wall])
        points = np.column_stack([along, 3 * section]) + rng.normal(0, 0.005, (30_000, 3))
        source = CloudScans("smooth", np.eye(4)[None], [points[np.linalg.norm(points, axis=1) < 12.0]])
        sessions.append(mapped(source, np.eye(4)))
    merged = merge_maps(*sessions, CONFIG)
    assert not merged.is_accepted
    assert "can slide" in merged.reason and "one place of a smooth drift" in merged.reason


@pytest.mark.parametrize("swap", [False, True])
def test_two_real_scans_are_merged(tmp_path: Path, swap: bool) -> None:
    if "TUNNELCD_REAL_DATA" not in os.environ:
        pytest.skip("TUNNELCD_REAL_DATA is unset: the real registration pair is not at hand")
    folder = Path(os.environ["TUNNELCD_REAL_DATA"]) / "registration_pair"
    true = np.loadtxt(folder / "T_target_source.txt")
    names = ("source", "target") if swap else ("target", "source")
    for name in names:
        (tmp_path / name).mkdir()
        (tmp_path / name / "0.ply").symlink_to(folder / f"{name}.ply")
        (tmp_path / name / "poses.txt").write_text("0 0 0 0 0 0 0 1\n")
    with pytest.warns(InputWarning, match=r"missing returns|extract\.min_views"):
        report = detect(tmp_path / names[0], tmp_path / names[1])
    error = invert(invert(true) if swap else true) @ report.before_T_after
    assert np.linalg.norm(error[:3, 3]) < 0.02
    assert np.degrees(Rotation.from_matrix(error[:3, :3]).magnitude()) < 0.5


def test_the_real_pair_is_solved() -> None:
    if "TUNNELCD_REAL_DATA" not in os.environ:
        pytest.skip("TUNNELCD_REAL_DATA is unset: the real registration pair is not at hand")
    folder = Path(os.environ["TUNNELCD_REAL_DATA"]) / "registration_pair"
    source, target = read_ply_points(folder / "source.ply"), read_ply_points(folder / "target.ply")
    true = np.loadtxt(folder / "T_target_source.txt")
    error = invert(true) @ register(source, target, np.eye(4), MergeConfig())
    assert np.linalg.norm(error[:3, 3]) < 0.02
    assert np.degrees(Rotation.from_matrix(error[:3, :3]).magnitude()) < 0.5


def test_a_known_merge_beyond_what_cells_can_number_is_refused(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array
) -> None:
    utm = make_pose(translation=(500_000.0, 0.0, 0.0)) @ true_before_T_after
    with pytest.raises(InputError, match=r"^the known merge .*to 500\d\d\d m.* up to 52429 m: expected .*[^\n]$"):
        take_known_merge(tunnel_before, tunnel_after, utm, CONFIG)
