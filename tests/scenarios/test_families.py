from __future__ import annotations

import math
from collections import Counter
from functools import cache
from itertools import combinations

import pytest

from scenarios import check_scenario, load_scenario, scenario_names
from scenarios.references import route_length_m
from scenarios.schema import Place, Prop, Scenario, Tunnel

SEEDS = (*range(10), *range(10000, 10010))
TRAINED = ("narrow", "wide")
drawn = cache(load_scenario)


def lengths_m(scenario: Scenario) -> list[float]:
    return [route_length_m(scenario.tunnel, plan) for plan in (scenario.before, scenario.after)]


def changes(scenario: Scenario) -> Counter[str]:
    return Counter(prop.change for prop in scenario.props if prop.change != "none")


def position_m(tunnel: Tunnel, place: Place) -> tuple[float, ...]:
    a, b = (tunnel.nodes[name] for name in place.between)
    return tuple(p + place.fraction * (q - p) for p, q in zip(a, b, strict=True))


def test_the_names_are_the_documented_ones() -> None:
    assert scenario_names() == [
        "narrow", "paper/site1", "paper/site2", "smoke/one_box", "smoke/unchanged",
        "unchanged/narrow", "unchanged/site1", "unchanged/wide", "wide",
    ]  # fmt: skip


@pytest.mark.parametrize("name", scenario_names())
def test_every_family_is_valid_for_many_seeds(name: str) -> None:
    assert check_scenario(name).family == name
    for seed in SEEDS:
        scenario = drawn(name, seed)
        assert scenario.description
        assert all(abs(place.lateral) >= 0.7 for prop in scenario.props for place in (prop.place, prop.to) if place)
        assert (
            scenario.tunnel.resolution_m <= min(scenario.tunnel.section.width_m, scenario.tunnel.section.height_m) / 8
        )


def test_site1_holds_what_the_paper_tells() -> None:
    for seed in SEEDS:
        scenario = drawn("paper/site1", seed)
        assert changes(scenario) == {"added": 2, "moved": 3}
        assert {prop.kind for prop in scenario.props if prop.change != "none"} == {"box", "chair", "trolley"}
        assert all(abs(length_m - 200) < 10 for length_m in lengths_m(scenario))
        assert scenario.score_radius_m == 4.5
        assert scenario.platform.kind == "ground_robot"
        moved = [prop for prop in scenario.props if prop.to is not None]
        for prop in moved:
            way_m = math.dist(
                position_m(scenario.tunnel, prop.place), position_m(scenario.tunnel, prop.to or prop.place)
            )
            assert 3 < way_m < 6
        assert clusters_m(scenario) == 3


def test_site2_holds_what_the_paper_tells() -> None:
    for seed in SEEDS:
        scenario = drawn("paper/site2", seed)
        assert changes(scenario) == {"added": 5}
        assert Counter(prop.kind for prop in scenario.props if prop.change == "added") == {"railing": 2, "muck_pile": 3}
        assert all(1000 < length_m < 1500 for length_m in lengths_m(scenario))
        assert (scenario.score_radius_m, scenario.tunnel.section.width_m) == (10, 10)
        assert scenario.platform.kind == "quadrotor"
        assert clusters_m(scenario) == 4


def clusters_m(scenario: Scenario) -> int:
    """Number of groups of changed places when places within 15 m share a group, and no groups are within 40 m."""
    places = [place for prop in scenario.props if prop.change != "none" for place in (prop.place, prop.to) if place]
    spots = [position_m(scenario.tunnel, place) for place in places]
    groups: list[list[tuple[float, ...]]] = []
    for spot in spots:
        near = [group for group in groups if min(math.dist(spot, other) for other in group) < 15]
        groups = [group for group in groups if group not in near] + [[spot, *(s for group in near for s in group)]]
    for one, other in combinations(groups, 2):
        assert min(math.dist(a, b) for a in one for b in other) > 40
    return len(groups)


@pytest.mark.parametrize(("name", "length_m"), [("narrow", (60, 100)), ("wide", (90, 150))])
def test_training_families_stay_in_their_stated_ranges(name: str, length_m: tuple[float, float]) -> None:
    counts = set()
    for seed in range(100):
        scenario = drawn(name, seed)
        assert all(length_m[0] - 5 < one < length_m[1] for one in lengths_m(scenario))
        counts.add(changes(scenario).total())
        assert sum(prop.change == "none" for prop in scenario.props) >= 1
        assert not {prop.kind for prop in scenario.props} & {"trolley", "railing"}
    assert counts == {2, 3, 4, 5}


@pytest.mark.parametrize("name", TRAINED)
def test_no_prop_of_a_training_family_can_stand_in_another(name: str) -> None:
    for seed in range(100):
        scenario = drawn(name, seed)
        stands = [(prop, place) for prop in scenario.props for place in (prop.place, prop.to) if place]
        for (one, a), (other, b) in combinations(stands, 2):
            if a.between == b.between and a.lateral * b.lateral > 0:
                edge_m = math.dist(*(scenario.tunnel.nodes[node] for node in a.between))
                assert abs(a.fraction - b.fraction) * edge_m > (along_m(one, a) + along_m(other, b)) / 2
            at_bend = a.between != b.between and set(a.between) & set(b.between)
            if at_bend and max(a.fraction, b.fraction) > 0.8 and min(a.fraction, b.fraction) < 0.2:
                assert a.lateral * b.lateral < 0


def along_m(prop: Prop, place: Place) -> float:
    """Extent of a prop's box along the drift."""
    yaw_rad = math.radians(place.yaw_deg)
    return abs(prop.size_m[0] * math.cos(yaw_rad)) + abs(prop.size_m[1] * math.sin(yaw_rad))


@pytest.mark.parametrize(
    ("name", "base"),
    [
        ("smoke/unchanged", "smoke/one_box"),
        ("unchanged/site1", "paper/site1"),
        ("unchanged/narrow", "narrow"),
        ("unchanged/wide", "wide"),
    ],
)
def test_unchanged_families_are_their_base_with_nothing_changed(name: str, base: str) -> None:
    for seed in SEEDS:
        scenario, changed = drawn(name, seed), drawn(base, seed)
        assert scenario.tunnel == changed.tunnel
        assert not changes(scenario)
        assert [(prop.name, prop.place) for prop in scenario.props] == [
            (prop.name, prop.place) for prop in changed.props if prop.change != "added"
        ]
        assert scenario.before != scenario.after


def test_smoke_is_small_and_changes_one_box() -> None:
    scenario = drawn("smoke/one_box", 0)
    assert [(prop.kind, prop.change) for prop in scenario.props] == [("box", "added"), ("barrel", "none")]
    assert max(lengths_m(scenario)) < 30
