from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import pdist

from cdpipe.core.geometry import Float64Array
from scenarios.schema import Drift, Floor, Roughness, Section, Stones, Tunnel
from sim.furniture.stones import SMALLEST_SHARE, draw_stone_sizes, strew_stones
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster
from sim.props.rocks import passing_share
from sim.rock.centreline import Centreline, build_centreline
from sim.rock.tunnel import mesh_tunnel

SEED = 4
DOWN = np.array([0.0, 0.0, -1.0])


def rough(per_m2: float, length_m: float = 60.0, **stones: float) -> Tunnel:
    return Tunnel(
        nodes={"a": (0, 0, 0), "b": (length_m, 0, 1.0)},
        drifts=(Drift(nodes=("a", "b")),),
        section=Section(width_m=4.0, height_m=3.2),
        roughness=(Roughness(amplitude_m=0.1, length_m=1.5),),
        floor=Floor(roughness=0.3, stones=Stones(per_m2=per_m2, **stones)),
        resolution_m=0.2,
    )


def walls_of(tunnel: Tunnel) -> tuple[Centreline, Caster]:
    centreline = build_centreline(tunnel, SEED)
    return centreline, Caster([mesh_tunnel(tunnel, centreline, SEED)])


def strewn(tunnel: Tunnel, *outlines: Float64Array, seed: int = SEED) -> list[Float64Array]:
    centreline, walls = walls_of(tunnel)
    fixture = strew_stones(tunnel, centreline, walls, outlines, seed)
    assert fixture is not None
    assert (fixture.name, fixture.material) == ("stones", "rock")
    return one_by_one(fixture.mesh)


def one_by_one(mesh: Mesh) -> list[Float64Array]:
    """Corners of each stone."""
    links = np.concatenate([mesh.faces[:, :2], mesh.faces[:, 1:]])
    graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(len(mesh.vertices),) * 2)
    n, part = connected_components(graph, directed=False)
    assert n * 12 <= len(mesh.faces) <= n * 40
    order = np.argsort(part, kind="stable")
    return np.split(mesh.vertices[order], np.cumsum(np.bincount(part))[:-1])


def middles(stones: list[Float64Array]) -> Float64Array:
    return np.array([(stone.min(axis=0) + stone.max(axis=0)) / 2 for stone in stones])


def names_of(stones: list[Float64Array]) -> set[bytes]:
    return {stone.tobytes() for stone in stones}


def test_sizes_follow_the_law_between_its_bounds() -> None:
    law = Stones(per_m2=1.0, size_m=0.15, max_size_m=0.4)
    drawn = np.sort(draw_stone_sizes(np.random.default_rng(0).random(20_000), law))
    low, high = SMALLEST_SHARE * 0.15, 0.4
    assert (drawn[0] >= low) & (drawn[-1] <= high)
    bounds = passing_share(np.array([low, high]), 0.15)
    expected = (passing_share(drawn, 0.15) - bounds[0]) / (bounds[1] - bounds[0])
    assert np.abs(expected - (np.arange(20_000) + 0.5) / 20_000).max() < 0.015  # Kolmogorov-Smirnov: 1.6 / sqrt(n)


def test_the_stones_themselves_have_these_sizes() -> None:
    stones = strewn(rough(3.0, size_m=0.15, max_size_m=0.4))
    measured = np.sort([pdist(stone).max() for stone in stones])
    low, high = SMALLEST_SHARE * 0.15, 0.4
    assert (measured[0] > low - 1e-9) & (measured[-1] < high + 1e-9)
    bounds = passing_share(np.array([low, high]), 0.15)
    expected = (passing_share(measured, 0.15) - bounds[0]) / (bounds[1] - bounds[0])
    assert np.abs(expected - (np.arange(len(measured)) + 0.5) / len(measured)).max() < 1.63 / np.sqrt(len(measured))


