from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, invert, make_pose, stream, transform, yaw_pose
from cdpipe.core.geometry.voxel import cell_keys, cell_means
from cdpipe.extract.objects import PointGroup, _Surroundings, assemble_objects
from cdpipe.model.report import ChangedObject
from cdpipe.model.types import PLACES, MergedMaps, PointMap, SessionName

VOXEL_M = 0.2
STEP_M = 0.04
AXIS = np.arange(-5.0, 5.0, STEP_M) + 0.01
X, Y = (grid.ravel() for grid in np.meshgrid(AXIS, AXIS))
PILE = np.maximum(0.7 - 0.6 * np.hypot(X - 2.0, Y - 2.0), 0.0)
LEFT = np.minimum(PILE, np.maximum((1.9 - X) * 1.2, 0.0))
CRATE_M = (1.0, 0.6, 0.5)


def crate(map_T_crate: Float64Array) -> Float64Array:
    """Returns of the top and the sides of a crate that stands with a corner at the origin of its frame."""
    axes = [np.linspace(0, edge, round(edge / STEP_M) + 1) for edge in CRATE_M]
    solid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    is_skin = (solid[:, :2] == 0).any(axis=1) | (solid == CRATE_M).any(axis=1)
    return transform(map_T_crate, solid[is_skin])


def ground(heights: Float64Array) -> Float64Array:
    """The surface at some heights; the floor lies just below the voxels that objects stand in."""
    return np.column_stack([X, Y, heights - 0.01])


def build(returns: Float64Array, strays: Float64Array | None = None) -> PointMap:
    """A map of one scan of these returns, each of them three times, and of stray ones, each of them once."""
    returns = np.concatenate([np.repeat(returns, 3, axis=0), returns[:0] if strays is None else strays])
    _, owner, counts = np.unique(cell_keys(returns, VOXEL_M), return_inverse=True, return_counts=True)
    points = np.column_stack([np.bincount(owner, returns[:, axis]) / counts for axis in range(3)])
    in_cells = returns / VOXEL_M
    return PointMap(
        points=points,
        nearest_m=np.ones(len(points), np.float32),
        voxel_m=VOXEL_M,
        odom_T_sensor=np.eye(4)[None],
        keyframe_scans=np.zeros(1, np.int64),
        return_points=owner.astype(np.int32),
        return_pixels=np.arange(len(returns), dtype=np.int32),
        scan_offsets=np.array([0, len(returns)]),
        return_offsets=((in_cells - np.floor(in_cells)) * PLACES).astype(np.uint8),
    )


def merge(before: Float64Array, after: Float64Array, map_T_after: Float64Array | None = None) -> MergedMaps:
    pose = make_pose() if map_T_after is None else map_T_after
    return MergedMaps(build(before), build(transform(invert(pose), after)), pose, {}, True)


def group(merged: MergedMaps, session: SessionName, where: Float64Array) -> PointGroup:
    """The map points within half a voxel of some places of the map frame, above the floor."""
    point_map = merged.before if session == "before" else merged.after
    points = point_map.points if session == "before" else merged.alignment.to_map(point_map.points)
    wanted, _ = cell_means(where, 0.1)
    near_m = np.min(np.linalg.norm(points[:, None] - wanted[None], axis=2), axis=1)
    indices = np.flatnonzero((near_m < VOXEL_M / 2) & (points[:, 2] > 0.03))
    returns = np.flatnonzero(np.isin(point_map.return_points, indices))
    return PointGroup(session, indices, points[indices], 0, returns)


TALL = crate(yaw_pose(0.0, (2.0, -3.5, 0.0))) * (1.0, 1.0, 1.9)
HERE, THERE = yaw_pose(0.3, (-3.0, -3.0, 0.0)), yaw_pose(1.7, (-1.0, 2.0, 0.0))
SCENE = merge(
    np.concatenate([ground(PILE), crate(HERE)]),
    np.concatenate([ground(LEFT), crate(THERE), TALL]),
    yaw_pose(0.8, (12.0, -5.0, 0.395)),
)


