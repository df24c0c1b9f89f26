"""Glare of retroreflectors: light that strays within the sensor reaches beams that look past the reflector.

A plate of warning sheet sends back a thousand times the light of white paper, so what strays from its beams outshines
rock beside it. Users of an OS1 report both that noise hangs about reflecting barriers (ouster-sdk issue 61) and that
the surroundings of reflecting strips are missing until these are covered (ouster-sdk issue 387). So a beam that stray
light outshines reports nothing, or, more rarely, a point at the reflector's range.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from cdpipe.core.geometry import BoolArray, Float32Array, Int64Array
from cdpipe.sensor.ouster import SensorMetadata
from sim.sensor.footprint import Echo, choose_echo, no_echo
from sim.sensor.rays import Rays

GLARE = -5  # number of the geom of a return from stray light
# Share of a reflector's light that reaches a beam 1 deg off, falling with the square of the angle, and how far it is
# followed. Ours, unverified: no figure for this sensor was found; so chosen that a plate of 0.4 m at 6 m blinds what is
# less than its own size beside it.
STRAY_AT_1_DEG, REACH_DEG = 3e-4, 4.0
_STEEPEST_DEG = 85.0
# Of the beams that stray light outshines, how many report it; the vendor's firmware suppresses most of it since 1.12
# (ouster-sdk issue 61). Ours, unverified.
REPORTED_SHARE = 0.2
_BLOCK_PAIRS = 1 << 17  # of a source and a pixel that are looked at together


def add_glare(
    echo: Echo, second: Echo | None, rays: Rays, sensor: SensorMetadata, is_reflector: BoolArray, draw: Float32Array
) -> tuple[Echo, Echo | None]:
    """Return the first and the second echo of a revolution with the glare of the retroreflectors that it meets.

    Args:
        echo: The echo as if no light strayed.
        second: The second one, None where the sensor has one return.
        rays: The revolution's rays.
        sensor: Its beam table, whose rows lie one below the other.
        is_reflector: (G,) whether each geom is a retroreflector.
        draw: (W, H) uniform numbers that decide which outshone beams report something.
    """
    is_source = (echo.geom >= 0) & is_reflector[np.maximum(echo.geom, 0)] & (echo.photons > 0)
    if not is_source.any():
        return echo, second
    stray, range_m = _spread_light(echo, is_source, rays, sensor)
    light = np.where((stray > echo.photons) & ~is_source, stray, np.float32(0.0))
    is_told = (light > 0) & (draw < REPORTED_SHARE)
    halo = replace(
        no_echo(echo),
        range_m=np.where(is_told, range_m, np.float32(0.0)),
        photons=np.where(is_told, light, np.float32(0.0)),
        cosine=is_told.astype(np.float32),
        geom=np.where(is_told, np.int32(GLARE), np.int32(-1)),
    )
    return (
        choose_echo(light > 0, halo, echo),
        None if second is None else choose_echo(light > 0, no_echo(second), second),
    )


def _spread_light(
    echo: Echo, is_source: BoolArray, rays: Rays, sensor: SensorMetadata
) -> tuple[Float32Array, Float32Array]:
    """Return the light that strays from some pixels (W, H) to all others, and the range of the one that sends most.

    Both (W, H); sources are taken in blocks, so that memory does not grow with their number.
    """
    sources = np.flatnonzero(is_source)
    row_step, turn = _neighbours(sensor)
    total, most, range_m = np.zeros(is_source.size), *np.zeros((2, is_source.size), np.float32)
    n_block = max(_BLOCK_PAIRS // (len(row_step) * len(turn)), 1)
    for first in range(0, len(sources), n_block):
        source, pixel, angle_deg = _find_lit(sources[first : first + n_block], is_source, rays, sensor)
        light = echo.photons.ravel()[source] * STRAY_AT_1_DEG / np.square(angle_deg)
        np.add.at(total, pixel, light.astype(np.float64))
        np.maximum.at(most, pixel, light)
        is_most = light == most[pixel]  # of equal ones the last
        range_m[pixel[is_most]] = echo.range_m.ravel()[source[is_most]]
    return total.astype(np.float32).reshape(is_source.shape), range_m.reshape(is_source.shape)


def _find_lit(
    sources: Int64Array, is_source: BoolArray, rays: Rays, sensor: SensorMetadata
) -> tuple[Int64Array, Int64Array, Float32Array]:
    """Return the pairs of a source and a pixel that its stray light reaches.

    Args:
        sources: (N,) flat numbers of pixels that send light.
        is_source: (W, H) all pixels that do: they look at a reflector, so stray light is lost on them.
        rays: The revolution's rays.
        sensor: Its beam table.

    Returns:
        (P,) flat numbers of the sources, in their order; (P,) of the pixels; (P,) float32 angles between them, degrees.
    """
    height, width = sensor.height, sensor.width
    row_step, turn = _neighbours(sensor)
    shift = np.asarray(sensor.pixel_shift)
    source_column, source_row = np.divmod(sources, height)
    row = source_row[:, None] + row_step
    one, step = np.nonzero((row >= 0) & (row < height))
    row = row[one, step]
    column = ((source_column + shift[source_row])[one, None] - shift[row][:, None] + turn) % width
    pixel = column * height + row[:, None]
    is_rock = ~is_source.ravel()[pixel]
    source, pixel = sources[one[np.nonzero(is_rock)[0]]], pixel[is_rock]
    ways = rays.directions.reshape(-1, 3)
    facing = (ways[pixel] * ways[source]).sum(axis=-1)
    angle_deg = np.degrees(np.arccos(np.clip(facing, -1.0, 1.0)))
    is_lit = (angle_deg > 0) & (angle_deg <= REACH_DEG)
    return source[is_lit], pixel[is_lit], angle_deg[is_lit]


@lru_cache(maxsize=4)
def _neighbours(sensor: SensorMetadata) -> tuple[Int64Array, Int64Array]:
    """Return how many rows (R,) and columns of one direction (C,) stray light may reach."""
    step_deg = float(np.abs(np.diff(sensor.altitude_deg)).min()) if sensor.height > 1 else REACH_DEG
    # columns stand closer together on steep beams
    steepest = np.deg2rad(min(float(np.abs(sensor.altitude_deg).max()) + REACH_DEG, _STEEPEST_DEG))
    rows = int(REACH_DEG / max(step_deg, 0.1))
    columns = min(int(REACH_DEG * sensor.width / 360.0 / np.cos(steepest)) + 1, (sensor.width - 1) // 2)
    return np.arange(-rows, rows + 1), np.arange(-columns, columns + 1)
