"""Mist and dust: what the air takes from a beam on its way, and what it sends back itself.

Extinction alpha (1/m) dims a surface at range R by exp(-2 integral of alpha), Beer and Lambert there and back. A slice
of air of depth dR sends back as much light as a surface of reflectivity pi beta dR in its place, beta = alpha / lidar
ratio. So both go through the sensor's own photon budget (`sim.sensor.optics.received_photons`), overlap included.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from cdpipe.core.geometry import Float32Array, Float64Array, Int64Array, stream
from scenarios.schema import Air, Dust
from sim.geometry.noise import smooth_noise
from sim.sensor.footprint import EVERYWHERE, PULSE_M, Echo, Limits, choose_echo, no_echo, outweighs
from sim.sensor.optics import received_photons
from sim.sensor.plumes import Puffs, fill_lattice
from sim.sensor.rays import Rays

AIR = -3  # number of the geom of a return from the air
# Koschmieder: at the meteorological optical range 5 % of the contrast is left, so alpha = ln(20) / range.
CONTRAST_LEFT = 0.05
# Extinction over backscatter, sr. Water droplets at 905 nm: O'Connor, Illingworth and Hogan 2004. Mineral dust at
# 532 nm: Tesche and others 2009; at the sensor's 865 nm unverified.
MIST_RATIO_SR, DUST_RATIO_SR = 18.8, 55.0
# Extinction of dust, 3 Q / (4 density r): Mie's efficiency Q is 2 for grains much larger than the wavelength (here 18
# times around the grain), quartz has 2,650 kg/m3, the effective radius of 2.5 um is that of respirable dust: ours.
DUST_M2_PER_MG = 3 * 2.0 / (4 * 2650.0 * 2.5e-6) * 1e-6
# The receiver adds up what comes back within one pulse (`PULSE_M`); air farther than this is too weak to be reported.
REACH_M = 20.0
LEAST_PHOTONS = 1.0
# Around the sensor dust has swathes on a lattice; farther off it has its mean.
_LATTICE_M, _LATTICE_REACH_M, _LATTICE_HEIGHT_M = 1.0, 40.0, 8.0


@dataclass(frozen=True, slots=True, eq=False)
class DustCloud:
    """The dust around the sensor during one revolution.

    Attributes:
        dust: What it is like where no vehicle raised it; None: there is none.
        floor_z_m: Height of the floor below the sensor, world frame, metres.
        corner_m: (3,) first point of the lattice, world frame, metres.
        swathes: (X, Y, Z) float32 density over its mean on the lattice.
        raised: (X, Y, Z) float32 density of what vehicles raised, mg/m3; None: they raised none.
    """

    dust: Dust | None
    floor_z_m: float
    corner_m: Float64Array
    swathes: Float32Array
    raised: Float32Array | None = None

    def extinction(self, points: Float32Array) -> Float32Array:
        """Return the extinction (N,), 1/m, at (3, N) points, world frame, metres; of the mean beyond the lattice."""
        index = np.rint((points - self.corner_m[:, None].astype(np.float32)) / np.float32(_LATTICE_M)).astype(np.int32)
        is_off = np.zeros(points.shape[1], np.bool_)
        for axis, count in enumerate(self.swathes.shape):
            is_off |= (index[axis] < 0) | (index[axis] >= count)
            np.clip(index[axis], 0, count - 1, out=index[axis])
        density: Float32Array = self.swathes[index[0], index[1], index[2]]
        density[is_off] = 1.0
        if self.dust is None:
            density[:] = 0.0
        else:
            density *= np.float32(DUST_M2_PER_MG * self.dust.mg_per_m3)
            heights_m = np.maximum(points[2] - np.float32(self.floor_z_m), np.float32(0.0))
            density *= np.exp(heights_m / np.float32(-self.dust.scale_height_m))
        if self.raised is not None:
            raised = self.raised[index[0], index[1], index[2]]
            density += np.float32(DUST_M2_PER_MG) * np.where(is_off, np.float32(0.0), raised)
        return density


@dataclass(frozen=True, slots=True, eq=False)
class AirVolume:
    """The air around the sensor during one revolution.

    Attributes:
        mist_per_m: Extinction of the mist.
        dust: The dust, None without any.
    """

    mist_per_m: float
    dust: DustCloud | None = None

    def extinction(self, points: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Return the extinction (1/m) and the backscatter (1/(m sr)) at (3, N) points, world frame, metres."""
        mist = np.full(points.shape[1], self.mist_per_m, np.float32)
        from_mist = mist / np.float32(MIST_RATIO_SR)
        if self.dust is None:
            return mist, from_mist
        dust = self.dust.extinction(points)
        return mist + dust, from_mist + dust / np.float32(DUST_RATIO_SR)


