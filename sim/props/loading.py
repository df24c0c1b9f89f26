"""What a loader leaves of a muck pile: a bite from one side, with a fresh face."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cdpipe.core.geometry import Float64Array, stream
from sim.geometry.noise import smooth_noise
from sim.props.heap import BURIED, Heap, column_volume_m3, largest_size_m, whole_mesh
from sim.props.rubble import Rubble, confined, draw_sizes, lay, moved_by, together
from sim.props.shapes import BELOW_FLOOR_M

# A fresh face stands steeper than the angle of repose.
_FACE_DEG = (46.0, 57.0)
_STEPS = 16
# How near the share taken comes to the one asked for; a large fragment may be worth more in a small pile.
_CLOSE_SHARE = 0.002
_COVERAGE = 2.0
_MOST_FRAGMENTS = 700
# Fragments of the face lie at least this far below the pile's old surface.
_FRESH_BELOW_M = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Face:
    """The surface of a bite, which rises into the pile; what lies above it is taken.

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
        """Return the height of the face at places (N, 2); below the floor where all is taken."""
        across = xy @ np.array([-self.into[1], self.into[0]])
        return np.asarray(self.rise * (xy @ self.into - self.foot_m - np.interp(across, self.along_m, self.wander_m)))

    def places(self, along_m: Float64Array, height_m: Float64Array) -> Float64Array:
        """Return the places (N, 2) of points on the face, given along it and by their height."""
        ahead = self.foot_m + np.interp(along_m, self.along_m, self.wander_m) + height_m / self.rise
        return np.asarray(ahead[:, None] * self.into + along_m[:, None] * [-self.into[1], self.into[0]])


def load_away(heap: Heap, share: float, fragment_m: float, seed: int, name: str) -> Heap:
    """Take a share of a pile's volume from one side, never from its back.

    The face meets the bed where it lies below it, and the bed keeps its heights everywhere else; a fragment goes if
    its middle lies above the face; the others stay as they are. The face gets fragments of its own.

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
        left = _bitten(heap, replace(face, foot_m=foot_m), fresh)
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
    sizes = draw_sizes(plan_m2, _COVERAGE, fragment_m, largest_size_m(fragment_m, height), _MOST_FRAGMENTS, generator)
    along_m = generator.uniform(-reach_m, reach_m, len(sizes))
    xy = face.places(along_m, generator.uniform(0.0, height, len(sizes)))
    return lay(sizes, xy, face.heights, BURIED, generator)


def _bitten(heap: Heap, face: Face, fresh: Rubble) -> Heap:
    bed = heap.bed
    nodes = np.stack(np.meshgrid(bed.x, bed.y, indexing="ij"), axis=-1)
    face_z = face.heights(nodes.reshape(-1, 2)).reshape(bed.z.shape)
    left = replace(bed, z=np.minimum(bed.z, np.maximum(face_z, -BELOW_FLOOR_M)))
    old = heap.rubble
    old = old.kept(old.centres[:, 2] < face.heights(old.centres[:, :2]))
    shift = np.append(face.foot_m * face.into, 0.0)
    is_cut = bed.heights(fresh.centres[:, :2] + shift[:2]) > fresh.centres[:, 2] + _FRESH_BELOW_M
    new = confined(moved_by(fresh.kept(is_cut), shift), *heap.limits())
    return replace(heap, bed=left, rubble=together(old, new))
