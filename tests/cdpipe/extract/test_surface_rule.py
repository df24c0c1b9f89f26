from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

import cdpipe.extract.objects
import cdpipe.extract.surface_rule
from cdpipe.core.geometry import Float64Array, invert, make_pose, stream, transform, yaw_pose
from cdpipe.extract.objects import PointGroup, ReturnPool
from cdpipe.extract.surface_rule import cut_by_surface, realign
from cdpipe.merge.registration import Surface
from cdpipe.model.config import ExtractConfig
from cdpipe.model.types import MergedMaps, PointMap
from tests.cdpipe.cut_rooms import CONFIG, CRATE, MIDDLE, Scanned, cut, iou, returns_of, scanned
from tests.cdpipe.rooms import PATH, Box, RoomScans, room_regions

BARREL: Box = ((-2.2, -2.6, 0.0), (-1.6, -1.9, 0.6))
BEAM: Box = ((-1.2, 2.0, 0.0), (1.2, 2.5, 0.5))  # longer than what lies between two regions
# What lies this near to floor or wall is no farther off than noise and cells of 0.05 m.
FOOT_M = 0.06


def assert_is_cut_out(group: PointGroup, session: Scanned, box: int, lowest_m: float = FOOT_M) -> None:
    """Everything that hit a box is in the group but for its foot, and nothing else but what lies right beside it."""
    scans, point_map = session
    found, true = returns_of(point_map, group), scans.returns_on(box)
    assert len(true) > 500
    assert len(found) == len(group.returns)
    missed = scans.places(true - found)
    assert missed[:, 2].max(initial=0.0) < lowest_m
    assert len(found - true) < 0.01 * len(true)
    assert len(found & true) > 0.9 * len(true)
    # map points and thinned points are of the same returns
    assert set(point_map.return_points[group.returns].tolist()) == set(group.indices.tolist())
    assert cKDTree(scans.places(found)).query(group.points_map)[0].max() < 0.1


def test_an_added_box_is_its_returns() -> None:
    after = scanned((CRATE,), 2)
    (group,) = cut(scanned((), 1), after)
    assert (group.session, group.region) == ("after", 0)
    assert_is_cut_out(group, after, 0)


def test_a_removed_box_is_its_returns_in_the_before_session() -> None:
    before = scanned((CRATE,), 2)
    (group,) = cut(before, scanned((), 1))
    assert (group.session, group.region) == ("before", 0)
    assert_is_cut_out(group, before, 0)


def test_one_came_one_went_and_one_stayed() -> None:
    stays: Box = ((2.8, -2.5, 0.0), (3.6, -1.5, 1.2))
    before, after = scanned((stays, BARREL), 1), scanned((stays, CRATE), 2)
    groups = {group.session: group for group in cut(before, after)}
    assert len(groups) == 2
    assert_is_cut_out(groups["after"], after, 1)
    assert_is_cut_out(groups["before"], before, 1)


def test_a_pallet_is_found_by_the_rays_that_passed_it(monkeypatch: pytest.MonkeyPatch) -> None:
    pallet: Box = ((1.0, 1.6, 0.0), (2.2, 2.6, 0.144))
    before, after = scanned((), 1), scanned((pallet,), 2)
    for one, other, session in ((before, after, "after"), (after, before, "before")):
        (group,) = cut(one, other)
        assert group.session == session
        assert iou(returns_of(after[1], group), after[0].returns_on(0)) > 0.8
    assert cut(after, scanned((pallet,), 3)) == []
    monkeypatch.setattr(
        cdpipe.extract.surface_rule, "grazing_ray_count", lambda points, *_: np.zeros(len(points), np.int64)
    )
    assert cut(before, after) == []


@pytest.mark.parametrize(("apart_m", "is_found"), [(1.0, False), (10.0, True)])
@pytest.mark.parametrize("height_m", [0.144, 0.8])
def test_one_of_the_stations_of_a_survey_is_enough(apart_m: float, is_found: bool, height_m: float) -> None:
    hall: Box = ((-5.0, -4.0, 0.0), (20.0, 4.0, 3.0))
    box: Box = ((-0.6, 1.6, 0.0), (0.6, 2.6, height_m))
    screen: Box = ((1.5, -3.0, 0.0), (1.6, 4.0, 3.0))  # hides it from all but the first
    stations = tuple((-2.0 + apart_m * k, -2.0, 1.5) for k in range(3) if k == 0 or apart_m * k > 4.0)
    far = tuple((4.0 + apart_m * k, -2.0, 1.5) for k in range(3))
    survey = RoomScans((screen,), 1, stations if apart_m > 4.0 else (stations[0], *far), room=hall)
    robot = RoomScans((screen, box), 2, tuple((x, -1.0, 1.5) for x in np.arange(-4.0, 1.0, 0.5).tolist()), room=hall)
    found = cut((survey, survey.mapped()), (robot, robot.mapped()))
    assert bool(found) == is_found