def air_around(
    air: Air,
    sensor_m: Float64Array,
    floor_z_m: float,
    time_s: float,
    seed: int,
    session: str,
    puffs: Puffs | None = None,
) -> AirVolume:
    """Return the air around a sensor at a (3,) position, world frame, at a time of its session.

    Args:
        air: Mist and dust of the session.
        sensor_m: (3,) the position.
        floor_z_m: Height of the floor below it.
        time_s: The time.
        seed: Of the scenario.
        session: "before" or "after".
        puffs: What vehicles have raised by then; it drifts with the session's dust, or stays in still air.
    """
    mist_per_m = -np.log(CONTRAST_LEFT) / air.mist.visibility_m if air.mist is not None else 0.0
    if air.dust is None and puffs is None:
        return AirVolume(mist_per_m)
    return AirVolume(
        mist_per_m, _dust_around(air.dust, puffs, sensor_m, floor_z_m, time_s, stream(seed, session, "air"))
    )


def _dust_around(
    dust: Dust | None,
    puffs: Puffs | None,
    sensor_m: Float64Array,
    floor_z_m: float,
    time_s: float,
    generator: np.random.Generator,
) -> DustCloud:
    """Return dust in swathes that are log-normal about their mean and drift along a drawn level heading, and puffs."""
    key, heading_rad = int(generator.integers(1 << 62)), float(generator.uniform(0.0, 2 * np.pi))
    heading = np.array([np.cos(heading_rad), np.sin(heading_rad), 0.0])
    half_m = np.array([_LATTICE_REACH_M, _LATTICE_REACH_M, _LATTICE_HEIGHT_M])
    corner_m = np.floor((sensor_m - half_m) / _LATTICE_M) * _LATTICE_M
    axes = [start + np.arange(0.0, 2 * half + 1e-9, _LATTICE_M) for start, half in zip(corner_m, half_m, strict=True)]
    speed_mps = 0.0 if dust is None else dust.drift_mps
    raised = None if puffs is None else fill_lattice(puffs, speed_mps * heading, axes)
    if dust is None:
        return DustCloud(None, floor_z_m, corner_m, np.zeros([len(axis) for axis in axes], np.float32), raised)
    drifted_m = speed_mps * time_s * heading
    moved = (axes[0] - drifted_m[0], axes[1] - drifted_m[1], axes[2])
    swathes = np.exp(dust.contrast * smooth_noise(moved, dust.patch_m, key) - dust.contrast**2 / 2)
    return DustCloud(dust, floor_z_m, corner_m, swathes.astype(np.float32), raised)


def cross_air(
    echo: Echo,
    rays: Rays,
    beam_origin_m: float,
    air: AirVolume,
    generator: np.random.Generator,
    limits: Limits = EVERYWHERE,
) -> tuple[Echo, Echo]:
    """Return the stronger and the weaker echo of a revolution through the air: of dimmed surfaces and of the air.

    The light of each metre of air within the limits is counted with the noise of its photons (square root transform);
    the metre with the highest count is the air's echo, somewhere within it. That the strongest metre wins is ours,
    unverified.

    Args:
        echo: The surfaces' echo through clear air.
        rays: The revolution's rays.
        beam_origin_m: Distance of their origins from the spin axis.
        air: The air.
        generator: Draws as many numbers for every pixel, whatever it meets.
        limits: The ranges at which the receiver listens.
    """
    n_pixels = echo.range_m.size
    reach_m = np.where(echo.geom != -1, echo.range_m - np.float32(beam_origin_m), np.float32(REACH_M)).ravel()
    depth, best, best_m = (np.zeros(n_pixels, np.float32) for _ in range(3))
    within = generator.random(n_pixels, dtype=np.float32)
    nearest_m, farthest_m = np.float32(limits.least_m - beam_origin_m), np.float32(limits.most_m - beam_origin_m)
    for step in _walk(reach_m, rays, air):
        if step.start_m < REACH_M:
            noise = generator.standard_normal(n_pixels, dtype=np.float32)[step.on_way]
            skipped_m = max(nearest_m - step.start_m, np.float32(0.0))
            heard_m = np.minimum(step.length_m, farthest_m - step.start_m) - skipped_m
            middle_m = skipped_m + heard_m * np.float32(0.5)
            dimmed = np.exp(-2 * (depth[step.on_way] + step.alpha * middle_m))
            power = np.float32(np.pi) * step.beta * np.maximum(heard_m, np.float32(0.0)) * dimmed
            counted = _count(received_photons(power, step.start_m + middle_m + np.float32(beam_origin_m)), noise)
            is_better = counted > best[step.on_way]
            better = step.on_way[is_better]
            best[better] = counted[is_better]
            best_m[better] = step.start_m + skipped_m + within[better] * heard_m[is_better]
        depth[step.on_way] += step.alpha * step.length_m
    return _rank(echo, depth, best, best_m + np.float32(beam_origin_m), limits)


