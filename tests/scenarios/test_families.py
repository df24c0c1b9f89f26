from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import combinations, pairwise

import pytest

from cdpipe.core.yamlfile import read_yaml
from scenarios import check_scenario, library, load_scenario, scenario_names
from scenarios.references import route_length_m
from scenarios.schema import Furniture, Place, Scenario, Tunnel

SEEDS = (*range(10), *range(10000, 10010))
MANY = range(100)
swept = pytest.mark.parametrize(
    "seeds",
    [pytest.param(SEEDS[::5], id="few"), pytest.param(SEEDS, id="some", marks=pytest.mark.soak)],
)
swept_wide = pytest.mark.parametrize(
    "seeds",
    [pytest.param(SEEDS[::5], id="few"), pytest.param((*MANY, *SEEDS[10:]), id="many", marks=pytest.mark.soak)],
)
TRAINED = ("narrow", "wide", "network", "smooth")
RANDOM = (*TRAINED, "cave")
DRAWN = (*RANDOM, "tight")  # tight has no unchanged twin: it is trained and validated on, never tested on
SITES = ("paper/site1", "paper/site2")
HELD_OUT = {"trolley", "railing", "mesh"}
LENGTHS_M = {
    "narrow": (120, 200),
    "wide": (240, 300),
    "network": (150, 300),
    "cave": (110, 190),
    "smooth": (115, 160),
    "tight": (120, 200),
}
BASES = {
    "smoke/unchanged": "smoke/one_box",
    "unchanged/site1": "paper/site1",
    **{f"unchanged/{name}": name for name in RANDOM},
}
drawn = cache(load_scenario)


@pytest.fixture(scope="module", autouse=True)
def each_file_is_read_once() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(library, "read_yaml", cache(read_yaml))
        yield


def lengths_m(scenario: Scenario) -> list[float]:
    return [route_length_m(scenario.tunnel, plan) for plan in (scenario.before, scenario.after)]


def changes(scenario: Scenario) -> Counter[str]:
    return Counter(prop.change for prop in scenario.props if prop.change != "none")


def places(scenario: Scenario) -> list[Place]:
    return [place for prop in scenario.props for place in (prop.place, prop.to) if place]


def position_m(tunnel: Tunnel, place: Place) -> tuple[float, ...]:
    assert place.between is not None and place.fraction is not None
    a, b = (tunnel.nodes[name] for name in place.between)
    return tuple(p + place.fraction * (q - p) for p, q in zip(a, b, strict=True))


def edges(tunnel: Tunnel) -> set[frozenset[str]]:
    return {frozenset(pair) for drift in tunnel.drifts for pair in pairwise(drift.nodes)}


def is_reversed(scenario: Scenario) -> bool:
    return scenario.after.route[0] == scenario.before.route[-1]


@swept
@pytest.mark.parametrize("name", scenario_names())
def test_every_family_is_valid(name: str, seeds: Sequence[int]) -> None:
    assert check_scenario(name).family == name
    for seed in seeds:
        scenario = drawn(name, seed)
        assert scenario.description
        flown_over = name.endswith("low")
        assert flown_over or all(abs(place.lateral) >= 0.5 for place in places(scenario))
        section = scenario.tunnel.section
        assert scenario.tunnel.resolution_m <= min(section.width_m, section.height_m) / 8
        sources = {plan.odometry.source for plan in (scenario.before, scenario.after)}
        assert sources <= {"kiss-icp", "random-walk"} if name.startswith("odometry/") else sources == {"drift"}


@swept_wide
@pytest.mark.parametrize("name", scenario_names())
def test_no_pile_is_higher_than_its_flanks_allow(name: str, seeds: Sequence[int]) -> None:
    for seed in seeds:
        for prop in drawn(name, seed).props:
            if prop.kind == "muck_pile" and prop.size_m is not None:
                length_m, width_m, height_m = prop.size_m
                run_m = min(length_m / 2, width_m if prop.place.posture == "leaning" else width_m / 2)
                assert height_m <= 1.01 * run_m * math.tan(math.radians(prop.repose_deg)), (seed, prop.name)


@swept_wide
@pytest.mark.parametrize("name", [name for name in scenario_names() if not name.startswith(("smoke/", "train/"))])
def test_at_least_five_distractors_on_100_m(name: str, seeds: Sequence[int]) -> None:
    for seed in seeds:
        scenario = drawn(name, seed)
        staying = [prop for prop in scenario.props if prop.change == "none" and prop.place.area is None]
        # they stand anywhere on the edges that either session drives
        way = {frozenset(pair) for plan in (scenario.before, scenario.after) for pair in pairwise(plan.route)}
        way_m = sum(math.dist(*(scenario.tunnel.nodes[node] for node in edge)) for edge in way)
        assert len(staying) >= 0.05 * way_m


