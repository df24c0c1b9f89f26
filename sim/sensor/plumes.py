"""Dust that vehicles raise: puffs that drift with the air, spread and settle.

A vehicle raises a mass of dust with each metre of its way. A puff of it is a round Gaussian that starts as wide as the
wake, spreads by turbulence, and loses mass to the floor, which mirrors the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cdpipe.core.geometry import Float32Array, Float64Array

# All ours, unverified: width of a wake and the height of its middle, turbulent diffusivity in a ventilated drift, and
# the time in which 63 % settle. By Stokes, quartz grains 14 um in diameter sink 2 m in about that time; those of 10 um
# take 250 s.
WAKE_SIGMA_M, WAKE_HEIGHT_M = 0.8, 0.6
DIFFUSIVITY_M2_PER_S = 0.05
SETTLING_S = 120.0
LIFE_S = 240.0  # puffs older than this have lost 86 % and are left out
_WINDOW_SIGMAS = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Puffs:
    """The dust that vehicles have raised so far.

    Attributes:
        raised: (P, 3) where each puff was raised, on the floor, world frame, metres.
        age_s: (P,) how long ago.
        mass_mg: (P,) its mass then.
    """

    raised: Float64Array
    age_s: Float64Array
    mass_mg: Float64Array


def fill_lattice(puffs: Puffs, drift_mps: Float64Array, axes: Sequence[Float64Array]) -> Float32Array:
    """Return the density (X, Y, Z) of all puffs on a lattice, mg/m3.

    Args:
        puffs: The puffs.
        drift_mps: (3,) velocity of the air.
        axes: Coordinates (X,), (Y,), (Z,) of the lattice, world frame, metres, evenly spaced.
    """
    total = np.zeros([len(axis) for axis in axes], np.float32)
    sigma_m = np.sqrt(WAKE_SIGMA_M**2 + 2.0 * DIFFUSIVITY_M2_PER_S * puffs.age_s)
    left_mg = puffs.mass_mg * np.exp(-puffs.age_s / SETTLING_S)
    middles = puffs.raised + puffs.age_s[:, None] * drift_mps
    for middle, sigma, mass in zip(middles, sigma_m, left_mg, strict=True):
        reach_m = _WINDOW_SIGMAS * sigma + WAKE_HEIGHT_M
        off = [axis - place for axis, place in zip(axes, middle, strict=True)]
        windows = [slice(*np.searchsorted(each, (-reach_m, reach_m))) for each in off]
        off = [each[window] for each, window in zip(off, windows, strict=True)]
        across = [np.exp(-0.5 * (each / sigma) ** 2) for each in off[:2]]
        up = sum(np.exp(-0.5 * ((off[2] + sign * WAKE_HEIGHT_M) / sigma) ** 2) for sign in (-1.0, 1.0))
        up = np.where(off[2] >= -0.5, up, 0.0)  # half a cell below the floor
        peak = mass / ((2.0 * np.pi) ** 1.5 * sigma**3)
        total[tuple(windows)] += (peak * across[0][:, None, None] * across[1][:, None] * up).astype(np.float32)
    return total
