"""Props cast into one revolution: the nearest return counts, and what lies behind a prop is in its shadow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array, stream
from sim.geometry.raycast import Caster
from sim.graft.noise import RangeNoise, find_bins
from sim.graft.part import Part, RecordedRevolution
from sim.sensor.optics import range_channel
from sim.sensor.rays import Rays, revolution_rays
from sim.session.truth import Int16Array

NO_RETURN = -1


@dataclass(frozen=True, slots=True, eq=False)
class Props:
    """The props of one session.

    Attributes:
        caster: Over their surfaces, world frame; None where none stands.
        instance: (G,) number of the prop of each surface.
    """

    caster: Caster | None
    instance: Int32Array


@dataclass(frozen=True, slots=True, eq=False)
class Grafted:
    """A revolution with props.

    Attributes:
        range_mm, reflectivity, signal: (R, W) as in `ScanChunk`.
        instance: (R, W) int16 as in `sim.session.truth`: 0 for every recorded return.
        reach_m: (R, W) length of each ray from its origin to what it met, metres: as measured of a recorded return, as
            cast of one from a prop; 0 without a return.
        rays: Its rays, world frame.
        n_replaced, n_lost: Number of recorded returns that are gone, and of beams that a prop swallowed.
    """

    range_mm: npt.NDArray[np.uint32]
    reflectivity: npt.NDArray[np.uint8]
    signal: npt.NDArray[np.uint16]
    instance: Int16Array
    reach_m: Float64Array
    rays: Rays
    n_replaced: int = 0
    n_lost: int = 0


def graft_revolution(
    part: Part, revolution: RecordedRevolution, props: Props, noise: RangeNoise | None, seed: int
) -> Grafted:
    """Cast props into a revolution; without props it stays as it is, and no noise is needed.

    Every beam has random numbers of its own, so that another prop changes only the beams that meet it. A beam without
    a recorded return that meets a prop returns from it, but for the share that is lost; one in a column that did not
    arrive does not. Of two returns of a beam those behind the prop give way to one from the prop.
    """
    sensor = part.source.sensor
    rays = revolution_rays(sensor, part.world_T_sensor[revolution.number] @ revolution.sensor_T_column)
    is_return = revolution.range_mm > 0
    reach_m = np.where(is_return, revolution.range_mm / 1000.0 - sensor.beam_origin_m, 0.0)
    instance = np.where(is_return, np.int16(0), np.int16(NO_RETURN))
    channels = revolution.range_mm.copy(), revolution.reflectivity.copy(), revolution.signal.copy()
    if props.caster is None or noise is None:
        return Grafted(*channels, instance, reach_m, rays)
    ranges_m, ids, _ = props.caster.cast_columns(rays.origins, rays.directions)
    hit_m, geom = ranges_m.T, ids.T
    layers = (len(revolution.range_mm) // sensor.height, sensor.height, sensor.width)
    is_behind, row, column = _find_met(is_return.reshape(layers), reach_m.reshape(layers), hit_m)
    if not len(row):
        return Grafted(*channels, instance, reach_m, rays)
    numbers = stream(seed, part.name, "graft", str(revolution.number)).random((3, *layers[1:]))[:, row, column]
    met_m = hit_m[row, column].astype(np.float64)
    is_lost = numbers[0] < noise.lost[find_bins(met_m)]
    is_free = is_behind[0, row, column] | ~is_return[row, column]  # the first return is the one to be written
    target = np.where(is_free, row, row + sensor.height)
    gone = is_behind.reshape(is_return.shape)
    for channel in (*channels, reach_m):
        channel[gone] = 0
    instance[gone] = NO_RETURN
    kept, where = ~is_lost, (target[~is_lost], column[~is_lost])
    measured_m = met_m[kept] + noise.draw(met_m[kept], numbers[1][kept]) + sensor.beam_origin_m
    channels[0][where] = np.maximum(range_channel(measured_m, noise.step_mm), noise.step_mm)
    bright = noise.intensity[find_bins(met_m[kept]), (numbers[2][kept] * noise.intensity.shape[1]).astype(np.int64)]
    channels[1][where], channels[2][where] = bright.T
    instance[where] = props.instance[geom[row, column][kept]]
    reach_m[where] = met_m[kept]
    return Grafted(*channels, instance, reach_m, rays, int(np.count_nonzero(gone)), int(np.count_nonzero(is_lost)))


def _find_met(
    is_return: BoolArray, reach_m: Float64Array, hit_m: Float32Array
) -> tuple[BoolArray, Int64Array, Int64Array]:
    """Return which returns (n, H, W) lie behind a prop, and row and column (M,) of the beams that meet a prop first.

    Args:
        is_return: (n, H, W) where each beam has a return.
        reach_m: (n, H, W) how far away that is.
        hit_m: (H, W) distance to the nearest prop, infinite where there is none.
    """
    is_behind = is_return & (reach_m > hit_m)
    has_arrived = is_return.any(axis=(0, 1))
    is_met = np.isfinite(hit_m) & has_arrived & (is_behind.any(axis=0) | ~is_return.any(axis=0))
    row, column = np.nonzero(is_met)
    return is_behind, row, column
