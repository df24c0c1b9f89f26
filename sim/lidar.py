"""The sensor: rays of an Ouster beam table from a pose per column, then range noise, dropouts and 1 mm steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cdpipe.geometry import BoolArray, Float32Array, Float64Array, Int32Array, stream
from cdpipe.ouster import SensorMetadata
from scenarios.schema import Sensor
from sim.scene import Scene

# One-sigma range precision below each range; not verified in a data sheet.
_SIGMA_TABLE_M = ((1.0, 0.007), (20.0, 0.010), (50.0, 0.020), (np.inf, 0.050))
# Data sheet: a target of 10 % is seen at 45 m with 90 % and at 55 m with 50 % probability.
_ANCHOR_REFLECTIVITY = 0.10
_ANCHOR_90_M, _ANCHOR_50_M = 45.0, 55.0


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """The rays of one revolution, world frame.

    Attributes:
        origins: (W, H, 3) float64 points where the beams leave the head, metres. Column by column.
        directions: (W, H, 3) float64 unit vectors.
    """

    origins: Float64Array
    directions: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One revolution as the sensor reports it, with the truth of each return. All arrays (H, W), staggered.

    Attributes:
        range_mm: uint32, 0 where nothing returned.
        reflectivity: uint8.
        signal: uint16 photons.
        true_range_m: float32 distance from the spin axis's point to the surface along the beam, infinite for a miss.
        geom: int32 geom hit, -1 where nothing returned.
    """

    range_mm: npt.NDArray[np.uint32]
    reflectivity: npt.NDArray[np.uint8]
    signal: npt.NDArray[np.uint16]
    true_range_m: Float32Array
    geom: Int32Array


def revolution_rays(sensor: SensorMetadata, world_T_column: Float64Array) -> Rays:
    """Return the rays of a revolution whose columns have poses (W, 4, 4)."""
    rotations, positions = world_T_column[:, :3, :3], world_T_column[:, None, :3, 3]
    # Written out by component: no library may split the sums differently from run to run.
    return Rays(_turned(rotations, sensor.origins) + positions, _turned(rotations, sensor.directions))


def scan(
    scene: Scene, sensor: SensorMetadata, settings: Sensor, rays: Rays, seed: int, session: str, number: int
) -> Scan:
    """Cast one revolution and add what the sensor adds.

    The random numbers are drawn for every pixel whatever it hits, so that another prop in the scene changes only the
    beams that meet it.

    Args:
        scene: What is there.
        sensor: Beam table.
        settings: Range limits, and which effects are on.
        rays: The revolution's rays.
        seed: The scenario's seed.
        session: "before" or "after".
        number: Index of the revolution in its session.
    """
    shape = (sensor.height, sensor.width)
    flat = (sensor.width * sensor.height, 3)
    distance_m, geom, cosine = scene.caster.cast(rays.origins.reshape(flat), rays.directions.reshape(flat))
    distance_m, geom, cosine = (array.reshape(shape[::-1]).T for array in (distance_m, geom, cosine))
    true_range_m = distance_m + np.float32(sensor.beam_origin_m)
    power = scene.reflectivity[geom] * cosine
    reported_m = np.where(geom >= 0, true_range_m, 0.0).astype(np.float64)
    if settings.range_noise:
        noise = stream(seed, session, "range-noise", str(number)).standard_normal(shape, dtype=np.float32)
        reported_m += noise * range_sigma_m(reported_m)
    is_return = (geom >= 0) & (reported_m >= settings.min_range_m) & (reported_m <= settings.max_range_m)
    if settings.dropouts:
        draw = stream(seed, session, "dropouts", str(number)).random(shape, dtype=np.float32)
        is_return &= draw < detection_probability(power, true_range_m)
    range_mm = np.where(is_return, np.rint(reported_m * 1000.0), 0.0).astype(np.uint32)
    is_return = range_mm > 0
    return Scan(
        range_mm=range_mm,
        reflectivity=_reflectivity(power, is_return),
        signal=np.where(is_return, np.rint(1000.0 * power), 0.0).astype(np.uint16),
        true_range_m=np.ascontiguousarray(true_range_m),
        geom=np.where(is_return, geom, -1).astype(np.int32),
    )


def range_sigma_m(range_m: Float64Array) -> Float64Array:
    """Return the standard deviation of the range noise, metres."""
    limits = [limit for limit, _ in _SIGMA_TABLE_M[:-1]]
    return np.asarray(np.array([sigma for _, sigma in _SIGMA_TABLE_M])[np.searchsorted(limits, range_m, side="right")])


def detection_probability(
    power: npt.NDArray[np.floating], range_m: npt.NDArray[np.floating]
) -> npt.NDArray[np.floating]:
    """Return the chance that a return is seen: a logistic curve in the logarithm of the received power.

    Args:
        power: Reflectivity times the cosine of incidence.
        range_m: Distance, metres; received power falls with its square.
    """
    steepness = np.log(9.0) / (2.0 * np.log(_ANCHOR_50_M / _ANCHOR_90_M))
    with np.errstate(over="ignore"):
        odds_against = (range_m**2 * (_ANCHOR_REFLECTIVITY / _ANCHOR_50_M**2) / np.maximum(power, 1e-9)) ** steepness
    return np.asarray(1.0 / (1.0 + odds_against))


def _reflectivity(power: Float32Array, is_return: BoolArray) -> npt.NDArray[np.uint8]:
    """Percent of a perfect diffuse reflector, as Ouster's calibrated channel is scaled up to 100; at least 1."""
    return np.where(is_return, np.clip(np.rint(100.0 * power), 1.0, 255.0), 0.0).astype(np.uint8)


def _turned(rotations: Float64Array, vectors: Float64Array) -> Float64Array:
    """Rotations (W, 3, 3) of column vectors (H, W, 3), as (W, H, 3)."""
    parts = [np.ascontiguousarray(vectors[:, :, axis].T) for axis in range(3)]
    out = np.empty((vectors.shape[1], vectors.shape[0], 3))
    for row in range(3):
        out[:, :, row] = sum(rotations[:, None, row, axis] * parts[axis] for axis in range(3))
    return out
