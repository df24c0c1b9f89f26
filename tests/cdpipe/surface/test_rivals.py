"""The rivals of our measure of displacement, on a smooth tunnel of which a patch came 20 mm into the void."""

import importlib.util
from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, stream
from cdpipe.methods.registry import list_extras
from cdpipe.model.config import load_config
from cdpipe.surface.cells import NearReturns, SurfaceCells, make_cells
from cdpipe.surface.measure import load_method, require_method
from cdpipe.surface.method import Measured
from cdpipe.surface.places import SurfacePlaces
from cdpipe.surface.rivals.c2m import closest_on_triangles, find_closest, make_mesh
from tests.cdpipe.surface.tunnels import (
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

CONFIG = load_config("tunnelcd")
Survey = tuple[SurfaceCells, SurfacePlaces, Float64Array]


def needs_extra(name: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(importlib.util.find_spec("py4dgeo") is None, reason=f"{name} needs the extra `m3c2`")


RIVALS = [pytest.param(name, marks=needs_extra(name)) for name in ("m3c2", "m3c2-ep")] + ["c2c", "c2m", "unrolled"]
# Largest error of the mean over the patch, and of the mean where nothing moved, metres. C2C measures to the nearest of
# scattered cells, farther than the surface; the triangles of C2M are chords of the round.
BIASES_M = {"m3c2": (0.001, 2e-4), "m3c2-ep": (0.001, 2e-4), "c2c": (0.006, 0.002), "c2m": (0.002, 0.002),
            "unrolled": (0.001, 2e-4)}  # fmt: skip


@pytest.fixture(scope="module", name="survey")
def survey_fixture() -> Survey:
    return surveyed(tunnel(1))


@pytest.fixture(scope="module", name="moved")
def moved_fixture() -> NearReturns:
    return tunnel(2, left_wall)


@pytest.fixture(scope="module", name="unmoved")
def unmoved_fixture() -> NearReturns:
    return tunnel(3)


def measure(name: str, survey: Survey, after: NearReturns, *settings: str) -> Measured:
    cells, places, chainage_m = survey
    return load_method(name)(cells, after, places, chainage_m, load_config("tunnelcd", settings))


@pytest.mark.parametrize("name", RIVALS)
def test_a_patch_that_moved_has_its_sign_and_magnitude(name: str, survey: Survey, moved: NearReturns) -> None:
    found = measure(name, survey, moved)
    truth_m, inner = true_displacement(survey[1], left_wall), is_inner(survey[1])
    on, off = inner & (truth_m > 0), inner & (truth_m == 0)
    assert np.count_nonzero(on) > 20
    assert np.mean(found.displacement_m[on] > 0) > 0.99
    bias_m, still_bias_m = BIASES_M[name]
    assert found.displacement_m[on].mean() == pytest.approx(0.02, abs=bias_m)
    assert found.displacement_m[off].mean() == pytest.approx(0.0, abs=still_bias_m)
    np.testing.assert_array_equal(found.along_m, found.displacement_m)


@pytest.mark.parametrize("name", RIVALS)
def test_the_reverse_has_the_other_sign(name: str, unmoved: NearReturns) -> None:
    back = surveyed(tunnel(2, left_wall))
    found = measure(name, back, unmoved)
    on = is_inner(back[1]) & (true_displacement(back[1], left_wall) > 0)
    assert found.displacement_m[on].mean() == pytest.approx(-0.02, abs=BIASES_M[name][0])


@pytest.mark.parametrize("name", RIVALS)
def test_where_nothing_moved_the_level_holds(name: str, survey: Survey, unmoved: NearReturns) -> None:
    found = measure(name, survey, unmoved)
    inner = is_inner(survey[1])
    assert np.isfinite(found.level_m[inner]).all()
    assert np.mean(np.abs(found.displacement_m[inner]) <= found.level_m[inner]) >= 0.95
    assert (found.level_m[inner] > 0).all()


@pytest.mark.parametrize("name", RIVALS)
def test_without_returns_or_places_nothing_is_measured(name: str, survey: Survey, unmoved: NearReturns) -> None:
    cells, places, chainage_m = survey
    none = np.zeros(0)
    no_returns = single_returns(np.zeros((0, 3)), none, none)
    method = load_method(name)
    for measured in (
        method(cells, no_returns, places, chainage_m, CONFIG),
        method(make_cells(no_returns), no_returns, places, chainage_m, CONFIG),
    ):
        for values in (measured.displacement_m, measured.along_m, measured.level_m):
            assert values.shape == (len(places.points),)
            assert np.isnan(values).all()
    no_places = SurfacePlaces(np.zeros((0, 3)), np.zeros((0, 3)), *(none,) * 4)
    measured = method(cells, unmoved, no_places, none, CONFIG)
    assert measured.displacement_m.shape == measured.along_m.shape == measured.level_m.shape == (0,)


@pytest.mark.parametrize("name", ["c2c", "c2m", "unrolled"])
def test_a_larger_displacement_than_the_reach_is_not_measured(name: str, survey: Survey, moved: NearReturns) -> None:
    on = is_inner(survey[1]) & (true_displacement(survey[1], left_wall) > 0)
    assert np.isnan(measure(name, survey, moved, "surface.reach_m=0.01").displacement_m[on]).mean() > 0.9
    assert np.isfinite(measure(name, survey, moved).displacement_m[on]).all()


def test_the_level_of_c2c_is_the_spacing_of_the_cloud(survey: Survey, unmoved: NearReturns) -> None:
    """Of points scattered at random, density lambda, 95 % of distances to the nearest are below the level."""
    level_m = measure("c2c", survey, unmoved).level_m[is_inner(survey[1])]
    # all cells of 0.05 m that the round wall meets are occupied: 6.9e4 on 151 m2
    density = len(make_cells(unmoved).points) / (2 * np.pi * RADIUS_M * 12.0)
    assert np.median(level_m) == pytest.approx(np.sqrt(np.log(20) / (np.pi * density)), rel=0.1)


def test_the_level_of_m3c2_ep_has_the_alignment(survey: Survey, unmoved: NearReturns) -> None:
    pytest.importorskip("py4dgeo")
    exact = ("m3c2_ep.range_m=1e-6", "m3c2_ep.angle_deg=1e-6", "m3c2_ep.alignment_m=0.01")
    level_m = measure("m3c2-ep", survey, unmoved, *exact).level_m
    np.testing.assert_allclose(level_m, np.sqrt(7.815) * 0.01, rtol=1e-4)


def test_settings_of_a_rival_are_used(survey: Survey, moved: NearReturns) -> None:
    edge = np.abs(about_axis_deg(survey[1].points) - 90.0) < 35.0
    for name, setting in (("c2m", "surface.mesh_m=0.4"), ("unrolled", "surface.raster_m=0.5")):
        coarse, fine = measure(name, survey, moved, setting), measure(name, survey, moved)
        assert np.nanmax(np.abs(coarse.displacement_m - fine.displacement_m)[edge]) > 0.003


def test_a_heave_of_the_floor_leaves_the_roof_of_an_unrolled_tunnel(survey: Survey) -> None:
    """Each session's own axis would rise with its floor."""

    def heave(x_m: Float64Array, angle_deg: Float64Array) -> Float64Array:
        return np.where(np.abs(angle_deg) > 135.0, 0.1, 0.0)

    found = measure("unrolled", survey, tunnel(4, heave))
    angle_deg = np.abs(about_axis_deg(survey[1].points))
    inner = np.abs(survey[1].points[:, 0] - 6.0) < 5.0
    assert np.nanmean(found.displacement_m[inner & (angle_deg < 90)]) == pytest.approx(0.0, abs=5e-4)
    assert np.nanmean(found.displacement_m[inner & (angle_deg > 145)]) == pytest.approx(0.1, abs=0.002)


def test_the_closest_point_of_a_triangle_by_brute_force() -> None:
    rng = stream(1, "triangles")
    corners, points = rng.normal(0, 1, (60, 3, 3)), rng.normal(0, 2, (60, 3))
    corners[0, 2] = corners[0, 1]  # no area
    corners[1] = corners[1, 0]  # a point
    closest = closest_on_triangles(points, corners)
    shares = np.stack(np.meshgrid(np.linspace(0, 1, 301), np.linspace(0, 1, 301)), -1).reshape(-1, 2)
    shares = shares[shares.sum(axis=1) <= 1 + 1e-12]
    weights = np.column_stack([shares, 1 - shares.sum(axis=1)])
    for point, own, triangle in zip(points, closest, corners, strict=True):
        brute_m = np.linalg.norm(weights @ triangle - point, axis=1).min()
        assert np.linalg.norm(own - point) == pytest.approx(brute_m, abs=2e-3)
        assert np.linalg.norm(own - point) <= brute_m + 1e-9
    # and it lies in its triangle
    assert np.linalg.norm(closest_on_triangles(closest, corners) - closest, axis=1).max() < 1e-9


def test_the_mesh_goes_around_and_the_nearest_of_all_its_triangles_is_found() -> None:
    angle = np.deg2rad(stream(2, "mesh").uniform(-180, 180, 20_000))
    x_m = stream(3, "mesh").uniform(0, 4, 20_000)
    wall = np.column_stack([x_m, RADIUS_M * np.sin(angle), RADIUS_M * np.cos(angle)])
    mesh = make_mesh(wall, PATH, 0.15)
    a, b, c = mesh.vertices[mesh.triangles].transpose(1, 0, 2)
    area_m2 = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    # the seam is closed by up to a column of triangles twice; 4 m of wall less a rim of half a cell
    assert area_m2 == pytest.approx(2 * np.pi * RADIUS_M * 4.0, rel=0.06)
    asked = wall[:50] * [1.0, 0.95, 0.95]
    closest, triangle = find_closest(mesh, asked)
    for point, own, number in zip(asked, closest, triangle, strict=True):
        every = closest_on_triangles(np.tile(point, (len(mesh.triangles), 1)), mesh.vertices[mesh.triangles])
        assert np.linalg.norm(own - point) == pytest.approx(np.linalg.norm(every - point, axis=1).min(), abs=1e-12)
        np.testing.assert_allclose(every[number], own)
    # across the seam under the floor there is no gap
    floor = np.column_stack([np.linspace(1, 3, 41), np.zeros(41), np.full(41, -RADIUS_M)])
    assert np.linalg.norm(find_closest(mesh, floor)[0] - floor, axis=1).max() < 0.005


def test_a_mesh_of_too_few_points_is_empty() -> None:
    for n in (0, 1, 2):
        mesh = make_mesh(np.column_stack([np.arange(n) * 0.5, np.zeros(n), np.full(n, 2.0)]), PATH, 0.15)
        assert len(mesh.triangles) == 0
        assert np.isnan(find_closest(mesh, np.zeros((2, 3)))[0]).all()


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cdpipe.core.plugins.find_spec", lambda name: None)
    for name in ("m3c2", "m3c2-ep"):
        told = rf"surface.method = {name} needs a package more: pip install 'tunnelcd\[m3c2\]'"
        with pytest.raises(InputError, match=told):
            require_method(name)
        with pytest.raises(InputError, match=told):
            load_method(name)
    for name in ("none", "planes", "c2c", "c2m", "unrolled"):
        require_method(name)


def test_an_answer_names_the_package_of_the_rival(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cdpipe.methods.registry.extra_version", lambda name: f"{name} 1")
    config = load_config("tunnelcd", ["surface.method=m3c2-ep"])
    assert list_extras(config, {}) == list_extras(config, {}, proposes=False) == {"py4dgeo": "py4dgeo 1"}
    assert list_extras(config, {}, measures=False) == {}
    assert list_extras(load_config("tunnelcd", ["surface.method=c2m"]), {}) == {}
    both = load_config("dufomap", ["surface.method=m3c2"])
    assert list(list_extras(both, {})) == ["dufomap", "py4dgeo"]


def test_each_name_has_its_own_method() -> None:
    pytest.importorskip("py4dgeo")
    names = ("planes", "m3c2", "m3c2-ep", "c2c", "c2m", "unrolled")
    assert len({load_method(name) for name in names}) == len(names)


def test_a_rival_changes_no_argument(survey: Survey, moved: NearReturns) -> None:
    cells, places, chainage_m = survey
    kept = replace(moved, points=moved.points.copy()), replace(places, points=places.points.copy())
    for name in ("c2c", "c2m", "unrolled"):
        load_method(name)(cells, moved, places, chainage_m, CONFIG)
    np.testing.assert_array_equal(moved.points, kept[0].points)
    np.testing.assert_array_equal(places.points, kept[1].points)