def dim_echo(echo: Echo, rays: Rays, beam_origin_m: float, air: AirVolume) -> Echo:
    """Return an echo as it comes through the air, which sends nothing back itself."""
    reach_m = np.where(echo.geom != -1, echo.range_m - np.float32(beam_origin_m), np.float32(0.0)).ravel()
    depth = np.zeros(len(reach_m), np.float32)
    for step in _walk(reach_m, rays, air):
        depth[step.on_way] += step.alpha * step.length_m
    return replace(echo, photons=echo.photons * np.exp(-2 * depth).reshape(echo.range_m.shape))


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """The air that the (M,) beams `on_way` cross between `start_m` and a pulse farther, or up to what they meet."""

    start_m: np.float32
    on_way: Int64Array
    length_m: Float32Array
    alpha: Float32Array
    beta: Float32Array


def _walk(reach_m: Float32Array, rays: Rays, air: AirVolume) -> Iterator[_Step]:
    """Yield the air along all beams, one pulse after the other, up to the reach (N,) of each."""
    ways = rays.directions.reshape(-1, 3).T
    origins = np.repeat(rays.origins.T, rays.directions.shape[1], axis=1).astype(np.float32)
    for number in range(int(np.ceil(reach_m.max(initial=0.0) / PULSE_M))):
        start_m = np.float32(number * PULSE_M)
        on_way = np.flatnonzero(reach_m > start_m)
        length_m = np.minimum(reach_m[on_way] - start_m, np.float32(PULSE_M))
        middle_m = start_m + length_m * np.float32(0.5)
        yield _Step(start_m, on_way, length_m, *air.extinction(origins[:, on_way] + ways[:, on_way] * middle_m))


def _count(photons: Float32Array, noise: Float32Array) -> Float32Array:
    """Return (N,) numbers of photons of (N,) expectations: the square root of a Poisson number has deviation 1/2."""
    root = np.maximum(np.sqrt(photons) + noise / 2, np.float32(0.0))
    return np.asarray(
        np.where(photons > 0, np.maximum(root * root - np.float32(0.25), np.float32(0.0)), np.float32(0.0))
    )


def _rank(
    echo: Echo, depth: Float32Array, counted: Float32Array, air_m: Float32Array, limits: Limits
) -> tuple[Echo, Echo]:
    """Return the stronger and the weaker of the dimmed surface and the air.

    Args:
        echo: The surface's echo, not dimmed.
        depth: (N,) optical depth of the air before it.
        counted: (N,) photons of the air; fewer than one are none.
        air_m: (N,) range of the air's echo, metres.
        limits: The ranges at which the receiver listens.
    """
    shape = echo.range_m.shape
    surface = replace(echo, photons=echo.photons * np.exp(-2 * depth).reshape(shape))
    light = counted.reshape(shape)
    light = np.where(light >= LEAST_PHOTONS, light, np.float32(0.0))
    is_there = light > 0
    air = replace(
        no_echo(echo),
        range_m=np.where(is_there, air_m.reshape(shape), np.float32(0.0)),
        photons=light,
        cosine=is_there.astype(np.float32),
        geom=np.where(is_there, np.int32(AIR), np.int32(-1)),
    )
    is_air = outweighs(air, surface, limits)
    return choose_echo(is_air, air, surface), choose_echo(is_air, surface, air)
