"""Registration of spheres: FRAME's chain on two clouds, and ours of a sphere against a map indexed once.

FRAME (arXiv 2301.09213) aligns two spheres by GICP (3 m correspondences) and then VGICP (1 m). A whole map can be
prepared for GICP while it is being built; then each sphere only brings its own points, which is what makes many
hypotheses and a sphere for every metre of path affordable.
"""

from __future__ import annotations

import numpy as np
import small_gicp
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float32Array, Float64Array, invert, make_pose, transform
from cdpipe.core.grid_index import GridIndex, column_keys
from cdpipe.core.voxel import cell_keys
from cdpipe.model.config import MergeConfig
from cdpipe.model.types import PointMap

# Fewer points than this are not registered.
MIN_SPHERE_POINTS = 100
_NEIGHBOURS = 10
# Distances beyond this count less and less; a change is not to pull.
_ROBUST_M = 0.1
_PLANE_STEPS, _PLANE_CONVERGED, _DAMPING, _MIN_PAIRS = 8, 1e-3, 1e-3, 30
# Gaussian voxels of half the correspondence distance: twice as accurate as 1 m on a real pair of 32-beam scans.
_VGICP_CELLS = 2.0


class Surface:
    """A cloud that others are registered to: a k-d tree, and covariance and normal of every point's neighbourhood.

    Attributes:
        cloud: The cloud as small_gicp has it.
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
    """A map prepared for merging, which can be done while it is being built.

    Only what was seen from near is used: a return from afar stands where the odometry of then says, which has drifted
    since. A target is thinned to `merge.target_voxel_m`: half the time, as accurate (reports/merge/notes).

    Attributes:
        map: The map.
        points: (N, 3) the points that are worked with.
        seen_from: (N, 3) mean position of the sensor when each was seen; the point itself where that is not known.
        columns: For cutting spheres out of them.
        positions: (K, 3) of its keyframes, odom frame, metres.
        path: k-d tree of the positions of all scans.
        tree: k-d tree of the points.
    """

    def __init__(
        self, point_map: PointMap, config: MergeConfig, is_target: bool, has_coarse_target: bool = True
    ) -> None:
        self.map = point_map
        is_near = point_map.nearest_m <= config.seen_within_m
        near = point_map.points[is_near]
        seen_from = near if point_map.seen_from is None else point_map.seen_from[is_near]
        self.points, self.seen_from = _thin(near, seen_from, config.target_voxel_m) if is_target else (near, seen_from)
        self.columns = GridIndex(self.points)
        self.positions = point_map.odom_T_keyframe[:, :3, 3]
        self.path = cKDTree(point_map.odom_T_sensor[:, :3, 3])
        self._fine = Surface(self.points) if is_target else None
        self._coarse = Surface(self.points, config.coarse_voxel_m) if is_target and has_coarse_target else None
        self.tree = self._fine.tree if self._fine else small_gicp.KdTree(self.points)

    @property
    def target(self) -> Surface:
        """The map as a surface to register to, its points in the order of `points`."""
        if self._fine is None:
            raise ValueError("this map was not indexed as a target")
        return self._fine

    @property
    def coarse_target(self) -> Surface:
        """The same, thinned to `merge.coarse_voxel_m`."""
        if self._coarse is None:
            raise ValueError("this map was not indexed as a target")
        return self._coarse

    def sphere(self, centre: Float64Array, radius_m: float) -> Float64Array:
        """Return the (N, 3) map points within `radius_m` of `centre` (3,)."""
        return self.columns.points_within(centre, radius_m)


def _thin(
    points: Float64Array, seen_from: Float64Array | Float32Array, voxel_m: float
) -> tuple[Float64Array, Float64Array]:
    """Return the means of the points of each cell and of where they were seen from, in the order of `GridIndex`."""
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
        config: Thinning and correspondence distances.
    """
    target_cloud, target_tree = small_gicp.preprocess_points(target_points, config.voxel_m, num_threads=1)
    # about the source's centre: small_gicp solves for a turn about the origin, which may be far away
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


