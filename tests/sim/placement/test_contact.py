"""How deep points lie in rock or in a solid, against the closed form of a room and of a box."""

from __future__ import annotations

import numpy as np

from sim.geometry.mesh import Mesh, box_mesh
from sim.geometry.raycast import Caster
from sim.placement.contact import find_way_out


def test_points_behind_the_walls_of_a_room_are_in_rock() -> None:
    cube = box_mesh((2.0, 2.0, 2.0))
    room = Caster([Mesh(cube.vertices, cube.faces[:, ::-1])])
    points = np.random.default_rng(0).uniform(-2.6, 2.6, (3000, 3))
    beyond_m = np.abs(points) - 2.0
    depth_m, way_out = find_way_out(points, room)
    np.testing.assert_array_equal(depth_m > 0, (beyond_m > 0).any(axis=1))
    behind_one = (beyond_m > 0).sum(axis=1) == 1
    np.testing.assert_allclose(depth_m[behind_one], beyond_m[behind_one].max(axis=1), rtol=0.05, atol=1e-4)
    out = points[behind_one] + 1.001 * depth_m[behind_one, None] * way_out[behind_one]
    assert (np.abs(out) < 2.001).all()


def test_depth_in_a_box_is_the_way_to_its_nearest_side() -> None:
    box = Caster([box_mesh((1.0, 0.5, 0.25))])
    points = np.random.default_rng(1).uniform(-1.2, 1.2, (2000, 3))
    margin_m = np.array([1.0, 0.5, 0.25]) - np.abs(points)
    is_inside = (margin_m > 0).all(axis=1)
    depth_m, _ = find_way_out(points, box, is_solid_inside=True)
    np.testing.assert_array_equal(depth_m > 0, is_inside)
    np.testing.assert_allclose(depth_m[is_inside], margin_m[is_inside].min(axis=1), rtol=0.05, atol=1e-4)
