"""What came or went over a flat floor and below a flat roof: objects are told from rock."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.geometry import BoolArray, Float64Array
from cdpipe.model.config import ExtractConfig
from cdpipe.model.report import ChangedObject, ChangeRegions, ChangeReport
from cdpipe.model.types import Kind, SessionName
from cdpipe.surface.places import SurfacePlaces
from cdpipe.surface.rock_or_object import leave_out_rock, split_rock

SPACING_M = 0.25
ROOF_M = 4.0


def split(
    objects: Sequence[ChangedObject], places: SurfacePlaces, along_m: Float64Array, level_m: float = 0.02
) -> tuple[BoolArray, BoolArray]:
    return split_rock(objects, places, along_m, np.full(len(along_m), level_m))


def grid(low: tuple[float, float], high: tuple[float, float], height_m: float) -> Float64Array:
    """(N, 3) places a quarter of a metre apart on a level rectangle."""
    x, y = np.meshgrid(*(np.arange(a, b, SPACING_M) for a, b in zip(low, high, strict=True)), indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height_m)])


def make_places(*parts: tuple[Float64Array, float]) -> SurfacePlaces:
    """Places, each part with the upward share of its normals."""
    points = np.concatenate([points for points, _ in parts])
    up = np.concatenate([np.full(len(points), sign) for points, sign in parts])
    n = len(points)
    normals = np.column_stack([np.zeros((n, 2)), up])
    flat = np.zeros(n), np.zeros(n), np.full(n, SPACING_M**2), np.full(n, 2.0)
    return SurfacePlaces(points, normals, *flat)


def rock() -> SurfacePlaces:
    """A floor of 10 x 6 m and a roof 4 m above it."""
    return make_places((grid((0, 0), (10, 6), 0.0), 1.0), (grid((0, 0), (10, 6), ROOF_M), -1.0))


def item(session: SessionName, points: Float64Array, kind: Kind = "added", region: int = 0) -> ChangedObject:
    return ChangedObject(session, kind, region, np.zeros((0, 2), np.int32), points, 1.0)


def inside(places: SurfacePlaces, low: tuple[float, float], high: tuple[float, float], height_m: float) -> np.ndarray:
    x, y, z = places.points.T
    return (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1]) & (np.abs(z - height_m) < 0.01)


def box(low: tuple[float, float], high: tuple[float, float], height_m: float) -> Float64Array:
    """(P, 3) the top and the sides of a box on the floor."""
    tops = grid(low, high, height_m)
    heights = np.arange(0.05, height_m, 0.1)
    rim = tops[
        (tops[:, :2] == tops[:, :2].min(axis=0)).any(axis=1) | (tops[:, :2] == tops[:, :2].max(axis=0)).any(axis=1)
    ]
    return np.concatenate([tops, *(np.column_stack([rim[:, :2], np.full(len(rim), z)]) for z in heights)])


def fallen(places: SurfacePlaces, depth_m: float = 0.3) -> Float64Array:
    """(Q,) displacement after 1.25 x 1.25 m of the roof fell."""
    return np.where(inside(places, (3.9, 1.9), (5.1, 3.1), ROOF_M), -depth_m, 0.0)


def heap(places: SurfacePlaces, x_m: float, y_m: float) -> tuple[Float64Array, Float64Array]:
    """(Q,) displacement of the floor under a heap 0.6 m high at the angle of repose, and its (P, 3) points."""
    away_m = np.hypot(places.points[:, 0] - x_m, places.points[:, 1] - y_m)
    height_m = np.where(places.points[:, 2] == 0, np.maximum(0.6 - 0.75 * away_m, 0.0), 0.0)
    points = places.points[height_m > 0] + np.outer(height_m[height_m > 0], [0, 0, 1])
    return height_m, points


def test_a_box_that_went_is_an_object_and_rock_that_fell_is_rock() -> None:
    tops = grid((7, 2), (8, 3), 0.5)
    floor, roof = grid((0, 0), (10, 6), 0.0), grid((0, 0), (10, 6), ROOF_M)
    places = make_places((floor, 1.0), (roof, -1.0), (tops, 1.0))
    along_m = fallen(places)
    along_m[-len(tops) :] = -0.5  # where the box stood the after session sees the floor
    scar = places.points[along_m == -0.3]
    objects = (item("before", tops, "removed"), item("before", scar, "reshaped"))
    is_rock, is_of_object = split(objects, places, along_m)
    assert is_rock.tolist() == [False, True]
    assert np.flatnonzero(is_of_object).tolist() == np.arange(len(places.points))[-len(tops) :].tolist()


def test_a_heap_is_rubble_below_a_scar_alone() -> None:
    places = rock()
    raised_m, points = heap(places, 4.5, 2.5)
    for along_m, wanted in ((raised_m + fallen(places), True), (raised_m, False)):
        is_rock, is_of_object = split((item("after", points),), places, along_m)
        assert is_rock.tolist() == [wanted]
        assert is_of_object[raised_m > 0].any() == (not wanted)
    aside_m, points = heap(places, 8.5, 2.5)  # 3 m from below the scar
    assert not split((item("after", points),), places, aside_m + fallen(places))[0].any()


def test_rock_that_may_not_have_fallen_explains_no_object() -> None:
    places = rock()
    raised_m, points = heap(places, 4.5, 2.5)
    along_m = raised_m + fallen(places)
    for level_m in (-along_m.min() + 0.01, np.nan):
        assert not split((item("after", points),), places, along_m, level_m)[0].any()
    far = replace(places, points=places.points * [1, 1, 5])  # a level 20 m above
    assert not split((item("after", points),), far, along_m)[0].any()


@pytest.mark.parametrize("size_m", [(1.0, 0.75, 0.6), (1.25, 1.0, 0.15), (2.0, 2.0, 0.5), (3.5, 3.5, 1.0)])
def test_what_was_put_on_the_floor_is_an_object(size_m: tuple[float, float, float]) -> None:
    places = rock()
    high = (3 + size_m[0], 1 + size_m[1])
    along_m = np.where(inside(places, (2.99, 0.99), (high[0] - 0.01, high[1] - 0.01), 0.0), size_m[2], 0.0)
    is_rock, is_of_object = split((item("after", box((3, 1), high, size_m[2])),), places, along_m)
    assert not is_rock.any()
    np.testing.assert_array_equal(is_of_object[along_m > 0], True)
    assert not is_of_object[(along_m == 0) & (places.points[:, 2] == 0)].any()


@pytest.mark.parametrize("radius_m", [1.8, 2.6])
def test_a_heave_is_rock_though_the_extraction_cuts_out_its_top(radius_m: float) -> None:
    places = rock()
    away = np.clip((np.hypot(places.points[:, 0] - 5, places.points[:, 1] - 3) / radius_m - 0.5) / 0.5, 0, 1)
    along_m = np.where(places.points[:, 2] == 0, 0.14 * (1 + np.cos(np.pi * away)) / 2, 0.0)
    top = places.points[along_m > 0.04] + np.outer(along_m[along_m > 0.04], [0, 0, 1])
    is_rock, is_of_object = split((item("after", top),), places, along_m)
    assert is_rock.all()
    assert not is_of_object.any()


def test_a_floor_that_sank_is_rock() -> None:
    places = rock()
    away = np.clip((np.hypot(places.points[:, 0] - 5, places.points[:, 1] - 3) / 2.2 - 0.5) / 0.5, 0, 1)
    along_m = np.where(places.points[:, 2] == 0, -0.14 * (1 + np.cos(np.pi * away)) / 2, 0.0)
    is_rock, is_of_object = split((item("before", places.points[along_m < -0.04], "removed"),), places, along_m)
    assert is_rock.all()
    assert not is_of_object.any()


@pytest.mark.parametrize("session", ["before", "after"])
def test_a_pile_of_muck_is_an_object_however_large(session: str) -> None:
    """A pile 5.6 m wide covers 24 m2; its flanks lie at 0.75."""
    floor, heights = grid((0, 0), (10, 6), 0.0), grid((0, 0), (10, 6), 0.0)
    heights[:, 2] = np.maximum(2.1 - 0.75 * np.hypot(heights[:, 0] - 5, heights[:, 1] - 3), 0.0)
    on = heights[:, 2] > 0.1
    if session == "after":
        places, along_m = make_places((floor, 1.0)), heights[:, 2]
    else:  # the floor below is seen in the after session alone
        places, along_m = make_places((heights, 1.0)), -heights[:, 2]
    is_rock, is_of_object = split((item(session, heights[on]),), places, along_m)
    assert not is_rock.any()
    assert is_of_object[on].all()


def test_fill_with_steep_edges_is_rock() -> None:
    places = rock()
    along_m = np.where(inside(places, (1.99, 0.49), (8.01, 5.51), 0.0), 0.3, 0.0)
    raised = places.points[along_m > 0] + [0, 0, 0.3]
    assert split((item("after", raised),), places, along_m)[0].all()


def test_places_without_a_displacement_and_objects_without_points_decide_nothing() -> None:
    places = rock()
    unknown = np.full(len(places.points), np.nan)
    objects = (item("before", np.zeros((0, 3)), "removed"), item("after", grid((3, 1), (4, 2), 0.5)))
    is_rock, _ = split(objects, places, unknown)
    assert not is_rock.any()
    assert not split((), places, unknown)[0].any()


def test_rock_is_left_out_of_a_report_with_the_regions_that_held_nothing_else() -> None:
    point = np.zeros((1, 3))
    shift = np.array([1.0, 0.0, 0.0])
    objects = (
        replace(item("before", point, "moved", 0), partner=1, displacement_map=shift),
        replace(item("after", point, "moved", 1), partner=0, displacement_map=shift),
        item("after", point, "added", 2),
        item("before", point, "removed", 2),
    )
    n = 4
    regions = ChangeRegions(
        np.zeros((n, 3)), 4.5, np.arange(n, 0, -1.0), np.zeros((n, 2), np.int64),
        np.array([True, True, True, False]), np.zeros(0), is_withdrawn=np.array([False, False, False, True]),
    )  # fmt: skip
    none = np.zeros(0, np.int64)
    figures = {"v_oe_m3": np.ones(n), "asked_points": np.ones(n)}
    report = ChangeReport(np.eye(4), {}, regions, objects, {}, {}, (none, none))
    report = replace(report, figures=figures)
    is_rock = np.array([True, False, True, False])
    left = leave_out_rock(report, is_rock, ExtractConfig())
    assert [(each.kind, each.partner, each.region) for each in left.objects] == [("added", -1, 1), ("removed", -1, 2)]
    assert left.objects[0].displacement_map is None
    assert left.regions.is_reported.tolist() == [False, True, True, False]
    assert left.regions.is_withdrawn is not None
    assert left.regions.is_withdrawn.tolist() == [True, False, False, True]
    assert np.isnan(left.figures["v_oe_m3"]).tolist() == [True, False, False, False]
    assert left.figures["asked_points"].tolist() == [1, 1, 1, 1]  # it was asked for
    for config in (ExtractConfig(withdraw=False), ExtractConfig(method="clusters")):
        assert leave_out_rock(report, is_rock, config).regions.is_reported.tolist() == [True, True, True, False]
    assert leave_out_rock(report, np.zeros(4, np.bool_), ExtractConfig()) is report
