"""Panes of glass: what is seen through them, what they mirror, and to whom it belongs."""

from __future__ import annotations

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array
from cdpipe.sensor.ouster import SensorMetadata
from scenarios.schema import Sensor
from sim.geometry.mesh import Mesh, box_mesh
from sim.geometry.raycast import Caster
from sim.scene import Scene
from sim.sensor.footprint import Echo, Limits, central_echo
from sim.sensor.glass import ABSORBED, GLASS_INDEX, Panes, cross_glass
from sim.sensor.lidar import scan
from sim.sensor.optics import MIRRORED, mirrored_share, received_photons
from sim.sensor.rays import Rays, revolution_rays

HALF_M = np.array([12.0, 8.0, 4.0])
PANE_X, THICK_M = 3.0, 0.006


def hall(*boxes: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Scene:
    """A hall with a pane, 4 m wide, across x = 3, and boxes (middle, half size) of 50 % in it."""
    walls, pane = box_mesh(HALF_M), box_mesh((THICK_M / 2, 2.0, 2.0))
    meshes = [Mesh(walls.vertices, walls.faces[:, ::-1]), Mesh(pane.vertices + np.array((PANE_X, 0, 0)), pane.faces)]
    meshes += [Mesh(box_mesh(half).vertices + np.array(middle), box_mesh(half).faces) for middle, half in boxes]
    shares = np.array([0.25, 0.05] + [0.5] * len(boxes), np.float32)
    owners = np.array([0, 1, *range(2, 2 + len(boxes))], np.int32)
    materials = ("rock", "glass", *["paint"] * len(boxes))
    return Scene(tuple(meshes), Caster(meshes), owners, shares, materials, materials)


def panes_of(scene: Scene) -> Panes:
    return Panes(scene.caster, scene.reflectivity, scene.instance, np.array(scene.materials) == "glass")


def look(sensor: SensorMetadata, scene: Scene) -> tuple[Rays, Echo, Echo, Echo]:
    rays = revolution_rays(sensor, np.tile(np.eye(4), (sensor.width, 1, 1)))
    walled = central_echo(scene.caster, scene.reflectivity, rays, sensor.beam_origin_m, scene.instance)
    return rays, walled, *cross_glass(walled, rays, sensor.beam_origin_m, panes_of(scene))


def passed(cosine: Float64Array) -> Float64Array:
    """Share of light behind both faces of a pane."""
    return np.asarray((1 - mirrored_share(cosine, GLASS_INDEX)) ** 2 * (1 - ABSORBED))


def test_the_wall_behind_a_pane_is_seen_at_its_own_range_and_dimmed_twice(sensor: SensorMetadata) -> None:
    rays, walled, seen, _ = look(sensor, hall())
    column, row = np.nonzero((walled.geom == 1) & (seen.geom == 0))
    assert len(column) > 200
    reach_m = (seen.range_m[column, row] - sensor.beam_origin_m).astype(np.float64)
    points = rays.points(row, column, reach_m)
    assert np.abs(np.abs(points) - HALF_M).min(axis=1).max() < 2e-3
    np.testing.assert_allclose(seen.true_range_m[column, row], seen.range_m[column, row])
    cosine = rays.directions[column, row, 0].astype(np.float64)
    on_end = np.abs(points[:, 0] - HALF_M[0]) < 2e-3
    assert on_end.sum() > 200
    light = received_photons((0.25 * cosine * passed(cosine) ** 2).astype(np.float32), seen.range_m[column, row])
    np.testing.assert_allclose(seen.photons[column, row][on_end], light[on_end], rtol=1e-3)
    is_other = walled.geom != 1
    np.testing.assert_array_equal(seen.range_m[is_other], walled.range_m[is_other])


def test_a_pane_mirrors_what_stands_beside_the_sensor(sensor: SensorMetadata) -> None:
    # nothing comes back from behind: the pane hides a black hole; the mirror shows the hall behind the sensor
    scene = hall()
    dark = Scene(
        scene.meshes, scene.caster, scene.instance, np.array([0.25, 0.0], np.float32), scene.parts, scene.materials
    )
    rays, walled, first, second = look(sensor, dark)
    both = np.stack([first.geom, second.geom])
    assert ((both == 0).any(axis=0) & (both == MIRRORED).any(axis=0)).sum() > 200
    column, row = np.nonzero((walled.geom == 1) & (second.geom == MIRRORED))
    reach_m = (second.range_m[column, row] - sensor.beam_origin_m).astype(np.float64)
    points = rays.points(row, column, reach_m)
    front_m = PANE_X - THICK_M / 2
    mirrored = points * (-1, 1, 1) + (2 * front_m, 0, 0)
    assert np.abs(np.abs(mirrored) - HALF_M).min(axis=1).max() < 3e-3
    assert (points[:, 0] > front_m).all()
    cosine = rays.directions[column, row, 0].astype(np.float64)
    on_end = np.abs(mirrored[:, 0] + HALF_M[0]) < 3e-3
    assert on_end.sum() > 100
    power = (0.25 * cosine * mirrored_share(cosine, GLASS_INDEX) ** 2).astype(np.float32)
    light = received_photons(power, second.range_m[column, row])
    np.testing.assert_allclose(second.photons[column, row][on_end], light[on_end], rtol=1e-3)


def test_a_thing_behind_glass_is_itself_and_the_switch_makes_glass_a_wall(sensor: SensorMetadata) -> None:
    scene = hall(((6.0, 0.0, 0.0), (0.5, 0.8, 0.8)))
    rays, *_ = look(sensor, scene)
    quiet = Sensor(false_positives=False, glass=True)
    seen = scan(scene, sensor, quiet, rays, 1, "after", 0, panes=panes_of(scene))
    wall = scan(scene, sensor, quiet, rays, 1, "after", 0)
    is_box = (seen.geom == 2) & (seen.range_mm > 0)
    assert is_box.sum() > 100
    assert (seen.owner[is_box] == 2).all()
    assert (wall.geom[is_box] == 1).mean() > 0.9
    assert seen.range_mm[is_box] == pytest.approx(5500 / rays.directions[..., 0].T[is_box], abs=80)
    both = scan(scene, sensor, quiet.model_copy(update={"returns": "dual"}), rays, 1, "after", 0, panes=panes_of(scene))
    n_second = (both.range_mm[sensor.height :] > 0).sum()
    assert n_second > 100


def test_what_stands_behind_a_pane_beyond_the_greatest_range_hides_no_dust_on_it(sensor: SensorMetadata) -> None:
    rays, walled, free, _ = look(sensor, hall())
    panes = panes_of(hall())
    told, rest = cross_glass(walled, rays, sensor.beam_origin_m, panes, Limits(0.3, 5.0))
    is_lost = (walled.geom == 1) & (walled.range_m <= 5.0) & (free.geom == 0) & (free.range_m > 5.0)
    assert is_lost.sum() > 100
    for name in ("geom", "range_m", "photons"):
        is_wall = is_lost & (told.geom == 1)
        np.testing.assert_array_equal(getattr(told, name)[is_wall], getattr(walled, name)[is_wall])
    assert ((told.range_m <= 5.0) & (told.geom != 0))[is_lost].all()
    assert (rest.geom[is_lost] == 0).mean() > 0.9  # the stronger one is the second
