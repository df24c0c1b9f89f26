from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array
from scenarios.schema import (
    Bolts,
    CableTray,
    Drift,
    Duct,
    Furniture,
    Markers,
    Pipe,
    Roughness,
    Screen,
    Section,
    Tunnel,
)
from sim.furniture.furniture import Fixture, furnish
from sim.furniture.support import BOLT_LOWEST_SHARE, STUB_M, covered_rows
from sim.furniture.utilities import DUCT_LOWEST_M, FIXING_M, wall_plans
from sim.furniture.wall_line import PASSING_M, wall_lines
from sim.geometry.mesh import Mesh, point_triangle_distance
from sim.geometry.raycast import Caster
from sim.geometry.sweep import bars, circle, sweep
from sim.rock.axis import Axis, is_opening, lower_envelope, measure_axes
from sim.rock.centreline import Centreline, build_centreline
from sim.rock.tunnel import mesh_tunnel

SEED = 3
EVERYTHING = Furniture(
    pipes=(
        Pipe(diameter_m=0.16, side="left", height_share=0.35),
        Pipe(diameter_m=0.11, side="left", height_share=0.45),
    ),
    ducts=(Duct(diameter_m=0.6, lateral=-0.4),),
    cable_trays=(CableTray(side="right", height_share=0.6),),
    bolts=Bolts(),
    screen=Screen(share=0.5),
    markers=Markers(every_m=5, size_m=0.3, side="right", height_share=0.3),
)


def straight(furniture: Furniture, length_m: float = 24.0, **override: object) -> Tunnel:
    settings: dict[str, object] = {
        "nodes": {"a": (0, 0, 0), "b": (length_m, 0, 0)},
        "drifts": (Drift(nodes=("a", "b")),),
        "section": Section(width_m=4.0, height_m=3.2),
        "resolution_m": 0.2,
        "furniture": furniture,
    }
    return Tunnel.model_validate(settings | override)


def built(tunnel: Tunnel) -> tuple[Centreline, Mesh, Caster]:
    centreline = build_centreline(tunnel, SEED)
    wall = mesh_tunnel(tunnel, centreline, SEED)
    return centreline, wall, Caster([wall])


def furnished(tunnel: Tunnel, seed: int = SEED) -> dict[str, Fixture]:
    centreline, _, walls = built(tunnel)
    return {fixture.name: fixture for fixture in furnish(tunnel, centreline, walls, seed)}


