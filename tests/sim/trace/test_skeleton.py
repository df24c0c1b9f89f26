from __future__ import annotations

import numpy as np
import pytest

from scenarios.schema import Drift, Tunnel
from sim.rock.centreline import build_centreline
from sim.trace.inside import Void
from sim.trace.route import find_route
from sim.trace.skeleton import count_uses, find_branches


def void_of(*boxes: tuple[slice, slice, slice], shape: tuple[int, int, int] = (80, 80, 16)) -> Void:
    cells = np.zeros(shape, dtype=bool)
    for box in boxes:
        cells[box] = True
    return Void(cells, np.zeros(3), 0.5)


@pytest.mark.parametrize("width", [4, 5, 6, 8])
@pytest.mark.parametrize("height", [4, 5, 6])
def test_a_bar_of_any_width_is_thinned_to_its_middle(width: int, height: int) -> None:
    (branch,) = find_branches(void_of(np.s_[5:75, 20 : 20 + width, 4 : 4 + height]), lambda _: width / 2)
    # cells of 0.5 m; each end recedes by half the width, or by half the height
    assert branch.length_m == pytest.approx(35.0 - width / 2, abs=1.5)
    np.testing.assert_allclose(branch.points[5:-5, 1], (20 + (width - 1) / 2) / 2, atol=0.3)


def test_a_crossing_is_one_place_and_a_niche_is_none() -> None:
    cross = [np.s_[5:75, 37:43, 4:10], np.s_[37:43, 5:75, 4:10]]
    niche = np.s_[15:20, 43:46, 4:10]
    branches = find_branches(void_of(*cross, niche), lambda _: 3.0)
    assert len(branches) == 4
    uses = count_uses(branches)
    assert sorted(uses.values()) == [1, 1, 1, 1, 4]


def test_a_loop_is_a_ring() -> None:
    boxes = [np.s_[10:70, 10:16, 4:10], np.s_[10:70, 64:70, 4:10], np.s_[10:16, 10:70, 4:10], np.s_[64:70, 10:70, 4:10]]
    (ring,) = find_branches(void_of(*boxes), lambda _: 3.0)
    assert ring.ends[0] == ring.ends[1]
    np.testing.assert_array_equal(ring.points[0], ring.points[-1])
    assert ring.length_m == pytest.approx(4 * 27.0, rel=0.06)


def test_the_route_is_the_longest_shortest_way_without_a_sharp_turn() -> None:
    nodes = {"a": (0, 0, 0), "b": (30, 0, 0), "c": (60, 0, 0), "d": (34, 20, 0), "back": (-20, 14, 0)}
    # from `back` the drift comes into b at a sharp angle to a
    drifts = (Drift(nodes=("a", "b", "c")), Drift(nodes=("b", "d")), Drift(nodes=("b", "back")))
    centreline = build_centreline(Tunnel(nodes=nodes, drifts=drifts), 0)
    route = find_route(centreline, 1000.0)
    assert set(route) == {"back", "b", "c"}
    assert len(find_route(centreline, 20.0)) == 2
