"""Outcomes of regions by hand and against loops; coverage, keyframe labels and the way from the map into the world."""

import numpy as np
import pytest

from cdpipe.core.geometry import invert, stream, transform, yaw_pose
from eval.scoring.region_metrics import (
    compute_recall_at_k,
    label_keyframes,
    match_regions,
    measure_covered_share,
    transform_to_map,
    transform_to_world,
)
from eval.truth.ground_truth import SessionTruth
from eval.truth.scoring_points import ScoringPoints

EMPTY = ScoringPoints(
    returns=np.zeros(0, dtype=np.int64),
    points_odom=np.zeros((0, 3), dtype=np.float32),
    change=np.zeros(0, dtype=np.int16),
    instance=np.zeros(0, dtype=np.int16),
    n_scans=1,
    n_pixels=1,
)


def on_line(*x_m: float) -> np.ndarray:
    return np.array([(x, 0.0, 0.0) for x in x_m]).reshape(-1, 3)


def test_every_outcome_by_hand() -> None:
    # changes at 0, 6 (observable) and 50 (not); radius 4.5
    centroids, is_observable = on_line(0, 6, 50), np.array([True, True, False])
    #          finds 6   only 6 again  finds 0 and 6   nothing  only 50  not reported
    centres = on_line(7, 8, 3, 30, 52, 0)
    reported = np.array([True, True, True, True, True, False])
    matches = match_regions(centres, reported, centroids, is_observable, 4.5)
    assert matches.outcomes == ("true", "duplicate", "true", "false", "ignored", "unreported")
    assert matches.found == ((1,), (1,), (0, 1), (), (2,), (0,))
    assert matches.best_region.tolist() == [2, 0, 4]
    assert [matches.count(name) for name in ("true", "duplicate", "false", "ignored")] == [2, 1, 1, 1]


def test_a_centre_at_exactly_the_radius_finds() -> None:
    one = np.array([True])
    assert match_regions(on_line(4.5), one, on_line(0), one, 4.5).outcomes == ("true",)
    assert match_regions(on_line(4.5 + 1e-9), one, on_line(0), one, 4.5).outcomes == ("false",)


def test_a_region_near_both_kinds_of_change_is_judged_by_the_observable_one() -> None:
    one = np.array([True])
    matches = match_regions(on_line(0), one, on_line(1, 2), np.array([True, False]), 4.5)
    assert matches.outcomes == ("true",)


def outcomes_by_loops(
    centres: np.ndarray, reported: np.ndarray, centroids: np.ndarray, is_observable: np.ndarray, radius_m: float
) -> tuple[list[str], set[int]]:
    taken: set[int] = set()
    outcomes = []
    for centre, is_reported in zip(centres, reported, strict=True):
        near = {i for i, c in enumerate(centroids) if np.linalg.norm(c - centre) <= radius_m}
        countable = {i for i in near if is_observable[i]}
        if not is_reported:
            outcomes.append("unreported")
        elif countable - taken:
            outcomes.append("true")
        elif countable:
            outcomes.append("duplicate")
        else:
            outcomes.append("ignored" if near else "false")
        if is_reported:
            taken |= countable
    return outcomes, taken


@pytest.mark.parametrize("seed", range(10))
def test_outcomes_equal_the_loops(seed: int) -> None:
    draw = stream(seed, "regions")
    centres, centroids = draw.uniform(0, 30, (25, 3)), draw.uniform(0, 30, (8, 3))
    reported, is_observable = draw.random(25) < 0.7, draw.random(8) < 0.6
    matches = match_regions(centres, reported, centroids, is_observable, 9.0)
    outcomes, taken = outcomes_by_loops(centres, reported, centroids, is_observable, 9.0)
    assert list(matches.outcomes) == outcomes
    assert set(np.flatnonzero((matches.best_region >= 0) & is_observable)) == taken


def test_recall_at_k_looks_at_as_many_candidates_as_there_are_changes() -> None:
    is_observable = np.array([True, True, False])
    # K = 2: the third candidate comes too late, and finding the unobservable change earns nothing
    assert compute_recall_at_k([(0, 2), (0,), (1,)], is_observable) == 0.5
    assert compute_recall_at_k([(0,), (1,)], is_observable) == 1.0
    assert compute_recall_at_k([], is_observable) == 0.0
    assert np.isnan(compute_recall_at_k([(0,)], np.array([False])))


