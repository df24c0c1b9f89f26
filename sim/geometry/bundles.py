"""Bundles of rays: several rays over the width of every beam, which is round and widens along its way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cdpipe.core.geometry import Float32Array, Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """Where the rays of a beam lie.

    Attributes:
        places: (n, 2) places across the beam, in radii: to the right and up.
        radius_m: Radius where the beam starts.
        slope: Growth of the radius along the beam, metres per metre.
    """

    places: Float64Array
    radius_m: float
    slope: float

    @property
    def lengths(self) -> Float32Array:
        """(n,) length of each ray's direction before it is made a unit vector."""
        squares = (self.places * self.places).sum(axis=1)
        return np.asarray(np.sqrt(1.0 + squares * self.slope**2), dtype=np.float32)


def make_bundle_rays(
    beam_origins: Float64Array, beam_directions: Float32Array, bundle: Bundle, centre_m: Float64Array
) -> tuple[Float32Array, Float32Array]:
    """Return the origins from a centre, and the directions, of the rays of every beam, both (W * H * n, 3) float32.

    They are computed by component: numpy is slow on rows of three.

    Args:
        beam_origins: (W, 3) point where all beams of a column start, world frame, metres.
        beam_directions: (W, H, 3) unit vectors.
        bundle: The n rays of a beam.
        centre_m: (3,) world.
    """
    directions = np.ascontiguousarray(beam_directions.reshape(-1, 3).T)
    starts = np.repeat(beam_origins.T, beam_directions.shape[1], axis=1)
    right, up = _across(directions)
    x, y = bundle.places.astype(np.float32).T[..., None]
    lengths = bundle.lengths[:, None]
    origins, ways = np.empty((2, directions.shape[1], len(bundle.places), 3), np.float32)
    for axis in range(3):
        aside = right[axis] * x + up[axis] * y
        origins[..., axis] = (starts[axis] + aside * np.float32(bundle.radius_m) - centre_m[axis]).T
        ways[..., axis] = ((aside * np.float32(bundle.slope) + directions[axis]) / lengths).T
    return origins.reshape(-1, 3), ways.reshape(-1, 3)


def _across(directions: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Two unit vectors (3, N) at right angles to each beam (3, N) and to one another, the first one level."""
    x, y, z = directions
    level = np.maximum(np.hypot(x, y), np.float32(1e-6))
    right = np.stack([y / level, -x / level, np.zeros_like(z)])
    return right, np.stack([right[1] * z, right[0] * -z, level])
