"""Ray casting of a revolution at a fixed scene and at movers, each posed at the time of every column.

The rays of a column that can meet a link are carried into the link's frame at that column's time and cast at its own
Embree scene. So the cast is exact for a scan that rolls, however fast a link moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import Float32Array, Float64Array, Int32Array, Int64Array
from sim.geometry.raycast import RayCaster
from sim.movers.mover import Limb, MovingBody
from sim.scene import Scene

# Added to the radius of the ball around a body or a link: the rays of a beam start up to 1 cm from the column's origin,
# and rounding must lose no ray. Rays beyond those that can meet it only cost time.
_SLACK_M = 0.05
_Vectors = npt.NDArray[np.floating[Any]]


class MovingCaster(RayCaster):
    """The fixed scene and the movers as the columns of one revolution meet them.

    The geoms of the scene keep their numbers; those of the movers follow, mover by mover.
    """

    def __init__(self, fixed: RayCaster, n_fixed: int, movers: Sequence[MovingBody], time_s: Float64Array) -> None:
        """Pose movers for the columns of a revolution.

        Args:
            fixed: Ray caster of the fixed scene.
            n_fixed: Number of its geoms.
            movers: The movers.
            time_s: (W,) time of each column in the session.
        """
        self.centre_m = fixed.centre_m
        self._fixed, self._n_fixed, self._movers, self._time_s = fixed, n_fixed, movers, time_s
        if fixed.keeps_hits:  # a device casts a whole revolution faster than its parts
            self.block_columns = len(time_s)

    def _at(self, columns: slice) -> RayCaster:
        """Return the caster of some columns."""
        return MovingCaster(self._fixed, self._n_fixed, self._movers, self._time_s[columns])

    def cast_local(
        self, origins: Float32Array, directions: Float32Array
    ) -> tuple[Float32Array, Int32Array, Float32Array]:
        """Return the results of `Caster.cast_local` for rays (N, 3), column after column, as many in each."""
        hits = self._fixed.cast_local(origins, directions)
        first = self._n_fixed
        for mover in self._movers:
            self._cast_mover(mover, first, origins, directions, hits)
            first += len(mover.figure.materials)
        return hits

    def _cast_mover(
        self,
        mover: MovingBody,
        first: int,
        origins: Float32Array,
        directions: Float32Array,
        hits: tuple[Float32Array, Int32Array, Float32Array],
    ) -> None:
        """Replace the hits (N,) of the rays that meet a mover, whose geoms have the numbers from `first` on."""
        extent, per_column = mover.figure.extent, len(origins) // len(self._time_s)
        centres = _place_point(mover.world_T_root(self._time_s), extent.centre) - self.centre_m
        near = _find_near(centres, extent.radius_m, per_column, origins, directions, hits[0])
        if not len(near):
            return
        columns, column = np.unique(near // per_column, return_inverse=True)
        poses = mover.world_T_links(self._time_s[columns])
        rays = origins[near].astype(np.float64), directions[near].astype(np.float64)
        for limb, world_T_link in zip(mover.figure.limbs, poses, strict=True):
            world_T_link[:, :3, 3] -= self.centre_m
            self._cast_limb(limb, first, world_T_link, (near, column), rays, hits)
            first += len(limb.meshes)

    def _cast_limb(
        self,
        limb: Limb,
        first: int,
        local_T_link: Float64Array,
        near: tuple[Int64Array, Int64Array],
        rays: tuple[Float64Array, Float64Array],
        hits: tuple[Float32Array, Int32Array, Float32Array],
    ) -> None:
        """Replace the hits of the rays that meet a link.

        Args:
            limb: The link.
            first: Number of its first geom.
            local_T_link: (C, 4, 4) its pose from `centre_m`, at C columns.
            near: (M,) numbers of the rays that may meet the mover, and (M,) which of the C columns each is of.
            rays: Their origins, from `centre_m`, and directions, both (M, 3).
            hits: (N,) range, geom and cosine of all rays, written in place.
        """
        ranges_m, geoms, cosines = hits
        ray, column = near
        towards = _place_point(local_T_link, limb.centre)[column] - rays[0]
        along_m = _dot(towards, rays[1])
        reach_m = limb.radius_m + _SLACK_M
        is_near = (_dot(towards, towards) - along_m * along_m < reach_m**2) & (along_m > -reach_m)
        may = np.flatnonzero(is_near & (ranges_m[ray] > along_m - reach_m))
        if not len(may):
            return
        pose = local_T_link[column[may]]
        origins = _turn_back(pose, rays[0][may] - pose[:, :3, 3]) - limb.caster.centre_m
        ways = _turn_back(pose, rays[1][may])
        own_m, own, own_cosines = limb.caster.cast_local(origins.astype(np.float32), ways.astype(np.float32))
        is_first = own_m < ranges_m[ray[may]]
        met = ray[may[is_first]]
        ranges_m[met], geoms[met], cosines[met] = own_m[is_first], first + own[is_first], own_cosines[is_first]


def _find_near(
    centres: Float64Array,
    radius_m: float,
    per_column: int,
    origins: Float32Array,
    directions: Float32Array,
    ranges_m: Float32Array,
) -> Int64Array:
    """Return the numbers (M,) of the rays that can meet a ball before what they hit.

    Args:
        centres: (W, 3) middle of the ball at the time of each column.
        radius_m: Its radius.
        per_column: Number of rays in a column.
        origins: (N, 3) where the rays start.
        directions: (N, 3) where they go.
        ranges_m: (N,) distance to what each hits.
    """
    towards = (centres - origins[::per_column]).astype(np.float32)
    distance2 = _dot(towards, towards)[:, None]
    ways = directions.reshape(-1, per_column, 3)
    along_m = ways[..., 0] * towards[:, 0, None]
    along_m += ways[..., 1] * towards[:, 1, None]
    along_m += ways[..., 2] * towards[:, 2, None]
    reach_m = np.float32(radius_m + _SLACK_M)
    is_near = (along_m > -reach_m) & (distance2 - along_m * along_m < reach_m**2)
    is_near &= ranges_m.reshape(-1, per_column) > along_m - reach_m
    return np.flatnonzero(is_near)


def _place_point(poses: Float64Array, point: Float64Array) -> Float64Array:
    """Return a point (3,) carried along by poses (T, 4, 4): (T, 3)."""
    return np.asarray(sum(poses[:, :3, axis] * point[axis] for axis in range(3)) + poses[:, :3, 3])


def _turn_back(poses: Float64Array, vectors: Float64Array) -> Float64Array:
    """Return vectors (M, 3) in the axes of their own poses (M, 4, 4); written out by component."""
    return np.asarray(sum(poses[:, axis, :3] * vectors[:, axis, None] for axis in range(3)))


def _dot(a: _Vectors, b: _Vectors) -> _Vectors:
    """Return the products (N,) of vectors (N, 3), summed in their order."""
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


@dataclass(frozen=True, slots=True, eq=False)
class PosedScene:
    """What the sensor meets in one revolution: a caster, and instance and reflectivity (G,) of every geom."""

    caster: RayCaster
    instance: Int32Array
    reflectivity: Float32Array


class MovingScene:
    """The fixed scene of a session, and what moves in it.

    Attributes:
        caster: What casts the sensor's rays at the fixed scene.
        movers: The movers, in the order of the scenario.
        instance: (G,) instance of each geom, those of the movers last.
        reflectivity: (G,) share of light that each geom reflects.
    """

    def __init__(self, scene: Scene, movers: Sequence[MovingBody], caster: RayCaster | None = None) -> None:
        """Let movers move in a scene; `caster` casts at it in place of the scene's own."""
        self.movers, self.caster = tuple(movers), caster or scene.caster
        own = [np.full(len(mover.figure.materials), mover.instance, np.int32) for mover in movers]
        self.instance = np.concatenate([scene.instance, *own])
        self.reflectivity = np.concatenate([scene.reflectivity, *(mover.figure.reflectivity for mover in movers)])
        self._n_fixed = len(scene.instance)

    def pose(self, time_s: Float64Array) -> PosedScene:
        """Return the scene as the columns of a revolution meet it at times (W,); without movers the fixed one."""
        caster = MovingCaster(self.caster, self._n_fixed, self.movers, time_s) if self.movers else self.caster
        return PosedScene(caster, self.instance, self.reflectivity)