def test_nothing_changed() -> None:
    assert cut(scanned((), 1), scanned((), 3)) == []
    assert cut(scanned((CRATE, BARREL), 1), scanned((CRATE, BARREL), 2)) == []


def test_two_objects_in_one_region_are_two() -> None:
    beside: Box = ((2.4, 1.5, 0.0), (2.9, 2.0, 0.6))  # 0.4 m from the crate
    after = scanned((CRATE, beside, BARREL), 2)
    groups = cut(scanned((), 1), after)
    assert len(groups) == 3
    for box in range(3):
        (whole,) = [group for group in groups if returns_of(after[1], group) & after[0].returns_on(box)]
        assert_is_cut_out(whole, after, box, lowest_m=0.12)


@pytest.mark.parametrize("gap_m", [0.6, 0.8, 1.1])
def test_objects_apart_share_no_return(gap_m: float) -> None:
    # candidates 0.5 m apart are looked at together, and everything within 0.5 m of them
    beside: Box = ((2.0 + gap_m, 1.5, 0.0), (2.5 + gap_m, 2.0, 0.6))
    after = scanned((CRATE, beside), 2)
    found = [returns_of(after[1], group) for group in cut(scanned((), 1), after)]
    assert len(found) == 2
    assert not found[0] & found[1]


def test_an_object_between_two_regions_is_one() -> None:
    after = scanned((BEAM,), 2)
    # each sphere holds one end of it
    (group,) = cut(scanned((), 1), after, [(1.9, 2.2, 0.5), (-1.9, 2.2, 0.5)], radius_m=1.9)
    assert group.region == 0
    assert_is_cut_out(group, after, 0)
    # and one end is enough to find it
    (alone,) = cut(scanned((), 1), after, [(-1.9, 2.2, 0.5)], radius_m=1.9)
    assert iou(returns_of(after[1], alone), returns_of(after[1], group)) > 0.98


def test_a_long_site_is_compared_region_by_region(monkeypatch: pytest.MonkeyPatch) -> None:
    before, after = scanned((), 1), scanned((BEAM,), 2)
    centres = [(1.9, 2.2, 0.5), (-1.9, 2.2, 0.5)]
    (whole,) = cut(before, after, centres, radius_m=1.9)
    monkeypatch.setattr(cdpipe.extract.surface_rule, "_LONG_SITE_M", 2.0)
    parts = cut(before, after, centres, radius_m=1.9)
    assert [part.region for part in parts] == [0, 1]
    one, other = (returns_of(after[1], part) for part in parts)
    assert not one & other and min(len(one), len(other)) > 1000
    assert iou(one | other, returns_of(after[1], whole)) > 0.98


def test_what_lies_out_of_all_spheres_is_not_looked_at() -> None:
    before, after = scanned((), 1), scanned((CRATE, BARREL), 2)
    (group,) = cut(before, after, [(-1.9, -2.2, 0.3)], radius_m=1.0)
    assert_is_cut_out(group, after, 1)
    assert cut(before, after, [(3.5, -3.0, 0.5), (60.0, 0.0, 0.0)], radius_m=1.0) == []
    # an object beside the sphere is not its business, though its margin holds it whole
    assert cut(before, after, [(-0.3, -2.25, 0.3)], radius_m=1.0) == []
    pair = MergedMaps(before[1], after[1], np.eye(4), {}, True)
    silent = replace(room_regions([MIDDLE]), is_reported=np.zeros(1, np.bool_))
    assert cut_by_surface(pair, silent, CONFIG) == []
    assert cut_by_surface(pair, room_regions([]), CONFIG) == []


