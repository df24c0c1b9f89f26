"""Retroreflectors: how bright they are, and what their stray light does to the beams around them."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from cdpipe.sensor.ouster import SensorMetadata, load_profile
from scenarios import load_scenario
from scenarios.schema import Sensor
from sim.geometry.mesh import Mesh, box_mesh
from sim.geometry.raycast import Caster
from sim.materials import REFLECTIVITY
from sim.scene import Scene
from sim.sensor import glare
from sim.sensor.footprint import Echo, central_echo
from sim.sensor.glare import GLARE, REACH_DEG, REPORTED_SHARE, STRAY_AT_1_DEG, _neighbours, add_glare
from sim.sensor.lidar import Scan, _measure, scan
from sim.sensor.optics import RETRO_FROM, reflected_share
from sim.sensor.rays import Rays, revolution_rays
from sim.session.planning import plan_drives

HALF_M = np.array([12.0, 12.0, 4.0])
RETRO = REFLECTIVITY["reflector"]
QUIET = Sensor(range_noise=False, dropouts=False, false_positives=False)


def hall(reflectivity: float) -> Scene:
    """A hall with a plate of 0.4 m that faces the sensor from 6 m."""
    box, plate = box_mesh(HALF_M), box_mesh((0.01, 0.2, 0.2))
    meshes = Mesh(box.vertices, box.faces[:, ::-1]), Mesh(plate.vertices + np.array((6.0, 0.0, 0.0)), plate.faces)
    shares = np.array([0.25, reflectivity], np.float32)
    return Scene(meshes, Caster(meshes), np.array([0, 1], np.int32), shares, ("wall", "plate"), ("rock", "reflector"))


def still(sensor: SensorMetadata) -> Rays:
    return revolution_rays(sensor, np.tile(np.eye(4), (sensor.width, 1, 1)))


def bare_echo(sensor: SensorMetadata, scene: Scene) -> Echo:
    return central_echo(scene.caster, scene.reflectivity, still(sensor), sensor.beam_origin_m, scene.instance)


def glaring(sensor: SensorMetadata, scene: Scene, draw: float) -> tuple[Echo, Echo]:
    clear = bare_echo(sensor, scene)
    draws = np.full(clear.range_m.shape, draw, np.float32)
    return clear, add_glare(clear, None, still(sensor), sensor, scene.reflectivity >= RETRO_FROM, draws)[0]


@pytest.mark.parametrize(("entrance_deg", "coefficient"), [(5, 330), (20, 290), (30, 180), (40, 65)])
def test_a_retroreflector_sends_back_what_the_standard_asks_of_its_area(
    entrance_deg: float, coefficient: float
) -> None:
    cosine = np.cos(np.deg2rad([entrance_deg])).astype(np.float32)
    share = reflected_share(np.array([0.25, RETRO], np.float32), np.array([1], np.int32), cosine)
    # of white paper: a beam of fixed width lights 1 / cosine of its width, and the coefficient is by area
    assert share == pytest.approx(np.pi * coefficient / cosine, rel=1e-3)


def test_bright_paint_is_lamberts() -> None:
    cosine = np.array([1.0, 0.5], np.float32)
    found = reflected_share(np.array([4.0], np.float32), np.zeros(2, np.int32), cosine)
    assert found == pytest.approx([4.0, 2.0])


def test_a_retroreflector_from_the_side_is_white_and_rock_is_lamberts() -> None:
    shares, cosine = np.array([0.25, RETRO], np.float32), np.array([0.4, 0.4, 0.0], np.float32)
    found = reflected_share(shares, np.array([0, 1, -1], np.int32), cosine)
    assert found == pytest.approx([0.1, 0.4, 0.0])


def test_stray_light_falls_with_the_square_of_the_angle_and_adds_up(sensor: SensorMetadata) -> None:
    scene, rays = hall(RETRO), still(sensor)
    clear, told = glaring(sensor, scene, 0.0)
    is_source = (clear.geom == 1) & (clear.photons > 0)
    assert is_source.sum() > 10
    ways = rays.directions.reshape(-1, 3).astype(np.float64)
    facing = ways @ ways[is_source.ravel()].T
    angle_deg = np.degrees(np.arccos(np.clip(facing, -1, 1)))
    reached = (angle_deg <= REACH_DEG) & (angle_deg > 0)
    light = np.where(reached, STRAY_AT_1_DEG / np.maximum(angle_deg, 1e-9) ** 2, 0.0) @ clear.photons[is_source]
    is_outshone = (light.reshape(clear.photons.shape) > clear.photons) & ~is_source
    halo = np.nonzero(told.geom == GLARE)
    assert is_outshone.sum() > 20
    np.testing.assert_array_equal(told.geom == GLARE, is_outshone)
    np.testing.assert_allclose(told.photons[halo], light.reshape(clear.photons.shape)[halo], rtol=0.02)
    # all of it seems to come from the plate's range, in the air beside it
    assert told.range_m[halo] == pytest.approx(6.0, abs=0.05)
    assert np.isinf(told.true_range_m[halo]).all()
    # no other beam changes
    np.testing.assert_array_equal(told.range_m[~is_outshone], clear.range_m[~is_outshone])
    np.testing.assert_array_equal(told.photons[~is_outshone], clear.photons[~is_outshone])


def wall_plate() -> tuple[SensorMetadata, Scene]:
    """A dense sensor before a plate of 2 m at 3 m, which some thousand beams meet."""
    box, plate = box_mesh(HALF_M), box_mesh((0.01, 1.0, 0.5))
    meshes = Mesh(box.vertices, box.faces[:, ::-1]), Mesh(plate.vertices + np.array((3.0, 0.0, 0.0)), plate.faces)
    shares = np.array([0.25, RETRO], np.float32)
    scene = Scene(meshes, Caster(meshes), np.array([0, 1], np.int32), shares, ("wall", "plate"), ("rock", "reflector"))
    return load_profile("os1-128-nominal", "1024x10"), scene


def test_the_memory_of_glare_does_not_grow_with_the_number_of_reflecting_beams() -> None:
    sensor, scene = wall_plate()
    clear, rays = bare_echo(sensor, scene), still(sensor)
    assert (clear.geom == 1).sum() > 4000
    draws = np.zeros(clear.range_m.shape, np.float32)
    tracemalloc.start()
    add_glare(clear, None, rays, sensor, scene.reflectivity >= RETRO_FROM, draws)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 40e6  # 2.5 million pairs of a source and a pixel


def test_blocks_of_sources_give_the_bytes_of_all_at_once(
    sensor: SensorMetadata, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = []
    for n_pairs in (1, 3000, 1 << 40):
        monkeypatch.setattr(glare, "_BLOCK_PAIRS", n_pairs)
        told.append(glaring(sensor, hall(RETRO), 0.0)[1])
    assert (told[0].geom == GLARE).sum() > 20
    for other in told[1:]:
        for name in ("range_m", "photons", "geom"):
            np.testing.assert_array_equal(getattr(told[0], name), getattr(other, name))


def test_most_outshone_beams_report_nothing_and_a_covered_plate_does_no_harm(sensor: SensorMetadata) -> None:
    clear, blind = glaring(sensor, hall(RETRO), REPORTED_SHARE)
    _, told = glaring(sensor, hall(RETRO), 0.0)
    is_outshone = told.geom == GLARE
    assert (blind.geom[is_outshone] == -1).all()
    assert not blind.photons[is_outshone].any()
    assert (clear.geom[is_outshone] == 0).all()
    covered, same = glaring(sensor, hall(0.5), 0.0)
    assert same is covered
    clear = bare_echo(sensor, hall(RETRO))
    draws = np.ones(clear.range_m.shape, np.float32)
    *_, second = add_glare(clear, clear, still(sensor), sensor, hall(RETRO).reflectivity >= RETRO_FROM, draws)
    assert second is not None
    assert not second.photons[is_outshone].any()


def sweep(sensor: SensorMetadata, scene: Scene, settings: Sensor) -> Scan:
    return scan(scene, sensor, settings, still(sensor), 1, "after", 0)


def test_the_switch_turns_white_plates_into_dazzling_ones(sensor: SensorMetadata) -> None:
    scene = hall(RETRO)
    off, on = sweep(sensor, scene, QUIET), sweep(sensor, scene, replace_switch(QUIET))
    white = sweep(sensor, replace(scene, reflectivity=np.array([0.25, 1.0], np.float32)), QUIET)
    for name in ("range_mm", "reflectivity", "signal", "geom", "true_range_m"):
        np.testing.assert_array_equal(getattr(off, name), getattr(white, name))
    plate = (on.geom == 1) & (off.geom == 1)
    assert (on.reflectivity[plate] > 200).all()
    assert (off.reflectivity[plate] <= 100).all()
    is_lost = (off.range_mm > 0) & (on.range_mm == 0)
    n_halo, n_lost = int((on.geom == GLARE).sum()), int(is_lost.sum())
    assert n_halo + n_lost > 20
    assert n_halo == pytest.approx(REPORTED_SHARE * (n_halo + n_lost), abs=4 * np.sqrt(n_halo + n_lost))
    assert not on.owner[on.geom == GLARE].any()


def replace_switch(settings: Sensor) -> Sensor:
    return settings.model_copy(update={"retroreflectors": True})


def test_one_ray_and_seven_glare_alike_and_the_draw_is_the_seeds(sensor: SensorMetadata) -> None:
    scene, wide = hall(RETRO), replace_switch(QUIET.model_copy(update={"sub_rays": 7}))
    one, seven = sweep(sensor, scene, replace_switch(QUIET)), sweep(sensor, scene, wide)
    lost = [int(((each.range_mm == 0) | (each.geom == GLARE)).sum()) for each in (one, seven)]
    assert lost[1] == pytest.approx(lost[0], rel=0.5)
    again = sweep(sensor, scene, wide)
    np.testing.assert_array_equal(seven.range_mm, again.range_mm)


def test_returns_of_no_geom_are_no_reflectors(sensor: SensorMetadata) -> None:
    echo = bare_echo(sensor, hall(RETRO))
    for geom in (-1, -3, -4):  # nothing, dust, a mirror image; fewer geoms than that
        other = replace(echo, geom=np.full_like(echo.geom, geom))
        draws = np.zeros(echo.range_m.shape, np.float32)
        assert add_glare(other, None, still(sensor), sensor, np.array([True]), draws)[0] is other


def test_a_family_with_markers_keeps_the_world_of_its_clean_twin() -> None:
    small = ["platform.scan_spacing_m=4", "sensor.mode=512x10"]
    glare, clean = (load_scenario(name, 10001, small) for name in ("glare/null", "unchanged/narrow"))
    assert glare.tunnel.furniture.markers is not None
    assert glare.sensor.retroreflectors
    ours, twin = (plan_drives(each, 10001)[0] for each in (glare, clean))
    markers = [number for number, part in enumerate(ours.scene.parts) if part == "markers"]
    assert len(markers) == 1
    assert ours.scene.reflectivity[markers[0]] == np.float32(RETRO)
    rest = [part for part in ours.scene.parts if part != "markers"]
    assert rest == list(twin.scene.parts)
    for name in ("wall", "stays-1"):
        mine, theirs = (each.scene.meshes[each.scene.parts.index(name)] for each in (ours, twin))
        np.testing.assert_array_equal(mine.vertices, theirs.vertices)
    np.testing.assert_array_equal(ours.trajectory.world_T_sensor, twin.trajectory.world_T_sensor)


def test_all_beams_within_reach_of_a_steep_one_are_looked_at() -> None:
    steep = load_profile("os0-128-nominal")
    rows, columns = _neighbours(steep)
    ways = still(steep).directions.astype(np.float64)
    top = int(np.argmax(np.abs(steep.altitude_deg)))
    column = 100
    facing = ways @ ways[column, top]
    lit = np.argwhere(np.degrees(np.arccos(np.clip(facing, -1, 1))) <= REACH_DEG)
    shift = np.asarray(steep.pixel_shift)
    step_row = lit[:, 1] - top
    off = (lit[:, 0] - column - shift[top] + shift[lit[:, 1]] + steep.width // 2) % steep.width - steep.width // 2
    assert len(lit) > 100
    assert set(step_row.tolist()) <= set(rows.tolist()) and set(off.tolist()) <= set(columns.tolist())


@pytest.mark.parametrize(("range_m", "step_mm", "is_return"), [(0.004, 8, False), (0.009, 8, True), (0.0004, 1, False)])
def test_a_range_that_rounds_to_none_is_no_return(
    sensor: SensorMetadata, range_m: float, step_mm: int, is_return: bool
) -> None:
    echo = bare_echo(sensor, hall(RETRO))
    echo = replace(echo, range_m=np.full_like(echo.range_m, range_m))
    found = _measure(
        echo, QUIET.model_copy(update={"min_range_m": 0.0, "range_step_mm": step_mm}), (1, "before", ""), 0
    )
    assert (found.geom[echo.geom >= 0] >= 0).all() == is_return
