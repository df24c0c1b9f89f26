"""Puddles: Fresnel's shares, the weak floor under water, the ghost below it, and where water stands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array
from cdpipe.sensor.ouster import SensorMetadata
from scenarios import load_scenario
from scenarios.schema import Puddle, Sensor
from sim.geometry.mesh import Mesh, box_mesh
from sim.geometry.raycast import Caster
from sim.placement.puddles import Pool, lay_puddles
from sim.scene import Scene, build_world
from sim.sensor.footprint import Echo, Limits, central_echo
from sim.sensor.lidar import scan
from sim.sensor.optics import MIRRORED, mirrored_share, received_photons
from sim.sensor.rays import Rays, revolution_rays
from sim.sensor.water import (
    WATER_ABSORPTION_PER_M,
    WATER_INDEX,
    Water,
    cross_water,
)
from sim.session.planning import plan_drives
from sim.session.revolution import simulate_revolution
from sim.session.simulate import simulate_pair
from sim.session.truth import read_labels
from sim.view.view import view_scenario

HALF_M = np.array([12.0, 12.0, 2.0])
DEPTH_M = 0.04
LEVEL_M = -HALF_M[2] + DEPTH_M
SMALL = ["platform.scan_spacing_m=2", "sensor.mode=512x10"]


def room() -> Scene:
    box = box_mesh(tuple(HALF_M))
    mesh = Mesh(box.vertices, box.faces[:, ::-1])
    share = np.array([0.25], np.float32)
    return Scene((mesh,), Caster([mesh]), np.zeros(1, np.int32), share, ("wall",), ("rock",))


def still(sensor: SensorMetadata) -> Rays:
    return revolution_rays(sensor, np.tile(np.eye(4), (sensor.width, 1, 1)))


def echoes(sensor: SensorMetadata, *pools: Pool) -> tuple[Rays, Echo, Echo]:
    scene, rays = room(), still(sensor)
    dry = central_echo(scene.caster, scene.reflectivity, rays, sensor.beam_origin_m, scene.instance)
    return rays, dry, cross_water(dry, rays, sensor.beam_origin_m, Water(pools, scene.caster, scene.reflectivity))[0]


def lake() -> list[Pool]:
    """Four puddles that cover the floor of the room."""
    puddle, corners = Puddle(name="lake", radius_m=10), [(x, y, LEVEL_M) for x in (-7.0, 7.0) for y in (-7.0, 7.0)]
    return [Pool(puddle, np.array(corner)) for corner in corners]


def test_the_mirrored_share_is_fresnels() -> None:
    assert mirrored_share(np.array(1.0), WATER_INDEX) == pytest.approx(((WATER_INDEX - 1) / (WATER_INDEX + 1)) ** 2)
    assert mirrored_share(np.array(0.0), WATER_INDEX) == pytest.approx(1.0)
    # at Brewster's angle light polarised in the plane of incidence is not mirrored, the rest by ((n^2 - 1)/(n^2 + 1))^2
    brewster = np.cos(np.arctan(WATER_INDEX))
    squared = WATER_INDEX**2
    assert mirrored_share(brewster, WATER_INDEX) == pytest.approx(((squared - 1) / (squared + 1)) ** 2 / 2)
    # Fresnel's own form, by the angles of incidence and refraction
    incidence = np.deg2rad([5.0, 30.0, 60.0, 80.0, 89.0])
    refraction = np.arcsin(np.sin(incidence) / WATER_INDEX)
    off, both = incidence - refraction, incidence + refraction
    expected = ((np.sin(off) / np.sin(both)) ** 2 + (np.tan(off) / np.tan(both)) ** 2) / 2
    assert mirrored_share(np.cos(incidence), WATER_INDEX) == pytest.approx(expected)
    shares = mirrored_share(np.linspace(1.0, 0.0, 50), WATER_INDEX)
    assert (np.diff(shares[25:]) > 0).all()


def spread_by_refraction(cosine: float) -> float:
    """Return by how much the solid angle of a narrow bundle grows where it leaves the water, from Snell's law."""
    above = np.arccos(cosine) + np.array([-1e-4, 1e-4])
    below = np.arcsin(np.sin(above) / WATER_INDEX)
    # solid angles are differences of cosines; flat beams shorten the section of the bundle
    solid = np.abs(np.diff(np.cos(above)) / np.diff(np.cos(below)))[0]
    shortened = cosine / np.cos(np.arcsin(np.sqrt(1 - cosine**2) / WATER_INDEX))
    return float(solid * shortened)


def test_the_floor_under_water_is_weak_and_seems_deeper(sensor: SensorMetadata) -> None:
    rays, dry, wet = echoes(sensor, *lake())
    steep = np.argwhere((wet.geom == 0) & (rays.directions[..., 2] < -0.3))
    assert len(steep) > 1000
    for column, row in steep[::199].tolist():
        cosine = -float(rays.directions[column, row, 2])
        path_m = DEPTH_M / np.sqrt(1 - (1 - cosine**2) / WATER_INDEX**2)
        passed = (1 - mirrored_share(np.array(cosine), WATER_INDEX)) ** 2 * np.exp(-2 * WATER_ABSORPTION_PER_M * path_m)
        passed /= spread_by_refraction(cosine)
        assert wet.photons[column, row] == pytest.approx(dry.photons[column, row] * passed, rel=1e-3)
        seems_m = dry.range_m[column, row] - DEPTH_M / cosine + WATER_INDEX * path_m
        assert wet.range_m[column, row] == pytest.approx(seems_m, abs=1e-4)


