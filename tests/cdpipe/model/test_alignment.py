from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, invert, make_pose, stream, transform, yaw_pose
from cdpipe.model.alignment import PathAlignment

RIGID = make_pose(Rotation.from_euler("xyz", [0.02, -0.01, 2.1]).as_matrix(), (30.0, -12.0, 1.0))
STRAIN, BEND_DEG = 0.01, 1.0  # of the after odometry on every 100 m: a metre and a degree


def drifted(length_m: float = 100.0) -> PathAlignment:
    """An after odometry that stretches the way by 1 % and turns by 1 degree in 100 m, in a winding tunnel."""
    along = np.arange(0.0, length_m + 0.5)
    error_rad = np.radians(BEND_DEG) * along / 100.0
    heading = 0.3 * np.sin(along / 30.0)
    odom, world = (
        np.concatenate([[(0, 0, 0)], np.cumsum(np.column_stack([np.cos(h), np.sin(h), 0 * h])[:-1] * scale, axis=0)])
        for h, scale in ((heading, 1.0), (heading + error_rad, 1 + STRAIN))
    )
    turns = Rotation.from_rotvec(np.outer(error_rad, (0, 0, 1))).as_matrix()
    poses = [make_pose(turn, there - turn @ here) for turn, there, here in zip(turns, world, odom, strict=True)]
    return PathAlignment(odom, RIGID @ np.array(poses))


def tunnel(alignment: PathAlignment, n: int = 20_000) -> Float64Array:
    """Points up to 6 m around the anchors."""
    rng = stream(0, "around a path")
    offsets = rng.normal(size=(n, 3))
    offsets *= rng.uniform(1, 6, (n, 1)) / np.linalg.norm(offsets, axis=1, keepdims=True)
    return np.asarray(alignment.anchors_odom[rng.integers(0, len(alignment.anchors_odom), n)] + offsets)


def blended_by_hand(alignment: PathAlignment, point: Float64Array) -> Float64Array:
    """All anchors' opinions of one point, weighed by a Gaussian of 2 m of their distance."""
    squared = ((alignment.anchors_odom - point) ** 2).sum(axis=1)
    weights = np.exp(-(squared - squared.min()) / 8.0)
    opinions = np.array([transform(pose, point[None])[0] for pose in alignment.before_T_after])
    return np.asarray((weights[:, None] * opinions).sum(axis=0) / weights.sum())


def test_a_rigid_alignment_is_the_transform_to_the_last_bit() -> None:
    alignment = PathAlignment.rigid(RIGID)
    points = tunnel(drifted())
    assert alignment.is_rigid
    np.testing.assert_array_equal(alignment.to_map(points), transform(RIGID, points))
    np.testing.assert_array_equal(alignment.to_odom(points), transform(invert(RIGID), points))
    np.testing.assert_array_equal(alignment.at(points[:5]), np.stack([RIGID] * 5))


@pytest.mark.parametrize("n_anchors", [2, 3, 100])
def test_anchors_that_agree_are_one_transform(n_anchors: int) -> None:
    anchors = stream(1, "anchors").uniform(-20, 20, (n_anchors, 3))
    alignment = PathAlignment(anchors, np.stack([RIGID] * n_anchors))
    points = tunnel(alignment)
    assert not alignment.is_rigid
    np.testing.assert_allclose(alignment.to_map(points), transform(RIGID, points), atol=1e-9)
    np.testing.assert_allclose(alignment.to_odom(points), transform(invert(RIGID), points), atol=1e-9)
    np.testing.assert_allclose(alignment.at(points[:50]), np.stack([RIGID] * 50), atol=1e-9)


def test_points_are_where_all_anchors_together_put_them() -> None:
    alignment = drifted()
    points = tunnel(alignment)
    moved = alignment.to_map(points)
    for number in range(0, len(points), 200):
        expected = blended_by_hand(alignment, points[number])
        assert np.linalg.norm(moved[number] - expected) < 1e-3
        # a single point is not interpolated between the corners of a cell
        np.testing.assert_allclose(alignment.to_map(points[number, None])[0], expected, atol=2e-4)


def test_between_two_anchors_by_hand() -> None:
    # 1 m apart; at a quarter the squared distances differ by 0.5: weights 1 and exp(-0.5 / 8)
    anchors = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    poses = np.stack([make_pose(), make_pose(translation=(0, 0, 0.1))])
    share = np.exp(-0.5 / 8) / (1 + np.exp(-0.5 / 8))
    moved = PathAlignment(anchors, poses).to_map(np.array([[0.25, 0, 0], [0.5, 7, 0]]))
    np.testing.assert_allclose(moved, [[0.25, 0, 0.1 * share], [0.5, 7, 0.05]], atol=1e-12)


