"""Ray casting with Embree against the geoms of a compiled MuJoCo model, under MuJoCo's own geom ids."""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from cdpipe.geometry import Float32Array, Float64Array, Int32Array
from sim.mesh import Mesh, box_mesh, cylinder_mesh, moved

_CYLINDER_SEGMENTS = 64


class Caster:
    """An Embree scene of one or more meshes, numbered in the order given.

    Embree works in float32; coordinates are taken from the middle of the scene, so that a mine of 400 m keeps steps
    of 0.02 mm.
    """

    def __init__(self, meshes: Iterable[Mesh]) -> None:
        meshes = list(meshes)
        corners = np.concatenate([mesh.vertices for mesh in meshes])
        self._centre_m = np.round((corners.min(axis=0) + corners.max(axis=0)) / 2)
        self._scene = EmbreeScene()
        self._geoms = [
            TriangleMesh(self._scene, (mesh.vertices - self._centre_m).astype(np.float32), mesh.faces)
            for mesh in meshes
        ]
        # The scene is built on its first use, which must not happen in two threads at once.
        self.cast(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))

    def cast(
        self, origins: Float64Array | Float32Array, directions: Float64Array | Float32Array
    ) -> tuple[Float32Array, Int32Array, Float32Array]:
        """Return the first hit of each ray; safe to call from several threads.

        Args:
            origins: (N, 3) starting points, world frame, metres.
            directions: (N, 3) unit vectors.

        Returns:
            (N,) float32 distance, metres, infinite where nothing is hit; (N,) int32 number of the mesh hit, or -1;
            (N,) float32 absolute cosine between ray and surface normal, 0 for a miss.
        """
        ranges_m, ids, normals = self.hits(origins, directions)
        return ranges_m, ids, np.abs((normals * directions).sum(axis=1)).astype(np.float32)

    def hits(
        self, origins: Float64Array | Float32Array, directions: Float64Array | Float32Array
    ) -> tuple[Float32Array, Int32Array, Float32Array]:
        """Return distances and mesh numbers as `cast` does, and the (N, 3) unit normals (0 for a miss)."""
        local = np.ascontiguousarray(origins - self._centre_m, dtype=np.float32)
        answer = self._scene.run(local, np.ascontiguousarray(directions, dtype=np.float32), output=1)
        ids = answer["geomID"]
        is_hit = ids >= 0
        normals = answer["Ng"]
        length = np.sqrt(np.einsum("ij,ij->i", normals, normals))
        normals = np.where(is_hit[:, None], normals / np.maximum(length, 1e-30)[:, None], 0.0)
        return np.where(is_hit, answer["tfar"], np.float32(np.inf)), ids, normals.astype(np.float32)


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
        local = Mesh(model.mesh_vert[vertices].astype(np.float64), model.mesh_face[faces])
    elif kind == mujoco.mjtGeom.mjGEOM_BOX:
        local = box_mesh(size)
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        local = cylinder_mesh(size[0], size[1], _CYLINDER_SEGMENTS)
    else:
        raise ValueError(f"geom {geom} is of type {kind}: only meshes, boxes and cylinders are cast")
    world_T_geom = np.eye(4)
    world_T_geom[:3, :3] = data.geom_xmat[geom].reshape(3, 3)
    world_T_geom[:3, 3] = data.geom_xpos[geom]
    return moved(local, world_T_geom)
