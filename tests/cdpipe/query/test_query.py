from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, invert, make_pose, yaw_pose
from cdpipe.model.config import PipelineConfig, QueryConfig, RegionsConfig
from cdpipe.model.types import DescriptorSet, MergedMaps, PointMap
from cdpipe.query.query import _find_ends, find_regions, rank_regions


def session(positions: list[tuple[float, float, float]], q: list[list[float]]) -> tuple[PointMap, DescriptorSet]:
    poses = np.array([make_pose(translation=position) for position in positions]).reshape(-1, 4, 4)
    scans = np.arange(len(positions))
    nothing = np.zeros(0, np.int32)
    point_map = PointMap(
        np.zeros((0, 3)),
        np.zeros(0, np.float32),
        0.2,
        poses,
        scans,
        nothing,
        nothing,
        np.zeros(len(scans) + 1, np.int64),
    )
    vectors = np.array(q, dtype=np.float32).reshape(-1, 2)
    return point_map, DescriptorSet(vectors, None, scans, "by hand", "")


def by(source: str, **settings: object) -> PipelineConfig:
    return PipelineConfig(regions=RegionsConfig(source=source), query=QueryConfig.model_validate(settings))


def find(
    before: tuple[PointMap, DescriptorSet],
    after: tuple[PointMap, DescriptorSet],
    before_T_after: Float64Array | None = None,
    **settings: object,
) -> dict[tuple[float, ...], tuple[float, tuple[int, int]]]:
    """Score and pair of every candidate, by its centre."""
    merged = MergedMaps(before[0], after[0], make_pose() if before_T_after is None else before_T_after, {}, True)
    regions = find_regions(merged, before[1], after[1], by("scan", suppression=1e-9, **settings))
    return {
        tuple(np.round(centre, 6).tolist()): (pytest.approx(score, abs=1e-6), (int(pair[0]), int(pair[1])))
        for centre, score, pair in zip(regions.centres_map, regions.scores, regions.pairs, strict=True)
    }


# Three places 10 m apart. After keyframe 0 looks like place 1, and place 1 itself has changed to (0.6, 0.8).
BEFORE = session([(0, 0, 0), (10, 0, 0), (20, 0, 0)], [[1, 0], [0, 1], [-1, 0]])
AFTER = session([(0, 1, 0), (10, 1, 0), (20, 1, 0)], [[0, 1], [0.6, 0.8], [-1, 0]])
# |(0, 1) - (0.6, 0.8)| = sqrt(0.36 + 0.04); |(1, 0) - (0.6, 0.8)| = sqrt(0.16 + 0.64); |(1, 0) - (0, 1)| = sqrt 2
S04, S08, S2 = 0.4**0.5, 0.8**0.5, 2.0**0.5


def test_reading_a_by_hand() -> None:
    assert find(BEFORE, AFTER, reading="nearest") == {
        (0, 1, 0): (0, (1, 0)),
        (10, 1, 0): (S04, (1, 1)),
        (20, 1, 0): (0, (2, 2)),
        (0, 0, 0): (S08, (0, 1)),
        (10, 0, 0): (0, (1, 0)),
        (20, 0, 0): (0, (2, 2)),
    }


def test_reading_b_by_hand() -> None:
    assert find(BEFORE, AFTER, reading="paired") == {
        (0, 1, 0): (S2, (0, 0)),
        (10, 1, 0): (S04, (1, 1)),
        (20, 1, 0): (0, (2, 2)),
        (0, 0, 0): (S2, (0, 0)),
        (10, 0, 0): (S04, (1, 1)),
        (20, 0, 0): (0, (2, 2)),
    }


def test_the_direction_says_whose_keyframe_was_looked_up() -> None:
    merged = MergedMaps(BEFORE[0], AFTER[0], make_pose(), {}, True)
    for reading in ("nearest", "paired"):
        regions = find_regions(merged, BEFORE[1], AFTER[1], by("scan", reading=reading, suppression=1e-9))
        # before keyframes stand at y = 0, after keyframes at y = 1; the centre is where the asking one stands
        np.testing.assert_array_equal(regions.direction, regions.centres_map[:, 1])
        own = np.where(regions.direction == 0, regions.pairs[:, 0], regions.pairs[:, 1])
        np.testing.assert_array_equal(regions.centres_map[:, 0], 10.0 * own)
    assert sorted(regions.direction.tolist()) == [0, 0, 0, 1, 1, 1]


