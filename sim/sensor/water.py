"""Standing water: a mirror that most of the light passes. The floor below it gets weak, and a ghost lies under it.

Of a beam that meets the water at angle of incidence i, the share R(i) is mirrored (Fresnel, both polarisations alike)
and 1 - R(i) is refracted. What the floor under the water sends back has passed the surface twice and the water twice.
What the mirrored beam meets sends light back the same way: it is reported in the direction of the beam, as far behind
the surface as it is away from it. The stronger of the two echoes is reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import Float32Array
from sim.geometry.raycast import Caster
from sim.placement.puddles import Pool
from sim.sensor.footprint import Echo
from sim.sensor.optics import received_photons
from sim.sensor.rays import Rays

MIRRORED = -4  # number of the geom of a return by way of water
# Refractive index of water, near infrared.
WATER_INDEX = 1.33
# Absorption of pure water at 865 nm, 1/m: Kou, Labrie and Chylek 1993, cited from memory. Mud is not modelled.
WATER_ABSORPTION_PER_M = 4.6
_OFF_SURFACE_M = 1e-3
_T = TypeVar("_T", np.float32, np.int32)


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


def mirrored_share(cosine: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Return the share of unpolarised light that water mirrors, by the cosine of the incidence (Fresnel)."""
    refracted = np.sqrt(1.0 - (1.0 - cosine * cosine) / WATER_INDEX**2)
    across = (cosine - WATER_INDEX * refracted) / (cosine + WATER_INDEX * refracted)
    along = (WATER_INDEX * cosine - refracted) / (WATER_INDEX * cosine + refracted)
    return np.asarray((across * across + along * along) / 2)


def cross_water(echo: Echo, rays: Rays, beam_origin_m: float, water: Water) -> Echo:
    """Return the echo of a revolution where the middles of its beams meet water before anything else.

    Args:
        echo: The echo as if there were no water.
        rays: The revolution's rays.
        beam_origin_m: Distance of their origins from the spin axis.
        water: The pools, and what they mirror.
    """
    shape, height = echo.range_m.shape, rays.directions.shape[1]
    ways = rays.directions.reshape(-1, 3)
    reach_m = np.where(echo.geom >= 0, echo.range_m - np.float32(beam_origin_m), np.float32(np.inf)).ravel()
    surface_m = _meet(rays, reach_m, water.pools)
    wet = np.flatnonzero(surface_m < reach_m)
    if not len(wet):
        return echo
    way, start_m = ways[wet].astype(np.float64), surface_m[wet].astype(np.float64)
    cosine = np.abs(way[:, 2])
    share = mirrored_share(cosine)
    # through the water to the floor and back
    depth_m = np.where(np.isfinite(reach_m[wet]), reach_m[wet] - start_m, 0.0) * cosine
    path_m = depth_m / np.sqrt(1.0 - (1.0 - cosine**2) / WATER_INDEX**2)
    passed = (1.0 - share) ** 2 * np.exp(-2.0 * WATER_ABSORPTION_PER_M * path_m)
    floor_m = start_m + WATER_INDEX * path_m + beam_origin_m
    floor_light = echo.photons.ravel()[wet] * passed
    # by way of the surface to what it mirrors and back
    points = rays.origins[wet // height] + start_m[:, None] * way
    points[:, 2] += _OFF_SURFACE_M
    mirrored_m, geom, facing = water.caster.cast(points, way * (1.0, 1.0, -1.0))
    is_met = geom >= 0
    total_m = np.where(is_met, start_m + np.where(is_met, mirrored_m, 0.0) + beam_origin_m, 0.0).astype(np.float32)
    power = np.where(is_met, water.reflectivity[geom] * facing * share**2, 0.0).astype(np.float32)
    mirror_light = np.where(is_met, received_photons(power, np.maximum(total_m, np.float32(1e-3))), 0.0)
    is_mirrored = mirror_light > floor_light

    def with_wet(channel: npt.NDArray[_T], mirrored: npt.ArrayLike, floor: npt.ArrayLike) -> npt.NDArray[_T]:
        flat = channel.ravel().copy()
        flat[wet] = np.where(is_mirrored, mirrored, floor)
        return flat.reshape(shape)

    is_floor = echo.geom.ravel()[wet] >= 0
    return replace(
        echo,
        range_m=with_wet(echo.range_m, total_m, np.where(is_floor, floor_m, 0.0)),
        photons=with_wet(echo.photons, mirror_light, floor_light),
        cosine=with_wet(echo.cosine, facing, echo.cosine.ravel()[wet]),
        true_range_m=with_wet(echo.true_range_m, np.inf, echo.true_range_m.ravel()[wet]),
        geom=with_wet(echo.geom, MIRRORED, echo.geom.ravel()[wet]),
    )


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
        inside = may[(off * off).sum(axis=1) <= pool.radius_m**2]
        surface_m[inside] = level_m.ravel()[inside]
    return surface_m
