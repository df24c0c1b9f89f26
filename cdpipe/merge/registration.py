"""Registration: FRAME's GICP and VGICP of two clouds, and ours of a sphere against a map that is indexed once.

FRAME (arXiv 2301.09213) aligns two spheres by GICP (correspondences up to 3 m) and then VGICP (1 m). Here the full
before map is indexed once, with normals and covariances, so a registration only has to prepare the sphere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from time import perf_counter
from typing import Any

import numpy as np
import small_gicp
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import (
    BoolArray,
    Float32Array,
    Float64Array,
    Int64Array,
    invert,
    make_pose,
    plane_jacobian,
    transform,
)
from cdpipe.core.geometry.grid_index import GridIndex, column_keys
from cdpipe.core.geometry.voxel import cell_keys
from cdpipe.model.config import MergeConfig
from cdpipe.model.types import PointMap

# A sphere needs this many points to be registered.
MIN_SPHERE_POINTS = 100
_NEIGHBOURS = 10
# Scale of the robust weight: changed objects must not pull.
_ROBUST_M = 0.1
_PLANE_STEPS, _PLANE_CONVERGED, _DAMPING, _MIN_PAIRS = 8, 1e-3, 1e-3, 30
# Points beyond an indexed place that the normals at its border are made of.
_MARGIN_M = 2.0
# How much wider than asked for a place is indexed: a registration moves it.
_SLACK_M = 2.0
# Correspondence distance over voxel size of VGICP.
_VGICP_CELLS = 2.0


class Surface:
    """A registration target: k-d tree, covariances and normals of a cloud.

    Attributes:
        cloud: The cloud as small_gicp's type.
        tree: Its k-d tree.
        points: (N, 3) its points, metres.
        normals: (N, 3) unit normals, of either sign.
    """

    def __init__(self, points: Float64Array, voxel_m: float | None = None) -> None:
        if voxel_m is None:
            self.cloud = small_gicp.PointCloud(points)
            self.tree = small_gicp.KdTree(self.cloud)
            small_gicp.estimate_normals_covariances(self.cloud, self.tree, num_neighbors=_NEIGHBOURS, num_threads=1)
        else:
            self.cloud, self.tree = small_gicp.preprocess_points(points, voxel_m, _NEIGHBOURS, num_threads=1)
        self.points: Float64Array = np.ascontiguousarray(self.cloud.points()[:, :3])
        self.normals: Float64Array = np.ascontiguousarray(self.cloud.normals()[:, :3])


class IndexedMap:
    """A map indexed for merging; a robot can do this while it maps.

    Only points that were seen from within `merge.seen_within_m` are used: distant points carry the odometry error at
    the time they were observed. A target is thinned to `merge.target_voxel_m` (reports/merge/notes). The (N,) points of
    the map that are held out are left out.

    A map that `is_local` has trees, covariances and normals only around the places that were asked for, which is a
    fraction of a long path. Results are those of the full index, but for points whose neighbours are metres away.

    Attributes:
        map: The map.
        points: (N, 3) the points in use, odom frame, metres.
        seen_from: (N, 3) mean sensor position that saw each point; the point itself if unknown.
        columns: Grid index of the points, for cropping spheres.
        positions: (K, 3) keyframe positions, odom frame, metres.
        path: k-d tree of the positions of all scans.
        local_s: Seconds spent on places since the map was indexed.
    """

    def __init__(
        self,
        point_map: PointMap,
        config: MergeConfig,
        is_target: bool,
        has_coarse_target: bool = True,
        is_held_out: BoolArray | None = None,
        is_local: bool = False,
    ) -> None:
        self.map = point_map
        is_near = point_map.nearest_m <= config.seen_within_m
        if is_held_out is not None:
            is_near &= ~is_held_out
        near = point_map.points[is_near]
        seen_from = near if point_map.seen_from is None else point_map.seen_from[is_near]
        self.points, self.seen_from = _thin(near, seen_from, config.target_voxel_m) if is_target else (near, seen_from)
        self.columns = GridIndex(self.points)
        self.positions = point_map.odom_T_keyframe[:, :3, 3]
        self.path = cKDTree(point_map.odom_T_sensor[:, :3, 3])
        self.local_s = 0.0
        self._coarse_voxel_m, self._places = config.coarse_voxel_m, list[_Place]()
        self._is_local = is_local
        is_whole = is_target and not is_local
        self._fine = Surface(self.points) if is_whole else None
        self._coarse = Surface(self.points, config.coarse_voxel_m) if is_whole and has_coarse_target else None
        self._tree = None if is_target or is_local else small_gicp.KdTree(self.points)

    @cached_property
    def has_mist(self) -> bool:
        """Whether the session met mist or dust, as far as its range images tell."""
        return self.map.views is not None and self.map.views.has_mist()

    @property
    def target(self) -> Surface:
        """The map as a registration target; its points have the order of `points`."""
        if self._fine is None:
            raise ValueError("this map was not indexed as a target")
        return self._fine

    @property
    def coarse_target(self) -> Surface:
        """The target thinned to `merge.coarse_voxel_m`."""
        if self._coarse is None:
            raise ValueError("this map was not indexed as a target")
        return self._coarse

    def target_near(self, centre: Float64Array, radius_m: float) -> tuple[Surface, Int64Array | None]:
        """Return a registration target that holds the map within `radius_m` of `centre` (3,).

        With it the index into `points` of each of its points, rising; None if it holds all of them.
        """
        if not self._is_local:
            return self.target, None
        place = self._find_place("fine", centre, radius_m, Surface)
        return place.index, place.rows

    def coarse_target_near(self, centre: Float64Array, radius_m: float) -> Surface:
        """Return the `coarse_target`, or the part of it within `radius_m` of `centre` (3,)."""
        if not self._is_local:
            return self.coarse_target
        place = self._find_place("coarse", centre, radius_m, lambda points: Surface(points, self._coarse_voxel_m))
        coarse: Surface = place.index
        return coarse

    def nearest_near(
        self, centre: Float64Array, radius_m: float, points: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Return the (N, 3) nearest map point of each of (N, 3) points, and the squared distances (N,), square metres.

        Exact where the nearest point is within `radius_m` of `centre` (3,).
        """
        tree: Any = self._fine.tree if self._fine else self._tree
        of_map = self.points
        if self._is_local:
            place = self._find_place("tree", centre, radius_m, small_gicp.KdTree)
            tree, of_map = place.index, self.points[place.rows]
        found, squared_m2 = tree.batch_nearest_neighbor_search(points)
        return of_map[found], np.asarray(squared_m2)

    def _find_place(
        self, kind: str, centre: Float64Array, radius_m: float, index: Callable[[Float64Array], Any]
    ) -> _Place:
        """Return an indexed place that holds a sphere; index one if there is none yet."""
        for place in self._places:
            if place.kind == kind and np.linalg.norm(centre - place.centre) + radius_m <= place.radius_m:
                return place
        start = perf_counter()
        valid_m = radius_m + _SLACK_M
        rows = self.columns.crop(centre, valid_m + _MARGIN_M)
        if len(rows) < MIN_SPHERE_POINTS:  # far off the map: what is nearest may be anywhere
            valid_m, rows = np.inf, np.arange(len(self.points))
        place = _Place(kind, centre, valid_m, rows, index(self.points[rows]))
        self._places.append(place)
        self.local_s += perf_counter() - start
        return place

    def sphere(self, centre: Float64Array, radius_m: float) -> Float64Array:
        """Return the (N, 3) map points within `radius_m` of `centre` (3,)."""
        return self.columns.points_within(centre, radius_m)


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """An indexed part of a map: its index is valid within `radius_m`, and was made of the points in `rows`."""

    kind: str
    centre: Float64Array
    radius_m: float
    rows: Int64Array
    index: Any


