"""Places, answers and windows of displacement fields, worked out by hand on a few points."""

from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.geometry import make_pose, stream
from cdpipe.model.report import SurfaceField, SurfaceRegion
from eval.scoring.surface.places import (
    SurfacePlaces,
    carry_surface,
    find_surface_places,
    mark_true_regions,
)
from eval.scoring.surface.windows import find_windows, list_windows
from eval.truth.ground_truth import GroundTruth, SurfaceLabels, ground_truth
from sim.session.truth import PairTruth
from tests.eval.scoring.surface.surface_worlds import score_field, session, true_field, wall_truth

REGION = SurfaceRegion(np.zeros(3), 1.0, 0.1, 0.1, 0.1)


def truth_of(before: list, after: list, displacement: list | None = None, labels: list | None = None) -> GroundTruth:
    """The truth of a few points; the after session's odometry frame lies 5 m aside, so that only the world is shared.

    Args:
        before: Points of the before session, world.
        after: Likewise.
        displacement: Of each before point; none if left out.
        labels: Change of each before point, as prop; 0 if left out.
    """
    n = len(before)
    surface = None if displacement is None else SurfaceLabels(np.float32(displacement), np.full(n, 7, np.int16))
    here = session(np.array(before, float).reshape(-1, 3), np.eye(4), surface)
    if labels is not None:
        here = replace(here, scoring_points=replace(here.scoring_points, change=np.array(labels, np.int16)))
    there = session(np.array(after, float).reshape(-1, 3), make_pose(translation=(0.0, 5.0, 0.0)))
    return ground_truth(PairTruth("surface/test", 1, 3.0, (), {}), {"before": here, "after": there})


def beside(point: tuple[float, float, float], n: int, away_m: float = 0.0) -> list[list[float]]:
    return [[point[0], point[1] + away_m, point[2]]] * n


def test_a_place_is_a_cell_with_the_median_of_its_displacements_at_the_point_nearest_to_their_mean() -> None:
    # one cell of 0.25 m with five points, one with two, all of one scan
    first = [[0.01, 0.1, 0.1], [0.06, 0.1, 0.1], [0.12, 0.1, 0.1], [0.15, 0.1, 0.1], [0.24, 0.1, 0.1]]
    second = [[0.26, 0.1, 0.1], [0.30, 0.1, 0.1]]
    values = [0.5, -0.25, 0.125, 0.0625, -0.125, 0.25, 0.5]
    places = find_surface_places(truth_of([*first, *second], [], values))
    # means are 0.116 and, with two equally near, 0.28: the first of the two stands for it
    np.testing.assert_allclose(places.points_map[:, 0], [0.12, 0.26], atol=1e-6)
    assert places.true_m.tolist() == [0.0625, 0.375]
    assert places.change.tolist() == [7, 7]
    assert places.is_judged.tolist() == [False, False]
    assert places.is_changed.tolist() == [True, True]


def test_a_place_moved_if_it_moved_by_more_than_a_millimetre() -> None:
    moved = SurfacePlaces(
        np.zeros((5, 3)), np.array([0.001, 0.0011, -0.001, -0.0011, 0.0]), np.zeros(5, np.int64), np.ones(5, np.bool_)
    )
    assert moved.is_changed.tolist() == [False, True, False, True, False]


def test_props_and_returns_without_a_displacement_are_no_places() -> None:
    points = [[0.1, 0.1, 0.1], [0.4, 0.1, 0.1], [0.6, 0.1, 0.1], [0.9, 0.1, 0.1]]
    truth = truth_of(points, [], [0.5, 0.25, np.nan, 0.125], labels=[0, 3, 0, 0])
    assert find_surface_places(truth).true_m.tolist() == [0.5, 0.125]
    instance = np.array([0, 0, 0, 2], np.int16)
    before = truth.before
    fixture = replace(before, scoring_points=replace(before.scoring_points, instance=instance))
    truth = replace(truth, sessions={**truth.sessions, "before": fixture})
    assert find_surface_places(truth).true_m.tolist() == [0.5]


