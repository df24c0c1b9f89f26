"""The front of quality against cost, by brute force, and who may stand on it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from eval.report.cost import COLUMNS, _drawing, draw_pareto, front, pareto_table
from eval.report.pooled import pooled_recalls
from eval.running.results.cases import comparable
from eval.running.results.run_data import RunData
from eval.running.runfolder import RunFolder
from tests.eval.report.drawing.drawn import read_panels

NAN = float("nan")


def run(folder: Path, methods: dict[str, tuple[float, float, float]], n_pairs: dict[str, int] | None = None) -> RunData:
    """Return a run of methods with (F1, seconds, bytes), the same on every pair."""
    rows = [
        {"scenario": "regions/narrow", "family": "regions/narrow", "seed": seed, "variant": name, "status": "ok",
         "is_unchanged_pair": False, "object_f1_50": f1, "t_total_s": seconds, "bytes_regions_before": n_bytes}
        for name, (f1, seconds, n_bytes) in methods.items() for seed in range((n_pairs or {}).get(name, 6))
    ]  # fmt: skip
    return RunData(RunFolder(folder), tuple(rows), (), (), {}, ())


def on_front(table: pd.DataFrame, cost: str) -> list[str]:
    own = table[(table["cost"] == cost) & table["is_on_front"]]
    return own["variant"].tolist()


@pytest.mark.parametrize("seed", range(20))
def test_front_by_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # few values, so that points tie in one or in both
    cost, quality = rng.integers(0, 5, 12).astype(float), rng.integers(0, 5, 12) / 4
    cost[rng.random(12) < 0.1] = NAN
    expected = []
    for i in range(12):
        beaten = any(
            cost[j] <= cost[i] and quality[j] >= quality[i] and (cost[j], quality[j]) != (cost[i], quality[i])
            for j in range(12)
        )
        expected.append(not beaten and not np.isnan(cost[i]))
    assert front(cost, quality).tolist() == expected


def test_front_does_not_depend_on_order_or_units() -> None:
    rng = np.random.default_rng(5)
    cost, quality, order = rng.random(30), rng.random(30), rng.permutation(30)
    np.testing.assert_array_equal(front(cost, quality)[order], front(1000 * cost[order], 2 * quality[order] - 1))


def test_points_by_hand(tmp_path: Path) -> None:
    data = run(tmp_path, {"slow": (0.9, 4.0, 10.0), "fast": (0.5, 1.0, 20.0), "beaten": (0.4, 2.0, 20.0)})
    table = pareto_table(data)
    assert list(table) == list(COLUMNS)
    assert set(table["quality"]) == {"object_f1_50"}
    assert on_front(table, "t_total_s") == ["slow", "fast"]
    assert on_front(table, "bytes_regions_before") == ["slow"]
    slow = table[(table["variant"] == "slow") & (table["cost"] == "t_total_s")].iloc[0]
    assert slow[["n_pairs", "n_quality", "quality_value", "low", "high", "n_cost", "cost_value"]].tolist() == (
        [6, 6, 0.9, pytest.approx(0.9), pytest.approx(0.9), 6, 4.0]
    )


def test_who_is_told_the_truth_finds_nothing_or_ran_fewer_pairs_does_not_compete(tmp_path: Path) -> None:
    methods = {
        "oracle-merge+oracle-regions": (1.0, 0.1, 1.0), "nothing": (0.0, 0.1, 1.0), "few": (1.0, 0.1, 1.0),
        "tunnelcd": (0.9, 3.0, 5.0), "voxel-diff": (0.3, 1.0, 9.0),
    }  # fmt: skip
    table = pareto_table(run(tmp_path, methods, {"few": 4}))
    assert set(table["variant"]) == set(methods)
    assert on_front(table, "t_total_s") == ["tunnelcd", "voxel-diff"]
    assert on_front(table, "bytes_regions_before") == ["tunnelcd"]


def test_a_cost_that_is_stated_for_some_answers_only_does_not_compete(tmp_path: Path) -> None:
    data = run(tmp_path, {"slow": (0.9, 4.0, 10.0), "fast": (0.5, 1.0, 20.0), "chosen": (0.9, 0.1, 0.1)})
    rows = [
        {**row, "bytes_regions_before": NAN} if (row["variant"], row["seed"]) == ("chosen", 3) else dict(row)
        for row in data.results
    ]
    table = pareto_table(replace(data, results=tuple(rows)))
    assert on_front(table, "t_total_s") == ["chosen"]
    assert on_front(table, "bytes_regions_before") == ["slow"]
    # a pair without an answer has no cost, and its method competes
    rows = [{**row, "status": "failed"} if np.isnan(row["bytes_regions_before"]) else row for row in rows]
    assert on_front(pareto_table(replace(data, results=tuple(rows))), "bytes_regions_before") == ["chosen"]


def test_recall_at_a_rate_is_taken_from_the_table_of_regions(tmp_path: Path) -> None:
    names = [{"domain": domain, "variant": name} for domain in ("in", "all") for name in ("a", "b")]
    stored = [{**each, "n_pairs": 6, "recall_at_0.1": value,
               "recall_at_0.1_low": value - 0.1, "recall_at_0.1_high": value + 0.1}
              for each, value in zip(names, (0.5, 0.7, 0.0, 0.0), strict=True)]  # fmt: skip
    pd.DataFrame(stored).to_csv(tmp_path / "regions_table.csv", index=False)
    table = pareto_table(run(tmp_path, {"a": (NAN, 1.0, 1.0), "b": (NAN, 2.0, 1.0)}))
    assert set(table["quality"]) == {"recall_at_0.1"}
    own = table[table["cost"] == "t_total_s"]
    assert own["quality_value"].tolist() == [0.5, 0.7]
    assert own["high"].tolist() == pytest.approx([0.6, 0.8])
    assert own["is_on_front"].tolist() == [True, True]
    # a table over other pairs too, as of a world's repetitions, says nothing of these
    pd.DataFrame(stored).assign(n_pairs=132).to_csv(tmp_path / "regions_table.csv", index=False)
    table = pareto_table(run(tmp_path, {"a": (NAN, 1.0, 1.0), "b": (NAN, 2.0, 1.0)}))
    assert "recall_at_0.1" not in set(table["quality"])
    pd.DataFrame(stored).assign(n_pairs=[6, 132, 6, 132]).to_csv(tmp_path / "regions_table.csv", index=False)
    data = run(tmp_path, {"a": (NAN, 1.0, 1.0), "b": (NAN, 2.0, 1.0)})
    assert pooled_recalls(data, comparable(data))["recall_at_0.1"].isna().all()


def test_one_method_is_no_comparison(tmp_path: Path) -> None:
    table = pareto_table(run(tmp_path, {"tunnelcd": (0.9, 3.0, 5.0)}))
    assert len(table) == 0
    assert draw_pareto(table) == []


def test_the_picture_names_the_front(tmp_path: Path) -> None:
    methods = {"tunnelcd": (0.9, 3.0, 5.0), "voxel-diff": (0.3, 1.0, 9.0), "c2c": (0.2, 2.0, 9.0)}
    (chart,) = draw_pareto(pareto_table(run(tmp_path, methods)))
    assert chart.name == "pareto_objects"
    assert chart.png.startswith(b"\x89PNG")
    labels = [text for row in read_panels(chart.drawing) for panel in row for text in panel.texts.get("label", ())]
    assert labels == ["tunnelcd", "voxel-diff", "tunnelcd"]
    front_text = chart.caption.partition("On the front: ")[2]
    assert "time of a pair, in distribution: tunnelcd, voxel-diff;" in front_text
    assert "c2c" not in front_text
    assert "beside other work" not in front_text
    (busy,) = draw_pareto(pareto_table(run(tmp_path, methods)), is_contended=True)
    assert busy.caption.endswith("Times were measured beside other work.")


def test_methods_at_one_place_share_a_label(tmp_path: Path) -> None:
    methods = {"tunnelcd": (0.9, 3.0, 5.0), "paper": (0.3, 1.0, 2.0), "untrained": (0.3, 1.0, 2.0)}
    (chart,) = draw_pareto(pareto_table(run(tmp_path, methods)))
    labels = [text for row in read_panels(chart.drawing) for panel in row for text in panel.texts.get("label", ())]
    assert labels == ["tunnelcd", "paper, untrained"] * 2


def test_of_many_methods_at_one_place_the_first_are_named_and_the_rest_counted(tmp_path: Path) -> None:
    methods = {f"m-{number}": (0.9, 3.0, 5.0) for number in range(40)}
    (chart,) = draw_pareto(pareto_table(run(tmp_path, methods)))
    labels = [text for row in read_panels(chart.drawing) for panel in row for text in panel.texts.get("label", ())]
    assert labels == [", ".join(list(methods)[:8]) + " and 32 more"] * 2
    assert chart.caption.count("m-7 and 32 more") == 2


def test_a_cost_of_nothing_leaves_the_axis_to_the_others(tmp_path: Path) -> None:
    methods = {"tunnelcd": (0.9, 3.0, 5.0), "c2c": (0.2, 2.0, 9.0)}
    tiny = {"theirs": (0.5, 5e-324, 5e-324)}
    (alone,), (beside,) = (_drawing(pareto_table(run(tmp_path, each)), "x").rows for each in (methods, methods | tiny))
    assert [panel.x.span for panel in beside] == [panel.x.span for panel in alone]
    (chart,) = draw_pareto(pareto_table(run(tmp_path, methods | tiny)))
    assert "theirs" in chart.caption  # its figures stay as it stated them
