"""The families of the plans `merge` and `merge-gates`: the kinds of pairs, and what differs between them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from functools import cache
from itertools import pairwise

import pytest

from cdpipe.core.yamlfile import read_yaml
from scenarios import library, load_scenario
from scenarios.schema import Odometry, Scenario, SessionPlan

SEEDS = range(24)
BASES = {
    "narrow": "narrow", "wide": "wide", "network": "network", "cave": "cave", "smooth": "smooth",
    "site1": "paper/site1", "site2": "paper/site2",
}  # fmt: skip
CLEAN = ("narrow", "wide", "network", "cave", "site1", "site2")
DISJOINT = ("narrow", "wide", "network", "cave", "smooth")
TRUE = Odometry()
DRIFTING = Odometry(translation_percent=0.5, yaw_deg_per_100m=0.5)
drawn = cache(load_scenario)


@pytest.fixture(scope="module", autouse=True)
def each_file_is_read_once() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(library, "read_yaml", cache(read_yaml))
        yield


def with_odometry(scenario: Scenario, odometry: Odometry) -> Scenario:
    sessions = {name: getattr(scenario, name).model_copy(update={"odometry": odometry}) for name in ("before", "after")}
    return scenario.model_copy(update=sessions)


def driven(plan: SessionPlan) -> list[tuple[str, str]]:
    return list(pairwise(plan.route))


def reversed_share(scenario: Scenario) -> float:
    """Share of the edges that both sessions drive which the after session drives the other way."""
    there = driven(scenario.before)
    shared = [edge for edge in driven(scenario.after) if edge in there or edge[::-1] in there]
    assert shared
    return sum(edge not in there for edge in shared) / len(shared)


@pytest.mark.parametrize("name", [*CLEAN, "smooth"])
def test_a_merge_lives_with_the_tunnels_and_the_changes_of_its_family(name: str) -> None:
    n_changes = 0
    for seed in SEEDS:
        scenario, base = drawn(f"merge/{name}", seed), drawn(BASES[name], seed)
        assert (scenario.tunnel, scenario.props, scenario.areas) == (base.tunnel, base.props, base.areas)
        n_changes += sum(prop.change != "none" for prop in scenario.props)
    assert n_changes > 2 * len(SEEDS)


@pytest.mark.parametrize("name", CLEAN)
def test_clean_has_true_odometry_and_drift_is_the_same_pair_with_an_error(name: str) -> None:
    for seed in SEEDS:
        clean, drifting = drawn(f"merge/{name}", seed), drawn(f"drift/{name}", seed)
        assert (clean.before.odometry, clean.after.odometry) == (TRUE, TRUE)
        assert (drifting.before.odometry, drifting.after.odometry) == (DRIFTING, DRIFTING)
        same = {"family": clean.family, "description": clean.description}
        assert with_odometry(drifting, TRUE).model_copy(update=same) == clean


@pytest.mark.parametrize("name", [*CLEAN, "smooth"])
def test_half_of_the_pairs_meet_head_on_and_no_pair_does_both(name: str) -> None:
    shares = Counter(reversed_share(drawn(f"merge/{name}", seed)) for seed in SEEDS)
    if name != "site2":  # which after the crossing may share one drift forwards, another backwards
        assert set(shares) == {0.0, 1.0}
    assert 0.3 < sum(count for share, count in shares.items() if share > 0.5) / len(SEEDS) < 0.7


@pytest.mark.parametrize("name", DISJOINT)
def test_no_way_leads_from_one_session_to_the_other_and_nothing_changes(name: str) -> None:
    directions = set()
    for seed in SEEDS:
        scenario, base = drawn(f"disjoint/{name}", seed), drawn(BASES[name], seed)
        reached = set(scenario.before.route)
        for _ in scenario.tunnel.drifts:
            reached |= {n for drift in scenario.tunnel.drifts if reached & set(drift.nodes) for n in drift.nodes}
        assert not reached & set(scenario.after.route)
        assert not scenario.areas
        assert all(prop.change == "none" for prop in scenario.props)
        # one mine: the section, the rock and what hangs on it are drawn once, and as the family draws them
        ours, theirs = scenario.tunnel, base.tunnel
        assert (ours.section, ours.roughness, ours.floor) == (theirs.section, theirs.roughness, theirs.floor)
        assert (ours.furniture, ours.variation) == (theirs.furniture, theirs.variation)
        assert (scenario.sensor, scenario.platform) == (base.sensor, base.platform)
        kinds = [{d.section or ours.section for d in ours.drifts if set(d.nodes) & set(p.route)} for p in
                 (scenario.before, scenario.after)]  # fmt: skip
        assert kinds[0] == kinds[1]
        directions.add(scenario.after.route)
    assert len(directions) == 2


@pytest.mark.parametrize("name", ["narrow", "wide", "cave", "smooth"])
def test_the_second_drift_does_not_copy_the_first(name: str) -> None:
    for seed in SEEDS:
        scenario = drawn(f"disjoint/{name}", seed)
        nodes = scenario.tunnel.nodes
        forward = sorted((scenario.after.route, scenario.after.route[::-1]))[0]
        shapes = [
            [tuple(b - a for a, b in zip(nodes[p], nodes[q], strict=True)) for p, q in pairwise(route)]
            for route in (scenario.before.route, forward)
        ]
        assert shapes[0] != shapes[1]