def assembled() -> tuple[ChangedObject, ...]:
    gone = np.flatnonzero(PILE - LEFT > 0.1)
    return assemble_objects(
        SCENE,
        [
            group(SCENE, "after", TALL),
            group(SCENE, "before", crate(HERE)),
            group(SCENE, "before", ground(PILE)[gone]),
            group(SCENE, "after", crate(THERE)),
        ],
    )


def test_what_was_cut_out_by_whole_map_points_is_never_reshaped() -> None:
    gone = np.flatnonzero(PILE - LEFT > 0.1)
    (item,) = assemble_objects(SCENE, [replace(group(SCENE, "before", ground(PILE)[gone]), returns=None)])
    assert item.kind == "removed"


def test_what_happened_to_each_of_four() -> None:
    objects = assembled()
    assert [(item.session, item.kind, item.partner) for item in objects] == [
        ("after", "added", -1),
        ("before", "moved", 3),
        ("before", "reshaped", -1),
        ("after", "moved", 1),
    ]
    middle = np.array([[0.5, 0.3, 0.25]])
    went = (transform(THERE, middle) - transform(HERE, middle))[0]
    for item in (objects[1], objects[3]):
        assert item.displacement_map is not None
        np.testing.assert_allclose(item.displacement_map, went, atol=0.03)
    assert objects[0].displacement_map is objects[2].displacement_map is None


def test_how_large_each_of_four_is() -> None:
    boxes = [item.shape for item in assembled()]
    added, moved, taken, there = boxes
    assert added is not None
    assert moved is not None
    assert taken is not None
    assert there is not None
    np.testing.assert_allclose(added.box_m, [1.0, 0.6, 0.95], atol=0.06)
    for box, pose in ((moved, HERE), (there, THERE)):
        np.testing.assert_allclose(box.box_m, CRATE_M, atol=0.06)
        np.testing.assert_allclose(box.map_T_box[:3, 3], transform(pose, np.array([[0.5, 0.3, 0.25]]))[0], atol=0.04)
        assert box.volume_m3 == pytest.approx(0.3, rel=0.12)
    assert taken.volume_m3 == pytest.approx((PILE - LEFT).sum() * STEP_M**2, rel=0.12)


def test_without_the_places_of_returns_map_points_are_measured() -> None:
    coarse = replace(SCENE, before=replace(SCENE.before, return_offsets=None))
    (item,) = assemble_objects(coarse, [group(coarse, "before", crate(HERE))])
    assert item.shape is not None
    np.testing.assert_allclose(item.shape.box_m, CRATE_M, atol=0.2)
    low, high = item.points_map[:, 2].min(), item.points_map[:, 2].max()
    assert item.shape.box_m[2] == pytest.approx(high - low)


def test_a_group_of_some_returns_is_measured_on_them_alone() -> None:
    whole = group(SCENE, "before", crate(HERE))
    chosen = np.flatnonzero(np.isin(SCENE.before.return_points, whole.indices))
    places = SCENE.before.positions_of(chosen)
    half = chosen[transform(invert(HERE), places)[:, 0] < 0.5]
    points, _ = cell_means(SCENE.before.positions_of(half), 0.1)
    scrambled = stream(1, "objects").permutation(half)
    (item,) = assemble_objects(SCENE, [PointGroup("before", whole.indices, points, 2, scrambled)])
    assert item.shape is not None
    assert item.shape.box_m[0] == pytest.approx(0.6, abs=0.06)
    assert item.shape.box_m[1] == pytest.approx(0.5, abs=0.06)
    np.testing.assert_array_equal(item.returns, np.column_stack([np.zeros(len(half)), half]))
    np.testing.assert_array_equal(item.points_map, points)


def test_a_fringe_of_single_returns_makes_a_crate_no_larger() -> None:
    around = stream(2, "objects").uniform((-0.1, -0.1, 0.1), (1.1, 0.7, 0.45), (60, 3))
    fringed = replace(SCENE, before=build(np.concatenate([ground(PILE), crate(HERE)]), transform(HERE, around)))
    (item,) = assemble_objects(fringed, [group(fringed, "before", crate(HERE))])
    assert item.shape is not None
    np.testing.assert_allclose(item.shape.box_m, CRATE_M, atol=0.06)


