"""Our measure of displacement, on a smooth tunnel of which is known what moved."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.errors import InputWarning
from cdpipe.core.geometry import Float64Array, make_pose, stream, transform
from cdpipe.core.geometry.voxel import cell_means
from cdpipe.model.config import load_config
from cdpipe.surface.cells import NearReturns, SurfaceCells, make_cells
from cdpipe.surface.measure import _warn_of_thin_maps, measure_planes
from cdpipe.surface.method import Measured
from cdpipe.surface.motions import PathMotions, fit_motions
from cdpipe.surface.places import SurfacePlaces, choose_places
from cdpipe.surface.regions import group_regions
from cdpipe.surface.unrolled import middle_place, unroll
from tests.cdpipe.surface.tunnels import (
    LENGTH_M,
    PATH,
    RADIUS_M,
    about_axis_deg,
    is_inner,
    left_wall,
    single_returns,
    surveyed,
    true_displacement,
    tunnel,
)

Survey = tuple[SurfaceCells, SurfacePlaces, Float64Array]


@pytest.fixture(scope="module", name="survey")
def survey_fixture() -> Survey:
    return surveyed(tunnel(1))


def measure(survey: Survey, after: NearReturns) -> Measured:
    cells, places, chainage_m = survey
    return measure_planes(cells, after, places, chainage_m, load_config("tunnelcd"))


def test_a_patch_that_moved_is_measured_to_a_millimetre(survey: Survey) -> None:
    found = measure(survey, tunnel(2, left_wall))
    truth_m, inner = true_displacement(survey[1], left_wall), is_inner(survey[1])
    for still in (True, False):
        of_kind = inner & ((truth_m == 0) == still)
        assert found.displacement_m[of_kind].mean() == pytest.approx(0.0 if still else 0.02, abs=1e-3)
        assert np.abs(found.displacement_m - truth_m)[of_kind].max() < 0.004
    assert (found.displacement_m > found.level_m)[inner & (truth_m > 0)].all()


def test_rock_that_left_is_negative() -> None:
    back = surveyed(tunnel(2, left_wall))
    on = is_inner(back[1]) & (true_displacement(back[1], left_wall) > 0)
    assert measure(back, tunnel(1)).displacement_m[on].mean() == pytest.approx(-0.02, abs=1e-3)


def test_a_far_displacement_is_the_distance_to_the_new_surface(survey: Survey) -> None:
    def slab(x_m: Float64Array, angle_deg: Float64Array) -> Float64Array:
        return 30.0 * left_wall(x_m, angle_deg)

    on = is_inner(survey[1]) & (true_displacement(survey[1], slab) > 0)
    found = measure(survey, tunnel(2, slab))
    # the nearest cell is half a cell off the foot of the perpendicular, and nearer than the surface by its noise
    assert np.median(found.displacement_m[on]) == pytest.approx(0.6, abs=0.01)


def test_the_level_holds_19_of_20_unchanged_places() -> None:
    """Errors that the scans of a metre of path share: the folds tell them, and 95 % are below the level."""
    survey = surveyed(tunnel(1, stretch_noise_m=0.0025))
    found = measure(survey, tunnel(2, stretch_noise_m=0.0025))
    inner = is_inner(survey[1])
    held = np.abs(found.along_m[inner]) <= found.level_m[inner]
    assert len(held) > 2000
    assert 0.93 <= held.mean() <= 0.97


def test_the_level_of_independent_noise_is_on_the_safe_side(survey: Survey) -> None:
    """A smooth wall that is curved counts as rough, so more than 95 % are below the level."""
    found = measure(survey, tunnel(3))
    assert np.mean(np.abs(found.along_m) <= found.level_m) > 0.97
    assert np.median(found.level_m) < 0.003


def test_a_rigid_misalignment_is_absorbed(survey: Survey) -> None:
    turn = np.deg2rad(0.1)
    after = tunnel(2, left_wall)
    # 5 mm across the tunnel, and 0.1 degrees about the vertical through its middle: another 10 mm at its ends
    moved_by = make_pose(
        [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]], [0, 0.003, 0.004]
    )
    middle = np.array([6.0, 0.0, 0.0])
    points = transform(moved_by, after.points - middle) + middle
    found = measure(survey, replace(after, points=points))
    truth_m, inner = true_displacement(survey[1], left_wall), is_inner(survey[1])
    angle_deg, x_m = about_axis_deg(survey[1].points), survey[1].points[:, 0]
    for sector in range(-180, 180, 45):
        for end in (x_m < 3.0, x_m > 9.0):
            of_sector = inner & end & (angle_deg >= sector) & (angle_deg < sector + 45)
            assert found.displacement_m[of_sector].mean() == pytest.approx(0.0, abs=1e-3)
    assert found.displacement_m[inner & (truth_m > 0)].mean() == pytest.approx(0.02, abs=1.5e-3)


def test_a_change_of_a_third_of_the_round_is_not_absorbed(survey: Survey) -> None:
    def third(x_m: Float64Array, angle_deg: Float64Array) -> Float64Array:
        return np.where(np.abs(angle_deg - 90.0) < 60.0, 0.02, 0.0)

    found = measure(survey, tunnel(2, third))
    from_wall_deg = np.abs(about_axis_deg(survey[1].points) - 90.0)
    inner = np.abs(survey[1].points[:, 0] - 6.0) < 5.5
    assert found.displacement_m[inner & (from_wall_deg < 45.0)].mean() == pytest.approx(0.02, abs=1.5e-3)
    assert found.displacement_m[inner & (from_wall_deg > 75.0)].mean() == pytest.approx(0.0, abs=1.5e-3)


@pytest.mark.parametrize("width_deg", [120.0, 180.0])
def test_a_roof_that_came_down_over_half_of_the_round_is_not_absorbed(survey: Survey, width_deg: float) -> None:
    def roof(x_m: Float64Array, angle_deg: Float64Array) -> Float64Array:
        return np.where(np.abs(angle_deg) < width_deg / 2, 0.01, 0.0)

    found = measure(survey, tunnel(2, roof))
    from_edge_deg = np.abs(about_axis_deg(survey[1].points)) - width_deg / 2
    inner = np.abs(survey[1].points[:, 0] - 6.0) < 5.5
    assert found.displacement_m[inner & (from_edge_deg < -15.0)].mean() == pytest.approx(0.01, abs=1e-3)
    assert found.displacement_m[inner & (from_edge_deg > 15.0)].mean() == pytest.approx(0.0, abs=1e-3)


def test_a_convergence_all_round_is_not_absorbed_and_its_level_says_how_unsure_it_is(survey: Survey) -> None:
    """No rigid motion explains it, but nothing stands still: the alignment is as unsure as the offsets are large."""
    found = measure(survey, tunnel(2, lambda x_m, angle_deg: np.full(len(x_m), 0.02)))
    still = measure(survey, tunnel(2))
    inner = np.abs(survey[1].points[:, 0] - 6.0) < 5.5
    error_m = np.abs(found.displacement_m - 0.02)[inner]
    assert np.mean(error_m <= found.level_m[inner]) > 0.95
    assert (found.displacement_m > found.level_m)[inner].mean() > 0.95
    assert np.median(found.level_m[inner]) > 2 * np.median(still.level_m[inner])


def wire_before_rock(sample: int, share: float) -> NearReturns:
    """The tunnel with wire 60 mm before the rock of its left wall; a share of the returns there comes from the wire."""
    rock = tunnel(sample)
    angle_deg = about_axis_deg(rock.points)
    is_wire = (np.abs(angle_deg - 90.0) < 30.0) & (np.abs(rock.points[:, 0] - 6.0) < 3.0)
    is_wire &= stream(sample, "wire").random(len(angle_deg)) < share
    points = rock.points * np.where(is_wire[:, None], [1.0, 1 - 0.06 / RADIUS_M, 1 - 0.06 / RADIUS_M], 1.0)
    return single_returns(points, rock.path_m, rock.weights)


def test_sessions_that_see_other_shares_of_wire_and_rock_find_no_region() -> None:
    """The means differ by centimetres where nothing moved. The level says so, and neighbours share it."""
    survey = surveyed(wire_before_rock(1, 0.35))
    found = measure(survey, wire_before_rock(2, 0.5))
    places, settings = survey[1], load_config("tunnelcd").surface
    behind = (np.abs(about_axis_deg(places.points) - 90.0) < 25.0) & (np.abs(places.points[:, 0] - 6.0) < 2.5)
    assert np.mean(np.abs(found.along_m[behind]) <= found.level_m[behind]) > 0.9
    beside = is_inner(places) & (np.abs(about_axis_deg(places.points) - 90.0) > 45.0)
    assert np.median(found.level_m[beside]) < 0.003 < 3 * 0.003 < np.median(found.level_m[behind])

    def regions(shared_m: Float64Array | float) -> int:
        return len(
            group_regions(places, found.along_m, found.level_m, settings.spacing_m, settings.least_m,
                          settings.least_area_m2, shared_m=shared_m)[1]
        )  # fmt: skip

    assert regions(found.shared_m) == 0


def wall_ring(x_m: float) -> Float64Array:
    """Crown, left wall, right wall, floor, and the places between, at one chainage."""
    angle = np.deg2rad([0.0, 90.0, -90.0, 180.0, 45.0, -45.0, 135.0, -135.0])
    return np.column_stack([np.full(len(angle), x_m), RADIUS_M * np.sin(angle), RADIUS_M * np.cos(angle)])


def test_angles_and_chainage_of_an_unrolled_tunnel() -> None:
    chainage_m, angle_deg, radius_m = unroll(wall_ring(4.3), PATH)
    np.testing.assert_allclose(chainage_m, 4.3, atol=1e-9)
    np.testing.assert_allclose(np.abs(angle_deg[3]), 180.0, atol=1e-9)
    expected_deg = [0.0, 90.0, -90.0, 45.0, -45.0, 135.0, -135.0]
    np.testing.assert_allclose(np.delete(angle_deg, 3), expected_deg, atol=1e-9)
    # about the axis of the drift, though the path is half a metre below it
    np.testing.assert_allclose(radius_m, RADIUS_M, atol=1e-9)


@pytest.mark.parametrize("width_m", [3.0, 6.0])
def test_a_crosscut_and_a_raise_do_not_move_the_axis(width_m: float) -> None:
    """A drift of 4 by 4 m whose left wall opens for 12 m, and whose roof opens for 9 m, on a stretch of some metres."""
    x_m, across_m = (each.ravel() for each in np.meshgrid(np.arange(0.1, 40, 0.2), np.arange(-1.9, 2, 0.2)))
    open_from, flat = np.abs(x_m - 20.0) < width_m / 2, np.full(len(x_m), 2.0)
    floor, right = np.column_stack([x_m, across_m, -flat]), np.column_stack([x_m, -flat, across_m])
    roof = np.column_stack([x_m, across_m, np.where(np.abs(x_m - 31.0) < 1.5, 11.0, 2.0)])
    left = np.column_stack([x_m, np.where(open_from, 14.0, 2.0), across_m])
    path = make_pose(translation=np.column_stack([np.arange(0.0, 40.0, 0.25), np.full(160, 0.7), np.full(160, -0.5)]))
    points = np.concatenate([floor, right, roof, left])
    _, angle_deg, _ = unroll(points, path)
    expected_deg = np.rad2deg(np.arctan2(points[:, 1], points[:, 2]))
    np.testing.assert_allclose(angle_deg, expected_deg, atol=1e-6)


def test_a_swerve_of_the_sensor_is_no_opening() -> None:
    """In a drift of 6 by 4 m a path swerves by 1.6 m: both walls move in its frame, and the drift stays as wide."""
    x_m, across_m = (each.ravel() for each in np.meshgrid(np.arange(0.1, 40, 0.2), np.arange(-1.9, 2, 0.2)))
    walls = [np.column_stack([x_m, np.full(len(x_m), side_m), across_m]) for side_m in (-3.0, 3.0)]
    roof_and_floor = [np.column_stack([x_m, 1.5 * across_m, np.full(len(x_m), up_m)]) for up_m in (-2.0, 2.0)]
    points, along_m = np.concatenate([*walls, *roof_and_floor]), np.arange(0.0, 40.0, 0.25)
    swerve = np.column_stack([along_m, 1.6 * np.exp(-0.5 * ((along_m - 20.0) / 2.0) ** 2), np.zeros(160)])
    _, angle_deg, _ = unroll(points, make_pose(translation=swerve))
    expected_deg = np.rad2deg(np.arctan2(points[:, 1], points[:, 2]))
    off_deg = np.abs((angle_deg - expected_deg + 180.0) % 360.0 - 180.0)
    # the axis of a metre is off by what the path moves aside in it: 1.8 degrees here, 3.6 with one side cut off
    assert np.median(off_deg[np.abs(points[:, 0] - 20.0) < 3.0]) < 2.5


def test_a_reversed_path_counts_from_the_other_end_and_swaps_the_walls() -> None:
    places = np.concatenate([wall_ring(x_m) for x_m in (2.3, 7.1)])
    forth, back = unroll(places, PATH), unroll(places, PATH[::-1])
    np.testing.assert_allclose(forth[0] + back[0], LENGTH_M - 0.25, atol=1e-9)
    is_side = np.abs(np.abs(forth[1]) - 90.0) < 60.0
    np.testing.assert_allclose(back[1][is_side], -forth[1][is_side], atol=1e-9)
    np.testing.assert_allclose(forth[2], back[2], atol=1e-9)


def test_a_path_that_comes_back_counts_on() -> None:
    beside = make_pose(translation=np.array([0.0, -1.0, 0.0])) @ PATH[::-1]
    there_and_back = np.concatenate([PATH, beside])
    left, right = wall_ring(4.3)[1:3]
    chainage_m, _, _ = unroll(np.array([left, right, *wall_ring(4.3)[[0, 3]]]), there_and_back)
    # the left wall is nearer to the way there, the right wall to the way back, which is a metre longer
    assert chainage_m[0] == pytest.approx(4.3, abs=1e-6)
    assert chainage_m[1] == pytest.approx(2 * (LENGTH_M - 0.25) + 1.0 - 4.3, abs=1e-6)
    assert unroll(np.zeros((0, 3)), PATH)[0].shape == (0,)


@pytest.mark.parametrize(("wide_m", "back_deg"), [(0.4, 90.0), (6.0, -90.0)], ids=["on the spot", "by a bend"])
def test_a_wall_keeps_its_side_past_a_turn_on_the_spot(wide_m: float, back_deg: float) -> None:
    ahead_m, half = np.arange(0.0, 40.0, 0.25), wide_m / 2
    turn = np.arange(0.0, np.pi, 0.25 / max(half, 0.5))
    out = np.column_stack([ahead_m, 0 * ahead_m])
    bend = np.column_stack([40.0 + half * np.sin(turn), half - half * np.cos(turn)])
    back = np.column_stack([ahead_m[:80:-1], np.full(79, wide_m)])
    path = np.concatenate([out, bend, back])
    session = make_pose(translation=np.column_stack([path, np.zeros(len(path))]))
    # beside the way out, and beside the way back, which is shorter: to the north and to the south
    north_m = np.array([0.1, -0.1, wide_m + 0.1, wide_m - 0.1])
    places = np.column_stack([np.full(4, 30.1), north_m, np.zeros(4)])
    np.testing.assert_allclose(unroll(places, session)[1], [90.0, -90.0, back_deg, -back_deg], atol=1e-6)
    np.testing.assert_allclose(unroll(places, session[::-1])[1], [-90.0, 90.0, -back_deg, back_deg], atol=1e-6)


def test_a_region_that_two_passes_share_has_the_place_of_its_middle() -> None:
    beside = make_pose(translation=np.array([0.0, -1.0, 0.0])) @ PATH[::-1]
    y_m, x_m = (each.ravel() for each in np.meshgrid(np.arange(-1.4, 0.5, 0.1), np.arange(3.0, 5.0, 0.1)))
    roof = np.column_stack([x_m, y_m, np.full(len(x_m), RADIUS_M)])
    chainage_m, angle_deg, _ = unroll(roof, np.concatenate([PATH, beside]))
    middle_m = middle_place(roof, chainage_m, angle_deg)[0]
    # 4 m on the way there is 20.5 m on the way back; the median of both names neither
    assert min(abs(middle_m - 4.0), abs(middle_m - (2 * (LENGTH_M - 0.25) + 1.0 - 4.0))) < 0.2


def test_areas_and_volumes_of_regions(survey: Survey) -> None:
    """3.6 m by 150 degrees came 40 mm, 3 m by 120 degrees on the other side went 30 mm."""
    places = survey[1]
    x_m, angle_deg = places.points[:, 0], about_axis_deg(places.points)
    came_m = np.where((np.abs(x_m - 3.5) < 1.8) & (np.abs(angle_deg - 90.0) < 75.0), 0.04, 0.0)
    went_m = np.where((np.abs(x_m - 8.5) < 1.5) & (np.abs(angle_deg + 90.0) < 60.0), -0.03, 0.0)
    # one degree of the round is 35 mm wide
    came_m2, went_m2 = 3.6 * 150 * np.deg2rad(RADIUS_M), 3.0 * 120 * np.deg2rad(RADIUS_M)
    level_m = np.full(len(places.points), 1e-3)
    region, regions = group_regions(places, came_m + went_m, level_m, 0.25, 0.005, 0.75)
    assert len(regions) == 2
    for number, (found, volume_m3) in enumerate(zip(regions, (came_m2 * 0.04, went_m2 * -0.03), strict=True)):
        assert found.volume_m3 == pytest.approx(volume_m3, rel=0.05)
        assert found.mean_m * found.area_m2 == pytest.approx(found.volume_m3)
        assert places.areas_m2[region == number].sum() == pytest.approx(found.area_m2)
    assert [found.largest_m for found in regions] == [0.04, -0.03]
    # of a step, half is left at the edge once it is smoothed: with this least displacement a region ends there
    for along_m, area_m2, x_of_centre_m in ((came_m, came_m2, 3.5), (went_m, went_m2, 8.5)):
        _, (found,) = group_regions(places, along_m, level_m, 0.25, float(np.abs(along_m).max()) / 2, 0.75)
        assert found.area_m2 == pytest.approx(area_m2, rel=0.05)
        assert found.centre_map[0] == pytest.approx(x_of_centre_m, abs=0.1)


def test_regions_below_the_level_or_too_small_are_none(survey: Survey) -> None:
    places = survey[1]
    along_m, level_m = true_displacement(places, left_wall), np.full(len(places.points), 1e-3)
    assert group_regions(places, along_m, level_m, 0.25, 0.005, 0.75)[1]
    assert group_regions(places, along_m, level_m * 100, 0.25, 0.005, 0.75)[1] == ()
    assert group_regions(places, along_m, level_m, 0.25, 0.03, 0.75)[1] == ()
    assert group_regions(places, along_m, level_m, 0.25, 0.005, 20.0)[1] == ()
    region, regions = group_regions(places, along_m, level_m * np.nan, 0.25, 0.005, 0.75)
    assert regions == ()
    assert (region == -1).all()


def test_averaging_leaves_the_part_of_the_level_that_neighbours_share(survey: Survey) -> None:
    """20 mm at a level of 30 mm: found where errors are independent, not where 25 mm of them are of the alignment."""
    places = survey[1]
    along_m, level_m = true_displacement(places, left_wall), np.full(len(places.points), 0.03)
    assert len(group_regions(places, along_m, level_m, 0.25, 0.005, 0.75)[1]) == 1
    for shared_m in (0.025, np.full(len(level_m), 0.025)):
        assert group_regions(places, along_m, level_m, 0.25, 0.005, 0.75, shared_m=shared_m)[1] == ()


def test_normals_point_to_where_the_rock_was_seen_from() -> None:
    """A face that was seen from 3 m away, and another drift passes 1.5 m behind it."""
    y_m, z_m = (each.ravel() for each in np.meshgrid(np.arange(-2.0, 2.0, 0.02), np.arange(0.0, 3.0, 0.02)))
    points = np.column_stack([np.full(len(y_m), 3.0), y_m, z_m])
    seen, behind = np.arange(-5.0, 0.1, 0.5), np.arange(-5.0, 5.1, 0.5)
    path = np.concatenate([
        np.column_stack([seen, np.zeros(len(seen)), np.ones(len(seen))]),
        np.column_stack([np.full(len(behind), 4.5), behind, np.ones(len(behind))]),
    ])  # fmt: skip
    returns = single_returns(points, np.where(y_m > 0, 5.0, 4.0), np.ones(len(points)))
    returns = replace(returns, map_T_sensor=make_pose(translation=path))
    places = choose_places(make_cells(returns), returns, 0.25, 0.3)
    assert len(places.points) > 100
    np.testing.assert_allclose(places.normals[:, 0], -1.0, atol=1e-6)
    sensors = np.where(places.points[:, 1] > 0, 0.0, -1.0)[:, None] * [1.0, 0.0, 0.0] + [0.0, 0.0, 1.0]
    is_inner = np.abs(places.points[:, 1]) > 0.05
    away_m = np.linalg.norm(places.points - sensors, axis=1)
    np.testing.assert_allclose(places.seen_from_m[is_inner], away_m[is_inner], atol=1e-6)


def test_thin_maps_are_warned_of_and_measured_with_larger_spheres() -> None:
    def thinned(returns: NearReturns) -> NearReturns:
        return single_returns(points := cell_means(returns.points, 0.25)[0], points[:, 0].clip(0.0, 11.0),
                              np.ones(len(points)))  # fmt: skip

    before, after = thinned(tunnel(1)), thinned(tunnel(2, lambda x_m, _: np.where(np.abs(x_m - 6.0) < 2.0, 0.03, 0.0)))
    cells = make_cells(before)
    for radius_m, is_thin in ((0.2, True), (0.5, False)):
        radii = [f"surface.radius_m={radius_m}", f"surface.normal_m={max(radius_m, 0.3)}"]
        config = load_config("tunnelcd", ["surface.method=planes", *radii])
        places = choose_places(cells, before, 0.25, config.surface.normal_m)
        found = measure_planes(cells, after, places, unroll(places.points, PATH)[0], config)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            _warn_of_thin_maps((cells, found.after), found.displacement_m, config)
        told = [str(each.message) for each in caught if each.category is InputWarning]
        assert len(told) == is_thin
        assert all("0.2" in text and "surface.radius_m=0." in text for text in told)
        known = np.isfinite(found.displacement_m)
        assert (np.count_nonzero(known) < 1000) == is_thin
        if not is_thin:
            assert known.mean() > 0.9
            middle = np.abs(places.points[:, 0] - 6.0) < 1.0
            assert np.nanmedian(found.displacement_m[middle]) == pytest.approx(0.03, abs=0.003)


@pytest.mark.parametrize(
    ("settings", "remedy"),
    [
        (["surface.method=planes"], "--set surface.radius_m=0.8 --set surface.normal_m=0.8"),
        (["surface.method=planes", "surface.radius_m=0.9"], "--set surface.normal_m=0.8"),
        (["surface.method=m3c2"], "--set m3c2.cylinder_m=0.8 --set surface.normal_m=0.8"),
        (["surface.method=m3c2-ep"], "--set m3c2.cylinder_m=0.8 --set surface.normal_m=0.8"),
        (["surface.method=c2c"], "--set surface.normal_m=0.8"),
        (["surface.method=c2m"], "--set surface.mesh_m=0.8 --set surface.normal_m=0.8"),
        (["surface.method=unrolled"], "--set surface.raster_m=0.8 --set surface.normal_m=0.8"),
    ],
)
def test_the_warning_of_a_thin_map_names_settings_of_the_method(settings: list[str], remedy: str) -> None:
    x, y = np.meshgrid(np.arange(20) * 0.39, np.arange(20) * 0.39)
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(400)]) + 0.001
    cells = make_cells(single_returns(points, points[:, 0], np.ones(400)), with_folds=False)
    with pytest.warns(InputWarning) as caught:
        _warn_of_thin_maps((cells, None), np.full(400, np.nan), load_config("tunnelcd", settings))
    (text,) = (str(each.message) for each in caught)
    assert text.endswith(f" too few: {remedy}")
    given = load_config("tunnelcd", [*settings, *remedy.replace("--set ", "").split()])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _warn_of_thin_maps((cells, None), np.full(400, np.nan), given)


def test_the_places_cover_the_area_of_the_tunnel(survey: Survey) -> None:
    inner = np.abs(survey[1].points[:, 0] - 6.0) < 5.0
    assert survey[1].areas_m2[inner].sum() == pytest.approx(2 * np.pi * RADIUS_M * 10.0, rel=0.05)


def test_motions_between_stations_by_hand() -> None:
    """Station 0 m slides by 10 mm along y; that at 2 m turns by 1 mrad about z through (2, 0, 0)."""
    motions = np.array([[0, 0, 0, 0, 0.01, 0], [0, 0, 1e-3, 0, 0, 0]], dtype=np.float64)
    centres = np.array([[0.0, 0, 0], [2.0, 0, 0]])
    of_path = PathMotions(0.0, centres, motions, np.tile(1e-6 * np.eye(6), (2, 1, 1)))
    points = np.array([[5.0, 0, 0]] * 5)
    path_m = np.array([0.0, 2.0, 1.0, -3.0, 9.0])
    # 3 m from the centre of the second: 3 mm; half way between, half of each; beyond the ends, as at the ends
    expected_m = [0.01, 0.003, 0.0065, 0.01, 0.003]
    np.testing.assert_allclose(of_path.shifts(points, path_m)[:, 1], expected_m, atol=1e-12)
    along_m, variance_m2 = of_path.along(points, np.tile([0.0, 1, 0], (5, 1)), path_m)
    np.testing.assert_allclose(along_m, expected_m, atol=1e-12)
    # the variance of the slide is 1e-6, that of the turn 1e-6 times the square of the lever
    np.testing.assert_allclose(variance_m2[:3], [(1 + 25) * 1e-6, (1 + 9) * 1e-6, (26 + 10) / 2 * 1e-6], rtol=1e-9)


def test_motions_are_found_again_with_a_third_of_outliers() -> None:
    rng = stream(5, "motions")
    angle = rng.uniform(-np.pi, np.pi, 3000)
    normals = -np.column_stack([np.zeros(3000), np.sin(angle), np.cos(angle)])
    points = np.column_stack([rng.uniform(0, 12, 3000), np.zeros(3000), np.zeros(3000)]) - RADIUS_M * normals
    turn, slide = np.array([0.0, 1e-3, -2e-3]), np.array([0.0, 0.004, 0.003])
    shift = np.cross(turn, points - [6.0, 0, 0]) + slide
    clean_m = np.einsum("ij,ij->i", shift, normals)
    along_m = clean_m + rng.normal(0, 5e-4, 3000) + np.where(np.abs(angle - 1.5) < np.pi / 3, 0.03, 0.0)
    found = fit_motions(points, normals, along_m, points[:, 0], 8.0)
    np.testing.assert_allclose(found.along(points, normals, points[:, 0])[0], clean_m, atol=5e-4)


@pytest.mark.parametrize("tilt", [0.0, 0.01])
def test_motions_of_a_floor_of_which_a_strip_heaved(tilt: float) -> None:
    """No normal points down: a fit that begins on that half has nothing to begin with."""
    rng = stream(7, "floor")
    points = np.column_stack([rng.uniform(0, 12, 3000), rng.uniform(-2.5, 2.5, 3000), np.zeros(3000)])
    normals = np.array([0.0, 0, 1]) + rng.normal(0, tilt, (3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    is_still = points[:, 1] < 1.2
    along_m = rng.normal(0, 5e-4, 3000) + np.where(is_still, 0.0, 0.05)
    moved_m, variance_m2 = fit_motions(points, normals, along_m, points[:, 0], 8.0).along(points, normals, points[:, 0])
    np.testing.assert_allclose(moved_m[is_still], 0.0, atol=5e-4)
    assert np.isfinite(variance_m2).all()


def test_offsets_at_one_point_tell_no_rotation() -> None:
    along_m = stream(8, "lever").normal(0, 5e-4, 600) + np.repeat([0.0, 0.05], 300)
    found = fit_motions(np.tile([1.0, 2, 3], (600, 1)), np.tile([0.0, 0, 1], (600, 1)), along_m, np.zeros(600), 8.0)
    assert (found.motions[:, :3] == 0).all()
    assert np.isfinite(found.covariances).all()


def test_offsets_of_which_none_is_near_the_motion_of_all() -> None:
    """Those that agree lie at the end of the window of the station at 8 m, and weigh nothing there."""
    points = np.column_stack([stream(9, "near").uniform(-2, 2, (600, 2)), np.zeros(600)])
    points = np.concatenate([points, points[:200], points[:200]])
    along_m = np.repeat([0.0, -0.09, 0.09], [600, 200, 200])
    path_m = np.repeat([0.0, 8.0], [600, 400])
    found = fit_motions(points, np.tile([0.0, 0, 1], (1000, 1)), along_m, path_m, 8.0)
    np.testing.assert_allclose(found.motions, 0.0, atol=1e-9)
    assert np.isfinite(found.covariances[[0, -1]]).all()


@pytest.mark.parametrize("apart_m", [5.0, 8.0, 15.0])
def test_stations_far_from_one_another_tell_motions_where_they_stand(apart_m: float) -> None:
    rng = stream(6, "stations")
    normals = rng.normal(size=(600, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    path_m = np.repeat([0.0, apart_m, 2 * apart_m], 200)
    points = rng.uniform(-3, 3, (600, 3)) + path_m[:, None] * [1, 0, 0]
    found = fit_motions(points, normals, 0.01 * normals[:, 2], path_m, 4.0)
    moved_m, variance_m2 = found.along(points, normals, path_m)
    np.testing.assert_allclose(moved_m, 0.01 * normals[:, 2], atol=1e-4)
    assert np.isfinite(variance_m2).all()


def test_too_few_offsets_tell_no_motion() -> None:
    points, unknown = np.zeros((5, 3)), np.full(5, np.nan)
    for along_m in (np.zeros(5), unknown):
        found = fit_motions(points, np.tile([0.0, 0, 1], (5, 1)), along_m, np.zeros(5), 8.0)
        moved_m, variance_m2 = found.along(points, np.tile([0.0, 0, 1], (5, 1)), np.zeros(5))
        assert (moved_m == 0).all()
        assert np.isnan(variance_m2).all()