def test_a_direction_is_dropped_and_ordered_with_its_candidate() -> None:
    centres = np.array([[6.0, 0, 0], [3, 0, 0], [0, 0, 0]])
    regions = rank_regions(
        centres,
        np.array([1.0, 2.0, 3.0]),
        np.zeros((3, 2), np.int64),
        np.zeros(0),
        QueryConfig(radius_m=4.0),
        np.array([1, 1, 0], np.uint8),
        radii_m=np.full(3, 4.0),
    )
    assert regions.direction.tolist() == [0, 1]


def test_reading_b_leaves_out_keyframes_without_a_partner_nearby() -> None:
    far = session([(0, 1, 0), (15, 0.1, 0)], [[1, 0], [0, 1]])
    assert set(find(BEFORE, far, reading="paired", max_pair_m=5.0)) == {(0, 1, 0), (0, 0, 0)}
    assert set(find(BEFORE, far, reading="paired", max_pair_m=5.1)) == {
        (0, 1, 0), (15, 0.1, 0), (0, 0, 0), (10, 0, 0), (20, 0, 0),
    }  # fmt: skip


def test_scores_of_before_keyframes_by_hand() -> None:
    # after keyframes 1 and 2 are both nearest to before keyframe 1, whose own nearest is after keyframe 1
    before = session([(0, 0, 0), (10, 0, 0), (40, 0, 0)], [[1, 0], [1, 0], [1, 0]])
    after = session([(0, 1, 0), (10, 1, 0), (10, 4, 0)], [[1, 0], [0.6, 0.8], [-1, 0]])
    merged = MergedMaps(before[0], after[0], make_pose(), {}, True)
    paired = find_regions(merged, before[1], after[1], by("scan", reading="paired"))
    # own scores: 0, |(1, 0) - (0.6, 0.8)|; heard from after keyframe 2: 2; the third place was not visited again
    np.testing.assert_allclose(paired.keyframe_scores, [0, 2, np.nan], atol=1e-6)
    nearest = find_regions(merged, before[1], after[1], by("scan", reading="nearest"))
    # reading A: every before keyframe finds (1, 0) again; after keyframe 2 is |(-1, 0) - (1, 0)| from all
    np.testing.assert_allclose(nearest.keyframe_scores, [0, 2, np.nan], atol=1e-6)


def test_moving_both_sessions_moves_the_centres() -> None:
    g, h = yaw_pose(0.7, (3, -2, 1)), yaw_pose(-1.9, (40, 5, 0))
    for reading in ("nearest", "paired"):
        plain = find(BEFORE, AFTER, reading=reading)
        before = replace(BEFORE[0], odom_T_sensor=g @ BEFORE[0].odom_T_sensor), BEFORE[1]
        after = replace(AFTER[0], odom_T_sensor=h @ AFTER[0].odom_T_sensor), AFTER[1]
        moved = find(before, after, g @ invert(h), reading=reading)
        expected = {
            tuple(np.round(g[:3, :3] @ np.array(centre) + g[:3, 3], 6).tolist()): value
            for centre, value in plain.items()
        }
        assert moved == expected


def test_a_session_without_keyframes() -> None:
    nothing = session([], [])
    for before, after in ((nothing, AFTER), (BEFORE, nothing), (nothing, nothing)):
        for reading in ("nearest", "paired"):
            assert find(before, after, reading=reading) == {}