@swept_wide
@pytest.mark.parametrize("name", ["cave", "smooth", "unchanged/cave", "unchanged/smooth"])
def test_there_are_enough_to_have_five_on_100_m_of_the_before_path_alone(name: str, seeds: Sequence[int]) -> None:
    # Part of what may be driven lies beyond where the before session drives: half as many again as needed on average.
    for seed in seeds:
        scenario = drawn(name, seed)
        drives = {frozenset(pair) for plan in (scenario.before, scenario.after) for pair in pairwise(plan.route)}
        way_m = sum(math.dist(*(scenario.tunnel.nodes[node] for node in edge)) for edge in drives)
        assert sum(prop.change == "none" and prop.place.area is None for prop in scenario.props) >= 0.075 * way_m


@pytest.mark.parametrize("name", DRAWN)
def test_random_families_stay_in_their_stated_ranges(name: str) -> None:
    shortest_m, longest_m = LENGTHS_M[name]
    counts: Counter[int] = Counter()
    kinds: set[str] = set()
    for seed in MANY:
        scenario = drawn(name, seed)
        assert all(shortest_m <= one <= longest_m for one in lengths_m(scenario)), seed
        counts[changes(scenario).total()] += 1
        kinds |= set(changes(scenario))
    assert set(counts) == set(range(7))
    assert kinds == {"added", "removed", "moved", "reshaped"}


@pytest.mark.parametrize("name", DRAWN)
def test_most_of_the_way_is_far_from_the_areas_of_change(name: str) -> None:
    for seed in MANY:
        scenario = drawn(name, seed)
        assert [area.name for area in scenario.areas] == ["a", "b"]
        for prop in scenario.props:
            where = {place.area for place in (prop.place, prop.to) if place is not None}
            assert where <= ({None} if prop.change == "none" else {"a"} if prop.name[0] == "a" else {"b"})
            assert prop.shift is None or 0.3 <= prop.shift.distance_m <= 1.0
        near_m = sum(area.length_m + 4 * scenario.score_radius_m for area in scenario.areas)
        assert near_m <= 0.4 * lengths_m(scenario)[0]


@swept_wide
@pytest.mark.parametrize(
    "name",
    [*TRAINED, "tight", *(name for name in scenario_names() if name.startswith("train/"))]
    + [f"unchanged/{name}" for name in TRAINED],
)
def test_kinds_held_out_stand_in_no_family_that_is_trained_on(name: str, seeds: Sequence[int]) -> None:
    for seed in seeds:
        scenario = drawn(name, seed)
        assert not {prop.kind for prop in scenario.props} & HELD_OUT
        assert scenario.tunnel.mesh is None


@pytest.mark.parametrize("name", RANDOM)
def test_a_third_of_the_pairs_is_driven_in_both_directions(name: str) -> None:
    share = sum(is_reversed(drawn(name, seed)) for seed in MANY) / len(MANY)
    assert 0.2 < share < 0.47
    twin = sum(is_reversed(drawn(f"unchanged/{name}", seed)) for seed in MANY) / len(MANY)
    assert 0.37 < twin < 0.63


@pytest.mark.parametrize(
    ("name", "width_m"), [("narrow", (3.5, 6.5)), ("wide", (8, 12)), ("network", (4, 6.5)), ("tight", (2.0, 3.6))]
)
def test_widths_and_platforms(name: str, width_m: tuple[float, float]) -> None:
    shapes = set()
    for seed in MANY:
        scenario = drawn(name, seed)
        sections = [scenario.tunnel.section, *(drift.section for drift in scenario.tunnel.drifts if drift.section)]
        assert all(width_m[0] <= section.width_m <= width_m[1] for section in sections)
        assert scenario.platform.kind == ("quadrotor" if name == "wide" else "ground_robot")
        assert scenario.score_radius_m == (10 if name == "wide" else 4.5)
        shapes.add(scenario.tunnel.section.shape)
    assert {"horseshoe", "d", "arch"} <= shapes


@pytest.mark.parametrize("name", ["narrow", "wide", "network", "tight"])
def test_furniture_comes_and_goes_with_the_seed(name: str) -> None:
    for item in ("pipes", "ducts", "cable_trays", "bolts", "screen"):
        share = sum(bool(getattr(drawn(name, seed).tunnel.furniture, item)) for seed in MANY) / len(MANY)
        assert 0.2 < share < 0.95, item
    for item in ("ruts", "stones"):
        share = sum(getattr(drawn(name, seed).tunnel.floor, item) is not None for seed in MANY) / len(MANY)
        assert 0.3 < share < 0.7, item


