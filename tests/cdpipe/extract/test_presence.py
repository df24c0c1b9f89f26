"""What its own session tells to be no object that stands: doubles of walls, people, machines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import cdpipe.extract.presence
from cdpipe.core.geometry import make_pose, stream
from cdpipe.extract.objects import PointGroup
from cdpipe.extract.presence import Sight, is_fleeting, is_floor
from cdpipe.model.config import ExtractConfig
from cdpipe.model.types import PosedScan
from tests.cdpipe.cut_rooms import CONFIG, CRATE, Scanned, cut, iou, returns_of, scanned
from tests.cdpipe.rooms import PATH, Box, RoomScans


def drifted(boxes: tuple[Box, ...], path: Sequence[tuple[float, float, float]], off_m: float) -> Scanned:
    """A session that came by again, the second time with an odometry that is off sideways."""
    scans = RoomScans(boxes, 2, (*PATH, *path))
    scans.odom_T_sensor[len(PATH) :, 1, 3] += off_m
    return scans, scans.mapped()


def both_ways(session: str, one: Scanned, other: Scanned, config: ExtractConfig = CONFIG) -> list[PointGroup]:
    before, after = (one, other) if session == "before" else (other, one)
    return cut(before, after, config=config)


@pytest.mark.parametrize("session", ["before", "after"])
def test_a_wall_that_hangs_in_the_room_after_drift_is_no_change(session: str, monkeypatch: pytest.MonkeyPatch) -> None:
    twice = drifted((CRATE,), ((0.0, 0.0, 1.5),), -0.5)
    (crate,) = both_ways(session, twice, scanned((), 1))
    of_first_pass = {each for each in twice[0].returns_on(0) if each[0] < len(PATH)}
    assert len(returns_of(twice[1], crate) & of_first_pass) > 0.9 * len(of_first_pass)
    monkeypatch.setattr(cdpipe.extract.presence.Sight, "is_double", lambda _: False)
    assert len(both_ways(session, twice, scanned((), 1), KEPT)) > 1


HALL: Box = ((-5.0, -4.0, 0.0), (40.0, 4.0, 3.0))
LOCKER: Box = ((1.0, 1.5, 0.0), (2.6, 3.1, 2.0))
DOWN_THE_HALL = tuple((x, 0.0, 1.5) for x in np.arange(18.0, 36.0, 1.0).tolist())


def in_the_hall(path: Sequence[tuple[float, float, float]], n_off: int = 0, off_m: float = 0.0) -> Scanned:
    """A session in a long hall with a locker; of its first scans the odometry is off sideways."""
    scans = RoomScans((LOCKER,), 2, path, room=HALL)
    scans.odom_T_sensor[:n_off, 1, 3] += off_m
    return scans, scans.mapped()


@pytest.mark.parametrize("session", ["before", "after"])
def test_what_only_scans_from_afar_show_is_no_change_where_the_session_came_near(
    session: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cdpipe.extract.presence, "_DOUBLED", np.inf)  # as from near
    monkeypatch.setattr(cdpipe.extract.presence, "_ON_ITS_WAY", np.inf)
    monkeypatch.setattr(cdpipe.extract.presence, "_PALE", np.inf)
    right = in_the_hall((*DOWN_THE_HALL, *PATH))
    off = in_the_hall((*DOWN_THE_HALL, *PATH), len(DOWN_THE_HALL), -1.2)
    assert both_ways(session, off, right) == []
    monkeypatch.setattr(cdpipe.extract.presence, "_DOUBLED_AFAR", np.inf)
    hanging = both_ways(session, off, right)[0]  # the locker again, in front of itself
    assert hanging.points_map[:, 1].max() < 1.5


@pytest.mark.parametrize(
    "path",
    [
        tuple((x, 0.0, 1.5) for x in np.arange(13.8, 36.0, 0.7).tolist()),  # it came no nearer than 12 m
        # it waited before it came
        (*((18.0, 0.0, 1.5),) * 100, *((x, 0.0, 1.5) for x in np.arange(18.0, 8.0, -0.7).tolist())),
        ((8.0, 0.0, 1.5), *DOWN_THE_HALL),  # one scan from near shows it too
    ],
)
def test_a_thing_seen_mostly_from_afar_is_a_change_all_the_same(path: Sequence[tuple[float, float, float]]) -> None:
    empty = RoomScans((), 1, (*DOWN_THE_HALL, *PATH), room=HALL)
    after = in_the_hall(path)
    found = set().union(*(returns_of(after[1], group) for group in cut((empty, empty.mapped()), after)))
    assert iou(found, after[0].returns_on(0)) > 0.7
    ranges_m = [np.linalg.norm(after[0].scan(scan).points_sensor[pixel]) for scan, pixel in found]
    assert np.mean(np.array(ranges_m) > 15.0) > 0.5


class Passing(RoomScans):
    """A room in which a crate stands while some scans are taken, and is gone in the others."""

    def __init__(self, scans: Sequence[int], path: Sequence[tuple[float, float, float]]) -> None:
        super().__init__((), 2, path)
        self._with, self._scans = RoomScans((CRATE,), 2, path), scans

    def scan(self, index: int) -> PosedScan:
        return self._with.scan(index) if index in self._scans else super().scan(index)


ALONG = tuple((x, 0.0, 1.5) for x in np.arange(-2.0, 2.5, 0.5).tolist())


@pytest.mark.parametrize("session", ["before", "after"])
def test_a_crate_that_a_third_of_the_scans_saw_through_is_no_change(session: str) -> None:
    for seen, is_change in ((range(9), True), (range(8), True), (range(4), False), ((4,), False)):
        passing = Passing(seen, ALONG)
        assert bool(both_ways(session, (passing, passing.mapped()), scanned((), 1))) == is_change, seen


@pytest.mark.parametrize("session", ["before", "after"])
def test_what_lies_beside_a_mover_in_the_same_scans_and_is_seen_through_is_no_change(session: str) -> None:
    empty = scanned((), 1)
    leaves, stands = (Passing(range(n), ALONG) for n in (7, 9))
    maps = [(each, each.mapped()) for each in (leaves, stands)]
    for (scans, point_map), y_m, moved, is_change in (
        (maps[0], 1.3, range(9), False),
        (maps[0], -1.3, range(9), True),
        (maps[0], 1.3, (2,), True),
        (maps[0], 1.3, (), True),
        (maps[1], 1.3, range(9), True),  # as in dust, which maps drop
    ):
        hits = np.repeat(np.array(moved, dtype=np.int32), 9)
        points = np.column_stack([np.tile(np.linspace(1.0, 2.0, 9), len(moved)), *np.tile([[y_m], [0.4]], len(hits))])
        here = scans, replace(point_map, mover_points=points.astype(np.float32), mover_scans=hits)
        assert bool(both_ways(session, here, empty)) == is_change, (scans, y_m, moved)
        assert both_ways(session, here, empty, KEPT)


class Plume(RoomScans):
    """A room in which few of the rays that meet a crate return from it."""

    def __init__(self, share: float) -> None:
        super().__init__((), 2, ALONG)
        self._crate = RoomScans((CRATE,), 2, ALONG)
        self._is_met = [stream(scan, "met").random(len(hits)) < share for scan, hits in enumerate(self.hits)]

    def scan(self, index: int) -> PosedScan:
        empty, full = super().scan(index), self._crate.scan(index)
        points = np.where(self._is_met[index][:, None], full.points_sensor, empty.points_sensor)
        return replace(empty, points_sensor=points)


@pytest.mark.parametrize("n_at_rest", [0, 20, 600])
def test_a_robot_at_rest_beside_a_thing_that_it_does_not_see_counts_once(n_at_rest: int) -> None:
    # the thing is hit from 10 to 40 m of the way, and seen through 0.4 times as often; the robot rests at 8 m
    path_m = np.concatenate([np.arange(0, 8, 0.1), np.full(n_at_rest, 8.0), np.arange(8, 60, 0.1)])
    keyframes = np.unique(np.searchsorted(path_m, np.arange(0, 60, 1.0)))
    hits = 100 * ((path_m[keyframes] >= 10) & (path_m[keyframes] <= 40))
    sight = Sight.__new__(Sight)
    sight._seen = np.flatnonzero((path_m >= 10) & (path_m <= 40))
    sight._path_m, sight._keyframe_scans = path_m, keyframes
    sight._odom_T_sensor = make_pose(translation=np.column_stack([path_m, 0 * path_m, 0 * path_m]))
    sight._off_m = np.maximum(np.maximum(10 - path_m, path_m - 40), 0.0)
    through = 0.4 * hits
    sight._looks = cast(Any, SimpleNamespace(n_through=through, n_hit=hits, n_pixel_through=0 * hits, n_pixel_hit=hits))
    assert not sight.is_passing()
    # a robot that never moves has scans alone to count: two of three do not see it here
    sight._path_m, sight._seen = 0 * path_m, np.arange(0, len(path_m), 3)
    sight._off_m = 0 * path_m
    assert sight.is_passing()


def test_what_few_rays_meet_is_no_change(monkeypatch: pytest.MonkeyPatch) -> None:
    before, plume, crate = scanned((), 1), Plume(0.14), Plume(0.5)
    (found,) = cut(before, (crate, crate.mapped()))
    assert len(found.returns if found.returns is not None else []) > 1000
    after = plume, plume.mapped()
    assert cut(before, after) == []
    # by the five pixels around each place, as free space is told elsewhere, it stands there
    monkeypatch.setattr(cdpipe.extract.presence, "_PALE", np.inf)
    assert len(cut(before, after)) == 1


@pytest.mark.parametrize(
    ("seen", "n_scans", "apart_m", "expected"),
    [
        ([5], 20, 0.5, True), ([5, 6, 6], 20, 0.5, True), ([5, 6, 7], 20, 0.5, False), ([5, 7], 20, 0.5, True),
        ([0], 20, 0.5, True), ([19], 20, 0.5, True), ([5], 20, 10.0, False), ([0, 1], 2, 0.5, False),
        ([0], 1, 0.5, False), ([2], 20, 0.0, True), ([5, 15], 20, 0.5, False),
    ],
)  # fmt: skip
def test_one_or_two_scans_between_near_ones_are_fleeting(
    seen: list[int], n_scans: int, apart_m: float, expected: bool
) -> None:
    poses = np.tile(np.eye(4), (n_scans, 1, 1))
    poses[:, 0, 3] = apart_m * np.arange(n_scans)
    assert is_fleeting(poses, np.unique(seen)) == expected


@pytest.mark.parametrize("n_again", [3, 5, 7])
def test_a_thing_that_stands_twice_after_drift_is_still_a_change(n_again: int) -> None:
    tall: Box = ((-0.3, -0.3, 0.0), (0.3, 0.3, 1.6))
    beside = tuple((x, 2.0, 1.5) for x, _, _ in PATH)
    before = scanned((), 1)
    path = tuple((x, -2.0, 1.5) for x, _, _ in PATH)
    scans = RoomScans((tall,), 2, (*path, *beside[:n_again]))
    scans.odom_T_sensor[len(path) :, 1, 3] -= 1.2
    twice = scans, scans.mapped()
    found = set().union(*(returns_of(twice[1], group) for group in cut(before, twice)))
    first = {each for each in scans.returns_on(0) if each[0] < len(path)}
    for of_pass in (first, scans.returns_on(0) - first):
        assert len(found & of_pass) > 0.7 * len(of_pass)


@pytest.mark.parametrize(("n_again", "is_found"), [(1, False), (3, True), (7, True)])
def test_what_was_put_down_between_two_passes_is_a_change_if_the_second_was_no_glimpse(
    n_again: int, is_found: bool
) -> None:
    without, with_crate = RoomScans((), 4), RoomScans((CRATE,), 5)

    class Both(RoomScans):
        def __init__(self) -> None:
            self.name = "put down in between"
            self.odom_T_sensor = np.concatenate([without.odom_T_sensor, with_crate.odom_T_sensor[:n_again]])

        def scan(self, index: int) -> PosedScan:
            if index < len(PATH):
                return without.scan(index)
            return replace(with_crate.scan(index - len(PATH)), index=index)

        def scans(self) -> Iterator[PosedScan]:
            return (self.scan(index) for index in range(len(self.odom_T_sensor)))

    scans = Both()
    found = cut(scanned((), 1), (scans, scans.mapped()))
    assert bool(found) == is_found


def test_maps_without_views_keep_what_they_cannot_judge() -> None:
    twice = drifted((CRATE,), ((0.0, 0.0, 1.5),), -0.5)
    with_views = both_ways("after", twice, scanned((), 1))
    blind = both_ways("after", (twice[0], replace(twice[1], views=None)), scanned((), 1))
    assert len(blind) > len(with_views) == 1


# A person who stands: legs, hips, chest with arms, head.
PERSON: tuple[Box, ...] = (
    ((1.4, 1.55, 0.0), (1.55, 1.7, 0.8)),
    ((1.4, 1.8, 0.0), (1.55, 1.95, 0.8)),
    ((1.38, 1.58, 0.8), (1.6, 1.92, 1.0)),
    ((1.38, 1.5, 1.0), (1.6, 2.0, 1.55)),
    ((1.4, 1.67, 1.55), (1.58, 1.84, 1.8)),
)
AS_LARGE: Box = ((1.38, 1.5, 0.0), (1.6, 2.0, 1.8))
KEPT = ExtractConfig(movers="keep")


@pytest.mark.parametrize("session", ["before", "after"])
def test_a_person_who_stands_is_no_change_and_a_locker_is(session: str) -> None:
    empty = scanned((), 1)
    assert both_ways(session, scanned(PERSON, 2), empty) == []
    assert len(both_ways(session, scanned(PERSON, 2), empty, KEPT)) == 1
    assert len(both_ways(session, scanned((AS_LARGE,), 2), empty)) == 1


class Waiting(RoomScans):
    """A hall with a crate, and a machine of two parts that is gone when the robot is far away."""

    def __init__(self, n_with: int) -> None:
        path = tuple((x, 0.0, 1.5) for x in np.arange(0.0, 36.0, 1.0).tolist())
        super().__init__((CRATE_AFAR,), 2, path, room=HALL)
        self._with, self._n_with = RoomScans((CRATE_AFAR, LOCKER, PART), 2, path, room=HALL), n_with

    def scan(self, index: int) -> PosedScan:
        return self._with.scan(index) if index < self._n_with else super().scan(index)


CRATE_AFAR: Box = ((3.4, 1.5, 0.0), (4.4, 2.3, 0.8))
PART: Box = ((0.1, 1.8, 0.0), (0.6, 2.3, 0.3))  # too low to be seen through from far away


@pytest.mark.parametrize("session", ["before", "after"])
def test_a_machine_that_left_when_the_robot_was_far_away_is_no_change(session: str) -> None:
    empty = RoomScans((), 1, tuple((x, 0.0, 1.5) for x in np.arange(0.0, 36.0, 1.0).tolist()), room=HALL)
    other = empty, empty.mapped()
    for n_with, n_found in ((36, 3), (20, 1)):
        waiting = Waiting(n_with)
        found = both_ways(session, (waiting, waiting.mapped()), other)
        assert len(found) == n_found, n_with
    # the crate beside it, which the same scans hit and others, too, stays
    assert found[0].points_map[:, 0].min() > 3.0
    assert len(both_ways(session, (waiting, waiting.mapped()), other, KEPT)) == 3


# A room above a cellar: blocks are its floor, and where one is missing the scans see far down, as in a mirror.
CELLAR: Box = ((-5.0, -4.0, -3.0), (5.0, 4.0, 3.0))
SLABS: tuple[Box, ...] = (
    ((-4.9, -3.9, -2.9), (1.0, 3.9, 0.0)),
    ((2.5, -3.9, -2.9), (4.9, 3.9, 0.0)),
    ((1.0, -3.9, -2.9), (2.5, 1.0, 0.0)),
    ((1.0, 2.5, -2.9), (2.5, 3.9, 0.0)),
)
DRY: Box = ((1.0, 1.0, -2.9), (2.5, 2.5, 0.0))


@pytest.mark.parametrize("session", ["before", "after"])
def test_floor_that_water_hides_from_the_other_session_is_no_change(
    session: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def over_cellar(boxes: tuple[Box, ...], sample: int) -> Scanned:
        scans = RoomScans((*SLABS, *boxes), sample, room=CELLAR)
        return scans, scans.mapped()

    wet, dry = over_cellar((), 1), over_cellar((DRY,), 2)
    assert both_ways(session, dry, wet) == []
    assert len(both_ways(session, over_cellar((DRY, CRATE), 2), wet)) == 1  # what stands on it is one
    monkeypatch.setattr(cdpipe.extract.presence, "is_floor", lambda *_: False)
    (floor,) = both_ways(session, dry, wet)
    assert np.ptp(floor.points_map[:, 2]) < 0.2


@pytest.mark.parametrize(
    ("over_m", "thick_m", "slope_deg", "is_bare"),
    [
        (0.0, 0.06, 0.0, True),
        (-0.06, 0.06, 0.0, True),
        (-0.06, 0.06, 12.0, True),
        (0.05, 0.06, 0.0, False),
        (0.05, 0.06, 12.0, False),
        (-0.06, 0.2, 0.0, False),
        (-0.06, 0.06, 60.0, False),
    ],
)
def test_floor_is_a_level_sheet_no_higher_than_what_is_around(
    over_m: float, thick_m: float, slope_deg: float, is_bare: bool
) -> None:
    draw = stream(10000, "test", "floor")
    turn = Rotation.from_euler("y", slope_deg, degrees=True).as_matrix()
    sheet = draw.uniform((-1.0, -0.5, over_m - thick_m / 2), (1.0, 0.5, over_m + thick_m / 2), (800, 3)) @ turn.T
    around = draw.uniform((-3.0, -3.0, -0.02), (3.0, 3.0, 0.02), (4000, 3)) @ turn.T
    assert is_floor(sheet, around) == is_bare
    assert not is_floor(sheet, around[:0])


BESIDE: tuple[Box, ...] = (((1.2, 1.5, 0.0), (1.95, 2.7, 1.5)), ((2.85, 1.5, 0.0), (3.6, 2.7, 1.5)))


@pytest.mark.parametrize(
    ("low", "kept"),
    [
        (((3.8, 3.2, 0.0), (5.0, 4.0, 0.14)), ()),  # in a corner
        (((2.0, 1.5, 0.0), (2.8, 2.7, 0.1)), BESIDE),
    ],
)
def test_a_low_thing_in_a_corner_or_between_crates_is_no_floor(low: Box, kept: tuple[Box, ...]) -> None:
    assert len(cut(scanned(kept, 1), scanned((*kept, low), 2), centres=((3.5, 2.5, 0.5),))) == 1
