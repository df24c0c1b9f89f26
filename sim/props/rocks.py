"""Angular rock fragments, how their sizes are distributed, and how they lie half buried on a pile."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import BoolArray, Float64Array, Int32Array, Int64Array, stream
from sim.geometry.mesh import Mesh
from sim.props.parts import hull_mesh

# Rosin-Rammler passing share of blasted rock, 1 - exp(-(1.87 D / L)^0.88): at D = L it is 82 %.
_SCALE = 1.87
_EXPONENT = 0.88
_CORNERS = 13
# Standard deviation of a vertex's way along the normal, as a share of the edge that it halves.
_CHIP_SHARE = 0.06
# Smaller fragments are left out: the rings of the sensor lie 9 cm apart at 4 m.
_SMALLEST_M = 0.05
_TEMPLATES = 24
# Area in plan of a fragment, as a share of the square of its size.
_PLAN_SHARE = 0.5
_MOST_ROUNDS, _ROUND = 2000, 256  # of draws; a wide and flat pile would need millions of its small fragments

Heights = Callable[[Float64Array], Float64Array]


def rosin_rammler(n: int, size_m: float, generator: np.random.Generator) -> Float64Array:
    """Draw fragment sizes.

    Args:
        n: How many.
        size_m: Characteristic size L: 82 % of the fragments are smaller, half of them smaller than 0.35 L.
        generator: Source of the draws.

    Returns:
        (n,) sizes, metres. The law gives passing mass; here its shares are shares of the number of fragments.
        Otherwise nearly all draws would be fines, which are too small for the sensor.
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
        points, faces = _chip(points, faces, generator)
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


def _chip(points: Float64Array, faces: Int32Array, generator: np.random.Generator) -> tuple[Float64Array, Int32Array]:
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


@dataclass(frozen=True, slots=True, eq=False)
class Rubble:
    """Fragments, each a closed surface that faces outwards; a pile has hundreds, so they share their arrays.

    Attributes:
        vertices: (V, 3) corners, fragment by fragment, metres.
        faces: (F, 3) int32, fragment by fragment, numbered from the first corner of their own fragment.
        n_vertices, n_faces: (N,) number of corners and faces of each fragment.
        centres: (N, 3) middle of each, metres.
    """

    vertices: Float64Array
    faces: Int32Array
    n_vertices: Int64Array
    n_faces: Int64Array
    centres: Float64Array

    @property
    def starts(self) -> Int64Array:
        """(N,) number of the first corner of each fragment."""
        return np.cumsum(self.n_vertices) - self.n_vertices

    @property
    def fragments(self) -> tuple[Mesh, ...]:
        """The fragments one by one."""
        corners, faces = np.cumsum(self.n_vertices)[:-1], np.cumsum(self.n_faces)[:-1]
        return tuple(map(Mesh, np.split(self.vertices, corners), np.split(self.faces, faces))) if len(self) else ()

    def __len__(self) -> int:
        """Return the number of fragments."""
        return len(self.centres)

    def surface(self) -> Mesh:
        """Return all fragments as one mesh."""
        starts = np.repeat(self.starts, self.n_faces)
        return Mesh(self.vertices, (self.faces + starts[:, None]).astype(np.int32))

    def kept(self, is_kept: BoolArray) -> Rubble:
        """Return the fragments marked (N,)."""
        vertices = self.vertices[np.repeat(is_kept, self.n_vertices)]
        faces = self.faces[np.repeat(is_kept, self.n_faces)]
        return Rubble(vertices, faces, self.n_vertices[is_kept], self.n_faces[is_kept], self.centres[is_kept])


