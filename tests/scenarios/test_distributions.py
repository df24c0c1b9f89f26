from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cdpipe.core.geometry import stream
from scenarios import distributions
from scenarios.distributions import find_malformed, join_key, merge_trees


def draw(tree: Any, seed: int) -> Any:
    return distributions.draw(tree, seed).value


@pytest.mark.parametrize("seed", [0, 7, 2_000_000_000])
def test_every_distribution_draws_from_the_stream_of_its_dotted_path(seed: int) -> None:
    tree = {
        "a": {
            "u": {"uniform": [2, 4]},
            "n": [0, {"normal": [1.0, 0.5]}],
            "i": {"integers": [3, 9]},
            "c": {"choice": ["x", "y", "z"]},
        }
    }
    assert draw(tree, seed) == {
        "a": {
            "u": stream(seed, "scenario", "a.u").uniform(2, 4),
            "n": [0, stream(seed, "scenario", "a.n.1").normal(1.0, 0.5)],
            "i": stream(seed, "scenario", "a.i").integers(3, 9),
            "c": "xyz"[stream(seed, "scenario", "a.c").integers(3)],
        }
    }


def test_draws_have_the_stated_ranges_and_python_types() -> None:
    tree = {f"a {name}": {name: [2, 5]} for name in ("uniform", "normal", "integers", "choice")}
    drawn = [draw(tree, seed) for seed in range(400)]
    assert {one["a integers"] for one in drawn} == {2, 3, 4}
    assert {one["a choice"] for one in drawn} == {2, 5}
    uniform = np.array([one["a uniform"] for one in drawn])
    assert 2 <= uniform.min() < 2.1 and 4.9 < uniform.max() < 5
    normal = np.array([one["a normal"] for one in drawn])
    # standard errors of 400 draws: 5 / 20 of the mean, 5 / sqrt(800) of the deviation; three of each
    assert abs(normal.mean() - 2) < 0.75 and abs(normal.std() - 5) < 0.53
    assert {type(value) for value in drawn[0].values()} == {float, int}


def test_plain_values_pass_and_the_input_is_not_changed() -> None:
    tree = {"a": [1, "x", None, True, {"b": {"uniform": [0, 1]}}], "c": {}}
    before = repr(tree)
    assert draw({"a": [1, "x", None, True], "c": {}, "d": []}, 3) == {"a": [1, "x", None, True], "c": {}, "d": []}
    draw(tree, 3)
    assert repr(tree) == before


def test_a_choice_may_hold_distributions_and_whole_mappings() -> None:
    tree = {"p": {"choice": [{"uniform": [0, 1]}, {"uniform": [5, 6]}]}, "m": {"choice": [{"k": {"integers": [1, 2]}}]}}
    drawn = [draw(tree, seed) for seed in range(50)]
    assert all(0 <= one["p"] < 1 or 5 <= one["p"] < 6 for one in drawn)
    assert {one["p"] < 1 for one in drawn} == {True, False}
    index = stream(9, "scenario", "p").integers(2)
    assert draw(tree, 9)["p"] == stream(9, "scenario", f"p.{index}").uniform(*[(0, 1), (5, 6)][index])
    assert all(one["m"] == {"k": 1} for one in drawn)


def barrels(repeat: Any) -> dict[str, Any]:
    return {"props": [{"name": "barrel", "repeat": repeat, "at": {"uniform": [0, 1]}}]}


def test_repeat_numbers_the_names_and_draws_each_copy_by_itself() -> None:
    drawn = draw(barrels(3), 5)["props"]
    assert drawn == [
        {"name": f"barrel-{n}", "at": stream(5, "scenario", f"props.barrel-{n}.at").uniform()} for n in (1, 2, 3)
    ]
    assert draw(barrels(0), 5)["props"] == []


def test_repeat_may_be_a_distribution_and_more_copies_leave_the_first_ones_alone() -> None:
    counts = {len(draw(barrels({"integers": [1, 4]}), seed)["props"]) for seed in range(60)}
    assert counts == {1, 2, 3}
    for seed in range(10):
        drawn = draw(barrels({"integers": [1, 4]}), seed)["props"]
        assert len(drawn) == stream(seed, "scenario", "props.barrel.repeat").integers(1, 4)
        assert drawn == draw(barrels(5), seed)["props"][: len(drawn)]


def test_chance_keeps_an_item_with_its_probability() -> None:
    tree = {"props": [{"name": "a", "chance": 0.25}, {"name": "b", "chance": 1}, {"name": "c", "chance": 0}]}
    kept = [[item["name"] for item in draw(tree, seed)["props"]] for seed in range(1000)]
    share = np.mean(["a" in names for names in kept])
    assert abs(share - 0.25) < 3 * np.sqrt(0.25 * 0.75 / 1000)
    assert all("b" in names and "c" not in names for names in kept)
    assert "chance" not in draw(tree, 0)["props"][0]


def test_one_of_merges_a_drawn_mapping_under_the_mapping_s_own_keys() -> None:
    tree = {"m": {"own": 1, "one_of": [{"own": 0, "x": {"uniform": [1, 2]}}, {"y": {"deep": 2}}], "y": {"kept": 3}}}
    drawn = {seed: draw(tree, seed)["m"] for seed in range(20)}
    for seed, mapping in drawn.items():
        first = {"own": 1, "x": stream(seed, "scenario", "m.x").uniform(1, 2), "y": {"kept": 3}}
        second = {"own": 1, "y": {"deep": 2, "kept": 3}}
        assert mapping == [first, second][stream(seed, "scenario", "m.one_of").integers(2)]