def ranked(
    xs: list[float], scores: list[float], forced: list[int] | None = None, **settings: object
) -> tuple[list[float], list[bool]]:
    centres = np.array([[x, 0.0, 0.0] for x in xs]).reshape(-1, 3)
    pairs = np.zeros((len(xs), 2), np.int64)
    config, radii_m = QueryConfig(radius_m=4.0, **settings), np.full(len(xs), 4.0)
    is_forced = None if forced is None else np.isin(np.arange(len(xs)), forced)
    regions = rank_regions(centres, np.array(scores), pairs, np.zeros(0), config, radii_m=radii_m, is_forced=is_forced)
    return regions.centres_map[:, 0].tolist(), regions.is_reported.tolist()


def test_suppression_by_hand() -> None:
    # 3 falls to 0; 6 stays because 3, which it is near to, is gone; 4 is exactly one radius from 0 and stays
    assert ranked([6, 3, 0], [1, 2, 3])[0] == [0, 6]
    assert ranked([0, 4], [2, 1])[0] == [0, 4]
    assert ranked([0, 4], [2, 1], suppression=1.01)[0] == [0]


def test_the_radius_of_the_better_one_decides_what_is_near() -> None:
    def kept(scores: list[float]) -> tuple[list[float], list[float]]:
        centres = np.array([[0.0, 0, 0], [6, 0, 0]])
        radii_m, pairs = np.array([10.0, 4.5]), np.zeros((2, 2), np.int64)
        config = QueryConfig(radius_m="width")
        regions = rank_regions(centres, np.array(scores), pairs, np.zeros(0), config, radii_m=radii_m)
        return regions.centres_map[:, 0].tolist(), regions.radii_m.tolist()

    assert kept([2, 1]) == ([0], [10])
    assert kept([1, 2]) == ([6, 0], [4.5, 10])


def test_threshold_or_number() -> None:
    xs, scores = [0.0, 10.0, 20.0, 30.0], [0.1, 0.4, np.nan, 0.3]
    assert ranked(xs, scores, threshold=0.3) == ([10, 30, 0], [True, True, False])
    assert ranked(xs, scores, threshold=9.0, n_regions=1) == ([10, 30, 0], [True, False, False])
    assert ranked(xs, scores, n_regions=9)[1] == [True, True, True]
    assert ranked([], []) == ([], [])


def test_what_is_always_looked_at_by_hand() -> None:
    xs, scores, ends = [0.0, 10.0, 20.0, 30.0], [0.1, 0.4, 0.2, 0.3], [0, 3]
    # they keep their scores, and stand behind all that is surer
    assert ranked(xs, scores, ends, threshold=0.35) == ([10, 30, 20, 0], [True, True, False, True])
    assert ranked(xs, scores, ends, threshold=9.0) == ([10, 30, 20, 0], [False, True, False, True])
    assert ranked(xs, scores, ends, threshold=0.0) == ([10, 30, 20, 0], [True] * 4)
    # 3 is nearer than a radius to the end at 0: it covers the end if it is looked at; else the end stays beside it
    assert ranked([0, 3], [1, 2], [0], threshold=2.0) == ([3], [True])
    assert ranked([0, 3], [1, 2], [0], threshold=2.1) == ([3, 0], [False, True])
    # an end hides what is less sure, looked at or not, and of two ends that are near each other the surer one stays
    assert ranked([0, 3], [2, 1], [0], threshold=9.0) == ([0], [True])
    assert ranked([0, 3], [1, 2], [0, 1], threshold=9.0) == ([3], [True])


def test_of_equal_scores_the_first_comes_first() -> None:
    assert ranked([0, 10, 20], [1, 1, 1])[0] == [0, 10, 20]