@pytest.mark.parametrize("n_points", [40, 20_000])
def test_a_small_step_stays_small(n_points: int) -> None:
    alignment = drifted()
    points = tunnel(alignment, n_points)
    step = 1e-3 * stream(2, "steps").normal(size=points.shape)
    steps = np.linalg.norm(alignment.to_map(points + step) - alignment.to_map(points), axis=1)
    lengths = np.linalg.norm(step, axis=1)
    # 1 % longer along the path; what is left out of the blend makes a jump of some micrometres
    np.testing.assert_allclose(steps, lengths, rtol=0.02, atol=2e-5)


def test_along_the_path_nothing_jumps() -> None:
    alignment = drifted()
    along = np.linspace(alignment.anchors_odom[50], alignment.anchors_odom[53], 3001)
    path = alignment.to_map(along[::30]), np.concatenate([alignment.to_map(point[None]) for point in along[::30]])
    for moved in path:
        steps = np.linalg.norm(np.diff(moved, axis=0), axis=1)
        assert steps.max() < 1.01 * steps.mean()


def test_there_and_back_is_within_millimetres() -> None:
    alignment = drifted()
    # the first and the last anchor do differ: by a metre and a degree
    first, last = alignment.before_T_after[0], alignment.before_T_after[-1]
    end = alignment.anchors_odom[-1:]
    assert np.linalg.norm(transform(first, end) - transform(last, end)) > 0.9
    assert Rotation.from_matrix((invert(first) @ last)[:3, :3]).magnitude() == pytest.approx(np.radians(1.0))
    points = tunnel(alignment)
    back = alignment.to_odom(alignment.to_map(points))
    assert np.linalg.norm(back - points, axis=1).max() < 2e-3
    centre = alignment.to_odom(alignment.to_map(points[:1]))
    assert np.linalg.norm(centre - points[:1]) < 2e-3


def test_the_poses_are_rigid_and_agree_with_the_points() -> None:
    alignment = drifted()
    positions = tunnel(alignment, 500)
    poses = alignment.at(positions)
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].swapaxes(1, 2), np.stack([np.eye(3)] * 500), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0, atol=1e-12)
    np.testing.assert_array_equal(poses[:, 3], np.tile([0.0, 0, 0, 1], (500, 1)))
    moved = np.einsum("nij,nj->ni", poses[:, :3, :3], positions) + poses[:, :3, 3]
    np.testing.assert_allclose(moved, [blended_by_hand(alignment, place) for place in positions], atol=2e-4)
    middle = alignment.at(alignment.anchors_odom[50, None])[0]
    turned = invert(alignment.before_T_after[50]) @ middle
    assert np.degrees(Rotation.from_matrix(turned[:3, :3]).magnitude()) < 0.01


def test_far_from_the_path_the_nearest_anchors_decide() -> None:
    alignment = drifted()
    far = np.array([[-5000.0, 0, 0], [0, 0, 5000.0]])
    first = transform(alignment.before_T_after[0], far[:1])
    moved = alignment.to_map(far)
    assert np.isfinite(moved).all()
    np.testing.assert_allclose(moved[0], first[0], atol=0.1)
    assert np.isfinite(alignment.at(far)).all()
    assert np.linalg.norm(alignment.to_odom(moved) - far, axis=1).max() < 1.0


def test_moving_both_frames_moves_the_answer() -> None:
    alignment = drifted()
    g, h = yaw_pose(-2.1, (400.0, -90.0, 7.0)), yaw_pose(1.3, (-50.0, 800.0, -3.0))
    other = PathAlignment(transform(h, alignment.anchors_odom), g @ alignment.before_T_after @ invert(h))
    points = tunnel(alignment, 3000)
    few = points[:40]
    np.testing.assert_allclose(other.to_map(transform(h, few)), transform(g, alignment.to_map(few)), atol=1e-8)
    np.testing.assert_allclose(other.at(transform(h, few)), g @ alignment.at(few) @ invert(h), atol=1e-8)
    # many points are interpolated in a grid of their frame
    np.testing.assert_allclose(other.to_map(transform(h, points)), transform(g, alignment.to_map(points)), atol=2e-3)


def test_no_points_and_no_anchors() -> None:
    alignment = drifted()
    none = np.zeros((0, 3))
    assert alignment.to_map(none).shape == alignment.to_odom(none).shape == (0, 3)
    assert alignment.at(none).shape == (0, 4, 4)
    with pytest.raises(ValueError, match="needs an anchor"):
        PathAlignment(none, np.zeros((0, 4, 4)))
    with pytest.raises(ValueError, match=r"points must be \(N, 3\), got \(4, 2\)"):
        alignment.to_map(np.zeros((4, 2)))
