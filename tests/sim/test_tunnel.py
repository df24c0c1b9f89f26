from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from cdpipe.errors import ScenarioError
from cdpipe.geometry import Float64Array
from scenarios.schema import Drift, Section, Tunnel
from sim.centreline import build_centreline
from sim.mesh import Mesh
from sim.raycast import Caster
from sim.tunnel import mesh_tunnel, section_distance

SEED = 3


def straight(section: Section, resolution_m: float = 0.1) -> Tunnel:
    return Tunnel(
        nodes={"a": (0, 0, 0), "b": (12, 0, 0)},
        drifts=(Drift(nodes=("a", "b")),),
        section=section,
        resolution_m=resolution_m,
    )


def edges_of(mesh: Mesh) -> tuple[Float64Array, Float64Array]:
    """Directed edges as numbers, and the same edges reversed."""
    start = mesh.faces.astype(np.int64)
    end = np.roll(start, -1, axis=1)
    n = len(mesh.vertices)
    return np.sort((start * n + end).ravel()), np.sort((end * n + start).ravel())


def assert_closed(mesh: Mesh) -> None:
    forth, back = edges_of(mesh)
    assert len(np.unique(forth)) == len(forth)
    np.testing.assert_array_equal(forth, back)


def test_a_network_is_one_closed_surface_that_faces_inwards(junction_tunnel: Tunnel) -> None:
    mesh = mesh_tunnel(junction_tunnel, build_centreline(junction_tunnel, SEED), SEED)
    assert_closed(mesh)
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    volume_m3 = (a * np.cross(b, c)).sum() / 6
    assert -800 < volume_m3 < -500  # some 70 m of drift with a section of 9 m2, turned inside out


def test_no_ray_escapes_and_every_ray_hits_a_front_face(junction_tunnel: Tunnel) -> None:
    centreline = build_centreline(junction_tunnel, SEED)
    walls = Caster([mesh_tunnel(junction_tunnel, centreline, SEED)])
    rng = np.random.default_rng(0)
    line = np.concatenate([drift.points[10:-10] for drift in centreline.drifts])
    origins = line[rng.integers(len(line), size=100_000)] + [0, 0, 1.3]
    directions = rng.normal(size=(100_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ranges_m, ids, normals = walls.hits(origins, directions)
    assert np.isfinite(ranges_m).all()
    assert (ids == 0).all()
    assert ((normals * directions).sum(axis=1) < 1e-3).all()


def test_no_face_lies_inside_a_junction(junction_tunnel: Tunnel) -> None:
    # Where two smooth drifts meet, the middle of one must see through the mouth of the other.
    tunnel = junction_tunnel.model_copy(update={"roughness": (), "meander_m": 0.0})
    centreline = build_centreline(tunnel, SEED)
    walls = Caster([mesh_tunnel(tunnel, centreline, SEED)])
    for route in (("a", "b", "c"), ("a", "b", "d"), ("d", "b", "c")):
        points = np.concatenate([centreline.edge(*pair)[0] for pair in pairwise(route)]) + np.array([0, 0, 1.0])
        steps = np.diff(points[::5], axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        keep = lengths > 0
        ranges_m, _, _ = walls.cast(points[::5][:-1][keep], steps[keep] / lengths[keep, None])
        assert (ranges_m > lengths[keep]).all()


@pytest.mark.parametrize("shape", ["horseshoe", "rectangle"])
def test_a_smooth_drift_has_the_section_it_was_asked_for(shape: str) -> None:
    section = Section.model_validate({"shape": shape, "width_m": 4.0, "height_m": 3.5})
    tunnel = straight(section)
    walls = Caster([mesh_tunnel(tunnel, build_centreline(tunnel, 0), 0)])
    middle = np.array([[6.0, 0.03, 1.0]])
    for direction, distance_m in (((0, 1, 0), 1.97), ((0, -1, 0), 2.03), ((0, 0, 1), 2.5), ((0, 0, -1), 1.0)):
        ranges_m, _, _ = walls.cast(middle, np.array([direction], dtype=np.float64))
        assert ranges_m[0] == pytest.approx(distance_m, abs=0.01)
    # A blind drift goes on for half its width behind its node.
    assert walls.cast(middle, np.array([[1.0, 0, 0]]))[0][0] == pytest.approx(6.0 + 2.0, abs=0.06)


def test_section_distance_by_hand() -> None:
    arch = Section(width_m=4.0, height_m=3.5)  # upright to 1.5 m, then a half circle of 2 m
    distance_m = section_distance(
        arch, np.array([0.0, 2.0, 1.0, 0.0, 3.0, 0.0]), np.array([3.5, 0.7, 1.0, 4.5, 1.5, 1.0])
    )
    np.testing.assert_allclose(distance_m, [0.0, 0.0, -1.0, 1.0, 1.0, -2.0], atol=1e-12)
    box = Section(shape="rectangle", width_m=4.0, height_m=3.5)
    np.testing.assert_allclose(section_distance(box, np.array([1.5, 0.0]), np.array([1.0, 4.0])), [-0.5, 0.5])


def test_the_seed_draws_the_rock(junction_tunnel: Tunnel) -> None:
    meshes = [mesh_tunnel(junction_tunnel, build_centreline(junction_tunnel, seed), seed) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(meshes[0].vertices, meshes[1].vertices)
    np.testing.assert_array_equal(meshes[0].faces, meshes[1].faces)
    assert len(meshes[0].vertices) != len(meshes[2].vertices)


def test_the_floor_is_smoother_than_the_walls(junction_tunnel: Tunnel) -> None:
    rough = straight(Section(width_m=5.0, height_m=4.0)).model_copy(update={"roughness": junction_tunnel.roughness})
    walls = Caster([mesh_tunnel(rough, build_centreline(rough, SEED), SEED)])
    stations = np.stack([np.linspace(0, 12, 200), np.zeros(200), np.full(200, 1.5)], axis=1)
    spread = [walls.cast(stations, np.tile(np.array(d, float), (200, 1)))[0].std() for d in ((0, 1, 0), (0, 0, -1))]
    assert 0.05 < spread[0] < 0.25
    assert spread[1] < 0.6 * spread[0]


def test_bad_tunnels_are_refused() -> None:
    coarse = straight(Section(width_m=3.0, height_m=2.5), resolution_m=0.8)
    with pytest.raises(ScenarioError, match=r"tunnel\.resolution_m = 0\.8: too coarse"):
        mesh_tunnel(coarse, build_centreline(coarse, 0), 0)
    section = Section(width_m=3.0, height_m=2.5)
    double = Tunnel(nodes={"a": (0, 0, 0), "b": (1, 0, 0)}, drifts=(Drift(nodes=("a", "b")),), section=section)
    with pytest.raises(ScenarioError, match=r"'a' and 'b' are 1\.00 m apart"):
        build_centreline(double, 0)