def test_what_the_other_session_never_saw_is_no_change() -> None:
    # a partition hides the far end of the room from the one session; the other looks behind it
    partition: Box = ((1.9, -4.0, 0.0), (2.1, 4.0, 3.0))
    hidden: Box = ((3.0, 1.0, 0.0), (3.8, 2.0, 0.9))
    near = tuple(place for place in PATH if place[0] < 1.0)
    kept_out = scanned((partition,), 1, near)
    inside = scanned((partition, hidden), 2, (*near, *((x, 0.0, 1.5) for x in (2.6, 3.0, 3.4))))
    looked = scanned((partition,), 3, (*near, *((2.8, y, 1.5) for y in (-2.5, -2.0, -1.5, -1.0, 0.5))))
    glanced = scanned((partition,), 4, (*near, (2.8, -1.0, 1.5)))
    centres = [(2.5, 0.5, 1.0)]
    assert cut(kept_out, inside, centres) == []
    assert cut(inside, kept_out, centres) == []
    assert cut(glanced, inside, centres) == []  # one keyframe is not enough
    twice = scanned((partition,), 4, (*near, (2.8, -1.0, 1.5), (2.8, 0.5, 1.5)))
    assert cut(twice, inside, centres) == []  # nor are two, but in mist
    assert twice[1].views is not None
    met = twice[1].views.ranges_m.copy()
    met[0, 0, 0] = -0.7
    misty = twice[0], replace(twice[1], views=replace(twice[1].views, ranges_m=met))
    (in_mist,) = cut(misty, inside, centres)
    assert iou(returns_of(inside[1], in_mist), inside[0].returns_on(1)) > 0.9
    (group,) = cut(looked, inside, centres)
    assert iou(returns_of(inside[1], group), inside[0].returns_on(1)) > 0.9
    # nobody remembers what was seen through: then everything that stands off is new
    forgetful = kept_out[0], replace(kept_out[1], views=None)
    assert len(cut(forgetful, inside, centres)) >= 1


def test_moving_both_sessions_moves_the_objects() -> None:
    g, h = yaw_pose(0.9, (140.0, -38.0, 4.1)), yaw_pose(-1.7, (-27.0, 63.3, 0.7))
    boxes = ((BARREL,), (CRATE,))
    plain = [scanned(each, sample) for sample, each in enumerate(boxes, 1)]
    moved = [
        RoomScans(each, sample, odom_T_room=pose)
        for sample, (each, pose) in enumerate(zip(boxes, (g, h), strict=True), 1)
    ]
    maps = [scans.mapped() for scans in moved]
    pair = MergedMaps(maps[0], maps[1], g @ invert(h), {}, True)
    centre = tuple(transform(g, np.array([MIDDLE]))[0].tolist())
    groups = cut_by_surface(pair, room_regions([centre]), CONFIG)
    expected = cut(plain[0], plain[1])
    assert [group.session for group in groups] == [group.session for group in expected] == ["after", "before"]
    for group, other, is_after in zip(groups, expected, (True, False), strict=True):
        # other cells, so a few returns at the foot fall on the other side
        found, wanted = returns_of(maps[is_after], group), returns_of(plain[is_after][1], other)
        assert iou(found, wanted) > 0.97
        differing = moved[is_after].places(found ^ wanted)
        assert transform(invert((g, h)[is_after]), differing)[:, 2].max(initial=0.0) < 0.1
        assert cKDTree(other.points_map).query(transform(invert(g), group.points_map))[0].max() < 0.1


@pytest.mark.parametrize("shift", [(0.0, 0.05, -0.09), (0.06, -0.07, 0.04)])
def test_realigning_mends_a_merge_that_is_ten_centimetres_off(shift: tuple[float, float, float]) -> None:
    before, after = scanned((BARREL,), 1), scanned((CRATE,), 2)
    off = yaw_pose(0.006, shift)
    pair = MergedMaps(before[1], after[1], off, {}, True)
    groups = {group.session: group for group in cut_by_surface(pair, room_regions([MIDDLE]), CONFIG)}
    assert len(groups) == 2
    for name, session in (("before", before), ("after", after)):
        assert iou(returns_of(session[1], groups[name]), session[0].returns_on(0)) > 0.9
    # the answer stays in the frame of the merge: the sides that were seen are where it has them
    points = transform(invert(off), groups["after"].points_map)
    sides = [points[:, 0].min(), points[:, 0].max(), points[:, 1].min(), points[:, 2].max()]
    np.testing.assert_allclose(sides, [1.0, 2.0, 1.5, 0.8], atol=0.01)
    as_merged = cut_by_surface(pair, room_regions([MIDDLE]), ExtractConfig(realign=False))
    crate = after[0].returns_on(0)
    assert (
        max((iou(returns_of(after[1], each), crate) for each in as_merged if each.session == "after"), default=0.0)
        < 0.9
    )


