from __future__ import annotations

import numpy as np
import pytest
import trimesh

from cdpipe.core.geometry import Float64Array
from sim.geometry.mesh import (
    Mesh,
    NearSurface,
    box_mesh,
    crop_near,
    cut_triangles,
    cylinder_mesh,
    join_meshes,
    move_mesh,
    point_triangle_distance,
)


def volume_m3(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def test_primitives_are_closed_and_face_outwards() -> None:
    assert volume_m3(box_mesh((0.5, 1.0, 2.0))) == pytest.approx(8.0)
    # A prism of n sides: n / 2 r^2 sin(2 pi / n) times its height.
    assert volume_m3(cylinder_mesh(0.5, 1.5, 64)) == pytest.approx(32 * 0.25 * np.sin(2 * np.pi / 64) * 3.0)


def test_distance_to_a_triangle_by_hand() -> None:
    triangle = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0]])
    cases = [
        ((0.5, 0.5, 3.0), 3.0),  # over the inside
        ((1.0, -2.0, 0.0), 2.0),  # beside an edge
        ((-3.0, -4.0, 0.0), 5.0),  # beyond a corner
        ((2.0, 2.0, 0.0), np.sqrt(2.0)),  # beside the long edge
        ((0.2, 0.2, 0.0), 0.0),
    ]
    points = np.array([point for point, _ in cases])
    distances = point_triangle_distance(points, np.broadcast_to(triangle, (len(points), 3, 3)))
    np.testing.assert_allclose(distances, [distance for _, distance in cases], atol=1e-12)


def test_near_surface_agrees_with_every_triangle_tried() -> None:
    rng = np.random.default_rng(0)
    mesh = join_meshes([box_mesh((2.0, 0.3, 0.2)), move_mesh(cylinder_mesh(0.4, 1.0, 12), np.diag([1.0, 1, 1, 1]))])
    points = rng.uniform(-2.4, 2.4, (5000, 3)) * (1.0, 0.5, 0.6)
    triangles = mesh.vertices[mesh.faces]
    distances = np.min([point_triangle_distance(points, np.broadcast_to(t, (5000, 3, 3))) for t in triangles], axis=0)
    near = NearSurface(mesh, 0.1).marks(points)
    np.testing.assert_array_equal(near, distances <= 0.1)
    assert 300 < near.sum() < 4500


def test_near_surface_of_nothing() -> None:
    assert NearSurface(box_mesh((1, 1, 1)), 0.1).marks(np.empty((0, 3))).shape == (0,)
    assert not NearSurface(box_mesh((1, 1, 1)), 0.1).marks(np.full((4, 3), 9.0)).any()


def test_near_a_surface_without_triangles_is_nothing() -> None:
    nothing = Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32))
    assert not NearSurface(nothing, 0.1).marks(np.zeros((4, 3))).any()


def test_near_part_keeps_only_what_comes_close() -> None:
    far = move_mesh(box_mesh((1, 1, 1)), np.array([[1.0, 0, 0, 5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
    part = crop_near(join_meshes([box_mesh((1, 1, 1)), far]), box_mesh((0.5, 0.5, 0.5)), 0.6)
    np.testing.assert_array_equal(part.faces, box_mesh((1, 1, 1)).faces)


def test_near_part_is_every_triangle_whose_bounding_box_comes_close() -> None:
    rng = np.random.default_rng(3)
    triangles = rng.uniform(-6, 6, (4000, 1, 3)) + rng.uniform(-3, 3, (4000, 3, 3))  # some span the target, corners out
    mesh = Mesh(triangles.reshape(-1, 3), np.arange(12000, dtype=np.int32).reshape(-1, 3))
    part = crop_near(mesh, box_mesh((0.5, 0.4, 0.3)), 0.6)
    reach = np.array([1.1, 1.0, 0.9])
    is_near = ((triangles.max(axis=1) >= -reach) & (triangles.min(axis=1) <= reach)).all(axis=1)
    np.testing.assert_array_equal(part.faces, mesh.faces[is_near])
    is_corner_in = (np.abs(triangles) <= reach).all(axis=2).any(axis=1)
    assert 50 < is_corner_in.sum() < is_near.sum() - 50


def test_a_box_is_that_of_trimesh_to_the_bit() -> None:
    for half_size_m in np.random.default_rng(3).uniform(0.001, 9.0, (50, 3)):
        box, expected = box_mesh(half_size_m), trimesh.creation.box(extents=2.0 * half_size_m)
        assert box.vertices.tobytes() == np.asarray(expected.vertices, np.float64).tobytes()
        np.testing.assert_array_equal(box.faces, expected.faces)


def test_a_cylinder_that_is_remembered_cannot_be_written() -> None:
    with pytest.raises(ValueError, match="read-only"):
        cylinder_mesh(0.2, 0.3, 32).vertices[0] = 0.0


def halve_one_by_one(triangle: Float64Array, edge_m: float) -> list[Float64Array]:
    """Return the pieces of a triangle, in any order."""
    lengths_m = [np.linalg.norm(triangle[corner] - triangle[corner - 2]) for corner in range(3)]
    longest = int(np.argmax(lengths_m))
    if lengths_m[longest] <= edge_m:
        return [triangle]
    a, b, c = np.roll(triangle, -longest, axis=0)
    middle = (a + b) / 2
    return [piece for half in ([a, middle, c], [middle, b, c]) for piece in halve_one_by_one(np.array(half), edge_m)]


def test_triangles_are_halved_as_one_by_one() -> None:
    triangles = np.random.default_rng(4).normal(size=(20, 3, 3))
    triangles[0] = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]  # two edges of one length
    pieces, owners = cut_triangles(triangles, 0.4)
    for number, triangle in enumerate(triangles):
        expected = sorted(piece.tobytes() for piece in halve_one_by_one(triangle, 0.4))
        assert sorted(piece.tobytes() for piece in pieces[owners == number]) == expected
