"""Ray-cast pictures of a scene: material colours, a lamp beside the camera, shadows and ambient occlusion."""

from __future__ import annotations

import zlib

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import Float32Array, Float64Array, stream
from sim.scene import WALL_GEOM, Scene
from sim.sensor.air import AirVolume

COLOURS: dict[str, tuple[float, float, float]] = {
    "rock": (0.50, 0.47, 0.43),
    "wood": (0.60, 0.47, 0.32),
    "paper": (0.70, 0.56, 0.38),
    "plastic": (0.84, 0.36, 0.10),
    "rubber": (0.10, 0.10, 0.11),
    "steel": (0.58, 0.61, 0.65),
    "paint": (0.80, 0.58, 0.10),
    "fabric": (0.80, 0.68, 0.30),
    "reflector": (0.95, 0.93, 0.88),
    "glass": (0.14, 0.19, 0.22),
    "water": (0.10, 0.16, 0.22),
}
_PAINTS = ((0.80, 0.58, 0.10), (0.16, 0.36, 0.62), (0.20, 0.46, 0.28), (0.74, 0.34, 0.10), (0.42, 0.47, 0.52))
_LAMP_M = (1.1, 0.8)  # right of the camera and above it
_LAMP_RADIUS_M = 0.05
_OCCLUSION_RAYS = 4
_OCCLUSION_M = 1.2
_CHUNK = 300_000
_AIR_COLOUR = (0.66, 0.61, 0.54)
_AIR_STEP_M, _AIR_REACH_M = 0.5, 60.0


def render(
    scene: Scene,
    eye: npt.ArrayLike,
    target: npt.ArrayLike,
    width: int = 640,
    height: int = 480,
    field_of_view_deg: float = 70.0,
    samples: int = 1,
    tints: Float64Array | None = None,
    air: AirVolume | None = None,
) -> npt.NDArray[np.uint8]:
    """Return a picture (height, width, 3) of a scene.

    Args:
        scene: The surfaces.
        eye: (3,) camera, world frame, metres.
        target: (3,) point in the middle of the picture.
        width: Pixels across.
        height: Pixels down.
        field_of_view_deg: Horizontal.
        samples: Rays across and down each pixel; more rays smooth edges and shadows.
        tints: (M, 3) linear RGB colour of every face of the walls, NaN for the colour of rock; None for rock alone.
        air: Mist and dust, which dim what lies behind them and shine in the lamp; None for clear air.
    """
    eye_m = np.asarray(eye, dtype=np.float64)
    forward, right, down = _axes(np.asarray(target, dtype=np.float64) - eye_m)
    lamp_m = eye_m + _LAMP_M[0] * right - _LAMP_M[1] * down
    aside_m = float(np.linalg.norm(lamp_m - eye_m))
    free_m = float(scene.caster.cast(eye_m[None], _unit(lamp_m - eye_m)[None])[0][0])
    lamp_m = eye_m + (lamp_m - eye_m) * min(1.0, 0.7 * free_m / aside_m)  # before any rock beside the camera
    half = np.tan(np.deg2rad(field_of_view_deg) / 2)
    across = np.linspace(-half, half, width * samples)[None, :, None]
    along = np.linspace(-half, half, height * samples)[:, None, None] * (height / width)
    directions = _unit((forward + across * right + along * down).reshape(-1, 3))
    colours = part_colours(scene)
    generator = stream(0, "picture")
    chunks = np.split(directions, range(_CHUNK, len(directions), _CHUNK))
    light = np.concatenate([_shaded(scene, eye_m, lamp_m, chunk, colours, generator, tints) for chunk in chunks])
    if air is not None:
        light = np.concatenate(
            [
                _through_air(scene, eye_m, lamp_m, chunk, behind, air)
                for chunk, behind in zip(chunks, np.split(light, range(_CHUNK, len(light), _CHUNK)), strict=True)
            ]
        )
    pixels = light.reshape(height, samples, width, samples, 3).mean(axis=(1, 3))
    return np.asarray(np.clip(pixels, 0.0, 1.0) ** (1 / 2.2) * 255, dtype=np.uint8)


def part_colours(scene: Scene) -> Float64Array:
    """Return a linear RGB colour (G, 3) for every geom."""
    rows = [material_colour(part, material) for part, material in zip(scene.parts, scene.materials, strict=True)]
    return np.array(rows) ** 2.2


