from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import cdpipe.extract.objects
from cdpipe.core.geometry import Float64Array, invert, make_pose, stream, transform, yaw_pose
from cdpipe.extract.crops import Crops
from cdpipe.extract.extract import (
    count_asked_points,
    cut_objects,
    hull_volume_m3,
    measure_regions,
    withdraw_empty_regions,
)
from cdpipe.extract.objects import PointGroup, assemble_objects
from cdpipe.model.alignment import PathAlignment
from cdpipe.model.config import ClusterConfig, ExtractConfig, OutlierConfig, PipelineConfig
from cdpipe.model.report import ChangedObject, ChangeRegions
from cdpipe.model.types import MergedMaps, PointMap

CONFIG = PipelineConfig(
    extract=ExtractConfig(method="voxel", voxel_m=0.4),
    outlier=OutlierConfig(sigmas=100.0),
    cluster=ClusterConfig(radius_m=0.3, min_points=8),
)
# grid points lie away from the borders of the 0.4 m voxels, so that a rigid motion of the frame cannot tip them over
_STEP = 0.1


def extract_objects(
    pair: MergedMaps, candidates: ChangeRegions, config: PipelineConfig
) -> tuple[tuple[ChangedObject, ...], dict[str, np.ndarray]]:
    groups = cut_objects(pair, candidates, config)
    return assemble_objects(pair, groups), measure_regions(
        candidates, groups, lambda centre, radius_m: Crops(pair, 0.0).crop("after", centre, radius_m)[1]
    )


