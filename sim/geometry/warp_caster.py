"""Ray casting with package `warp-lang`, on a GPU where there is one, else on the CPU."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from functools import cache
from threading import Lock
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from cdpipe.core.geometry import Float32Array, Float64Array, Int32Array
from sim.geometry import kernels
from sim.geometry.bundles import Bundle
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import RayCaster

_LOCK = Lock()


@cache
def start_device() -> str:
    """Start Warp without its messages and return the device that casts: "cuda:0" where there is a GPU, else "cpu"."""
    wp.config.log_level = wp.LOG_ERROR
    wp.init()
    return "cuda:0" if wp.is_cuda_available() else "cpu"


@cache
def load_kernels(module: ModuleType, device: str) -> None:
    """Compile the kernels of a module for a device, or take them from Warp's cache; one thread at a time.

    The cache is the folder `WARP_CACHE_PATH`, by default in the user's cache.
    """
    with _LOCK:
        wp.load_module(module, device=device)


class WarpCaster(RayCaster):
    """One triangle mesh of one or more meshes, numbered in the order given, on a device of Warp.

    Rays, faces and ranges are those of `sim.geometry.raycast.Caster`, but for what RAYCASTING.md says. Safe to use from
    several threads; on a GPU they take turns.

    Attributes:
        device: Name of the device.
        turn: Held while a thread uses a GPU.
    """

    keeps_hits = True

    def __init__(self, meshes: Sequence[Mesh], centre_m: Float64Array, device: str | None = None) -> None:
        """Build the tree.

        Args:
            meshes: All meshes.
            centre_m: (3,) centre of the scene, world frame.
            device: Name of the device; None for that of `start_device`.
        """
        found = start_device()
        self.centre_m, self.device = centre_m, device or found
        self.turn = _LOCK if self.device != "cpu" else nullcontext()
        points = np.concatenate([(mesh.vertices - centre_m).astype(np.float32) for mesh in meshes])
        firsts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
        faces = np.concatenate([mesh.faces + first for mesh, first in zip(meshes, firsts, strict=True)])
        owners = np.repeat(np.arange(len(meshes), dtype=np.int32), [len(mesh.faces) for mesh in meshes])
        load_kernels(kernels, self.device)
        with self.turn:
            # On both devices the same tree: of two faces that meet in an edge the same one is found.
            flat = self.put(faces.astype(np.int32).ravel(), wp.int32)
            self._mesh = wp.Mesh(self.put(points, wp.vec3), flat, bvh_constructor="sah")
            self._target = kernels.Target()
            self._target.mesh, self._target.geoms = self._mesh.id, self.put(owners, wp.int32)

    def cast_local(
        self, origins: Float32Array, directions: Float32Array
    ) -> tuple[Float32Array, Int32Array, Float32Array]:
        """Return the results of `Caster.cast` for contiguous (N, 3) rays whose origins are given from `centre_m`."""
        with self.turn:
            rays = [self.put(each, wp.vec3) for each in (origins, directions)]
            hits = self._launch(kernels.cast_rays, (len(origins),), rays, (len(origins),))
            ranges_m, ids, cosines = (each.numpy() for each in hits)
        return ranges_m, ids, cosines

    def cast_bundles(
        self, origins: Float64Array, directions: Float32Array, bundle: Bundle
    ) -> tuple[Float32Array, Int32Array, Float32Array]:
        """Cast the n rays of every beam of a revolution as `RayCaster.cast_bundles` does; the device makes the rays."""
        with self.turn:
            ranges_m, ids, cosines = (each.numpy() for each in self.keep_bundles(origins, directions, bundle))
        return ranges_m, ids, cosines

    def keep_bundles(self, origins: Float64Array, directions: Float32Array, bundle: Bundle) -> list[Any]:
        """Return the results of `cast_bundles` as arrays of Warp on the device; call it while holding `turn`."""
        width, height, _ = directions.shape
        rays = np.column_stack([bundle.places.astype(np.float32), bundle.lengths])
        shape = kernels.BeamShape()
        shape.places, shape.centre_m = self.put(rays, wp.vec3), wp.vec3d(*self.centre_m)
        shape.radius_m, shape.slope = bundle.radius_m, bundle.slope
        beams = [self.put(origins, wp.vec3d), self.put(directions, wp.vec3)]
        dim = (width, height, len(rays))
        return self._launch(kernels.cast_bundles, dim, [shape, *beams], (len(rays), width * height))

    def put(self, array: npt.NDArray[Any], dtype: Any) -> Any:
        """Return an array on the device; on the CPU the same memory."""
        return wp.array(np.ascontiguousarray(array), dtype=dtype, device=self.device, copy=self.device != "cpu")

    def _launch(self, kernel: Any, dim: tuple[int, ...], inputs: list[Any], shape: tuple[int, ...]) -> list[Any]:
        """Run a kernel and return the ranges, geoms and cosines that it wrote, each of one shape, on the device."""
        outputs = [wp.empty(shape, dtype=each, device=self.device) for each in (wp.float32, wp.int32, wp.float32)]
        wp.launch(kernel, dim, inputs=[self._target, *inputs], outputs=outputs, device=self.device)
        return outputs
