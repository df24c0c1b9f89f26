"""One plot per effect of the simulated sensor, from its functions and from simulated revolutions.

python -m sim.studies.sensor_plots OUT

Points "of a real unit" were measured on an OS1-32 gradient unit's revolution published with the vendor's SDK (BSD-3).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from cdpipe.core.geometry import Float32Array, Float64Array, yaw_pose
from cdpipe.sensor.ouster import SensorMetadata, load_profile
from scenarios.schema import Sensor
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster
from sim.sensor.footprint import central_echo, spread_echo
from sim.sensor.lidar import FALSE_RETURN, scan
from sim.sensor.optics import (
    FALSE_RETURN_RATE,
    PHOTONS_AT_1_M,
    detection_probability,
    range_sigma_m,
    received_photons,
    reflectivity_channel,
)
from sim.sensor.rays import Rays, revolution_rays
from sim.studies.mine_plots import draw_air, draw_glare, draw_mirrors
from sim.studies.sensor_rooms import COLOURS, IDEAL, SEED, make_room, still_scan

_SHARES = (0.1, 0.25, 0.8)
# Of the real unit: sigma of facing surfaces by range (m, mm), by photons between 4 and 13 m (photons, mm), and photons
# per percent of reflectivity by range.
_REAL_SIGMA = ((3.5, 6.0, 8.0, 10.5, 14.0, 20.0, 30.0, 52.0), (4.2, 3.0, 3.3, 5.4, 7.3, 11.5, 11.5, 21.0))
_REAL_BY_LIGHT = ((9, 15, 21, 29, 44, 59, 84, 119, 197, 311), (6.7, 3.6, 3.0, 3.0, 2.4, 2.4, 3.6, 4.8, 7.3, 5.4))
_REAL_LIGHT = (
    (2.5, 2.9, 3.25, 3.75, 4.25, 4.75, 5.25, 5.75, 6.25, 7.25, 8.5, 10.5, 12.5, 14.5, 17.0, 21.0, 26.0, 36.0, 55.0),
    (2.9, 2.5, 2.38, 2.58, 3.41, 4.65, 5.17, 5.84, 7.34, 7.15, 7.95, 6.97, 6.09, 5.41, 4.28, 3.1, 2.17, 1.1, 0.45),
)


def draw_plots(out: Path) -> list[Path]:
    """Write every plot as a PNG into a folder, made where it is missing, and return the files."""
    out.mkdir(parents=True, exist_ok=True)
    files = []
    for name, draw in _PLOTS.items():
        figure = Figure(figsize=(8.0, 3.4), dpi=90, layout="constrained", facecolor="white")
        draw(figure)
        files.append(out / f"{name}.png")
        figure.savefig(files[-1], metadata={"Software": None})
    return files


def _rolling(figure: Figure) -> None:
    """Show a room driven through, raw and deskewed, and the staggered beams of three columns."""
    sensor = load_profile("os1-32-nominal", "1024x10")
    left, right = figure.subplots(1, 2)
    time_s = np.arange(sensor.width) / sensor.width / sensor.rate_hz - 0.05
    poses = np.stack([yaw_pose(np.deg2rad(60.0) * t, (5.0 * t, 0.0, 0.0)) for t in time_s])
    result = scan(make_room((5.0, 3.0, 2.0)), sensor, IDEAL, revolution_rays(sensor, poses), SEED, "before", 0)
    points = sensor.project(result.range_mm / 1000.0)
    placed = np.einsum("wij,hwj->hwi", poses[:, :3, :3], points) + poses[:, :3, 3]
    row = 16
    for cloud, colour, label in ((points, COLOURS[1], "one pose"), (placed, COLOURS[0], "a pose per column")):
        left.plot(cloud[row, :, 0], cloud[row, :, 1], ".", markersize=2, color=colour, label=label)
    left.set(xlabel="x (m)", ylabel="y (m)", title="A 10 x 6 m room at 5 m/s and 60 deg/s", aspect="equal")
    left.legend(loc="center", markerscale=5, fontsize=8)
    for place, column in enumerate((508, 512, 516)):
        way = sensor.directions[:, column]
        azimuth, altitude = np.rad2deg(np.arctan2(way[:, 1], way[:, 0])), np.rad2deg(np.arcsin(way[:, 2]))
        right.plot(azimuth, altitude, "o", markersize=3, color=COLOURS[place], label=f"column {column}")
    right.set(xlabel="azimuth (deg), counter-clockwise", ylabel="altitude (deg)", title="Beams of one time stamp each")
    right.set_xlim(-6.5, 14.0)
    right.legend(fontsize=8, loc="center right")


def _range_noise(figure: Figure) -> None:
    left, right = figure.subplots(1, 2)
    range_m = _grid(0.3, 120.0)
    level = np.ones_like(range_m)
    for share, colour in zip(_SHARES, COLOURS, strict=False):
        sigma = range_sigma_m(range_m, received_photons(share * level, range_m), level)
        left.loglog(range_m, 1000 * sigma, color=colour, label=f"{100 * share:.0f} %, squarely")
    near_m = range_m[range_m < 25.0]
    slanted: Float32Array = np.full(len(near_m), 0.26, np.float32)  # 75 degrees
    sigma = range_sigma_m(near_m, received_photons(np.float32(0.25) * slanted, near_m), slanted)
    left.loglog(near_m, 1000 * sigma, "--", color=COLOURS[1], label="25 % at 75 deg")
    left.step((0.3, 1, 20, 50, 120), (7, 7, 10, 20, 50), where="pre", color="grey", linewidth=1, label="quoted table")
    left.plot(*_REAL_SIGMA, "kx", label="real unit, facing")
    left.set(xlabel="range (m)", ylabel="sigma of the range (mm)", title="By range")
    left.set_yticks((2, 5, 10, 20, 50), ("2", "5", "10", "20", "50"))
    left.yaxis.set_minor_formatter("")
    left.legend(fontsize=7)
    light = _grid(2.0, 1000.0)
    for reach_m, colour in zip((8.0, 20.0, 50.0), COLOURS, strict=False):
        right.semilogx(light, 1000 * range_sigma_m(reach_m * level, light, level), color=colour, label=f"{reach_m:g} m")
    right.plot(*_REAL_BY_LIGHT, "kx", label="real unit, 4-13 m")
    right.set(xlabel="photons", ylabel="sigma of the range (mm)", title="By strength, squarely", ylim=(0, 33))
    right.legend(fontsize=8, loc="upper right", ncols=2)


def _detection(figure: Figure) -> None:
    axes = figure.subplots()
    sensor = load_profile("os1-32-nominal", "1024x10")
    range_m = _grid(5.0, 200.0)
    settings = Sensor(range_noise=False, false_positives=False)
    for share, colour in zip(_SHARES, COLOURS, strict=False):
        seen = detection_probability(received_photons(share * np.ones_like(range_m), range_m))
        axes.plot(range_m, 100 * seen, color=colour, label=f"{100 * share:.0f} % target, met squarely")
        walls_m = np.arange(20.0, 120.0, 10.0)
        found = [_facing_share(sensor, settings, share, wall_m) for wall_m in walls_m]
        axes.plot(walls_m, 100 * np.array(found), "o", markersize=4, color=colour)
    axes.plot([45.0, 55.0], [90.0, 50.0], "k*", markersize=12, label="data sheet, 10 %: 90 % at 45 m, 50 % at 55 m")
    axes.axvline(120.0, color="grey", linewidth=0.8, linestyle=":")
    axes.text(121.0, 5.0, "max_range_m", fontsize=8, color="grey")
    axes.set(xlabel="range (m)", ylabel="returns (%)", title="Detection; dots: simulated walls")
    axes.legend(fontsize=8)


def _incidence(figure: Figure) -> None:
    left, right = figure.subplots(1, 2)
    angle = np.linspace(0.0, 89.9, 400).astype(np.float32)
    cosine = np.cos(np.deg2rad(angle))
    for reach_m, colour in zip((3.0, 8.0, 15.0, 30.0), COLOURS, strict=True):
        seen = detection_probability(received_photons(np.float32(0.25) * cosine, np.full_like(angle, reach_m)))
        left.plot(angle, 100 * seen, color=colour, label=f"{reach_m:g} m")
    left.set(xlabel="incidence (deg)", ylabel="returns (%)", title="Rock of 25 %", xlim=(60, 90))
    left.legend(fontsize=8)
    sensor = load_profile("os1-32-nominal", "1024x10")
    settings = Sensor(range_noise=False, false_positives=False)
    for share, colour in zip((0.06, 0.25), COLOURS, strict=False):
        scene = make_room((80.0, 80.0, 0.8 - sensor.sensor_T_lidar[2, 3]), share)
        seen = np.mean([still_scan(scene, sensor, settings, n).range_mm > 0 for n in range(8)], axis=(0, 2))
        down = sensor.altitude_deg < 0
        beams_m = 0.8 / np.sin(np.deg2rad(-sensor.altitude_deg[down]))
        right.plot(beams_m, 100 * seen[down], "o", markersize=4, color=colour, label=f"{100 * share:.0f} % floor")
        line_m = _grid(2.0, 60.0)
        light = received_photons(np.asarray(np.float32(share * 0.8) / line_m, np.float32), line_m)
        right.plot(line_m, 100 * detection_probability(light), color=colour, linewidth=1)
    right.set(xlabel="range (m)", title="Floor 0.8 m below; dots: simulated", ylim=(-3, 103), xlim=(0, 30))
    right.legend(fontsize=8)


def _channels(figure: Figure) -> None:
    left, right = figure.subplots(1, 2)
    range_m = _grid(0.3, 120.0)
    for share, colour in zip(_SHARES, COLOURS, strict=False):
        light = received_photons(share * np.ones_like(range_m), range_m)
        left.loglog(range_m, light, color=colour, label=f"{100 * share:.0f} %")
    far_m = _grid(4.0, 120.0)
    left.loglog(far_m, 0.25 * PHOTONS_AT_1_M / far_m**2, ":", color="grey", label="25 %, 1/R^2 alone")
    left.plot(_REAL_LIGHT[0], 25 * np.array(_REAL_LIGHT[1]), "kx", label="real unit, as 25 %")
    left.set(xlabel="range (m)", ylabel="photons", title="Signal, met squarely", ylim=(1, 3000))
    left.legend(fontsize=7)
    bright = _grid(0.01, 100.0)
    right.semilogx(100 * bright, reflectivity_channel(bright), color=COLOURS[0])
    right.axvline(100.0, color="grey", linewidth=0.8, linestyle=":")
    right.text(125.0, 20.0, "logarithmic; of our materials\nretroreflectors alone", fontsize=8, color="grey")
    right.set(xlabel="reflectivity x cosine (%)", ylabel="reflectivity channel", title="Calibrated reflectivity")


def _divergence(figure: Figure) -> None:
    for axes, depth_m in zip(figure.subplots(1, 2), (0.4, 3.0), strict=True):
        near_m = 8.0
        meshes = [_plate(near_m, -3.0, 0.0), _plate(near_m + depth_m, -3.0, 3.0)]
        rays = _fan(np.arange(-0.09, 0.0901, 0.0003))
        seen = Caster(meshes), np.full(2, 0.25, np.float32), rays, 0.0, np.arange(2, dtype=np.int32)
        every = {1: central_echo(*seen), 19: spread_echo(*seen, 19)}
        for (count, echo), colour, size in zip(every.items(), COLOURS, (5, 2), strict=False):
            points = echo.range_m[..., None] * rays.directions
            axes.plot(points[:, 0, 1], points[:, 0, 0], ".", markersize=size, color=colour, label=f"{count} per beam")
        axes.set(xlabel="y (m)", title=f"Edge {depth_m:g} m before a wall, from above", xlim=(-0.12, 0.12))
        axes.legend(fontsize=8, title="rays", title_fontsize=8, loc="center right")
    figure.axes[0].set_ylabel("x (m); the sensor is at 0")


def _false_returns(figure: Figure) -> None:
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    sensor = load_profile("os1-32-nominal", "1024x10")
    scene, drawn = make_room((40.0, 2.5, 2.0), 0.25), []
    for number in range(40):
        result = still_scan(scene, sensor, Sensor(), number)
        points = sensor.project(result.range_mm / 1000.0)
        is_false = result.geom == FALSE_RETURN
        drawn.append(result.range_mm[is_false] / 1000.0)
        if number == 0:
            wall = points[(result.geom >= 0) & (np.abs(sensor.altitude_deg) < 4)[:, None]]
            left.plot(wall[:, 0], wall[:, 1], ".", markersize=1, color="grey", label="walls, one revolution")
        lone = points[is_false]
        left.plot(lone[:, 0], lone[:, 1], "x", markersize=4, color=COLOURS[1], label=None if number else "false")
    left.set(xlabel="x (m)", ylabel="y (m)", title="From above, false returns of 40 revolutions", aspect="equal")
    left.legend(fontsize=7, loc="lower left", framealpha=1.0)
    ranges_m = np.concatenate(drawn)
    right.hist(ranges_m, bins=12, range=(0.0, 120.0), color=COLOURS[1], edgecolor="white")
    expected = 40 * sensor.height * sensor.width * FALSE_RETURN_RATE
    right.axhline(expected * 10.0 / (Sensor().max_range_m - Sensor().min_range_m), color="k", linewidth=0.8)
    title = f"{len(ranges_m)} in 40; line: expected {expected:.0f}"
    right.set(xlabel="range (m)", ylabel="false returns per 10 m", title=title)


def _steps(figure: Figure) -> None:
    left, right = figure.subplots(1, 2)
    sensor = load_profile("os1-32-nominal", "2048x10")
    row = 15
    scene = make_room((3.0, 0.35, 1.0))
    for step_mm, colour, size in ((1, COLOURS[0], 2), (8, COLOURS[1], 5)):
        result = still_scan(scene, sensor, Sensor(**(IDEAL.model_dump() | {"range_step_mm": step_mm})), 0)
        pair = (1000 * result.true_range_m[row], result.range_mm[row])
        left.plot(*pair, ".", markersize=size, color=colour, label=f"{step_mm} mm")
    left.set(xlabel="true range (mm)", ylabel="reported range (mm)", title="Range steps", xlim=(350, 410))
    left.set_ylim(340, 410)
    left.legend(fontsize=8)
    narrow = still_scan(make_room((3.0, 0.25, 1.0)), sensor, IDEAL, 0)
    is_hit = narrow.range_mm[row] > 0
    columns = np.arange(sensor.width)
    right.plot(columns[is_hit], narrow.range_mm[row, is_hit] / 1000.0, ".", markersize=2, color=COLOURS[0])
    right.plot(columns[~is_hit], narrow.true_range_m[row, ~is_hit], ".", markersize=2, color=COLOURS[1])
    right.axhline(0.3, color="grey", linewidth=0.8, linestyle=":")
    right.text(240, 0.66, "orange: nearer\nthan 0.3 m,\na miss", fontsize=8)
    right.set(xlabel="column", ylabel="range (m)", title="Walls 0.25 m to either side", ylim=(0.2, 1.0))


def _facing_share(sensor: SensorMetadata, settings: Sensor, share: float, wall_m: float) -> float:
    """Return the share of beams within 5 degrees of the normal of a wall that have a return."""
    result = still_scan(make_room((wall_m, 150.0, 150.0), share), sensor, settings, int(wall_m))
    return float((result.range_mm > 0)[np.abs(sensor.directions[..., 0]) > np.cos(np.deg2rad(5.0))].mean())


def _plate(x_m: float, low_m: float, high_m: float) -> Mesh:
    corners = [(x_m, low_m, -2.0), (x_m, high_m, -2.0), (x_m, high_m, 2.0), (x_m, low_m, 2.0)]
    return Mesh(np.array(corners), np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def _fan(angles_rad: Float64Array) -> Rays:
    ways = np.stack([np.cos(angles_rad), np.sin(angles_rad), np.zeros_like(angles_rad)], axis=1)
    return Rays(np.zeros((len(angles_rad), 3)), ways[:, None].astype(np.float32))


def _grid(low: float, high: float) -> Float32Array:
    return np.geomspace(low, high, 400).astype(np.float32)


_PLOTS: dict[str, Callable[[Figure], None]] = {
    "rolling": _rolling,
    "range_noise": _range_noise,
    "detection": _detection,
    "incidence": _incidence,
    "channels": _channels,
    "divergence": _divergence,
    "false_returns": _false_returns,
    "steps": _steps,
    "air": draw_air,
    "mirrors": draw_mirrors,
    "glare": draw_glare,
}

if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m sim.studies.sensor_plots OUT")
    for file in draw_plots(Path(sys.argv[1])):
        sys.stdout.write(f"{file}\n")
