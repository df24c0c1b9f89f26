import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, invert, stream, transform, yaw_pose, yaw_rad
from cdpipe.core.geometry.voxel import cell_means
from cdpipe.extract.shape import column_volume_m3, ground_heights, upright_box
from cdpipe.model.report import ObjectShape

NOTHING = np.zeros((0, 3))


def sheet(half_m: float, height: float = 0.0, step_m: float = 0.05) -> Float64Array:
    """A level square about the origin."""
    axis = np.arange(-half_m + step_m / 2, half_m, step_m)
    x, y = np.meshgrid(axis, axis)
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height)])


def measure(points: Float64Array, ground: Float64Array) -> ObjectShape:
    return ObjectShape(*upright_box(points), column_volume_m3(points, ground))


def cone(radius_m: float, height_m: float) -> Float64Array:
    """The skin of a cone that stands at the origin, down to the floor."""
    points = sheet(radius_m + 0.1, step_m=0.02)
    points[:, 2] = height_m * (1 - np.linalg.norm(points[:, :2], axis=1) / radius_m)
    return points[points[:, 2] >= 0.0]


def box_faces(size: tuple[float, float, float], with_top: bool = True) -> Float64Array:
    """The upright faces and the top of a box that stands on the floor at the origin, borders included."""
    x, y, z = (np.linspace(0, edge, round(edge / 0.05) + 1) for edge in size)
    low_x, low_y = size[0] / 2, size[1] / 2
    faces = [np.stack(np.meshgrid(x, [0.0, size[1]], z, indexing="ij"), axis=-1)]
    faces += [np.stack(np.meshgrid([0.0, size[0]], y, z, indexing="ij"), axis=-1)]
    if with_top:
        faces += [np.stack(np.meshgrid(x, y, [size[2]], indexing="ij"), axis=-1)]
    return np.concatenate([face.reshape(-1, 3) for face in faces]) - (low_x, low_y, 0.0)


@pytest.mark.parametrize("yaw_deg", [0.0, 13.0, 45.0, 89.0, -90.0, 120.0, 180.0])
def test_the_box_around_a_turned_box_is_that_box(yaw_deg: float) -> None:
    pose = yaw_pose(np.deg2rad(yaw_deg), (20.0, -7.0, 1.5))
    map_T_box, box_m = upright_box(transform(pose, box_faces((1.6, 0.8, 1.1))))
    np.testing.assert_allclose(box_m, [1.6, 0.8, 1.1], atol=1e-9)
    np.testing.assert_allclose(map_T_box[:3, 3], [20.0, -7.0, 1.5 + 0.55], atol=1e-9)
    assert -90.0 <= np.rad2deg(yaw_rad(map_T_box)) < 90.0 + 1e-9
    turns = (np.rad2deg(yaw_rad(map_T_box)) - yaw_deg) / 180  # a box turned by half a turn is the same box
    assert turns == pytest.approx(round(turns), abs=1e-9)
    np.testing.assert_allclose(map_T_box[2, :3], [0, 0, 1], atol=1e-12)


def test_no_upright_box_is_smaller() -> None:
    generator = stream(3, "shape", "clouds")
    for _ in range(8):
        points = generator.normal(size=(15, 3)) * (2.0, 1.0, 0.5)
        map_T_box, box_m = upright_box(points)
        inside = np.abs(transform(invert(map_T_box), points))
        assert (inside <= box_m / 2 + 1e-9).all()
        areas = [np.ptp(transform(yaw_pose(yaw), points)[:, :2], axis=0).prod() for yaw in np.arange(0, np.pi, 2e-3)]
        assert box_m[0] * box_m[1] <= min(areas) + 1e-9
        assert box_m[0] * box_m[1] == pytest.approx(min(areas), rel=5e-3)
        assert box_m[0] >= box_m[1]


def test_a_cone_on_a_floor_has_the_volume_of_a_cone() -> None:
    volume = np.pi * 1.5**2 * 0.9 / 3
    assert column_volume_m3(cone(1.5, 0.9), sheet(3.0)) == pytest.approx(volume, rel=0.02)
    # two false returns far below the floor are not it
    false = np.array([[0.3, 0.2, -2.0], [-0.5, 0.4, -3.0]])
    assert column_volume_m3(cone(1.5, 0.9), np.concatenate([sheet(3.0), false])) == pytest.approx(volume, rel=0.02)
    # nor is the roof above it
    roofed = np.concatenate([sheet(3.0), sheet(3.0, 4.0)])
    assert column_volume_m3(cone(1.5, 0.9), roofed) == pytest.approx(volume, rel=0.02)


def test_what_was_hidden_behind_the_crest_is_interpolated() -> None:
    skin = cone(1.5, 0.9)
    is_hidden = (np.abs(skin[:, 0] - 0.7) < 0.3) & (np.abs(skin[:, 1]) < 0.4)
    assert column_volume_m3(skin[~is_hidden], sheet(3.0)) == pytest.approx(np.pi * 1.5**2 * 0.3, rel=0.03)


def test_a_slope_below_a_pile_is_not_counted() -> None:
    sloped = sheet(3.0)
    sloped[:, 2] += 0.12 * sloped[:, 0]
    skin = cone(1.5, 0.9)
    skin[:, 2] += 0.12 * skin[:, 0]
    assert column_volume_m3(skin, sloped) == pytest.approx(np.pi * 1.5**2 * 0.3, rel=0.02)


