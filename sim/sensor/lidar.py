"""The sensor: the echoes of a revolution's beams, then range noise, dropouts, range steps and false returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import BoolArray, Float32Array, Int32Array, stream
from cdpipe.sensor.ouster import SensorMetadata
from scenarios.schema import Sensor
from sim.geometry.raycast import RayCaster
from sim.sensor.air import AirVolume, cross_air, dim_echo
from sim.sensor.footprint import (
    PULSE_M,
    Echo,
    Limits,
    blend_beams,
    cast_beams,
    central_echo,
    choose_echo,
    drop_strongest,
    no_echo,
    outweighs,
    spread_echo,
    stronger_echo,
)
from sim.sensor.glare import add_glare
from sim.sensor.glass import Panes, cross_glass
from sim.sensor.optics import (
    FALSE_PHOTONS,
    RETRO_FROM,
    apparent_reflectivity,
    as_white,
    detection_probability,
    false_returns,
    range_channel,
    range_sigma_m,
    reflectivity_channel,
    signal_channel,
)
from sim.sensor.rays import Rays
from sim.sensor.water import Water, cross_water, look_through_water

MISS, FALSE_RETURN = -1, -2
# A return belongs to an owner whose geoms reflected at least this share of its light; others are mixed. Surfaces that
# blend are less than 1 m apart (`sim.sensor.footprint.PULSE_M`), so the rest of the light moves the return by less than
# 0.1 m, the distance by which a return must be off the old surface to count as changed.
LEAST_SHARE = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One revolution as the sensor reports it, with the truth of each return. All arrays (H, W), staggered.

    With two returns they are (2 H, W): the second return of row h is in row H + h.

    Attributes:
        range_mm: uint32, 0 where nothing returned.
        reflectivity: uint8, percent of a perfect diffuse reflector up to 100.
        signal: uint16 photons.
        true_range_m: float32 distance from the spin axis's point to the surface along the beam, infinite for a miss.
        geom: int32 geom hit, `MISS` where nothing returned, `FALSE_RETURN` where nothing stands,
            `sim.sensor.air.AIR` for mist and dust, `sim.sensor.optics.MIRRORED` for what water or glass mirrors,
            `sim.sensor.glare.GLARE` for stray light.
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
    panes: Panes | None = None,
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
        panes: Panes of glass; None where glass is a wall.
    """
    reflectivity = scene.reflectivity if settings.retroreflectors else as_white(scene.reflectivity)
    surfaces = scene.caster, reflectivity, rays, sensor.beam_origin_m
    limits = _range_limits(settings)
    echo, second = _see_surfaces(surfaces, scene.instance if owners is None else owners, settings)
    if water is not None:
        echo, other = cross_water(echo, rays, sensor.beam_origin_m, water, limits)
        if second is not None:
            second = stronger_echo(look_through_water(second, rays, sensor.beam_origin_m, water), other, limits)
    if panes is not None:
        echo, other = cross_glass(echo, rays, sensor.beam_origin_m, panes, limits)
        second = None if second is None else stronger_echo(second, other, limits)
    if air is not None:
        returns = stream(seed, session, "air-returns", str(number))
        if second is not None:
            second = dim_echo(second, rays, sensor.beam_origin_m, air)
        echo, other = cross_air(echo, rays, sensor.beam_origin_m, air, returns, limits)
        second = None if second is None else stronger_echo(second, other, limits)
    if second is not None:  # what was the stronger one may have been dimmed more
        is_stronger = outweighs(second, echo, limits)
        echo, second = choose_echo(is_stronger, second, echo), choose_echo(is_stronger, echo, second)
    if settings.retroreflectors:
        draw = stream(seed, session, "glare", str(number)).random(echo.range_m.shape, dtype=np.float32)
        echo, second = add_glare(echo, second, rays, sensor, reflectivity >= RETRO_FROM, draw)
    parts = [_measure(echo, settings, (seed, session, ""), number)]
    if second is not None:
        parts = _arrange(parts[0], _measure(second, settings, (seed, session, "second-"), number))
    if settings.returns == "last":
        is_later = (parts[1].geom != MISS) & (parts[1].range_m > parts[0].range_m)
        parts = [_choose(is_later, parts[1], parts[0])]
    if settings.false_positives:
        _report_nothing_there(parts, settings, stream(seed, session, "false-positives", str(number)))
    geom, range_m, photons, true_range_m, owner, share = (
        np.concatenate([getattr(part, name).T for part in parts]) for name in _MEASURED
    )
    return Scan(
        range_mm=range_channel(range_m, settings.range_step_mm),
        reflectivity=reflectivity_channel(apparent_reflectivity(photons, range_m)),
        signal=signal_channel(photons),
        true_range_m=true_range_m,
        geom=geom,
        owner=np.where(geom >= 0, owner, np.int32(0)),
        is_mixed=(geom >= 0) & (share < LEAST_SHARE),
    )


