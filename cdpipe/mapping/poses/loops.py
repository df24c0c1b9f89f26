"""Loops of a session: where it comes through a place that it knows, and poses that agree there.

A place is known if an earlier pass led through it. Candidates are near to one another under the poses so far. The map
around the one is registered with the map around the other from several starts along the path. A loop is accepted if
both agree (`_MIN_INLIERS`), if no other start agrees as well (`_RIVAL`), if both ways find the same motion, and if a
neighbouring loop of the same two passes says the same. Accepted loops and the odometry between them make a pose graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, Int64Array, invert, make_pose, transform
from cdpipe.core.geometry.path_frames import path_frames
from cdpipe.mapping.poses.scan_registration import MIN_PAIRS, Registration, Samples, Target, register_scan, spread

# Places are this far apart along the path; those closer than the second are no two passes.
_SPACING_M, _APART_M = 4.0, 25.0
# Two passes are candidates within this distance, which grows with the path between them.
_NEAR_M, _NEAR_SHARE = 3.0, 0.03
_MOST_PASSES = 4
# Half the path that makes the map around a place: of the one that is registered, and of its target.
_AROUND_M, _TARGET_M = 4.0, 10.0
# Starts along the path of the target, and the registrations one after the other.
_STARTS_M = (0.0, -2.0, 2.0, -4.0, 4.0)
_FREE_M, _FREE_RAD = 10.0, 1.0
_FINE = Registration(0.3, 0.5, 0.1, _FREE_M, _FREE_RAD)
_REGISTRATIONS = (
    Registration(0.3, 2.0, 0.5, _FREE_M, _FREE_RAD),
    Registration(0.3, 1.0, 0.3, _FREE_M, _FREE_RAD),
    _FINE,
)
# Points that have a counterpart and lie this near to its plane, as a share of those with a counterpart this near.
_INLIER_M, _COUNTERPART_M = 0.1, 1.5
_MIN_INLIERS, _RIVAL, _OTHER_M = 0.85, 0.95, 0.5
_BOTH_WAYS_M, _BOTH_WAYS_RAD = 0.1, np.deg2rad(1.0)
# Neighbouring loops of the same passes: farthest apart along the path, and what their motions may differ by.
_NEIGHBOUR_M, _SAME_M, _SAME_SHARE = 10.0, 0.2, 0.03
# Pose graph: spacing of its nodes, standard deviations of the odometry over a metre and of a loop.
_NODE_M = 2.0
_ODOMETRY_M, _ODOMETRY_RAD = 0.015, np.deg2rad(0.07)
_LOOP_M, _LOOP_RAD = 0.03, np.deg2rad(0.1)
_GRAPH_STEPS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """Two scans of one session that saw the same place.

    Attributes:
        scan: The later scan.
        other: The earlier one.
        other_T_scan: (4, 4) pose of the later in the earlier.
    """

    scan: int
    other: int
    other_T_scan: Float64Array


def find_loops(scans: Samples, poses: Float64Array) -> tuple[Loop, ...]:
    """Return the loops of a session that passed all gates.

    Args:
        scans: The scans.
        poses: (S, 4, 4) poses that agree along the path, odom frame.
    """
    candidates, found = _find_candidates(scans.path_m, poses), []
    odom_T_path = path_frames(poses, np.array([other for _, other in candidates], dtype=np.int64))
    for (scan, other), ahead in zip(candidates, odom_T_path[:, :3, 0], strict=True):
        other_T_scan = _register_places(scans, poses, scan, other, ahead)
        if other_T_scan is not None:
            found.append(Loop(scan, other, other_T_scan))
    at_m = scans.path_m[[loop.scan for loop in found]]  # in order, so neighbours are neighbours in the list
    first = np.searchsorted(at_m, at_m - _NEIGHBOUR_M, side="left")
    end = np.searchsorted(at_m, at_m + _NEIGHBOUR_M, side="right")
    return tuple(
        loop
        for loop, a, b in zip(found, first, end, strict=True)
        if _is_confirmed(loop, found[a:b], scans.path_m, poses)
    )


def close_loops(path_m: Float64Array, poses: Float64Array, loops: tuple[Loop, ...]) -> Float64Array:
    """Return the (S, 4, 4) poses of the pose graph of odometry and loops; the first scan keeps its pose.

    Args:
        path_m: (S,) path length at every scan.
        poses: (S, 4, 4) poses that agree along the path; the steps between them are the odometry.
        loops: Closed loops.
    """
    nodes = _choose_places(path_m, _NODE_M)
    nodes = np.unique(np.concatenate([nodes, [len(poses) - 1], *([loop.scan, loop.other] for loop in loops)]))
    first, second = np.arange(len(nodes) - 1), np.arange(1, len(nodes))
    ends = np.searchsorted(nodes, np.array([[loop.other, loop.scan] for loop in loops]).reshape(-1, 2))
    pairs = np.concatenate([np.column_stack([first, second]), ends])
    measured = np.concatenate(
        [invert(poses[nodes[:-1]]) @ poses[nodes[1:]], *(loop.other_T_scan[None] for loop in loops)]
    )
    way_m = np.maximum(np.diff(path_m[nodes]), 0.1)[:, None]
    of_odometry = np.repeat([1 / _ODOMETRY_RAD**2, 1 / _ODOMETRY_M**2], 3) / way_m
    of_loops = np.tile(np.repeat([1 / _LOOP_RAD**2, 1 / _LOOP_M**2], 3), (len(loops), 1))
    solved = _solve_graph(poses[nodes], pairs, measured, np.concatenate([of_odometry, of_loops]))
    return _between_nodes(path_m, poses, nodes, solved)


def _choose_places(path_m: Float64Array, spacing_m: float) -> Int64Array:
    """Return the first scan of every stretch of path."""
    return np.unique(np.floor(path_m / spacing_m), return_index=True)[1].astype(np.int64)


def _find_candidates(path_m: Float64Array, poses: Float64Array) -> list[tuple[int, int]]:
    """Return pairs of scans, the later first, that may have seen one place on two passes; of each pass the nearest.

    Of more than four earlier passes four are asked, so that time grows with the path and not with its square.
    """
    places = _choose_places(path_m, _SPACING_M)
    positions = poses[:, :3, 3]
    candidates: list[tuple[int, int]] = []
    for scan in places.tolist():
        between_m = path_m[scan] - path_m
        away_m = np.linalg.norm(positions - positions[scan], axis=1)
        is_near = (between_m >= _APART_M) & (away_m <= _NEAR_M + _NEAR_SHARE * between_m)
        near = np.flatnonzero(is_near)
        passes = np.split(near, np.flatnonzero(np.diff(path_m[near]) > _APART_M) + 1)
        nearest = [int(one[np.argmin(away_m[one])]) for one in passes if len(one)]
        if len(nearest) > _MOST_PASSES:  # the first, the last and the nearest of the others tie all passes together
            others = sorted(nearest[1:-1], key=lambda each: float(away_m[each]))[: _MOST_PASSES - 2]
            nearest = sorted((nearest[0], nearest[-1], *others))
        candidates += [(scan, each) for each in nearest]
    return candidates


class _Place:
    """The map around one scan, in its sensor's frame: points to be registered, and a target."""

    def __init__(self, scans: Samples, poses: Float64Array, scan: int) -> None:
        way_m = np.abs(scans.path_m - scans.path_m[scan])
        near = np.flatnonzero(way_m <= _TARGET_M)
        scan_T_others = np.empty_like(poses)  # those of near scans are used
        scan_T_others[near] = invert(poses[scan]) @ poses[near]
        around = spread(np.flatnonzero(way_m <= _AROUND_M))
        points = np.concatenate([transform(scan_T_others[k], scans.of_scan(k)) for k in around.tolist()])
        self.points = points[np.einsum("ij,ij->i", points, points) < (2 * _AROUND_M) ** 2]
        self.target = Target(scans, scan_T_others, near, np.zeros(3), _FINE.voxel_m)

    def align(
        self, other: _Place, start: Float64Array, registrations: Sequence[Registration]
    ) -> tuple[Float64Array, float]:
        """Return the (4, 4) other_T_self from a start, and the share of points that lie on the other's surface."""
        pose = start
        for settings in registrations:
            pose = register_scan(self.points, pose, [pose], other.target, settings).pose
        found, distances_m, _ = other.target.planes(transform(pose, self.points), _COUNTERPART_M)
        if len(found) < max(MIN_PAIRS, len(self.points) / 2):
            return pose, 0.0
        return pose, float(np.mean(np.abs(distances_m) <= _INLIER_M))


