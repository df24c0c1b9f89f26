"""Standing water: a mirror that most of the light passes. The floor below it gets weak, and a ghost lies under it.

Of a beam that meets the water at angle of incidence i, the share R(i) is mirrored (Fresnel, both polarisations alike)
and 1 - R(i) is refracted. What the floor under the water sends back has passed the surface twice and the water twice.
What the mirrored beam meets sends light back the same way: it is reported in the direction of the beam, as far behind
the surface as it is away from it. The stronger of the two echoes is reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cdpipe.core.geometry import Float32Array, Float64Array, Int64Array
from sim.geometry.raycast import Caster
from sim.placement.puddles import Pool
from sim.sensor.footprint import EVERYWHERE, Echo, Limits, choose_echo, no_echo, outweighs, replace_pixels
from sim.sensor.optics import MIRRORED, mirrored_share, received_photons
from sim.sensor.rays import Rays

# Refractive index of water, near infrared.
WATER_INDEX = 1.33
# Absorption of pure water at 865 nm, 1/m: Kou, Labrie and Chylek 1993, cited from memory. Mud is not modelled.
WATER_ABSORPTION_PER_M = 4.6
_OFF_SURFACE_M = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Water:
    """The pools of a session, and the fixed scene that they mirror; movers are not mirrored.

    Attributes:
        pools: The pools.
        caster: Caster of the fixed scene.
        reflectivity: (G,) share of the light that each of its geoms reflects.
    """

    pools: Sequence[Pool]
    caster: Caster
    reflectivity: Float32Array


def cross_water(
    echo: Echo, rays: Rays, beam_origin_m: float, water: Water, limits: Limits = EVERYWHERE
) -> tuple[Echo, Echo]:
    """Return the stronger and the weaker echo of a revolution where beams meet water before anything else.

    Args:
        echo: The echo as if there were no water.
        rays: The revolution's rays; the middle of a beam decides for the whole beam.
        beam_origin_m: Distance of their origins from the spin axis.
        water: The pools, and what they mirror.
        limits: The ranges at which the receiver listens.

    Returns:
        The stronger echo; and the other one of the beams that meet water, nothing for all other beams.
    """
    wet, start_m = _find_wet(echo, rays, beam_origin_m, water)
    if not len(wet):
        return echo, no_echo(echo)
    way = rays.directions.reshape(-1, 3)[wet].astype(np.float64)
    floor = _look_down(echo, wet, start_m, np.abs(way[:, 2]), beam_origin_m)
    # by way of the surface to what it mirrors and back
    share = mirrored_share(np.abs(way[:, 2]), WATER_INDEX)
    points = rays.origins[wet // rays.directions.shape[1]] + start_m[:, None] * way
    points[:, 2] += _OFF_SURFACE_M
    beyond_m, geom, facing = water.caster.cast(points, way * (1.0, 1.0, -1.0))
    is_met = geom >= 0
    total_m = np.where(is_met, start_m + np.where(is_met, beyond_m, 0.0) + beam_origin_m, 0.0).astype(np.float32)
    power = np.where(is_met, water.reflectivity[geom] * facing * share**2, 0.0).astype(np.float32)
    light = np.where(is_met, received_photons(power, np.maximum(total_m, np.float32(beam_origin_m))), 0.0)
    ghost = replace_pixels(
        no_echo(echo), wet, range_m=total_m, photons=light, cosine=facing, geom=np.where(is_met, MIRRORED, -1)
    )
    is_ghost = outweighs(ghost, floor, limits)
    is_wet = np.zeros(echo.range_m.size, dtype=np.bool_)
    is_wet[wet] = True
    other = choose_echo(is_ghost, floor, ghost)
    return choose_echo(is_ghost, ghost, floor), choose_echo(is_wet.reshape(is_ghost.shape), other, no_echo(echo))


def look_through_water(echo: Echo, rays: Rays, beam_origin_m: float, water: Water) -> Echo:
    """Return an echo as it comes through the water that its beams meet before it. Arguments as of `cross_water`."""
    wet, start_m = _find_wet(echo, rays, beam_origin_m, water)
    cosine = np.abs(rays.directions.reshape(-1, 3)[wet, 2].astype(np.float64))
    return _look_down(echo, wet, start_m, cosine, beam_origin_m) if len(wet) else echo


def _find_wet(echo: Echo, rays: Rays, beam_origin_m: float, water: Water) -> tuple[Int64Array, Float64Array]:
    """Return the flat numbers (M,) of the beams that meet water before their echo, and the distance (M,) to it."""
    reach_m = np.where(echo.geom >= 0, echo.range_m - np.float32(beam_origin_m), np.float32(np.inf)).ravel()
    surface_m = _meet(rays, reach_m, water.pools)
    wet = np.flatnonzero(surface_m < reach_m)
    return wet, surface_m[wet].astype(np.float64)


def _look_down(echo: Echo, wet: Int64Array, start_m: Float64Array, cosine: Float64Array, beam_origin_m: float) -> Echo:
    """Return the echo of what lies under the water of (M,) beams, which is weaker and seems farther away.

    Args:
        echo: The echo as if there were no water.
        wet: Flat numbers of the beams.
        start_m: (M,) distance to the surface.
        cosine: (M,) of the incidence on it.
        beam_origin_m: Distance of the rays' origins from the spin axis.
    """
    is_floor = echo.geom.ravel()[wet] >= 0
    reach_m = echo.range_m.ravel()[wet].astype(np.float64) - beam_origin_m
    depth_m = np.where(is_floor, reach_m - start_m, 0.0) * cosine
    path_m = depth_m / np.sqrt(1.0 - (1.0 - cosine**2) / WATER_INDEX**2)
    # light that leaves the water spreads over n^2 times the solid angle
    passed = ((1.0 - mirrored_share(cosine, WATER_INDEX)) / WATER_INDEX) ** 2
    passed *= np.exp(-2.0 * WATER_ABSORPTION_PER_M * path_m)
    seems_m = np.where(is_floor, start_m + WATER_INDEX * path_m + beam_origin_m, 0.0)
    return replace_pixels(echo, wet, range_m=seems_m, photons=echo.photons.ravel()[wet] * passed)


def _meet(rays: Rays, reach_m: Float32Array, pools: Sequence[Pool]) -> Float32Array:
    """Return the distance (N,) at which each ray meets water, from above; infinite where it meets none."""
    height = rays.directions.shape[1]
    surface_m = np.full(len(reach_m), np.inf, np.float32)
    slope = rays.directions[..., 2]
    for pool in pools:
        towards = pool.centre - rays.origins
        with np.errstate(divide="ignore"):
            level_m = (towards[:, 2, None] / slope).astype(np.float32)
        may = np.flatnonzero((slope < 0).ravel() & (level_m.ravel() > 0) & (level_m.ravel() < surface_m))
        column = may // height
        off = rays.directions.reshape(-1, 3)[may, :2] * level_m.ravel()[may, None] - towards[column, :2]
        inside = may[(off * off).sum(axis=1) <= pool.puddle.radius_m**2]
        surface_m[inside] = level_m.ravel()[inside]
    return surface_m
