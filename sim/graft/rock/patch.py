"""A patch of recorded rock and where it moves: both surfaces on one topology, exact displacement between them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, invert, transform
from scenarios.grafted import RockChange
from sim.displacement.displace import MOVED_M
from sim.displacement.measure import SignedDistance
from sim.displacement.refine import TwinWalls, swept_volume_m3
from sim.displacement.zone import window
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster
from sim.graft.rock.heights import Heights
from sim.session.surface import measure_faces
from sim.session.truth import SurfaceChangeTruth

MARGIN_M = 0.5  # of rock that stays around a change, which rays are cast at too
EDGE_M = 0.06  # over which the thickness of shotcrete runs out, as in a simulated world
_STEP_M = 0.05
_STILL_M = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """One rock change of a recording, at its place.

    The frame `patch` has its origin in the middle of the change, z along the normal into the void, x along the length.

    Attributes:
        number: 1-based, in the order of the scenario.
        change: What the scenario says.
        world_T_patch: (4, 4) its pose.
        heights: The smooth surface through the returns of both sessions, frame `patch`.
        tolerance_m: A return this near to the surface lies on the rock.
        walls: That surface and the moved one, frame `patch`.
    """

    number: int
    change: RockChange
    world_T_patch: Float64Array
    heights: Heights
    tolerance_m: float
    walls: TwinWalls
    label: BoolArray = field(init=False)  # (M,) faces of which a corner moves by more than 1 mm
    is_moved: BoolArray = field(init=False)  # (M,) faces of which a corner moves at all
    casters: tuple[Caster, Caster] = field(init=False)  # of the surface before, and after
    bump: Caster = field(init=False)  # of the faces that moved, after
    distances: tuple[SignedDistance, SignedDistance] = field(init=False)  # to the surface before, and after

    def __post_init__(self) -> None:
        moved_m = np.linalg.norm(self.walls.after - self.walls.before, axis=1)[self.walls.faces].max(axis=1)
        meshes = self.walls.mesh("before"), self.walls.mesh("after")
        object.__setattr__(self, "label", moved_m > MOVED_M)
        object.__setattr__(self, "is_moved", moved_m > _STILL_M)
        object.__setattr__(self, "casters", tuple(Caster([mesh]) for mesh in meshes))
        object.__setattr__(self, "bump", Caster([Mesh(meshes[1].vertices, meshes[1].faces[moved_m > _STILL_M])]))
        object.__setattr__(self, "distances", tuple(SignedDistance(mesh) for mesh in meshes))

    @property
    def half_m(self) -> tuple[float, float]:
        """Half of length and width."""
        length_m, width_m = self.change.sides_m
        return length_m / 2, width_m / 2

    @property
    def radius_m(self) -> float:
        """Radius of a ball about the middle of the change that holds both surfaces."""
        every = np.concatenate([self.walls.before, self.walls.after])
        return float(np.linalg.norm(every, axis=1).max())

    def measure_before(self, places: Float64Array) -> Float64Array:
        """Return the displacement (N,) at places (N, 3) of the before surface, frame `patch`: after minus before."""
        return -self.distances[1].measure(places)

    def measure_after(self, places: Float64Array) -> Float64Array:
        """Return the displacement (N,) at places (N, 3) of the after surface, frame `patch`: after minus before."""
        return self.distances[0].measure(places)

    def describe(self) -> SurfaceChangeTruth:
        """Return what the change amounts to, measured on the before surface."""
        faces = np.flatnonzero(self.label)
        wall = self.walls.mesh("before")
        told = measure_faces(wall, faces, lambda places, _: self.measure_before(places))
        told["centre_world"] = transform(self.world_T_patch, np.array([told["centre_world"]]))[0].tolist()
        volume_m3 = swept_volume_m3(self.walls, np.arange(len(self.walls.faces)))
        name, kind = self.change.name, self.change.kind
        return SurfaceChangeTruth(id=self.number, name=name, kind=kind, partner=None, volume_m3=volume_m3, **told)

    def as_plain(self) -> dict[str, Any]:
        """Return its place and sizes as plain values."""
        length_m, width_m = self.change.sides_m
        told: dict[str, Any] = {"name": self.change.name, "kind": self.change.kind}
        told |= {"world_T_patch": self.world_T_patch.tolist(), "length_m": length_m, "width_m": width_m}
        return {**told, "tolerance_m": self.tolerance_m}


def make_patch(
    number: int, change: RockChange, world_T_patch: Float64Array, heights: Heights, tolerance_m: float
) -> Patch:
    """Return a patch: its surface as a grid of triangles, and the same moved as the change says.

    Convergence is largest over the inner half of both sides and falls to 0 by half a cosine, along the normals of the
    smooth surface. Heave is the same, vertically. Shotcrete has its thickness everywhere but at an edge of 6 cm.
    """
    length_m, width_m = change.sides_m
    axes = [_axis(side_m / 2, is_edged=change.kind == "shotcrete") for side_m in (length_m, width_m)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    before = np.column_stack([places, heights.at(places)])
    faces = _grid_faces(len(axes[0]), len(axes[1]))
    weight = weigh(change, places)
    up = invert(world_T_patch)[:3, 2]
    ways = np.tile(up, (len(places), 1)) if change.kind == "heave" else heights.normals(places)
    size_m = change.thickness_m if change.depth_m is None else change.depth_m
    assert size_m is not None
    after = before + (size_m * weight)[:, None] * ways
    walls = TwinWalls(before, after, faces, np.where(weight > 0, number, 0))
    return Patch(number, change, world_T_patch, heights, tolerance_m, walls)


def weigh(change: RockChange, places: Float64Array) -> Float64Array:
    """Return the share (N,) of its size by which a change moves rock at places (N, 2) about its middle."""
    half_m = np.array(change.sides_m) / 2
    if change.kind == "shotcrete":
        return np.asarray(np.clip((half_m - np.abs(places)).min(axis=1) / EDGE_M, 0.0, 1.0))
    return window(places[:, 0] / half_m[0]) * window(places[:, 1] / half_m[1])


def _axis(half_m: float, *, is_edged: bool) -> Float64Array:
    """Return the coordinates of a grid, with lines where the change begins and, of shotcrete, where its edge ends."""
    inner_m = half_m - EDGE_M if is_edged else half_m
    within = np.linspace(-inner_m, inner_m, 1 + 2 * int(np.ceil(inner_m / _STEP_M)))
    beyond = np.linspace(half_m, half_m + MARGIN_M, 1 + int(np.ceil(MARGIN_M / _STEP_M)))
    return np.unique(np.concatenate([-beyond, within, beyond]))


def _grid_faces(n: int, m: int) -> Int64Array:
    """Return the faces (M, 3) of a grid of n by m vertices, whose normals point along z."""
    low = (np.arange(n - 1)[:, None] * m + np.arange(m - 1)).ravel()
    return np.concatenate(
        [np.column_stack([low, low + m, low + m + 1]), np.column_stack([low, low + m + 1, low + 1])]
    ).astype(np.int64)