def test_what_is_around_an_object_is_not_the_object() -> None:
    gone = group(SCENE, "before", ground(PILE)[PILE - LEFT > 0.1])
    # a map point of the border may stand for returns of both: the object is said to reach 0.3 m less far
    inner = gone.points_map[gone.points_map[:, 0] > gone.points_map[:, 0].min() + 0.3]
    around = _Surroundings(SCENE).of(PointGroup("before", gone.indices, inner, 0, np.zeros(0, np.int64)))
    off_object_m = [np.linalg.norm(around["before"] - point, axis=1).min() for point in inner]
    assert min(off_object_m) > 0.1
    border = gone.points_map[gone.points_map[:, 0] < gone.points_map[:, 0].min() + 0.1]
    assert all((around["before"] == point).all(axis=1).any() for point in border)
    assert len(around["after"]) > len(around["before"])
    assert np.abs(around["after"][:, 2]).max() < PILE.max()


def test_a_crate_in_the_place_of_a_barrel_is_not_a_move() -> None:
    angle = np.arange(0, 2 * np.pi, 0.1)
    ring = np.column_stack([0.3 * np.cos(angle) - 2.5, 0.3 * np.sin(angle) - 2.5])
    barrel = np.concatenate([np.column_stack([ring, np.full(len(ring), z)]) for z in np.arange(0.0, 1.2, STEP_M)])
    pair = merge(np.concatenate([ground(0 * X), barrel]), np.concatenate([ground(0 * X), crate(HERE)]))
    objects = assemble_objects(pair, [group(pair, "before", barrel), group(pair, "after", crate(HERE))])
    assert [(item.kind, item.partner) for item in objects] == [("removed", -1), ("added", -1)]


def test_a_crate_pushed_by_half_its_length_is_one_with_what_seems_to_have_stayed() -> None:
    # of it before only the strip that it left, after only the end that came: they are no more alike than top and end
    here, there = (make_pose(translation=(x, 0.01, 0.0)) for x in (0.01, 0.51))  # no side on the border of two cells
    merged = merge(
        np.concatenate([ground(np.zeros(X.size)), crate(here)]),
        np.concatenate([ground(np.zeros(X.size)), crate(there)]),
        yaw_pose(0.8, (12.0, -5.0, 0.395)),
    )
    left = crate(here)[crate(here)[:, 0] < 0.35]
    came = crate(there)[crate(there)[:, 0] > 1.15]
    gone, come = assemble_objects(merged, [group(merged, "before", left), group(merged, "after", came)])
    assert (gone.kind, gone.partner, come.kind, come.partner) == ("moved", 1, "moved", 0)
    assert gone.displacement_map is not None
    np.testing.assert_allclose(gone.displacement_map, [0.5, 0.0, 0.0], atol=0.03)


def test_muck_put_beside_the_pile_it_was_taken_off_is_reshaped_and_added() -> None:
    gone = np.flatnonzero(PILE - LEFT > 0.1)
    load = ground(PILE)[gone] + (1.4, 0.0, 0.0)
    pair = merge(ground(PILE), np.concatenate([ground(LEFT), load]))
    objects = assemble_objects(pair, [group(pair, "before", ground(PILE)[gone]), group(pair, "after", load)])
    assert [(item.kind, item.partner) for item in objects] == [("reshaped", -1), ("added", -1)]


@pytest.mark.parametrize("in_pile", [True, False])
def test_a_crate_that_stood_in_a_pile_is_no_part_of_it(in_pile: bool) -> None:
    here = yaw_pose(0.1, (2.3, 1.7, 0.15) if in_pile else (2.3, -1.7, 0.0))
    pair = merge(np.concatenate([ground(PILE), crate(here)]), np.concatenate([ground(PILE), crate(HERE)]))
    shown = crate(here)[crate(here)[:, 2] > 0.1]
    objects = assemble_objects(pair, [group(pair, "before", shown), group(pair, "after", crate(HERE))])
    assert [item.kind for item in objects] == ["moved", "moved"]


def test_what_stands_around_two_places_is_what_rises_above_the_ground_there() -> None:
    around = _Surroundings(SCENE)
    ((before, after),) = around.standing([crate(HERE)])
    assert len(before) > 200
    assert np.min(np.linalg.norm(before[:, None] - crate(HERE)[None], axis=2), axis=1).max() < 0.05
    assert len(after) == 0
    assert around.standing([]) == []