@pytest.mark.parametrize(
    ("n_seen", "away_m", "is_judged"), [(5, 0.49, True), (4, 0.0, False), (5, 0.51, False), (6, -0.49, True)]
)
def test_a_place_is_judged_if_the_after_session_saw_it(n_seen: int, away_m: float, is_judged: bool) -> None:
    at = (2.1, 0.1, 0.1)
    assert find_surface_places(truth_of([at], beside(at, n_seen, away_m))).is_judged.tolist() == [is_judged]
    # rock that moved by 0.25 m is looked for that much farther, whatever the sign
    for moved_m in (0.25, -0.25):
        truth = truth_of([at], beside(at, n_seen, away_m + np.copysign(0.25, away_m)), [moved_m])
        assert find_surface_places(truth).is_judged.tolist() == [is_judged]


def test_props_that_the_after_session_saw_are_no_sight_of_the_rock() -> None:
    at = (2.1, 0.1, 0.1)
    truth = truth_of([at], beside(at, 6))
    for name in ("change", "instance"):
        points = truth.after.scoring_points
        for n_props, is_judged in ((1, True), (2, False)):
            labels = np.repeat(np.int16([0, 4]), [6 - n_props, n_props])
            after = replace(truth.after, scoring_points=replace(points, **{name: labels}))
            found = find_surface_places(replace(truth, sessions={**truth.sessions, "after": after}))
            assert found.is_judged.tolist() == [is_judged]


def places_at(*x: float, true_m: float | list = 0.0, change: int = 0, is_judged: bool = True) -> SurfacePlaces:
    n = len(x)
    points = np.column_stack([x, np.zeros(n), np.zeros(n)])
    true = np.broadcast_to(np.asarray(true_m, float), n).copy()
    return SurfacePlaces(points, true, np.full(n, change), np.full(n, is_judged))


def field_at(x: list, displacement: list, level: list | None = None, region: list | None = None) -> SurfaceField:
    n = len(x)
    points = np.column_stack([x, np.zeros(n), np.zeros(n)])
    normals = np.tile((0.0, 0.0, 1.0), (n, 1))
    regions = (REGION,) * (1 + max(region or [-1]))
    level_m = np.full(n, np.nan) if level is None else np.array(level, float)
    index = np.full(n, -1) if region is None else np.array(region)
    return SurfaceField(points, normals, np.array(displacement, float), level_m, index.astype(np.int32), regions)


def test_the_answer_at_a_place_is_that_of_the_nearest_point_with_a_displacement_up_to_30_cm_away() -> None:
    field = field_at([0.0, 1.0, 1.25, 5.3, 9.31], [0.1, np.nan, 0.2, 0.3, 0.4], [1, 2, 3, 4, 5], [0, 1, 2, 3, 4])
    said = carry_surface(field, places_at(0.1, 1.0, 2.0, 5.0, 9.0))
    assert said.is_covered.tolist() == [True, True, False, True, False]
    assert said.answered_m.tolist() == [0.1, 0.2, 0.0, 0.3, 0.0]
    np.testing.assert_array_equal(said.level_m, [1, 3, np.nan, 4, np.nan])
    assert said.region.tolist() == [0, 2, -1, 3, -1]
    assert said.region.dtype == np.int64


def test_without_a_displacement_nothing_is_said() -> None:
    places = places_at(0.0, 1.0)
    for field in (None, field_at([], []), field_at([0.0], [np.nan], [0.1], [0])):
        said = carry_surface(field, places)
        assert (said.answered_m.tolist(), said.region.tolist()) == ([0.0, 0.0], [-1, -1])
        assert (said.is_covered.tolist(), np.isnan(said.level_m).tolist()) == ([False, False], [True, True])
    none = carry_surface(field_at([0.0], [0.1]), places_at())
    assert (none.answered_m.shape, none.is_covered.shape, none.region.shape) == ((0,), (0,), (0,))


