"""Pictures of a scene: ray-cast, shaded by the angle to a lamp at the camera."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import numpy.typing as npt

from cdpipe.geometry import Float64Array
from sim.scene import Scene

_ROCK_RGB = (0.55, 0.52, 0.48)
_PROP_RGB = (0.86, 0.47, 0.16)
_HIGHLIGHT_RGB = (0.85, 0.12, 0.12)


def render(
    scene: Scene,
    eye: npt.ArrayLike,
    target: npt.ArrayLike,
    width: int = 640,
    height: int = 480,
    field_of_view_deg: float = 70.0,
    highlight: Collection[int] = (),
) -> npt.NDArray[np.uint8]:
    """Return a picture (height, width, 3) of a scene.

    Args:
        scene: What is there.
        eye: (3,) camera, world frame, metres.
        target: (3,) what it looks at.
        width: Pixels across.
        height: Pixels down.
        field_of_view_deg: Horizontal.
        highlight: Instance numbers to be drawn red.
    """
    eye_m = np.asarray(eye, dtype=np.float64)
    directions = _pixel_rays(np.asarray(target, dtype=np.float64) - eye_m, width, height, field_of_view_deg)
    ranges_m, geom, normals = scene.caster.hits(np.broadcast_to(eye_m, directions.shape), directions)
    lit = np.abs((normals * directions).sum(axis=1))
    # A second light from above keeps level and upright faces apart.
    above = np.clip(normals[:, 2] * -np.sign((normals * directions).sum(axis=1)), 0.0, 1.0)
    fog = np.exp(-np.where(np.isfinite(ranges_m), ranges_m, 1e3) / 60.0)
    shade = (0.12 + 0.63 * lit + 0.25 * above) * fog
    owner = np.where(geom >= 0, scene.instance[geom], 0)
    colour = np.where((owner > 0)[:, None], _PROP_RGB, _ROCK_RGB)
    colour = np.where(np.isin(owner, sorted(highlight))[:, None], _HIGHLIGHT_RGB, colour)
    pixels = np.clip(colour * shade[:, None], 0.0, 1.0) ** (1 / 1.6)
    return np.asarray(pixels.reshape(height, width, 3) * 255, dtype=np.uint8)


def _pixel_rays(forward: Float64Array, width: int, height: int, field_of_view_deg: float) -> Float64Array:
    forward = forward / np.linalg.norm(forward)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.99 else np.array([1.0, 0.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    half = np.tan(np.deg2rad(field_of_view_deg) / 2)
    across = np.linspace(-half, half, width)[None, :, None]
    along = np.linspace(-half, half, height)[:, None, None] * (height / width)
    rays = (forward + across * right + along * down).reshape(-1, 3)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
