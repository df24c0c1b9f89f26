from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float32Array, Float64Array, Int32Array
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster
from sim.sensor.footprint import (
    EVERYWHERE,
    PULSE_M,
    Echo,
    Limits,
    beam_bundle,
    blend_echoes,
    central_echo,
    divide_light,
    spread_echo,
    sub_ray_pattern,
)
from sim.sensor.optics import DIVERGENCE_RAD, WAIST_M, received_photons
from sim.sensor.rays import Rays

N_FAN = 1201
REACH_DEG = 0.6


def plate(x_m: float, y_m: tuple[float, float]) -> Mesh:
    """An upright plate across the x axis."""
    (low, high), z_m = y_m, 5.0
    corners = [(x_m, low, -z_m), (x_m, high, -z_m), (x_m, high, z_m), (x_m, low, z_m)]
    return Mesh(np.array(corners), np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def fan() -> Rays:
    """Rays from the origin about the x axis, all level."""
    angle = np.deg2rad(np.linspace(-REACH_DEG, REACH_DEG, N_FAN))
    directions = np.stack([np.cos(angle), np.sin(angle), np.zeros(N_FAN)], axis=1)[:, None]
    return Rays(np.zeros((N_FAN, 3)), directions.astype(np.float32))


def one_ray(*meshes: Mesh) -> Echo:
    return central_echo(Caster(meshes), np.full(len(meshes), 0.3, np.float32), fan(), 0.015, each_its_own(meshes))


def many_rays(sub_rays: Literal[7, 19], *meshes: Mesh, limits: Limits = EVERYWHERE) -> Echo:
    reflectivity = np.full(len(meshes), 0.3, np.float32)
    return spread_echo(Caster(meshes), reflectivity, fan(), 0.015, each_its_own(meshes), sub_rays, limits)


def each_its_own(meshes: tuple[Mesh, ...]) -> Int32Array:
    return np.arange(len(meshes), dtype=np.int32)


def step(depth_m: float) -> tuple[Mesh, Mesh]:
    """Geom 0 at 10 m right of the axis, geom 1 behind it over the whole width."""
    return plate(10.0, (-5.0, 0.0)), plate(10.0 + depth_m, (-5.0, 5.0))


def half_width_m(range_m: float) -> float:
    return float(WAIST_M / 2 + range_m * np.tan(DIVERGENCE_RAD / 2))


def sideways_m() -> Float64Array:
    """Where the middle of each ray of the fan crosses the near plate's plane."""
    return np.asarray(10.0 * np.tan(np.deg2rad(np.linspace(-REACH_DEG, REACH_DEG, N_FAN))))


def test_seven_rays_have_the_gaussians_moments_to_degree_five() -> None:
    places, weights = sub_ray_pattern(7)
    x, y = places.T
    variance = 1.0 / (2.0 * np.log(2.0))  # of a Gaussian with half its brightness at radius 1
    moments = {(0, 0): 1.0, (2, 0): variance, (0, 2): variance, (4, 0): 3 * variance**2, (2, 2): variance**2}
    for i in range(6):
        for j in range(6 - i):
            assert (weights * x**i * y**j).sum() == pytest.approx(moments.get((i, j), 0.0), abs=1e-12) or (i, j) == (
                0,
                4,
            )
    assert (weights * y**4).sum() == pytest.approx(3 * variance**2)


def test_nineteen_rays_are_a_hexagonal_lattice_with_the_gaussians_brightness() -> None:
    places, weights = sub_ray_pattern(19)
    assert places.shape == (19, 2)
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)[np.triu_indices(19, 1)]
    assert apart.min() == pytest.approx(1.0)
    radius = np.linalg.norm(places, axis=1)
    np.testing.assert_allclose(np.unique(radius.round(9)), [0.0, 1.0, np.sqrt(3.0), 2.0])
    np.testing.assert_allclose(weights / weights[0], 0.5 ** (radius**2))
    assert weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(weights @ places, 0.0, atol=1e-12)