def test_of_points_at_one_place_the_least_displacement_counts_in_any_order() -> None:
    # of equal ones that of the first region, and of equal regions the least level
    x, displacement = [0.0, 0.0, 0.0, 0.0, 0.5], [0.3, 0.1, 0.1, 0.1, 0.4]
    level, region = [1.0, 3.5, 2.0, 3.0, 4.0], [0, 1, 2, 1, 3]
    for order in ([0, 1, 2, 3, 4], [3, 2, 1, 0, 4], [4, 3, 1, 2, 0], [1, 3, 4, 0, 2]):
        field = field_at(*([values[k] for k in order] for values in (x, displacement, level, region)))
        said = carry_surface(field, places_at(0.0, 0.5))
        assert (said.answered_m.tolist(), said.level_m.tolist(), said.region.tolist()) == ([0.1, 0.4], [3, 4], [1, 3])


def test_points_that_differ_in_one_coordinate_are_two() -> None:
    field = field_at([0.0] * 4, [0.1, 0.2, 0.3, 0.4])
    for axis in range(3):
        points = np.zeros((4, 3))
        points[:, axis] = [0.0, 0.1, 0.2, 0.3]
        said = carry_surface(
            replace(field, points_map=points), SurfacePlaces(points, np.zeros(4), np.zeros(4, int), np.ones(4, bool))
        )
        assert said.answered_m.tolist() == [0.1, 0.2, 0.3, 0.4]


def test_a_region_is_true_if_a_point_of_it_is_within_30_cm_of_rock_that_moved_judged_or_not() -> None:
    places = places_at(0.0, 10.0, true_m=[0.1, 0.0], change=1, is_judged=False)
    field = field_at([0.3, 0.31, -0.2, 5.0, 10.0, 0.0], [0.0] * 6, None, [0, 1, 2, 2, 3, -1])
    assert mark_true_regions(field, places).tolist() == [True, False, True, False]
    assert mark_true_regions(field, places_at(0.0)).tolist() == [False] * 4
    # points without a displacement belong to their regions as well
    silent = replace(field, displacement_m=np.full(6, np.nan))
    assert mark_true_regions(silent, places).tolist() == [True, False, True, False]
    assert mark_true_regions(replace(field, region=np.full(6, -1, np.int32)), places).tolist() == [False] * 4


Cells = dict[tuple[int, int], int]


def grid(
    width: int, height: int, moved: dict[tuple[int, int], int] | None = None, depth_m: float = 0.1
) -> SurfacePlaces:
    """Places 0.25 m apart in the plane z = 0, row by row along y; some belong to changes that moved."""
    cells = [(i, j) for i in range(width) for j in range(height)]
    change = np.array([(moved or {}).get(cell, 0) for cell in cells])
    points = np.array([(0.25 * i, 0.25 * j, 0.0) for i, j in cells])
    return SurfacePlaces(points, np.where(change > 0, depth_m, 0.0), change, np.ones(len(cells), np.bool_))


def box(x: range, y: range, number: int = 1) -> Cells:
    return {(i, j): number for i in x for j in y}


def centres_of(windows: list, places: SurfacePlaces) -> list:
    """Area, change, and the cell of the centre of each window."""
    found = []
    for area_m2, change, centre, _ in windows:
        i, j, _ = np.rint(places.points_map[places.is_judged][centre] / 0.25).astype(int).tolist()
        found.append((area_m2, change, (i, j)))
    return found


