"""Mist and dust: extinction and backscatter by their formulas, and what the sensor reports of either."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad

from cdpipe.core.geometry import make_pose, stream
from cdpipe.sensor.ouster import SensorMetadata
from scenarios import load_scenario
from scenarios.schema import Air, Dust, Mist, Sensor
from sim.geometry.mesh import Mesh, box_mesh
from sim.geometry.raycast import Caster
from sim.scene import Scene
from sim.sensor.air import AIR, DUST_M2_PER_MG, DUST_RATIO_SR, MIST_RATIO_SR, AirVolume, air_around, cross_air
from sim.sensor.footprint import Echo, Limits, central_echo
from sim.sensor.lidar import MISS, Scan, scan
from sim.sensor.optics import received_photons
from sim.sensor.rays import Rays, revolution_rays
from sim.session.simulate import simulate_in_memory

IDEAL = Sensor(range_noise=False, dropouts=False, false_positives=False)
FLOOR_Z_M = -1.5


def room(half_m: float = 12.0, reflectivity: float = 0.25) -> Scene:
    mesh = Mesh(box_mesh((half_m, half_m, 3.0)).vertices, box_mesh((half_m, half_m, 3.0)).faces[:, ::-1])
    share = np.array([reflectivity], np.float32)
    return Scene((mesh,), Caster([mesh]), np.zeros(1, np.int32), share, ("wall",), ("rock",))


def still(sensor: SensorMetadata, place: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Rays:
    return revolution_rays(sensor, np.tile(make_pose(translation=place), (sensor.width, 1, 1)))


def echoes(sensor: SensorMetadata, air: AirVolume, scene: Scene, seed: int = 1) -> tuple[Echo, Echo]:
    rays = still(sensor)
    clear = central_echo(scene.caster, scene.reflectivity, rays, sensor.beam_origin_m, scene.instance)
    return clear, cross_air(clear, rays, sensor.beam_origin_m, air, stream(seed, "air-returns"))[0]


def dusty(dust: Dust, at: tuple[float, float, float] = (0.0, 0.0, 0.0), time_s: float = 0.0) -> AirVolume:
    return air_around(Air(dust=dust), np.array(at), FLOOR_Z_M, time_s, 1, "after")


@pytest.mark.parametrize("visibility_m", [15.0, 40.0, 600.0])
def test_mist_dims_surfaces_by_beer_and_lambert(sensor: SensorMetadata, visibility_m: float) -> None:
    clear, misty = echoes(sensor, AirVolume(np.log(20) / visibility_m), room(half_m=5.0))
    is_surface = misty.geom >= 0
    assert is_surface.mean() > (0.05 if visibility_m == 15 else 0.8)
    reach_m = clear.range_m[is_surface].astype(np.float64) - sensor.beam_origin_m
    expected = 20.0 ** (-2 * reach_m / visibility_m)  # 5 % of the contrast is left at the visibility
    assert misty.photons[is_surface] / clear.photons[is_surface] == pytest.approx(expected, rel=1e-3)
    assert (misty.range_m[is_surface] == clear.range_m[is_surface]).all()


def test_dust_that_thins_upwards_dims_by_the_integral_along_the_ray(sensor: SensorMetadata) -> None:
    dust = Dust(mg_per_m3=300, scale_height_m=1.2, contrast=0)
    clear, dim = echoes(sensor, dusty(dust), room())
    rays = still(sensor)
    picked = np.argwhere(dim.geom >= 0)[::97]
    assert len(picked) > 100
    for column, row in picked.tolist():
        height_m, climb = rays.origins[column, 2] - FLOOR_Z_M, float(rays.directions[column, row, 2])
        reach_m = float(clear.range_m[column, row]) - sensor.beam_origin_m
        depth, _ = quad(lambda way, h=height_m, c=climb: np.exp(-max(h + c * way, 0.0) / 1.2), 0.0, reach_m)
        expected = np.exp(-2 * DUST_M2_PER_MG * 300 * depth)
        assert dim.photons[column, row] / clear.photons[column, row] == pytest.approx(expected, rel=0.01)


def test_dust_of_a_known_size_has_mies_extinction() -> None:
    # a gram of quartz in grains of 2.5 um: its cross-section, counted twice as large grains take twice their shadow
    grain_kg = 2650 * 4 / 3 * np.pi * 2.5e-6**3
    assert pytest.approx(2 * np.pi * 2.5e-6**2 * 1e-6 / grain_kg) == DUST_M2_PER_MG


@pytest.mark.parametrize(("air", "ratio_sr"), [(AirVolume(0.06), MIST_RATIO_SR), ("dust", DUST_RATIO_SR)])
def test_the_air_sends_back_what_its_backscatter_says(
    sensor: SensorMetadata, air: AirVolume | str, ratio_sr: float
) -> None:
    dust = Dust(mg_per_m3=0.06 / DUST_M2_PER_MG, scale_height_m=1e9, contrast=0)
    volume = air if isinstance(air, AirVolume) else dusty(dust)
    black = room(half_m=60.0, reflectivity=1e-9)  # all light is the air's
    rays = still(sensor)
    clear = central_echo(black.caster, black.reflectivity, rays, sensor.beam_origin_m, black.instance)
    level = np.abs(rays.directions[..., 2]) < 0.05  # 20 m of air before a wall
    counts = [cross_air(clear, rays, sensor.beam_origin_m, volume, stream(seed, "air-returns"))[0] for seed in range(3)]
    middle_m = np.arange(20) + 0.5
    power = np.pi * 0.06 / ratio_sr * np.exp(-2 * 0.06 * middle_m)
    expected = received_photons(power.astype(np.float32), (middle_m + sensor.beam_origin_m).astype(np.float32))
    rng = np.random.default_rng(0)
    drawn = rng.poisson(np.broadcast_to(expected, (200_000, 20)))
    strongest = drawn.max(axis=1)
    found = np.concatenate([echo.photons[level & (echo.geom == AIR)] for echo in counts])
    # the transform of a normal number against Poisson numbers themselves
    assert found.mean() == pytest.approx(strongest[strongest >= 1].mean(), rel=0.12)
    where = np.concatenate([echo.range_m[level & (echo.geom == AIR)] for echo in counts]) - sensor.beam_origin_m
    first = (drawn + rng.random(drawn.shape)).argmax(axis=1)[strongest >= 3]  # equal numbers: any of them
    weight = np.bincount(first, minlength=20) / len(first)
    strong = where[found >= 3]
    share = np.histogram(strong, np.arange(21))[0] / len(strong)
    assert np.abs(np.cumsum(share) - np.cumsum(weight)).max() < 0.08


def test_clear_air_changes_nothing_and_reports_nothing(sensor: SensorMetadata) -> None:
    clear, crossed = echoes(sensor, AirVolume(0.0), room())
    for name in ("range_m", "photons", "cosine", "true_range_m", "geom"):
        assert (getattr(clear, name) == getattr(crossed, name)).all()


def test_returns_of_the_air_are_labelled_and_belong_to_nothing(sensor: SensorMetadata) -> None:
    def seen(air: AirVolume | None) -> Scan:
        return scan(room(), sensor, Sensor(), still(sensor), 1, "after", 0, air=air)

    thick = seen(AirVolume(np.log(20) / 10.0))
    is_air = thick.geom == AIR
    assert 0.2 < is_air.mean() < 0.95
    assert not thick.is_mixed[is_air].any() and not thick.owner[is_air].any()
    assert np.isinf(thick.true_range_m[is_air]).all()
    assert np.median(thick.range_mm[is_air]) < 3000  # near the sensor, as in thick fog
    assert (seen(None).geom != AIR).all()


def test_the_air_hides_no_more_than_it_must(sensor: SensorMetadata) -> None:
    def shares(visibility_m: float) -> tuple[float, float]:
        result = scan(room(), sensor, Sensor(), still(sensor), 1, "after", 0, air=AirVolume(np.log(20) / visibility_m))
        return float((result.geom >= 0).mean()), float((result.geom == MISS).mean())

    seen = [shares(visibility_m)[0] for visibility_m in (8.0, 15.0, 30.0, 100.0)]
    assert seen == sorted(seen) and seen[0] < 0.2 and seen[-1] > 0.9


@pytest.mark.parametrize(("least_m", "most_m"), [(0.25, 0.75), (0.5, 1.0), (0.5, 1.5)])
def test_only_the_air_within_the_range_limits_competes(sensor: SensorMetadata, least_m: float, most_m: float) -> None:
    black, rays, origin_m, alpha = room(half_m=60.0, reflectivity=1e-9), still(sensor), sensor.beam_origin_m, 1.0
    clear = central_echo(black.caster, black.reflectivity, rays, origin_m, black.instance)
    limits = Limits(least_m + origin_m, most_m + origin_m)
    told, _ = cross_air(clear, rays, origin_m, AirVolume(alpha), stream(1, "air-returns"), limits)
    is_air = told.geom == AIR
    assert is_air.mean() > 0.97
    told_m = told.range_m[is_air]
    assert told_m.min() == pytest.approx(limits.least_m, abs=0.01)
    assert told_m.max() == pytest.approx(limits.most_m, abs=0.01)
    # pieces of one metre each, all of them nearer than 3 m, where a percent of reflectivity gives the same light
    edges_m = np.array([least_m, *np.arange(np.floor(least_m) + 1, most_m), most_m])
    power = np.pi * alpha / MIST_RATIO_SR * np.diff(edges_m) * np.exp(-alpha * (edges_m[1:] + edges_m[:-1]))
    expected = received_photons(power.astype(np.float32), np.full(len(power), 2.0, np.float32))
    counts = np.random.default_rng(0).poisson(expected, (200_000, len(power))).max(axis=1)
    assert told.photons[is_air].mean() == pytest.approx(counts[counts >= 1].mean(), rel=0.03)


def test_a_least_range_moves_the_echo_only_where_it_lay_below(sensor: SensorMetadata) -> None:
    scene, rays, origin_m = room(half_m=3.0), still(sensor), sensor.beam_origin_m
    clear = central_echo(scene.caster, scene.reflectivity, rays, origin_m, scene.instance)
    drawn = clear, rays, origin_m, AirVolume(np.log(20) / 10.0)
    free, _ = cross_air(*drawn, stream(1, "air-returns"))
    told, _ = cross_air(*drawn, stream(1, "air-returns"), Limits(0.8, 120.0))
    is_first_metre = (free.geom == AIR) & (free.range_m < 1.0 + origin_m)
    is_below = (free.geom == AIR) & (free.range_m < 0.8)
    assert is_below.mean() > 0.05
    assert (told.geom[is_below] == 0).mean() > 0.05
    assert (told.range_m >= np.float32(0.8)).all()
    for name in ("range_m", "photons", "geom"):
        np.testing.assert_array_equal(getattr(told, name)[~is_first_metre], getattr(free, name)[~is_first_metre])
    is_wall = told.geom == 0
    np.testing.assert_array_equal(told.range_m[is_wall], clear.range_m[is_wall])
    dimmed = clear.photons[is_wall] * 20.0 ** (-2 * (clear.range_m[is_wall] - origin_m) / 10.0)
    np.testing.assert_allclose(told.photons[is_wall], dimmed, rtol=1e-3)  # air that is not heard dims all the same


@pytest.mark.parametrize(("least_m", "most_m"), [(0.3, 120.0), (0.8, 120.0), (2.0, 6.0)])
def test_one_return_is_the_first_of_two_and_no_beam_loses_what_lies_within_the_limits(
    sensor: SensorMetadata, least_m: float, most_m: float
) -> None:
    def seen(returns: str) -> Scan:
        limits = {"min_range_m": least_m, "max_range_m": most_m, "returns": returns}
        settings = IDEAL.model_copy(update=limits)
        return scan(room(), sensor, settings, still(sensor), 1, "after", 0, air=AirVolume(np.log(20) / 12.0))

    strongest, dual, last = (seen(each) for each in ("strongest", "dual", "last"))
    first, second = np.split(dual.range_mm, 2)
    assert (strongest.geom == AIR).mean() > 0.1
    np.testing.assert_array_equal(strongest.range_mm, first)
    np.testing.assert_array_equal(strongest.geom, np.split(dual.geom, 2)[0])
    np.testing.assert_array_equal(last.range_mm, np.maximum(first, second))
    if most_m > 20:  # all walls are within
        assert (strongest.geom != MISS).all()


def test_swathes_keep_the_mean_and_drift_with_the_air() -> None:
    dust = Dust(mg_per_m3=100, contrast=0.8, patch_m=3, drift_mps=1.0)
    volume = dusty(dust)
    assert volume.dust is not None
    swathes = volume.dust.swathes.astype(np.float64)
    assert np.log(swathes).std() == pytest.approx(0.8, rel=0.15) and swathes.mean() == pytest.approx(1.0, abs=0.2)
    # the lattice follows the sensor, the swathes do not
    aside = dusty(dust, at=(5.0, -3.0, 0.0))
    points = np.random.default_rng(0).uniform(-6, 6, (3, 200)).astype(np.float32)
    assert volume.extinction(points)[0] == pytest.approx(aside.extinction(points)[0], rel=1e-6)
    heading_rad = _heading(1)
    drifted = points + np.array([[4 * np.cos(heading_rad)], [4 * np.sin(heading_rad)], [0]], np.float32)
    later = dusty(dust, time_s=4.0)
    near = np.corrcoef(volume.extinction(points)[0], later.extinction(drifted)[0])[0, 1]
    unmoved = np.corrcoef(volume.extinction(points)[0], later.extinction(points)[0])[0, 1]
    assert near > 0.9 > unmoved


def _heading(seed: int) -> float:
    generator = stream(seed, "after", "air")
    generator.integers(1 << 62)
    return float(generator.uniform(0.0, 2 * np.pi))


def test_another_surface_changes_no_draw_of_the_air(sensor: SensorMetadata) -> None:
    air = AirVolume(np.log(20) / 12.0)
    _, near = echoes(sensor, air, room(half_m=11.0))
    _, far = echoes(sensor, air, room(half_m=19.0))
    both = (near.geom == AIR) & (far.geom == AIR) & (near.range_m < 8)
    same = near.range_m[both] == far.range_m[both]
    assert both.sum() > 1000 and same.mean() > 0.99


def test_a_misty_session_has_labels_and_the_same_bytes_with_any_threads(tmp_path: Path) -> None:
    settings = ["after.air.mist.visibility_m=12", "platform.scan_spacing_m=3"]
    scenario = load_scenario("smoke/one_box", 1, settings)
    pair = simulate_in_memory(scenario, 1)
    before, after = (pair.sessions[name] for name in ("before", "after"))
    assert (before.instance != AIR).all()
    is_air = after.instance == AIR
    assert 0.01 < is_air.mean() < 0.9 and not after.change[is_air].any()
    again = simulate_in_memory(scenario, 1, n_threads=2)
    assert (again.sessions["after"].instance == after.instance).all()
    for one, other in zip(after.session.chunks(), again.sessions["after"].session.chunks(), strict=True):
        assert (one.range_mm == other.range_mm).all() and (one.signal == other.signal).all()
    # the before session does not know of it
    clear = simulate_in_memory(load_scenario("smoke/one_box", 1, settings[1:]), 1)
    for one, other in zip(before.session.chunks(), clear.sessions["before"].session.chunks(), strict=True):
        assert (one.range_mm == other.range_mm).all()


def test_a_scenario_with_clear_air_says_nothing_about_it() -> None:
    plain = load_scenario("smoke/one_box", 1).model_dump(mode="json")
    assert "air" not in plain["before"] and "air" not in plain["after"]
    misty = load_scenario("smoke/one_box", 1, ["after.air.mist.visibility_m=12"])
    assert misty.after.air == Air(mist=Mist(visibility_m=12)) and misty.before.air is None


@pytest.mark.parametrize("family", ["dust/narrow", "dust/wide", "dust/mist", "dust/null"])
def test_families_with_dust_are_the_clear_ones_seed_by_seed(family: str) -> None:
    twin = {"dust/wide": "wide", "dust/null": "unchanged/narrow"}.get(family, "narrow")
    for seed in (10000, 10001):
        clear, dusty_one = load_scenario(twin, seed), load_scenario(family, seed)
        assert dusty_one.after.air is not None
        dumped = [each.model_dump(mode="json") for each in (clear, dusty_one)]
        for tree in dumped:
            for key in ("family", "description"):
                tree.pop(key)
            for session in ("before", "after"):
                tree[session].pop("air", None)
        assert dumped[0] == dumped[1]
