"""Light and time of flight of an OS1-32: photons, range noise, detection, the sensor's channels, false returns.

Every function is pure and works element by element, in float32. Constants
marked "measured" come from a real OS1-32 gradient unit's revolution published with the vendor's SDK (BSD-3), 27,310
returns between 2.4 and 204 m; how far other units differ is unverified.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import Float32Array, Int32Array, Int64Array

MIRRORED = -4  # number of the geom of a return by way of a mirror, water or glass
# Photons from a perfect diffuse reflector at 1 m, were the receiver as good there as it is far off. Measured: the
# unit's signal times range squared over its own calibrated reflectivity, median beyond 20 m (0.80 to 1.16 of
# it by beam).
PHOTONS_AT_1_M = 139_800.0
# Share of the light that reaches the receiver, 1 / (1 + (10 m / R)^3.4): measured, within 20 % between 3 and 22 m.
# Nearer than 3 m a percent of reflectivity gives as much as there, 2.5 photons: measured down to 2.4 m (2.4 to 2.9),
# unverified below.
OVERLAP_M, OVERLAP_POWER = 10.0, 3.4
NEAR_M = 3.0
# Data sheet (OS1 rev 6): a target of 10 % is seen at 45 m with 90 % and at 55 m with 50 % probability.
ANCHOR_REFLECTIVITY = 0.10
ANCHOR_90_M, ANCHOR_50_M = 45.0, 55.0
# Standard deviation of a range: the root of the sum of squares of a floor, a share of the range, and the length of
# what comes back over the root of its photons. Set by hand to what was measured on facing surfaces at 3 to 80 m (floor
# and photons: the darker half of those at 4 to 13 m), the scene's own roughness included: 0.66 to
# 1.24 of it by range, 0.5 to 1.8 by photons. They give 0.8, 2.0 and 4.9 cm at 20, 50 and 120 m, where 1, 2 and 5 cm are
# quoted for the OS1 (unverified).
SIGMA_FLOOR_M = 0.002
SIGMA_PER_M = 0.0004
SIGMA_ONE_PHOTON_M = 0.013
# Width of the beam at half its brightness: 9.5 mm where it leaves the window, growing by 0.18 deg (data sheet of the
# first generation: 10 mm, 0.13 to 0.18 deg at half maximum; for the OS1-32 rev 6 both are unverified).
WAIST_M = 0.0095
DIVERGENCE_RAD = math.radians(0.18)
# On a slanted surface what comes back is as long as the beam is wide across: standard deviations of a normal curve
# for each width at half its height, and the steepest slant that is told apart.
SIGMA_PER_WIDTH = 1.0 / math.sqrt(8.0 * math.log(2.0))
LEAST_COSINE = 0.05
# Above 100 % the reflectivity channel is logarithmic (the vendor's maintainers say so): counts for each doubling,
# measured on about a hundred returns of 101 to 160; brighter ones bend off.
COUNTS_PER_DOUBLING = 1.0 / 0.06
# A reflectivity from this on is a retroreflector's: more than the highest count of the reflectivity channel stands for.
RETRO_FROM = 700.0
# What is left of a retroreflector's coefficient at an angle of entrance: EN ISO 20471, the least of new bands at 0.2
# deg of observation (330, 290, 180, 65 cd/(lx m2)); that nothing is left at 60 deg is ours.
RETRO_ENTRANCE_DEG, RETRO_LEFT = (5.0, 20.0, 30.0, 40.0, 60.0), (1.0, 290 / 330, 180 / 330, 65 / 330, 0.0)
# Data sheet of the first generation: the false positive rate its ranges are stated for, at 100 klx of sunlight.
FALSE_RETURN_RATE = 1e-4


def reflected_share(reflectivity: Float32Array, geom: Int32Array, cosine: Float32Array) -> Float32Array:
    """Return how much light surfaces send back, as a share of what a white diffuse one does at right angles.

    Reflectivity times cosine (Lambert). One from `RETRO_FROM` on is that of a retroreflector at right angles: the light
    goes back to where it came from, at any angle of entrance up to some 30 deg, and the lit area grows with it.

    Args:
        reflectivity: (G,) of every geom.
        geom: (...) geoms that were met; -1 for none.
        cosine: (...) of the incidence, 0 where nothing was met.
    """
    share = reflectivity[geom] * cosine
    if (reflectivity >= RETRO_FROM).any():
        retro = np.nonzero(reflectivity[geom] >= RETRO_FROM)
        facing = np.maximum(cosine[retro], np.float32(LEAST_COSINE))
        left = np.interp(np.degrees(np.arccos(np.minimum(facing, 1.0))), RETRO_ENTRANCE_DEG, RETRO_LEFT)
        share[retro] = np.where(cosine[retro] > 0, reflectivity[geom[retro]] * left / facing, 0.0)
        share[retro] = np.maximum(share[retro], cosine[retro])  # the sheet itself is white
    return np.asarray(share)


def mirrored_share(cosine: npt.NDArray[np.floating], index: float) -> npt.NDArray[np.floating]:
    """Return the share of unpolarised light that a smooth surface mirrors (Fresnel).

    Args:
        cosine: Of the incidence.
        index: Refractive index behind the surface; that of air lies before it.
    """
    refracted = np.sqrt(1.0 - (1.0 - cosine * cosine) / index**2)
    across = (cosine - index * refracted) / (cosine + index * refracted)
    along = (index * cosine - refracted) / (index * cosine + refracted)
    return np.asarray((across * across + along * along) / 2)


def as_white(reflectivity: Float32Array) -> Float32Array:
    """Return reflectivities (G,) in which retroreflectors are perfect diffuse reflectors."""
    return np.where(reflectivity >= RETRO_FROM, np.float32(1.0), reflectivity)


def received_photons(power: Float32Array, range_m: Float32Array) -> Float32Array:
    """Return the expected photons of a return: 139,800 x power / R^2 x overlap(R), 0 for a miss at infinity.

    Args:
        power: Share of light that the surface sends back, such as `reflected_share`.
        range_m: Distance, metres.
    """
    return np.asarray(power * _photons_of_white(range_m))


def apparent_reflectivity(photons: Float32Array, range_m: Float32Array) -> Float32Array:
    """Return what reflectivity a surface met at right angles would need to send back this many photons.

    As the vendor has it, signal times range squared over the sensitivity at that range: the cosine stays in.
    """
    return np.asarray(photons / _photons_of_white(range_m))


def range_sigma_m(range_m: Float32Array, photons: Float32Array, cosine: Float32Array) -> Float32Array:
    """Return the standard deviation of the range noise, metres.

    Root of (2 mm)^2 + (0.4 mm per m)^2 + ((13 mm)^2 + (width tan(incidence))^2) / photons, where the width of the beam
    has the standard deviation 4.0 mm + 1.33 mm per m: rises with range and incidence, falls with the strength of the
    return; a return of less than one photon counts as one.

    Args:
        range_m: Distance, metres, finite.
        photons: Expected photons of the return.
        cosine: Of the incidence.
    """
    squared_tangent = 1.0 / np.square(np.maximum(cosine, LEAST_COSINE)) - 1.0
    squared_range = np.square(range_m)
    width_m = np.float32(SIGMA_PER_WIDTH * WAIST_M) + np.float32(SIGMA_PER_WIDTH * DIVERGENCE_RAD) * range_m
    length = SIGMA_ONE_PHOTON_M**2 + np.square(width_m) * squared_tangent
    variance = SIGMA_FLOOR_M**2 + SIGMA_PER_M**2 * squared_range + length / np.maximum(photons, 1.0)
    return np.asarray(np.sqrt(variance))


def detection_probability(photons: Float32Array) -> Float32Array:
    """Return the chance that a return is seen: logistic in the logarithm of its photons, through both anchors."""
    odds_against = (_PHOTONS_50 / np.maximum(photons, 1e-5)) ** _STEEPNESS
    return np.asarray(1.0 / (1.0 + odds_against))


def reflectivity_channel(share: Float32Array) -> npt.NDArray[np.uint8]:
    """Return the reflectivity channel: percent up to 100, above that logarithmic up to 255."""
    percent = 100.0 * share
    counts = np.minimum(percent, 100.0)
    is_bright = percent > 100.0
    if is_bright.any():
        counts[is_bright] += COUNTS_PER_DOUBLING * np.log2(percent[is_bright] / 100.0)
    return np.asarray(np.clip(np.rint(counts), 0.0, 255.0), dtype=np.uint8)


def signal_channel(photons: Float32Array) -> npt.NDArray[np.uint16]:
    """Return the signal channel: whole photons, at most 65535."""
    return np.asarray(np.minimum(np.rint(photons), 65535.0), dtype=np.uint16)


def range_channel(range_m: Float32Array, step_mm: int) -> npt.NDArray[np.uint32]:
    """Return ranges in millimetres, rounded to whole ones, then down to a multiple of `step_mm`.

    Down, as the vendor's SDK writes its low-bandwidth packets: without the last three bits of the millimetres.
    """
    millimetres = np.asarray(np.rint(range_m * 1000.0), dtype=np.uint32)
    return millimetres if step_mm == 1 else np.asarray(millimetres - millimetres % step_mm)


def false_returns(
    generator: np.random.Generator, n_pixels: int, min_range_m: float, max_range_m: float
) -> tuple[Int64Array, Float32Array]:
    """Draw the pixels that report something where nothing is.

    Their number is binomial with `FALSE_RETURN_RATE`. Their ranges are uniform, for a peak of stray light is as likely
    in one bin of time as in any other: ours, unverified.

    Returns:
        (n,) flat numbers of the pixels, and (n,) float32 ranges, metres.
    """
    n_false = int(generator.binomial(n_pixels, FALSE_RETURN_RATE))
    pixels = generator.choice(n_pixels, n_false, replace=False, shuffle=False)
    ranges_m = min_range_m + (max_range_m - min_range_m) * generator.random(n_false, dtype=np.float32)
    return pixels.astype(np.int64), ranges_m.astype(np.float32)


def _photons_of_white(range_m: Float32Array) -> Float32Array:
    """Photons of a perfect diffuse reflector met at right angles."""
    reach_m = np.maximum(range_m, NEAR_M)
    return np.asarray(PHOTONS_AT_1_M / (reach_m * reach_m * (1.0 + (OVERLAP_M / reach_m) ** OVERLAP_POWER)))


def _anchor_photons(range_m: float) -> float:
    return float(received_photons(np.array(ANCHOR_REFLECTIVITY, np.float32), np.array(range_m, np.float32)))


_PHOTONS_50 = _anchor_photons(ANCHOR_50_M)
_STEEPNESS = math.log(9.0) / math.log(_anchor_photons(ANCHOR_90_M) / _PHOTONS_50)
FALSE_PHOTONS = _PHOTONS_50  # a false return is as weak as what is seen every other time: ours