def draw_sizes(
    plan_m2: float, coverage: float, fragment_m: float, largest_m: float, most: int, generator: np.random.Generator
) -> Float64Array:
    """Draw the sizes of fragments that cover a share of an area, at most the `most` largest.

    Args:
        plan_m2: Area to be covered, seen from above.
        coverage: Sum of the fragments' areas over it; above 1 they overlap.
        fragment_m: Characteristic size of the Rosin-Rammler law.
        largest_m: Larger ones are not drawn.
        most: How many at most.
        generator: Source of the draws.

    Returns:
        Sizes from the largest to the smallest, metres; none below 5 cm, or half the largest of a low pile. They cover
        less where half a million draws do not do.
    """
    smallest_m = min(_SMALLEST_M, 0.5 * fragment_m)
    if smallest_m >= largest_m:  # a low pile has only fines
        smallest_m = 0.5 * largest_m
    sizes = np.empty(0)
    for _ in range(_MOST_ROUNDS):
        if _PLAN_SHARE * np.square(sizes).sum() >= coverage * plan_m2:
            break
        drawn = rosin_rammler(_ROUND, fragment_m, generator)
        sizes = np.concatenate([sizes, drawn[(drawn >= smallest_m) & (drawn <= largest_m)]])
    enough = int(np.searchsorted(_PLAN_SHARE * np.cumsum(np.square(sizes)), coverage * plan_m2)) + 1
    return np.asarray(np.sort(sizes[:enough])[::-1][:most])


def lay_fragments(
    sizes_m: Float64Array,
    xy: Float64Array,
    heights: Heights,
    buried: tuple[float, float],
    generator: np.random.Generator,
) -> Rubble:
    """Lay fragments on a surface.

    Args:
        sizes_m: (N,) longest side of each.
        xy: (N, 2) where they lie.
        heights: The surface.
        buried: Range of their centres along the normal of the surface, in multiples of their size.
        generator: Source of the draws.
    """
    n = len(sizes_m)
    keys = generator.integers(2**31, size=_TEMPLATES)
    shares = np.sort(generator.uniform(0.5, 1.0, (_TEMPLATES, 2)), axis=1)
    templates = [rock_mesh((1.0, float(b), float(a)), int(key)) for key, (a, b) in zip(keys, shares, strict=True)]
    turns = Rotation.from_quat(generator.standard_normal((n, 4))).as_matrix()
    which = generator.integers(_TEMPLATES, size=n)
    depth = generator.uniform(*buried, n) * sizes_m
    centres = np.column_stack([xy, heights(xy)]) + depth[:, None] * _normals(xy, heights)
    vertices = [
        templates[pick].vertices @ (size * turn).T + centre
        for pick, size, turn, centre in zip(which, sizes_m, turns, centres, strict=True)
    ]
    faces = [templates[pick].faces for pick in which]
    n_vertices, n_faces = (np.array([len(each) for each in part], np.int64) for part in (vertices, faces))
    none = np.empty((0, 3))
    return Rubble(
        np.concatenate([none, *vertices]),
        np.concatenate([none.astype(np.int32), *faces]),
        n_vertices,
        n_faces,
        centres,
    )


def confine(rubble: Rubble, low: Float64Array, high: Float64Array) -> Rubble:
    """Move every fragment that reaches out of a box, from corner (3,) to corner (3,), infinite or not, back into it."""
    if not len(rubble):
        return rubble
    lowest, highest = (part.reduceat(rubble.vertices, rubble.starts, axis=0) for part in (np.minimum, np.maximum))
    return shift_rubble(rubble, np.maximum(low - lowest, 0) - np.maximum(highest - high, 0))


def shift_rubble(rubble: Rubble, shift_m: Float64Array) -> Rubble:
    """Return the fragments shifted by one vector (3,), or by one each (N, 3)."""
    shifts_m = np.broadcast_to(shift_m, rubble.centres.shape)
    vertices = rubble.vertices + np.repeat(shifts_m, rubble.n_vertices, axis=0)
    return replace(rubble, vertices=vertices, centres=rubble.centres + shifts_m)


def join_rubble(first: Rubble, second: Rubble) -> Rubble:
    """Return the fragments of both."""
    return Rubble(*(np.concatenate([getattr(first, each.name), getattr(second, each.name)]) for each in fields(Rubble)))


def _normals(xy: Float64Array, heights: Heights, step_m: float = 0.1) -> Float64Array:
    slope = [(heights(xy + step) - heights(xy - step)) / (2 * step_m) for step in ((step_m, 0.0), (0.0, step_m))]
    normals = np.column_stack([-slope[0], -slope[1], np.ones(len(xy))])
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))
