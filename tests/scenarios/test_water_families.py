from __future__ import annotations

import pytest

from scenarios import load_scenario, scenario_names

SEEDS = (*range(8), *range(10000, 10008))


@pytest.mark.parametrize(("name", "base"), [("water/null", "unchanged/narrow"), ("water/narrow", "narrow")])
def test_a_water_family_is_its_base_with_puddles(name: str, base: str) -> None:
    sessions = set()
    for seed in SEEDS:
        wet, dry = load_scenario(name, seed), load_scenario(base, seed)
        own = {"family", "description", "puddles"}
        assert wet.model_dump(exclude=own) == dry.model_dump(exclude=own)
        assert 2 <= len(wet.puddles) <= (6 if name == "water/narrow" else 8) and not dry.puddles
        sessions |= {puddle.sessions for puddle in wet.puddles}
    assert sessions == {"both", "before", "after"}


def test_no_other_family_has_puddles() -> None:
    for name in scenario_names():
        assert bool(load_scenario(name, 1).puddles) == (name.startswith("water/") or name == "train/mine"), name
