"""Sources of the comparison: the real revolution, a scene rebuilt from it, and simulated revolutions of a world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import BoolArray, Float64Array, transform
from cdpipe.io.ouster.captures import open_recording
from cdpipe.sensor.ouster import SensorMetadata
from eval.studies.reality.sensor_measures import Revolutions, destagger
from scenarios.library import load_scenario
from scenarios.schema import Sensor
from sim.drive.trajectory import record
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster
from sim.scene import Scene
from sim.sensor.lidar import Scan, scan
from sim.sensor.optics import COUNTS_PER_DOUBLING
from sim.sensor.rays import revolution_rays
from sim.session.planning import plan_drives
from sim.session.revolution import Drive

RECORDING = "OS-1-32-G_v2.1.1_1024x10"


def find_recording(folder: Path | None, name: str = RECORDING) -> Path:
    """Return the path of a real revolution's PCAP below a folder, its metadata beside it.

    Raises:
        InputError: No folder is given, or it does not hold the two files.
    """
    wanted = f"{name}.pcap and {name}.json (both from the vendor's SDK repository, BSD-3)"
    if folder is None:
        raise InputError(f"no real recording: give --data or set TUNNELCD_REAL_DATA to a folder with {wanted}")
    for path in (folder / f"{name}.pcap", folder / "ouster" / f"{name}.pcap"):
        if path.is_file() and path.with_suffix(".json").is_file():
            return path
    raise InputError(f"{folder}: no real recording in it: expected {wanted}, there or in its folder ouster")


def read_real_revolution(pcap: Path) -> Revolutions:
    """Read the first revolution of a capture, destaggered.

    Raises:
        InputError: The extra `ouster` is not installed, or the capture is damaged or holds no whole revolution.
    """
    recording = open_recording(pcap)
    first = next(recording.revolutions())
    images = [destagger(recording.sensor, each)[None] for each in (first.range_mm, first.signal, first.reflectivity)]
    return Revolutions(recording.sensor, images[0] / 1000.0, images[1], images[2])


def plan_drive(family: str, seed: int, sensor: SensorMetadata, profile: str) -> Drive:
    """Build the world of a family's seed and plan its before session with a sensor.

    Raises:
        ScenarioError: The world cannot be built.
    """
    settings = [f"sensor.profile={profile}", f"sensor.mode={sensor.mode}"]
    return plan_drives(load_scenario(family, seed, settings), seed, sensor)[0]


def change_effects(drive: Drive, settings: Sensor) -> Drive:
    """Return the same drive recorded with other effects: where the scan does not roll, its columns have one pose."""
    scenario = drive.scenario.model_copy(update={"sensor": settings})
    trajectory = record(drive.trajectory.true, scenario, drive.sensor, drive.seed, drive.name)
    return replace(drive, scenario=scenario, trajectory=trajectory)


def stop_drive(drive: Drive, number: int, n_revolutions: int) -> Drive:
    """Return revolutions all recorded where a drive recorded the middle column of one, the sensor standing still."""
    still = replace(
        drive.trajectory,
        revolution_s=np.full(n_revolutions, drive.trajectory.revolution_s[number]),
        column_s=np.zeros(drive.sensor.width),
    )
    return replace(drive, trajectory=still)


def cast_at_origin(scene: Scene, sensor: SensorMetadata, settings: Sensor, number: int) -> Scan:
    """Return a revolution of a sensor that stands still at the origin of a scene."""
    poses = np.broadcast_to(np.eye(4), (sensor.width, 4, 4))
    return scan(scene, sensor, settings, revolution_rays(sensor, poses), 0, "before", number)


def gather_revolutions(sensor: SensorMetadata, scans: Sequence[Scan]) -> Revolutions:
    """Return simulated revolutions, destaggered."""
    ranges_mm, signal, reflectivity = (
        destagger(sensor, np.stack([getattr(each, name) for each in scans]))
        for name in ("range_mm", "signal", "reflectivity")
    )
    return Revolutions(sensor, ranges_mm / 1000.0, signal, reflectivity)


def find_world_points(sensor: SensorMetadata, result: Scan, poses: Float64Array) -> Float64Array:
    """Return the reported points (N, 3) of a revolution, world frame, each column at its true pose."""
    points = sensor.project(result.range_mm / 1000.0).swapaxes(0, 1)
    turned = points @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
    return np.asarray(turned[result.range_mm.T > 0])


_N_LEVELS = 96
_LEVELS = np.geomspace(0.002, 200.0, _N_LEVELS)  # steps of reflectivity in a rebuilt scene
_ROW_RATIO, _COLUMN_RATIO = 1.3, 1.03  # of ranges: neighbouring pixels of one surface
_HOLE = 2  # columns
_SMOOTHING = np.array([-2.0, 3.0, 6.0, 7.0, 6.0, 3.0, -2.0]) / 21.0  # Savitzky-Golay, parabola through seven
# The tip of a patch's triangles, in half steps from its middle: off the beam, which must meet a face and no corner.
_TIP_ROW, _TIP_COLUMN = 0.15, 0.2


def rebuild(real: Revolutions, template: Scene) -> tuple[Scene, BoolArray]:
    """Make a surface from the first revolution, with the noise of the sensor removed.

    Each pixel becomes a flat patch that reaches half way to its neighbours and is inclined towards those of similar
    range; beams of the same table meet it at the recorded range. A parabola through seven columns removes the noise
    along the beam where the surface is smooth. Holes of one or two columns between returns of similar range are closed,
    because a surface is there. Reflectivity is the recorded channel over the patch's cosine of incidence, in 96 steps.

    Args:
        real: The recording, in the sensor frame.
        template: Any scene: only its caster, instances and reflectivities are replaced.

    Returns:
        The scene, with one patch for each pixel, as wide as the pixel; the (H, W) destaggered mask of the pixels that
        have one: every return, and holes of one or two columns between returns that agree.
    """
    filled_m, share, is_surface = _close_holes(real)
    inverse = np.where(is_surface, 1.0 / np.where(is_surface, filled_m, 1.0), 0.0)
    vertices = _make_vertices(real.sensor, inverse)
    cosine = _compute_patch_cosine(vertices)
    reflectivity = np.clip(share / np.maximum(cosine, 0.05), _LEVELS[0], _LEVELS[-1])
    level = np.searchsorted(_LEVELS, reflectivity[is_surface] * (_LEVELS[0] / _LEVELS[1]) ** 0.5)
    patches = vertices[is_surface]
    levels = np.unique(level)
    caster = Caster(_make_patch_mesh(patches[level == each]) for each in levels)
    scene = replace(
        template,
        caster=caster,
        instance=np.zeros(len(levels), np.int32),
        reflectivity=_LEVELS[np.minimum(levels, _N_LEVELS - 1)].astype(np.float32),
    )
    return scene, is_surface


def _close_holes(real: Revolutions) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Return ranges, apparent reflectivities and mask (H, W), with small holes closed and noise removed."""
    range_m, counts = real.range_m[0].copy(), np.maximum(real.reflectivity[0], 0.5)
    share = np.where(counts > 100, 2.0 ** ((counts - 100.0) / COUNTS_PER_DOUBLING), counts / 100.0)
    smooth_m = sum(weight * np.roll(range_m, place - 3, -1) for place, weight in enumerate(_SMOOTHING))
    window = np.stack([np.roll(range_m, shift, -1) for shift in range(-3, 4)])
    is_flat = (window > 0).all(axis=0) & (np.ptp(window, axis=0) < 0.03 * range_m)
    range_m = np.where(is_flat, smooth_m, range_m)
    is_surface = range_m > 0
    known_m, known_share = range_m.copy(), share.copy()
    for width in range(1, _HOLE + 1):
        for place in range(width):
            before, after = place + 1, width - place
            left_m, right_m = np.roll(known_m, before, -1), np.roll(known_m, -after, -1)
            is_hole = (range_m == 0) & (left_m > 0) & (right_m > 0)
            is_hole &= np.abs(left_m - right_m) < (_COLUMN_RATIO - 1.0) * left_m
            part = before / (before + after)
            range_m = np.where(is_hole, (1.0 - part) * left_m + part * right_m, range_m)
            left, right = np.roll(known_share, before, -1), np.roll(known_share, -after, -1)
            share = np.where(is_hole, left ** (1.0 - part) * right**part, share)
            is_surface |= is_hole
    return range_m, share, is_surface