def test_windows_of_one_square_metre_by_hand() -> None:
    # 20 x 9 places, 5 x 2.25 m; a patch of 7 x 7 places, whose middle place is the deepest
    places = grid(20, 9, box(range(1, 8), range(1, 8)))
    windows, _ = find_windows(places)
    found = [each for each in centres_of(windows, places) if each[0] == 1.0]
    # the radius is 0.564 m: 2.26 places, so a disc holds 21 places: 5 x 5 without its corners
    assert found[0] == (1.0, 1, (4, 4))
    assert [each[1] for each in found].count(1) == 1  # no second centre is 2 m away and whole
    inside = windows[0][3]
    assert len(inside) == 21
    assert (np.sort(inside) == inside).all()
    assert (places.change[inside] == 1).all()
    # null windows: the first whole one in the order of places stands at column 10 (8 is the first unmoved, and the disc
    # reaches two to either side); at the edge a disc is not full, but 8 places are enough: 9 x 9 corners hold 8
    null = [each[2] for each in found if each[1] == 0]
    assert null[0] == (10, 0)
    gaps = np.linalg.norm(0.25 * (np.array(null)[:, None] - np.array(null)), axis=2)
    assert gaps[~np.eye(len(null), dtype=bool)].min() == 2.0  # a centre exactly 2 m away is taken
    assert null == [(10, 0), (10, 8), (17, 4)]


def test_a_change_that_is_smaller_than_a_window_has_one_window_that_reaches_beyond_it() -> None:
    places = grid(24, 24, box(range(10, 13), range(10, 13)))
    windows, _ = find_windows(places)
    found = [each for each in centres_of(windows, places) if each[1] == 1]
    assert found == [(area, 1, (11, 11)) for area in (1.0, 4.0, 16.0)]
    rows = list_windows(carry_surface(None, places), places)
    first = rows[0]
    assert (first["n_places"], first["true_m"]) == (21, pytest.approx(0.1 * 9 / 21))
    assert (first["window"], first["area_m2"], first["surface_change"], first["is_null"]) == (0, 1.0, 1, False)
    assert (first["x_m"], first["y_m"], first["z_m"]) == (2.75, 2.75, 0.0)
    assert [row["window"] for row in rows] == list(range(len(rows)))


def test_a_window_needs_half_of_its_cells() -> None:
    # a disc of 1 m2 has 16 cells: 8 places in a row are not within its radius, a block of 3 x 3 is
    for width, height, n_wanted in ((3, 3, 1), (40, 1, 0), (2, 4, 1), (7, 1, 0), (2, 3, 0)):
        windows, _ = find_windows(grid(width, height))
        assert len([each for each in windows if each[0] == 1.0]) == n_wanted, (width, height)
    assert find_windows(places_at()) == ((), ())


def test_each_change_has_windows_of_its_own_and_unjudged_places_are_in_none(monkeypatch: pytest.MonkeyPatch) -> None:
    moved = {**box(range(8), range(9), 2), **box(range(12, 20), range(9), 5), **box(range(21, 22), range(9), 0)}
    places = grid(30, 9, moved)
    windows, _ = find_windows(places)
    assert sorted({each[1] for each in windows}) == [0, 2, 5]
    assert [each[1] for each in windows] == sorted((each[1] for each in windows), key=lambda its: (its == 0, its))
    judged = replace(places, is_judged=places.points_map[:, 0] < 2.9)
    windows, _ = find_windows(judged)
    assert sorted({each[1] for each in windows}) == [0, 2]
    own = [np.flatnonzero(judged.is_judged)[each[3]] for each in windows]
    assert all(judged.is_judged[inside].all() for inside in own)
    monkeypatch.setattr("eval.scoring.surface.windows.MAX_NULL_WINDOWS", 1)  # which leaves room for checks
    _, checks = find_windows(places)
    assert checks and all(each[1] == 0 for each in checks)


def test_rock_that_moved_and_belongs_to_no_change_is_in_no_window(monkeypatch: pytest.MonkeyPatch) -> None:
    places = grid(24, 9, box(range(9), range(9), 1))
    places = replace(places, change=np.zeros(len(places.change), np.int64))
    windows, _ = find_windows(places)
    monkeypatch.setattr("eval.scoring.surface.windows.MAX_NULL_WINDOWS", 1)  # which leaves room for checks
    _, checks = find_windows(places)
    assert windows and checks
    assert all(each[1] == 0 for each in (*windows, *checks))
    assert not any(places.is_changed[each[3]].any() for each in (*windows, *checks))