def test_there_are_as_many_as_asked_for_and_more_at_the_walls() -> None:
    stones = middles(strewn(rough(4.0)))
    inner = stones[(stones[:, 0] > 2) & (stones[:, 0] < 58)]
    # 0.6 + 1.2 s^2 of the mean at a share s of the way to a wall 1.93 m off; the last 0.2 m are the wall's own foot.
    expected_per_m = 2 * 4.0 * (0.6 * 1.5 + 1.2 * 1.5**3 / 3 / 1.93**2)
    assert (np.abs(inner[:, 1]) < 1.5).sum() == pytest.approx(56 * expected_per_m, rel=0.1)
    assert len(inner) == pytest.approx(4.0 * 56 * 4.0, rel=0.15)
    at_wall, at_middle = (
        (part.sum() / area_m2)
        for part, area_m2 in (
            ((np.abs(inner[:, 1]) > 1.2) & (np.abs(inner[:, 1]) < 1.7), 56 * 1.0),
            (np.abs(inner[:, 1]) < 0.5, 56 * 1.0),
        )
    )
    assert 1.4 < at_wall / at_middle < 3.0


def test_every_stone_rests_in_the_floor() -> None:
    tunnel = rough(3.0)
    _, walls = walls_of(tunnel)
    for stone in strewn(tunnel):
        above = stone * (1, 1, 0) + (0, 0, stone[:, 2].max() + 0.3)
        floor_z = above[:, 2] - walls.cast(above, np.tile(DOWN, (len(above), 1)))[0]
        height_m = np.ptp(stone[:, 2])
        lowest = int(np.argmin(stone[:, 2]))
        assert stone[lowest, 2] < floor_z[lowest] + 0.005  # none floats
        assert (stone[:, 2] - floor_z).max() > 0.15 * height_m  # none is out of sight


def test_no_stone_in_an_outline_and_no_other_stone_changes() -> None:
    tunnel = rough(3.0)
    square = np.array([[10.0, -1.0], [12.0, -1.0], [12.0, 1.0], [10.0, 1.0]])
    arrow = np.array([[30.0, -1.5], [34.0, 0.0], [30.0, 1.5], [31.0, 0.0]])  # not convex
    free, once, both = (strewn(tunnel, *outlines) for outlines in ((), (square,), (square, arrow)))
    assert names_of(once) < names_of(free)
    assert names_of(both) < names_of(once)
    corners = np.concatenate(once)[:, :2]
    assert not ((np.abs(corners[:, 0] - 11.0) < 1.0) & (np.abs(corners[:, 1]) < 1.0)).any()
    gone = middles([stone for stone in free if stone.tobytes() not in names_of(once)])
    assert len(gone) == pytest.approx(3.0 * 2.4 * 2.4 * 0.7, rel=0.5)
    assert (np.abs(gone[:, :2] - [11.0, 0.0]) < 1.0 + 0.35).all()
    notch = middles(both)[:, :2]
    in_arrow = (notch[:, 0] > 31.0) & (np.abs(notch[:, 1]) < (34.0 - notch[:, 0]) / 3.0)
    assert not in_arrow.any()


def test_the_same_seed_the_same_stones_and_crossing_drifts_share_theirs() -> None:
    tunnel = rough(2.0, length_m=24.0)
    assert names_of(strewn(tunnel)) == names_of(strewn(tunnel))
    assert not names_of(strewn(tunnel)) & names_of(strewn(tunnel, seed=SEED + 1))
    crossing = tunnel.model_copy(
        update={
            "nodes": {"a": (0, 0, 0), "b": (12, 0, 0), "c": (24, 0, 0), "d": (12, 12, 0), "e": (12, -12, 0)},
            "drifts": (Drift(nodes=("a", "b", "c")), Drift(nodes=("d", "b", "e"))),
        }
    )
    spots = middles(strewn(crossing))
    in_crossing = spots[(np.abs(spots[:, 0] - 12) < 2) & (np.abs(spots[:, 1]) < 2)]
    assert len(in_crossing) == len(np.unique(in_crossing[:, :2].round(6), axis=0))
    assert 8 < len(in_crossing) < 2.0 * 16 * 1.8


def test_no_stones_is_nothing() -> None:
    tunnel = rough(0.0, length_m=12.0)
    centreline, walls = walls_of(tunnel)
    assert strew_stones(tunnel, centreline, walls, (), SEED) is None
    bare = tunnel.model_copy(update={"floor": Floor()})
    assert strew_stones(bare, centreline, walls, (), SEED) is None
    some = rough(2.0, length_m=12.0)
    assert strew_stones(some, Centreline((), {}), walls, (), SEED) is None
    everywhere = np.array([[-50.0, -50.0], [50.0, -50.0], [50.0, 50.0], [-50.0, 50.0]])
    assert strew_stones(some, centreline, walls, (everywhere,), SEED) is None