def volume_m3(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def is_in_rock(points: Float64Array, walls: Caster) -> BoolArray:
    """The first face that a ray out of the rock meets is seen from behind."""
    up = np.tile([0.3, 0.1, np.sqrt(0.9)], (len(points), 1))
    _, ids, normals = walls.hits(points, up)
    return (ids < 0) | ((normals * up).sum(axis=1) > 0)


def depths_m(points: Float64Array, wall: Mesh) -> Float64Array:
    """Distance to the nearest of the 24 triangles with the nearest middles."""
    if len(points) == 0:
        return np.empty(0)
    triangles = wall.vertices[wall.faces]
    _, near = cKDTree(triangles.mean(axis=1)).query(points, k=24)
    return np.min([point_triangle_distance(points, triangles[near[:, k]]) for k in range(24)], axis=0)


def samples_of(mesh: Mesh) -> Float64Array:
    return np.concatenate([mesh.vertices, mesh.vertices[mesh.faces].mean(axis=1)])


@pytest.fixture(scope="module")
def network(junction_tunnel: Tunnel) -> tuple[Tunnel, Centreline, Mesh, Caster, dict[str, Fixture]]:
    """Three drifts 4.2 m wide that bend, branch and end blind, with all furniture."""
    section = Section(width_m=4.2, height_m=3.4)
    tunnel = junction_tunnel.model_copy(update={"section": section, "furniture": EVERYTHING})
    centreline, wall, walls = built(tunnel)
    fixtures = furnish(tunnel, centreline, walls, SEED)
    return tunnel, centreline, wall, walls, {fixture.name: fixture for fixture in fixtures}


Network = tuple[Tunnel, Centreline, Mesh, Caster, dict[str, Fixture]]


def test_names_and_materials(network: Network) -> None:
    assert {name: fixture.material for name, fixture in network[4].items()} == {
        "pipe-1": "steel",
        "pipe-2": "steel",
        "duct-1": "fabric",
        "cable-tray-1": "steel",
        "cables-1": "rubber",
        "bolts": "steel",
        "screen": "steel",
        "markers": "reflector",
    }


@pytest.mark.parametrize("side", ["left", "right"])
def test_markers_hang_flat_on_their_wall_as_far_apart_as_they_say(side: str) -> None:
    markers = Markers.model_validate({"every_m": 5, "size_m": 0.4, "side": side, "height_share": 0.5})
    tunnel = straight(
        Furniture(markers=markers), section=Section(shape="rectangle", width_m=4.0, height_m=3.0), resolution_m=0.1
    )
    mesh = furnished(tunnel)["markers"].mesh
    plates = mesh.vertices.reshape(-1, 8, 3)
    wall_y = 2.0 if side == "left" else -2.0
    np.testing.assert_allclose(np.ptp(plates, axis=1), np.tile((0.4, 0.005, 0.4), (len(plates), 1)), atol=2e-3)
    middles = plates.mean(axis=1)
    np.testing.assert_allclose(np.diff(middles[:, 0]), 5.0, atol=0.01)
    assert len(middles) == 5
    np.testing.assert_allclose(middles[:, 1], wall_y - np.sign(wall_y) * 0.0325, atol=0.01)
    np.testing.assert_allclose(middles[:, 2], 1.5, atol=0.01)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_pipe_runs_at_its_height_its_side_and_its_stand_off(side: str) -> None:
    pipe = Pipe.model_validate({"diameter_m": 0.2, "side": side, "height_share": 0.4})
    tunnel = straight(
        Furniture(pipes=(pipe,)), section=Section(shape="rectangle", width_m=4.0, height_m=3.0), resolution_m=0.1
    )
    centreline, _, walls = built(tunnel)
    (axis,) = measure_axes(centreline, walls)
    (line,) = wall_lines(axis, wall_plans(tunnel.furniture)[0])
    wall_y = 2.0 if side == "left" else -2.0
    np.testing.assert_allclose(line.path[:, 1], wall_y - np.sign(wall_y) * (0.08 + 0.1), atol=0.01)
    np.testing.assert_allclose(line.path[:, 2], 0.4 * 3.0, atol=0.01)
    # A blind drift goes on for half its width, and nothing is hung in the last metre and a station.
    assert line.path[0, 0] == pytest.approx(-2.0 + 1.0, abs=0.3)
    assert line.path[-1, 0] == pytest.approx(24.0 + 2.0 - 1.0, abs=0.3)


def test_a_pipe_is_as_thick_as_it_says() -> None:
    path = np.array([[0.0, 0, 0], [2.0, 0, 0.0], [5.0, 0, 0.0]])
    tube = sweep(path, circle(0.1, 10))
    assert volume_m3(tube) == pytest.approx(np.pi * 0.1**2 * 5.0, rel=1e-9)
    assert volume_m3(bars(np.zeros((1, 3)), np.array([[0.0, 0, 2.0]]), 0.05)) == pytest.approx(0.05**2 * 2, rel=1e-9)
    rays = np.array([[0.0, 0.0, -1.0]])
    pipe = furnished(straight(Furniture(pipes=(Pipe(diameter_m=0.3, side="left", height_share=0.5),))))["pipe-1"]
    caster = Caster([pipe.mesh])
    above = np.array([[14.1, y, 3.0] for y in np.linspace(1.2, 2.0, 401)])
    hits = np.isfinite(caster.cast(above, np.repeat(rays, len(above), axis=0))[0])
    assert hits.sum() * 0.002 == pytest.approx(0.3, rel=0.06)


def test_nothing_but_fixings_lies_in_the_rock(network: Network) -> None:
    _, _, wall, walls, fixtures = network
    # Brackets and hangers reach FIXING_M into the rock; between its knots a wire is straight, and a plate is flat.
    bracket_m = FIXING_M + 0.02
    deepest_m = {"cables-1": 0.0, "screen": 0.03, "bolts": 0.01, "duct-1": bracket_m, "cable-tray-1": bracket_m}
    for name, fixture in fixtures.items():
        points = samples_of(fixture.mesh)
        buried = points[is_in_rock(points, walls)]
        assert (depths_m(buried, wall) < deepest_m.get(name, bracket_m)).all(), name
        assert len(buried) < 0.1 * len(points), name


def test_tubes_and_trays_themselves_stay_out_of_the_rock(network: Network) -> None:
    tunnel, centreline, _, walls, _ = network
    n_lines = 0
    for axis in measure_axes(centreline, walls):
        for plan in wall_plans(tunnel.furniture):
            for line in wall_lines(axis, plan):
                n_lines += 1
                half_m = np.array([plan.cross.half_width_m, plan.cross.half_height_m])
                for across, up in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
                    shifted = line.path + across * half_m[0] * line.left + up * half_m[1] * np.array([0, 0, 1.0])
                    assert not is_in_rock(shifted, walls).any()
    assert n_lines >= 9


def test_the_way_is_left_free(network: Network) -> None:
    _, centreline, _, _, fixtures = network
    line = np.concatenate([drift.points for drift in centreline.drifts])
    tree = cKDTree(line[:, :2])
    for name, fixture in fixtures.items():
        distance_m, nearest = tree.query(fixture.mesh.vertices[:, :2])
        above_m = fixture.mesh.vertices[:, 2] - line[nearest, 2]
        lowest_m = DUCT_LOWEST_M if name == "duct-1" else PASSING_M
        # Floors undulate by 0.1 m, and brackets lie below what they carry. What hangs over the mouth of a branch is
        # near the centreline of that.
        assert (above_m[distance_m < 1.0] > lowest_m - 0.15).all(), name
    pipe = fixtures["pipe-1"].mesh.vertices
    assert (tree.query(pipe[:, :2])[0] < 1.0).any()  # one does cross a mouth


@pytest.mark.parametrize(("width_m", "height_m", "passing_m"), [(4.0, 3.2, PASSING_M), (6.0, 5.0, 3.0)])
def test_a_pipe_climbs_over_an_opening_and_comes_down_again(width_m: float, height_m: float, passing_m: float) -> None:
    tunnel = straight(
        Furniture(pipes=(Pipe(diameter_m=0.15, side="left", height_share=0.4),)),
        nodes={"a": (0, 0, 0), "b": (14, 0, 0), "c": (28, 0, 0), "d": (14, width_m, 0)},
        drifts=(Drift(nodes=("a", "b", "c")), Drift(nodes=("b", "d"))),
        section=Section(width_m=width_m, height_m=height_m),
    )
    centreline, _, walls = built(tunnel)
    (line,) = wall_lines(measure_axes(centreline, walls)[0], wall_plans(tunnel.furniture)[0])
    is_over = np.abs(line.path[:, 0] - 14.0) < width_m / 2
    assert (line.path[is_over, 2] > passing_m).all()
    is_far = np.abs(line.path[:, 0] - 14.0) > width_m / 2 + 3.5
    np.testing.assert_allclose(line.path[is_far, 2], 0.4 * height_m, atol=0.03)
    assert line.path[:, 1].max() < width_m / 2  # straight across, not round the bay


def test_lines_end_where_the_roof_is_too_low_to_pass() -> None:
    tunnel = straight(
        Furniture(pipes=(Pipe(diameter_m=0.15, side="left", height_share=0.5),)),
        nodes={"a": (0, 0, 0), "b": (12, 0, 0), "c": (24, 0, 0), "d": (12, 14, 0)},
        drifts=(Drift(nodes=("a", "b", "c")), Drift(nodes=("b", "d"))),
        section=Section(width_m=3.0, height_m=2.1),
    )
    centreline, _, walls = built(tunnel)
    main, branch = measure_axes(centreline, walls)
    plan = wall_plans(tunnel.furniture)[0]
    before, after = wall_lines(main, plan)
    assert before.path[-1, 0] < 12.0 - 1.5 < 12.0 + 1.5 < after.path[0, 0]
    (inner,) = wall_lines(branch, plan)
    assert inner.path[0, 1] > 1.4  # where the branch's own wall begins


def test_at_a_crossing_only_the_first_drift_hands_its_duct_across() -> None:
    tunnel = straight(
        Furniture(ducts=(Duct(diameter_m=0.5, lateral=0.0),)),
        nodes={"a": (0, 0, 0), "b": (12, 0, 0), "c": (24, 0, 0), "d": (12, 14, 0), "e": (12, -14, 0)},
        drifts=(Drift(nodes=("a", "b", "c")), Drift(nodes=("d", "b", "e"))),
    )
    vertices = furnished(tunnel)["duct-1"].mesh.vertices
    in_crossing = vertices[(np.abs(vertices[:, 0] - 12.0) < 1.7) & (np.abs(vertices[:, 1]) < 1.7)]
    assert np.ptp(in_crossing[:, 0]) > 3.0
    assert np.abs(in_crossing[:, 1]).max() < 0.3


@pytest.mark.parametrize("lateral", [-0.9, 0.0, 0.5])
def test_a_duct_hangs_under_the_roof_where_it_should(lateral: float) -> None:
    tunnel = straight(
        Furniture(ducts=(Duct(diameter_m=0.6, lateral=lateral),)),
        section=Section(shape="rectangle", width_m=4.0, height_m=3.0),
        resolution_m=0.1,
    )
    duct = furnished(tunnel)["duct-1"].mesh
    tube = duct.vertices[duct.vertices[:, 2] < 3.0 - 0.05]
    assert (tube[:, 1].min() + tube[:, 1].max()) / 2 == pytest.approx(lateral * (2.0 - 0.3 - 0.1), abs=0.03)
    assert np.ptp(tube[:, 1]) == pytest.approx(0.6, rel=0.06)
    assert 3.0 - 0.1 - 0.6 - 0.1 < tube[:, 2].min() < 3.0 - 0.1 - 0.6 + 0.02


@pytest.mark.parametrize("seed", range(6))
def test_no_pipe_hangs_in_mid_air_where_its_wall_opens_into_another_drift(seed: int) -> None:
    tunnel = straight(
        Furniture(pipes=(Pipe(diameter_m=0.2, side="right", height_share=0.45),)),
        nodes={"corner": (0, 0, 0), "along": (50, -1, 0.5), "aside": (3, 30, 0.5)},
        drifts=(Drift(nodes=("corner", "along")), Drift(nodes=("corner", "aside"))),
        section=Section(width_m=10.0, height_m=5.2),
        meander_m=0.8,
        meander_length_m=40.0,
        resolution_m=0.5,
    )
    centreline = build_centreline(tunnel, seed)
    wall = mesh_tunnel(tunnel, centreline, seed)
    near = cKDTree(wall.vertices[wall.faces].mean(axis=1))
    for fixture in furnish(tunnel, centreline, Caster([wall]), seed):
        assert near.query(fixture.mesh.vertices)[0].max() < 1.0


def test_bolts_are_as_dense_as_their_spacing_says_and_stick_out_of_the_rock() -> None:
    for spacing_m in (1.0, 1.5):
        tunnel = straight(Furniture(bolts=Bolts(spacing_m=spacing_m)), length_m=36.0)
        _, _, walls = built(tunnel)
        mesh = furnished(tunnel)["bolts"].mesh
        bolts = mesh.vertices.reshape(-1, 19, 3)
        # Upright to 1.2 m, then a half circle of 2 m; bolts from 45 % of the height up.
        arc_m = 2 * 2.0 * (np.pi / 2 - np.arcsin((BOLT_LOWEST_SHARE * 3.2 - 1.2) / 2.0))
        assert len(bolts) == pytest.approx(arc_m * (36.0 + 4.0 - 2.0) / spacing_m**2, rel=0.1)
        nearest = cKDTree(bolts.mean(axis=1)).query(bolts.mean(axis=1), k=2)[0][:, 1]
        assert nearest.min() > 0.5 * spacing_m
        assert np.median(nearest) == pytest.approx(spacing_m, abs=0.15)
        assert bolts[:, :, 2].min() > BOLT_LOWEST_SHARE * 3.2 - 0.4
        tips = bolts[:, 14:].mean(axis=1)
        # The rock is as far behind a bolt's tip as the bolt is long.
        inwards = bolts[:, :4].mean(axis=1) - tips
        length_m = np.linalg.norm(inwards, axis=1)
        np.testing.assert_allclose(length_m, STUB_M, atol=1e-9)
        np.testing.assert_allclose(walls.cast(tips, inwards / length_m[:, None])[0], STUB_M, atol=0.03)
        assert not is_in_rock(tips, walls).any()


@pytest.mark.parametrize("share", [0.25, 0.6, 1.0])
def test_the_screen_covers_its_share_in_panels(share: float) -> None:
    tunnel = straight(Furniture(screen=Screen(share=share)), length_m=60.0)
    mesh = furnished(tunnel)["screen"].mesh
    covered = np.histogram(mesh.vertices[:, 0], bins=np.arange(-1.0, 61.0, 0.5))[0] > 0
    assert covered.mean() == pytest.approx(share, abs=0.06)
    assert mesh.vertices[:, 2].min() > 0.5 * 3.2


def test_rows_of_panels_by_count() -> None:
    for n_rows in (1, 2, 7, 40):
        for share in (0.0, 0.3, 0.5, 0.97, 1.0):
            rows = covered_rows(n_rows, share, np.random.default_rng(n_rows))
            assert (len(rows), rows.sum()) == (n_rows, round(share * n_rows))


@pytest.mark.parametrize("opening_m", [0.1, 0.15])
def test_wires_are_an_opening_apart_and_a_few_centimetres_off_the_rock(opening_m: float) -> None:
    tunnel = straight(Furniture(screen=Screen(opening_m=opening_m)))
    _, _, walls = built(tunnel)
    screen = furnished(tunnel)["screen"].mesh
    caster = Caster([screen])
    # Rays straight up beside the crown, where no panels overlap, a millimetre apart: a wire is a run of hits.
    origins = np.stack([np.arange(4.0, 20.0, 0.001), np.full(16000, 0.9), np.full(16000, 1.5)], axis=1)
    up = np.tile([0.0, 0.0, 1.0], (len(origins), 1))
    is_hit = np.isfinite(caster.cast(origins, up)[0])
    wires_m, behind_m = (origins[1:, 0][is_hit[1:] > is_hit[:-1]], origins[1:, 0][is_hit[1:] < is_hit[:-1]])
    assert np.median(np.diff(wires_m)) == pytest.approx(opening_m, abs=0.003)
    thickness_m = behind_m[1:] - wires_m[np.searchsorted(wires_m, behind_m[1:]) - 1]
    assert np.median(thickness_m) == pytest.approx(0.006, abs=0.002)
    gaps_m = walls.cast(screen.vertices, np.tile([0.0, 0.0, 1.0], (len(screen.vertices), 1)))[0]
    assert 0.005 < np.median(gaps_m) < 0.12


def test_every_face_that_can_be_seen_looks_at_the_viewer(network: Network) -> None:
    _, centreline, wall, _, fixtures = network
    caster = Caster([wall, *(fixture.mesh for fixture in fixtures.values())])
    rng = np.random.default_rng(0)
    line = np.concatenate([drift.points[30:-30] for drift in centreline.drifts])
    origins = line[rng.integers(len(line), size=50_000)]
    origins[:, 2] += rng.uniform(0.5, 2.0, len(origins))
    directions = rng.normal(size=(50_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    _, ids, normals = caster.hits(origins, directions)
    for number, name in enumerate(fixtures, start=1):
        mine = ids == number
        if name == "cables-1":  # they lie in the tray, above the eye
            continue
        assert mine.sum() > 20, name
        assert ((normals * directions).sum(axis=1)[mine] < 1e-3).mean() > 0.99, name
    assert volume_m3(fixtures["cables-1"].mesh) > 0


def test_the_budget_of_triangles(network: Network) -> None:
    _, centreline, _, _, fixtures = network
    length_m = sum(len(drift.points) for drift in centreline.drifts) * 0.1
    assert sum(len(fixture.mesh.faces) for fixture in fixtures.values()) < 400_000 / 300 * length_m


def test_the_same_seed_the_same_bytes_and_one_item_does_not_change_another() -> None:
    rough = (Roughness(amplitude_m=0.1, length_m=1.5),)
    tunnel = straight(EVERYTHING, roughness=rough)
    first, again, other = furnished(tunnel), furnished(tunnel), furnished(tunnel, seed=SEED + 1)
    for name in first:
        np.testing.assert_array_equal(first[name].mesh.vertices, again[name].mesh.vertices)
    assert not np.array_equal(first["bolts"].mesh.vertices, other["bolts"].mesh.vertices)
    more = EVERYTHING.model_copy(update={"ducts": (*EVERYTHING.ducts, Duct(diameter_m=0.3, lateral=0.8))})
    longer = furnished(straight(more, roughness=rough))
    assert set(longer) - set(first) == {"duct-2"}
    for name in first:
        np.testing.assert_array_equal(first[name].mesh.vertices, longer[name].mesh.vertices)


def test_no_furniture_or_no_drifts_is_nothing() -> None:
    tunnel = straight(Furniture())
    centreline, _, walls = built(tunnel)
    assert furnish(tunnel, centreline, walls, SEED) == ()
    wanted = tunnel.model_copy(update={"furniture": EVERYTHING})
    assert furnish(wanted, Centreline((), {}), walls, SEED) == ()
    # A drift of a foreign mesh that lies in the rock carries nothing.
    elsewhere = straight(EVERYTHING, nodes={"a": (0, 50, 0), "b": (24, 50, 0)})
    assert furnish(elsewhere, build_centreline(elsewhere, SEED), walls, SEED) == ()


def test_envelope_by_hand() -> None:
    line = lower_envelope(np.array([3.0, 3, 3, 1, 3, 3, 3, 3, 3]), 1)
    assert line[3] == 1.0
    # The dip widens to three values of 1; weights are 1/4, 1/2, 1/4.
    np.testing.assert_allclose(line, [3.0, 2.5, 1.5, 1.0, 1.5, 2.5, 3.0, 3.0, 3.0])
    rough = np.random.default_rng(0).normal(size=200)
    assert (lower_envelope(rough, 4) <= rough + 1e-12).all()
    flat = np.full(40, 2.0)
    flat[20:24] = 9.0
    np.testing.assert_array_equal(np.flatnonzero(is_opening(flat)), [20, 21, 22, 23])


def test_axis_measures_the_drift() -> None:
    tunnel = straight(Furniture(), nodes={"a": (0, 0, 0), "b": (24, 0, 2.4)}, resolution_m=0.1)
    centreline, _, walls = built(tunnel)
    axis: Axis = measure_axes(centreline, walls)[0]
    inner = (axis.points[:, 0] > 3) & (axis.points[:, 0] < 21)
    np.testing.assert_allclose(axis.points[inner, 2], 0.1 * axis.points[inner, 0], atol=0.02)
    np.testing.assert_allclose(axis.clear_m[inner], 3.2, atol=0.02)
    np.testing.assert_allclose(axis.to_side(1.0, 1.0)[inner], 2.0, atol=0.02)