def _compute_slopes(inverse: Float64Array, axis: int, ratio: float) -> Float64Array:
    """Return how much a patch's inverse range (H, W) grows over half a step down (axis 0) or on (axis 1).

    The mean of the slopes to the two neighbours, as far as they are the same surface. Inverse range is linear in the
    image of a plane.
    """
    back, ahead = np.roll(inverse, 1, axis), np.roll(inverse, -1, axis)
    if axis == 0:
        back[0] = ahead[-1] = 0.0
    has_back, has_ahead = (
        (each > 0) & (np.maximum(each, inverse) < ratio * np.minimum(each, inverse)) for each in (back, ahead)
    )
    total = np.where(has_back, inverse - back, 0.0) + np.where(has_ahead, ahead - inverse, 0.0)
    return np.asarray(total / (2.0 * np.maximum(has_back + 0.0 + has_ahead, 1.0)))


def _make_vertices(sensor: SensorMetadata, inverse: Float64Array) -> Float64Array:
    """Return the tip and the four corners of each patch's triangles (H, W, 5, 3), sensor frame, metres."""
    altitude = np.deg2rad(sensor.altitude_deg)
    padded = np.concatenate([[2 * altitude[0] - altitude[1]], altitude, [2 * altitude[-1] - altitude[-2]]])
    halves = (padded[:-1] + padded[1:])[:, None] / 2.0
    above, below = halves[:-1] - altitude[:, None], halves[1:] - altitude[:, None]
    shift = np.asarray(sensor.pixel_shift)[:, None]
    measurement = (np.arange(sensor.width, dtype=np.float64)[None, :] - shift) % sensor.width
    per_row, per_column = _compute_slopes(inverse, 0, _ROW_RATIO), _compute_slopes(inverse, 1, _COLUMN_RATIO)
    rise = 2.0 * per_row / (below - above)  # per radian, both halves of a patch alike
    places = [(_TIP_ROW * below, _TIP_COLUMN), *((edge, side) for edge in (above, below) for side in (-1.0, 1.0))]
    ends = []
    for turn, side in places:
        at = np.maximum(inverse + turn * rise + side * per_column, inverse / 2.0)
        ends.append(_find_ray_ends(sensor, measurement + 0.5 * side, altitude[:, None] + turn, at))
    return np.stack(ends, axis=2)