def test_windows_of_thresholds_are_the_first_and_those_of_checks_lie_all_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("eval.scoring.surface.windows.MAX_NULL_WINDOWS", 3)
    places = grid(120, 9, box(range(50, 60), range(9), 1))
    windows, checks = find_windows(places)
    for area_m2 in (1.0, 4.0):
        sets = [centre for area, _, centre in centres_of(windows, places) if area == area_m2][-3:]
        others = [centre for area, _, centre in centres_of(checks, places) if area == area_m2]
        assert max(i for i, _ in sets) < 30 < 100 < max(i for i, _ in others)
        both = 0.25 * np.array([*sets, *others])
        gaps = np.linalg.norm(both[:, None] - both, axis=2)[~np.eye(len(both), dtype=bool)]
        assert gaps.min() >= max(2.0, 2 * np.sqrt(area_m2 / np.pi))
        assert len(others) > 8
    assert all(change == 0 for _, change, _, _ in checks)
    assert not any(places.is_changed[inside].any() for *_, inside in checks)
    least = {1.0: 8, 4.0: 32, 16.0: 128}
    assert all(len(inside) >= least[area] for area, _, _, inside in checks)
    assert all((np.sort(inside) == inside).all() for *_, inside in checks)
    monkeypatch.setattr("eval.scoring.surface.windows.MAX_CHECK_WINDOWS", 4)
    _, fewer = find_windows(places)
    assert [each[:3] for each in fewer] == [
        each[:3] for area in (1.0, 4.0, 16.0) for each in [each for each in checks if each[0] == area][:4]
    ]
    rows = list_windows(carry_surface(None, replace(places)), replace(places))
    assert [row["is_check"] for row in rows] == [False] * len(windows) + [True] * len(fewer)
    assert all(row["is_null"] for row in rows if row["is_check"])


def test_a_window_says_what_is_answered_on_it_and_how_much_of_it() -> None:
    places = grid(24, 24, box(range(8, 16), range(8, 16)), depth_m=-0.1)
    x = places.points_map[:, 0]
    said = carry_surface(
        SurfaceField(
            places.points_map[x < 2.9], np.tile((0.0, 0.0, 1.0), (int((x < 2.9).sum()), 1)), 0.1 * x[x < 2.9],
            np.full(int((x < 2.9).sum()), np.nan), np.full(int((x < 2.9).sum()), -1, np.int32),
        ),
        places,
    )  # fmt: skip
    for (_, _, _, inside), row in zip(find_windows(places)[0], list_windows(said, places), strict=False):
        # a place of the column at 3 m takes the answer of the column at 2.75 m
        expected = np.where(x[inside] < 2.9, 0.1 * x[inside], np.where(x[inside] < 3.1, 0.275, 0.0))
        assert row["answered_m"] == pytest.approx(expected.mean())
        assert row["cover"] == pytest.approx((x[inside] < 3.1).mean())
        assert row["n_places"] == len(inside)
        assert row["true_m"] == pytest.approx(places.true_m[inside].mean())


