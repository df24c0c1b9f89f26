from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, invert, make_pose, transform, yaw_pose
from cdpipe.extract.point_comparison import is_within
from cdpipe.model.config import QueryConfig
from cdpipe.model.types import DescriptorSet, MergedMaps, PointMap
from cdpipe.query.difference import NEW_BEYOND_M, marked_share, sphere_difference

BEFORE_T_AFTER = yaw_pose(0.7, (3.0, -2.0, 0.5))


def point_map(points_map: Float64Array, path_map: Float64Array, odom_T_map: Float64Array) -> PointMap:
    poses = np.array([odom_T_map @ make_pose(translation=position) for position in path_map]).reshape(-1, 4, 4)
    nothing = np.zeros(0, np.int32)
    return PointMap(
        transform(odom_T_map, points_map),
        np.ones(len(points_map), np.float32),
        0.2,
        poses,
        np.arange(len(poses)),
        nothing,
        nothing,
        np.zeros(len(poses) + 1, np.int64),
    )


def scored(
    before: Float64Array, after: Float64Array, paths: tuple[Float64Array, Float64Array], **settings: float | str
) -> Float64Array:
    """Scores of the before keyframes; everything is given in the map frame."""
    maps = point_map(before, paths[0], np.eye(4)), point_map(after, paths[1], invert(BEFORE_T_AFTER))
    sets = [
        DescriptorSet(np.zeros((len(m.keyframe_scans), 2), np.float32), None, m.keyframe_scans, "-", "") for m in maps
    ]
    return sphere_difference(MergedMaps(*maps, BEFORE_T_AFTER, {}, True), *sets, QueryConfig(**settings))


def line(*xs: float, y: float = 0.0) -> Float64Array:
    return np.array([[x, y, 0.0] for x in xs]).reshape(-1, 3)


def test_a_score_by_hand() -> None:
    paths = line(0, 10), line(0, 10)
    # around 0: two points each, of which after has one alone; around 10: one each, and before's is 0.31 m off after's
    before, after = line(1, 2, 10.0), line(1, 3, 10.31)
    np.testing.assert_allclose(scored(before, after, paths, radius_m=4.5), [2 / 4, 2 / 2])
    # nearer than 0.3 m is the same
    np.testing.assert_allclose(scored(before, line(1, 3, 10.29), paths, radius_m=4.5), [2 / 4, 0 / 2])
    assert NEW_BEYOND_M == 0.3


def test_only_what_the_other_session_came_near_to_counts() -> None:
    # the before session drove on beyond 10 m; 13 and -13 lie within 4.5 m of its keyframe, but of no after keyframe
    paths = line(0, 10), line(0, 7)
    before, after = line(0, 9, 13), line(0, 9)
    np.testing.assert_allclose(scored(before, after, paths, radius_m=4.5), [0, 0])
    np.testing.assert_allclose(scored(before, after, paths, radius_m=6.5), [0, 1 / 3])


def test_the_same_change_has_the_same_score_however_wide_the_drift_is() -> None:
    paths = line(0, 10), line(0, 10)
    before, after = line(1, 2, 4.6, 10.0), line(1, 3, 4.6, 10.31)
    for wall_m in (2.0, 8.0):  # 4 m and 16 m wide; the walls are out of reach, or the same in both sessions
        walls = np.concatenate([line(*np.arange(-5, 15, 0.2), y=side_m) for side_m in (-wall_m, wall_m)])
        pair = np.concatenate([before, walls]), np.concatenate([after, walls])
        np.testing.assert_array_equal(scored(*pair, paths, radius_m="width"), scored(*pair, paths, radius_m=4.5))


def test_keyframes_that_cannot_be_scored_are_nan() -> None:
    # 10 was not visited again within 5 m; at 20 nothing stands
    scores = scored(line(0, 10), line(0, 10), (line(0, 10, 20), line(0, 4.9, 20)), radius_m=6.0)
    np.testing.assert_array_equal(scores, [0, np.nan, np.nan])
    np.testing.assert_array_equal(scored(line(0), line(0), (line(0), line())), [np.nan])
    assert scored(line(0), line(0), (line(), line(0))).shape == (0,)
    # a map that has lost everything: all of the other one is new
    np.testing.assert_array_equal(scored(line(0, 1), line(), (line(0), line(0))), [1.0])