def test_coverage_by_hand() -> None:
    # 40 steps of a quarter metre along x; a sphere of 1 m at x = 2 holds the 8 steps between 1 and 3
    x = np.arange(41) * 0.25
    positions = on_line(*x)
    assert measure_covered_share(positions, x, on_line(2.0), np.ones(1)) == 8 / 40
    assert measure_covered_share(positions, x, on_line(2.0, 8.0), np.array([1.0, 0.5])) == 12 / 40
    # overlapping spheres count once
    assert measure_covered_share(positions, x, on_line(2.0, 2.0), np.ones(2)) == 8 / 40
    assert measure_covered_share(positions, x, on_line(5.0), np.array([100.0])) == 1.0
    assert measure_covered_share(positions, x, on_line(), np.zeros(0)) == 0.0
    assert np.isnan(measure_covered_share(on_line(0.0), np.zeros(1), on_line(0.0), np.ones(1)))


def test_keyframe_labels_by_hand() -> None:
    # radius 4: observable change at 0, unobservable one at 40; negatives are more than 6 m from both
    labels = label_keyframes(on_line(0, 4, 5, 6, 6.1, 33.9, 34, 40), on_line(0, 40), np.array([True, False]), 4.0)
    assert labels.tolist() == [1, 1, -1, -1, 0, 0, -1, -1]


def test_without_changes_every_keyframe_is_a_negative() -> None:
    assert label_keyframes(on_line(0, 1), on_line(), np.zeros(0, dtype=np.bool_), 4.0).tolist() == [0, 0]


def test_centres_go_into_the_world_through_the_nearest_keyframe() -> None:
    # the odometry is right at the start and 1 m and a right angle off at x = 10
    world_T_sensor = np.stack([yaw_pose(0.0), yaw_pose(np.pi / 2, (10.0, 1.0, 0.0))])
    odom_T_sensor = np.stack([yaw_pose(0.0), yaw_pose(0.0, (10.0, 0.0, 0.0))])
    before = SessionTruth(odom_T_sensor, world_T_sensor, EMPTY)
    centres = transform_to_world(on_line(1.0, 9.0), before)
    # the second centre lies 1 m behind keyframe 1, which truly looks along +y from (10, 1)
    np.testing.assert_allclose(centres, [(1.0, 0.0, 0.0), (10.0, 0.0, 0.0)], atol=1e-12)


def test_moving_the_odom_frame_changes_no_place_in_the_world() -> None:
    draw = stream(3, "odom")
    world_T_sensor = np.stack([yaw_pose(draw.uniform(-1, 1), draw.uniform(0, 20, 3)) for _ in range(6)])
    moved = yaw_pose(2.0, (5.0, -3.0, 1.0))
    centres_world = draw.uniform(0, 20, (9, 3))
    centres_odom = transform(invert(moved), centres_world)
    before = SessionTruth(invert(moved) @ world_T_sensor, world_T_sensor, EMPTY)
    np.testing.assert_allclose(transform_to_world(centres_odom, before), centres_world, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_places_go_into_the_map_and_back(seed: int) -> None:
    draw = stream(seed, "places")
    along = np.arange(0.0, 60.0, 6.0)
    world_T_sensor = np.stack([yaw_pose(draw.uniform(-3, 3), (x, draw.uniform(-1, 1), 0.5)) for x in along])
    bends = np.stack([yaw_pose(0.01 * k, (40.0 + 0.05 * k, -7.0, 0.02 * k)) for k in range(len(along))])
    before = SessionTruth(bends @ world_T_sensor, world_T_sensor, EMPTY)
    # within 2 m of a judged scan, so that the nearest one is the same in either frame
    places = world_T_sensor[draw.choice(len(along), 20), :3, 3] + draw.uniform(-1.1, 1.1, (20, 3))
    found = transform_to_map(places, before)
    nearest = np.linalg.norm(places[:, None] - world_T_sensor[:, :3, 3], axis=2).argmin(axis=1)
    expected = [transform(bends[k], place[None])[0] for k, place in zip(nearest, places, strict=True)]
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(transform_to_world(found, before), places, atol=1e-9)
    assert transform_to_map(np.zeros((0, 3)), before).shape == (0, 3)