def test_a_flat_beam_reports_what_the_water_mirrors_where_its_mirror_image_is(sensor: SensorMetadata) -> None:
    rays, dry, wet = echoes(sensor, *lake())
    ghosts = np.argwhere(wet.geom == MIRRORED)
    assert len(ghosts) > 300
    column, row = ghosts.T
    reach_m = wet.range_m[column, row].astype(np.float64) - sensor.beam_origin_m
    points = rays.points(row, column, reach_m)
    mirrored = points * (1, 1, -1) + (0, 0, 2 * LEVEL_M)
    # mirrored back at the water they lie on a wall or on the roof of the room
    off_m = np.abs(np.abs(mirrored) - HALF_M).min(axis=1)
    assert off_m.max() < 2e-3
    assert (np.abs(mirrored) < HALF_M + 2e-3).all()
    assert (points[:, 2] < LEVEL_M).all()
    # as much light as Fresnel leaves after two mirrorings
    cosine = -rays.directions[column, row, 2]
    facing = np.where(np.abs(np.abs(mirrored[:, 0]) - HALF_M[0]) < 2e-3, np.abs(rays.directions[column, row, 0]), 0.0)
    on_x = facing > 0.5
    expected = received_photons(
        (0.25 * facing * mirrored_share(cosine, WATER_INDEX) ** 2).astype(np.float32), wet.range_m[column, row]
    )
    assert on_x.sum() > 30
    assert wet.photons[column, row][on_x] == pytest.approx(expected[on_x], rel=1e-3)
    # no beam changes that meets something before the water
    is_changed = (wet.range_m != dry.range_m) | (wet.photons != dry.photons)
    assert (rays.directions[is_changed][:, 2] < 0).all()
    to_wall_m = dry.range_m - sensor.beam_origin_m
    to_water_m = LEVEL_M / np.where(rays.directions[..., 2] < 0, rays.directions[..., 2], -1e-9)
    assert (to_wall_m[is_changed] > to_water_m[is_changed]).all()
    assert np.isinf(wet.true_range_m[column, row]).all()


def test_only_beams_inside_the_pool_change_and_ghosts_are_labelled(sensor: SensorMetadata) -> None:
    pool = Pool(Puddle(name="p", radius_m=1), np.array([4.0, 1.0, LEVEL_M]))
    rays, dry, wet = echoes(sensor, pool)
    column, row = np.nonzero(wet.photons != dry.photons)
    points = rays.points(row, column, (LEVEL_M / rays.directions[column, row, 2]).astype(np.float64))
    assert len(points) > 15
    assert (np.hypot(*(points[:, :2] - pool.centre[:2]).T) < 1.01).all()
    scene = room()
    water = Water(lake(), scene.caster, scene.reflectivity)
    seen = scan(scene, sensor, Sensor(false_positives=False), rays, 1, "after", 0, water=water)
    assert (seen.geom == MIRRORED).sum() > 100
    both = scan(scene, sensor, Sensor(false_positives=False, returns="dual"), rays, 1, "after", 0, water=water)
    first, second = np.split(both.geom, 2)
    # a beam that meets water has the floor and the ghost, whichever is the stronger
    assert ((first == 0) & (second == MIRRORED)).sum() > 100 < ((first == MIRRORED) & (second == 0)).sum()
    assert (both.signal[sensor.height :] <= both.signal[: sensor.height]).all()


PUDDLES = [
    "puddles=[{name: both, place: {between: [a, b], fraction: 0.4}, radius_m: 1.2},"
    " {name: new, sessions: after, place: {between: [a, b], fraction: 0.7}}]"
]


def nodes() -> list[str]:
    scenario = load_scenario("smoke/unchanged", 3)
    return list(scenario.before.route[:2])


def with_puddles() -> list[str]:
    first, second = nodes()
    return [line.replace("a, b", f"{first}, {second}") for line in PUDDLES]


def test_a_puddle_covers_the_lowest_part_of_the_floor_around_it() -> None:
    scenario = load_scenario("smoke/unchanged", 3, with_puddles())
    world = build_world(scenario, 3)
    before, after = (lay_puddles(scenario, world.centreline, world.walls, name, 3) for name in ("before", "after"))
    assert [pool.puddle.name for pool in before] == ["both"] and [pool.puddle.name for pool in after] == ["both", "new"]
    assert np.array_equal(before[0].centre, after[0].centre)
    for pool in after:
        above = pool.centre + np.column_stack([_disc(pool.puddle.radius_m), np.full(256, 0.5)])
        above_m, _, _ = world.walls.cast(above, (0.0, 0.0, -1.0))
        depths_m = above_m[np.isfinite(above_m)] - 0.5
        assert 0.03 < depths_m.max() < 0.055  # 0.05 m where the floor is lowest
        assert (depths_m > 0).mean() > 0.1 and (depths_m < 0).any()


