from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, Int64Array, stream, transform, yaw_pose
from cdpipe.core.geometry.groups import label_groups
from cdpipe.core.geometry.voxel import cell_means
from cdpipe.extract.surface import (
    PlaneTable,
    Site,
    add_low_objects,
    compare_site,
    distances_m,
    find_candidates,
    grow_objects,
    measure_noise_m,
    split_group,
    unassigned_cells,
)
from cdpipe.merge.registration import Surface
from cdpipe.model.config import ExtractConfig

CONFIG = ExtractConfig()


def lattice(low: tuple[float, float, float], high: tuple[float, float, float], step_m: float) -> Float64Array:
    axes = [np.arange(a, b + step_m / 2, step_m) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


FLOOR = lattice((-3, -3, 0), (3, 3, 0), 0.2)


def test_distances_from_a_plane_are_heights_and_beyond_its_edge_from_its_rim() -> None:
    heights = np.array([0.0, 0.05, -0.11, 0.3])
    above = np.column_stack([np.array([0.1, -1.0, 0.7, 2.1]), np.array([0.1, 0.33, -2.1, 0.05]), heights])
    surface = Surface(FLOOR)
    np.testing.assert_allclose(distances_m(above, surface, 0.4)[0], np.abs(heights), atol=1e-9)
    # 0.38 m beyond the edge the plane still holds, 0.41 m beyond it does not; nor 0.41 m above
    beyond = np.array([[3.38, 0.0, 0.1], [3.41, 0.0, 0.1], [1.0, 1.0, 0.41]])
    np.testing.assert_allclose(distances_m(beyond, surface, 0.4)[0], [0.1, np.hypot(0.41, 0.1), 0.41], atol=1e-9)
    np.testing.assert_allclose(distances_m(beyond, surface, 0.5)[0], [0.1, 0.1, 0.41], atol=1e-9)


def test_a_gap_of_the_map_does_not_stand_off_it() -> None:
    # a fifth of the way to the nearest point is the most that what lies flat beyond an edge may be off its plane
    beyond = np.array([[4.0, 0.0, 0.2], [4.0, 0.0, 0.21], [5.0, 0.0, 0.0]])
    np.testing.assert_allclose(distances_m(beyond, Surface(FLOOR), 0.4)[0], [0.2, np.hypot(1.0, 0.21), 0.0], atol=1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_distances_equal_brute_force_on_a_rough_cloud(seed: int) -> None:
    rng = stream(seed, "rough")
    cloud = rng.uniform(-2, 2, (600, 3)) * (1, 1, 0.1)
    points = rng.uniform(-2.5, 2.5, (400, 3)) * (1, 1, 0.3)
    surface = Surface(cloud)
    expected = []
    for point in points:
        gaps_m = np.linalg.norm(cloud - point, axis=1)
        nearest = int(np.argmin(gaps_m))
        # the normal by hand: the direction in which its ten nearest, itself among them, spread least
        around = cloud[np.argsort(np.linalg.norm(cloud - cloud[nearest], axis=1))[:10]]
        normal = np.linalg.svd(around - around.mean(axis=0))[2][2]
        off_plane_m = abs((point - cloud[nearest]) @ normal)
        is_on_plane = gaps_m[nearest] < 0.3 or off_plane_m < 0.2 * gaps_m[nearest]
        expected.append(off_plane_m if is_on_plane else gaps_m[nearest])
    np.testing.assert_allclose(distances_m(points, surface, 0.3)[0], expected, atol=1e-6)


def test_candidates_are_three_together_more_than_eight_centimetres_off() -> None:
    table = PlaneTable(Surface(FLOOR))

    def found(*places: tuple[float, float, float]) -> list[int]:
        chosen, _ = find_candidates(np.concatenate([FLOOR, np.array(places).reshape(-1, 3)]), table)
        return (chosen - len(FLOOR)).tolist()

    assert found((0, 0, 0.09), (0.3, 0, 0.09), (0.6, 0, 0.09)) == [0, 1, 2]
    assert found((0, 0, 0.09), (0.3, 0, 0.09)) == []
    assert found((0, 0, 0.07), (0.3, 0, 0.07), (0.6, 0, 0.07)) == []
    assert found((0, 0, 0.09), (0.3, 0, 0.09), (0.6, 0, 0.09), (2, 2, 0.09), (1.2, 0, 0.09)) == [0, 1, 2]
    chosen, noise_m = find_candidates(transform(yaw_pose(0.0, (0, 0, 0.03)), FLOOR), table)
    assert (len(chosen), noise_m) == (0, pytest.approx(0.03))


def test_a_plane_of_each_cell_by_brute_force() -> None:
    surface = Surface(stream(3, "cloud").uniform(-1, 1, (400, 3)))
    points = stream(4, "points").uniform(-1.6, 1.6, (300, 3))
    table, low = PlaneTable(surface), surface.points.min(axis=0)
    cells = np.floor((surface.points - low) / 0.25)
    for point, distance_m in zip(points, table.distances_m(points), strict=True):
        inside = np.flatnonzero((cells == np.floor((point - low) / 0.25)).all(axis=1))
        off_planes = np.abs(((point - surface.points[inside]) * surface.normals[inside]).sum(axis=1))
        assert np.isclose(off_planes, distance_m).any() if len(inside) else np.isinf(distance_m)


@pytest.mark.parametrize("n_points", [0, 1, 2, 3, 40, 120, 300])
def test_candidates_are_all_of_groups_of_three_and_more(n_points: int) -> None:
    # from scattered pairs to one lump
    above = stream(n_points, "above").uniform((-2.9, -2.9, 0.1), (2.9, 2.9, 0.3), (n_points, 3))
    labels, sizes = label_groups(above, 0.5)
    chosen, _ = find_candidates(np.concatenate([FLOOR, above]), PlaneTable(Surface(FLOOR)))
    assert chosen.tolist() == (len(FLOOR) + np.flatnonzero(sizes[labels] >= 3)).tolist()


@pytest.mark.parametrize("link_m", [0.05, 0.3, 5.0])
def test_groups_equal_flood_fill(link_m: float) -> None:
    points = stream(0, "groups").uniform(-1, 1, (150, 3))
    is_linked = np.linalg.norm(points[:, None] - points, axis=2) <= link_m
    expected = np.full(len(points), -1)
    for start in range(len(points)):
        if expected[start] < 0:
            open_ones = [start]
            while open_ones:
                here = open_ones.pop()
                expected[here] = start
                open_ones += np.flatnonzero(is_linked[here] & (expected < 0)).tolist()
    labels, sizes = label_groups(points, link_m)
    assert len({(a, b) for a, b in zip(expected.tolist(), labels.tolist(), strict=True)}) == len(set(expected.tolist()))
    assert sizes.tolist() == [np.count_nonzero(labels == label) for label in range(len(set(expected.tolist())))]
    assert [each.shape for each in label_groups(points[:0], link_m)] == [(0,), (0,)]


def test_cell_means_equal_a_dict_of_cells() -> None:
    points = stream(0, "cells").uniform(-1, 1, (500, 3))
    cells: dict[tuple[int, ...], list[int]] = {}
    for index, cell in enumerate(np.floor(points / 0.3).astype(int).tolist()):
        cells.setdefault(tuple(cell), []).append(index)
    means, cell_of_point = cell_means(points, 0.3)
    assert len(means) == len(cells)
    for members in cells.values():
        (number,) = set(cell_of_point[members].tolist())
        np.testing.assert_allclose(means[number], points[members].mean(axis=0), atol=1e-12)
    assert [len(each) for each in cell_means(points[:0], 0.3)] == [0, 0]


def test_a_site_is_compared_as_well_as_the_other_session_knows_it() -> None:
    points = np.array([[0.02, 0.02, 0.31], [0.03, 0.03, 0.33], [1.02, 0.02, 0.17]])
    nothing = compare_site(points, np.zeros((0, 3)))
    assert nothing.cell_of_return.tolist() == [0, 0, 1]
    np.testing.assert_allclose(nothing.points, [[0.025, 0.025, 0.32], [1.02, 0.02, 0.17]])
    assert np.isposinf(nothing.distance_m).all()
    # too few cells for a plane: the distance from the nearest of them
    few = lattice((0.05, 0.05, 0.05), (0.35, 0.05, 0.05), 0.1)
    np.testing.assert_allclose(
        compare_site(points, few).distance_m,
        [np.linalg.norm([0.025, 0.025, 0.27]), np.linalg.norm([0.67, 0.03, 0.12])],
    )
    # a floor: the height above it where it is near enough, else the distance from its nearest cell
    floor = lattice((-1.05, -1.05, 0.05), (2.05, 1.05, 0.05), 0.1)
    by_plane = compare_site(points, floor).distance_m
    np.testing.assert_allclose(by_plane, [np.linalg.norm([0.025, 0.025, 0.27]), 0.12], atol=1e-9)
    assert [len(each) for each in (compare_site(points[:0], floor).points, compare_site(points[:0], few).points)] == [
        0, 0]  # fmt: skip


def skin(low: tuple[float, float, float], high: tuple[float, float, float]) -> Float64Array:
    """Cells of 0.05 m on the sides and the top of a box."""
    low = tuple(value + 0.025 for value in low)
    solid = lattice(low, tuple(value - 0.02 for value in high), 0.05)
    top, edge = solid.max(axis=0), solid.min(axis=0)
    is_skin = (np.isclose(solid, top)).any(axis=1) | np.isclose(solid[:, :2], edge[:2]).any(axis=1)
    return solid[is_skin]


def site_of(cells: Float64Array, distance_m: Float64Array, n_returns: Int64Array | int = 1) -> Site:
    """Cells above a floor, each with so many returns."""
    return Site(cells, np.repeat(np.arange(len(cells)), n_returns), distance_m, np.ones(len(cells), np.bool_))


def on_floor(*boxes: Float64Array) -> Site:
    """Cells of boxes on a floor at height 0, and of the floor around them, which is a centimetre off."""
    floor = lattice((-1.025, -1.025, 0.01), (2.975, 2.975, 0.01), 0.05)
    cells = np.concatenate([*boxes, floor])
    return site_of(cells, cells[:, 2].copy())


def is_above(site: Site, height_m: float) -> np.ndarray:
    """Seen through by three keyframes down to a height: no ray passed between foot and floor."""
    return np.where(site.points[:, 2] > height_m, 3, 0)


BOX = skin((0, 0, 0), (0.8, 0.6, 0.7))
OTHER = skin((1.3, 0, 0), (1.8, 0.6, 0.5))  # half a metre beside it


@pytest.mark.parametrize(("noise_m", "border_m"), [(0.0, 0.04), (0.02, 0.1), (0.03, 0.15), (0.5, 0.2)])
def test_a_box_is_grown_whole_down_to_the_border(noise_m: float, border_m: float) -> None:
    site = on_floor(BOX)
    (found,) = grow_objects(site, is_above(site, 0.21), noise_m, CONFIG)
    assert sorted(found.tolist()) == np.flatnonzero(site.points[:, 2] > border_m).tolist()
    assert len(set(found.tolist())) == len(found)


def test_what_was_not_seen_through_grows_nothing() -> None:
    site = on_floor(BOX)
    assert grow_objects(site, np.zeros(len(site.points), np.int64), 0.0, CONFIG) == []
    # nor does what stands behind it: the foot ends 0.3 m from what was seen through
    (found,) = grow_objects(site, is_above(site, 0.56), 0.0, CONFIG)
    core = np.flatnonzero(site.points[:, 2] > 0.56)
    gaps_m = np.linalg.norm(site.points[:, None] - site.points[core], axis=2).min(axis=1)
    assert sorted(found.tolist()) == np.flatnonzero((gaps_m < 0.3) & (site.points[:, 2] > 0.04)).tolist()
    assert site.points[found, 2].min() > 0.25


@pytest.mark.parametrize(("n_clear", "n_objects"), [(29, 0), (30, 1)])
def test_an_object_has_enough_cells_that_stand_clear(n_clear: int, n_objects: int) -> None:
    cells = lattice((0, 0, 0.2), (0.35, 0.55, 0.2), 0.05)
    height_m = np.where(np.arange(len(cells)) < n_clear, 0.125, 0.115)
    found = grow_objects(site_of(cells, height_m), np.full(len(cells), 3), 0.0, CONFIG)
    assert [len(each) for each in found] == [len(cells)] * n_objects
    # noise raises what counts as clear: 2.5 times a border of 5 times the noise
    assert grow_objects(site_of(cells, height_m), np.full(len(cells), 3), 0.011, CONFIG) == []


def test_an_object_was_seen_through_by_enough_keyframes_in_the_mean() -> None:
    # the mean is over what was seen through at all: 100 cells by three and as many by two are 2.5, one view less is not
    cells = lattice((0, 0, 0.3), (0.95, 0.45, 0.3), 0.05)
    site = site_of(cells, np.full(200, 0.3))
    views = np.repeat([3, 2], 100)
    (found,) = grow_objects(site, views, 0.0, CONFIG)
    assert len(found) == 200
    views[0] = 2
    assert grow_objects(site, views, 0.0, CONFIG) == []
    (found,) = grow_objects(site, views, 0.0, CONFIG.model_copy(update={"min_views": 2.4}))
    assert len(found) == 200
    # cells that were hit as often as seen through are no evidence either way
    assert len(grow_objects(site, np.repeat([3, 0], 100), 0.0, CONFIG)) == 1


def test_two_boxes_half_a_metre_apart_are_two_and_touching_ones_are_one() -> None:
    site = on_floor(BOX, OTHER)
    found = grow_objects(site, is_above(site, 0.21), 0.0, CONFIG)
    members = [set(each.tolist()) for each in found]
    is_box = site.points[:, 0] < 1.0
    stands = site.points[:, 2] > 0.04
    assert members == [set(np.flatnonzero(stands & is_box).tolist()), set(np.flatnonzero(stands & ~is_box).tolist())]
    site = on_floor(BOX, OTHER - (0.4, 0.0, 0.0))
    (found_one,) = grow_objects(site, is_above(site, 0.21), 0.0, CONFIG)
    assert set(found_one.tolist()) == set(np.flatnonzero(site.points[:, 2] > 0.04).tolist())


@pytest.mark.parametrize(
    ("gap_m", "n_box", "n_bridge", "n_objects"),
    [
        (0.5, 3, 2, 2),
        (0.5, 3, 3, 1),  # what joins them is solid
        (0.5, 2, 2, 1),  # seen from too far away to tell
        (0.25, 3, 2, 1),  # near enough to be parts of one
    ],
)
def test_boxes_that_single_returns_join_are_two(gap_m: float, n_box: int, n_bridge: int, n_objects: int) -> None:
    bridge = lattice((0.8, 0.3, 0.4), (0.8 + gap_m, 0.3, 0.4), 0.05)[1:-1]
    boxes = np.concatenate([BOX, OTHER + np.array([gap_m - 0.5, 0.0, 0.0])])
    cells = on_floor(boxes, bridge)
    n_returns = np.repeat([n_box, n_bridge, 3], [len(boxes), len(bridge), len(cells.points) - len(boxes) - len(bridge)])
    site = site_of(cells.points, cells.distance_m, n_returns)
    found = grow_objects(site, is_above(site, 0.21), 0.0, CONFIG)
    assert len(found) == n_objects
    # nothing is lost, and every cell of the bridge is part of the nearer box
    assert sorted(np.concatenate(found).tolist()) == np.flatnonzero(site.points[:, 2] > 0.04).tolist()
    if n_objects == 2:
        assert site.points[found[0], 0].max() <= 0.8 + gap_m / 2 + 1e-9
        assert site.points[found[1], 0].min() >= 0.8 + gap_m / 2 - 1e-9


@pytest.mark.parametrize(("n_between", "n_parts"), [(1, 2), (2, 1)])
def test_a_surface_that_is_sampled_thinly_between_two_dense_patches_is_one(n_between: int, n_parts: int) -> None:
    sheet = lattice((0, 0, 0), (2.0, 1.0, 0), 0.05)
    n_returns = np.where((sheet[:, 0] < 0.32) | (sheet[:, 0] > 1.68), 3, 2)
    n_returns[np.abs(sheet[:, 0] - 1.0) < 0.12] = n_between
    part = split_group(sheet, n_returns, np.ones(len(sheet), dtype=np.bool_), 30)
    assert part.max() + 1 == n_parts


def test_noise_is_that_of_the_surfaces_at_the_site_and_that_of_the_region_at_most() -> None:
    # three cells on the surface, 1, 2 and 6 cm off, and an object
    site = site_of(np.zeros((6, 3)), np.array([0.01, 0.02, 0.06, 0.5, 0.6, 0.7]))
    assert measure_noise_m(site, 0.05) == 0.02
    assert measure_noise_m(site, 0.015) == 0.015
    alone = site_of(np.zeros((2, 3)), np.array([0.5, np.inf]))
    assert measure_noise_m(alone, 0.05) == 0.05


SLAB = lattice((0, 0, 0.05), (1.15, 0.95, 0.15), 0.05)


def test_a_low_object_is_what_scans_passed_and_most_of_it_clear() -> None:
    site = on_floor(SLAB)  # 24 x 20 cells at 0.05, 0.1 and 0.15 m
    left = unassigned_cells(site, [], 0.0, CONFIG)
    assert sorted(left.tolist()) == np.flatnonzero(site.points[:, 2] > 0.04).tolist()
    height_m = site.points[left, 2]
    # passed above 0.12 m all is clear, and the rest is its foot
    (found,) = add_low_objects(site, left, height_m > 0.12, [], 0.0, CONFIG)
    assert sorted(found.tolist()) == sorted(left.tolist())
    assert add_low_objects(site, left, np.zeros(len(left), np.bool_), [], 0.0, CONFIG) == []
    # two thirds of what was passed are clear, or half with a noise of 1.5 cm, which asks for 12 cm
    assert len(add_low_objects(site, left, np.ones(len(left), np.bool_), [], 0.0, CONFIG)) == 1
    noisy = unassigned_cells(site, [], 0.015, CONFIG)
    assert sorted(noisy.tolist()) == np.flatnonzero(site.points[:, 2] > 0.09).tolist()
    assert len(add_low_objects(site, noisy, np.ones(len(noisy), np.bool_), [], 0.015, CONFIG)) == 1
    # a third is clear: so it is with a surface that is a little off
    assert add_low_objects(site, left, np.ones(len(left), np.bool_), [], 0.015, CONFIG) == []
    # noise raises what counts as clear
    assert len(unassigned_cells(site, [], 0.02, CONFIG)) == 0


def test_a_thin_thing_is_an_object_on_the_floor_alone() -> None:
    thin = lattice((0, 0, 0.1), (1.15, 0.95, 0.1), 0.05)
    site = on_floor(thin)
    passed = np.ones(len(thin), np.bool_)
    left = unassigned_cells(site, [], 0.0, CONFIG)
    assert sorted(left.tolist()) == list(range(len(thin)))
    assert len(add_low_objects(site, left, passed, [], 0.0, CONFIG)) == 1
    # noise of 1.3 cm asks for 10.4 cm
    assert len(unassigned_cells(site, [], 0.013, CONFIG)) == 0
    # a wall that is 10 cm off is bent
    wall = replace(site, is_on_floor=np.zeros(len(site.points), np.bool_))
    assert len(unassigned_cells(wall, [], 0.0, CONFIG)) == 0
    assert add_low_objects(wall, left, passed, [], 0.0, CONFIG) == []


@pytest.mark.parametrize(("slope_deg", "is_floor"), [(0.0, True), (25.0, True), (35.0, False), (90.0, False)])
def test_a_floor_lies_below_and_is_level(slope_deg: float, is_floor: bool) -> None:
    turn = Rotation.from_euler("y", slope_deg, degrees=True).as_matrix()
    above = np.array([[0.3, 0.2, 0.1], [-0.5, 0.4, -0.1]]) @ turn.T
    _, is_on_floor = distances_m(above, Surface(FLOOR @ turn.T), 0.4)
    assert is_on_floor.tolist() == [is_floor, False]


def test_what_touches_an_object_is_a_part_of_it_and_no_low_one() -> None:
    for gap_m, n_new in ((0.2, 0), (0.5, 1)):
        site = on_floor(BOX, SLAB + np.array([0.8 + gap_m, 0.0, 0.0]))
        taken = grow_objects(site, np.where((site.points[:, 2] > 0.21) & (site.points[:, 0] < 0.9), 3, 0), 0.0, CONFIG)
        assert len(taken) == 1
        left = unassigned_cells(site, taken, 0.0, CONFIG)
        assert not set(left.tolist()) & set(taken[0].tolist())
        is_passed = site.points[left, 2] > 0.12
        found = add_low_objects(site, left, is_passed, taken, 0.0, CONFIG)
        assert len(found) == 1 + n_new
        passed = set(left[is_passed].tolist())
        assert passed <= set(found[-1].tolist())
        assert set(taken[0].tolist()) <= set(found[0].tolist())


def test_what_hides_the_middle_of_an_object_does_not_cut_it_in_two() -> None:
    site = on_floor(skin((0, 0, 0), (1.6, 0.6, 0.7)))
    # a strip 0.5 m wide that no keyframe of the other session saw through
    is_hidden = np.abs(site.points[:, 0] - 0.8) < 0.25
    (found,) = grow_objects(site, np.where(is_hidden, 0, is_above(site, 0.21)), 0.0, CONFIG)
    assert sorted(found.tolist()) == np.flatnonzero(site.points[:, 2] > 0.04).tolist()


def test_nothing_stands_off() -> None:
    site = on_floor()
    assert grow_objects(site, np.full(len(site.points), 3), 0.0, CONFIG) == []
    empty = site_of(np.zeros((0, 3)), np.zeros(0))
    assert grow_objects(empty, np.zeros(0, np.int64), 0.0, CONFIG) == []
