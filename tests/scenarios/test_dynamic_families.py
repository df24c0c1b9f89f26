from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from pydantic import ValidationError

from cdpipe.core.errors import ScenarioError
from scenarios import check_scenario, load_scenario, scenario_names
from scenarios.schema import Mover

SEEDS = (*range(12), *range(10000, 10012))
BASES = {"dynamic/null": "unchanged/narrow", "dynamic/narrow": "narrow", "dynamic/wide": "wide"}


@pytest.mark.parametrize(("name", "base"), BASES.items())
def test_a_dynamic_family_is_its_base_with_movers(name: str, base: str) -> None:
    counts: Counter[int] = Counter()
    kinds: set[str] = set()
    for seed in SEEDS:
        moving, still = load_scenario(name, seed), load_scenario(base, seed)
        own = {"family", "description", "movers"}
        assert moving.model_dump(exclude=own) == still.model_dump(exclude=own)
        assert not still.movers and moving.sensor.sub_rays == 7
        assert all(mover.sessions == "both" for mover in moving.movers)
        counts[len(moving.movers)] += 1
        kinds |= {mover.kind for mover in moving.movers}
    assert min(counts) >= 1 and max(counts) <= (6 if name == "dynamic/null" else 4) and len(counts) > 2
    machine = "loader" if name == "dynamic/wide" else "forklift"
    assert kinds == {"person", "curtain", machine}


def test_no_other_family_has_movers() -> None:
    for name in scenario_names():
        assert bool(load_scenario(name, 1).movers) == (name.startswith("dynamic/") or name == "dust/haul"), name


def test_haul_is_wide_with_a_loader_that_raises_dust() -> None:
    for seed in (1, 10001, 10002):
        haul, wide = (load_scenario(name, seed).model_dump() for name in ("dust/haul", "wide"))
        (loader,) = haul["movers"]
        assert loader["kind"] == "loader" and 300 <= loader["dust_mg_per_m"] <= 3000
        for tree in (haul, wide):
            for key in ("family", "description", "movers"):
                tree.pop(key, None)
            for session in ("before", "after"):
                tree[session].pop("air", None)
        assert haul == wide


def test_movers_are_repeated_and_drawn_as_props_are() -> None:
    scenario = load_scenario("dynamic/null", 10002)
    walkers = [mover for mover in scenario.movers if mover.name.startswith("walker-")]
    assert [mover.name for mover in walkers] == [f"walker-{number}" for number in range(1, len(walkers) + 1)]
    assert len({mover.speed_mps for mover in walkers}) == len(walkers)


@pytest.mark.parametrize(
    ("settings", "rule"),
    [
        ({"kind": "person", "width_m": 1}, "a person has no width_m: leave that out"),
        ({"kind": "curtain", "speed_mps": 1, "pause_s": 2}, "a curtain has no pause_s, speed_mps"),
        ({"kind": "loader", "height_m": 1.8}, "a loader has no height_m"),
        ({"kind": "forklift", "speed_mps": 0}, "a forklift that never moves is a prop"),
        ({"kind": "person", "path": {"between": ["a", "b"]}}, "between and fractions go together"),
        ({"kind": "person", "path": {"between": ["a", "b"], "fractions": [0, 1], "area": "a"}}, "between or area"),
        ({"kind": "dragon"}, "person"),
    ],
)
def test_keys_that_would_be_ignored_are_refused(settings: dict[str, object], rule: str) -> None:
    with pytest.raises(ValidationError, match=rule):
        Mover.model_validate({"name": "m", **settings})


def test_every_kind_has_the_usual_figures_of_its_own() -> None:
    assert Mover(name="m", kind="person").speed_mps == 1.3
    assert Mover(name="m", kind="forklift").size_m == (3.4, 1.15, 2.1)
    assert Mover.model_validate({"name": "m", "kind": "person", "speed_mps": 0}).speed_mps == 0


def test_mistakes_in_movers_are_told_with_their_line(tmp_path: Path) -> None:
    file = tmp_path / "world.yaml"
    file.write_text(
        "extends: smoke/one_box\n"
        "movers:\n"
        "  - {name: a, kind: person, path: {between: [start, bent], fractions: [0, 1]}}\n"
        "  - {name: a, kind: person, path: {area: nowhere}}\n"
        "  - {name: b, kind: persan}\n"
    )
    with pytest.raises(ScenarioError) as refused:
        check_scenario(str(file))
    lines = str(refused.value).splitlines()
    assert any(":3: " in line and 'did you mean "bend"?' in line for line in lines)
    assert any(":4: " in line and "another mover has this name" in line for line in lines)
    assert any(":4: " in line and "there are no areas" in line for line in lines)
    assert any(":5: " in line and "movers.2.kind" in line for line in lines)
