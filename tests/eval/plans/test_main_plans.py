"""The plans `main` and `stress`: which methods on which pairs, and what each stress is held against."""

from __future__ import annotations

from collections import Counter

import pytest

from cdpipe.model.config import load_config, preset_names
from eval.plans.cells import expand_cells
from eval.plans.files import plan_names
from eval.plans.plan import load_plan
from eval.plans.worlds import find_references, list_settings_over
from scenarios import load_scenario, scenario_names
from scenarios.catalogue import EFFECT_GROUPS
from tests.eval.plans.shipped import cells_of, plan_of

BASE = "stress/narrow"
WITHOUT_SITE = ("tunnelcd", "sphere-difference", "kiss-matcher", "oracle-merge", "oracle-merge+oracle-regions")


def test_main_runs_every_preset_and_the_bounds_on_the_pairs_of_regions() -> None:
    found = expand_cells(load_plan("main"))
    variants = {cell.variant for cell in found}
    assert variants == {*preset_names(), "oracle-merge", "oracle-merge+oracle-regions"} - {"frame", "every-keyframe"}
    pairs = Counter((cell.scenario, cell.seed) for cell in found if cell.variant == "paper")
    assert {scenario for scenario, _ in pairs} <= {cell.scenario for cell in expand_cells(load_plan("regions"))}
    n_seeds = Counter(scenario for scenario, _ in pairs)
    # each family counts alike, with KISS-ICP's poses and with its own drift
    assert {n for scenario, n in n_seeds.items() if scenario.endswith("[odometry=kiss-icp]")} == {6}
    assert {n for scenario, n in n_seeds.items() if "[" not in scenario} == {2}
    assert {scenario.split("/")[1] for scenario, _ in pairs} >= {"narrow", "wide", "network", "cave", "site1"}
    assert all(20000 <= cell.seed < 30000 for cell in found)
    assert load_plan("main").report == ("regions", "objects")


def test_main_judges_at_the_radius_and_threshold_of_regions() -> None:
    ours, theirs = (
        {(cell.scenario, cell.variant): cell.config for cell in expand_cells(load_plan(name))}
        for name in ("main", "regions")
    )
    shared = ours.keys() & theirs.keys()
    assert {variant for _, variant in shared} >= {"tunnelcd", "paper", "voxel-diff", "random-regions"}
    assert all(ours[key] == theirs[key] for key in shared)
    for (scenario, variant), config in ours.items():
        told = 10.0 if scenario.partition("[")[0] == "regions/wide" else 4.5
        assert config.query.radius_m == ("width" if variant in WITHOUT_SITE else told)
    for variant in ("kiss-matcher", "oracle-merge"):
        assert ours["regions/wide", variant].query == ours["regions/wide", "tunnelcd"].query


def test_parts_takes_one_part_away_at_a_time() -> None:
    found = expand_cells(load_plan("parts"))
    assert {cell.variant for cell in found} == {
        "tunnelcd", "tunnelcd[map.movers=keep]", "tunnelcd[map.consistency=none,map.movers=keep]",
        "tunnelcd[map.consistency=scan-to-map,map.movers=keep]", "tunnelcd[merge.refine=local]",
        "tunnelcd[sphere.frames=sensor]", "tunnelcd[extract.recentre=false]", "tunnelcd[query.radius_m=4.5]",
    }  # fmt: skip
    ours = next(cell.config for cell in found if cell.variant == "tunnelcd")
    # else a row would repeat the first
    assert ours.map.consistency == "graph" and ours.merge.refine != "local"
    assert ours.sphere.frames != "sensor" and ours.extract.recentre and ours.query.radius_m == "width"
    held = find_references((cell.scenario, cell.variant, cell.seed) for cell in found)
    thin = {label for label, _ in held}
    assert {list_settings_over(label, held[label, "tunnelcd"]) for label in thin} == {"sensor.sub_rays=1"}
    plain = {f"regions/{name}[odometry=kiss-icp]" for name in ("narrow", "wide", "network")}
    # what frames of the path and closed loops are for
    assert {cell.scenario for cell in found} - thin == plain | {"odometry/handheld", "odometry/turned", "loops/network"}
    assert len({cell.seed for cell in found}) >= 6 and all(20000 <= cell.seed < 30000 for cell in found)


