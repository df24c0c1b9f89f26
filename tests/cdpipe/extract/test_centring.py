from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, stream, transform, yaw_pose
from cdpipe.extract.centring import centre_regions
from cdpipe.extract.extract import extract_changes
from cdpipe.extract.objects import PointGroup
from cdpipe.model.config import load_config
from cdpipe.model.report import ChangeRegions, ChangeReport
from cdpipe.model.types import DescriptorSet, MergedMaps
from tests.cdpipe.rooms import Box, RoomScans, room_regions

RADIUS_M = 4.0
# a small cloud around the origin, and the same with more points
FEW = np.array([(x, y, z) for x in (-0.2, 0.2) for y in (-0.2, 0.2) for z in (-0.2, 0.2)])
MANY = np.concatenate([FEW, FEW / 2])


def group(x: float, y: float = 0.0, z: float = 0.0, points: Float64Array = FEW, region: int = 0) -> PointGroup:
    return PointGroup("after", np.arange(len(points)), points + np.array([x, y, z]), region)


def regions(*centres: tuple[float, float], n_reported: int = 9) -> ChangeRegions:
    found = room_regions([(x, y, 0.0) for x, y in centres], RADIUS_M)
    is_reported = np.arange(len(centres)) < n_reported
    return replace(found, is_reported=is_reported, is_withdrawn=np.zeros(len(centres), np.bool_))


def test_a_region_is_centred_on_the_object_at_its_rim_and_keeps_the_proposed_centre() -> None:
    proposed = regions((0, 0), (20, 0), (40, 0), n_reported=2)
    found, (crate,) = centre_regions(proposed, [group(3.9, 1.0, region=1)])
    # 4.03 m away, but a part of it lies in the sphere; the regions without objects stay, reported or not
    np.testing.assert_allclose(found.centres_map, [(3.9, 1, 0), (20, 0, 0), (40, 0, 0)], atol=1e-12)
    assert found.proposed_centres_map is proposed.centres_map
    assert found.is_reported.tolist() == [True, True, False]
    assert found.is_withdrawn is not None and not found.is_withdrawn.any()
    for same in ("scores", "pairs", "radius_m", "keyframe_scores"):
        assert getattr(found, same) is getattr(proposed, same)
    assert crate.region == 0


def test_a_region_with_two_objects_is_centred_between_them() -> None:
    found, _ = centre_regions(regions((0, 1)), [group(-3, points=MANY), group(3.5)])
    np.testing.assert_allclose(found.centres_map, [(0.25, 0, 0)], atol=0.05)


def test_what_is_too_far_apart_for_one_sphere_is_centred_without_the_smallest_object() -> None:
    # the two ends of a long heap lie 8.4 m apart: each object's part in the margin of the sphere counts
    far = [group(-4.1, points=MANY), group(4.1), group(-3.0)]
    found, _ = centre_regions(regions((0, 0)), far)
    np.testing.assert_allclose(found.centres_map, [(-4.1, 0, 0)], atol=1e-9)


def test_objects_beyond_the_reported_regions_report_no_more_regions_than_asked_for() -> None:
    proposed = regions((0, 0), (3, 0), (30, 0), n_reported=1)
    far = [group(-3.9), group(4.3, region=0)]  # the second is followed out of the sphere, and lies in the next one
    assert centre_regions(proposed, far)[0].is_reported.tolist() == [True, True, False]
    for most, expected in ((2, [True, True, False]), (1, [True, False, False])):
        assert centre_regions(proposed, far, most=most)[0].is_reported.tolist() == expected


def test_only_the_part_of_an_object_near_the_sphere_counts() -> None:
    wall = np.column_stack([np.linspace(3.0, 30.0, 271), np.zeros(271), np.zeros(271)])
    found, _ = centre_regions(regions((0, 0)), [PointGroup("before", np.arange(271), wall, 0)])
    np.testing.assert_allclose(found.centres_map, [(3.0 + 2.5 / 2, 0, 0)], atol=1e-9)  # 1.5 m beyond the sphere


