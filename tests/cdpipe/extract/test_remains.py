import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, stream, yaw_pose
from cdpipe.core.geometry.voxel import cell_means
from cdpipe.extract.remains import is_heap, is_part_of_remainder

STEP_M = 0.2
AXIS = np.arange(-4.0, 4.0, STEP_M) + 0.1
X, Y = (grid.ravel() for grid in np.meshgrid(AXIS, AXIS))
FLOOR = np.column_stack([X, Y, np.zeros(X.size)])


def skin(heights: Float64Array) -> Float64Array:
    return np.column_stack([X, Y, heights])


def pile_m(height_m: float = 0.8, slope: float = 0.65) -> Float64Array:
    """Heights of a pile about the origin, 0 beside it."""
    return np.maximum(height_m - slope * np.maximum(np.hypot(X / 1.6, Y) - 0.2, 0.0), 0.0)


def block(low: tuple[float, float, float], high: tuple[float, float, float]) -> Float64Array:
    axes = [np.arange(a, b + 1e-9, STEP_M) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def test_a_pile_with_a_bite_out_of_it_is_a_rest() -> None:
    whole = pile_m()
    left = np.minimum(whole, np.maximum((0.3 - X) * 1.2, 0.0))  # a face of 50 degrees that rises towards -x
    is_taken = whole - left > 0.1
    taken, rest, after = skin(whole)[is_taken], skin(whole)[~is_taken], skin(left)
    assert is_part_of_remainder(taken, rest, after)
    # the same skin, but of the rest nothing stands any more
    assert not is_part_of_remainder(taken, rest, FLOOR)


def test_a_pile_that_went_as_a_whole_left_no_rest() -> None:
    whole = pile_m()
    is_taken = whole > 0.0
    assert not is_part_of_remainder(skin(whole)[is_taken], skin(whole)[~is_taken], FLOOR)
    # nor where its outermost ring was not recognised as a part of it
    is_taken = whole > 0.12
    assert not is_part_of_remainder(skin(whole)[is_taken], skin(whole)[~is_taken], FLOOR)


def test_a_wall_is_not_what_is_left_of_a_pile_against_it() -> None:
    banked = np.where(Y < 1.0, pile_m(0.9, 0.5), 0.0)
    wall = block((-4.0, 1.1, 0.0), (4.0, 1.1, 2.4))
    is_taken = banked > 0.1
    front = Y < 1.0
    rest = np.concatenate([skin(banked)[~is_taken & front], wall])
    assert not is_part_of_remainder(skin(banked)[is_taken], rest, np.concatenate([FLOOR[front], wall]))


def test_a_crate_beside_another_that_stays_was_whole() -> None:
    gone, stays = block((0.0, 0.0, 0.2), (0.8, 0.6, 0.6)), block((1.4, 0.0, 0.2), (2.2, 0.6, 0.6))
    rest = np.concatenate([FLOOR, stays])
    assert not is_part_of_remainder(gone, rest, rest)


def on_slope(points: Float64Array, slope_deg: float, heading_rad: float, purpose: str) -> Float64Array:
    """Points on a floor that rises by a slope in a heading, as a map with cells of 0.2 m anywhere on it has them."""
    draw = stream(3, "slope", purpose)
    corner = stream(3, "corner", f"{heading_rad}").uniform(0.0, STEP_M, 3)
    slope = np.deg2rad(slope_deg)
    tilt = np.array([[np.cos(slope), 0, -np.sin(slope)], [0, 1, 0], [np.sin(slope), 0, np.cos(slope)]])
    noisy = points + draw.normal(scale=0.02, size=points.shape)
    return cell_means(noisy @ (yaw_pose(heading_rad)[:3, :3] @ tilt).T + corner, STEP_M)[0]


def dense_floor() -> Float64Array:
    axis = np.arange(-2.5, 2.5, 0.05)
    x, y = (grid.ravel() for grid in np.meshgrid(axis, axis))
    return np.column_stack([x, y, 0.03 * np.sin(4 * x)])  # somewhat uneven


@pytest.mark.parametrize("slope_deg", [0.0, 15.0, 20.0])
def test_a_sloping_floor_is_not_what_is_left_of_a_crate(slope_deg: float) -> None:
    axis = np.arange(-0.35, 0.36, 0.05)
    x, y = (grid.ravel() for grid in np.meshgrid(axis, axis))
    sides = [np.column_stack([x, np.full(x.size, side), y + 0.35]) for side in (-0.35, 0.35)]
    crate = np.concatenate([*sides, *(side[:, [1, 0, 2]] for side in sides), np.column_stack([x, y, 0.7 + 0 * x])])
    under = (np.abs(dense_floor()[:, :2]) < 0.35).all(axis=1)
    for step in range(36):
        heading_rad = step * np.pi / 18
        taken = on_slope(crate, slope_deg, heading_rad, f"crate {step}")
        rest = on_slope(dense_floor()[~under], slope_deg, heading_rad, f"before {step}")
        after = on_slope(dense_floor(), slope_deg, heading_rad, f"after {step}")
        assert not is_part_of_remainder(taken, rest, after), step


@pytest.mark.parametrize("slope_deg", [0.0, 15.0, 20.0])
def test_a_bite_out_of_a_pile_on_a_sloping_floor_leaves_a_rest(slope_deg: float) -> None:
    floor = dense_floor()
    whole = np.maximum(0.7 - 0.65 * np.maximum(np.hypot(floor[:, 0] / 1.6, floor[:, 1]) - 0.2, 0.0), 0.0)
    left = np.minimum(whole, np.maximum((0.3 - floor[:, 0]) * 1.2, 0.0))
    is_taken = whole - left > 0.1
    before, after = (floor + np.column_stack([0 * floor[:, :2], heights]) for heights in (whole, left))
    for step in range(12):
        heading_rad = step * np.pi / 6
        parts = [
            on_slope(points, slope_deg, heading_rad, f"pile {step} {number}")
            for number, points in enumerate((before[is_taken], before[~is_taken], after))
        ]
        assert is_part_of_remainder(*parts), step


def test_where_nothing_is_nothing_is_left() -> None:
    nothing = np.zeros((0, 3))
    assert not is_part_of_remainder(nothing, FLOOR, FLOOR)
    assert not is_part_of_remainder(FLOOR, nothing, FLOOR)
    assert not is_part_of_remainder(FLOOR, FLOOR, nothing)


def test_a_flank_is_muck_and_a_crate_level_or_upright_is_not() -> None:
    axis = np.arange(0.0, 2.0, 0.05)
    x, y = (grid.ravel() for grid in np.meshgrid(axis, axis))
    assert is_heap(np.column_stack([x, y, 0.65 * y]))  # 33 degrees
    assert not is_heap(np.column_stack([x, y, np.full(x.size, 0.6)]))
    sides = [np.column_stack([np.full(x.size, side), x, y]) for side in (0.0, 2.0)]
    assert not is_heap(np.concatenate([np.column_stack([x, y, np.full(x.size, 2.0)]), *sides]))
    # too few to have a surface
    assert not is_heap(np.zeros((2, 3)))