@pytest.mark.parametrize("sub_rays", [7, 19])
def test_a_wall_met_squarely_is_seen_as_by_one_ray(sub_rays: Literal[7, 19]) -> None:
    wall = plate(10.0, (-5.0, 5.0))
    one, many = one_ray(wall), many_rays(sub_rays, wall)
    np.testing.assert_allclose(many.range_m, one.range_m, atol=2e-4)
    np.testing.assert_allclose(many.photons, one.photons, rtol=1e-3)
    np.testing.assert_allclose(many.true_range_m, one.true_range_m, atol=1e-5)
    np.testing.assert_array_equal(many.geom, one.geom)
    assert one.range_m[N_FAN // 2, 0] == pytest.approx(10.015, abs=1e-5)


def expected_at_step(depth_m: float, sub_rays: int) -> tuple[Float64Array, Float64Array]:
    """Light from the near and from the far surface at each ray of the fan, by geometry in float64."""
    places, weights = sub_ray_pattern(sub_rays)
    # The fan's rays are level, so the first of the two directions across is along -y.
    aside_m = sideways_m()[:, None] - places[:, 0] * half_width_m(10.0)
    near = (weights * (aside_m < 0)).sum(axis=1)
    light = [float(received_photons(np.float32([0.3]), np.float32([reach]))[0]) for reach in (10.015, 10.015 + depth_m)]
    return near * light[0], (1 - near) * light[1]


@pytest.mark.parametrize("sub_rays", [7, 19])
def test_at_a_step_of_a_decimetre_pixels_blend_as_the_light_divides(sub_rays: Literal[7, 19]) -> None:
    echo = many_rays(sub_rays, *step(0.1))
    range_m = (echo.range_m[:, 0] - 0.015) * np.cos(np.arctan(sideways_m() / 10.0))
    outermost = 2.0 if sub_rays == 19 else sub_ray_pattern(7)[0][:, 0].max()
    is_edge = np.abs(sideways_m()) < outermost * half_width_m(10.0) - 1e-4
    is_mixed = (range_m > 10.0005) & (range_m < 10.0995)
    np.testing.assert_array_equal(is_mixed[is_edge], True)
    # Share of edge pixels by geometry: the footprint's width over the fan's, at most one pixel more at either side.
    fan_m = 2 * 10.0 * np.tan(np.deg2rad(REACH_DEG))
    assert is_mixed.sum() == pytest.approx(N_FAN * 2 * outermost * half_width_m(10.0) / fan_m, abs=2)
    near, far = expected_at_step(0.1, sub_rays)
    # A sub-ray within rounding of the edge may fall to either side.
    off = np.abs(range_m - (10.0 * near + 10.1 * far) / (near + far))
    assert np.sort(off)[: -len(sub_ray_pattern(sub_rays)[0])].max() < 1.5e-3
    owner, share = echo.owner[:, 0], echo.owner_share[:, 0]
    np.testing.assert_array_equal(share < 1.0, is_mixed)
    off = np.abs(share - np.maximum(near, far) / (near + far))
    assert np.sort(off)[: -len(sub_ray_pattern(sub_rays)[0])].max() < 1e-3
    is_clear = np.abs(near - far) > 0.2 * np.maximum(near, far)
    assert ((owner == 0) != (near > far))[is_clear].sum() <= 1


def test_at_a_step_of_five_metres_the_stronger_surface_wins() -> None:
    echo = many_rays(19, *step(5.0))
    range_m, geom = echo.range_m[:, 0] - np.float32(0.015), echo.geom[:, 0]
    assert ((range_m < 10.01) | (range_m > 14.99)).all()
    np.testing.assert_array_equal(geom, np.where(range_m < 12.0, 0, 1))
    np.testing.assert_allclose(echo.true_range_m[:, 0], echo.range_m[:, 0], atol=0.01)
    near, far = expected_at_step(5.0, 19)
    is_clear = np.abs(near - far) > 0.2 * np.maximum(near, far)
    np.testing.assert_array_equal((geom == 0)[is_clear], (near > far)[is_clear])
    # Part of the beam passes by the edge, and with it part of the light.
    np.testing.assert_allclose(echo.photons[:, 0][is_clear], np.maximum(near, far)[is_clear], rtol=0.25)
    assert echo.photons[:, 0].min() < 0.6 * near.max()


def test_half_a_beam_past_an_edge_is_a_weaker_return_and_a_whole_one_a_miss() -> None:
    echo = many_rays(19, plate(10.0, (-5.0, 0.0)))
    sideways = sideways_m()
    beyond = sideways > 2 * half_width_m(10.0) + 1e-4
    assert beyond.sum() > 300
    for part, value in ((echo.range_m, 0.0), (echo.photons, 0.0), (echo.geom, -1), (echo.true_range_m, np.inf)):
        np.testing.assert_array_equal(part[beyond, 0], value)
    halfway = echo.photons[np.argmin(np.abs(sideways)), 0]
    assert 0.3 < halfway / echo.photons[0, 0] < 0.75
    assert (echo.geom[~beyond, 0] == 0).mean() > 0.99
    assert (np.abs(echo.range_m[echo.geom >= 0] - 10.015) < 0.01).all()


def test_the_beam_widens_by_its_divergence() -> None:
    for reach_m in (2.0, 40.0):
        echo = many_rays(19, plate(reach_m, (-5.0, 0.0)))
        aside_m = reach_m * np.tan(np.deg2rad(np.linspace(-REACH_DEG, REACH_DEG, N_FAN)))
        reaches_m = aside_m[echo.geom[:, 0] == 0].max()
        step_m = aside_m[1] - aside_m[0]
        assert reaches_m == pytest.approx(2 * half_width_m(reach_m), abs=1.5 * abs(step_m) + 1e-4)


@pytest.mark.parametrize("pitch_deg", [-40.0, -20.0, 25.0])
@pytest.mark.parametrize("sub_rays", [7, 19])
def test_a_scene_and_its_beams_tilted_together_give_the_same_echoes(sub_rays: Literal[7, 19], pitch_deg: float) -> None:
    rng = np.random.default_rng(5)
    yaw, level = rng.uniform(-np.pi, np.pi, 400), np.deg2rad(rng.uniform(-0.4, 0.4, 400))
    turn = Rotation.from_euler("y", pitch_deg, degrees=True).as_matrix()
    ways = np.stack([np.cos(level), np.sin(level) * np.cos(yaw), np.sin(level) * np.sin(yaw)], axis=1)
    plates = [plate(10.0, (-5.0, 0.0)), plate(10.3, (-5.0, 5.0))]
    plates[0] = Mesh(plates[0].vertices[:, [0, 2, 1]], plates[0].faces)  # its edge lies level, so that height counts
    echoes = [
        spread_echo(
            Caster([Mesh(mesh.vertices @ matrix.T, mesh.faces) for mesh in plates]),
            np.full(2, 0.3, np.float32),
            Rays(np.zeros((400, 3)), (ways @ matrix.T)[:, None].astype(np.float32)),
            0.015,
            np.arange(2, dtype=np.int32),
            sub_rays,
        )
        for matrix in (np.eye(3), turn)
    ]
    is_mixed = (echoes[0].range_m > 10.05) & (echoes[0].range_m < 10.28)
    assert is_mixed.sum() > 20
    # A sub-ray within rounding of the edge may fall to either side.
    off = np.abs(echoes[0].range_m - echoes[1].range_m)
    assert np.sort(off, axis=None)[:-4].max() < 2e-4
    assert (echoes[0].geom != echoes[1].geom).sum() <= 4


@pytest.mark.parametrize(("limits", "other"), [(Limits(12.0, 120.0), 1), (Limits(0.3, 12.0), 0)])
@pytest.mark.parametrize("sub_rays", [7, 19])
def test_a_surface_outside_the_limits_hides_none_within(sub_rays: Literal[7, 19], limits: Limits, other: int) -> None:
    meshes = step(5.0)
    places, weights = sub_ray_pattern(sub_rays)
    ranges_m, geoms, cosines = Caster(meshes).cast_bundles(fan().origins, fan().directions, beam_bundle(places))
    light = weights[:, None] * received_photons(0.3 * cosines, ranges_m + np.float32(0.015))
    reaches = (geoms == other).any(axis=0)
    free, told = many_rays(sub_rays, *meshes), many_rays(sub_rays, *meshes, limits=limits)
    assert (free.geom[reaches, 0] != other).sum() > 20  # the other surface sends more light
    assert (told.geom[reaches, 0] == other).all()
    within = np.where(geoms == other, light, 0.0).sum(axis=0)
    np.testing.assert_allclose(told.photons[reaches, 0], within[reaches], rtol=1e-5)
    np.testing.assert_array_equal(told.range_m[~reaches], free.range_m[~reaches])  # the receiver gates these later
    # a single group that straddles a limit stays whole
    near = many_rays(sub_rays, *step(0.5)), many_rays(sub_rays, *step(0.5), limits=Limits(0.3, 10.2))
    np.testing.assert_array_equal(near[0].range_m, near[1].range_m)


def brute_force(ranges_m: Float64Array, photons: Float64Array) -> tuple[float, float]:
    """Range and light of one pixel's strongest group, the slow way."""
    hits = sorted((r, p) for r, p in zip(ranges_m, photons, strict=True) if np.isfinite(r))
    groups: list[list[tuple[float, float]]] = []
    for r, p in hits:
        if groups and r - groups[-1][-1][0] < PULSE_M:
            groups[-1].append((r, p))
        else:
            groups.append([(r, p)])
    if not groups:
        return 0.0, 0.0
    light = [sum(p for _, p in group) for group in groups]
    best = int(np.argmax(light))
    return sum(r * p for r, p in groups[best]) / light[best], light[best]


def test_blending_equals_its_slow_twin() -> None:
    rng = np.random.default_rng(11)
    n_rays, n_pixels = 19, 400
    ranges_m = (rng.choice([4.0, 4.7, 5.3, 9.0, 30.0], (n_rays, n_pixels)) + rng.random((n_rays, n_pixels))).astype(
        np.float32
    )
    ranges_m[:, :100] = 6.0 + 0.3 * rng.random((n_rays, 100))
    ranges_m[rng.random(ranges_m.shape) < 0.1] = np.inf
    ranges_m[:, -3:] = np.inf
    photons = np.where(np.isinf(ranges_m), 0.0, rng.random(ranges_m.shape) + 0.01).astype(np.float32)
    range_m, light, strongest = blend_echoes(ranges_m, photons)
    expected = np.array([brute_force(ranges_m[:, i], photons[:, i]) for i in range(n_pixels)])
    np.testing.assert_allclose(range_m, expected[:, 0], rtol=2e-6)
    np.testing.assert_allclose(light, expected[:, 1], rtol=2e-6)
    # The strongest ray of the group lies in it and no other ray of the group is stronger.
    chosen = ranges_m[strongest, np.arange(n_pixels)]
    several = np.isfinite(ranges_m).any(axis=0)
    assert (np.abs(chosen - range_m)[several] < 4.0).all()
    order = rng.permutation(n_rays)
    again = blend_echoes(ranges_m[order], photons[order])
    np.testing.assert_allclose(again[0], range_m, rtol=2e-6)
    np.testing.assert_array_equal(order[again[2]][several], strongest[several])


def divided(*rays: tuple[int, float, float]) -> tuple[int, float]:
    """Owner and share of one pixel whose rays have an owner, a range and photons each."""
    owners, ranges_m, photons = (np.array(part)[:, None] for part in zip(*rays, strict=True))
    owner, share = divide_light(owners.astype(np.int32), ranges_m.astype(np.float32), photons.astype(np.float32))
    return int(owner[0]), float(share[0])


def test_light_is_divided_among_its_owners_by_hand() -> None:
    assert divided((0, 5.0, 40.0), (3, 5.3, 60.0)) == (3, pytest.approx(0.6))
    assert divided((3, 5.3, 5.0), (0, 5.0, 95.0)) == (0, pytest.approx(0.95))
    # the owner of most light need not have the strongest ray
    assert divided((3, 5.0, 40.0), (0, 5.1, 30.0), (0, 5.2, 30.0)) == (0, pytest.approx(0.6))
    assert divided((1, 5.0, 20.0), (2, 5.1, 30.0), (0, 5.2, 50.0)) == (0, pytest.approx(0.5))
    assert divided((4, 5.0, 1.0), (4, 5.9, 1.0)) == (4, 1.0)
    # the light of a weaker group is not reported; a miss has none; nor has an echo that is dark
    assert divided((0, 5.0, 60.0), (3, 5.5, 5.0), (3, 9.0, 35.0)) == (0, pytest.approx(60 / 65))
    assert divided((7, np.inf, 0.0), (3, 5.3, 2.0), (3, 5.3, 2.0)) == (3, 1.0)
    assert divided((7, 5.0, 0.0), (3, 5.3, 0.0))[1] == 1.0
    assert divided((7, np.inf, 0.0), (3, np.inf, 0.0))[1] == 1.0


def test_dividing_light_equals_its_slow_twin() -> None:
    rng = np.random.default_rng(3)
    shape = (19, 300)
    ranges_m: Float32Array = (rng.choice([4.0, 4.7, 5.3, 9.0], shape) + rng.random(shape)).astype(np.float32)
    ranges_m[rng.random(shape) < 0.1] = np.inf
    photons = np.where(np.isinf(ranges_m), 0.0, rng.random(shape) + 0.01).astype(np.float32)
    owners = rng.integers(0, 3, shape).astype(np.int32)
    owners[:, :50] = 2
    owner, share = divide_light(owners, ranges_m, photons)
    for pixel in range(shape[1]):
        hits = sorted(zip(ranges_m[:, pixel], photons[:, pixel], owners[:, pixel], strict=True))
        groups: list[list[tuple[float, float, int]]] = []
        for hit in (each for each in hits if np.isfinite(each[0])):
            if groups and hit[0] - groups[-1][-1][0] < PULSE_M:
                groups[-1].append(hit)
            else:
                groups.append([hit])
        best = max(groups, key=lambda group: sum(p for _, p, _ in group))
        light = [sum(p for _, p, o in best if o == each) for each in range(3)]
        assert share[pixel] == pytest.approx(max(light) / sum(light), rel=1e-5)
        assert owner[pixel] == np.argmax(light)
