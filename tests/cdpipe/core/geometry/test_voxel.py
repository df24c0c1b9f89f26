from __future__ import annotations

import numpy as np
import pytest

from cdpipe.core.geometry.voxel import UniqueCells, cell_corners, cell_keys, max_coordinate_m, thin


def test_keys_by_hand() -> None:
    points = np.array([[0.0, 0, 0], [0.49, 0.49, 0.49], [0.5, 0, 0], [-0.01, 0, 0], [0, 0.5, 0], [0, 0, 0.5]])
    keys = cell_keys(points, 0.5)
    origin = keys[0]
    # x is the most significant part, z the least
    np.testing.assert_array_equal(keys - origin, [0, 0, 1 << 42, -(1 << 42), 1 << 21, 1])
    np.testing.assert_array_equal(cell_keys(points[:1], 0.5, origin_m=0.2), cell_keys(np.full((1, 3), -0.2), 0.5))


def test_corners_by_hand_and_of_the_farthest_cells() -> None:
    edge = max_coordinate_m(0.5)
    points = np.array([[0.1, 0.6, -0.1], [-3.2, 0.0, 7.4], [-edge, edge, -edge]])
    found = cell_corners(cell_keys(points, 0.5), 0.5)
    np.testing.assert_array_equal(found, [[0.0, 0.5, -0.5], [-3.5, 0.0, 7.0], [-edge, edge, -edge]])
    assert cell_corners(np.zeros(0, np.int64), 0.5).shape == (0, 3)


def test_equal_keys_are_equal_cells() -> None:
    points = np.random.default_rng(0).uniform(-4, 4, (3000, 3))
    cells = np.floor((points - 0.13) / 0.7).astype(int)
    keys = cell_keys(points, 0.7, origin_m=0.13)
    by_key: dict[int, set[tuple[int, ...]]] = {}
    for key, cell in zip(keys.tolist(), cells.tolist(), strict=True):
        by_key.setdefault(key, set()).add(tuple(cell))
    assert all(len(found) == 1 for found in by_key.values())
    assert len(by_key) == len({tuple(cell) for cell in cells.tolist()})


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e9, 1e9])
def test_points_that_have_no_cell(bad: float) -> None:
    with pytest.raises(ValueError, match="must be finite and within"):
        cell_keys(np.array([[0.0, bad, 0.0]]), 0.2)


def test_the_farthest_cells_are_distinct() -> None:
    edge = max_coordinate_m(0.2)
    corners = np.array([[x, y, z] for x in (-edge, edge) for y in (-edge, edge) for z in (-edge, edge)])
    assert len(set(cell_keys(corners, 0.2).tolist())) == 8


@pytest.mark.parametrize("n_batches", [1, 2, 7])
def test_unique_cells_equal_a_dict(n_batches: int) -> None:
    keys = np.random.default_rng(1).integers(0, 60, 500)
    cells = UniqueCells()
    ids = np.concatenate([cells.add(part) for part in np.array_split(keys, n_batches)])
    assert sorted(cells.keys.tolist()) == sorted(set(keys.tolist()))
    assert len(cells) == len(cells.keys)
    np.testing.assert_array_equal(cells.keys[ids], keys)


def test_no_points() -> None:
    cells = UniqueCells()
    assert cells.add(cell_keys(np.zeros((0, 3)), 0.2)).shape == (0,)
    assert len(cells) == len(cells.keys) == 0
    assert thin(np.zeros((0, 3)), 0.2).shape == (0, 3)


def test_thinning_keeps_the_first_point_of_each_cell() -> None:
    points = np.array([[0.9, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [1.1, 0, 0]])
    np.testing.assert_array_equal(thin(points, 1.0), points[[0, 3]])
