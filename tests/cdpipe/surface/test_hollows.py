"""Area and volume of rock that left, where the after session does not see the bottom of the hollow."""

import numpy as np
import pytest

from cdpipe.core.geometry import BoolArray, Float64Array, stream
from cdpipe.surface.cells import NearReturns, make_cells
from cdpipe.surface.hollows import _make_chart, measure_hollows
from cdpipe.surface.places import SurfacePlaces
from cdpipe.surface.regions import group_regions
from tests.cdpipe.surface.tunnels import RADIUS_M, about_axis_deg, single_returns, surveyed, tunnel

SIZE_M, DEPTH_M = 0.9, 0.4
# A bowl fell out of the roof. It widens towards the rock, as everything about an axis does.
AREA_M2 = np.pi * SIZE_M**2
VOLUME_M3 = AREA_M2 * (DEPTH_M / 2 + DEPTH_M**2 / 3 / 2 / RADIUS_M)


def off_centre_m(x_m: Float64Array, angle_deg: Float64Array) -> Float64Array:
    return np.hypot(x_m - 6.0, np.deg2rad(angle_deg) * RADIUS_M)


def fallen(x_m: Float64Array, angle_deg: Float64Array) -> Float64Array:
    return np.minimum(-DEPTH_M * (1 - (off_centre_m(x_m, angle_deg) / SIZE_M) ** 2), 0.0)


def of(returns: NearReturns, kept: BoolArray) -> NearReturns:
    return single_returns(returns.points[kept], returns.path_m[kept], returns.weights[kept])


def hide(returns: NearReturns, within_m: float) -> NearReturns:
    """The returns without those from the middle of the hollow."""
    return of(returns, off_centre_m(returns.points[:, 0], about_axis_deg(returns.points)) > within_m)