def test_a_region_whose_objects_are_in_better_ones_is_withdrawn_and_other_objects_are_its_own() -> None:
    proposed = regions((0, 0), (6, 0), (12, 0))
    objects = [group(3.0, region=1), group(9.5, region=1), group(2.0, region=0)]
    found, assigned = centre_regions(proposed, objects)
    # the first holds the objects at 2 and 3; the second holds 3 and 9.5, of which 9.5 is its own; the third holds 9.5
    np.testing.assert_allclose(found.centres_map[:, 0], [2.5, 9.5, 12.0], atol=0.02)
    assert found.is_reported.tolist() == [True, True, False]
    assert found.is_withdrawn is not None
    assert found.is_withdrawn.tolist() == [False, False, True]
    assert [each.region for each in assigned] == [0, 1, 0]
    kept, _ = centre_regions(replace(proposed, is_withdrawn=None), objects, withdraw=False)
    np.testing.assert_array_equal(kept.centres_map, found.centres_map)
    assert kept.is_reported.all()
    assert kept.is_withdrawn is None


def test_what_comes_into_the_sphere_with_its_new_centre_counts_for_the_centre() -> None:
    # 4.9 m from the proposed centre, 3.9 m from the object at 1: the second region, proposed on it, has nothing else
    found, assigned = centre_regions(regions((0, 0), (7, 0)), [group(1.0), group(4.9)])
    np.testing.assert_allclose(found.centres_map[0], (2.95, 0, 0), atol=0.03)
    assert found.is_reported.tolist() == [True, False]
    assert [each.region for each in assigned] == [0, 0]
    # a part of it in the sphere is not enough, for then it justifies a region of its own
    found, _ = centre_regions(regions((0, 0), (7, 0)), [group(1.0), group(5.1)])
    np.testing.assert_allclose(found.centres_map[:, 0], [1.0, 5.1], atol=1e-9)
    assert found.is_reported.tolist() == [True, True]


def test_every_region_has_its_own_reach() -> None:
    proposed = replace(regions((0, 0), (8, 0)), radius_m=np.array([2.0, 5.0]))
    found, assigned = centre_regions(proposed, [group(1.0), group(3.5)])
    np.testing.assert_allclose(found.centres_map[:, 0], [1.0, 3.5], atol=1e-9)
    # 3.5 is 2.5 m from the first centre, and inside the second sphere
    assert [each.region for each in assigned] == [0, 1]
    larger = replace(proposed, radius_m=np.array([5.0, 2.0]))
    np.testing.assert_allclose(centre_regions(larger, [group(1.0), group(3.5)])[0].centres_map[0, 0], 2.25, atol=0.02)


def test_an_object_out_of_reach_of_all_regions_keeps_its_region() -> None:
    found, assigned = centre_regions(regions((0, 0), (50, 0)), [group(1.0, region=0), group(60.0, region=1)])
    assert [each.region for each in assigned] == [0, 1]
    np.testing.assert_allclose(found.centres_map[1], (50, 0, 0))
    nothing = replace(regions((0, 0)), is_reported=np.zeros(1, np.bool_))
    assert centre_regions(nothing, [group(1.0, region=0)])[1][0].region == 0


def smallest_ball(places: Float64Array) -> tuple[Float64Array, float]:
    """The smallest ball around (N, 3) places: the smallest one through two, three or four of them that holds all."""
    best = (places[0], 0.0 if len(places) == 1 else np.inf)
    for size in (2, 3, 4):
        for chosen in combinations(places, size):
            offsets = np.array(chosen[1:]) - chosen[0]
            centre = chosen[0] + np.linalg.lstsq(2 * offsets, (offsets**2).sum(axis=1), rcond=None)[0]
            reach_m = float(np.linalg.norm(places - centre, axis=1).max())
            if reach_m < best[1]:
                best = (centre, reach_m)
    return best