def _see_surfaces(
    surfaces: tuple[RayCaster, Float32Array, Rays, float], owners: Int32Array, settings: Sensor
) -> tuple[Echo, Echo | None]:
    """Return the first echo of a revolution from the surfaces, and the second one where the sensor may report it.

    Args:
        surfaces: Caster, reflectivity (G,), rays, and the distance of their origins from the spin axis.
        owners: (G,) owner of each geom.
        settings: Number of rays in a beam, and of returns; range limits.
    """
    has_second, limits = settings.returns != "strongest", _range_limits(settings)
    if settings.sub_rays == 1:
        echo = central_echo(*surfaces, owners)
        return echo, no_echo(echo) if has_second else None
    if not has_second:
        return spread_echo(*surfaces, owners, settings.sub_rays, limits), None
    hits = cast_beams(*surfaces, settings.sub_rays, limits)
    first, second = (
        blend_beams(each, owners, surfaces[2].directions.shape[:2]) for each in (hits, drop_strongest(hits))
    )
    return first, second


def _range_limits(settings: Sensor) -> Limits:
    """Return the ranges that a sensor reports."""
    # a range of 0 says that there is no return
    return Limits(max(settings.min_range_m, settings.range_step_mm / 1000.0), settings.max_range_m)


@dataclass(frozen=True, slots=True, eq=False)
class _Return:
    """What the receiver makes of an echo. All arrays (W, H); attributes as of `Scan` and `Echo`, metres and photons."""

    geom: Int32Array
    range_m: Float32Array
    photons: Float32Array
    true_range_m: Float32Array
    owner: Int32Array
    owner_share: Float32Array


_MEASURED = tuple(field.name for field in fields(_Return))


def _measure(echo: Echo, settings: Sensor, purpose: tuple[int, str, str], number: int) -> _Return:
    """Return an echo with range noise, without what is out of range or too weak.

    Args:
        echo: The echo.
        settings: Which effects are on.
        purpose: Seed, session, and what precedes the names of the streams.
        number: Index of the revolution.
    """
    seed, session, prefix = purpose
    shape = echo.range_m.shape
    range_m, photons = echo.range_m, echo.photons
    if settings.range_noise:
        noise = stream(seed, session, f"{prefix}range-noise", str(number)).standard_normal(shape, dtype=np.float32)
        noise *= range_sigma_m(range_m, photons, echo.cosine)
        range_m = range_m + noise
    is_return = (echo.geom != MISS) & _range_limits(settings).hold(range_m)
    if settings.dropouts:
        draw = stream(seed, session, f"{prefix}dropouts", str(number)).random(shape, dtype=np.float32)
        is_return &= draw < detection_probability(photons)
    return _Return(
        geom=np.where(is_return, echo.geom, np.int32(MISS)),
        range_m=np.where(is_return, range_m, np.float32(0.0)),
        photons=np.where(is_return, photons, np.float32(0.0)),
        true_range_m=echo.true_range_m,
        owner=echo.owner,
        owner_share=echo.owner_share,
    )


def _arrange(first: _Return, second: _Return) -> list[_Return]:
    """Return both returns of every pixel: a lone one is the first, and two within one pulse are the first alone."""
    is_lone = (first.geom == MISS) & (second.geom != MISS)
    first, second = _choose(is_lone, second, first), _choose(is_lone, first, second)
    is_close = (second.geom != MISS) & (np.abs(second.range_m - first.range_m) < PULSE_M)
    dark = np.zeros_like(second.range_m)
    none = _Return(
        np.full_like(second.geom, MISS), dark, dark, np.full_like(dark, np.inf), second.owner, np.ones_like(dark)
    )
    return [first, _choose(is_close, none, second)]


def _report_nothing_there(parts: Sequence[_Return], settings: Sensor, generator: np.random.Generator) -> None:
    """Let some pixels report a return where nothing is, and no second one, in place."""
    first, *others = parts
    least_m = min(_range_limits(settings).least_m, settings.max_range_m)
    pixels, places_m = false_returns(generator, first.geom.size, least_m, settings.max_range_m)
    first.geom.flat[pixels], first.range_m.flat[pixels], first.photons.flat[pixels] = (
        FALSE_RETURN, places_m, FALSE_PHOTONS
    )  # fmt: skip
    for later in others:
        later.geom.flat[pixels], later.range_m.flat[pixels], later.photons.flat[pixels] = MISS, 0.0, 0.0


def _choose(mask: BoolArray, chosen: _Return, other: _Return) -> _Return:
    """Return one return where a mask (W, H) is true, and another elsewhere."""
    return _Return(*(np.where(mask, getattr(chosen, name), getattr(other, name)) for name in _MEASURED))