@pytest.mark.parametrize("source", ["scan", "sphere-difference"])
def test_regions_have_the_radius_of_their_own_keyframe_where_it_follows_the_width(source: str) -> None:
    def in_drift(session: tuple[PointMap, DescriptorSet], width_m: float) -> tuple[PointMap, DescriptorSet]:
        x, y, z = np.meshgrid(np.arange(-3.0, 24.0, 0.2), [-width_m / 2, width_m / 2], np.arange(-1.0, 1.0, 0.2))
        points = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
        return replace(session[0], points=points, nearest_m=np.ones(len(points), np.float32)), session[1]

    before, after = in_drift(BEFORE, 5.0), in_drift(AFTER, 14.0)
    merged = MergedMaps(before[0], after[0], make_pose(), {}, True)
    found = find_regions(merged, before[1], after[1], by(source, radius_m="width", suppression=1e-9))
    # before keyframes are in a drift 5 m wide, after keyframes in one 14 m wide
    assert len(found.radii_m) == (6 if source == "scan" else 3)
    np.testing.assert_array_equal(found.radii_m, np.where(found.direction == 0, 4.5, 10.0))
    fixed = find_regions(merged, before[1], after[1], by(source, radius_m=4.5, suppression=1e-9))
    assert fixed.radius_m == 4.5


def test_scores_of_spheres_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    before = session([(0, 0, 0), (2, 0, 0), (4, 0, 0), (6, 0, 0), (8, 0, 0), (40, 0, 0)], [[1, 0]] * 6)
    local = np.array([-5.0, 8.0, -6.0, -6.5, -1.0, np.nan])
    monkeypatch.setattr("cdpipe.query.query.change_log_odds", lambda *_: local)
    merged = MergedMaps(before[0], AFTER[0], make_pose(), {}, True)
    found = find_regions(merged, before[1], AFTER[1], by("sphere", radius_m=4.5, max_pair_m=6.0))
    # 8 counts as 3, less 0.1 per metre: 3 at its keyframe, 2.8 at both neighbours and 2.6 two keyframes on; the last
    # but one has nothing surer than -1 within 4.5 m; the last was not visited again
    np.testing.assert_allclose(found.keyframe_scores, [2.8, 3.0, 2.8, 2.6, -1.0, np.nan])
    assert found.scores.max() == 8.0


def test_ends_are_looked_at_with_their_own_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    way = session([(x, 0, 0) for x in (0.0, 10.0, 20.0, 30.0)], [[1, 0]] * 4)
    monkeypatch.setattr("cdpipe.query.query.change_log_odds", lambda *_: np.array([-9.3, 5.0, -4.0, -7.1]))
    merged = MergedMaps(way[0], way[0], make_pose(), {}, True)
    for threshold, n_surer in ((-8.0, 2), (-3.0, 1), (9.0, 0), (1000.0, 0)):
        found = find_regions(merged, way[1], way[1], by("sphere", radius_m=4.5, threshold=threshold))
        assert found.scores.tolist() == [5.0, -4.0, -7.1, -9.3]
        assert found.is_reported.tolist() == [n_surer > 0, n_surer > 1, True, True]
        assert found.is_forced is not None and found.is_forced.tolist() == [False, False, True, True]
    # a number of regions is the most that is reported
    found = find_regions(merged, way[1], way[1], by("sphere", radius_m=4.5, n_regions=1))
    assert found.is_reported.tolist() == [True, False, False, False]
    assert found.is_forced is None


def test_an_end_that_the_other_session_came_near_is_always_looked_at() -> None:
    def ends(x_m: list[float], others_m: list[float]) -> list[int]:
        places = (np.column_stack([each, np.zeros((len(each), 2))]) for each in (x_m, others_m))
        return _find_ends(*places, QueryConfig(max_pair_m=2.0)).tolist()

    way = [0.0, 1.0, 2.0, 3.0, 4.0]
    assert ends(way, [-1.5, 2.0, 5.5]) == [0, 4]
    assert ends(way, [5.5, 2.5]) == [4]  # driven the other way, and not as far
    assert ends(way, [9.0, 5.5, 2.0, -0.5, -3.0]) == [0, 4]  # driven on at both
    assert ends(way, [9.0, 6.5, -2.5]) == []
    assert ends([1.0], [0.0]) == [0]
    assert ends([], way) == ends(way, []) == []