def _thin(
    points: Float64Array, seen_from: Float64Array | Float32Array, voxel_m: float
) -> tuple[Float64Array, Float64Array]:
    """Return the mean point and mean sensor position of each voxel, in the order of `GridIndex`."""
    keys = cell_keys(points, voxel_m)
    order = np.argsort(keys, kind="stable")
    first = np.flatnonzero(np.diff(keys[order], prepend=keys[order[:1]] - 1))
    counts = np.diff(first, append=len(keys))[:, None]
    means, seen = (np.add.reduceat(each[order], first, axis=0) / counts for each in (points, seen_from))
    order = np.argsort(column_keys(means), kind="stable")
    return means[order], seen[order]


def register(
    source_points: Float64Array, target_points: Float64Array, initial_guess: Float64Array, config: MergeConfig
) -> Float64Array:
    """Return the (4, 4) `target_T_source` of two clouds by GICP and then VGICP, as FRAME does.

    Args:
        source_points: (N, 3) points, metres.
        target_points: (M, 3) points, metres.
        initial_guess: (4, 4) `target_T_source` to start from.
        config: Voxel size and correspondence distances.
    """
    target_cloud, target_tree = small_gicp.preprocess_points(target_points, config.voxel_m, num_threads=1)
    # centred: small_gicp solves for a rotation about the origin, which may be far away
    centre = source_points.mean(axis=0)
    source_cloud, _ = small_gicp.preprocess_points(source_points - centre, config.voxel_m, num_threads=1)
    coarse = small_gicp.align(
        target_cloud,
        source_cloud,
        target_tree,
        initial_guess @ make_pose(translation=centre),
        registration_type="GICP",
        max_correspondence_distance=config.gicp_correspondence_m,
        num_threads=1,
    )
    voxels = small_gicp.GaussianVoxelMap(config.vgicp_correspondence_m / _VGICP_CELLS)
    voxels.insert(target_cloud)
    fine = small_gicp.align(
        voxels,
        source_cloud,
        coarse.T_target_source,
        max_correspondence_distance=config.vgicp_correspondence_m,
        num_threads=1,
    )
    return np.asarray(fine.T_target_source @ make_pose(translation=-centre))


