"""The sensor: the echoes of a revolution's beams, then range noise, dropouts, range steps and false returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import BoolArray, Float32Array, Int32Array, stream
from cdpipe.sensor.ouster import SensorMetadata
from scenarios.schema import Sensor
from sim.geometry.raycast import RayCaster
from sim.sensor.air import AirVolume, cross_air
from sim.sensor.footprint import central_echo, spread_echo
from sim.sensor.optics import (
    FALSE_PHOTONS,
    apparent_reflectivity,
    detection_probability,
    false_returns,
    range_channel,
    range_sigma_m,
    reflectivity_channel,
    signal_channel,
)
from sim.sensor.rays import Rays
from sim.sensor.water import Water, cross_water

MISS, FALSE_RETURN = -1, -2
# A return belongs to an owner whose geoms reflected at least this share of its light; others are mixed. Surfaces that
# blend are less than 1 m apart (`sim.sensor.footprint.PULSE_M`), so the rest of the light moves the return by less than
# 0.1 m, the distance by which a return must be off the old surface to count as changed.
LEAST_SHARE = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One revolution as the sensor reports it, with the truth of each return. All arrays (H, W), staggered.

    Attributes:
        range_mm: uint32, 0 where nothing returned.
        reflectivity: uint8, percent of a perfect diffuse reflector up to 100.
        signal: uint16 photons.
        true_range_m: float32 distance from the spin axis's point to the surface along the beam, infinite for a miss.
        geom: int32 geom hit, `MISS` where nothing returned, `FALSE_RETURN` where nothing stands,
            `sim.sensor.air.AIR` for mist and dust, `sim.sensor.water.MIRRORED` for what water mirrors.
        owner: int32 owner of the geoms that reflected most of the light, 0 where no geom was hit.
        is_mixed: True for a return of which less than 90 % of the light came from geoms of `owner`. Always False with
            one ray per beam.
    """

    range_mm: npt.NDArray[np.uint32]
    reflectivity: npt.NDArray[np.uint8]
    signal: npt.NDArray[np.uint16]
    true_range_m: Float32Array
    geom: Int32Array
    owner: Int32Array
    is_mixed: BoolArray


class Surfaces(Protocol):
    """What a sensor looks at, such as `sim.scene.Scene`: a ray caster, instance and reflectivity (G,) of its geoms."""

    @property
    def caster(self) -> RayCaster:
        """Ray caster over the geoms."""

    @property
    def instance(self) -> Int32Array:
        """(G,) number of the object that each geom belongs to, 0 for rock and fixtures."""

    @property
    def reflectivity(self) -> Float32Array:
        """(G,) share of the light that each geom reflects."""


def scan(
    scene: Surfaces,
    sensor: SensorMetadata,
    settings: Sensor,
    rays: Rays,
    seed: int,
    session: str,
    number: int,
    owners: Int32Array | None = None,
    air: AirVolume | None = None,
    water: Water | None = None,
) -> Scan:
    """Cast one revolution and apply the effects of the sensor.

    Every pixel has random numbers, even without a hit. Another prop therefore changes only the beams that meet it.

    Args:
        scene: The surfaces.
        sensor: Beam table.
        settings: Range limits, and which effects are on.
        rays: The revolution's rays.
        seed: The scenario's seed.
        session: "before" or "after".
        number: Index of the revolution in its session.
        owners: (G,) owner of each geom, between which mixed returns are told; by default the prop, `scene.instance`.
        air: Mist and dust around the sensor; None where the air is clear.
        water: Puddles; None where there are none.
    """
    owners = scene.instance if owners is None else owners
    surfaces = scene.caster, scene.reflectivity, rays, sensor.beam_origin_m, owners
    echo = central_echo(*surfaces) if settings.sub_rays == 1 else spread_echo(*surfaces, settings.sub_rays)
    if water is not None:
        echo = cross_water(echo, rays, sensor.beam_origin_m, water)
    if air is not None:
        echo = cross_air(echo, rays, sensor.beam_origin_m, air, stream(seed, session, "air-returns", str(number)))
    shape = echo.range_m.shape
    range_m, photons = echo.range_m, echo.photons
    if settings.range_noise:
        noise = stream(seed, session, "range-noise", str(number)).standard_normal(shape, dtype=np.float32)
        noise *= range_sigma_m(range_m, photons, echo.cosine)
        range_m = range_m + noise
    is_return = (echo.geom != MISS) & (range_m >= settings.min_range_m) & (range_m <= settings.max_range_m)
    if settings.dropouts:
        draw = stream(seed, session, "dropouts", str(number)).random(shape, dtype=np.float32)
        is_return &= draw < detection_probability(photons)
    geom = np.where(is_return, echo.geom, np.int32(MISS))
    range_m, photons = np.where(is_return, range_m, np.float32(0.0)), np.where(is_return, photons, np.float32(0.0))
    if settings.false_positives:
        generator = stream(seed, session, "false-positives", str(number))
        pixels, places_m = false_returns(generator, geom.size, settings.min_range_m, settings.max_range_m)
        geom.flat[pixels], range_m.flat[pixels], photons.flat[pixels] = FALSE_RETURN, places_m, FALSE_PHOTONS
    range_mm = range_channel(range_m, settings.range_step_mm)
    return Scan(
        range_mm=range_mm.T,
        reflectivity=reflectivity_channel(apparent_reflectivity(photons, range_m)).T,
        signal=signal_channel(photons).T,
        true_range_m=echo.true_range_m.T,
        geom=geom.T,
        owner=np.where(geom >= 0, echo.owner, np.int32(0)).T,
        is_mixed=((geom >= 0) & (echo.owner_share < LEAST_SHARE)).T,
    )