def _register_places(
    scans: Samples, poses: Float64Array, scan: int, other: int, ahead: Float64Array
) -> Float64Array | None:
    """Return the (4, 4) other_T_scan of two places, None where a gate refuses it.

    Other starts lie along (3,) `ahead`, the unit direction of the path at the other place, odom frame.
    """
    here, there = _Place(scans, poses, scan), _Place(scans, poses, other)
    start = invert(poses[other]) @ poses[scan]
    ahead_other = poses[other, :3, :3].T @ ahead
    starts = [make_pose(translation=shift_m * ahead_other) @ start for shift_m in _STARTS_M]
    found = [here.align(there, each, _REGISTRATIONS) for each in starts]
    best_pose, best = max(found, key=lambda each: each[1])
    rivals = [share for pose, share in found if np.linalg.norm((pose - best_pose)[:3, 3]) > _OTHER_M]
    if best < _MIN_INLIERS or max(rivals, default=0.0) > _RIVAL * best:
        return None
    back, _ = there.align(here, invert(best_pose), [_FINE])
    error = back @ best_pose
    turn_rad = Rotation.from_matrix(error[:3, :3]).magnitude()
    agree = np.linalg.norm(error[:3, 3]) <= _BOTH_WAYS_M and turn_rad <= _BOTH_WAYS_RAD
    return best_pose if agree else None


