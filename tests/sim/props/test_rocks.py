"""Fragments: closed, angular, of the size asked for; sizes by Rosin and Rammler."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.stats import kstest

from cdpipe.core.geometry import stream
from sim.geometry.topology import edges_of
from sim.props.rocks import passing_share, rock_mesh, rosin_rammler
from sim.props.shapes import signed_volume_m3


def test_sizes_follow_the_law() -> None:
    sizes = rosin_rammler(4000, 0.25, stream(1, "sizes"))
    assert kstest(sizes, lambda size: 1 - np.exp(-((1.87 * size / 0.25) ** 0.88))).pvalue > 0.05
    assert (sizes > 0).all()


def test_passing_share_at_the_characteristic_size() -> None:
    # exp(-1.87^0.88) = exp(-1.7346) = 0.1765
    assert passing_share(np.array([0.25]), 0.25)[0] == pytest.approx(0.8235, abs=1e-4)


@pytest.mark.parametrize("subdivisions", [0, 1, 3])
@pytest.mark.parametrize("key", [0, 5, 11])
def test_a_fragment_is_closed_faces_outwards_and_fills_its_box(key: int, subdivisions: int) -> None:
    mesh = rock_mesh((1.0, 0.8, 0.6), key, subdivisions)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [0.5, 0.4, 0.3], atol=1e-12)
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [-0.5, -0.4, -0.3], atol=1e-12)
    assert edges_of(mesh).is_closed
    hull_m3 = ConvexHull(mesh.vertices).volume
    # The volume of the convex hull comes from another program; chips take a little from it, never more than a fifth.
    share = signed_volume_m3(mesh) / hull_m3
    assert share == pytest.approx(1.0, abs=1e-9) if subdivisions == 0 else 0.8 < share < 1.0
    assert 0.3 * 0.48 < hull_m3 < 0.65 * 0.48


def test_each_subdivision_takes_four_times_as_many_triangles_and_keys_differ() -> None:
    counts = [len(rock_mesh((1, 1, 1), 3, n).faces) for n in range(3)]
    assert counts[1] == 4 * counts[0]
    assert counts[2] == 16 * counts[0] <= 16 * 22
    same, other = rock_mesh((1, 1, 1), 3), rock_mesh((1, 1, 1), 4)
    np.testing.assert_array_equal(rock_mesh((1, 1, 1), 3).vertices, same.vertices)
    assert same.vertices.shape != other.vertices.shape or np.abs(same.vertices - other.vertices).max() > 0.05
