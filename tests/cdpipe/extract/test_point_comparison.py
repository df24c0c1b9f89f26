from __future__ import annotations

import numpy as np
import pytest

import cdpipe.extract.point_comparison
from cdpipe.extract.point_comparison import inlier_mask, is_within, label_clusters, new_points_mask
from cdpipe.model.config import ClusterConfig, ExtractConfig, OutlierConfig


@pytest.mark.parametrize("is_dense", [True, False])
@pytest.mark.parametrize(("min_points", "origin_m"), [(1, 0.0), (1, 0.17), (3, 0.0)])
def test_new_points_equal_a_dict_of_voxels(
    min_points: int, origin_m: float, is_dense: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not is_dense:
        monkeypatch.setattr(cdpipe.extract.point_comparison, "_MAX_DENSE_CELLS", 0)
    rng = np.random.default_rng(0)
    points, reference = rng.uniform(-3, 3, (800, 3)), rng.uniform(-4, 4, (1500, 3))
    config = ExtractConfig(voxel_m=0.65, min_points=min_points, origin_m=origin_m)
    counts: dict[tuple[int, ...], int] = {}
    for cell in np.floor((reference - origin_m) / 0.65).astype(int).tolist():
        counts[tuple(cell)] = counts.get(tuple(cell), 0) + 1
    cells = np.floor((points - origin_m) / 0.65).astype(int).tolist()
    expected = [counts.get(tuple(cell), 0) < min_points for cell in cells]
    found = new_points_mask(points, reference, config)
    assert 0 < found.sum() < len(points)
    np.testing.assert_array_equal(found, expected)


def test_nothing_is_new_beside_itself_and_all_is_beside_nothing() -> None:
    points = np.random.default_rng(1).normal(size=(100, 3))
    assert not new_points_mask(points, points, ExtractConfig()).any()
    assert new_points_mask(points, np.zeros((0, 3)), ExtractConfig()).all()
    assert new_points_mask(points, points + 1000.0, ExtractConfig()).all()
    assert new_points_mask(np.zeros((0, 3)), points, ExtractConfig()).shape == (0,)


def test_points_within_a_distance_equal_brute_force_and_include_the_border() -> None:
    rng = np.random.default_rng(3)
    points, reference = rng.uniform(-2, 2, (500, 3)), rng.uniform(-2, 2, (400, 3))
    gaps_m = np.linalg.norm(points[:, None] - reference, axis=2).min(axis=1)
    found = is_within(points, reference, 0.3)
    assert 0 < found.sum() < len(points)
    np.testing.assert_array_equal(found, gaps_m <= 0.3)
    line = np.array([[1.0, 0, 0], [1.5, 0, 0], [1.6, 0, 0]])
    assert is_within(line, np.array([[0.5, 0, 0]]), 1.0).tolist() == [True, True, False]
    assert not is_within(line, np.zeros((0, 3)), 0.3).any()
    assert is_within(line[:0], line, 0.3).shape == (0,)


def test_inliers_equal_brute_force() -> None:
    rng = np.random.default_rng(2)
    points = np.concatenate([rng.normal(0, 0.3, (200, 3)), rng.uniform(-4, 4, (20, 3))])
    gaps = np.sort(np.linalg.norm(points[:, None] - points[None], axis=2), axis=1)
    spacing = gaps[:, 1:7].mean(axis=1)
    mu, sigma = spacing.mean(), spacing.std()
    for sigmas in (0.3, 1.0, 2.0):
        expected = (spacing > mu - sigmas * sigma) & (spacing < mu + sigmas * sigma)
        np.testing.assert_array_equal(inlier_mask(points, OutlierConfig(neighbours=6, sigmas=sigmas)), expected)


def test_an_even_cloud_has_no_outliers_and_a_small_one_is_kept() -> None:
    circle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    ring = np.column_stack([np.cos(circle), np.sin(circle), 0 * circle])
    assert inlier_mask(ring, OutlierConfig(neighbours=4, sigmas=1.0)).all()
    for n in (0, 1, 8):
        assert inlier_mask(np.random.default_rng(0).normal(size=(n, 3)), OutlierConfig(neighbours=8)).all()


def test_clusters_by_hand() -> None:
    # a chain of four, a pair, one alone; the gap between chain and pair is 0.51
    x = np.array([0.0, 5.0, 0.5, 1.0, 1.5, 2.01, 2.2])
    points = np.column_stack([x, 0 * x, 0 * x])
    config = ClusterConfig(radius_m=0.5, min_points=2)
    assert label_clusters(points, config).tolist() == [0, -1, 0, 0, 0, 1, 1]
    assert label_clusters(points, ClusterConfig(radius_m=0.5, min_points=3)).tolist() == [0, -1, 0, 0, 0, -1, -1]
    assert label_clusters(points, ClusterConfig(radius_m=0.51, min_points=2)).tolist() == [0, -1, 0, 0, 0, 0, 0]
    # equal sizes: in the order of their first points
    assert label_clusters(points[[5, 0, 6, 2]], config).tolist() == [0, 1, 0, 1]
    assert label_clusters(points[:0], config).shape == (0,)
    assert label_clusters(points[:1], config).tolist() == [-1]
    assert label_clusters(points[:1], ClusterConfig(min_points=1)).tolist() == [0]