@pytest.mark.parametrize("seed", range(8))
def test_the_ball_is_the_smallest_and_moving_the_map_moves_it(seed: int) -> None:
    rng = stream(seed, "centring")
    places = rng.uniform(-2.0, 2.0, (1 + seed % 5, 3))
    objects = [group(*place) for place in places.tolist()]
    found, _ = centre_regions(regions((0.1, 0.2)), objects)
    _, reach_m = smallest_ball(places)
    assert np.linalg.norm(places - found.centres_map[0], axis=1).max() <= 1.02 * reach_m + 1e-9
    pose = yaw_pose(1.1, (30.0, -7.0, 2.0))
    moved = replace(regions((0, 0)), centres_map=transform(pose, np.array([[0.1, 0.2, 0.0]])))
    turned, _ = centre_regions(moved, [replace(each, points_map=transform(pose, each.points_map)) for each in objects])
    np.testing.assert_allclose(turned.centres_map, transform(pose, found.centres_map), atol=1e-6)


BOX: Box = ((1.0, 1.5, 0.0), (2.0, 2.3, 0.8))
PROPOSED = (-2.0, 0.0, 1.0)


def extracted(preset: str, settings: Sequence[str]) -> ChangeReport:
    before, after = (RoomScans(boxes, sample).mapped() for boxes, sample in (((), 1), ((BOX,), 2)))
    described = DescriptorSet(np.zeros((7, 2), np.float32), None, np.arange(7), "none", "")
    pair = MergedMaps(before, after, np.eye(4), {}, True)
    proposed = room_regions([PROPOSED], 4.0)
    return extract_changes(pair, proposed, (described, described), 0.0, load_config(preset, settings))


def test_extraction_centres_the_region_of_the_surface_rule_alone() -> None:
    report = extracted("tunnelcd", [])
    assert len(report.objects) == 1
    np.testing.assert_allclose(report.regions.centres_map[0], (1.5, 1.9, 0.4), atol=0.25)
    assert report.regions.proposed_centres_map is not None
    np.testing.assert_array_equal(report.regions.proposed_centres_map, [PROPOSED])
    assert report.figures["oe_points"][0] == report.objects[0].score
    as_proposed = extracted("tunnelcd", ["extract.recentre=false"])
    np.testing.assert_array_equal(as_proposed.regions.centres_map, [PROPOSED])
    assert as_proposed.regions.proposed_centres_map is None
    np.testing.assert_array_equal(as_proposed.objects[0].returns, report.objects[0].returns)
    paper = extracted("paper", ["outlier.sigmas=100"])
    assert len(paper.objects) > 0
    np.testing.assert_array_equal(paper.regions.centres_map, [PROPOSED])
    assert paper.regions.proposed_centres_map is None


def test_settings_name_the_centre_only_where_it_stays() -> None:
    assert "recentre" not in load_config("paper").model_dump()["extract"]
    assert load_config("tunnelcd", ["extract.recentre=false"]).model_dump()["extract"]["recentre"] is False


def test_an_object_that_was_followed_out_of_all_regions_has_the_best_candidate_that_holds_it() -> None:
    proposed = regions((0, 0), (6, 0), (8, 0), n_reported=1)
    found, groups = centre_regions(proposed, [group(1.0), group(5.5), group(6.5, points=MANY)])
    assert found.is_reported.tolist() == [True, True, False]
    np.testing.assert_allclose(found.centres_map[1], (5.5, 0, 0), atol=1e-9)
    assert found.is_withdrawn is not None and not found.is_withdrawn.any()
    assert [each.region for each in groups] == [0, 1, 1]
    # no candidate holds it: it stays without a region of its own
    alone, _ = centre_regions(regions((0, 0), (30, 0), n_reported=1), [group(1.0), group(9.0)])
    assert alone.is_reported.tolist() == [True, False]