def with_duct(returns: NearReturns) -> NearReturns:
    """The returns, and a duct below the roof of which the lower half hides nothing of the hollow."""
    x_m = np.repeat(np.arange(3.0, 9.0, 0.01), 60)
    angle = np.tile(np.linspace(0.0, np.pi, 60), len(x_m) // 60)
    duct = np.column_stack([x_m, -0.6 + 0.15 * np.cos(angle), 1.0 - 0.15 * np.sin(angle)])
    path_m, weights = np.clip(x_m, 0.0, 11.0), np.full(len(x_m), returns.weights[0])
    return single_returns(
        np.concatenate([returns.points, duct]), np.concatenate([returns.path_m, path_m]),
        np.concatenate([returns.weights, weights]),
    )  # fmt: skip


def displaced(places: SurfacePlaces, hidden_m: float) -> Float64Array:
    """What the offsets tell: the depth of the roof where it is seen."""
    x_m, angle_deg = places.points[:, 0], about_axis_deg(places.points)
    is_roof = np.linalg.norm(places.points[:, 1:], axis=1) > RADIUS_M - 0.1
    seen_m = np.where(off_centre_m(x_m, angle_deg) < hidden_m, np.nan, fallen(x_m, angle_deg))
    return np.where(is_roof, seen_m, 0.0)


@pytest.mark.parametrize("has_duct", [False, True], ids=["free", "with a duct in front"])
@pytest.mark.parametrize("hidden_m", [0.0, 0.5])
def test_the_volume_of_a_hollow_holds_though_its_bottom_is_hidden(hidden_m: float, has_duct: bool) -> None:
    before, after = tunnel(1), hide(tunnel(2, fallen), hidden_m)
    cells, places, _ = surveyed(with_duct(before) if has_duct else before)
    after = with_duct(after) if has_duct else after
    moved_m = displaced(places, hidden_m)
    region, regions = group_regions(places, moved_m, np.full(len(places.points), 1e-3), 0.25, 0.005, 0.3)
    _, (found,) = measure_hollows(regions, region, cells, places, np.isnan(moved_m), make_cells(after))
    assert found.volume_m3 == pytest.approx(-VOLUME_M3, rel=0.12)
    # the rim of a bowl is shallow, and half a pixel wide
    assert 0.78 * AREA_M2 < found.area_m2 < 1.05 * AREA_M2
    assert found.mean_m == pytest.approx(found.volume_m3 / found.area_m2)
    assert found.largest_m == regions[0].largest_m
    if hidden_m:  # the sum over the places that were seen misses the bottom
        assert abs(regions[0].volume_m3) < 0.8 * VOLUME_M3


def test_shallow_regions_and_rock_that_came_stay_as_they_are() -> None:
    cells, places, _ = surveyed(tunnel(1))
    for factor in (-0.2, 1.0):
        moved_m = -factor * displaced(places, 0.0)
        region, regions = group_regions(places, moved_m, np.full(len(places.points), 1e-3), 0.25, 0.005, 0.3)
        assert len(regions) == 1
        assert measure_hollows(regions, region, cells, places, np.isnan(moved_m), cells)[1] == regions


def test_without_cells_of_the_after_session_nothing_is_told() -> None:
    cells, places, _ = surveyed(tunnel(1))
    moved_m = displaced(places, 0.5)
    region, regions = group_regions(places, moved_m, np.full(len(places.points), 1e-3), 0.25, 0.005, 0.3)
    nothing = make_cells(of(tunnel(2), np.zeros(len(tunnel(2).points), dtype=np.bool_)))
    assert measure_hollows(regions, region, cells, places, np.isnan(moved_m), nothing)[1] == regions


def drift(sample: int, lowered_m: float) -> NearReturns:
    """A drift 4 m wide and 3 m high, of which the floor is lowered wall to wall from 3 to 9 m along it."""
    rng = stream(sample, "drift")
    x_m, around_m = rng.uniform(0.0, 12.0, 300_000), rng.uniform(0.0, 10.0, 300_000)
    noise_m, is_lower = rng.normal(0.0, 0.005, len(x_m)), np.abs(x_m - 6.0) < 3.0
    floor = np.column_stack([x_m, around_m - 5.0, noise_m - lowered_m * is_lower])
    left = np.column_stack([x_m, 2.0 + noise_m, around_m - 7.0 - lowered_m * is_lower])
    right = np.column_stack([x_m, noise_m - 2.0, 3.0 - around_m])
    points = np.where((around_m < 3.0)[:, None], right, np.where((around_m < 7.0)[:, None], floor, left))
    points[:, 2] -= 1.5  # the path is 1 m above the floor
    return single_returns(points, np.clip(x_m, 0.0, 11.0), np.full(len(x_m), 1.0 / 0.005**2))


@pytest.mark.parametrize("hidden_m", [0.0, 0.5])
def test_a_lowered_floor_ends_at_the_walls(hidden_m: float) -> None:
    """No rock behind the walls is taken for floor, and where all of it is seen the sum over the places stays."""
    cells, places, _ = surveyed(drift(1, 0.0))
    after = drift(2, 0.15)
    is_seen = np.hypot(after.points[:, 0] - 6.0, after.points[:, 1]) > hidden_m
    is_floor = (places.normals[:, 2] > 0.9) & (np.abs(places.points[:, 0] - 6.0) < 3.0)
    moved_m = np.where(is_floor, -0.15, 0.0)
    moved_m[np.hypot(places.points[:, 0] - 6.0, places.points[:, 1]) < hidden_m] = np.nan
    region, regions = group_regions(places, moved_m, np.full(len(places.points), 1e-3), 0.25, 0.005, 0.3)
    _, (found,) = measure_hollows(regions, region, cells, places, np.isnan(moved_m), make_cells(of(after, is_seen)))
    assert found.area_m2 == pytest.approx(24.0, rel=0.12)  # half a pixel of rim, and the corner
    assert found.volume_m3 == pytest.approx(-3.6, rel=0.18)
    assert abs(found.mean_m) <= abs(found.largest_m)


def test_a_long_hollow_aslant_to_the_axes_takes_no_more_pixels() -> None:
    along = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    points = np.linspace(0.0, 200.0, 800)[:, None] * along + stream(1, "strip").uniform(-1.5, 1.5, (800, 1)) * [
        1,
        -1,
        0,
    ]
    chart = _make_chart(points, np.array([0.0, 0.0, 1.0]))
    assert chart.shape[0] * chart.shape[1] < 1.2 * 100 * (200.0 + 1.2) * (3.0 * np.sqrt(2) + 1.2)
    assert chart.is_on(chart.place(points)).all()
    np.testing.assert_allclose(chart.axes @ chart.axes.T, np.eye(3), atol=1e-12)


def test_rock_that_left_a_round_wall_is_summed_across_the_wall() -> None:
    """What is seen needs no chart: its area is that across the wall, not that of the plane below it."""

    def receded(x_m: Float64Array, angle_deg: Float64Array) -> Float64Array:
        return np.where((np.abs(x_m - 6.0) < 2.0) & (np.abs(angle_deg) < 60.0), -0.2, 0.0)

    cells, places, _ = surveyed(tunnel(1))
    moved_m = receded(places.points[:, 0], about_axis_deg(places.points))
    region, regions = group_regions(places, moved_m, np.full(len(places.points), 1e-3), 0.25, 0.005, 0.3)
    after = make_cells(tunnel(2, receded))
    assert measure_hollows(regions, region, cells, places, np.isnan(moved_m), after)[1] == regions


def test_a_region_all_around_has_no_chart() -> None:
    """Rock that left the whole round is no hollow seen from one side."""
    cells, places, _ = surveyed(tunnel(1))
    left_m = np.where(np.abs(places.points[:, 0] - 6.0) < 1.0, -0.3, 0.0)
    left_m[::5] = np.nan
    region, regions = group_regions(places, left_m, np.full(len(places.points), 1e-3), 0.25, 0.005, 0.3)
    assert measure_hollows(regions, region, cells, places, np.isnan(left_m), cells)[1] == regions


def test_a_deeper_hollow_comes_first_once_its_bottom_is_told() -> None:
    cells, places, _ = surveyed(tunnel(1))
    x_m = places.points[:, 0]
    raised_m = np.where(np.abs(x_m - 2.0) < 0.8, 0.08, displaced(places, 0.5))  # 0.8 m3, the seen rim 0.2 m3
    region, regions = group_regions(places, raised_m, np.full(len(places.points), 1e-3), 0.25, 0.005, 0.3)
    assert [each.largest_m > 0 for each in regions] == [True, False]
    after = make_cells(hide(tunnel(2, lambda x, angle: 4 * fallen(x, angle)), 0.5))
    again, found = measure_hollows(regions, region, cells, places, np.isnan(raised_m), after)
    assert [each.largest_m > 0 for each in found] == [False, True]
    assert all(abs(each.mean_m) <= abs(each.largest_m) for each in found)
    np.testing.assert_array_equal(again, np.where(region < 0, -1, 1 - region))