def align_by_gicp(
    points: Float64Array,
    centre: Float64Array,
    target: Surface,
    initial_guess: Float64Array,
    correspondence_m: float,
    voxel_m: float,
    max_steps: int = 20,
) -> Float64Array:
    """Return the (4, 4) `target_T_source` of a sphere against an indexed map; finds its way from a metre off and more.

    Args:
        points: (N, 3) points of the sphere, source frame, metres.
        centre: (3,) its centre.
        target: What it is aligned with.
        initial_guess: (4, 4) `target_T_source` to start from.
        correspondence_m: Points farther apart than this are no pair.
        voxel_m: The sphere is thinned to this.
        max_steps: It ends after as many.
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
    """Return the (4, 4) `target_T_source` that brings a few hundred points onto the target's planes.

    Gauss-Newton on the distances along the target's normals. Needs no covariances of the points, which take GICP as
    long as the registration, but must start within decimetres. Ours, because small_gicp's PLANE_ICP sums the squares of
    n_x d_x, n_y d_y and n_z d_z instead of squaring n . d: it resists sliding along a plane, and depends on the frame.

    Args: as `align_by_gicp`.
    """
    pose = initial_guess @ make_pose(translation=centre)
    centred = points - centre
    for _ in range(_PLANE_STEPS):
        moved = transform(pose, centred)
        found, squared_m2 = target.tree.batch_nearest_neighbor_search(moved)
        is_pair = np.asarray(squared_m2) < correspondence_m**2
        if np.count_nonzero(is_pair) < _MIN_PAIRS:
            break
        chosen = np.asarray(found)[is_pair]
        distances_m = np.einsum("ij,ij->i", moved[is_pair] - target.points[chosen], target.normals[chosen])
        jacobian = plane_jacobian(centred[is_pair], target.normals[chosen] @ pose[:3, :3])
        step = -solve_point_to_plane(jacobian, distances_m, distances_m)
        pose = pose @ make_pose(Rotation.from_rotvec(step[:3]).as_matrix(), step[3:])
        if np.abs(step).max() < _PLANE_CONVERGED:  # metres, radians
            break
    return pose @ make_pose(translation=-centre)


def plane_jacobian(offsets: Float64Array, normals: Float64Array) -> Float64Array:
    """Return (N, 6) by how much each point moves along its normal if the cloud turns, and shifts, in its own axes.

    Args:
        offsets: (N, 3) points about the centre they turn around.
        normals: (N, 3) normals in the same axes.
    """
    (x, y, z), (a, b, c) = offsets.T, normals.T
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a, a, b, c], axis=1)


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


def eigenvalue_ratio(hessian: Float64Array) -> float:
    """Return the smallest to the largest eigenvalue of a symmetric (n, n) matrix; 0 for a zero matrix."""
    eigenvalues = np.linalg.eigvalsh(hessian)
    return float(eigenvalues[0] / eigenvalues[-1]) if eigenvalues[-1] > 0 else 0.0


def fit_rigid(positions: Float64Array, dst_T_src: Float64Array) -> Float64Array:
    """Return the one (4, 4) transform nearest to several, each of which holds around its own position.

    Positions and, 5 m about each, three axes are moved by each transform and fitted, so that a straight path leaves no
    roll open.

    Args:
        positions: (A, 3) source frame, metres.
        dst_T_src: (A, 4, 4) what holds there.
    """
    probes = positions[:, None] + np.concatenate([np.zeros((1, 3)), 5.0 * np.eye(3)])[None]
    moved = np.einsum("aij,apj->api", dst_T_src[:, :3, :3], probes) + dst_T_src[:, None, :3, 3]
    source, target = probes.reshape(-1, 3), moved.reshape(-1, 3)
    source_centre, target_centre = source.mean(axis=0), target.mean(axis=0)
    u, _, v = np.linalg.svd((target - target_centre).T @ (source - source_centre))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v
    return make_pose(rotation, target_centre - rotation @ source_centre)


def motion_between(one: Float64Array, other: Float64Array, position: Float64Array) -> tuple[float, float]:
    """Return by how many metres and radians two transforms (4, 4) differ at a position (3,) of their source frame."""
    shift = transform(one, position[None]) - transform(other, position[None])
    turn = invert(one)[:3, :3] @ other[:3, :3]
    return float(np.linalg.norm(shift)), float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1.0, 1.0)))