def _disc(radius_m: float) -> Float64Array:
    generator = np.random.default_rng(0)
    radii, turn = radius_m * np.sqrt(generator.random(256)), 2 * np.pi * generator.random(256)
    return radii[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])


def test_a_session_without_puddles_keeps_its_bytes_and_ghosts_are_no_change(tmp_path: Path) -> None:
    simulate_pair(load_scenario("smoke/unchanged", 3, SMALL), 3, tmp_path / "dry")
    lines = [line.replace("{name: both,", "{name: both, sessions: after,") for line in with_puddles()]
    simulate_pair(load_scenario("smoke/unchanged", 3, [*SMALL, *lines]), 3, tmp_path / "wet")
    first = "chunks/00000.npz"
    assert (tmp_path / "dry/before" / first).read_bytes() == (tmp_path / "wet/before" / first).read_bytes()
    assert (tmp_path / "dry/after" / first).read_bytes() != (tmp_path / "wet/after" / first).read_bytes()
    n_chunks = len(list((tmp_path / "wet" / "after" / "chunks").iterdir()))
    labels = read_labels(tmp_path / "wet" / "after", n_chunks)
    instance, change = (np.concatenate([part.ravel() for part in parts]) for parts in zip(*labels, strict=True))
    assert (instance == MIRRORED).sum() > 50
    assert (change == 0).all()


def test_the_ghost_of_a_changed_prop_is_no_part_of_the_change(tmp_path: Path) -> None:
    scenario = load_scenario("smoke/one_box", 3)
    (box,) = [prop for prop in scenario.props if prop.change == "added"]
    world = build_world(scenario, 3)
    (place,) = [item.world_T_object[:3, 3] for item in world.standing if item.prop.name == box.name]
    wet = scenario.model_copy(update={"sensor": scenario.sensor.model_copy(update={"mode": "1024x10"})})
    drive = plan_drives(wet, 3)[1]
    pool = Pool(Puddle(name="p", radius_m=3), place + np.array([0.0, 0.0, 0.02]))
    dry, water = (
        [simulate_revolution(replace(drive, water=each), number) for number in range(0, drive.trajectory.n_scans, 4)]
        for each in (None, Water((pool,), drive.scene.caster, drive.scene.reflectivity))
    )
    n_ghosts = sum((each.instance == MIRRORED).sum() for each in water)
    assert n_ghosts > 100
    for one, other in zip(dry, water, strict=True):
        assert not other.change[other.instance == MIRRORED].any()
        assert other.change.astype(bool).sum() <= one.change.astype(bool).sum()


@pytest.mark.parametrize(
    ("puddle", "rule"),
    [
        ("{name: p, place: {between: [x, y], fraction: 0.5}}", "no node of the tunnel is called x"),
        ("{name: p, place: {area: lake}}", "there are no areas"),
        ("{name: p, place: {fraction: 0.5}}", "between and fraction go together"),
        ("{name: p, depth_m: 2}", "puddles.0.depth_m = 2"),
        ("{name: p}, {name: p}", "another puddle has this name"),
    ],
)
def test_a_wrong_puddle_is_named(puddle: str, rule: str) -> None:
    with pytest.raises(ScenarioError, match=rule):
        load_scenario("smoke/unchanged", 3, [f"puddles=[{puddle}]"])


def test_the_view_shows_every_puddle_once_and_whose_it_is() -> None:
    view = view_scenario(load_scenario("smoke/unchanged", 3, with_puddles()), 3)
    sheets = {part.name: part.mesh for part in view.surfaces if part.name.startswith("puddles/")}
    assert set(sheets) == {"puddles/both", "puddles/new (after)"}
    for mesh in sheets.values():
        normals = np.cross(*(mesh.vertices[mesh.faces[:, k]] - mesh.vertices[mesh.faces[:, 0]] for k in (1, 2)))
        assert (normals[:, 2] > 0).all()  # seen from above


def test_a_ghost_beyond_the_greatest_range_hides_no_floor(sensor: SensorMetadata) -> None:
    scene, (rays, dry, _) = room(), echoes(sensor, *lake())
    crossed = dry, rays, sensor.beam_origin_m, Water(lake(), scene.caster, scene.reflectivity)
    free, other = cross_water(*crossed)
    told, rest = cross_water(*crossed, Limits(0.3, 11.0))
    is_lost = (free.geom == MIRRORED) & (free.range_m > 11.0) & (other.range_m <= 11.0)
    assert is_lost.sum() > 100
    for name in ("geom", "range_m", "photons"):
        np.testing.assert_array_equal(getattr(told, name), np.where(is_lost, getattr(other, name), getattr(free, name)))
        np.testing.assert_array_equal(getattr(rest, name), np.where(is_lost, getattr(free, name), getattr(other, name)))
