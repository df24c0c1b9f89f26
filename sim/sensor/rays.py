"""The rays of one revolution: an Ouster beam table carried along by a pose per column."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from cdpipe.core.geometry import Float32Array, Float64Array, Int64Array
from cdpipe.sensor.ouster import SensorMetadata


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """The rays of one revolution, world frame.

    Attributes:
        origins: (W, 3) float64 point where all beams of a column leave the head, metres.
        directions: (W, H, 3) float32 unit vectors; 120 m away they are exact to 0.03 mm.
    """

    origins: Float64Array
    directions: Float32Array

    def points(self, row: Int64Array, column: Int64Array, reach_m: Float32Array | Float64Array) -> Float64Array:
        """Return the world points (N, 3) at some distances (N,) along the rays of some pixels."""
        return np.asarray(self.origins[column] + reach_m[:, None].astype(np.float64) * self.directions[column, row])


def revolution_rays(sensor: SensorMetadata, world_T_column: Float64Array) -> Rays:
    """Return the rays of a revolution whose columns have poses (W, 4, 4)."""
    rotations, positions = world_T_column[:, :3, :3], world_T_column[:, :3, 3]
    ring = sensor.origins[0]  # the same for every beam of a column
    # Written out by component, here and below: no library may split the sums differently from run to run.
    origins = positions + sum(rotations[:, :, axis] * ring[:, axis, None] for axis in range(3))
    return Rays(origins, rotate_directions(rotations, direction_parts(sensor)))


@lru_cache(maxsize=4)
def direction_parts(sensor: SensorMetadata) -> Float32Array:
    """Return a sensor's beam directions as (3, W, H) float32 components, as `rotate_directions` takes them."""
    return np.ascontiguousarray(sensor.directions.transpose(2, 1, 0), dtype=np.float32)


def rotate_directions(rotations: Float64Array, parts: Float32Array) -> Float32Array:
    """Turn the vectors of each column by that column's rotation.

    Args:
        rotations: (W, 3, 3), one for each column.
        parts: (3, W, H) float32 x, y and z components.

    Returns:
        (W, H, 3) float32.
    """
    coefficients = rotations.astype(np.float32)[..., None]
    out = np.empty((*parts.shape[1:], 3), dtype=np.float32)
    for row in range(3):
        total = parts[0] * coefficients[:, row, 0]
        total += parts[1] * coefficients[:, row, 1]
        total += parts[2] * coefficients[:, row, 2]
        out[..., row] = total
    return out
