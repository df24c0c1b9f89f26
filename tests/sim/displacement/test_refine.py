from __future__ import annotations

import numpy as np
import pytest

from sim.displacement.measure import SignedDistance, closest_places
from sim.displacement.refine import refine, swept_volume_m3, twin_walls
from sim.geometry.mesh import Mesh, box_mesh, point_triangle_distance
from sim.geometry.topology import closed_volume_m3, edges_of


def room(half_m: float = 2.0) -> Mesh:
    """A cube whose faces look inwards."""
    box = box_mesh((half_m,) * 3)
    return Mesh(box.vertices, np.ascontiguousarray(box.faces[:, ::-1]))


def test_refined_walls_are_closed_face_inwards_and_enclose_what_they_did() -> None:
    mesh = room()
    walls = refine(twin_walls(mesh), lambda places: np.where(np.linalg.norm(places - 2.0, axis=1) < 3.0, 0.3, np.inf))
    for session in ("before", "after"):
        fine = walls.mesh(session)
        assert len(fine.faces) > 10 * len(mesh.faces)
        assert edges_of(fine).is_closed
        assert closed_volume_m3(fine) == pytest.approx(-64.0, abs=1e-9)
    corners = walls.before[walls.faces]
    longest_m = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
    is_near = (np.linalg.norm(corners - 2.0, axis=2) < 2.5).all(axis=1)
    assert longest_m[is_near].max() <= 0.3


def test_swept_volume_of_a_wall_that_came_in_by_hand() -> None:
    walls = twin_walls(room())
    chosen = np.flatnonzero(walls.before[:, 0] == 2.0)
    moved = walls.moved(chosen, walls.before[chosen] - [0.5, 0.0, 0.0], 1)
    faces = np.flatnonzero((moved.owner[moved.faces] == 1).any(axis=1))
    assert swept_volume_m3(moved, faces) == pytest.approx(0.5 * 4 * 4)  # rock came into the void: positive


def test_closest_places_agree_with_another_implementation() -> None:
    generator = np.random.default_rng(3)
    triangles, points = generator.normal(size=(4000, 3, 3)), generator.normal(size=(4000, 3))
    apart_m = np.linalg.norm(points - closest_places(points, triangles), axis=1)
    np.testing.assert_allclose(apart_m, point_triangle_distance(points, triangles), atol=1e-9)


def test_signed_distance_agrees_with_every_triangle_and_with_the_side() -> None:
    walls = refine(twin_walls(room()), lambda places: np.where(places[:, 0] > 0, 0.4, np.inf))
    mesh = walls.mesh("before")
    points = np.random.default_rng(5).uniform(-3.0, 3.0, size=(500, 3))
    found_m = SignedDistance(mesh).measure(points)
    triangles = mesh.vertices[mesh.faces]
    every_m = [
        point_triangle_distance(np.repeat(point[None], len(triangles), axis=0), triangles).min() for point in points
    ]
    np.testing.assert_allclose(np.abs(found_m), every_m, atol=1e-9)
    is_inside = (np.abs(points) < 2.0).all(axis=1)
    np.testing.assert_array_equal(found_m > 0, is_inside)


@pytest.mark.parametrize("cell_m", [0.12, 0.7])
def test_the_search_finds_the_closest_of_all_triangles_near_and_far(cell_m: float) -> None:
    generator = np.random.default_rng(11)
    x, y = np.meshgrid(np.arange(-3.0, 3.0, cell_m), np.arange(-3.0, 3.0, cell_m), indexing="ij")
    n_rows, n_columns = x.shape
    heights = 100.0 + 0.02 * x**2 + 0.4 * cell_m * generator.normal(size=x.shape)
    corner = (np.arange(n_rows - 1)[:, None] * n_columns + np.arange(n_columns - 1)).ravel()
    faces = [[corner, corner + n_columns, corner + 1], [corner + 1, corner + n_columns, corner + n_columns + 1]]
    mesh = Mesh(
        np.stack([x, y, heights], axis=-1).reshape(-1, 3),
        np.concatenate([np.stack(each, axis=1) for each in faces]).astype(np.int32),
    )
    above_m = generator.choice([-1, 1], 80) * 8 ** generator.uniform(-3, 1, 80)
    points = np.column_stack([generator.uniform(-4, 4, (80, 2)), 100.0 + above_m])
    triangles = mesh.vertices[mesh.faces]
    copies = [np.tile(point, (len(triangles), 1)) for point in points]
    every_m = np.array([np.linalg.norm(closest_places(each, triangles) - each, axis=1).min() for each in copies])
    found_m = np.abs(SignedDistance(mesh).measure(points))
    np.testing.assert_array_equal(np.isnan(found_m), every_m > 5.0)
    assert 0 < (every_m > 5.0).sum() < 20
    np.testing.assert_allclose(found_m[every_m <= 5.0], every_m[every_m <= 5.0], atol=1e-9)


def test_nothing_within_five_metres_is_nan() -> None:
    assert np.isnan(SignedDistance(room()).measure(np.array([[9.0, 0.0, 0.0]]))).all()
