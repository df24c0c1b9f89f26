"""Plots of what a mine does to the simulated sensor: mist, mirrors and retroreflectors."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from cdpipe.core.geometry import make_pose, yaw_pose
from cdpipe.sensor.ouster import load_profile
from scenarios.schema import Sensor
from sim.geometry.mesh import Mesh, box_mesh, move_mesh
from sim.geometry.raycast import Caster
from sim.materials import REFLECTIVITY
from sim.scene import Scene
from sim.sensor.air import AIR, AirVolume
from sim.sensor.glare import GLARE
from sim.sensor.glass import ABSORBED, GLASS_INDEX, Panes
from sim.sensor.lidar import scan
from sim.sensor.optics import MIRRORED, mirrored_share, reflected_share
from sim.sensor.rays import revolution_rays
from sim.sensor.water import WATER_INDEX
from sim.studies.sensor_rooms import COLOURS, IDEAL, SEED, make_room, still_scan


def draw_air(figure: Figure) -> None:
    """Draw what three densities of mist leave of the light of a wall, and the returns that they add."""
    left, right = figure.subplots(1, 2)
    sensor = load_profile("os1-32-nominal", "1024x10")
    scene = make_room((30.0, 2.5, 2.0))
    clear = still_scan(scene, sensor, IDEAL, 0)
    for visibility_m, colour in zip((12.0, 30.0, 60.0), COLOURS, strict=False):
        misty = [still_scan(scene, sensor, IDEAL, n, AirVolume(np.log(20) / visibility_m)) for n in range(4)]
        is_wall = (misty[0].geom >= 0) & (clear.signal >= 20)
        reach_m = (clear.true_range_m - sensor.beam_origin_m)[is_wall]
        left.plot(reach_m[::7], (misty[0].signal / clear.signal.clip(1))[is_wall][::7], ".", markersize=2, color=colour)
        line_m = np.linspace(0.0, 20.0, 100)
        left.plot(line_m, np.exp(-2 * np.log(20) / visibility_m * line_m), color=colour, label=f"{visibility_m:g} m")
        ranges_m = np.concatenate([each.range_mm[each.geom == AIR] / 1000.0 for each in misty])
        share = len(ranges_m) / (4 * sensor.height * sensor.width)
        label = f"{visibility_m:g} m: {100 * share:.0f} % of the beams"
        right.hist(ranges_m, bins=40, range=(0.0, 20.0), histtype="step", color=colour, label=label)
    left.set(xlabel="way to the wall (m)", ylabel="share of the photons", title="Lines: Beer-Lambert; dots: simulated")
    left.legend(fontsize=8, title="visibility", title_fontsize=8)
    right.set(xlabel="range (m)", ylabel="returns per 0.5 m", title="Returns of the mist in a 5 m drift", yscale="log")
    right.legend(fontsize=8)


def draw_mirrors(figure: Figure) -> None:
    """Draw the light that water and glass mirror, and a hall with a pane of glass as the sensor sees it."""
    left, right = figure.subplots(1, 2)
    angles_deg = np.linspace(0.0, 89.9, 300)
    cosine = np.cos(np.deg2rad(angles_deg))
    for (name, index), colour in zip({"water": WATER_INDEX, "glass": GLASS_INDEX}.items(), COLOURS, strict=False):
        left.plot(angles_deg, mirrored_share(cosine, index), color=colour, label=f"{name}, mirrored")
    passed = (1.0 - mirrored_share(cosine, GLASS_INDEX)) ** 2 * (1.0 - ABSORBED)
    left.plot(angles_deg, passed, "--", color=COLOURS[1], label="pane, let through")
    left.set(xlabel="incidence (deg)", ylabel="share of the light", title="Fresnel; each way")
    left.legend(fontsize=8)
    sensor, hall = load_profile("os1-32-nominal", "2048x10"), box_mesh((9.0, 6.0, 2.0))
    pane = move_mesh(box_mesh((2.5, 0.003, 1.5)), yaw_pose(0.2, (3.5, 1.4, 0.0)))
    meshes = Mesh(hall.vertices, hall.faces[:, ::-1]), pane
    shares, owners = np.array([0.25, 0.05], np.float32), np.array([0, 1], np.int32)
    scene = Scene(meshes, Caster(meshes), owners, shares, ("wall", "pane"), ("rock", "glass"))
    panes, both = (
        Panes(scene.caster, shares, owners, owners == 1),
        Sensor(**(IDEAL.model_dump() | {"returns": "dual"})),
    )
    rays = revolution_rays(sensor, np.tile(make_pose(), (sensor.width, 1, 1)))
    result = scan(scene, sensor, both, rays, SEED, "before", 0, panes=panes)
    points = sensor.project(result.range_mm / 1000.0)
    level = np.tile(np.abs(sensor.altitude_deg) < 1.0, 2)[:, None] & (result.range_mm > 0)
    for told, geom, colour in (("walls", 0, "grey"), ("pane", 1, COLOURS[2]), ("mirrored", MIRRORED, COLOURS[1])):
        shown = points[level & (result.geom == geom)]
        right.plot(shown[:, 0], shown[:, 1], ".", markersize=2, color=colour, label=told)
    right.set(xlabel="x (m)", ylabel="y (m)", title="A pane of 5 m, both returns", aspect="equal")
    right.legend(fontsize=7, loc="lower right", framealpha=1.0)


def draw_glare(figure: Figure) -> None:
    """Draw the light that a retroreflector sends back, and the beams around one."""
    left, right = figure.subplots(1, 2)
    angles_deg = np.linspace(0.0, 75.0, 300)
    cosine, shares = (
        np.cos(np.deg2rad(angles_deg)).astype(np.float32),
        np.array([REFLECTIVITY["reflector"]], np.float32),
    )
    left.plot(angles_deg, reflected_share(shares, np.zeros(300, np.int32), cosine), color=COLOURS[1], label="reflector")
    left.plot(angles_deg, cosine, color="grey", label="white")
    left.set(xlabel="incidence (deg)", ylabel="light, of white at right angles", title="A retroreflector", yscale="log")
    left.legend(fontsize=8)
    sensor, hall, plate = (
        load_profile("os1-32-nominal", "1024x10"),
        box_mesh((12.0, 12.0, 4.0)),
        box_mesh((0.01, 0.2, 0.2)),
    )
    meshes = Mesh(hall.vertices, hall.faces[:, ::-1]), Mesh(plate.vertices + np.array([6.0, 0.0, 0.0]), plate.faces)
    reflectivity = np.array([0.25, REFLECTIVITY["reflector"]], np.float32)
    scene = Scene(meshes, Caster(meshes), np.array([0, 1], np.int32), reflectivity, ("wall",), ("rock",))
    result = still_scan(scene, sensor, Sensor(**(IDEAL.model_dump() | {"retroreflectors": True, "sub_rays": 7})), 0)
    ways = sensor.directions
    azimuth_deg, altitude_deg = np.rad2deg(np.arctan2(ways[..., 1], ways[..., 0])), np.rad2deg(np.arcsin(ways[..., 2]))
    near = (np.abs(azimuth_deg) < 8.0) & (np.abs(altitude_deg) < 8.0)
    kinds = (("wall", 0, "grey"), ("plate", 1, COLOURS[1]), ("nothing", -1, COLOURS[0]), ("glare", GLARE, "k"))
    for told, geom, colour in kinds:
        shown = near & (result.geom == geom)
        right.plot(azimuth_deg[shown], altitude_deg[shown], ".", markersize=5, color=colour, label=told)
    right.set(xlabel="azimuth (deg)", ylabel="altitude (deg)", title="Beams around a plate at 6 m")
    right.legend(fontsize=8, loc="upper right", framealpha=1.0)
