"""The plans about regions: how many pairs of which family, how long a way, and that thresholds see no test pair."""

from __future__ import annotations

import math
from collections import Counter
from itertools import pairwise

import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.yamlfile import Document, validate
from cdpipe.sensor.ouster import profile_names
from eval.core.domains import domain_of
from eval.plans.plan import Plan
from eval.plans.worlds import find_references
from scenarios import load_scenario
from scenarios.schema import Scenario
from tests.eval.plans.shipped import cells_of, plan_of

VALIDATION, TEST = range(10000, 20000), range(20000, 30000)
METHODS = (
    "paper", "paper-paired", "untrained", "scan-context", "solid", "sphere-difference", "voxel-diff", "c2c", "tunnelcd",
    "m3c2", "dufomap",
)  # fmt: skip
VISIBILITY = {"removert", "octomap", "m3c2-ep", "erasor", "range-net"}
WIDE = ("regions/wide", "regions/low", "regions/site2", "null/wide")
KISS_ICP = "[odometry=kiss-icp]"


def pairs(name: str) -> set[tuple[str, int]]:
    return {(cell.scenario, cell.seed) for cell in cells_of(name)}


def way_m(scenario: Scenario) -> float:
    """Way of the after session along straight edges; the drive rounds the corners, which makes it a little shorter."""
    nodes = scenario.tunnel.nodes
    edges = sum(math.dist(nodes[a], nodes[b]) for a, b in pairwise(scenario.after.route))
    return edges - scenario.after.start_m - scenario.after.end_m


def scenario_of(label: str) -> str:
    return label.partition("[")[0]


@pytest.mark.parametrize("name", ["main", "regions", "null", "objects"])
def test_every_pair_is_made_with_both_odometries_and_the_figures_are_those_of_kiss_icp(name: str) -> None:
    plan = plan_of(name)
    assert plan.targets.odometry == "kiss-icp"
    plain = [world for world in plan.worlds if not world.common]
    own, kiss = ({world.name: world for world in plain if world.odometry == each} for each in ("own", "kiss-icp"))
    assert own.keys() == kiss.keys() != set()
    for family, world in own.items():  # those for comparison may be fewer
        assert (world.n_seeds or math.inf) <= (kiss[family].n_seeds or math.inf)
    assert plan.worlds[0].odometry == "kiss-icp"
    for world in plan.worlds:
        scenario = load_scenario(world.name, plan.seeds[0], world.settings)
        assert scenario.sensor.sub_rays == 7
        source = "kiss-icp" if world.odometry == "kiss-icp" else "drift"
        assert {scenario.before.odometry.source, scenario.after.odometry.source} == {source}


def test_objects_has_pairs_of_every_profile_and_asks_for_the_same_of_each() -> None:
    plan = plan_of("objects")
    nominal = plan.targets.sensor
    others = {*profile_names()} - {nominal}
    profiles = {load_scenario(world.name, plan.seeds[0], world.settings).sensor.profile for world in plan.worlds}
    assert profiles == {nominal, *others}
    asked = {(each.sensor, each.less_sensor, each.at_least) for each in plan.targets.objects if each.sensor}
    assert asked == {(name, "", 0.85) for name in others} | {(name, nominal, -0.05) for name in others}
    # each such pair stands beside one of the nominal sensor, and effects.csv compares them
    found = find_references((cell.scenario, cell.variant, cell.seed) for cell in cells_of("objects"))
    for world in plan.worlds:
        if world.common:
            assert found[world.label, "tunnelcd"] == f"{world.name}[odometry=kiss-icp]"


def test_regions_has_sixty_test_pairs_in_and_out_of_distribution() -> None:
    counts = Counter(scenario for scenario, _ in pairs("regions"))
    assert all(name.startswith("regions/") for name in counts)
    assert counts.total() >= 60
    assert sum(n for name, n in counts.items() if name.endswith(KISS_ICP)) >= 48
    assert {domain_of(scenario_of(name)) for name in counts if name.endswith(KISS_ICP)} == {"in", "out"}
    assert plan_of("regions").report == ("regions",)


def test_pairs_that_plans_share_are_simulated_and_mapped_once_in_a_common_folder() -> None:
    shared = pairs("regions")
    assert pairs("main") < shared
    assert {(name, seed) for name, seed in pairs("objects") if "sensor.profile" not in name} < shared
    of_parts = {(name, seed) for name, seed in pairs("parts") if name.startswith("regions/")}
    assert {(name, seed) for name, seed in of_parts if "sensor.sub_rays" not in name} < shared


def test_null_drives_five_kilometres_where_nothing_changed() -> None:
    found = [(scenario_of(name), seed) for name, seed in pairs("null") if name.endswith(KISS_ICP)]
    assert all(name.startswith("null/") for name, _ in found)
    assert {domain_of(name) for name, _ in found} == {"in", "out"}
    scenarios = [load_scenario(name, seed) for name, seed in found]
    assert sum(way_m(scenario) for scenario in scenarios) > 1.2 * 5000
    assert {scenario.after.route[0] == scenario.before.route[-1] for scenario in scenarios} == {True, False}
    assert min(scenario.after.end_m for scenario in scenarios) < 5 < 40 < max(s.after.end_m for s in scenarios)
    assert len(scenarios) >= 40  # one in twenty of fewer would be all or none
    assert plan_of("null").report == ("regions",)


def test_thresholds_are_set_on_twenty_validation_pairs_of_each_trained_family() -> None:
    assert Counter(scenario for scenario, _ in pairs("calibrate")) == dict.fromkeys(
        (f"{family}{KISS_ICP}" for family in ("null/narrow", "null/network", "null/wide")), 20
    )
    assert {domain_of(scenario_of(name)) for name, _ in pairs("calibrate")} == {"in"}


@pytest.mark.parametrize(
    ("name", "seeds", "others"),
    [("regions", TEST, {"random-regions"}), ("null", TEST, set()), ("calibrate", VALIDATION, VISIBILITY)],
)
def test_every_method_runs_on_the_seeds_that_are_its(name: str, seeds: range, others: set[str]) -> None:
    found = cells_of(name)
    assert {cell.seed for cell in found} <= set(seeds)
    assert {cell.preset for cell in found} == {*METHODS, *others}
    for cell in found:
        told = 10.0 if scenario_of(cell.scenario) in WIDE else 4.5
        assert cell.config.query.radius_m == ("width" if cell.preset in ("tunnelcd", "sphere-difference") else told)


def test_the_two_plans_of_test_pairs_judge_at_the_same_thresholds() -> None:
    found = {
        name: {(c.variant, c.scenario.partition("/")[2]): c.config.query for c in cells_of(name)}
        for name in ("regions", "null")
    }
    shared = found["regions"].keys() & found["null"].keys()
    assert len(shared) == 2 * 5 * len(METHODS)
    assert all(found["regions"][key] == found["null"][key] for key in shared)


def test_a_plan_that_ends_at_the_merge_has_no_regions_to_report() -> None:
    document = {
        "name": "x", "scenarios": ["narrow"], "seeds": "1", "variants": [{"preset": "tunnelcd"}],
        "until": "merge", "report": "regions",
    }  # fmt: skip
    with pytest.raises(InputError, match="report: regions needs regions"):
        validate(Plan, Document("x.yaml", document))
