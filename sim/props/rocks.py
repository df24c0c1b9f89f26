"""Angular rock fragments, and how their sizes are distributed."""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry import Float64Array, Int32Array, stream
from sim.geometry.mesh import Mesh
from sim.props.parts import hull_mesh

# Rosin-Rammler passing share of blasted rock, 1 - exp(-(1.87 D / L)^0.88): at D = L it is 82 %.
_SCALE = 1.87
_EXPONENT = 0.88
_CORNERS = 13
# Standard deviation of a vertex's way along the normal, as a share of the edge that it halves.
_CHIP_SHARE = 0.06


def rosin_rammler(n: int, size_m: float, generator: np.random.Generator) -> Float64Array:
    """Draw fragment sizes.

    Args:
        n: How many.
        size_m: Characteristic size L: 82 % of the fragments are smaller, half of them smaller than 0.35 L.
        generator: Where the randomness comes from.

    Returns:
        (n,) sizes, metres. The law is one of passing mass; here it is read as a share of the number of fragments,
        without which the fines, too small for any ray to meet, would be nearly all that is drawn.
    """
    return np.asarray(size_m / _SCALE * (-np.log1p(-generator.random(n))) ** (1.0 / _EXPONENT))


def passing_share(size_m: Float64Array, characteristic_m: float) -> Float64Array:
    """Return the share (N,) of fragments smaller than each size (N,), metres: the law `rosin_rammler` draws from."""
    return np.asarray(1.0 - np.exp(-((_SCALE * size_m / characteristic_m) ** _EXPONENT)))


def rock_mesh(size_m: tuple[float, float, float], key: int, subdivisions: int = 0) -> Mesh:
    """Build a closed angular fragment that faces outwards.

    Args:
        size_m: Length, width and height; the fragment touches every side of this box, whose middle is the origin.
        key: Which fragment.
        subdivisions: How often every triangle is split into four and its new corners chipped; 0 leaves the convex
            hull of 13 points (22 triangles or fewer), each step takes four times as many.

    Returns:
        The surface; star-shaped about its inside, convex without subdivisions.
    """
    generator = stream(key, "rock")
    # Points between a sphere and a cube, so that faces are large and edges sharp, as joints break blasted rock.
    direction = _scattered_directions(generator)
    points = direction / np.abs(direction).max(axis=1, keepdims=True) ** 0.7
    points *= generator.uniform(0.8, 1.0, (_CORNERS, 1))
    hull = hull_mesh(points)
    points, faces = hull.vertices, hull.faces
    for _ in range(subdivisions):
        points, faces = _chipped(points, faces, generator)
    low, high = points.min(axis=0), points.max(axis=0)
    return Mesh((points - (low + high) / 2) / (high - low) * np.asarray(size_m), faces)


def _scattered_directions(generator: np.random.Generator) -> Float64Array:
    """Draw unit vectors on every side: a Fibonacci lattice, turned and shaken."""
    number = np.arange(_CORNERS) + 0.5
    polar, azimuth = np.arccos(1 - 2 * number / _CORNERS), np.pi * (1 + np.sqrt(5)) * number
    lattice = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1)
    turn, _ = np.linalg.qr(generator.standard_normal((3, 3)))
    shaken = lattice @ turn + 0.25 * generator.standard_normal((_CORNERS, 3))
    return np.asarray(shaken / np.linalg.norm(shaken, axis=1, keepdims=True))


def _chipped(
    points: Float64Array, faces: Int32Array, generator: np.random.Generator
) -> tuple[Float64Array, Int32Array]:
    """Split every triangle into four; new corners leave the middle of their edge a little, in and out."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges, which = np.unique(edges, axis=0, return_inverse=True)
    first, second = points[edges[:, 0]], points[edges[:, 1]]
    middle = (first + second) / 2
    length = np.linalg.norm(second - first, axis=1, keepdims=True)
    outward = middle - points.mean(axis=0)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    middle = middle + outward * length * _CHIP_SHARE * generator.standard_normal((len(edges), 1))
    ab, bc, ca = (len(points) + which.reshape(3, -1)).astype(np.int32)
    a, b, c = faces.T
    split = [np.stack(corners, axis=1) for corners in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.concatenate([points, middle]), np.concatenate(split).astype(np.int32)