@pytest.mark.parametrize("seed", range(3))
def test_it_equals_its_slow_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    before = rng.uniform((-3, -3, -1), (33, 3, 1), (500, 3))
    after = np.concatenate(
        [before[:350] + rng.normal(0, 0.12, (350, 3)), rng.uniform((0, -3, -1), (40, 3, 1), (200, 3))]
    )
    paths = line(*np.arange(0, 30, 2.5)), line(*np.arange(8, 37, 3.0), y=1.5)
    radius_m, max_pair_m = 4.0, 3.0
    expected = []
    for keyframe in paths[0]:
        n_new = n_all = 0
        for points, others, other_path in ((before, after, paths[1]), (after, before, paths[0])):
            for point in points:
                gaps_m = [np.linalg.norm(point - place) for place in other_path]
                if np.linalg.norm(point - keyframe) <= radius_m and min(gaps_m) <= radius_m:
                    n_all += 1
                    n_new += min(np.linalg.norm(point - other) for other in others) > 0.3
        is_seen = min(np.linalg.norm(keyframe - place) for place in paths[1]) <= max_pair_m
        expected.append(n_new / n_all if is_seen and n_all else np.nan)
    assert np.isnan(expected).sum() == 3
    found = scored(before, after, paths, radius_m=radius_m, max_pair_m=max_pair_m)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_moving_the_after_session_changes_nothing() -> None:
    rng = np.random.default_rng(5)
    before = rng.uniform(-6, 6, (200, 3))
    after = np.where(rng.random((200, 1)) < 0.5, before, rng.uniform(-6, 6, (200, 3)))
    maps = point_map(before, line(0, 2), np.eye(4)), point_map(after, line(0, 2), invert(BEFORE_T_AFTER))
    sets = [DescriptorSet(np.zeros((2, 2), np.float32), None, np.arange(2), "-", "")] * 2
    elsewhere = yaw_pose(-1.1, (50.0, 7.0, -3.0))
    moved = replace(
        maps[1], points=transform(elsewhere, maps[1].points), odom_T_sensor=elsewhere @ maps[1].odom_T_sensor
    )
    still = sphere_difference(MergedMaps(*maps, BEFORE_T_AFTER, {}, True), *sets, QueryConfig())
    merged = MergedMaps(maps[0], moved, BEFORE_T_AFTER @ invert(elsewhere), {}, True)
    np.testing.assert_allclose(sphere_difference(merged, *sets, QueryConfig()), still, atol=1e-12)
    assert 0 < still[0] < 1


def test_the_keyframes_of_the_after_session_are_those_of_the_before_session_of_swapped_maps() -> None:
    rng = np.random.default_rng(6)
    before = rng.uniform(-6, 6, (200, 3))
    after = np.where(rng.random((200, 1)) < 0.5, before, rng.uniform(-6, 6, (200, 3)))
    maps = point_map(before, line(0, 2), np.eye(4)), point_map(after, line(-1, 1, 9), np.eye(4))
    sets = [
        DescriptorSet(np.zeros((len(m.keyframe_scans), 2), np.float32), None, m.keyframe_scans, "-", "") for m in maps
    ]
    swapped = sphere_difference(MergedMaps(*maps[::-1], np.eye(4), {}, True), *sets[::-1], QueryConfig())
    found = sphere_difference(MergedMaps(*maps, np.eye(4), {}, True), *sets, QueryConfig(), "after")
    np.testing.assert_array_equal(found, swapped)
    assert len(found) == 3 and np.isnan(found).tolist() == [False, False, True]


def test_the_border_is_within() -> None:
    assert is_within(line(1.0, 1.5, 1.6), line(0.5), 1.0).tolist() == [True, True, False]
    assert is_within(line(1.0), line(), 1.0).tolist() == [False]
    assert is_within(line(), line(1.0), 1.0).shape == (0,)
    share = marked_share([(line(0, 1, 2), np.array([True, False, True]))], line(0, 9), radius_m=1.0)
    np.testing.assert_array_equal(share, [0.5, np.nan])
