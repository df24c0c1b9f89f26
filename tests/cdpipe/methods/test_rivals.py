from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, make_pose, transform, yaw_pose
from cdpipe.core.plugins import METHODS, entry_points
from cdpipe.methods.c2c import c2c
from cdpipe.methods.random_regions import RandomRegions
from cdpipe.methods.registry import list_extras, load_method
from cdpipe.methods.voxel_diff import voxel_diff
from cdpipe.methods.whole_map import PlacedMaps, WholeMap, choose_scans
from cdpipe.model.config import PipelineConfig, load_config, preset_names
from cdpipe.model.report import ChangeReport
from cdpipe.model.types import DescriptorSet, MappedSession, MergedMaps, PointMap, SessionName
from cdpipe.pipeline import detect_changes

LENGTH_M = 40.0
SPACING_M = 0.2
BEFORE_T_AFTER = yaw_pose(0.7, (3.0, -2.0, 0.5))


def grid(low: Sequence[float], high: Sequence[float], spacing_m: float = SPACING_M) -> Float64Array:
    axes = [np.arange(a, b - 1e-9, spacing_m) + spacing_m / 2 for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def corridor() -> Float64Array:
    floor = grid((0, -2, 0), (LENGTH_M, 2, SPACING_M))
    walls = [grid((0, y, 0), (LENGTH_M, y + SPACING_M, 3)) for y in (-2.2, 2.0)]
    return np.concatenate([floor, *walls])


def crate(x_m: float, size_m: float = 0.8) -> Float64Array:
    # 1.2 m above the floor and from the walls: clear of every voxel of the corridor, so each of its points is new
    return grid((x_m, -size_m / 2, 1.2), (x_m + size_m, size_m / 2, 1.2 + size_m))


def point_map(points: Float64Array, odom_T_map: Float64Array) -> PointMap:
    n = len(points)
    poses = np.array([odom_T_map @ yaw_pose(0.0, (x, 0.0, 1.0)) for x in np.arange(0.5, LENGTH_M)])
    return PointMap(
        points=transform(odom_T_map, points),
        nearest_m=np.ones(n, np.float32),
        voxel_m=SPACING_M,
        odom_T_sensor=poses,
        keyframe_scans=np.arange(len(poses)),
        return_points=np.arange(n, dtype=np.int32),
        return_pixels=np.arange(n, dtype=np.int32),
        scan_offsets=np.concatenate([[0], np.full(len(poses), n)]),
    )


def pair(only_before: Sequence[Float64Array], only_after: Sequence[Float64Array]) -> MergedMaps:
    before = point_map(np.concatenate([corridor(), *only_before]), np.eye(4))
    after_T_before = np.linalg.inv(BEFORE_T_AFTER)
    after = point_map(np.concatenate([corridor(), *only_after]), after_T_before)
    return MergedMaps(before, after, BEFORE_T_AFTER, {}, True)


def descriptors(point_map: PointMap) -> DescriptorSet:
    n = len(point_map.keyframe_scans)
    return DescriptorSet(np.zeros((n, 2), np.float32), None, point_map.keyframe_scans, "none", "")


def answer(merged: MergedMaps, config: PipelineConfig) -> ChangeReport:
    mapped = [MappedSession(each, descriptors(each)) for each in (merged.before, merged.after)]
    return detect_changes(*mapped, config, merge=lambda before, after: merged)


def test_one_added_crate_by_hand() -> None:
    new = crate(20.0)  # 4 x 4 x 4 points
    config = load_config("voxel-diff", ["query.threshold=0", "outlier.sigmas=10"])
    report = answer(pair([], [new]), config)
    assert len(new) == 64
    assert report.regions.scores.tolist() == [64.0]
    np.testing.assert_allclose(report.regions.centres_map, [[20.4, 0.0, 1.6]], atol=1e-9)
    # keyframes stand at 0.5, 1.5, …: 20.5 is the nearest, number 20, in both sessions
    assert report.regions.pairs.tolist() == [[20, 20]]
    (item,) = report.objects
    assert (item.session, item.kind, item.region, item.score, len(item.returns)) == ("after", "added", 0, 64.0, 64)
    # 4 points along each edge, 0.2 m apart: a hull of 0.6 m cubed
    assert report.figures["v_oe_m3"][0] == pytest.approx(0.6**3)
    assert report.figures["oe_points"][0] == 64


def test_c2c_by_hand() -> None:
    # hovering in the middle of the corridor all 64 points are new; lowered to 0.2 m above the floor's points, the lower
    # layer of 16 is not; that it is nearer than a voxel to the floor takes more away from `voxel-diff`
    settings = ("query.threshold=0", "outlier.sigmas=10", "regions.min_points=16")
    hovering, low = crate(20.0), crate(20.0) - (0.0, 0.0, 1.0)
    assert low[:, 2].min() == pytest.approx(0.3)
    for box, distance_m, n_new in ((hovering, 0.3, 64), (low, 0.3, 48), (low, 0.19, 64), (low, 0.5, 32)):
        report = answer(pair([], [box]), load_config("c2c", [*settings, f"c2c.distance_m={distance_m}"]))
        assert report.regions.scores.tolist() == [n_new]
        (item,) = report.objects
        assert (item.session, item.kind, len(item.returns)) == ("after", "added", n_new)
    by_voxel = answer(pair([], [low]), load_config("voxel-diff", [*settings, "voxel_diff.voxel_m=0.65"]))
    assert by_voxel.regions.scores.max(initial=0) < 48


def test_c2c_measures_in_both_directions_and_at_any_place() -> None:
    settings = ("query.threshold=0", "outlier.sigmas=10", "regions.min_points=16")
    merged = pair([crate(10.0)], [crate(30.0)])
    objects = answer(merged, load_config("c2c", settings)).objects
    assert {(item.session, item.kind, item.partner) for item in objects} == {
        ("before", "moved", 0),
        ("after", "moved", 1),
    }
    unchanged = answer(pair([], []), load_config("c2c", settings))
    assert unchanged.regions.scores.shape == (0,)
    assert unchanged.regions.keyframe_scores.tolist() == [0.0] * 40
    passed_by = answer(pair([], [grid((60, -1, 0), (70, 1, 3))]), load_config("c2c", settings))
    assert len(passed_by.regions.scores) == 0


def test_removed_is_the_reverse_and_two_of_a_size_are_a_move() -> None:
    config = load_config("voxel-diff", ["query.threshold=0", "outlier.sigmas=10"])
    removed = answer(pair([crate(20.0)], []), config).objects
    assert [(item.session, item.kind) for item in removed] == [("before", "removed")]
    moved = answer(pair([crate(10.0)], [crate(30.0)]), config).objects
    assert {(item.session, item.kind, item.partner) for item in moved} == {
        ("before", "moved", 0),
        ("after", "moved", 1),
    }


def test_keyframe_score_is_the_changed_share_around_it() -> None:
    config = load_config("voxel-diff", ["query.threshold=0", "outlier.sigmas=10", "query.radius_m=2.2"])
    merged = pair([], [crate(20.0)])
    report = answer(merged, config)
    centre = np.array([18.5, 0.0, 1.0])
    n_changed = np.count_nonzero(np.linalg.norm(crate(20.0) - centre, axis=1) <= 2.2)
    n_all = n_changed + 2 * np.count_nonzero(np.linalg.norm(corridor() - centre, axis=1) <= 2.2)
    assert 0 < n_changed < 64
    assert report.regions.keyframe_scores[18] == pytest.approx(n_changed / n_all, abs=2 / n_all)
    assert report.regions.keyframe_scores[0] == 0.0


def test_threshold_is_in_points_and_a_near_cluster_joins_the_larger_one() -> None:
    small, large = crate(23.0, 0.6), crate(20.0)  # 27 and 64 points, centroids 3 m apart
    far = crate(35.0, 0.6)
    small_too = ("outlier.sigmas=10", "regions.min_points=16")
    merged = pair([], [small, large, far])
    loose = answer(merged, load_config("voxel-diff", [*small_too, "query.threshold=0", "query.radius_m=4.5"]))
    assert loose.regions.scores.tolist() == [64.0, 27.0]
    assert sorted((item.score, item.region) for item in loose.objects) == [(27.0, 0), (27.0, 1), (64.0, 0)]
    strict = answer(merged, load_config("voxel-diff", [*small_too, "query.threshold=28"]))
    assert strict.regions.is_reported.tolist() == [True, False]
    assert [(item.score, item.region) for item in strict.objects] == [(64.0, 0)]
    fixed = answer(merged, load_config("voxel-diff", [*small_too, "query.n_regions=1", "query.threshold=99"]))
    assert sorted(item.score for item in fixed.objects) == [27.0, 64.0]


def test_what_the_other_session_did_not_pass_is_not_compared() -> None:
    merged = pair([], [grid((60, -1, 0), (70, 1, 3))])
    assert len(answer(merged, load_config("voxel-diff")).regions.scores) == 0


def test_unchanged_and_empty_answers() -> None:
    report = answer(pair([], []), load_config("voxel-diff"))
    assert report.regions.centres_map.shape == (0, 3)
    assert report.objects == ()
    assert report.regions.keyframe_scores.tolist() == [0.0] * len(report.keyframe_scans[0])
    assert {"t_cd_s", "t_oe_s"} <= set(report.seconds)


def test_moving_the_after_session_changes_nothing() -> None:
    config = load_config("voxel-diff", ["query.threshold=0", "outlier.sigmas=10"])
    merged = pair([crate(10.0)], [crate(30.0, 0.6)])
    elsewhere = yaw_pose(-1.1, (50.0, 7.0, -3.0))
    moved_map = replace(
        merged.after,
        points=transform(elsewhere, merged.after.points),
        odom_T_sensor=elsewhere @ merged.after.odom_T_sensor,
    )
    moved = replace(merged, after=moved_map, before_T_after=merged.before_T_after @ np.linalg.inv(elsewhere))
    first, second = answer(merged, config), answer(moved, config)
    np.testing.assert_allclose(first.regions.centres_map, second.regions.centres_map, atol=1e-6)
    assert [len(item.returns) for item in first.objects] == [len(item.returns) for item in second.objects]


def test_random_regions_are_keyframes_and_repeat_with_their_seed() -> None:
    merged = pair([], [crate(20.0)])

    def drawn(seed: int) -> ChangeReport:
        return answer(merged, load_config("random-regions", [f"seed={seed}"]))

    first = drawn(0)
    assert int(first.regions.is_reported.sum()) == 3
    keyframes = merged.before.odom_T_keyframe[:, :3, 3]
    np.testing.assert_array_equal(first.regions.centres_map, keyframes[first.regions.pairs[:, 0]])
    np.testing.assert_array_equal(first.regions.pairs[:, 0], first.regions.pairs[:, 1])
    gaps_m = np.linalg.norm(first.regions.centres_map[:, None] - first.regions.centres_map, axis=2)
    assert gaps_m[~np.eye(len(gaps_m), dtype=bool)].min() >= first.regions.radius_m
    np.testing.assert_array_equal(first.regions.centres_map, drawn(0).regions.centres_map)
    assert not np.array_equal(first.regions.scores, drawn(1).regions.scores)


def test_random_regions_hit_at_random() -> None:
    """Over many seeds, the best region lies on each tenth of the corridor about equally often."""
    merged = pair([], [])
    sets = descriptors(merged.before), descriptors(merged.after)
    best = [
        RandomRegions().propose(merged, *sets, load_config("random-regions", [f"seed={seed}"])).centres_map[0, 0]
        for seed in range(200)
    ]
    counts, _ = np.histogram(best, bins=10, range=(0, LENGTH_M))
    # 200 draws into 10 bins: mean 20, standard deviation 4.2
    assert counts.min() > 20 - 4 * 4.2
    assert counts.max() < 20 + 4 * 4.2


def test_random_regions_stay_where_the_after_session_came() -> None:
    merged = pair([], [])
    half = replace(merged.after, keyframe_scans=merged.after.keyframe_scans[:10])
    config = load_config("random-regions", ["query.max_pair_m=2"])
    sets = descriptors(merged.before), descriptors(half)
    regions = RandomRegions().propose(replace(merged, after=half), *sets, config)
    assert np.isfinite(regions.keyframe_scores).sum() == 12  # 0.5 … 9.5 and those within 2 m behind
    assert regions.centres_map[:, 0].max() <= 11.5


def test_every_preset_has_its_source() -> None:
    assert {load_config(name).regions.source for name in preset_names()} <= entry_points(METHODS).keys()
    assert load_method("voxel-diff").propose == voxel_diff.propose
    assert load_method("c2c").propose == c2c.propose


def test_a_class_is_created_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    class Kept:
        def __init__(self) -> None:
            made.append(self)

        def propose(self) -> None: ...

    monkeypatch.setattr("cdpipe.methods.registry.load_entry_point", lambda *_: Kept)
    assert load_method("kept for a test").propose == load_method("kept for a test").propose
    assert len(made) == 1


def test_an_answer_names_the_optional_packages_that_it_depends_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cdpipe.methods.registry.extra_version", lambda name: f"{name} 1")
    ours, m3c2 = load_config("tunnelcd"), load_config("m3c2")
    assert list_extras(ours, {}) == {}
    assert list_extras(ours, {"kiss_matcher": 1.0}) == {"kiss-matcher": "kiss-matcher 1"}
    assert list_extras(ours, {"kiss_matcher": 0.0}) == {"kiss-matcher": "absent"}
    assert list_extras(m3c2, {}) == {"py4dgeo": "py4dgeo 1"}
    assert list_extras(m3c2, {}, proposes=False) == {}
    assert list(list_extras(load_config("dufomap"), {"kiss_matcher": 1.0})) == ["kiss-matcher", "dufomap"]
    assert list_extras(load_config("m3c2-ep"), {}) == {"py4dgeo": "py4dgeo 1"}
    assert list_extras(load_config("octomap"), {}) == {"pyoctomap": "pyoctomap 1"}
    assert list_extras(load_config("removert"), {}) == list_extras(load_config("erasor"), {}) == {}


def test_figures_are_of_the_after_map() -> None:
    # a crate went and a smaller one came 2 m beside it: one region holds both, the table only what came
    config = load_config(
        "voxel-diff", ["outlier.sigmas=10", "regions.min_points=16", "query.n_regions=1", "query.radius_m=4.5"]
    )
    report = answer(pair([crate(20.0)], [crate(22.0, 0.6)]), config)
    assert sorted((item.session, len(item.returns), item.region) for item in report.objects) == [
        ("after", 27, 0),
        ("before", 64, 0),
    ]
    assert report.figures["oe_points"][0] == 27
    assert report.figures["v_oe_m3"][0] == pytest.approx(0.4**3)


def test_a_mask_of_ones_own_makes_a_source() -> None:
    """A whole-map comparison is a mask."""

    def higher_mask(maps: PlacedMaps, session: SessionName, other: SessionName, config: PipelineConfig) -> BoolArray:
        points, others = maps.points[session], maps.points[other]
        beside = cKDTree(others[:, :2]).query(points[:, :2])[1]
        return np.asarray(points[:, 2] - others[beside, 2] > config.extract.distance_m)

    merged = pair([], [crate(20.0)])
    # beside the walls the nearest point of the other map may be any of a column: only what stands in the middle counts
    config = load_config("voxel-diff", ["query.threshold=0", "outlier.sigmas=10", "regions.min_points=33"])

    @WholeMap
    def in_the_middle(maps: PlacedMaps, session: SessionName, other: SessionName, config: PipelineConfig) -> BoolArray:
        return higher_mask(maps, session, other, config) & (np.abs(maps.points[session][:, 1]) < 1.5)

    regions = in_the_middle.propose(merged, descriptors(merged.before), descriptors(merged.after), config)
    assert regions.scores.tolist() == [64.0]
    assert regions.clusters is not None
    assert regions.clusters.is_after.tolist() == [True]


def test_points_are_compared_within_the_radius_of_the_others_nearest_keyframe() -> None:
    path = np.array([[0.0, 0, 0], [10, 0, 0]])
    points = np.array([[0.0, 4.5, 0], [0, 4.6, 0], [10, 9.9, 0], [10, 10.1, 0], [4.9, 4.6, 0], [5.1, 4.6, 0]])
    radii_m = np.array([4.5, 10.0])
    maps = PlacedMaps(pair([], []), {"before": path, "after": points}, {"before": path, "after": path},
                      {"before": radii_m, "after": radii_m})  # fmt: skip
    assert maps.is_compared("after", "before").tolist() == [True, False, True, False, False, True]
    nowhere = replace(maps, path={"before": path[:0], "after": path}, radii_m={"before": radii_m[:0], "after": radii_m})
    assert not nowhere.is_compared("after", "before").any()


def test_stations_of_a_survey_are_never_left_out() -> None:
    def along(step_m: float, n: int) -> Float64Array:
        return np.array([make_pose(translation=(step_m * k, 0.0, 0.0)) for k in range(n)])

    assert choose_scans(along(10.0, 16), 8).tolist() == list(range(16))
    assert choose_scans(along(0.1, 316), 8).tolist() == list(range(0, 316, 8))
    assert choose_scans(along(0.1, 1), 8).tolist() == [0]


@pytest.mark.parametrize("preset", ["frame", "kiss-matcher"])
@pytest.mark.parametrize("site", ["narrow", "wide"])
def test_presets_with_another_merge_differ_in_nothing_else(preset: str, site: Literal["narrow", "wide"]) -> None:
    poses = ["map.consistency=none"] if preset == "frame" else []
    ours = load_config("tunnelcd", poses, site=site).model_dump(exclude={"merge"})
    theirs = load_config(preset, site=site).model_dump(exclude={"merge"})
    assert theirs == ours
