"""Muck piles: flanks at the angle of repose, fragments half buried in them, and what a loader leaves.

A pile is a bed, one height for each node of a grid, with closed fragments on it: overlapping closed surfaces, which
rays meet as one. Its volume is what a surveyor measures from above, the columns between floor and surface. Object
frame as in `sim.props.shapes`; a banked pile leans on the plane y = +width/2 and goes on behind it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from cdpipe.core.geometry import Float64Array, stream
from sim.geometry.mesh import Mesh, join_meshes
from sim.geometry.noise import smooth_noise
from sim.geometry.raycast import Caster
from sim.props.bed import BEHIND_M, Bed, bed_mesh, build_bed
from sim.props.rocks import Rubble, confine, draw_sizes, join_rubble, lay_fragments, shift_rubble
from sim.props.shapes import BELOW_FLOOR_M, Shape, Size, shape_mesh, visible_part

_MOST_FRAGMENTS = 900
_COVERAGE = 1.5
_MOST_LOOSE = 14
_MOST_DRAWS = 2_000
# Loose blocks lie where the bed would be this far below the floor: up to half a metre from the foot.
_BESIDE_M = (-0.35, -0.05)
# Where the middle of a fragment lies along the surface's normal, in its sizes: from nearly buried to nearly free.
BURIED = (-0.22, 0.08)
_LOOSE = (0.0, 0.2)
# A fresh face stands steeper than the angle of repose.
_FACE_DEG = (46.0, 57.0)
_STEPS = 16
# How near the share taken comes to the one asked for; a large fragment may be worth more in a small pile.
_CLOSE_SHARE = 0.002
_FACE_COVERAGE = 2.0
_MOST_FACE_FRAGMENTS = 700
# Fragments of the face lie at least this far below the pile's old surface.
_FRESH_BELOW_M = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Heap:
    """A whole pile.

    Attributes:
        bed: The surface on which its fragments lie.
        rubble: Its fragments, and the loose blocks at its foot.
        size_m: Length, width and height above the floor.
        is_banked: Whether it lies against a wall at y = +width/2.
    """

    bed: Bed
    rubble: Rubble
    size_m: Size
    is_banked: bool


def largest_size_m(fragment_m: float, height_m: float) -> float:
    """Return the size of the largest fragment: 94 % of the law's are smaller, and a pile is three of them high."""
    return min(1.6 * fragment_m, height_m / 3)


def build_heap(size_m: Size, repose_deg: float, fragment_m: float, is_banked: bool, seed: int, name: str) -> Heap:
    """Build a pile.

    Args:
        size_m: Length and width of its outline, and its height, which is lowered to what flanks at `repose_deg` reach
            over this outline.
        repose_deg: Angle of the flanks.
        fragment_m: Characteristic size of the fragments; the largest is a third of the height.
        is_banked: Whether its back, at y = +width/2, lies against a wall.
        seed: Of the scenario.
        name: Of the prop; seed and name draw outline, surface and fragments.
    """
    bed = build_bed(size_m, repose_deg, is_banked, seed, name)
    length, width, height = size_m
    generator = stream(seed, "props", name, "fragments")
    largest_m = largest_size_m(fragment_m, height)
    low, high = _limits(size_m, is_banked)
    cell_m2 = float(bed.x[1] - bed.x[0]) * float(bed.y[1] - bed.y[0])
    area_m2 = float((bed.z > 0.0).sum()) * cell_m2
    sizes = draw_sizes(area_m2, _COVERAGE, fragment_m, largest_m, _MOST_FRAGMENTS, generator)
    places = _places(bed, (-0.03, np.inf), low, high, len(sizes), generator)
    pile = lay_fragments(sizes, places, bed.heights, BURIED, generator)
    n_loose = min(_MOST_LOOSE, 3 + int(length + width))
    blocks = largest_m * generator.uniform(0.4, 1.0, n_loose)
    feet = _places(bed, _BESIDE_M, low, np.minimum(high, (np.inf, width / 2, np.inf)), n_loose, generator)
    loose = lay_fragments(blocks, feet, lambda xy: np.zeros(len(xy)), _LOOSE, generator)
    rubble = confine(join_rubble(pile, loose), low, high)
    return _centre(Heap(bed, rubble, size_m, is_banked))


def whole_mesh(heap: Heap) -> Mesh:
    """Return the surface of a pile: a closed bed and closed fragments, all facing outwards."""
    return join_meshes([bed_mesh(heap.bed), heap.rubble.surface()])


