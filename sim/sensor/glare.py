"""Glare of retroreflectors: light that strays within the sensor reaches beams that look past the reflector.

A plate of warning sheet sends back a thousand times the light of white paper, so what strays from its beams outshines
rock beside it. Users of an OS1 report both that noise hangs about reflecting barriers (ouster-sdk issue 61) and that
the surroundings of reflecting strips are missing until these are covered (ouster-sdk issue 387). So a beam that stray
light outshines reports nothing, or, more rarely, a point at the reflector's range.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
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


@dataclass(frozen=True, slots=True, eq=False)
class _Stray:
    """Stray light in N pixels.

    Attributes:
        pixel: (N,) flat numbers of the pixels, rising, each once.
        photons: (N,) float32 what all reflectors together send there.
        range_m: (N,) float32 range of the one that sends most.
    """

    pixel: Int64Array
    photons: Float32Array
    range_m: Float32Array


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
    stray = _spread_light(echo, is_source, rays, sensor)
    is_outshone = (stray.photons > echo.photons.ravel()[stray.pixel]) & ~is_source.ravel()[stray.pixel]
    light, range_m = np.zeros_like(echo.photons), np.zeros_like(echo.range_m)
    light.flat[stray.pixel[is_outshone]] = stray.photons[is_outshone]
    range_m.flat[stray.pixel[is_outshone]] = stray.range_m[is_outshone]
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


def _spread_light(echo: Echo, is_source: BoolArray, rays: Rays, sensor: SensorMetadata) -> _Stray:
    """Return the light that strays from some pixels (W, H) to those around them."""
    source_column, source_row = np.nonzero(is_source)
    row_step, turn = _neighbours(sensor)
    height, width = sensor.height, sensor.width
    shift = np.asarray(sensor.pixel_shift)
    row = (source_row[:, None] + row_step)[:, :, None]
    is_there = (row >= 0) & (row < height)
    row = np.clip(row, 0, height - 1)
    column = (source_column[:, None, None] + shift[source_row][:, None, None] - shift[row] + turn) % width
    row, is_there = np.broadcast_arrays(row, column)[0], np.broadcast_to(is_there, column.shape)
    ways = rays.directions[column, row]
    facing = (ways * rays.directions[source_column, source_row][:, None, None]).sum(axis=-1)
    angle_deg = np.degrees(np.arccos(np.clip(facing, -1.0, 1.0)))
    is_lit = is_there & (angle_deg > 0) & (angle_deg <= REACH_DEG)
    source, *_ = np.nonzero(is_lit)
    light = echo.photons[source_column, source_row][source] * STRAY_AT_1_DEG / np.square(angle_deg[is_lit])
    pixel = column[is_lit] * height + row[is_lit]
    order = np.lexsort((light, pixel))
    last = np.flatnonzero(np.append(np.diff(pixel[order]) > 0, True))  # of each pixel, the one that gives most light
    total = np.bincount(pixel, light, echo.range_m.size)[pixel[order][last]]
    range_m = echo.range_m[source_column, source_row][source][order][last]
    return _Stray(pixel[order][last], total.astype(np.float32), range_m)


@lru_cache(maxsize=4)
def _neighbours(sensor: SensorMetadata) -> tuple[Int64Array, Int64Array]:
    """Return how many rows (R,) and columns of one direction (C,) stray light may reach."""
    step_deg = float(np.abs(np.diff(sensor.altitude_deg)).min()) if sensor.height > 1 else REACH_DEG
    # columns stand closer together on steep beams
    steepest = np.deg2rad(min(float(np.abs(sensor.altitude_deg).max()) + REACH_DEG, _STEEPEST_DEG))
    rows = int(REACH_DEG / max(step_deg, 0.1))
    columns = min(int(REACH_DEG * sensor.width / 360.0 / np.cos(steepest)) + 1, (sensor.width - 1) // 2)
    return np.arange(-rows, rows + 1), np.arange(-columns, columns + 1)
