"""The measures of real and simulated revolutions: closed forms on synthetic data, figures of the real revolution."""

import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import typer
from typer.testing import CliRunner

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import invert, make_pose
from cdpipe.sensor.ouster import SensorMetadata, load_profile
from eval.studies.reality import scenes as reality_scenes
from eval.studies.reality.plots import draw_measures, draw_novelty, draw_scene
from eval.studies.reality.reality import DATA_VARIABLE, main
from eval.studies.reality.scenes import (
    cast_at_origin,
    change_effects,
    find_recording,
    find_world_points,
    gather_revolutions,
    plan_drive,
    read_real_revolution,
    rebuild,
    stop_drive,
)
from eval.studies.reality.sensor_measures import (
    Revolutions,
    destagger,
    estimate_photons,
    find_edges,
    find_isolated,
    measure_noise_sigma_m,
    measure_novel_share,
    measure_novel_shares,
    measure_photons_per_percent,
    measure_return_share,
    measure_spread,
    stagger,
)
from eval.studies.reality.static_novelty import (
    N_REVOLUTIONS,
    STANDING_NUMBERS,
    Case,
    Shares,
    Way,
    list_effect_variants,
    list_novelty_cases,
    measure_static_novelty,
)
from eval.studies.reality.tables import COLUMNS, arrange_by_source, format_markdown, tabulate_measures, tabulate_novelty
from scenarios.library import load_scenario
from scenarios.schema import Sensor
from sim.session.planning import plan_drives
from sim.session.revolution import Drive, cast_revolution

SENSOR = load_profile("os1-32-g", "1024x10")
EVERYWHERE = np.ones((1, SENSOR.height, SENSOR.width), dtype=bool)
OFF = Sensor(range_noise=False, dropouts=False, false_positives=False, rolling_scan=False, max_range_m=250.0)


@pytest.fixture(scope="module")
def drive() -> Drive:
    return plan_drive("smoke/one_box", 0, SENSOR, "os1-32-g")


def with_ranges(range_m: np.ndarray, signal: float = 100.0, reflectivity: float = 20.0) -> Revolutions:
    return Revolutions(SENSOR, range_m, np.full(range_m.shape, signal), np.full(range_m.shape, reflectivity))


def wall_ranges(normal: np.ndarray, distance_m: float) -> np.ndarray:
    """Destaggered ranges (1, H, W) of a plane normal . x = distance, 0 for the beams that miss it."""
    toward = SENSOR.directions @ normal
    with np.errstate(divide="ignore"):
        reach_m = (distance_m - SENSOR.origins @ normal) / toward
    ranges_m = np.where((toward > 0.02) & (reach_m > 0), reach_m + SENSOR.beam_origin_m, 0.0)
    return destagger(SENSOR, ranges_m)[None]


def test_destaggering_is_undone_and_shifts_each_row_by_its_own_columns() -> None:
    image = np.arange(SENSOR.height * SENSOR.width, dtype=np.float64).reshape(SENSOR.height, SENSOR.width)
    shifted = destagger(SENSOR, image)
    np.testing.assert_array_equal(stagger(SENSOR, shifted), image)
    assert shifted[8, 24] == image[8, 0]  # the table shifts row 8 by 24 columns


def test_noise_on_a_bent_surface_is_found_to_three_percent() -> None:
    """8 revolutions x 32768 pixels: the spread of 262144 values is known to 0.3 %, dependence included to about 1 %."""
    bend_m = 10.0 + 3.0 * np.sin(np.linspace(0.0, 4.0 * np.pi, SENSOR.width, endpoint=False))
    noise_m = 0.02 * np.random.default_rng(1).standard_normal((8, SENSOR.height, SENSOR.width))
    revolutions = with_ranges(bend_m + noise_m)
    assert measure_noise_sigma_m(revolutions, np.ones(noise_m.shape, bool)) == pytest.approx(0.02, rel=0.03)