def material_colour(part: str, material: str) -> tuple[float, float, float]:
    """Return the colour (red, green, blue, 0 to 1) of a material; painted parts differ by their name."""
    return _PAINTS[zlib.crc32(part.encode()) % len(_PAINTS)] if material == "paint" else COLOURS[material]


def _shaded(
    scene: Scene,
    eye_m: Float64Array,
    lamp_m: Float64Array,
    directions: Float64Array,
    colours: Float64Array,
    generator: np.random.Generator,
    tints: Float64Array | None,
) -> Float64Array:
    """Return the linear light (N, 3) that the camera receives from each direction."""
    ranges_m, geom, normals = scene.caster.hits(eye_m, directions)
    light = np.zeros((len(directions), 3))
    seen = np.flatnonzero(geom >= 0)
    if not len(seen):
        return light
    facing = normals[seen] * -np.sign((normals[seen] * directions[seen]).sum(axis=1))[:, None]
    points = eye_m + ranges_m[seen, None] * directions[seen] + 2e-3 * facing
    to_lamp = lamp_m + _LAMP_RADIUS_M * generator.normal(size=points.shape) - points
    distance_m = np.linalg.norm(to_lamp, axis=1)
    towards = to_lamp / distance_m[:, None]
    is_lit = scene.caster.cast(points, towards)[0] >= distance_m
    lit = np.clip((facing * towards).sum(axis=1), 0.0, None) * is_lit
    lamp = lit / (1.0 + (distance_m / 12.0) ** 2)
    # a little more light from above than from below
    around = _openness(scene, points, facing, generator) * (0.8 + 0.2 * facing[:, 2])
    fog = 1.0 / (1.0 + (distance_m / 25.0) ** 2)
    own = colours[geom[seen]]
    if tints is not None:
        _, geom_again, face = scene.caster.faces(eye_m, directions[seen])
        wall = np.flatnonzero(geom_again == WALL_GEOM)
        tint = tints[face[wall]]
        own[wall] = np.where(np.isfinite(tint), tint, own[wall])
    light[seen] = own * (1.9 * lamp + 0.6 * around**1.4 * fog)[:, None]
    return light


def _through_air(
    scene: Scene,
    eye_m: Float64Array,
    lamp_m: Float64Array,
    directions: Float64Array,
    light: Float64Array,
    air: AirVolume,
) -> Float64Array:
    """Return the light (N, 3) of each direction through the air: Beer-Lambert on the way to the eye, one scattering."""
    ranges_m = np.minimum(scene.caster.cast(eye_m, directions)[0], _AIR_REACH_M)
    left = np.ones(len(directions))
    scattered = np.zeros(len(directions))
    for number in range(int(np.ceil(ranges_m.max(initial=0.0) / _AIR_STEP_M))):
        on_way = np.flatnonzero(ranges_m > number * _AIR_STEP_M)
        length_m = np.minimum(ranges_m[on_way] - number * _AIR_STEP_M, _AIR_STEP_M)
        middle = eye_m + (number * _AIR_STEP_M + length_m / 2)[:, None] * directions[on_way]
        alpha, _ = air.extinction(middle.T.astype(np.float32))
        kept = np.exp(-alpha * length_m)
        lamp = 1.0 / (1.0 + (np.linalg.norm(lamp_m - middle, axis=1) / 12.0) ** 2)
        scattered[on_way] += left[on_way] * (1.0 - kept) * lamp
        left[on_way] *= kept
    return np.asarray(left[:, None] * light + scattered[:, None] * np.array(_AIR_COLOUR) ** 2.2)


def _openness(scene: Scene, points: Float64Array, facing: Float64Array, generator: np.random.Generator) -> Float32Array:
    """Return how open the space in front of each point is (N,): mean ray length over `_OCCLUSION_M`, at most 1."""
    total = np.zeros(len(points), dtype=np.float32)
    for _ in range(_OCCLUSION_RAYS):
        spread = _unit(generator.normal(size=points.shape))
        ranges_m, _, _ = scene.caster.cast(points, _unit(facing + 0.999 * spread))
        total += np.minimum(ranges_m / _OCCLUSION_M, 1.0)
    return total / np.float32(_OCCLUSION_RAYS)


def _axes(forward: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return the unit vectors of a picture: into it, to the right, down."""
    forward = _unit(forward)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.99 else np.array([1.0, 0.0, 0.0])
    right = _unit(np.cross(forward, up))
    return forward, right, np.cross(forward, right)


def _unit(vectors: Float64Array) -> Float64Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
