from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array
from scenarios.schema import Drift, Floor, MeshFile, Niche, Roughness, Ruts, Section, Stones, Tunnel, Variation
from scenarios.schema.tunnel import Bolts, Screen
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster
from sim.rock.centreline import Centreline, build_centreline, left_of
from sim.rock.tunnel import mesh_tunnel, require_buildable

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


@pytest.fixture(scope="module")
def network() -> Tunnel:
    """Branches, a loop, a crossing without a node, slopes, niches and everything that changes walls and floor."""
    return Tunnel(
        nodes={
            "a": (0, 0, 0), "b": (18, 1, 0.4), "c": (40, -3, 0.2), "d": (16, 16, 1.8), "e": (40, 14, 0),
            "f": (30, -18, -1.5), "g": (29, -1, 0.3), "h": (30, 30, 2),
        },
        drifts=(
            Drift(nodes=("a", "b", "g", "c")), Drift(nodes=("b", "d", "e")), Drift(nodes=("e", "c")),
            Drift(nodes=("f", "g", "h")),
        ),
        niches=(
            Niche(between=("a", "b"), fraction=0.45, side="left", width_m=2.5, depth_m=1.6, height_m=2.2),
            Niche(between=("c", "e"), fraction=0.5, side="right", width_m=3.0, depth_m=2.0, height_m=2.4),
        ),
        section=Section(width_m=4.2, height_m=3.4),
        variation=Variation(share=0.08, length_m=10.0),
        roughness=(Roughness(amplitude_m=0.12, length_m=2.0), Roughness(amplitude_m=0.05, length_m=0.6)),
        floor=Floor(crossfall_percent=3.0, ruts=Ruts(depth_m=0.1)),
        meander_m=0.5,
        resolution_m=0.2,
    )  # fmt: skip


def with_section(tunnel: Tunnel, shape: str) -> Tunnel:
    section = Section.model_validate({"shape": shape, "width_m": 4.2, "height_m": 3.4})
    return tunnel.model_copy(update={"section": section})


def places_in_the_void(centreline: Centreline, count: int) -> Float64Array:
    """Random places at least a metre from the smooth walls of drifts and niches; the roughness takes 0.52 m at most."""
    rng = np.random.default_rng(0)
    line = np.concatenate([drift.points[20:-20] for drift in centreline.drifts])
    places = line[rng.integers(len(line), size=count)]
    places = places + np.column_stack([rng.uniform(-0.7, 0.7, (count, 2)), rng.uniform(1.0, 2.0, count)])
    in_niche = count // 20
    for index, recess in enumerate(centreline.recesses):
        rows = slice(index * in_niche, (index + 1) * in_niche)
        out_m = rng.uniform(0, recess.back_m - 1.0, (in_niche, 1))
        places[rows, :2] = recess.point[:2] + out_m * recess.outward
        places[rows, 2] = recess.point[2] + 1.1
    return places


