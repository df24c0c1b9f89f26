from __future__ import annotations

import pytest

from scenarios import load_scenario, scenario_names

SEEDS = (*range(4), *range(10000, 10004))


@pytest.mark.parametrize(
    ("name", "base"), [("glare/null", "unchanged/narrow"), ("glare/narrow", "narrow"), ("glare/wide", "wide")]
)
def test_a_glare_family_is_its_base_with_markers_and_switches(name: str, base: str) -> None:
    for seed in SEEDS:
        ours, clean = load_scenario(name, seed).model_dump(), load_scenario(base, seed).model_dump()
        markers = ours["tunnel"]["furniture"].pop("markers")
        assert 5 <= markers["every_m"] <= 25 and 0.2 <= markers["size_m"] <= 0.5
        assert ours["sensor"].pop("retroreflectors") and ours["sensor"].pop("glass")
        own = ("family", "description")
        assert [ours.pop(key) for key in own] != [clean.pop(key) for key in own]
        assert ours == clean


def test_no_other_family_dazzles() -> None:
    for name in scenario_names():
        scenario = load_scenario(name, 1)
        is_dazzling = scenario.sensor.retroreflectors, scenario.tunnel.furniture.markers is not None
        assert is_dazzling == (name.startswith("glare/"),) * 2, name
