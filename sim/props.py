"""The things that stand in a tunnel, built from boxes and cylinders, and the heap of a muck pile.

Object frame: origin on the floor in the middle of the footprint, x along the length, y across, z up.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from cdpipe.geometry import Float64Array, Int32Array, make_pose, stream
from scenarios.schema import Prop
from sim.mesh import Mesh, box_mesh, cylinder_mesh, moved
from sim.noise import smooth_noise

# Angle of repose of blasted rock, 34-40 degrees with 37 typical.
REPOSE_DEG = 37.0
# Posts of a railing and the foot of a heap go this far below the floor's level, so that no gap opens on rough floor.
BELOW_FLOOR_M = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """One primitive of a prop, in the object frame.

    Attributes:
        kind: "box" (half edges), "cylinder" (radius, half height, unused; along its own z) or "mesh".
        size_m: (3,) as the kind says; zeros for a mesh.
        object_T_solid: (4, 4) pose.
        mesh: The surface of a "mesh".
    """

    kind: str
    size_m: tuple[float, float, float]
    object_T_solid: Float64Array
    mesh: Mesh | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """What a prop is made of.

    Attributes:
        solids: Its primitives.
        is_settled: Whether physics drops it on the floor; heaps and railings are set into the floor instead.
        hull_volume_m3: Volume of the convex hull of what is above the floor.
    """

    solids: tuple[Solid, ...]
    is_settled: bool
    hull_volume_m3: float


def shape_of(prop: Prop, seed: int) -> Shape:
    """Return the shape of a prop; the seed draws the surface of a heap."""
    if prop.kind == "muck_pile":
        heap = _heap(prop.size_m, zlib.crc32(prop.name.encode()) ^ int(stream(seed, "props", "heap").integers(2**31)))
        solids: tuple[Solid, ...] = (Solid("mesh", (0.0, 0.0, 0.0), np.eye(4), heap),)
    else:
        solids = _BUILDERS[prop.kind](*prop.size_m)
    corners = np.concatenate([solid_mesh(solid).vertices for solid in solids])
    above = corners[corners[:, 2] >= 0.0]
    return Shape(solids, prop.kind not in ("muck_pile", "railing"), float(ConvexHull(above).volume))


def solid_mesh(solid: Solid) -> Mesh:
    """Return a primitive's surface in the object frame."""
    if solid.mesh is not None:
        return moved(solid.mesh, solid.object_T_solid)
    local = box_mesh(solid.size_m) if solid.kind == "box" else cylinder_mesh(solid.size_m[0], solid.size_m[1], 32)
    return moved(local, solid.object_T_solid)


def footprint(size_m: tuple[float, float, float]) -> Float64Array:
    """Return the four corners (4, 2) of a prop's bounding rectangle, object frame, counter-clockwise."""
    half = np.array([size_m[0], size_m[1]]) / 2
    return np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half


def _block(low: tuple[float, float, float], high: tuple[float, float, float]) -> Solid:
    """Axis-aligned box between two corners."""
    low_m, high_m = np.array(low), np.array(high)
    half = (high_m - low_m) / 2
    return Solid("box", (float(half[0]), float(half[1]), float(half[2])), make_pose(translation=(low_m + high_m) / 2))