def test_without_another_session_an_object_stands_on_its_lowest_point() -> None:
    assert column_volume_m3(cone(1.5, 0.9), NOTHING) == pytest.approx(np.pi * 1.5**2 * 0.3, rel=0.02)


def test_what_hangs_is_measured_up_to_the_roof() -> None:
    # the underside of a box of 1 m x 1 m x 0.3 m below a roof
    assert column_volume_m3(sheet(0.5, 0.7), sheet(1.5, 1.0)) == pytest.approx(0.9**2 * 0.3, rel=0.05)


def test_what_hangs_in_the_air_or_on_a_wall_is_measured_down_to_itself() -> None:
    size = (1.0, 0.6, 0.4)
    hung = box_faces(size, True) + np.array([0.0, 0.0, 1.2])
    wall = np.stack(np.meshgrid(np.linspace(-2, 2, 41), [0.31], np.linspace(0.3, 2.6, 24)), axis=-1).reshape(-1, 3)
    for other in (NOTHING, sheet(2.0), wall):
        assert column_volume_m3(hung, other) == pytest.approx(np.prod(size), rel=0.1)
    # of a lid, or the upper quarter of a metre, nobody knows how deep it reaches: to the floor
    assert column_volume_m3(sheet(0.5, 0.8), sheet(2.0)) == pytest.approx(0.9**2 * 0.8, rel=0.05)
    top = box_faces((1.0, 0.6, 0.25), True) + np.array([0.0, 0.0, 0.55])
    assert column_volume_m3(top, sheet(2.0)) == pytest.approx(0.6 * 0.8, rel=0.1)


def test_what_was_loaded_away_is_measured_down_to_what_is_left() -> None:
    # a block 2 m x 2 m x 1 m of which a wedge is gone: nothing at y = -1, all of it at y = +1
    taken, left = sheet(1.0, 1.0), sheet(1.0, 1.0)
    left[:, 2] = 1.0 - (left[:, 1] + 1.0) / 2
    # triangles reach from the middle of the outermost columns only: 1.9 m of 2 m each way
    assert column_volume_m3(taken, left) == pytest.approx(1.9 * 1.9 * 0.5, rel=0.02)


@pytest.mark.parametrize("with_top", [True, False])
def test_a_box_fills_its_footprint_whether_its_top_was_seen_or_not(with_top: bool) -> None:
    size = (1.2, 0.9, 1.0)
    volume = column_volume_m3(box_faces(size, with_top), sheet(2.0))
    assert volume == pytest.approx(1.2 * 0.9 * 1.0, rel=0.08)


def test_turning_the_map_turns_the_box_and_leaves_the_volume() -> None:
    rubble = cone(1.2, 0.7) * (1.4, 0.8, 1.0)
    floor = sheet(3.0)
    shape = measure(rubble, floor)
    for yaw, shift in ((0.4, (3.0, 1.0, 0.3)), (2.3, (-40.0, 7.0, -2.0))):
        turn = yaw_pose(yaw, shift)
        turned = measure(transform(turn, rubble), transform(turn, floor))
        assert turned.volume_m3 == pytest.approx(shape.volume_m3, rel=0.01)
        np.testing.assert_allclose(turned.box_m, shape.box_m, rtol=1e-3)
        np.testing.assert_allclose(turned.map_T_box[:3, 3], (turn @ shape.map_T_box)[:3, 3], atol=2e-3)


def test_boxes_of_next_to_nothing() -> None:
    one = np.array([[1.0, 2.0, 3.0]])
    for points in (one, np.repeat(one, 3, axis=0)):
        shape = measure(points, sheet(3.0))
        np.testing.assert_allclose(shape.map_T_box[:3, 3], [1, 2, 3])
        assert (shape.box_m.tolist(), shape.volume_m3) == ([0, 0, 0], 0.0)
    line = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 1.0], [1.5, 2.0, 0.2]])
    shape = measure(line, NOTHING)
    np.testing.assert_allclose(shape.box_m, [5.0, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(shape.map_T_box[:3, 0], [0.6, 0.8, 0.0], atol=1e-9)
    assert shape.volume_m3 == 0.0


def test_ground_by_hand() -> None:
    # one column with 0.3 and 0.1 in it: the lower one; of three columns the median
    surface = np.array([[0.05, 0.05, 0.3], [0.06, 0.05, 0.1], [0.25, 0.05, 0.2], [0.45, 0.05, 0.9]])
    np.testing.assert_allclose(ground_heights(surface, np.zeros((2, 2))), [0.2, 0.2])
    np.testing.assert_allclose(ground_heights(NOTHING, np.array([[0.0, 0, 4], [1, 1, 3]])), [3.0, 3.0])


def test_means_of_cells_by_hand() -> None:
    means, cells = cell_means(np.array([[0.01, 0.0, 0.0], [0.03, 0.0, 0.0], [0.07, 0.0, 0.0]]), 0.05)
    np.testing.assert_allclose(means, [[0.02, 0, 0], [0.07, 0, 0]])
    assert cells.tolist() == [0, 0, 1]