def test_the_network_has_loops_a_crossing_dead_ends_slopes_and_ways_of_its_own_for_each_session() -> None:
    seen_once = 0
    for seed in MANY:
        scenario = drawn("network", seed)
        joined = edges(scenario.tunnel)
        degree = Counter(node for edge in joined for node in edge)
        assert len(joined) - len(degree) + 1 == 2  # loops of a connected graph
        assert degree["m2"] == 4
        assert sum(count == 1 for count in degree.values()) >= 4
        slopes = [
            abs(a[2] - b[2]) / math.dist(a[:2], b[:2])
            for a, b in ([scenario.tunnel.nodes[name] for name in edge] for edge in joined)
        ]
        assert max(slopes) > 0.02 and max(slopes) < 0.15
        ways = [{frozenset(pair) for pair in pairwise(plan.route)} for plan in (scenario.before, scenario.after)]
        assert {frozenset(("m0", "m1")), frozenset(("m3", "m4"))} <= ways[0] & ways[1]
        seen_once += ways[0] != ways[1]
    assert seen_once > 0.6 * len(MANY)


def test_nothing_tells_the_place_in_smooth() -> None:
    for name in ("smooth", "unchanged/smooth"):
        for seed in MANY:
            scenario = drawn(name, seed)
            tunnel = scenario.tunnel
            (drift,) = tunnel.drifts
            assert [tunnel.nodes[node][1:] for node in drift.nodes] == [(0, 0), (0, 0)]
            assert (tunnel.furniture, tunnel.niches, tunnel.variation, tunnel.meander_m) == (Furniture(), (), None, 0)
            assert (tunnel.floor.ruts, tunnel.floor.stones, tunnel.floor.crossfall_percent) == (None, None, 0)
            assert all(octave.amplitude_m < 0.005 for octave in tunnel.roughness)
            for plan in (scenario.before, scenario.after):
                assert min(plan.start_m, plan.end_m) > scenario.sensor.max_range_m


def test_a_cave_has_nothing_fixed_to_its_rock() -> None:
    for seed in SEEDS:
        tunnel = drawn("cave", seed).tunnel
        assert (tunnel.section.shape, tunnel.furniture) == ("cave", Furniture())
        assert tunnel.roughness[0].amplitude_m >= 0.25 and tunnel.floor.stones is not None


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
    changed = [place for prop in scenario.props if prop.change != "none" for place in (prop.place, prop.to) if place]
    spots = [position_m(scenario.tunnel, place) for place in changed]
    groups: list[list[tuple[float, ...]]] = []
    for spot in spots:
        near = [group for group in groups if min(math.dist(spot, other) for other in group) < 15]
        groups = [group for group in groups if group not in near] + [[spot, *(s for group in near for s in group)]]
    for one, other in combinations(groups, 2):
        assert min(math.dist(a, b) for a in one for b in other) > 40
    return len(groups)


@pytest.mark.parametrize(("name", "base"), BASES.items())
def test_unchanged_families_are_their_base_with_nothing_changed(name: str, base: str) -> None:
    for seed in SEEDS:
        scenario, changed = drawn(name, seed), drawn(base, seed)
        assert scenario.tunnel == changed.tunnel
        assert not changes(scenario)
        assert [(prop.name, prop.place) for prop in scenario.props] == [
            (prop.name, prop.place) for prop in changed.props if prop.change != "added"
        ]
        assert all(prop.to is None and prop.shift is None and prop.loaded_share is None for prop in scenario.props)
        assert scenario.before == changed.before
        assert scenario.before != scenario.after


@pytest.mark.parametrize("name", [name for name in BASES if name.startswith("unchanged/")])
def test_unchanged_pairs_differ_in_line_direction_and_coverage(name: str) -> None:
    pairs = [drawn(name, seed) for seed in MANY]
    assert {is_reversed(scenario) for scenario in pairs} == {False, True}
    assert all(scenario.before.lateral != scenario.after.lateral for scenario in pairs)
    partial = [scenario for scenario in pairs if scenario.after.end_m > scenario.before.end_m + 10]
    assert 0.2 < len(partial) / len(pairs) < 0.8


def test_smoke_is_small_and_changes_one_box() -> None:
    scenario = drawn("smoke/one_box", 0)
    assert [(prop.kind, prop.change) for prop in scenario.props] == [("box", "added"), ("barrel", "none")]
    assert max(lengths_m(scenario)) < 30
