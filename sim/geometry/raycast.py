"""Ray casting with Embree against the geoms of a compiled MuJoCo model, under MuJoCo's own geom ids."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from cdpipe.core.geometry import BoolArray, Float32Array, Float64Array, Int32Array
from sim.geometry.bundles import Bundle, make_bundle_rays
from sim.geometry.mesh import Mesh, box_mesh, cylinder_mesh, move_mesh

_CYLINDER_SEGMENTS = 64


class RayCaster(ABC):
    """What the rays of a sensor are cast at: a scene of numbered meshes.

    Attributes:
        centre_m: (3,) float64 centre of the scene, world frame, whole metres; rays in float32 start from it.
        keeps_hits: Whether hits can stay on a device, where `sim.sensor.blending` blends them.
        block_columns: How many columns of bundles are cast at a time: their arrays stay in the processor's cache.
    """

    centre_m: Float64Array
    keeps_hits = False
    block_columns = 128

    @abstractmethod
    def cast_local(
        self, origins: Float32Array, directions: Float32Array
    ) -> tuple[Float32Array, Int32Array, Float32Array]:
        """Return the results of `Caster.cast` for contiguous (N, 3) rays whose origins are given from `centre_m`."""

    def cast_columns(
        self, origins: Float64Array, directions: Float32Array
    ) -> tuple[Float32Array, Int32Array, Float32Array]:
        """Cast a whole revolution; the results of `Caster.cast`, each (W, H).

        Args:
            origins: (W, 3) float64 point where all beams of a column start, world frame, metres.
            directions: (W, H, 3) float32 unit vectors, contiguous.
        """
        width, height, _ = directions.shape
        local = np.repeat((origins - self.centre_m).astype(np.float32), height, axis=0)
        ranges_m, ids, cosines = self.cast_local(local, directions.reshape(-1, 3))
        return ranges_m.reshape(width, height), ids.reshape(width, height), cosines.reshape(width, height)

    def cast_bundles(
        self, origins: Float64Array, directions: Float32Array, bundle: Bundle
    ) -> tuple[Float32Array, Int32Array, Float32Array]:
        """Cast the n rays of every beam of a revolution; the results of `Caster.cast`, each (n, W * H).

        Args:
            origins: (W, 3) float64 point where all beams of a column start, world frame, metres.
            directions: (W, H, 3) float32 unit vectors, contiguous.
            bundle: Where the rays of a beam lie.
        """
        width, height, _ = directions.shape
        n_rays = len(bundle.places)
        shape = n_rays, width * height
        answer = np.empty(shape, np.float32), np.empty(shape, np.int32), np.empty(shape, np.float32)
        for first in range(0, width, self.block_columns):
            columns = slice(first, first + self.block_columns)
            # The rays of a beam are cast one after another: they meet the same triangles, which is a quarter faster.
            rays = make_bundle_rays(origins[columns], directions[columns], bundle, self.centre_m)
            for whole, part in zip(answer, self._at(columns).cast_local(*rays), strict=True):
                whole[:, columns.start * height : columns.stop * height] = part.reshape(-1, n_rays).T
        return answer

    def _at(self, columns: slice) -> RayCaster:
        """Return what the rays of some columns of a revolution are cast at."""
        return self


@dataclass(frozen=True, slots=True, eq=False)
class _Tree:
    """One Embree scene, and the number of its first mesh."""

    scene: EmbreeScene
    geoms: list[TriangleMesh]
    first: int


class Caster(RayCaster):
    """Embree scenes of one or more meshes, numbered in the order given.

    Embree works in float32. Coordinates are relative to the centre of the scene, so that a mine of 400 m is resolved
    to 0.02 mm.

    Attributes:
        centre_m: (3,) float64 that centre, world frame, whole metres.
        n_meshes: Number of meshes.
    """

    def __init__(self, meshes: Iterable[Mesh], onto: Caster | None = None) -> None:
        """Build the trees.

        Args:
            meshes: All meshes.
            onto: A caster of the first of these meshes. Its trees are shared and only the other meshes get a tree of
                their own, which is quick to build and slower to cast at. Ranges are those of one tree over all, to the
                bit: where the centre of all meshes is not that of `onto`, one tree is built.
        """
        meshes = list(meshes)
        self.n_meshes = len(meshes)
        # Corner by corner: a copy of all of them would be large.
        self._low = np.min([mesh.vertices.min(axis=0, initial=np.inf) for mesh in meshes], axis=0)
        self._high = np.max([mesh.vertices.max(axis=0, initial=-np.inf) for mesh in meshes], axis=0)
        self.centre_m = np.round((self._low + self._high) / 2)
        shared: tuple[_Tree, ...] = ()
        if onto is not None and (onto.centre_m == self.centre_m).all():
            shared, meshes = onto._trees, meshes[onto.n_meshes :]
        own = (self._build(meshes, self.n_meshes - len(meshes)),) if meshes else ()
        self._trees: tuple[_Tree, ...] = (*shared, *own)

    def _build(self, meshes: Sequence[Mesh], first: int) -> _Tree:
        scene = EmbreeScene()
        geoms = [TriangleMesh(scene, (mesh.vertices - self.centre_m).astype(np.float32), mesh.faces) for mesh in meshes]
        # Embree builds the scene at its first use, which must not happen in two threads at once.
        scene.run(np.zeros((1, 3), np.float32), np.array([[0.0, 0.0, 1.0]], np.float32))
        return _Tree(scene, geoms, first)

    def cast(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> tuple[Float32Array, Int32Array, Float32Array]:
        """Return the first hit of each ray; safe to call from several threads.

        Args:
            origins: (N, 3) starting points, world frame, metres; or one (3,) for all rays.
            directions: (N, 3) unit vectors; or one (3,) for all rays.

        Returns:
            (N,) float32 distance, metres, infinite where nothing is hit; (N,) int32 number of the mesh hit, or -1;
            (N,) float32 absolute cosine between ray and surface normal, 0 for a miss.
        """
        return self.cast_local(*self._rays(origins, directions))

    def cast_local(
        self, origins: Float32Array, directions: Float32Array
    ) -> tuple[Float32Array, Int32Array, Float32Array]:
        """Return the results of `cast` for contiguous (N, 3) rays whose origins are given from `centre_m`."""
        # Written with few passes over memory for speed.
        answer = self._run(origins, directions)
        ranges_m, ids, normals = answer["tfar"], answer["geomID"], answer["Ng"]
        products = normals * directions
        cosines = _row_sums(products)
        np.abs(cosines, out=cosines)
        np.multiply(normals, normals, out=products)
        lengths = _row_sums(products)
        np.sqrt(lengths, out=lengths)
        np.maximum(lengths, np.float32(1e-30), out=lengths)  # a sliver's normal may have no length
        cosines /= lengths
        is_miss = ids < 0
        cosines[is_miss] = 0.0
        ranges_m[is_miss] = np.inf
        return ranges_m, ids, cosines

    def hits(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> tuple[Float32Array, Int32Array, Float32Array]:
        """Return distances and mesh numbers as `cast` does, and the (N, 3) unit normals (0 for a miss)."""
        answer = self._run(*self._rays(origins, directions))
        ids = answer["geomID"]
        is_hit = ids >= 0
        normals = answer["Ng"]
        length = np.sqrt(np.einsum("ij,ij->i", normals, normals))
        normals = np.where(is_hit[:, None], normals / np.maximum(length, 1e-30)[:, None], 0.0)
        return np.where(is_hit, answer["tfar"], np.float32(np.inf)), ids, normals.astype(np.float32)

    def faces(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> tuple[Float32Array, Int32Array, Int32Array]:
        """Return distances and mesh numbers as `cast` does, and the (N,) number of the face hit in its mesh, or -1."""
        answer = self._run(*self._rays(origins, directions))
        ids = answer["geomID"]
        is_hit = ids >= 0
        face = np.where(is_hit, answer["primID"], -1).astype(np.int32)
        return np.where(is_hit, answer["tfar"], np.float32(np.inf)), ids, face

    def _run(self, origins: Float32Array, directions: Float32Array) -> dict[str, npt.NDArray[Any]]:
        """Return Embree's answer for the nearest hit of each ray in all trees, under the numbers of the meshes."""
        base, *others = self._trees
        answer: dict[str, npt.NDArray[Any]] = base.scene.run(origins, directions, output=1)
        for tree in others:
            nearer = tree.scene.run(origins, directions, answer["tfar"], output=1)
            met = np.flatnonzero(nearer["geomID"] >= 0)
            if len(met):
                nearer["geomID"] += np.int32(tree.first)
                for name in ("tfar", "geomID", "primID", "Ng"):
                    answer[name][met] = nearer[name][met]
        return answer

    def _rays(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> tuple[Float32Array, Float32Array]:
        """Return origins, from the centre of the scene, and directions, both (N, 3) contiguous."""
        local, ways = np.broadcast_arrays(np.asarray(origins) - self.centre_m, directions)
        return np.ascontiguousarray(local, np.float32), np.ascontiguousarray(ways, np.float32)


def _row_sums(rows: Float32Array) -> Float32Array:
    """Sum over the three columns of (N, 3), in their order."""
    sums = rows[:, 0] + rows[:, 1]
    sums += rows[:, 2]
    return sums


def model_meshes(model: mujoco.MjModel, data: mujoco.MjData) -> list[Mesh]:
    """Return every geom of a compiled model as a mesh in world coordinates, in the order of MuJoCo's geom ids.

    Raises:
        ValueError: A geom is neither mesh, box nor cylinder.
    """
    return [_geom_mesh(model, data, geom) for geom in range(model.ngeom)]


def _geom_mesh(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Mesh:
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh_id = model.geom_dataid[geom]
        vertices = slice(model.mesh_vertadr[mesh_id], model.mesh_vertadr[mesh_id] + model.mesh_vertnum[mesh_id])
        faces = slice(model.mesh_faceadr[mesh_id], model.mesh_faceadr[mesh_id] + model.mesh_facenum[mesh_id])
        # A copy, because a view of its faces would keep the whole model in memory.
        local = Mesh(model.mesh_vert[vertices].astype(np.float64), model.mesh_face[faces].copy())
    elif kind == mujoco.mjtGeom.mjGEOM_BOX:
        local = box_mesh(size)
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        local = cylinder_mesh(size[0], size[1], _CYLINDER_SEGMENTS)
    else:
        raise ValueError(f"geom {geom} is of type {kind}: only meshes, boxes and cylinders are cast")
    world_T_geom = np.eye(4)
    world_T_geom[:3, :3] = data.geom_xmat[geom].reshape(3, 3)
    world_T_geom[:3, 3] = data.geom_xpos[geom]
    return move_mesh(local, world_T_geom)


def measure_room(caster: Caster, points: Float64Array, directions: Float64Array) -> tuple[Float64Array, BoolArray]:
    """Return the distance from points to the nearest surface, and which points lie in rock or outside everything.

    Args:
        caster: Surfaces that face the void.
        points: (N, 3) world.
        directions: (M, 3) unit vectors to look along from every point.

    Returns:
        (N,) smallest distance along the directions, metres; (N,) True if most hits are on the back of a surface, or if
        there is no hit. A majority is needed because thin fixtures and foreign meshes show some back faces.
    """
    rays = np.tile(directions, (len(points), 1))
    ranges_m, _, normals = caster.hits(np.repeat(points, len(directions), axis=0), rays)
    facing = -(normals * rays).sum(axis=1).reshape(len(points), -1)
    n_before, n_behind = (facing > 0).sum(axis=1), (facing < 0).sum(axis=1)
    gap_m = np.maximum(ranges_m.reshape(len(points), -1).min(axis=1), 0.0)  # on the surface Embree may say -0
    return gap_m.astype(np.float64), n_behind >= n_before
