"""The first words of a page: the plan with its question, and who leads by the figure that the plan is about."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from eval.plans.targets import read_targets
from eval.report.comparing.differences import BETTER, NOISE, SAME, TOO_FEW, WORSE
from eval.report.framing.headline import name_by_setting, name_leaders, name_without_shared, write_answer, write_title
from eval.report.summary import rank_methods
from eval.running.results.run_data import RunData
from eval.running.runfolder import RunFolder
from eval.tables.columns import Column, share
from eval.tables.merge_table import merge_table

HIGH, LOW = (Column("a", "share", better, share) for better in ("high", "low"))
NAN = float("nan")


def run(folder: Path, rows: list[dict[str, Any]] | None = None, **plan: Any) -> RunData:
    common = {"seed": 1, "status": "ok", "is_unchanged_pair": False, "n_observable": 4}
    results = tuple({**common, "family": row.get("scenario"), **row} for row in rows or ())
    return RunData(RunFolder(folder), results, (), (), {"plan": plan}, ())


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ([("a", 0.5), ("b", 0.9), ("c", 0.1)], "b (0.90), then a (0.50)"),
        ([("a", 0.904), ("b", 0.9), ("c", 0.1)], "a and b (0.90), then c (0.10)"),
        ([("a", 0.5), ("b", 0.5)], "all 2 methods alike (0.50)"),
        ([*((name, 1.0) for name in "abcde"), ("f", 0.0)], "a, b, c and 2 more (1.00), then f (0.00)"),
        ([("a", 0.5), ("oracle-merge", 0.9), ("b", NAN)], ""),
        ([("m[a=1,b=1]", 0.9), ("n[a=1,b=2]", 0.5)], "m[a=1, …] (0.90), then n[a=1, …] (0.50)"),
        ([("m[a=1,b=1]", 0.9), ("m[a=1,b=2]", 0.9), ("n", 0.5)], "m[a=1,b=1] and m[a=1,b=2] (0.90), then n (0.50)"),
        ([], ""),
    ],
)
def test_leaders_by_hand(values: list[tuple[str, float]], told: str) -> None:
    assert name_leaders(values, HIGH) == told  # nothing was judged, so nobody leads


def test_where_less_is_better_the_least_leads() -> None:
    assert name_leaders([("a", 0.5), ("b", 0.1)], LOW) == "b (0.10), then a (0.50)"


@pytest.mark.parametrize(
    ("verdict", "told"),
    [
        (BETTER, "a (0.90), before b (0.50)"),
        (WORSE, "a (0.90), before b (0.50)"),
        (TOO_FEW, "a (0.90), before b (0.50), on too few pairs for a verdict"),
        (NOISE, "a (0.90), not told from b (0.50)"),
        (SAME, "a (0.90), not told from b (0.50)"),
        ("", "a (0.90), then b (0.50)"),
    ],
)
def test_who_is_before_whom_by_the_verdict(verdict: str, told: str) -> None:
    assert name_leaders([("a", 0.9), ("b", 0.5)], HIGH, lambda first, second: verdict) == told


@pytest.mark.parametrize(
    ("plan", "title"),
    [
        ({"name": "main", "description": "Every method on all: test pairs. More."}, "main: Every method on all"),
        ({"name": "hard", "description": "What breaks whom? One drift."}, "hard: What breaks whom?"),
        ({"name": "x"}, "x: change detection between two LiDAR sessions of a tunnel"),
        ({}, "A run: change detection between two LiDAR sessions of a tunnel"),
    ],
)  # fmt: skip
def test_the_title_is_the_plan_and_its_question(tmp_path: Path, plan: dict[str, str], title: str) -> None:
    assert write_title(run(tmp_path, **plan)) == title


def test_each_domain_has_its_leaders(tmp_path: Path) -> None:
    shares = {"narrow": {"tunnelcd": 0.9, "c2c": 0.5, "oracle-merge": 1.0}, "cave": {"tunnelcd": 0.2, "c2c": 0.4}}
    rows = [
        {"scenario": world, "variant": name, "region_recall": value}
        for world, own in shares.items() for name, value in own.items()
    ]  # fmt: skip
    assert write_answer(run(tmp_path, rows), pd.DataFrame()) == (
        "Highest region recall, in distribution: tunnelcd (0.90), before c2c (0.50), on too few pairs for a verdict; "
        "out of distribution: c2c (0.40), before tunnelcd (0.20), on too few pairs for a verdict."
    )


@pytest.mark.parametrize(
    ("variants", "told"),
    [
        (("m[a.b=x]", "m[a.b=y,c.d=2]"), ("a.b", {"m[a.b=x]": "x", "m[a.b=y,c.d=2]": "y"})),
        (("m[a.b=x]", "m"), ("", {})),
        (("m[a.b=x]", "n[a.b=y]"), ("", {})),
        (("m[a.b=x]", "m[a.c=y]"), ("", {})),
        (("m[a.b=x,c.d=1]", "m[a.b=x,c.d=2]"), ("", {})),
        ((), ("", {})),
    ],
)
def test_variants_of_one_setting(variants: tuple[str, ...], told: tuple[str, dict[str, str]]) -> None:
    assert name_by_setting(variants) == told


@pytest.mark.parametrize(
    ("variants", "told"),
    [
        (("m[a.b=x]", "n[a.b=x]"), ("a.b=x", {"m[a.b=x]": "m", "n[a.b=x]": "n"})),
        (
            ("m[a.b=[1, 2],c.d=y]", "m[a.b=[1, 2]]"),
            ("a.b=[1, 2]", {"m[a.b=[1, 2],c.d=y]": "m[c.d=y]", "m[a.b=[1, 2]]": "m"}),
        ),
        (("m[a.b=x]", "n"), ("", {})),
        (("m", "n"), ("", {})),
        (("m[a.b=x]",), ("", {})),
    ],
)
def test_variants_without_the_settings_that_they_share(
    variants: tuple[str, ...], told: tuple[str, dict[str, str]]
) -> None:
    assert name_without_shared(variants) == told


def test_leaders_are_named_without_the_settings_that_all_share(tmp_path: Path) -> None:
    values = {"m[a.b=x]": 0.9, "n[a.b=x]": 0.5, "oracle-merge[a.b=x]": 1.0}
    rows = [{"scenario": "narrow", "variant": name, "region_recall": value} for name, value in values.items()]
    told = write_answer(run(tmp_path, rows), pd.DataFrame())
    few = ", on too few pairs for a verdict"
    assert told == f"Highest region recall with a.b=x, in distribution: m (0.90), before n (0.50){few}."


def test_a_leader_is_before_others_only_beyond_noise(tmp_path: Path) -> None:
    def told(scenarios: Sequence[str]) -> str:
        rows = [
            {"scenario": world, "seed": seed, "variant": name, "region_recall": value + 0.01 * seed}
            for world in scenarios for seed in range(6 // len(scenarios)) for name, value in (("a", 0.9), ("b", 0.5))
        ]  # fmt: skip
        return write_answer(run(tmp_path / str(len(scenarios)), rows), pd.DataFrame())

    assert "a (0.93), before b (0.53)" in told(["narrow"])
    # six pairs of two tunnels: the families differ by what is in the air
    few = "on too few pairs for a verdict"
    assert f"a (0.91), before b (0.51), {few}" in told(["narrow", "dust/narrow", "dust/mist"])
    assert few not in told(["narrow"])


def test_a_leader_within_noise_is_not_told_from_the_next(tmp_path: Path) -> None:
    rows = [
        {"scenario": "narrow", "seed": seed, "variant": name, "region_recall": value}
        for seed in range(8) for name, value in (("a", 0.9 if seed % 2 else 0.1), ("b", 0.1 if seed % 3 else 0.9))
    ]  # fmt: skip
    assert "a (0.50), not told from b (0.40)" in write_answer(run(tmp_path, rows), pd.DataFrame())


def test_without_the_candidates_of_regions_csv_no_lead_in_pooled_recall_is_claimed(tmp_path: Path) -> None:
    rows = [{"scenario": "narrow", "seed": seed, "variant": name} for seed in range(8) for name in "ab"]
    table = [
        {"domain": "in", "variant": name, "n_pairs": 8, "n_unchanged": 0, "recall_at_0.1": value,
         "recall_at_0.1_low": value, "recall_at_0.1_high": value}
        for name, value in (("a", 1.0), ("b", 0.94))
    ]  # fmt: skip
    pd.DataFrame(table).to_csv(tmp_path / "regions_table.csv", index=False)
    told = write_answer(run(tmp_path, rows), pd.DataFrame())
    assert told == "Highest recall at 0.1 false / 100 m, in distribution: a (1.00), then b (0.94)."


@pytest.mark.parametrize(
    ("n_alarms", "told"),
    [(8, "a (1.00), before b (0.00)"), (1, "a (1.00), not told from b (0.88)")],
)
def test_silence_is_judged_by_the_alarms_on_unchanged_pairs(tmp_path: Path, n_alarms: int, told: str) -> None:
    rows = [
        {"scenario": "narrow", "seed": seed, "variant": name, "is_unchanged_pair": True, "n_observable": 0,
         "is_alarm": name == "b" and seed < n_alarms}
        for seed in range(8) for name in "ab"
    ]  # fmt: skip
    table = [
        {"domain": "in", "variant": name, "n_pairs": 8, "n_unchanged": 8, "silent_share": value}
        for name, value in (("a", 1.0), ("b", 1.0 - n_alarms / 8))
    ]
    pd.DataFrame(table).to_csv(tmp_path / "regions_table.csv", index=False)
    silence = "Highest share of the unchanged pairs without a false region, in distribution"
    assert write_answer(run(tmp_path, rows), pd.DataFrame()) == f"{silence}: {told}."


def test_where_nothing_changed_the_fewest_alarms_lead(tmp_path: Path) -> None:
    rows = [
        {"scenario": "narrow", "seed": seed, "variant": name, "is_unchanged_pair": True, "n_observable": 0,
         "is_alarm": name == "b"}
        for seed in range(8) for name in "ab"
    ]  # fmt: skip
    told = write_answer(run(tmp_path, rows), pd.DataFrame())
    assert told == "Lowest alarm or no answer where nothing changed, in distribution: a (0.00), before b (1.00)."


def test_a_mean_over_fewer_pairs_leads_nothing(tmp_path: Path) -> None:
    rows = [
        {"scenario": "narrow", "seed": seed, "variant": name, "region_recall": value}
        for name, value, n in (("easy", 1.0, 2), ("a", 0.5, 8), ("b", 0.25, 8)) for seed in range(n)
    ]  # fmt: skip
    told = write_answer(run(tmp_path, rows), pd.DataFrame())
    assert told == "Highest region recall, in distribution: a (0.50), before b (0.25)."


@pytest.mark.parametrize(("n_wrong", "told"), [(8, "before b (0.00)"), (1, "not told from b (0.88)")])
def test_merges_are_judged_pair_by_pair(tmp_path: Path, n_wrong: int, told: str) -> None:
    rows = [
        {"scenario": "narrow", "seed": seed, "variant": name, "pair_kind": "clean", "merge_error_deg": 0.0,
         "merge_error_m": 9.0 if name == "b" and seed < n_wrong else 0.0}
        for seed in range(8) for name in "ab"
    ]  # fmt: skip
    data = run(tmp_path, rows, until="merge")
    merges = merge_table(pd.DataFrame(list(data.results)), read_targets(data.provenance))
    assert write_answer(data, merges) == f"Highest share of the pairs merged as their kind asks: a (1.00), {told}."


def test_a_limit_of_displacement_is_of_no_pair_so_it_is_not_judged(tmp_path: Path) -> None:
    table = [
        {"domain": "in", "variant": name, "surface_limit_1m2_m": value} for name, value in (("a", 0.01), ("b", 0.02))
    ]
    pd.DataFrame(table).to_csv(tmp_path / "surface_table.csv", index=False)
    rows = [{"scenario": "narrow", "seed": seed, "variant": name} for seed in range(8) for name in "ab"]
    told = write_answer(run(tmp_path, rows), pd.DataFrame())
    assert told == "Lowest displacement found on 1 m² [mm], in distribution: a (10), then b (20)."


def test_leaders_that_differ_by_a_setting_are_named_by_it(tmp_path: Path) -> None:
    values = {"m[a.b=x]": 0.9, "m[a.b=y,c.d=2]": 0.5, "oracle-merge[a.b=x]": 1.0}
    rows = [{"scenario": "narrow", "variant": name, "region_recall": value} for name, value in values.items()]
    told = write_answer(run(tmp_path, rows), pd.DataFrame())
    assert (
        told
        == "Highest region recall by a.b, in distribution: x (0.90), before y (0.50), on too few pairs for a verdict."
    )


def test_a_plan_with_axes_says_on_how_many_its_leader_holds(tmp_path: Path) -> None:
    points = [
        {"axis": axis, "unit": "m", "variant": name, "step": step, "value": 0.2, "is_measured": True, "recall": 0.5,
         "n_judged": 3}
        for name, steps in {"c2c": (1, 2), "tunnelcd": (0, 3), "oracle-merge": (0, 0)}.items()
        for axis, step in zip(("size", "drift"), steps, strict=True)
    ]  # fmt: skip
    pd.DataFrame(points).to_csv(tmp_path / "breaking_points.csv", index=False)
    rows = [{"scenario": "narrow", "variant": name} for name in ("c2c", "tunnelcd")]
    told = write_answer(run(tmp_path, rows, targets={"method": "tunnelcd"}), pd.DataFrame())
    assert told == "Holds on most axes: tunnelcd (1), then c2c (0); tunnelcd breaks at drift (0.2 m)."


def test_axes_that_are_not_measured_yet_give_no_leader(tmp_path: Path) -> None:
    rows = [{"scenario": "narrow", "variant": name} for name in ("c2c", "tunnelcd")]
    point = {"unit": "m", "value": 0.2, "recall": 0.5, "n_judged": 3, "step": 0}
    points = [
        {"axis": axis, "variant": name, "is_measured": axis == "size" or name == "c2c", **point}
        for axis in ("size", "drift") for name in ("c2c", "tunnelcd")
    ]  # fmt: skip
    for table, told in (
        (points, "tunnelcd breaks nowhere so far (1 of 2 axes measured)."),
        ([each for each in points if each["variant"] == "c2c"], "c2c breaks nowhere."),
    ):
        pd.DataFrame(table).to_csv(tmp_path / "breaking_points.csv", index=False)
        assert write_answer(run(tmp_path, rows, targets={"method": "tunnelcd"}), pd.DataFrame()) == told


def test_a_run_of_one_method_names_no_leader(tmp_path: Path) -> None:
    rows = [{"scenario": "narrow", "variant": "mine", "region_recall": 0.5}]
    assert write_answer(run(tmp_path, rows), pd.DataFrame()) == "The run holds too little to compare two methods."


def test_where_nothing_changed_the_table_begins_with_the_fewest_alarms(tmp_path: Path) -> None:
    alarms = {f"m{number}": number for number in range(9, -1, -1)}  # the silent one is run last
    rows = [
        {"scenario": "narrow", "seed": seed, "variant": name, "is_unchanged_pair": True, "n_observable": 0,
         "is_alarm": seed < n, "false_regions_per_100m": float(n)}
        for name, n in alarms.items() for seed in range(10)
    ]  # fmt: skip
    ranked, shown, _ = rank_methods(run(tmp_path, rows))
    assert ranked["variant"].tolist() == sorted(alarms)
    assert [column.key for column in shown] == ["false_regions_per_100m", "is_alarm"]