def lattice(low: tuple[float, ...], high: tuple[float, ...]) -> Float64Array:
    axes = [np.arange(a + _STEP / 2, b, _STEP) if b > a else np.array([a]) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


FLOOR = lattice((-6, -6, 0.05), (6, 6, 0.05))
BOX = lattice((1, 1, 0.4), (2, 1.8, 1.2))  # 10 x 8 x 8 points, 0.4 m above the floor
PLATE = lattice((-3, -2, 0.8), (-2, 0, 1.0))  # 10 x 20 x 2 points


def point_map(points: Float64Array) -> PointMap:
    """A map of points that stand for two returns each: scan 0 and scan 1, pixel = 3 x index."""
    n = len(points)
    return PointMap(
        points=points,
        nearest_m=np.ones(n, np.float32),
        voxel_m=0.1,
        odom_T_sensor=np.stack([np.eye(4)] * 2),
        keyframe_scans=np.zeros(1, np.int64),
        return_points=np.tile(np.arange(n, dtype=np.int32), 2),
        return_pixels=np.tile(3 * np.arange(n, dtype=np.int32), 2),
        scan_offsets=np.array([0, n, 2 * n]),
    )


def merged(
    before: list[Float64Array], after: list[Float64Array], before_T_after: Float64Array | None = None
) -> MergedMaps:
    pose = make_pose() if before_T_after is None else before_T_after
    cloud_after = transform(invert(pose), np.concatenate(after))
    return MergedMaps(point_map(np.concatenate(before)), point_map(cloud_after), pose, {}, True)


def regions(centres: list[tuple[float, float, float]], radius_m: float = 5.0, n_reported: int = 9) -> ChangeRegions:
    n = len(centres)
    return ChangeRegions(
        centres_map=np.array(centres).reshape(-1, 3),
        radius_m=radius_m,
        scores=-np.arange(n, dtype=np.float64),
        pairs=np.zeros((n, 2), np.int64),
        is_reported=np.arange(n) < n_reported,
        keyframe_scores=np.zeros(0),
    )


def as_set(points: Float64Array) -> set[tuple[float, ...]]:
    return {tuple(point) for point in np.round(points, 6).tolist()}


def summary(objects: tuple[ChangedObject, ...]) -> list[tuple[object, ...]]:
    return [(item.session, item.kind, item.region, len(item.points_map), item.partner) for item in objects]


def test_an_added_box_is_cut_out_exactly() -> None:
    objects, figures = extract_objects(merged([FLOOR], [FLOOR, BOX]), regions([(0, 0, 0.5)]), CONFIG)
    assert summary(objects) == [("after", "added", 0, 640, -1)]
    assert as_set(objects[0].points_map) == as_set(BOX)
    assert objects[0].score == 640.0
    n_floor = len(FLOOR)
    pixels = [3 * (n_floor + k) for k in range(640)]
    assert sorted(map(tuple, objects[0].returns.tolist())) == [(scan, p) for scan in (0, 1) for p in pixels]
    n_in_sphere = int((np.linalg.norm(np.concatenate([FLOOR, BOX]) - (0, 0, 0.5), axis=1) <= 5).sum())
    assert figures["s_points"].tolist() == [n_in_sphere]
    assert figures["oe_points"].tolist() == [640]
    # hulls of lattices are boxes of the outermost points: 0.9 x 0.7 x 0.7
    assert figures["v_oe_m3"][0] == pytest.approx(0.9 * 0.7 * 0.7)
    assert figures["v_sphere_m3"][0] > 10


def test_a_removed_box_is_cut_out_of_the_before_map() -> None:
    objects, figures = extract_objects(merged([FLOOR, BOX], [FLOOR]), regions([(0, 0, 0.5)]), CONFIG)
    assert summary(objects) == [("before", "removed", 0, 640, -1)]
    assert figures["s_points"][0] < len(FLOOR)


def test_who_looks_at_a_candidate_asks_for_the_before_points_of_its_proposed_sphere() -> None:
    pair = merged([FLOOR, BOX], [FLOOR, PLATE])
    # reported or not; the second was centred on what it holds after it had been proposed beside the map
    candidates = regions([(0.0, 0.0, 0.05), (1.5, 1.4, 0.8), (-3.0, 0.0, 0.8)], radius_m=1.0, n_reported=1)
    proposed = candidates.centres_map.copy()
    proposed[1] = (20.0, 0.0, 0.0)
    candidates = replace(candidates, proposed_centres_map=proposed, radius_m=np.array([1.0, 1.0, 0.9]))
    asked = count_asked_points(candidates, Crops(pair, 0.0))
    before = np.concatenate([FLOOR, BOX])
    assert asked[0] == np.count_nonzero(np.linalg.norm(before - proposed[0], axis=1) <= 1.0) > 0
    assert asked[1] == 0
    assert asked[2] == np.count_nonzero(np.linalg.norm(before - proposed[2], axis=1) <= 0.9) > 0


def test_moved_partners_name_each_other() -> None:
    moved_box = transform(yaw_pose(np.pi / 2, (0.2, -3.0, 0.0)), BOX)
    objects, _ = extract_objects(
        merged([FLOOR, BOX], [FLOOR, PLATE, moved_box]), regions([(0, 0, 0.5)], radius_m=6.0), CONFIG
    )
    assert summary(objects) == [
        ("after", "moved", 0, 640, 2),
        ("after", "added", 0, 400, -1),
        ("before", "moved", 0, 640, 0),
    ]


def test_objects_of_different_size_did_not_move() -> None:
    objects, _ = extract_objects(merged([FLOOR, BOX], [FLOOR, PLATE]), regions([(0, 0, 0.5)]), CONFIG)
    assert summary(objects) == [("after", "added", 0, 400, -1), ("before", "removed", 0, 640, -1)]


def test_nothing_changed() -> None:
    objects, figures = extract_objects(merged([FLOOR, BOX], [FLOOR, BOX]), regions([(0, 0, 0.5)]), CONFIG)
    assert objects == ()
    assert figures["oe_points"].tolist() == [0]
    assert figures["v_oe_m3"].tolist() == [0]


def test_the_border_of_the_sphere_makes_nothing_new() -> None:
    # the before map has every second point: the partner of a point just inside often lies just outside the sphere
    thin = FLOOR[(np.arange(len(FLOOR)) % 4) == 0]
    for radius_m in (1.0, 2.3, 3.1, 4.4):
        everything = CONFIG.model_copy(update={"cluster": ClusterConfig(radius_m=0.5, min_points=1)})
        objects, _ = extract_objects(merged([thin], [FLOOR]), regions([(0.3, 0.2, 0.5)], radius_m), everything)
        assert objects == ()


def test_a_point_belongs_to_the_better_region_only() -> None:
    pair = merged([FLOOR], [FLOOR, BOX])
    objects, figures = extract_objects(pair, regions([(0, 0, 0.5), (3, 3, 0.5)]), CONFIG)
    assert summary(objects) == [("after", "added", 0, 640, -1)]
    assert figures["oe_points"].tolist() == [640, 0]
    # a sphere that cuts the box: the second region gets the rest
    objects, _ = extract_objects(pair, regions([(1.5, -3.0, 0.8), (1.5, 1.5, 0.8)], radius_m=4.4), CONFIG)
    assert [item.region for item in objects] == [0, 1]
    assert sum(len(item.points_map) for item in objects) == 640
    assert as_set(np.concatenate([item.points_map for item in objects])) == as_set(BOX)


def test_only_reported_regions_are_looked_at() -> None:
    objects, figures = extract_objects(
        merged([FLOOR], [FLOOR, BOX, PLATE]), regions([(-3, -3, 0.5), (3, 3, 0.5)], 4.0, n_reported=1), CONFIG
    )
    assert summary(objects) == [("after", "added", 0, 400, -1)]
    for values in figures.values():
        assert np.isnan(values).tolist() == [False, True]
    none, figures = extract_objects(merged([FLOOR], [FLOOR]), regions([]), CONFIG)
    assert none == ()
    assert all(values.shape == (0,) for values in figures.values())


def test_everything_changed_and_an_empty_region() -> None:
    far = transform(make_pose(translation=(0, 0, 50.0)), FLOOR)
    objects, figures = extract_objects(merged([FLOOR], [far]), regions([(0, 0, 0), (0, 0, 50), (0, 0, 25)]), CONFIG)
    # the outlier filter may thin the rims, but nearly all of both floors is one object each
    assert [(item.session, item.region) for item in objects] == [("before", 0), ("after", 1)]
    assert figures["s_points"].tolist()[0::2] == [0, 0]
    assert figures["v_sphere_m3"].tolist()[0::2] == [0, 0]


def test_moving_both_sessions_moves_the_objects() -> None:
    # by whole voxels and quarter turns, so that the grid of the map frame stays the same
    g, h = yaw_pose(np.pi / 2, (40.0, -8.0, 4.0)), yaw_pose(0.83, (-7.0, 3.3, 0.1))
    plain = merged([FLOOR, BOX], [FLOOR, PLATE])
    centre = (0.0, 0.0, 0.5)
    objects, figures = extract_objects(plain, regions([centre]), CONFIG)
    moved_maps = MergedMaps(
        replace(plain.before, points=transform(g, plain.before.points)),
        replace(plain.after, points=transform(h, plain.after.points)),
        g @ invert(h),
        {},
        True,
    )
    moved_centre = tuple(transform(g, np.array([centre]))[0].tolist())
    moved_objects, moved_figures = extract_objects(moved_maps, regions([moved_centre]), CONFIG)
    assert summary(moved_objects) == summary(objects)
    for item, other in zip(objects, moved_objects, strict=True):
        assert as_set(transform(g, item.points_map)) == as_set(other.points_map)
        assert set(map(tuple, item.returns.tolist())) == set(map(tuple, other.returns.tolist()))
    for name, values in figures.items():
        np.testing.assert_allclose(moved_figures[name], values, rtol=1e-9)


def bent(pose: Float64Array, strain: float, length_m: float = 40.0) -> PathAlignment:
    """An after odometry that goes `strain` too far along x, corrected at anchors a metre apart."""
    along = np.arange(-length_m, length_m + 0.5)
    anchors = np.column_stack([along, 0 * along, 0 * along])
    shifts = np.array([make_pose(translation=(-strain * x, 0, 0)) for x in along])
    return PathAlignment(transform(invert(pose), anchors), shifts @ pose)


def test_local_anchors_that_agree_give_the_rigid_answer() -> None:
    pose = yaw_pose(0.83, (-7.0, 3.3, 0.1))
    rigid = merged([FLOOR, PLATE], [FLOOR, BOX], pose)
    candidates = regions([(0, 0, 0.5), (3, 3, 0.5)], 4.4)
    local = replace(rigid, local=bent(pose, 0.0))
    expected, figures = extract_objects(rigid, candidates, CONFIG)
    objects, local_figures = extract_objects(local, candidates, CONFIG)
    assert summary(objects) == summary(expected)
    for item, other in zip(objects, expected, strict=True):
        np.testing.assert_allclose(item.points_map, other.points_map, atol=1e-9)
        np.testing.assert_array_equal(item.returns, other.returns)
    for name, values in figures.items():
        np.testing.assert_allclose(local_figures[name], values, rtol=1e-9)


def stretched(straight: MergedMaps, strain: float) -> MergedMaps:
    """The same maps with an after odometry that goes too far along x, and the alignment that takes it back."""
    pose = straight.before_T_after
    in_map = transform(pose, straight.after.points) * (1 + strain, 1, 1)
    after = replace(straight.after, points=transform(invert(pose), in_map))
    return MergedMaps(straight.before, after, pose, {}, True, local=bent(pose, strain / (1 + strain)))


def test_the_border_of_a_bent_sphere_makes_nothing_new() -> None:
    # full voxels of the floor hold 16 points: one that lost a point to the crop would not count as occupied
    drifted = stretched(merged([FLOOR], [FLOOR], yaw_pose(0.7, (1.0, 2.0, 0.1))), 0.09)
    full = CONFIG.model_copy(
        update={
            "extract": ExtractConfig(method="voxel", voxel_m=0.4, min_points=16),
            "cluster": ClusterConfig(min_points=1),
        }
    )
    for radius_m in (2.3, 3.7, 4.9):
        objects, _ = extract_objects(drifted, regions([(0.2, 0.2, 0.1)], radius_m), full)
        assert objects == ()


def test_a_bent_alignment_straightens_the_after_map() -> None:
    # 4 % too far: 8 cm at the box, 20 cm at the rim of the floor
    straight = merged([FLOOR], [FLOOR, BOX], yaw_pose(-0.4, (2.0, 5.0, 0.2)))
    drifted = stretched(straight, 0.04)
    centre = (1.0, 0.5, 0.5)
    for radius_m in (2.0, 4.9):
        objects, figures = extract_objects(drifted, regions([centre], radius_m), CONFIG)
        expected, _ = extract_objects(straight, regions([centre], radius_m), CONFIG)
        assert summary(objects) == summary(expected)
        np.testing.assert_allclose(objects[0].points_map, expected[0].points_map, atol=2e-3)
        # cut to the sphere exactly, in the map frame
        moved = drifted.alignment.to_map(drifted.after.points)
        assert figures["s_points"][0] == np.count_nonzero(np.linalg.norm(moved - centre, axis=1) <= radius_m)


@pytest.mark.parametrize("block_returns", [7, 1 << 22])
def test_objects_from_groups_of_both_maps(block_returns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cdpipe.extract.objects, "_BLOCK_RETURNS", block_returns)
    pair = merged([FLOOR, BOX], [FLOOR, BOX])
    some, others = np.array([5, 7]), np.array([2, 9, 700])
    groups = [
        PointGroup("after", some, pair.after.points[some], -1),
        PointGroup("before", others, pair.before.points[others], 4),
    ]
    first, second = assemble_objects(pair, groups)
    assert first.returns.tolist() == [[0, 15], [0, 21], [1, 15], [1, 21]]
    assert second.returns.tolist() == [[0, 6], [0, 27], [0, 2100], [1, 6], [1, 27], [1, 2100]]
    assert (first.region, second.region) == (-1, 4)
    assert assemble_objects(pair, []) == ()


def groups_at(pair: MergedMaps, *places: Float64Array) -> list[PointGroup]:
    return [PointGroup("after", np.arange(len(points)), points, 0) for points in places]


def test_regions_that_hold_nothing_are_taken_back() -> None:
    pair = merged([FLOOR], [FLOOR, BOX])
    # the box's corner nearest to x = 5.95 is (1.95, 1.75, 1.15): 4 m away, the border included
    centres = [(0, 0, 0.5), (2, 1, 0.5), (-5, -5, 0.5), (5.95, 1.75, 1.15), (5.96, 1.75, 1.15), (1, 1, 1)]
    before = regions(centres, radius_m=4.0, n_reported=5)
    found = withdraw_empty_regions(before, groups_at(pair, BOX), CONFIG)
    assert found.is_reported.tolist() == [True, True, False, True, False, False]
    assert found.is_withdrawn is not None
    assert found.is_withdrawn.tolist() == [False, False, True, False, True, False]
    assert found.is_proposed.tolist() == before.is_reported.tolist() == [True] * 5 + [False]
    for same in ("centres_map", "scores", "pairs", "radius_m"):
        assert getattr(found, same) is getattr(before, same)
    at_origin = groups_at(pair, np.zeros((1, 3)))
    for reach_m, is_held in ((4.0, True), (np.nextafter(4.0, 5.0), False)):
        assert withdraw_empty_regions(regions([(reach_m, 0, 0)], 4.0), at_origin, CONFIG).is_reported.tolist() == [
            is_held
        ]
    # what is far from one object may hold another
    second = withdraw_empty_regions(before, groups_at(pair, BOX, BOX - (6, 6, 0)), CONFIG)
    assert second.is_reported.tolist() == [True, True, True, True, False, False]


def test_without_objects_all_regions_are_taken_back_unless_none_is_to_be() -> None:
    before = regions([(0, 0, 0.5), (3, 0, 0.5), (9, 0, 0.5)], n_reported=2)
    nothing = withdraw_empty_regions(before, [], CONFIG)
    assert nothing.is_reported.tolist() == [False] * 3
    assert nothing.is_withdrawn is not None
    assert nothing.is_withdrawn.tolist() == [True, True, False]
    kept = CONFIG.model_copy(update={"extract": ExtractConfig(method="voxel", withdraw=False)})
    assert withdraw_empty_regions(before, [], kept) is before
    pair = merged([FLOOR], [FLOOR, BOX])
    silent = regions([(0, 0, 0.5)], n_reported=0)
    for proposed in (silent, regions([])):
        found = withdraw_empty_regions(proposed, groups_at(pair, BOX), CONFIG)
        assert not found.is_reported.any()
        assert not found.is_proposed.any()


def slow_twin(pair: MergedMaps, candidates: ChangeRegions, config: PipelineConfig) -> list[tuple[str, int, set[int]]]:
    """(session, region, map points) of every object, point by point."""
    clouds = {"before": pair.before.points, "after": transform(pair.before_T_after, pair.after.points)}
    voxel_m, origin_m = config.extract.voxel_m, config.extract.origin_m

    def is_new(point: Float64Array, others: Float64Array) -> bool:
        if config.extract.method == "nearest":
            return bool(np.linalg.norm(others - point, axis=1).min() > config.extract.distance_m)
        cell = np.floor((point - origin_m) / voxel_m)
        in_cell = (np.floor((others - origin_m) / voxel_m) == cell).all(axis=1).sum()
        return bool(in_cell < config.extract.min_points)

    taken: set[tuple[str, int]] = set()
    found = []
    for region in np.flatnonzero(candidates.is_reported).tolist():
        for session, other in (("after", "before"), ("before", "after")):
            cloud = clouds[session]
            near = np.linalg.norm(cloud - candidates.centres_map[region], axis=1) <= candidates.radius_m
            new = [
                index
                for index in np.flatnonzero(near).tolist()
                if (session, index) not in taken and is_new(cloud[index], clouds[other])
            ]
            gaps_m = np.linalg.norm(cloud[new][:, None] - cloud[new], axis=2)
            k = config.outlier.neighbours
            if len(new) > k:
                spacing = np.sort(gaps_m, axis=1)[:, 1 : k + 1].mean(axis=1)
                is_kept = np.abs(spacing - spacing.mean()) <= config.outlier.sigmas * spacing.std()
                new, gaps_m = np.array(new)[is_kept].tolist(), gaps_m[is_kept][:, is_kept]
            left = set(range(len(new)))
            clusters = []
            while left:
                cluster, open_ones = set(), [min(left)]
                while open_ones:
                    here = open_ones.pop()
                    if here in left:
                        left.remove(here)
                        cluster.add(here)
                        open_ones += np.flatnonzero(gaps_m[here] <= config.cluster.radius_m).tolist()
                if len(cluster) >= config.cluster.min_points:
                    clusters.append({new[index] for index in cluster})
            clusters.sort(key=lambda members: (-len(members), min(members)))
            found += [(session, region, members) for members in clusters]
            taken |= {(session, index) for members in clusters for index in members}
    return found


@pytest.mark.parametrize(
    "rule",
    [
        ExtractConfig(method="voxel"),
        ExtractConfig(method="voxel", voxel_m=0.4, origin_m=0.13),
        ExtractConfig(method="voxel", voxel_m=0.8, min_points=3),
        ExtractConfig(method="nearest"),
        ExtractConfig(method="nearest", distance_m=0.45),
    ],
    ids=["paper", "origin", "min-points", "nearest", "farther"],
)
@pytest.mark.parametrize("seed", range(2))
def test_both_rules_on_points_equal_their_slow_twin(rule: ExtractConfig, seed: int) -> None:
    rng = stream(seed, "clouds")
    shared = rng.uniform((-4, -4, 0), (4, 4, 0.2), (900, 3))
    lumps = [rng.normal(rng.uniform((-3, -3, 0.8), (3, 3, 2.5)), 0.25, (60, 3)) for _ in range(6)]
    jittered = [shared + rng.normal(0, 0.03, shared.shape) for _ in range(2)]
    pair = merged([jittered[0], *lumps[:3]], [jittered[1], *lumps[2:]], yaw_pose(0.8, (3.0, -5.0, 0.4)))
    candidates = regions([(-1.5, 0.0, 1.0), (1.0, 0.5, 1.0), (2.0, 2.0, 1.5)], 3.0, n_reported=2)
    config = CONFIG.model_copy(
        update={"extract": rule, "outlier": OutlierConfig(), "cluster": ClusterConfig(radius_m=0.5, min_points=8)}
    )
    found = [(each.session, each.region, set(each.indices.tolist())) for each in cut_objects(pair, candidates, config)]
    assert {each[0] for each in found} == {"before", "after"}
    assert found == slow_twin(pair, candidates, config)


def test_hulls_by_hand_and_degenerate() -> None:
    cube = np.array([[x, y, z] for x in (0, 2.0) for y in (0, 2.0) for z in (0, 2.0)])
    assert hull_volume_m3(cube) == pytest.approx(8.0)
    assert hull_volume_m3(cube[:4]) == 0.0  # four points of one face
    assert hull_volume_m3(cube[:3]) == hull_volume_m3(cube[:0]) == 0.0