def room_points(n: int, seed: int) -> Float64Array:
    """Points on floor, walls and a crate of a room about the origin."""
    rng = stream(seed, "points")
    points = rng.uniform(-1, 1, (n, 3)) * (4, 3, 1.5)
    side = rng.integers(0, 6, n)
    for axis in range(3):
        for sign in (-1, 1):
            points[side == 2 * axis + (sign > 0), axis] = sign * (4, 3, 1.5)[axis]
    return points


@pytest.mark.parametrize(
    "error", [yaw_pose(0.02, (0.1, -0.05, 0.03)), yaw_pose(-0.01, (0.0, 0.0, 0.15)), yaw_pose(0.0, (0.35, 0.0, 0.0))]
)
def test_a_known_error_is_taken_back(error: Float64Array) -> None:
    centre = np.array([0.5, 0.0, 0.0])
    found = realign(transform(error, room_points(6000, 1)), centre, Surface(room_points(6000, 2)))
    corners = np.array([[x, y, z] for x in (-4, 4) for y in (-3, 3) for z in (-1.5, 1.5)])
    np.testing.assert_allclose(transform(found @ error, corners), corners, atol=0.005)


def test_a_correction_carries_no_sphere_far() -> None:
    centre = np.zeros(3)
    surface = Surface(room_points(6000, 2))
    for far_m in (0.45, 1.0):
        away = room_points(6000, 1) + np.array([far_m, 0.0, 0.0])
        found = realign(away, centre, surface)
        # 0.45 m off it could be pulled back and is not; a metre off nothing pulls it
        assert np.linalg.norm(found[:3, 3]) < 0.1
    assert (realign(room_points(6000, 1) + np.array([0.45, 0.0, 0.0]), centre, surface) == np.eye(4)).all()
    # 99 points are too few to align
    off = room_points(6000, 1) + np.array([0.1, 0.0, 0.0])
    assert (realign(off[:99], centre, surface) == np.eye(4)).all()
    assert (realign(off, centre, Surface(room_points(99, 2))) == np.eye(4)).all()


@pytest.mark.parametrize("block_returns", [1, 7, 1 << 22])
def test_returns_of_map_points(block_returns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cdpipe.extract.objects, "_BLOCK_RETURNS", block_returns)
    owners = stream(0, "owners").integers(0, 30, 200).astype(np.int32)
    point_map = PointMap(
        np.zeros((30, 3)), np.zeros(30, np.float32), 0.2, np.eye(4)[None], np.zeros(1, np.int64), owners, owners,
        np.array([0, 200]),
    )  # fmt: skip
    wanted = [np.array([3, 17, 4]), np.array([], np.int64), np.array([4, 29])]
    pool = ReturnPool(point_map, wanted)
    for indices in wanted:
        expected = [number for owner in indices.tolist() for number in np.flatnonzero(owners == owner).tolist()]
        assert pool.of(indices).tolist() == expected
    assert ReturnPool(point_map, []).of(np.array([], np.int64)).shape == (0,)


def test_maps_without_places_of_returns_are_refused() -> None:
    before, after = scanned((), 1), scanned((CRATE,), 2)
    forgetful = after[0], replace(after[1], return_offsets=None)
    with pytest.raises(ValueError, match="return_offsets is None"):
        cut(before, forgetful)


def test_a_handful_of_points_is_no_surface() -> None:
    before, after = scanned((), 1), scanned((CRATE,), 2)
    for n_points in (1, 4, 12):
        few = replace(
            before[1],
            points=before[1].points[:n_points],
            nearest_m=before[1].nearest_m[:n_points],
            seen_from=None,
            return_points=np.zeros(0, np.int32),
            return_pixels=np.zeros(0, np.int32),
            return_offsets=np.zeros((0, 3), np.uint8),
            scan_offsets=np.zeros_like(before[1].scan_offsets),
        )
        centre = tuple(few.points.mean(axis=0).tolist())
        pair = MergedMaps(few, after[1], make_pose(), {}, True)
        assert len(cut_by_surface(pair, room_regions([centre], 3.0), CONFIG)) < 5