def _rod(start: tuple[float, float, float], end: tuple[float, float, float], radius: float) -> Solid:
    """Cylinder between two points."""
    a, b = np.array(start), np.array(end)
    axis = (b - a) / np.linalg.norm(b - a)
    helper = np.array([1.0, 0.0, 0.0]) if abs(axis[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    side = np.cross(helper, axis)
    side /= np.linalg.norm(side)
    rotation = np.stack([side, np.cross(axis, side), axis], axis=1)
    return Solid("cylinder", (radius, float(np.linalg.norm(b - a)) / 2, 0.0), make_pose(rotation, (a + b) / 2))


def _box(length: float, width: float, height: float) -> tuple[Solid, ...]:
    return (_block((-length / 2, -width / 2, 0), (length / 2, width / 2, height)),)


def _barrel(length: float, width: float, height: float) -> tuple[Solid, ...]:
    radius = min(length, width) / 2
    rings = [_rod((0, 0, height * z - 0.015), (0, 0, height * z + 0.015), radius) for z in (1 / 3, 2 / 3)]
    return (_rod((0, 0, 0), (0, 0, height), 0.97 * radius), *rings)


def _chair(length: float, width: float, height: float) -> tuple[Solid, ...]:
    """Build four legs, a seat at half height and a back at the rear (-x)."""
    x, y, seat = length / 2, width / 2, 0.5 * height
    leg = min(0.05, 0.15 * min(length, width))
    legs = [
        _block((cx - leg / 2, cy - leg / 2, 0), (cx + leg / 2, cy + leg / 2, seat))
        for cx in (leg / 2 - x, x - leg / 2)
        for cy in (leg / 2 - y, y - leg / 2)
    ]
    plate = _block((-x, -y, seat), (x, y, seat + 0.04))
    posts = [_block((-x, side, seat), (leg - x, side + leg, height)) for side in (-y, y - leg)]
    back = _block((-x, -y, seat + 0.4 * (height - seat)), (0.03 - x, y, height))
    return (*legs, plate, *posts, back)


def _trolley(length: float, width: float, height: float) -> tuple[Solid, ...]:
    """Build a hand trolley standing upright: platform in front, two wheels and a frame with a handle at the rear."""
    x, y = length / 2, width / 2
    wheel = min(0.28 * length, 0.16 * height)
    axle = wheel - x
    tread = 0.12 * width
    wheels = [_rod((axle, side, wheel), (axle, side + tread, wheel), wheel) for side in (-y, y - tread)]
    inner = y - tread - 0.02
    rear = axle + 0.02
    tube = min(0.018, 0.05 * width)
    platform = _block((rear, -inner, 0.0), (x, inner, 0.03))
    rails = [_rod((rear, side, 0.03), (rear, side, height - tube), tube) for side in (tube - inner, inner - tube)]
    rungs = [_rod((rear, -inner, z * height), (rear, inner, z * height), tube) for z in (0.35, 0.6)]
    handle = _rod((rear, -inner, height - tube), (rear, inner, height - tube), tube)
    shaft = _rod((axle, -y, wheel), (axle, y, wheel), tube)
    return (*wheels, shaft, platform, *rails, *rungs, handle)


def _railing(length: float, width: float, height: float) -> tuple[Solid, ...]:
    """Build posts set into the floor, at most 1.5 m apart, with three rails."""
    x = length / 2
    post, rail = min(0.03, width / 2), min(0.024, width / 2)
    foot = max(post, width / 2)
    places = np.linspace(foot - x, x - foot, max(2, int(np.ceil(length / 1.5)) + 1)).tolist()
    posts = [_rod((place, 0, -BELOW_FLOOR_M), (place, 0, height), post) for place in places]
    rails = [_rod((-x, 0, z), (x, 0, z), rail) for z in (0.2 * height, 0.6 * height, height - rail)]
    plates = [_block((place - width / 2, -width / 2, 0), (place + width / 2, width / 2, 0.02)) for place in places]
    return (*posts, *rails, *plates)


def _heap(size_m: tuple[float, float, float], key: int) -> Mesh:
    """Build a heap with flanks at the angle of repose (steeper only if its height asks for it) and a rough surface.

    A polar grid: the flank goes on below the floor at the same slope and is closed by a flat bottom.
    """
    length, width, height = size_m
    half = min(length, width) / 2
    slope = max(np.tan(np.deg2rad(REPOSE_DEG)), 1.15 * height / half)
    rings = max(12, int(np.ceil(half / 0.12)))
    sectors = 2 * max(24, int(np.pi * (length + width) / 4 / 0.12))
    outer = 1.0 + BELOW_FLOOR_M / (slope * half)
    radius = np.linspace(0.0, outer, rings + 1)[1:, None]
    angle = (np.arange(sectors) * (2 * np.pi / sectors))[None, :]
    shape = np.broadcast_to(radius * np.cos(angle), (rings, sectors)), radius * np.sin(angle)
    # The outline wanders by a tenth; the noise is taken on a circle so that it closes.
    outline = _on_plane(0.8 * np.cos(angle), 0.8 * np.sin(angle), 0.6, key + 1)
    x, y = ((1.0 + 0.06 * np.clip(outline, -2, 2)) * part for part in shape)
    x, y = x * length / 2, y * width / 2
    smooth = _flank(radius, half, slope, height) + 0.0 * angle
    rough = 0.05 * height * _on_plane(x, y, 0.25 * half + 0.3, key + 2) + 0.035 * _on_plane(x, y, 0.15, key + 3)
    z = smooth + np.clip(rough, -0.15 * height, 0.15 * height)
    z[-1] = -BELOW_FLOOR_M
    z *= height / z.max()
    top = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    peak = np.array([[0.0, 0.0, z[0].mean()], [0.0, 0.0, z.min()]])
    return Mesh(np.concatenate([top, peak]), _polar_faces(rings, sectors))


def _flank(radius: Float64Array, half: float, slope: float, height: float) -> Float64Array:
    """Height over the relative radius: a slope to the edge under a rounded top (smooth minimum of slope and height)."""
    line = slope * half * (1.0 - radius)
    soft = 0.15 * height
    return np.asarray(-soft * np.logaddexp(-line / soft, -height / soft))


def _on_plane(x: Float64Array, y: Float64Array, length_m: float, key: int) -> Float64Array:
    """Smooth noise at scattered places, interpolated from a grid a sixth of its length fine."""
    step = length_m / 6
    axes = [np.arange(values.min() - step, values.max() + 3 * step, step) for values in (x, y)]
    grid = smooth_noise((axes[0], axes[1]), length_m, key)
    px, py = (x - axes[0][0]) / step, (y - axes[1][0]) / step
    ix, iy = px.astype(int), py.astype(int)
    fx, fy = px - ix, py - iy
    low = grid[ix, iy] * (1 - fx) + grid[ix + 1, iy] * fx
    high = grid[ix, iy + 1] * (1 - fx) + grid[ix + 1, iy + 1] * fx
    return np.asarray(low * (1 - fy) + high * fy)


def _polar_faces(rings: int, sectors: int) -> Int32Array:
    ring, i = np.meshgrid(np.arange(rings - 1), np.arange(sectors), indexing="ij")
    j = (i + 1) % sectors
    a, b = ring * sectors + i, (ring + 1) * sectors + i
    c, d = (ring + 1) * sectors + j, ring * sectors + j
    sides = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)]).reshape(-1, 3)
    near, far = np.arange(sectors), (np.arange(sectors) + 1) % sectors
    last, top, bottom = (rings - 1) * sectors, rings * sectors, rings * sectors + 1
    cap = np.stack([np.full(sectors, top), near, far], axis=1)
    base = np.stack([np.full(sectors, bottom), last + far, last + near], axis=1)
    return np.concatenate([sides, cap, base]).astype(np.int32)


_BUILDERS: dict[str, Callable[[float, float, float], tuple[Solid, ...]]] = {
    "box": _box,
    "barrel": _barrel,
    "chair": _chair,
    "trolley": _trolley,
    "railing": _railing,
}