def test_scores_of_the_sphere_difference_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    before = session([(0, 0, 0), (2, 0, 0), (4, 0, 0), (10, 0, 0)], [[1, 0]] * 4)
    monkeypatch.setattr("cdpipe.query.query.sphere_difference", lambda *_: np.array([0.1, 0.5, np.nan, 0.2]))
    merged = MergedMaps(before[0], before[0], make_pose(), {}, True)
    # without a map the drift counts as narrow, and the surroundings reach 4.5 m; 3 % less per metre
    follows = find_regions(merged, before[1], before[1], by("sphere-difference", radius_m="width"))
    np.testing.assert_allclose(follows.keyframe_scores, [0.5 * 0.94, 0.5, 0.5 * 0.94, 0.2])
    fixed = find_regions(merged, before[1], before[1], by("sphere-difference", radius_m=4.5))
    np.testing.assert_array_equal(fixed.keyframe_scores, [0.1, 0.5, np.nan, 0.2])


# Three stations of a tripod, and a robot that goes on for 10 m beyond the last.
STATIONS = session([(x, 0, 0) for x in (0.0, 10.0, 20.0)], [[1, 0]] * 3)
DRIVE = session([(x, 1, 0) for x in np.arange(0.0, 31.0).tolist()], [[1, 0]] * 31)


def test_between_the_stations_of_a_survey_it_is_asked_at_the_keyframes_of_the_robot() -> None:
    merged = MergedMaps(STATIONS[0], DRIVE[0], make_pose(), {}, True)
    found = find_regions(merged, STATIONS[1], DRIVE[1], by("every-keyframe", suppression=1e-9))
    # those within 7.5 m of a station
    assert sorted(found.centres_map[:, 0].tolist()) == list(range(28))
    assert found.direction is not None and (found.direction == 1).all()
    pairs = dict(zip(found.pairs[:, 1].tolist(), found.pairs[:, 0].tolist(), strict=True))
    assert [pairs[k] for k in (0, 4, 6, 14, 16, 25)] == [0, 0, 1, 1, 2, 2]
    assert found.keyframe_scores.tolist() == [0.0, 0.0, 0.0]
    # the paper asks at the keyframes of both sessions, each within 5 m of its partner
    paper = find_regions(merged, STATIONS[1], DRIVE[1], by("scan", reading="paired", suppression=1e-9))
    of_drive = sorted(paper.centres_map[paper.direction == 1][:, 0].tolist())
    assert of_drive == [x for x in range(31) if x % 10 != 5 and x < 25]
    # the other way round the stations are the after session; two drives, or two surveys, have no gaps
    longer = session([(1.003 * x, 0, 0) for x in (0.0, 10.0, 20.0)], [[1, 0]] * 3)
    for before, after in ((DRIVE, STATIONS), (DRIVE, DRIVE), (longer, STATIONS), (STATIONS, longer)):
        merged = MergedMaps(before[0], after[0], make_pose(), {}, True)
        found = find_regions(merged, before[1], after[1], by("every-keyframe", suppression=1e-9))
        assert found.direction is not None and (found.direction == 0).all()


@pytest.mark.parametrize("source", ["sphere", "sphere-difference"])
def test_stations_have_the_best_score_around_them(source: str, monkeypatch: pytest.MonkeyPatch) -> None:
    local = np.full(31, 0.1)
    local[[3, 7]] = 0.5, 0.4
    name = {"sphere": "change_log_odds", "sphere-difference": "sphere_difference"}[source]
    sessions = []
    monkeypatch.setattr(f"cdpipe.query.query.{name}", lambda *given: sessions.append(given[-1]) or local)
    merged = MergedMaps(STATIONS[0], DRIVE[0], make_pose(), {}, True)
    found = find_regions(merged, STATIONS[1], DRIVE[1], by(source, radius_m=4.5))
    assert sessions == ["after"]
    assert found.centres_map[0].tolist() == [3.0, 1.0, 0.0] and found.scores[0] == 0.5
    away_m = np.sqrt(10.0)
    first, second = (0.5 - 0.1 * away_m, 0.4 - 0.1 * away_m) if source == "sphere" else (
        0.5 * (1 - 0.03 * away_m), 0.4 * (1 - 0.03 * away_m)
    )  # fmt: skip
    np.testing.assert_allclose(found.keyframe_scores[:2], [first, second])
