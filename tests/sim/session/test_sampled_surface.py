"""Which points lie off a surface, against one tree of all of its samples."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sim.geometry.mesh import Mesh, join_meshes, split_triangles
from sim.props.rocks import rock_mesh
from sim.session.labels import SampledSurface


def heap_of_rocks(n: int) -> Mesh:
    rocks, places = [rock_mesh((0.6, 0.5, 0.4), key) for key in range(n)], np.random.default_rng(n).normal(size=(n, 3))
    return join_meshes([Mesh(rock.vertices + place, rock.faces) for rock, place in zip(rocks, places, strict=True)])


@pytest.mark.parametrize("limit_m", [0.02, 0.1, 5.0])
def test_points_lie_off_where_no_sample_is_near(limit_m: float) -> None:
    heap = heap_of_rocks(12)
    middles = split_triangles(heap.vertices[heap.faces], 0.03).mean(axis=1)
    points = np.concatenate(
        [
            heap.vertices + np.random.default_rng(0).normal(0.0, 0.03, heap.vertices.shape),
            np.random.default_rng(1).normal(0.0, 1.5, (500, 3)),
        ]
    )
    expected = cKDTree(np.concatenate([heap.vertices, middles])).query(points)[0] > limit_m
    np.testing.assert_array_equal(SampledSurface(heap).lies_off(points, limit_m), expected)
    assert limit_m > 1.0 or 0 < expected.sum() < len(points)


def test_no_points_lie_off() -> None:
    assert SampledSurface(heap_of_rocks(1)).lies_off(np.empty((0, 3)), 0.1).shape == (0,)