def search_nearest(tree: small_gicp.KdTree, points: Float64Array) -> tuple[Int64Array, Float64Array]:
    """Return the (N,) index of the tree's point nearest to each of (N, 3) points, and the (N,) squared distances."""
    # the k-nearest search returns arrays; the nearest search returns lists, which are slow to convert
    found, squared_m2 = tree.batch_knn_search(points, 1)
    return found[:, 0].astype(np.int64), squared_m2[:, 0]


def align_by_gicp(
    points: Float64Array,
    centre: Float64Array,
    target: Surface,
    initial_guess: Float64Array,
    correspondence_m: float,
    voxel_m: float,
    max_steps: int = 20,
) -> Float64Array:
    """Return the (4, 4) `target_T_source` of a sphere by GICP; it converges from an error of over a metre.

    Args:
        points: (N, 3) points of the sphere, source frame, metres.
        centre: (3,) centre of the sphere, source frame.
        target: Indexed map.
        initial_guess: (4, 4) `target_T_source` to start from.
        correspondence_m: Longest correspondence, metres.
        voxel_m: Voxel size that thins the sphere, metres.
        max_steps: Iteration limit.
    """
    source, _ = small_gicp.preprocess_points(points - centre, voxel_m, _NEIGHBOURS, num_threads=1)
    found = small_gicp.align(
        target.cloud,
        source,
        target.tree,
        initial_guess @ make_pose(translation=centre),
        registration_type="GICP",
        max_correspondence_distance=correspondence_m,
        max_iterations=max_steps,
        num_threads=1,
    )
    return np.asarray(found.T_target_source @ make_pose(translation=-centre))


def align_to_planes(
    points: Float64Array, centre: Float64Array, target: Surface, initial_guess: Float64Array, correspondence_m: float
) -> Float64Array:
    """Return the (4, 4) `target_T_source` of a few hundred points by point-to-plane Gauss-Newton.

    It needs no covariances of the points and is faster than GICP, but must start within decimetres. small_gicp's
    PLANE_ICP cannot be used: it sums the squares of n_x d_x, n_y d_y and n_z d_z instead of squaring n . d, so it
    penalises sliding along a plane and depends on the frame.

    Args: as `align_by_gicp`.
    """
    pose = initial_guess @ make_pose(translation=centre)
    centred = points - centre
    for _ in range(_PLANE_STEPS):
        moved = transform(pose, centred)
        found, squared_m2 = search_nearest(target.tree, moved)
        pairs = np.flatnonzero(squared_m2 < correspondence_m**2)
        if len(pairs) < _MIN_PAIRS:
            break
        chosen = found.take(pairs)
        normals = target.normals.take(chosen, axis=0)
        offsets = moved.take(pairs, axis=0) - target.points.take(chosen, axis=0)
        distances_m = np.einsum("ij,ij->i", offsets, normals)
        jacobian = plane_jacobian(centred.take(pairs, axis=0), normals @ pose[:3, :3])
        step = -solve_point_to_plane(jacobian, distances_m, distances_m)
        pose = pose @ make_pose(Rotation.from_rotvec(step[:3]).as_matrix(), step[3:])
        if np.abs(step).max() < _PLANE_CONVERGED:  # metres, radians
            break
    return pose @ make_pose(translation=-centre)


def solve_point_to_plane(jacobian: Float64Array, distances_m: Float64Array, values_m: Float64Array) -> Float64Array:
    """Return the (6,) motion, rotation then translation, whose displacements along the normals best match values.

    Weighted least squares: a correspondence weighs 1 / (1 + (d / 0.1 m)^2). Directions that no normal constrains are
    damped by a thousandth of the largest diagonal entry, so that the motion along them stays zero.

    Args:
        jacobian: (N, 6) from `plane_jacobian`.
        distances_m: (N,) point-to-plane distances that set the weights.
        values_m: (N,) displacements to match.
    """
    weighted = jacobian / (1.0 + (distances_m / _ROBUST_M) ** 2)[:, None]
    hessian = weighted.T @ jacobian
    damped = hessian + _DAMPING * np.diag(hessian).reshape(2, 3).max(axis=1).repeat(3) * np.eye(6)
    return np.linalg.solve(damped, weighted.T @ values_m)


def motion_between(one: Float64Array, other: Float64Array, position: Float64Array) -> tuple[float, float]:
    """Return the difference of two (4, 4) transforms at a (3,) source position: metres and radians."""
    shift = transform(one, position[None]) - transform(other, position[None])
    turn = invert(one)[:3, :3] @ other[:3, :3]
    return float(np.linalg.norm(shift)), float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1.0, 1.0)))