def test_all_alternatives_of_alternatives_occur() -> None:
    tree = {"one_of": [{"k": "A", "one_of": [{"s": 1}, {"s": 2}]}, {"k": "B", "one_of": [{"s": 3}, {"s": 4}]}]}
    found = [(drawn["k"], drawn["s"]) for drawn in (draw({"m": tree}, seed)["m"] for seed in range(80))]
    assert set(found) == {("A", 1), ("A", 2), ("B", 3), ("B", 4)}


def test_adding_a_prop_or_a_key_changes_no_other_draw() -> None:
    props = [
        {"name": "a", "repeat": {"integers": [1, 4]}, "at": [{"uniform": [0, 1]}, {"normal": [0, 1]}]},
        {"name": "b", "chance": 0.5, "one_of": [{"k": {"integers": [0, 99]}}, {"k": {"choice": [1, 2, 3]}}]},
    ]
    new = {"name": "new", "at": {"uniform": [0, 1]}}
    for seed in range(20):
        old = draw({"props": props, "z": {"uniform": [0, 1]}}, seed)
        for position in range(3):
            more = draw(
                {
                    "y": {"uniform": [0, 1]},
                    "z": {"uniform": [0, 1]},
                    "props": [*props[:position], new, *props[position:]],
                },
                seed,
            )
            assert [item for item in more["props"] if item["name"] != "new"] == old["props"]
            assert more["z"] == old["z"]


def test_seeds_draw_differently() -> None:
    values = [draw({"a": {"uniform": [0, 1]}}, seed)["a"] for seed in range(1000)]
    assert len(set(values)) == 1000
    assert abs(np.mean(values) - 0.5) < 3 / np.sqrt(12 * 1000)


def test_every_malformed_distribution_is_told_at_once() -> None:
    tree = {
        "a": {"uniform": [2, 1]},
        "b": {"uniform": [1, 2, 3]},
        "c": {"normal": [0, -1]},
        "d": {"integers": [3, 3]},
        "e": {"integers": [1, 2.5]},
        "f": {"choice": []},
        "g": {"choice": [1, {"uniform": ["x", 1]}]},
        "h": {"unifrom": [1, 2]},
        "i": {"uniform": [1, 2], "normal": [0, 1]},
        "j": {"uniform": [float("nan"), 1]},
        "l": {"uniform": [-1e308, 1e308]},
        "k": [{"repeat": -1}, {"repeat": {"uniform": [1, 2]}}, {"chance": 2}, {"one_of": []}],
        "m": [{"repeat": 10_001}, {"repeat": {"integers": [0, 10_002]}}, {"repeat": {"integers": [0, 10_001]}}],
        "fine": [{"repeat": {"choice": [1, {"integers": [0, 2]}]}, "chance": 0.5}],
    }
    lines = {join_key(key): rule for key, rule in find_malformed(tree).items()}
    assert list(lines) == [
        *"abcdef",
        "g.choice.1",
        "h",
        "i",
        "j",
        "l",
        "k.0.repeat",
        "k.1.repeat",
        "k.2.chance",
        "k.3.one_of",
        "m.0.repeat",
        "m.1.repeat",
    ]
    assert "uniform: [a, b]" in lines["a"]
    assert 'did you mean "uniform"?' in lines["h"]
    assert "uniform, normal, integers, choice" in lines["i"]


def test_origins_lead_from_drawn_keys_back_to_their_source() -> None:
    tree = {"l": [{"n": 1, "repeat": 2}, {"v": {"choice": [{"w": 5}]}}, {"one_of": [{"q": [7]}]}]}
    drawn = distributions.draw(tree, 0)
    assert drawn.value == {"l": [{"n": 1}, {"n": 1}, {"v": {"w": 5}}, {"q": [7]}]}
    assert drawn.origins["l", 1, "n"] == ("l", 0, "n")
    assert drawn.origins["l", 2, "v", "w"] == ("l", 1, "v", "choice", 0, "w")
    assert drawn.origins["l", 3, "q", 0] == ("l", 2, "one_of", 0, "q", 0)


def test_merging_goes_into_mappings_but_not_into_lists_or_distributions() -> None:
    base = {"a": {"x": 1, "y": 2}, "l": [1, 2], "d": {"uniform": [0, 1]}, "s": 3}
    over = {"a": {"y": 5}, "l": [9], "d": {"normal": [0, 1]}, "s": {"choice": [1, 2]}, "new": 1}
    assert merge_trees(base, over) == {
        "a": {"x": 1, "y": 5}, "l": [9], "d": {"normal": [0, 1]}, "s": {"choice": [1, 2]}, "new": 1,
    }  # fmt: skip


@pytest.mark.parametrize("tree", [{"integers": [0, 2**63]}, {"integers": [-(2**63), 5]}, {"uniform": [-1e307, 1e307]}])
def test_numbers_at_the_limits_are_drawn(tree: dict[str, Any]) -> None:
    (low, high) = next(iter(tree.values()))
    assert not find_malformed({"key": tree})
    assert low <= draw({"key": tree}, 3)["key"] <= high


@pytest.mark.parametrize(
    "tree",
    [
        {"integers": [0, 10**20]},
        {"integers": [-(10**20), 0]},
        {"uniform": [0, 10**400]},
        {"uniform": [-(10**308), 10**308]},
        {"normal": [10**400, 1]},
    ],
)
def test_numbers_beyond_the_limits_are_mistakes(tree: dict[str, Any]) -> None:
    assert list(find_malformed({"key": tree})) == [("key",)]
    assert draw({"key": tree}, 3)["key"] is None