def _find_ray_ends(
    sensor: SensorMetadata, measurement: Float64Array, altitude: Float64Array, inverse: Float64Array
) -> Float64Array:
    """Return the points (H, W, 3) at some inverse ranges along beams of any altitude at any part of a column."""
    encoder = 2.0 * np.pi * (1.0 - measurement / sensor.width)
    azimuth = encoder - np.deg2rad(sensor.azimuth_deg)[:, None]
    reach_m = 1.0 / np.where(inverse > 0, inverse, 1.0) - sensor.beam_origin_m
    offset_m = sensor.beam_origin_m
    in_lidar = np.stack(
        [
            offset_m * np.cos(encoder) + reach_m * np.cos(azimuth) * np.cos(altitude),
            offset_m * np.sin(encoder) + reach_m * np.sin(azimuth) * np.cos(altitude),
            reach_m * np.sin(altitude),
        ],
        axis=-1,
    )
    return transform(sensor.sensor_T_lidar, in_lidar)


def _compute_patch_cosine(vertices: Float64Array) -> Float64Array:
    """Return the cosine of incidence (H, W) on each patch, from its diagonals."""
    normal = np.cross(vertices[:, :, 4] - vertices[:, :, 1], vertices[:, :, 3] - vertices[:, :, 2])
    tip = vertices[:, :, 0]
    size = np.linalg.norm(normal, axis=-1) * np.linalg.norm(tip, axis=-1)
    return np.asarray(np.abs((normal * tip).sum(axis=-1)) / np.maximum(size, 1e-12))


def _make_patch_mesh(patches: Float64Array) -> Mesh:
    """Return the patches (N, 5, 3) as one mesh of four triangles each, round the tip."""
    fan = np.array([[0, 1, 2], [0, 2, 4], [0, 4, 3], [0, 3, 1]])
    faces = (5 * np.arange(len(patches))[:, None, None] + fan).reshape(-1, 3)
    return Mesh(patches.reshape(-1, 3), faces.astype(np.int32))