@pytest.mark.parametrize("name", plan_names())
def test_a_plan_whose_presets_follow_the_width_of_the_drift_names_no_wide_worlds(name: str) -> None:
    follows = {load_config(cell.preset).query.radius_m == "width" for cell in cells_of(name)}
    assert plan_of(name).wide == () or False in follows
    assert name != "surface" or follows == {True}


def test_every_stress_is_held_against_the_same_pair_without_it() -> None:
    plan = load_plan("stress")
    found = expand_cells(plan)
    held = find_references((cell.scenario, cell.variant, cell.seed) for cell in found)
    worlds = {cell.scenario for cell in found}
    methods = {cell.variant for cell in found if cell.oracle is None}
    assert held == {(world, variant): BASE for world in worlds - {BASE} for variant in methods}
    compared = {(cell.scenario, cell.variant.partition("[")[0]) for cell in found if cell.scenario != BASE}
    assert compared >= {(world, method) for world in worlds - {BASE} for method in ("tunnelcd", "paper-paired")}
    stresses = {list_settings_over(world, BASE).split("=")[0] for world in worlds - {BASE}}
    assert stresses == {"before.odometry.translation_percent", "sensor.mode", "after.route", "before.lateral"}
    merged = {(cell.preset, cell.oracle.noise_m) for cell in found if cell.oracle is not None}
    of_ours, of_paper = ({noise_m for name, noise_m in merged if name == each} for each in ("tunnelcd", "paper-paired"))
    assert of_ours == of_paper and min(of_ours) == 0 < max(of_ours)
    assert len({cell.config.query.n_regions for cell in found}) == 1  # no threshold hides an effect
    assert len({cell.seed for cell in found}) >= 6
    assert all(20000 <= cell.seed < 30000 for cell in found)


def test_the_base_of_the_stresses_is_the_easiest_drive_through_the_tunnels_of_narrow() -> None:
    for seed in range(10600, 10603):
        base, narrow = load_scenario(BASE, seed), load_scenario("narrow", seed)
        assert base.tunnel == narrow.tunnel
        assert base.before.route == base.after.route == narrow.before.route
        for session in (base.before, base.after):
            assert (session.lateral, session.start_m, session.end_m) == (0.0, 3.0, 3.0)
            assert (session.odometry.translation_percent, session.odometry.yaw_deg_per_100m) == (0.0, 0.0)


def test_mine_has_ten_pairs_of_every_family_with_an_effect_beside_their_clean_twins() -> None:
    plan = load_plan("mine")
    found = expand_cells(plan)
    worlds = {cell.scenario for cell in found}
    effects = {name for name in scenario_names() if name.partition("/")[0] in EFFECT_GROUPS}
    assert worlds == effects | {"narrow", "wide", "unchanged/narrow"}
    held = find_references((cell.scenario, cell.variant, cell.seed) for cell in found)
    assert held == {}  # so tables of regions and objects have a row for each
    held = find_references(((cell.scenario, cell.variant, cell.seed) for cell in found), has_families=True)
    assert {world for world, _ in held} == effects
    assert len(plan.seeds) == 10 and all(20000 <= seed < 30000 for seed in plan.seeds)
    radii = {cell.scenario: cell.config.query.radius_m for cell in found if cell.variant == "m3c2"}
    assert {world for world, radius_m in radii.items() if radius_m == 10} == {
        *(f"{effect}wide" for effect in ("", "dynamic/", "dust/", "glare/")),
        "dust/haul",
    }
    # all methods of `main` but that which merges otherwise; it has neither `frame` nor `every-keyframe`
    of_main = {*preset_names()} - {"frame", "every-keyframe", "kiss-matcher"}
    ablations = {"tunnelcd[map.movers=keep,extract.movers=keep]", "tunnelcd[map.airborne=keep]"}
    assert {cell.variant for cell in found} == of_main | ablations