def test_a_row_of_a_surface_change_by_hand() -> None:
    # 16 places 0.1 m deep and beside them 8 of 0.04 m, which are no core; 6 of the core answered in a region
    truth = wall_truth({1: (5, 1, 1, 1, 0.1), 2: (9, 1, 0.5, 0.75, -0.2), 3: (12, 1, 1, 0.5, 0.02)}, kinds={1: "scar"})
    surface = truth.before.surface
    points = truth.before.scoring_points.points_odom
    depth = surface.displacement_m.copy()
    depth[(surface.change == 1) & (points[:, 2] > 1.5)] = 0.04
    before = replace(truth.before, surface=replace(surface, displacement_m=depth))
    truth = replace(truth, sessions={**truth.sessions, "before": before})
    field = true_field(truth)
    own = np.flatnonzero(field.region == 0)
    core = own[points[own, 2] < 1.5]
    region = np.full(2400, -1, np.int32)
    region[core[:4]] = 0
    field = replace(field, region=region, regions=field.regions[:1], displacement_m=field.displacement_m * 0.5)
    score = score_field(truth, field)
    first, second, third = score.surface_changes
    assert (first["n_places"], first["n_core_places"], first["found_share"]) == (16, 8, 0.5)
    assert (first["is_observable"], first["is_found"], first["cover"]) == (True, True, 1.0)
    assert (first["true_places_m"], first["answered_places_m"]) == pytest.approx((0.07, 0.035))
    assert (first["surface_change"], first["name"], first["kind"], first["partner"]) == (1, "patch 1", "scar", -1)
    assert (first["volume_m3"], first["largest_m"], first["mean_m"]) == pytest.approx((0.1, 0.1, 0.1))
    # six places are too few, eight are enough
    assert (second["n_core_places"], second["is_observable"], second["is_found"]) == (6, False, False)
    assert (third["n_core_places"], third["is_observable"], third["found_share"]) == (8, True, 0.0)
    assert (second["answered_volume_m3"], second["volume_error_share"]) == (0.0, 1.0)
    assert score.row["n_surface_changes"] == 2
    assert score.row["surface_recall"] == 0.5
    region[core[3]] = -1
    assert not score_field(truth, replace(field, region=region)).surface_changes[0]["is_found"]


def test_the_core_of_a_change_is_what_moved_at_least_half_as_far_and_a_row_names_the_partner() -> None:
    truth = wall_truth({1: (5, 1, 1, 1, 0.125), 2: (9, 1, 1, 1, -0.25)}, kinds={1: "rubble", 2: "scar"})
    surface, points = truth.before.surface, truth.before.scoring_points.points_odom
    is_shallow = (surface.change == 1) & (points[:, 2] > 1.75)
    linked = tuple(replace(each, partner=3 - each.id) for each in truth.pair.surface_changes)
    for depth_m, n_core in ((0.0625, 16), (0.0624, 12)):
        depth = np.where(is_shallow, depth_m, surface.displacement_m).astype(np.float32)
        before = replace(truth.before, surface=replace(surface, displacement_m=depth))
        own = replace(
            truth, pair=replace(truth.pair, surface_changes=linked), sessions={**truth.sessions, "before": before}
        )
        first, second = score_field(own, None).surface_changes
        assert (first["n_core_places"], second["n_core_places"]) == (n_core, 16)
        assert (first["partner"], second["partner"]) == (2, 1)
        assert (first["n_places"], first["found_share"], first["cover"]) == (16, 0.0, 0.0)
        assert (first["answered_volume_m3"], second["answered_volume_m3"]) == (0.0, 0.0)


def list_slowly(places: SurfacePlaces, n_null: int, n_check: int) -> list[tuple[float, int, int]]:
    """Area, change and centre of every window, by loops over all pairs of places: a slow twin of `find_windows`."""
    points, is_changed = places.points_map, places.is_changed
    gaps = np.linalg.norm(points[:, None] - points, axis=2)
    found: list[tuple[float, int, int]] = []

    def take(area_m2: float, number: int, order: list[int], apart_m: float, most: int, earlier: list[int]) -> None:
        taken: list[int] = []
        for centre in order:
            near = np.flatnonzero(gaps[centre] <= np.sqrt(area_m2 / np.pi))
            its = is_changed[near] & (places.change[near] == number) if number else ~is_changed[near]
            is_far = all(gaps[centre, each] >= apart_m for each in (*earlier, *taken))
            is_full = len(near) * 0.25**2 >= area_m2 / 2
            if len(taken) < most and is_far and is_full and (its.all() or (number and not taken)):
                taken.append(centre)
        found.extend((area_m2, number, centre) for centre in taken)

    for number in sorted({int(each) for each in places.change[is_changed]} - {0}):
        own = np.flatnonzero(is_changed & (places.change == number))
        others = np.setdiff1d(np.arange(len(points)), own)
        order = sorted(own.tolist(), key=lambda index: (-gaps[index, others].min(initial=np.inf), index))
        for area_m2 in (1.0, 4.0, 16.0):
            take(area_m2, number, order, 2.0, len(points), [])
    still = np.flatnonzero(~is_changed)
    apart = {area_m2: max(2.0, 2 * np.sqrt(area_m2 / np.pi)) for area_m2 in (1.0, 4.0, 16.0)}
    for area_m2, apart_m in apart.items():
        take(area_m2, 0, still.tolist(), apart_m, n_null, [])
    sets = list(found)
    for area_m2, apart_m in apart.items():
        order = stream(len(still), "check windows").permutation(still).tolist()
        take(area_m2, 0, order, apart_m, n_check, [each[2] for each in sets if each[:2] == (area_m2, 0)])
    return found


