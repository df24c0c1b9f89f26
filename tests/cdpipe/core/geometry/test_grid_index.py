from __future__ import annotations

import numpy as np
import pytest

from cdpipe.core.geometry import transform, yaw_pose
from cdpipe.core.geometry.grid_index import GridIndex
from cdpipe.model.types import MappedSession


@pytest.mark.parametrize("radius_m", [0.3, 2.0, 5.5, 100.0])
def test_a_sphere_equals_the_brute_force_one(radius_m: float) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-20, 20, (5000, 3)) * (1, 0.7, 0.1)
    index = GridIndex(points)
    for centre in [*rng.uniform(-15, 15, (10, 3)), points[0], np.array([2.0, -4.0, 0.0]), np.array([500.0, 0, 0])]:
        inside = np.flatnonzero(((points - centre) ** 2).sum(axis=1) <= radius_m**2)
        found = index.crop(centre, radius_m)
        np.testing.assert_array_equal(np.sort(found), inside)
        np.testing.assert_array_equal(index.points_within(centre, radius_m), points[found])


def test_the_border_belongs_to_the_sphere() -> None:
    points = np.array([[2.0, 0, 0], [0, -2.0, 0], [0, 0, 2.0], [2.0000001, 0, 0]])
    assert sorted(GridIndex(points).crop(np.zeros(3), 2.0).tolist()) == [0, 1, 2]


def test_an_empty_map_and_a_single_point() -> None:
    assert GridIndex(np.zeros((0, 3))).crop(np.zeros(3), 5.0).shape == (0,)
    assert GridIndex(np.ones((1, 3))).crop(np.zeros(3), 5.0).tolist() == [0]


def test_maps_of_the_pipeline_are_ordered_and_turned_ones_are_not(tunnel_before: MappedSession) -> None:
    points = tunnel_before.map.points
    turned = transform(yaw_pose(1.0), points)
    for cloud, is_ordered in ((points, True), (turned, False)):
        indices = GridIndex(cloud).crop(cloud[1000], 3.0)
        assert (np.diff(indices) > 0).all() == is_ordered
        np.testing.assert_array_equal(GridIndex(cloud).points_within(cloud[1000], 3.0), cloud[indices])