def test_noise_estimate_does_not_see_edges() -> None:
    """A jump of 4 m spoils two second differences of 64: their root mean square would be 29 times off."""
    steps_m = np.where(np.arange(SENSOR.width) // 64 % 2 == 0, 8.0, 12.0)
    noise_m = 0.01 * np.random.default_rng(2).standard_normal((1, SENSOR.height, SENSOR.width))
    assert measure_noise_sigma_m(with_ranges(steps_m + noise_m), EVERYWHERE) == pytest.approx(0.01, rel=0.1)


def test_smooth_windows_need_seven_returns_and_ignore_the_middle() -> None:
    range_m = np.full((1, SENSOR.height, SENSOR.width), 5.0)
    range_m[0, 3, 100] = 5.5  # an outlier in the middle of a window stays in, at its ends it spoils four windows
    range_m[0, 4, 100] = 0.0
    smooth = with_ranges(range_m).is_smooth
    assert smooth[0, 3, [97, 98, 99, 100, 101, 102, 103]].tolist() == [False, False, True, True, True, False, False]
    assert smooth[0, 4, [96, 97, 103, 104]].tolist() == [True, False, False, True]


def test_spread_of_hand_made_values() -> None:
    assert measure_spread(np.array([1.0, 2.0, 3.0, 4.0, 100.0])) == pytest.approx(1.4826)
    assert np.isnan(measure_spread(np.zeros(0)))


def test_incidence_of_a_wall_is_that_of_its_normal() -> None:
    normal = np.array([1.0, 0.0, 0.0])
    revolutions = with_ranges(wall_ranges(normal, 4.0))
    toward = destagger(SENSOR, SENSOR.directions @ normal)
    found = revolutions.incidence_cosine[0]
    known = np.isfinite(found)
    assert known.sum() > 3000
    np.testing.assert_allclose(found[known], toward[known], atol=1e-6)
    np.testing.assert_array_equal(revolutions.is_facing[0][known], toward[known] > 0.85)


def test_return_share_counts_each_beam() -> None:
    range_m = np.full((2, SENSOR.height, SENSOR.width), 5.0)
    range_m[:, 7, :256] = 0.0
    shares = measure_return_share(with_ranges(range_m))
    assert shares[7] == 0.75
    assert (np.delete(shares, 7) == 1.0).all()


def test_photons_per_percent_is_the_constant_of_the_inverse_square_law() -> None:
    range_m = np.linspace(5.0, 50.0, SENSOR.width) * np.ones((1, SENSOR.height, 1))
    revolutions = Revolutions(SENSOR, range_m, 1400.0 * 30.0 / range_m**2, np.full(range_m.shape, 30.0))
    np.testing.assert_allclose(measure_photons_per_percent(revolutions, EVERYWHERE), 1400.0)
    bright = replace(revolutions, reflectivity=np.full(range_m.shape, 150.0))
    assert len(measure_photons_per_percent(bright, EVERYWHERE)) == 0


def test_expected_photons_come_from_both_neighbours_of_one_surface() -> None:
    revolutions = with_ranges(np.full((1, SENSOR.height, SENSOR.width), 5.0))
    revolutions.signal[0, 2, [9, 11]] = 4.0, 25.0
    revolutions.range_m[0, 2, 10] = 0.0  # its own return has no say
    revolutions.range_m[0, 3, 21] = 9.0
    expected = estimate_photons(revolutions)
    assert expected[0, 2, 10] == pytest.approx(10.0)
    assert np.isnan(expected[0, 2, [9, 11]]).all()  # a neighbour is missing
    assert np.isnan(expected[0, 3, [20, 22]]).all()  # the neighbours are two surfaces


def test_isolated_returns_are_those_unlike_all_eight_neighbours() -> None:
    range_m = np.full((1, SENSOR.height, SENSOR.width), 8.0)
    range_m[0, 5, 50] = 6.9  # alone
    range_m[0, 10, [70, 71]] = 6.0  # two: each has the other
    range_m[0, 15, 80] = 7.1  # within 1 m
    range_m[0, 20:23, 90:93] = 0.0
    range_m[0, 21, 91] = 8.0  # nothing around it
    range_m[0, 0, 0] = 3.0  # at the corner of the image, whose left neighbour is the last column
    found = {tuple(each) for each in np.argwhere(find_isolated(with_ranges(range_m)))}
    assert found == {(0, 5, 50), (0, 21, 91), (0, 0, 0)}


def test_edges_tell_mixed_missing_and_clean_pixels_apart() -> None:
    range_m = np.full((1, SENSOR.height, SENSOR.width), 5.0)
    range_m[0, :, 500:] = 8.0
    range_m[0, 4, 500] = 6.5
    range_m[0, 5, 500] = 5.2  # 0.2 m behind the near surface: not far enough from it
    range_m[0, 6, 500] = 0.0
    jump_m, is_mixed, is_missing = find_edges(with_ranges(range_m))
    assert np.argwhere(is_mixed).tolist() == [[0, 4, 500]]
    assert np.argwhere(is_missing).tolist() == [[0, 6, 500]]
    assert jump_m[0, 5, 500] == pytest.approx(3.0)
    assert np.isnan(jump_m[0, 5, 300])


def test_novel_share_of_hand_made_points() -> None:
    before = np.array([[0.05, 0.05, 0.05], [1.05, 0.0, 0.0]])
    after = np.array([[0.09, 0.01, 0.02], [0.11, 0.05, 0.05], [1.01, 0.09, 0.0], [-0.01, 0.05, 0.05]])
    assert measure_novel_share(after, before, 0.1) == 0.5  # over the border at 0.1, and below zero
    assert measure_novel_share(after, before, 0.2) == 0.25  # only below zero
    assert measure_novel_share(before, after, 0.1) == 0.0
    np.testing.assert_allclose(measure_novel_shares((before, after), (0.1, 0.2)), [0.25, 0.125])


def test_novelty_of_uniform_points_is_the_chance_of_an_empty_voxel() -> None:
    """n points in V voxels leave each empty with probability (1 - 1/V)^n."""
    generator = np.random.default_rng(5)
    halves = [generator.random((2000, 3)) for _ in range(2)]
    expected = (1.0 - 1.0 / 1000.0) ** 2000
    assert measure_novel_shares(halves, (0.1,))[0] == pytest.approx(expected, rel=0.1)


def test_rebuilt_scene_gives_a_recording_back_and_closes_small_holes_only(drive: Drive) -> None:
    """Ground 2 m below and a wall 12 m ahead; the simulator with every effect off must report what was recorded."""
    ground_m, wall_m = wall_ranges(np.array([0.0, 0.0, -1.0]), 2.0), wall_ranges(np.array([1.0, 0.0, 0.0]), 12.0)
    both = np.stack([np.where(each > 0, each, np.inf) for each in (ground_m, wall_m)]).min(axis=0)
    range_m = np.where(np.isfinite(both) & (both < 60.0), both, 0.0)
    row, column = 18, int(np.argmin(np.where(range_m[0, 18] > 0, range_m[0, 18], np.inf)))
    holes = range_m.copy()
    holes[0, row, column : column + 2] = 0.0
    holes[0, row, column + 10 : column + 13] = 0.0
    recorded = with_ranges(holes)
    scene, is_surface = rebuild(recorded, drive.scene)
    again = gather_revolutions(SENSOR, [cast_at_origin(scene, SENSOR, OFF, 0)])
    assert is_surface[row, column : column + 2].all()
    assert not is_surface[row, column + 10 : column + 13].any()
    np.testing.assert_array_equal(again.is_return[0], is_surface)
    seen = recorded.is_return
    error_m = np.abs(again.range_m - range_m)[seen]
    assert np.percentile(error_m, 95) < 0.002
    shares = again.reflectivity[seen]
    assert np.mean((shares >= 18) & (shares <= 22)) > 0.95  # 20 % apparent, in steps of 13 %


def test_standing_sensor_without_effects_sees_nothing_new_and_noise_alone_makes_it(drive: Drive) -> None:
    variants = list_effect_variants(drive.scenario.sensor)

    def found(variant: str, way: Way) -> Shares:
        return measure_static_novelty(drive, Case(way, variant, variants[variant], 4), 0)

    off, default, driving = found("all off", "standing"), found("default", "standing"), found("all off", "driving")
    assert off == (0.0, 0.0, 0.0)
    assert default[0] > default[1] > default[2] > 0.0
    assert driving[0] > 0.01  # another place samples other voxels
    assert default == found("default", "standing")
    assert found("all off", "driving, poses off")[0] > driving[0]


def test_no_case_of_novelty_is_the_same_as_another() -> None:
    default = Sensor()
    cases = list_novelty_cases(default)
    assert [each.n_revolutions for each in cases if (each.way, each.variant) == ("standing", "default")] == list(
        STANDING_NUMBERS
    )
    assert N_REVOLUTIONS in STANDING_NUMBERS
    driving = [each for each in cases if each.way == "driving"]
    assert {each.variant: each.settings for each in driving} == list_effect_variants(default)
    assert len(driving) == len(list_effect_variants(default))
    told = [(each.way, each.variant) for each in cases if each.n_revolutions == N_REVOLUTIONS]
    assert len(told) == len(set(told)) == 3 * len(driving) - 1  # how it rolls is no matter to a sensor that stands
    assert ("standing", "rolling_scan off") not in told


def test_a_drive_with_an_effect_off_is_the_drive_of_a_scenario_that_says_so(drive: Drive) -> None:
    said = ["sensor.profile=os1-32-g", "sensor.rolling_scan=false", "sensor.false_positives=false"]
    told = plan_drives(load_scenario("smoke/one_box", 0, said), 0, SENSOR)[0]
    default = drive.scenario.sensor
    off = change_effects(drive, default.model_copy(update={"rolling_scan": False, "false_positives": False}))
    rolls = change_effects(drive, default.model_copy(update={"false_positives": False}))
    stands, wanted, bent = (cast_revolution(each, 3)[1].range_mm for each in (off, told, rolls))
    np.testing.assert_array_equal(stands, wanted)
    assert (stands != bent).mean() > 0.3
    np.testing.assert_array_equal(cast_revolution(change_effects(off, default), 3)[1].range_mm, _range_mm(drive, 3))


def test_revolutions_of_a_standing_sensor_share_one_pose_and_no_noise(drive: Drive) -> None:
    still = stop_drive(drive, 5, 3)
    poses = still.trajectory.world_T_column(slice(0, 3))
    middle = drive.trajectory.world_T_column(slice(5, 6))[0, SENSOR.width // 2]
    np.testing.assert_array_equal(poses, np.broadcast_to(middle, (3, SENSOR.width, 4, 4)))
    first, second = _range_mm(still, 0), _range_mm(still, 1)
    both = (first > 0) & (second > 0)
    apart_mm = first[both].astype(float) - second[both]
    assert 0 < np.median(np.abs(apart_mm)) < 20
    assert abs(np.median(apart_mm)) <= 1


def _range_mm(drive: Drive, number: int) -> np.ndarray:
    return cast_revolution(drive, number)[1].range_mm


def test_points_of_a_moved_sensor_lie_on_the_same_wall(drive: Drive) -> None:
    off = change_effects(drive, OFF)
    _, result = cast_revolution(off, 0)
    poses = off.trajectory.world_T_column(slice(0, 1))[0]
    points = find_world_points(SENSOR, result, poses)
    moved = find_world_points(SENSOR, result, make_pose(translation=(1.0, 2.0, 3.0)) @ poses)
    np.testing.assert_allclose(moved - points, np.broadcast_to([1.0, 2.0, 3.0], points.shape), atol=1e-9)
    seen = (invert(poses[0]) @ np.c_[points, np.ones(len(points))].T).T[:, :3]  # it does not roll: all as the first
    expected = SENSOR.project(result.range_mm / 1000.0).swapaxes(0, 1)[result.range_mm.T > 0]
    np.testing.assert_allclose(seen, expected, atol=1e-9)


def test_effect_variants_differ_from_default_in_what_they_say() -> None:
    default = Sensor()
    variants = list_effect_variants(default)
    for name in ("rolling_scan", "range_noise", "dropouts", "false_positives"):
        assert variants[f"{name} off"] == default.model_copy(update={name: False})
        assert not getattr(variants["all off"], name)
    assert (variants["sub_rays 7"].sub_rays, variants["sub_rays 19"].sub_rays) == (7, 19)


def test_tables_put_sources_side_by_side_and_beams_as_extremes() -> None:
    range_m = np.full((1, SENSOR.height, SENSOR.width), 5.0)
    range_m[0, 3, :512] = 0.0
    table = pd.concat(
        [tabulate_measures(with_ranges(range_m), "a"), tabulate_measures(with_ranges(np.full_like(range_m, 5.0)), "b")]
    )
    assert tuple(table.columns) == COLUMNS
    wide = arrange_by_source(table).set_index(["measure", "where"])
    assert wide.loc[("returns by beam", "lowest"), ["a", "b"]].tolist() == [0.5, 1.0]
    assert wide.loc[("range noise, smooth", "4 to 6 m"), "b"] == 0.0
    assert wide.loc[("photons x range^2 per percent", "4 to 6 m"), "a"] == pytest.approx(100.0 * 25.0 / 20.0)
    assert ("range noise, smooth", "6 to 9 m") not in wide.index
    assert format_markdown(pd.DataFrame({"x": [1.23456, np.nan], "y": ["p", "q"]})) == (
        "| x | y |\n|---|---|\n| 1.23 | p |\n| - | q |\n"
    )


def test_plots_are_written(tmp_path: Path) -> None:
    noisy = 6.0 + 0.01 * np.random.default_rng(3).standard_normal((1, SENSOR.height, SENSOR.width))
    revolutions = with_ranges(noisy)
    draw_measures(tabulate_measures(revolutions, "real"), tmp_path / "a.png")
    draw_scene(revolutions, revolutions, tmp_path / "b.png")
    results = [(Case("standing", "default", Sensor(), n), (0.05 / n, 0.02 / n, 0.01 / n)) for n in (4, 8)]
    draw_novelty(results, tmp_path / "c.png")
    assert [path.read_bytes()[:4] for path in sorted(tmp_path.iterdir())] == [b"\x89PNG"] * 3
    assert tabulate_novelty(results).iloc[0, -3:].tolist() == pytest.approx([6.1, 2.1, 0.8])


def test_missing_recording_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="TUNNELCD_REAL_DATA"):
        find_recording(None)
    with pytest.raises(InputError, match=f"{tmp_path}: no real recording in it"):
        find_recording(tmp_path)
    (tmp_path / "ouster").mkdir()
    for suffix in (".pcap", ".json"):
        (tmp_path / "ouster" / f"{reality_scenes.RECORDING}{suffix}").touch()
    assert find_recording(tmp_path) == tmp_path / "ouster" / f"{reality_scenes.RECORDING}.pcap"
    monkeypatch.setitem(sys.modules, "ouster", None)
    with pytest.raises(InputError, match=r"tunnelcd\[ouster\]"):
        read_real_revolution(find_recording(tmp_path))


@pytest.fixture(scope="module")
def real() -> Iterator[Revolutions]:
    pytest.importorskip("ouster.sdk.core", reason="pip install 'tunnelcd[ouster]'")
    if DATA_VARIABLE not in os.environ:
        pytest.skip("real recordings: TUNNELCD_REAL_DATA is not set")
    yield read_real_revolution(find_recording(Path(os.environ[DATA_VARIABLE])))


def test_real_unit_returns_three_quarters_to_nine_tenths_of_each_beam(real: Revolutions) -> None:
    assert int(real.is_return.sum()) == 27310
    shares = measure_return_share(real)
    assert (round(shares.min(), 3), round(shares.max(), 3)) == (0.723, 0.908)


def test_real_range_noise_is_three_to_four_millimetres_on_facing_surfaces_nearby(real: Revolutions) -> None:
    near = real.is_smooth & real.is_facing & (real.range_m > 4) & (real.range_m < 9)
    assert near.sum() > 500
    assert 0.0025 < measure_noise_sigma_m(real, near) < 0.0045


def test_real_photons_follow_the_inverse_square_beyond_twenty_metres_and_fall_short_before(real: Revolutions) -> None:
    far = float(np.median(measure_photons_per_percent(real, real.range_m > 20.0)))
    assert 1300.0 < far < 1500.0
    at_3_m = float(np.median(measure_photons_per_percent(real, (real.range_m > 2.4) & (real.range_m < 3.0))))
    assert at_3_m < 0.02 * far


def test_real_returns_are_lost_at_the_data_sheets_photons(real: Revolutions) -> None:
    """10 % at 45 m, seen 9 times in 10, are 1398 x 10 / 45^2 = 6.9 photons."""
    expected = np.nan_to_num(estimate_photons(real))
    weak, strong = (expected >= 6) & (expected < 9), expected >= 48
    assert 0.82 < real.is_return[weak].mean() < 0.93
    assert 0.994 < real.is_return[strong].mean() < 0.999


def test_real_isolated_returns_and_mixed_pixels(real: Revolutions) -> None:
    assert 0.011 < find_isolated(real).sum() / real.is_return.sum() < 0.014
    jump_m, is_mixed, is_missing = find_edges(real)
    n_edges = np.isfinite(jump_m).sum()
    assert n_edges > 2500
    assert 0.08 < is_mixed.sum() / n_edges < 0.13
    assert 0.04 < is_missing.sum() / n_edges < 0.07


def test_command_reports_a_missing_folder() -> None:
    app = typer.Typer()
    app.command()(main)
    result = CliRunner().invoke(app, ["--out", "unused", "--data", "/nowhere"])
    assert isinstance(result.exception, InputError)
    assert "/nowhere: no real recording" in str(result.exception)


def test_sensor_of_the_recording_is_the_shipped_profile(real: Revolutions) -> None:
    shipped: SensorMetadata = load_profile("os1-32-g", real.sensor.mode)
    np.testing.assert_array_equal(shipped.altitude_deg, real.sensor.altitude_deg)
    np.testing.assert_array_equal(shipped.azimuth_deg, real.sensor.azimuth_deg)
    assert shipped.pixel_shift == real.sensor.pixel_shift