def column_volume_m3(mesh: Mesh, size_m: Size, columns: int = 60_000) -> float:
    """Return the volume between the floor and a surface seen from above, over the footprint of `size_m`."""
    heights, _, area_m2 = _columns(mesh, size_m, 0.0, columns)
    return float(np.maximum(heights, 0.0).sum() * area_m2)


def flank_angle_deg(shape: Shape) -> float:
    """Return the mean slope of a pile's flanks, measured on its finished surface, degrees.

    Heights from above, smoothed over a twelfth of the pile's height so that fragments do not count as slope; mean of
    the slope's angle where they lie between a fifth and six tenths of the pile's height.
    """
    _, width, height = shape.size_m
    smooth_m = 0.08 * height
    heights, y, area_m2 = _columns(shape_mesh(shape), shape.size_m, 0.3, 60_000)
    step_m = float(np.sqrt(area_m2))
    smooth = gaussian_filter(heights, smooth_m / step_m)
    slope = np.hypot(*np.gradient(smooth, step_m))
    # Behind the plane of a banked pile there is no flank.
    is_flank = (smooth > 0.2 * height) & (smooth < 0.6 * height) & (y < width / 2 - 2 * smooth_m)
    return float(np.rad2deg(np.arctan(slope[is_flank])).mean())


def _columns(mesh: Mesh, size_m: Size, margin_m: float, count: int) -> tuple[Float64Array, Float64Array, float]:
    """Heights from above over the footprint and a margin, y of each column, and the area of one."""
    half = np.array(size_m[:2]) / 2 + margin_m
    numbers = np.ceil(2 * half / np.sqrt(4 * half.prod() / count)).astype(int)
    axes = [(np.arange(number) + 0.5) / number * 2 * side - side for number, side in zip(numbers, half, strict=True)]
    x, y = np.meshgrid(*axes, indexing="ij")
    start_m = float(mesh.vertices[:, 2].max()) + 1.0
    origins = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, start_m)])
    ranges_m, _, _ = Caster([mesh]).cast(origins, (0.0, 0.0, -1.0))
    heights = np.where(np.isfinite(ranges_m), start_m - ranges_m.astype(np.float64), -BELOW_FLOOR_M)
    return heights.reshape(x.shape), y, float(4 * half.prod() / x.size)


def _places(
    bed: Bed,
    range_m: tuple[float, float],
    low: Float64Array,
    high: Float64Array,
    n: int,
    generator: np.random.Generator,
) -> Float64Array:
    """Draw places (n, 2) inside a box where the height of the bed lies in a range.

    Raises:
        ValueError: There is hardly such a place.
    """
    found = np.empty((0, 2))
    for _ in range(_MOST_DRAWS):
        if len(found) >= n:
            break
        drawn = generator.uniform(low[:2], high[:2], (512, 2))
        heights = bed.heights(drawn)
        found = np.concatenate([found, drawn[(heights > range_m[0]) & (heights < range_m[1])]])
    if len(found) < n:
        raise ValueError("it has no room for its blocks")
    return found[:n]


def _limits(size_m: Size, is_banked: bool) -> tuple[Float64Array, Float64Array]:
    """Return the corners (3,) of the box that no fragment leaves."""
    length, width, height = size_m
    low = np.array([-length / 2, -width / 2, -np.inf])
    return low, np.array([length / 2, width / 2 + (BEHIND_M if is_banked else 0.0), height])


def _centre(heap: Heap) -> Heap:
    """Move a pile so that the middle of what is above the floor is at the origin, and measure it."""
    back_m = heap.size_m[1] / 2 if heap.is_banked else np.inf
    seen = visible_part(whole_mesh(heap), back_m).reshape(-1, 3)
    low, high = seen.min(axis=0), seen.max(axis=0)
    middle = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, 0.0])
    bed = replace(heap.bed, x=heap.bed.x - middle[0], y=heap.bed.y - middle[1])
    size_m = (float(high[0] - low[0]), float(high[1] - low[1]), float(high[2]))
    return Heap(bed, shift_rubble(heap.rubble, -middle), size_m, heap.is_banked)


@dataclass(frozen=True, slots=True, eq=False)
class Face:
    """The surface of a bite, which rises into the pile; everything above it is removed.

    Attributes:
        into: (2,) unit vector, level, from the bite into the pile.
        rise: Tangent of the face's angle.
        along_m: Coordinates along the face, level, at which `wander_m` is given.
        wander_m: How far its foot lies off a straight line, metres.
        foot_m: Where that line crosses the floor, along `into` from the origin.
    """

    into: Float64Array
    rise: float
    along_m: Float64Array
    wander_m: Float64Array
    foot_m: float

    def heights(self, xy: Float64Array) -> Float64Array:
        """Return the height of the face at places (N, 2); below the floor where everything is removed."""
        across = xy @ np.array([-self.into[1], self.into[0]])
        return np.asarray(self.rise * (xy @ self.into - self.foot_m - np.interp(across, self.along_m, self.wander_m)))

    def places(self, along_m: Float64Array, height_m: Float64Array) -> Float64Array:
        """Return the places (N, 2) of points on the face, given along it and by their height."""
        ahead = self.foot_m + np.interp(along_m, self.along_m, self.wander_m) + height_m / self.rise
        return np.asarray(ahead[:, None] * self.into + along_m[:, None] * [-self.into[1], self.into[0]])


