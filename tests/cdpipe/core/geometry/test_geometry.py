import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import (
    invert,
    make_pose,
    require_poses,
    require_shape,
    stream,
    transform,
    travelled_m,
    yaw_pose,
    yaw_rad,
)
from cdpipe.model.report import ObjectShape


def test_yaw_pose_turns_then_moves() -> None:
    np.testing.assert_allclose(
        transform(yaw_pose(np.pi / 2, (1, 2, 3)), np.array([[1.0, 0, 0]])), [[1, 3, 3]], atol=1e-15
    )
    assert yaw_rad(yaw_pose(0.3)) == pytest.approx(0.3)
    assert Rotation.from_matrix((yaw_pose(-0.3))[:3, :3]).magnitude() == pytest.approx(0.3)


def test_inverse_of_one_pose_and_of_a_stack() -> None:
    stack = np.stack([yaw_pose(0.1 * k, (k, 2, -k)) for k in range(5)])
    np.testing.assert_allclose(invert(stack) @ stack, np.broadcast_to(np.eye(4), (5, 4, 4)), atol=1e-12)
    np.testing.assert_array_equal(invert(stack)[3], invert(stack[3]))


def test_travelled_path_is_a_running_sum() -> None:
    poses = np.stack([make_pose(translation=(x, 0, 0)) for x in (0, 3, 3, 1)])
    np.testing.assert_allclose(travelled_m(poses), [0, 3, 3, 5])


def test_wrong_arrays_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"points must be \(N, 3\), got \(4, 2\)"):
        require_shape("points", np.zeros((4, 2)), (None, 3))
    with pytest.raises(ValueError, match=r"box_m must be \(3\), got \(\)"):
        ObjectShape(np.eye(4), None, 1.0)  # type: ignore[arg-type]
    assert ObjectShape(np.eye(4), np.ones(3), 1.0).box_m.shape == (3,)
    poses = np.stack([np.eye(4)] * 3)
    poses[1, 0, 3] = np.nan
    with pytest.raises(ValueError, match=r"poses\[1\] is not finite"):
        require_poses("poses", poses)
    poses[1] = np.diag([1.0, 1.0, -1.0, 1.0])
    with pytest.raises(ValueError, match=r"poses\[1\]"):
        require_poses("poses", poses)


def test_streams_differ_by_purpose_and_repeat_by_seed() -> None:
    one = stream(7, "after", "noise").random(4)
    np.testing.assert_array_equal(one, stream(7, "after", "noise").random(4))
    assert (one != stream(7, "before", "noise").random(4)).all()
    assert (one != stream(8, "after", "noise").random(4)).all()