def _is_confirmed(loop: Loop, nearby: list[Loop], path_m: Float64Array, poses: Float64Array) -> bool:
    """Return whether a neighbouring loop of the same passes says the same, up to the odometry between them."""
    for each in nearby:
        way_m = max(abs(path_m[each.scan] - path_m[loop.scan]), abs(path_m[each.other] - path_m[loop.other]))
        if each is loop or way_m > _NEIGHBOUR_M:
            continue
        predicted = invert(poses[loop.other]) @ poses[each.other] @ each.other_T_scan
        predicted = predicted @ invert(poses[each.scan]) @ poses[loop.scan]
        if np.linalg.norm((predicted - loop.other_T_scan)[:3, 3]) <= _SAME_M + _SAME_SHARE * way_m:
            return True
    return False


def _solve_graph(
    poses: Float64Array, pairs: Int64Array, measured: Float64Array, information: Float64Array
) -> Float64Array:
    """Return the (N, 4, 4) most likely poses by Gauss-Newton; the first one is held.

    Args:
        poses: (N, 4, 4) first poses.
        pairs: (E, 2) nodes of each edge.
        measured: (E, 4, 4) pose of the second node in the first.
        information: (E, 6) inverse variances of rotation and translation.
    """
    n = len(poses)
    for _ in range(_GRAPH_STEPS):
        between = invert(poses[pairs[:, 0]]) @ poses[pairs[:, 1]]
        errors = invert(measured) @ between
        residuals = np.hstack([Rotation.from_matrix(errors[:, :3, :3]).as_rotvec(), errors[:, :3, 3]])
        second = np.repeat(np.eye(6)[None], len(pairs), axis=0)
        second[:, 3:, 3:] = errors[:, :3, :3]
        first = -second @ _adjoints(invert(between))
        blocks, gradient = [], np.zeros((n, 6))
        for jacobian, node in ((first, pairs[:, 0]), (second, pairs[:, 1])):
            weighted = np.swapaxes(jacobian, 1, 2) * information[:, None]
            np.add.at(gradient, node, np.einsum("eij,ej->ei", weighted, residuals))
            for other, column in ((first, pairs[:, 0]), (second, pairs[:, 1])):
                blocks.append((node, column, weighted @ other))
        held = (np.zeros(1, np.int64), np.zeros(1, np.int64), 1e12 * np.eye(6)[None])
        step = spsolve(_assemble([*blocks, held], n), -gradient.ravel()).reshape(n, 6)
        poses = poses @ make_pose(Rotation.from_rotvec(step[:, :3]).as_matrix(), step[:, 3:])
    return poses


def _adjoints(poses: Float64Array) -> Float64Array:
    """Return the (E, 6, 6) matrices that carry a motion (rotation, translation) from one frame into another."""
    rotations = poses[:, :3, :3]
    result = np.zeros((len(poses), 6, 6))
    result[:, :3, :3] = result[:, 3:, 3:] = rotations
    result[:, 3:, :3] = -np.cross(poses[:, None, :3, 3], np.eye(3)[None]) @ rotations
    return result


def _assemble(blocks: list[tuple[Int64Array, Int64Array, Float64Array]], n: int) -> csc_matrix:
    rows, columns, values = [], [], []
    row, column = np.divmod(np.arange(36), 6)
    for first, second, block in blocks:
        rows.append((6 * first[:, None] + row).ravel())
        columns.append((6 * second[:, None] + column).ravel())
        values.append(block.reshape(-1))
    shape = (6 * n, 6 * n)
    return coo_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape).tocsc()


def _between_nodes(path_m: Float64Array, poses: Float64Array, nodes: Int64Array, solved: Float64Array) -> Float64Array:
    """Return the (S, 4, 4) poses: the motions of both neighbouring nodes, blended along the path."""
    after = np.clip(np.searchsorted(nodes, np.arange(len(poses)), side="right"), 1, len(nodes) - 1)
    before = after - 1
    motions = solved @ invert(poses[nodes])
    way_m = np.maximum(path_m[nodes[after]] - path_m[nodes[before]], 1e-9)
    share = np.clip((path_m - path_m[nodes[before]]) / way_m, 0, 1)[:, None]
    by_before, by_after = motions[before] @ poses, motions[after] @ poses
    positions = (1 - share) * by_before[:, :3, 3] + share * by_after[:, :3, 3]
    turn = Rotation.from_matrix(np.swapaxes(by_before[:, :3, :3], 1, 2) @ by_after[:, :3, :3]).as_rotvec()
    return make_pose(by_before[:, :3, :3] @ Rotation.from_rotvec(share * turn).as_matrix(), positions)