def load_away(heap: Heap, share: float, fragment_m: float, seed: int, name: str) -> Heap:
    """Remove a share of a pile's volume from one side, never from its back.

    The bed is lowered to the face wherever the face lies below it. A fragment is removed if its centre lies above the
    face; the others stay unchanged. The face gets fragments of its own.

    Args:
        heap: The whole pile.
        share: Of its volume above the floor, between 0 and 1.
        fragment_m: Characteristic size of the fragments.
        seed: Of the scenario.
        name: Of the prop; seed and name draw the side, the face and its fragments.

    Returns:
        What is left. Its length and width are those of the whole pile.
    """
    face = _face(heap, seed, name)
    fresh = _fresh_rubble(heap, face, fragment_m, seed, name)
    whole_m3 = column_volume_m3(whole_mesh(heap), heap.size_m)
    reach_m = float(np.hypot(*heap.size_m[:2]))
    low, high = -reach_m, reach_m
    for _ in range(_STEPS):
        foot_m = (low + high) / 2
        left = _bite(heap, replace(face, foot_m=foot_m), fresh)
        excess = column_volume_m3(whole_mesh(left), heap.size_m) / whole_m3 - (1.0 - share)
        if abs(excess) < _CLOSE_SHARE:
            break
        low, high = (foot_m, high) if excess > 0 else (low, foot_m)
    return left


def _face(heap: Heap, seed: int, name: str) -> Face:
    length, width, _ = heap.size_m
    generator = stream(seed, "props", name, "bite")
    quarters = 3 if heap.is_banked else 4  # from either end, from the front, or from behind
    heading = np.deg2rad((0.0, 180.0, 90.0, -90.0)[generator.integers(quarters)] + generator.uniform(-20.0, 20.0))
    rise = float(np.tan(np.deg2rad(generator.uniform(*_FACE_DEG))))
    reach_m = length + width
    along_m = np.arange(-reach_m, reach_m, 0.05)
    wander = smooth_noise((along_m,), 0.4 * min(length, width), int(generator.integers(2**31)))
    wander_m = 0.05 * min(length, width) * np.clip(wander, -2, 2)
    return Face(np.array([np.cos(heading), np.sin(heading)]), rise, along_m, wander_m, 0.0)


def _fresh_rubble(heap: Heap, face: Face, fragment_m: float, seed: int, name: str) -> Rubble:
    """Lay the fragments of a face whose foot goes through the origin, as far as any face of this pile reaches."""
    generator = stream(seed, "props", name, "face")
    reach_m, height = float(np.hypot(*heap.size_m[:2])) / 2, heap.size_m[2]
    plan_m2 = 2 * reach_m * height / face.rise
    sizes = draw_sizes(
        plan_m2, _FACE_COVERAGE, fragment_m, largest_size_m(fragment_m, height), _MOST_FACE_FRAGMENTS, generator
    )
    along_m = generator.uniform(-reach_m, reach_m, len(sizes))
    xy = face.places(along_m, generator.uniform(0.0, height, len(sizes)))
    return lay_fragments(sizes, xy, face.heights, BURIED, generator)


def _bite(heap: Heap, face: Face, fresh: Rubble) -> Heap:
    bed = heap.bed
    nodes = np.stack(np.meshgrid(bed.x, bed.y, indexing="ij"), axis=-1)
    face_z = face.heights(nodes.reshape(-1, 2)).reshape(bed.z.shape)
    left = replace(bed, z=np.minimum(bed.z, np.maximum(face_z, -BELOW_FLOOR_M)))
    old = heap.rubble
    old = old.kept(old.centres[:, 2] < face.heights(old.centres[:, :2]))
    shift = np.append(face.foot_m * face.into, 0.0)
    is_cut = bed.heights(fresh.centres[:, :2] + shift[:2]) > fresh.centres[:, 2] + _FRESH_BELOW_M
    new = confine(shift_rubble(fresh.kept(is_cut), shift), *_limits(heap.size_m, heap.is_banked))
    return replace(heap, bed=left, rubble=join_rubble(old, new))