@pytest.mark.parametrize(
    "places",
    [
        grid(40, 40, box(range(4, 34), range(4, 34))),  # large enough for windows of 16 m2 side by side
        grid(41, 20, {**box(range(3, 16), range(0, 9), 1), **box(range(16, 24), range(2, 18), 4)}),
        grid(30, 9, {**box(range(9), range(9), 0), **box(range(18, 20), range(9), 2)}),
        grid(28, 8),
    ],
)
def test_windows_equal_those_of_a_slow_twin(places: SurfacePlaces, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("eval.scoring.surface.windows.MAX_NULL_WINDOWS", 3)
    monkeypatch.setattr("eval.scoring.surface.windows.MAX_CHECK_WINDOWS", 5)
    # some rock moved and belongs to no change, some of a change did not move
    true_m = places.true_m.copy()
    true_m[-3:] = 0.5
    true_m[np.flatnonzero(places.change > 0)[:2]] = 0.0
    places = replace(places, true_m=true_m)
    windows, checks = find_windows(places)
    assert [each[:3] for each in (*windows, *checks)] == list_slowly(places, 3, 5)


def test_one_place_and_a_point_exactly_30_cm_away() -> None:
    for at_m, is_covered in ((0.3, True), (-0.3, True), (np.nextafter(0.3, 1.0), False)):
        said = carry_surface(field_at([at_m], [0.1]), places_at(0.0))
        assert (said.is_covered.tolist(), said.answered_m.tolist()) == ([is_covered], [0.1 if is_covered else 0.0])


def test_points_that_are_repeated_hundreds_of_times_count_once() -> None:
    draw = stream(0, "repeated")
    x = np.repeat(draw.uniform(0, 100, 300), 4)
    displacement = np.tile([0.4, 0.1, 0.3, 0.2], 300)
    order = draw.permutation(1200)
    said = carry_surface(field_at(x[order].tolist(), displacement[order].tolist()), places_at(*x[::4]))
    assert set(said.answered_m.tolist()) == {0.1}


def test_without_a_field_there_is_no_region_and_no_false_one() -> None:
    truth = wall_truth({1: (5, 1, 2, 2, -0.1)})
    row = score_field(truth, None).row
    assert (row["n_surface_regions"], row["surface_false_regions_per_100m"]) == (0, 0.0)
    assert (row["surface_region_precision"], row["surface_recall"], row["n_surface_changes"]) == (0.0, 0.0, 1)
    assert np.isnan(score_field(wall_truth({}), None).row["surface_region_precision"])


def test_a_window_of_checks_needs_half_of_its_cells_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("eval.scoring.surface.windows.MAX_NULL_WINDOWS", 1)
    # two blocks of 3 x 3 places 5 m apart; 8 of 16 cells are enough, 7 are not
    block = grid(3, 3).points_map
    for n_places, n_checks in ((8, 1), (7, 0)):
        points = np.concatenate([block, block[:n_places] + np.array([5.0, 0.0, 0.0])])
        n = len(points)
        places = SurfacePlaces(points, np.zeros(n), np.zeros(n, np.int64), np.ones(n, np.bool_))
        windows, checks = find_windows(places)
        assert [len(each[3]) for each in windows] == [8]  # about a corner
        assert [len(each[3]) for each in checks] == [8] * n_checks