@pytest.mark.parametrize("shape", ["horseshoe", "rectangle", "cave"])
def test_a_network_is_closed_faces_inwards_and_lets_no_ray_escape(network: Tunnel, shape: str) -> None:
    tunnel = with_section(network, shape)
    centreline = build_centreline(tunnel, SEED)
    mesh = mesh_tunnel(tunnel, centreline, SEED)
    assert_closed(mesh)
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    volume_m3 = (a * np.cross(b, c)).sum() / 6
    assert -2300 < volume_m3 < -1400  # 140 m of drift with a section of 12 to 14 m2, turned inside out
    places = places_in_the_void(centreline, 100_000)
    directions = np.random.default_rng(1).normal(size=places.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ranges_m, _, normals = Caster([mesh]).hits(places, directions)
    assert np.isfinite(ranges_m).all()
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


@pytest.mark.parametrize("shape", ["horseshoe", "d", "arch", "rectangle"])
def test_a_smooth_drift_has_the_section_it_was_asked_for(shape: str) -> None:
    section = Section.model_validate({"shape": shape, "width_m": 4.0, "height_m": 3.5})
    tunnel = straight(section)
    walls = Caster([mesh_tunnel(tunnel, build_centreline(tunnel, 0), 0)])
    middle = np.array([[6.0, 0.03, 1.5]])
    for direction, distance_m in (((0, 1, 0), 1.97), ((0, -1, 0), 2.03), ((0, 0, 1), 2.0), ((0, 0, -1), 1.5)):
        ranges_m, _, _ = walls.cast(middle, np.array([direction], dtype=np.float64))
        assert ranges_m[0] == pytest.approx(distance_m, abs=0.01)
    # A blind drift goes on for half its width behind its node.
    assert walls.cast(middle, np.array([[1.0, 0, 0]]))[0][0] == pytest.approx(6.0 + 2.0, abs=0.06)
    assert walls.cast(middle + np.array([0, 1.4, -0.5]), np.array([[1.0, 0, 0]]))[0][0] == pytest.approx(
        6.0 + 2.0, abs=0.06
    )


def test_width_and_height_change_slowly_by_the_share_that_was_asked_for() -> None:
    section = Section(shape="d", width_m=4.0, height_m=3.5)
    tunnel = straight(section, resolution_m=0.2).model_copy(update={"variation": Variation(share=0.06, length_m=5.0)})
    long = tunnel.model_copy(update={"nodes": {"a": (0, 0, 0), "b": (4000, 0, 0)}})
    line = build_centreline(long, SEED).drifts[0]
    # 4 km are some 450 independent lengths: standard deviations are known to 3.5 %, correlations to 0.05.
    assert line.width_m.std() == pytest.approx(0.06 * 4.0, rel=0.12)
    assert line.height_m.std() == pytest.approx(0.06 * 3.5, rel=0.12)
    assert abs(np.corrcoef(line.width_m, line.height_m)[0, 1]) < 0.15
    assert np.corrcoef(line.width_m[:-50], line.width_m[50:])[0, 1] == pytest.approx(np.exp(-1), abs=0.15)
    assert np.abs(np.diff(line.width_m)).max() < 0.03
    # What the mesh has is what the centreline says; `at` gives the nominal section.
    centreline = build_centreline(tunnel, SEED)
    walls = Caster([mesh_tunnel(tunnel, centreline, SEED)])
    for fraction in (0.1, 0.37, 0.8):
        point, _, nominal = centreline.at("a", "b", fraction)
        drift, first, last = centreline.edges["a", "b"]
        sample = round(first + fraction * (last - first))
        width_m, height_m = (
            float(size[sample]) for size in (centreline.drifts[drift].width_m, centreline.drifts[drift].height_m)
        )
        assert nominal == section
        assert (width_m, height_m) != (section.width_m, section.height_m)
        for way, distance_m in (((0, 1, 0), width_m / 2), ((0, 0, 1), height_m - 1.4)):
            ranges_m, _, _ = walls.cast(point[None] + [0, 0, 1.4], np.array([way], dtype=np.float64))
            assert ranges_m[0] == pytest.approx(distance_m, abs=0.03)


def test_a_drift_never_closes_however_wild_its_size_and_its_walls() -> None:
    tunnel = straight(Section(width_m=3.0, height_m=2.6), resolution_m=0.2).model_copy(
        update={
            "nodes": {"a": (0, 0, 0), "b": (120, 0, 0)},
            "variation": Variation(share=0.4, length_m=4.0),
            "roughness": (Roughness(amplitude_m=0.35, length_m=2.0),),
            "floor": Floor(roughness=0.0),
        }
    )
    centreline = build_centreline(tunnel, SEED)
    line = centreline.drifts[0]
    assert line.width_m.min() == 1.5 and line.height_m.min() == 1.3
    walls = Caster([mesh_tunnel(tunnel, centreline, SEED)])
    eye = np.array([[0.0, 0.0, 0.5]])
    assert walls.cast(eye, np.array([[1.0, 0, 0]]))[0][0] > 120


def test_a_niche_is_a_recess_of_its_size_in_the_wall_it_names() -> None:
    niche = Niche(between=("b", "a"), fraction=0.25, side="left", width_m=2.4, depth_m=1.5, height_m=2.0)
    tunnel = straight(Section(shape="d", width_m=4.0, height_m=3.5)).model_copy(update={"niches": (niche,)})
    walls = Caster([mesh_tunnel(tunnel, build_centreline(tunnel, 0), 0)])
    # a quarter of the way from b to a is x = 9; left is that of the drift's own direction, +y

    def reach(place: tuple[float, float, float], way: tuple[float, float, float]) -> float:
        return float(walls.cast(np.array([place]), np.array([way], dtype=np.float64))[0][0])

    assert reach((9, 0, 1), (0, 1, 0)) == pytest.approx(3.5, abs=0.03)
    assert reach((9, 0, 1), (0, -1, 0)) == pytest.approx(2.0, abs=0.01)
    assert reach((9, 2.8, 1), (1, 0, 0)) == pytest.approx(1.2, abs=0.03)
    assert reach((9, 2.8, 1), (-1, 0, 0)) == pytest.approx(1.2, abs=0.03)
    assert reach((9, 2.8, 1), (0, 0, 1)) == pytest.approx(1.0, abs=0.03)
    assert reach((9, 2.8, 1), (0, 0, -1)) == pytest.approx(1.0, abs=0.03)
    assert reach((9, 0.3, 1), (0, 0, 1)) == pytest.approx(2.48, abs=0.03)  # the drift's roof is whole: 1.5 + 1.977 m
    tall = tunnel.model_copy(update={"niches": (niche.model_copy(update={"height_m": 4.0}),)})
    with pytest.raises(ScenarioError, match=r"tunnel\.niches\[0\]\.height_m = 4: .*3\.50 m"):
        build_centreline(tall, 0)


def floor_height(walls: Caster, x: float, y: float) -> float:
    return 1.2 - float(walls.cast(np.array([[x, y, 1.2]]), np.array([[0.0, 0, -1.0]]))[0][0])


def test_crossfall_and_ruts_by_hand() -> None:
    plain = straight(Section(shape="d", width_m=4.0, height_m=3.5)).model_copy(
        update={"floor": Floor(crossfall_percent=-5.0)}
    )
    walls = Caster([mesh_tunnel(plain, build_centreline(plain, 0), 0)])
    assert [floor_height(walls, 6.0, y) for y in (-1.0, 0.0, 1.2)] == pytest.approx([0.05, 0.0, -0.06], abs=0.005)
    floor = Floor(crossfall_percent=4.0, ruts=Ruts(depth_m=0.1, gauge_m=1.6, width_m=0.6))
    tunnel = straight(Section(shape="d", width_m=4.0, height_m=3.5), resolution_m=0.08).model_copy(
        update={"floor": floor}
    )
    walls = Caster([mesh_tunnel(tunnel, build_centreline(tunnel, 0), 0)])
    for y, depth_m in ((0.0, 0.0), (0.8, 0.1), (-0.8, 0.1), (0.65, 0.05), (-0.95, 0.05), (1.4, 0.0), (-1.4, 0.0)):
        # the left, +y, is high; half depth a quarter of the rut's width from its middle
        assert floor_height(walls, 6.0, y) == pytest.approx(0.04 * y - depth_m, abs=0.008)
    # Ruts end over the 1.5 m before the face of a blind drift, which is at 14 m.
    share = 0.4 / 1.5
    assert floor_height(walls, 13.6, 0.8) == pytest.approx(0.032 - 0.1 * share**2 * (3 - 2 * share), abs=0.008)


def test_ruts_fade_out_where_drifts_meet() -> None:
    tunnel = Tunnel(
        nodes={"a": (-12, 0, 0), "o": (0, 0, 0), "b": (12, 0, 0), "c": (0, -12, 0)},
        drifts=(Drift(nodes=("a", "o", "b")), Drift(nodes=("c", "o"))),
        section=Section(shape="d", width_m=4.0, height_m=3.5),
        floor=Floor(ruts=Ruts(depth_m=0.12, gauge_m=1.6, width_m=0.6)),
        resolution_m=0.1,
    )
    walls = Caster([mesh_tunnel(tunnel, build_centreline(tunnel, 0), 0)])
    along = np.arange(-8.0, 8.0, 0.1)
    heights = np.array([floor_height(walls, x, -0.8) for x in along])
    # whole beyond 1.3 half widths of the other drift, gone in its middle, in between never steeper than
    # 1.5 * 0.12 m over the 0.9 m of the fade
    np.testing.assert_allclose(heights[np.abs(along) > 2.7], -0.12, atol=0.01)
    np.testing.assert_allclose(heights[np.abs(along) < 1.4], 0.0, atol=0.01)
    assert np.abs(np.diff(heights)).max() / 0.1 < 0.25


@pytest.mark.parametrize(
    ("shape", "ruts", "steepest"),
    [("horseshoe", None, 0.35), ("horseshoe", Ruts(depth_m=0.1), 0.8), ("cave", None, 0.6)],
)
def test_floors_have_no_step_where_drifts_meet(network: Tunnel, shape: str, ruts: Ruts | None, steepest: float) -> None:
    # Slopes of 12 % at most, 3 % crossfall; a rut's flank is as steep as pi * depth / width = 0.7, a cave's bowl 0.5.
    floor = Floor(crossfall_percent=3.0, ruts=ruts)
    tunnel = with_section(network, shape).model_copy(
        update={"roughness": (), "niches": (), "floor": floor, "resolution_m": 0.15}
    )
    walls = Caster([mesh_tunnel(tunnel, build_centreline(tunnel, SEED), SEED)])
    grid = np.stack(np.meshgrid(*[np.arange(-3.2, 3.2, 0.05)] * 2, indexing="ij"), axis=-1)
    around = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    for node in "bgced":
        eyes = np.concatenate(
            [grid + tunnel.nodes[node][:2], np.full((*grid.shape[:2], 1), tunnel.nodes[node][2] + 0.7)], 2
        )
        eyes = eyes.reshape(-1, 3)
        down_m, _, normals = walls.hits(eyes, np.tile([0.0, 0, -1.0], (len(eyes), 1)))
        clear_m = np.min(
            [walls.cast(eyes, np.tile([np.cos(a), np.sin(a), 0.0], (len(eyes), 1)))[0] for a in around], axis=0
        )
        # the fillet along a wall, and in a cave the bowl, are no floor
        is_floor = (normals[:, 2] > 0) & (clear_m > (0.9 if shape == "cave" else 0.6))
        heights = np.where(is_floor, -down_m, np.nan).reshape(grid.shape[:2])
        assert np.isfinite(heights).sum() > 2000
        for axis in (0, 1):
            assert np.nanmax(np.abs(np.diff(heights, axis=axis))) / 0.05 < steepest


def test_levels_that_cross_keep_their_own_floors() -> None:
    tunnel = Tunnel(
        nodes={"a": (-12, 0, 0), "b": (12, 0, 0), "c": (0, -12, 6), "d": (0, 12, 6)},
        drifts=(Drift(nodes=("a", "b")), Drift(nodes=("c", "d"))),
        section=Section(width_m=4.0, height_m=3.2),
        resolution_m=0.2,
    )
    walls = Caster([mesh_tunnel(tunnel, build_centreline(tunnel, 0), 0)])
    down, up = np.array([[0, 0, -1.0]]), np.array([[0, 0, 1.0]])
    for level in (0.0, 6.0):
        eye = np.array([[0.1, 0.1, level + 1.0]])
        assert walls.cast(eye, down)[0][0] == pytest.approx(1.0, abs=0.01)
        assert walls.cast(eye, up)[0][0] == pytest.approx(2.2, abs=0.02)


def test_in_a_foreign_mesh_the_line_is_that_of_the_nodes() -> None:
    nodes = {"a": (0.0, 0.0, 0.0), "b": (20.0, 5.0, 1.0)}
    tunnel = Tunnel(
        mesh=MeshFile(path="mine.stl"), nodes=nodes, drifts=(Drift(nodes=("a", "b")),), meander_m=2.0,
        variation=Variation(share=0.1),
    )  # fmt: skip
    centreline = build_centreline(tunnel, SEED)
    points, section = centreline.edge("a", "b")
    np.testing.assert_allclose(points[[0, -1]], [nodes["a"], nodes["b"]])
    np.testing.assert_array_equal(points, centreline.drifts[0].points)
    across = left_of(np.array([[20.0, 5.0]]) / np.hypot(20, 5))[0]
    np.testing.assert_allclose(points[:, :2] @ across, 0.0, atol=1e-9)
    assert section == tunnel.section
    assert set(centreline.drifts[0].width_m) == {section.width_m}
    assert set(centreline.drifts[0].height_m) == {section.height_m}
    assert build_centreline(Tunnel(mesh=MeshFile(path="mine.stl")), 0).drifts == ()


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
    with pytest.raises(ScenarioError, match=r"'a' and 'b' .*1\.00 m"):
        build_centreline(double, 0)


def test_a_tunnel_that_memory_cannot_hold_is_refused_before_it_is_built() -> None:
    section = Section(width_m=8.0, height_m=6.0)
    nodes = {"a": (-5_000, 0, 0), "b": (5_000, 0, 0)}
    long = Tunnel(nodes=nodes, drifts=(Drift(nodes=("a", "b")),), section=section, resolution_m=0.15)
    line = build_centreline(long, SEED)
    require_buildable(long, line)  # 10 km are not too much
    with pytest.raises(ScenarioError, match=r"resolution_m = 0\.05: too fine .*section\.width_m.*at least 0\.1"):
        require_buildable(long.model_copy(update={"resolution_m": 0.05}), line)
    niche = Niche(between=("a", "b"), fraction=0.5, side="left", width_m=100, depth_m=100, height_m=5)
    hall = long.model_copy(update={"niches": (niche,) * 40})
    with pytest.raises(ScenarioError, match=r"resolution_m = 0\.15: too fine .*niches\): at least"):
        require_buildable(hall, build_centreline(hall, SEED))
    stony = long.model_copy(update={"floor": Floor(stones=Stones(per_m2=50.0))})
    with pytest.raises(ScenarioError, match=r"per_m2 = 50: 4e\+06 stones on 8e\+04 m2 of floor: at most 6\.2"):
        require_buildable(stony, line)


@pytest.mark.parametrize(
    "build",
    [
        lambda: Section(width_m=1e5),
        lambda: Section(height_m=101),
        lambda: Stones(per_m2=1e12),
        lambda: straight(Section(), resolution_m=1e-4),
        lambda: Bolts(spacing_m=1e-6),
        lambda: Screen(opening_m=1e-6),
    ],
)
def test_sizes_that_no_tunnel_has_are_refused(build: Callable[[], object]) -> None:
    with pytest.raises(ValidationError, match="Input should be"):
        build()


def test_a_drift_that_comes_to_a_node_twice_has_its_edges_in_order() -> None:
    nodes = {"portal": (0, 0, 0), "j": (20, 0, 0), "x": (35, 10, 0), "y": (20, 20, 0), "end": (5, 12, 0)}
    section = Section(width_m=3.0, height_m=3.0)
    for names in (("portal", "j", "x", "y", "j"), ("portal", "j", "x", "y", "j", "end"), ("j", "x", "y", "j")):
        tunnel = Tunnel(nodes=nodes, drifts=(Drift(nodes=names),), section=section)
        line = build_centreline(tunnel, SEED)
        for start, end in pairwise(names):
            points, _ = line.edge(start, end)
            # j lies at a sample to half a step, a rounded corner up to half a reach of 6 m beside the line
            for name, point in ((start, points[0]), (end, points[-1])):
                assert np.linalg.norm(point - nodes[name]) < (0.06 if name not in "xy" else 3.1)
            straight_m = float(np.linalg.norm(np.subtract(nodes[end], nodes[start])))
            way_m = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
            assert straight_m - 7.0 < way_m < straight_m + 0.2


def test_a_tunnel_lies_near_the_origin_and_its_rock_is_as_coarse_as_its_mesh() -> None:
    told = straight(Section()).model_dump()
    assert Tunnel.model_validate(told | {"nodes": {"a": (19_990.0, 0, 0), "b": (20_000.0, 0, -20_000.0)}})
    with pytest.raises(ValidationError, match=r"node 'b' lies 500 km from the origin"):
        Tunnel.model_validate(told | {"nodes": {"a": (19_990.0, 0, 0), "b": (20_000.0, -500_000.0, 0)}})
    octaves = [{"amplitude_m": 0.1, "length_m": 2.0}, {"amplitude_m": 0.02, "length_m": 0.05}]
    assert Tunnel.model_validate(told | {"resolution_m": 0.2, "roughness": octaves})
    with pytest.raises(ValidationError, match=r"roughness\.1\.length_m = 0\.05.* resolution_m = 0\.21"):
        Tunnel.model_validate(told | {"resolution_m": 0.21, "roughness": octaves})
