"""Which pairs are called the worst, and what is said of them."""

import math
from pathlib import Path

from eval.report.site.worst import draw_worst, worst_rows
from eval.running.results.run_data import RunData
from eval.running.runfolder import RunFolder


def run(values: list[tuple[float, float, int]], name: str = "tunnelcd", scenario: str = "narrow") -> RunData:
    rows = [
        {"scenario": scenario, "seed": seed, "variant": name, "status": "ok", "error": "", "is_unchanged_pair": False,
         "object_iou_point": iou, "region_recall": recall, "n_observable": n, "false_regions_per_100m": 0.5,
         "merge_error_m": 0.0123}
        for seed, (iou, recall, n) in enumerate(values)
    ]  # fmt: skip
    return RunData(RunFolder(Path("nowhere")), tuple(rows), (), (), {}, ())


def test_the_lowest_iou_comes_first_then_the_lowest_recall_then_the_most_changes() -> None:
    data = run([(0.5, 1.0, 3), (0.0, 0.5, 3), (0.0, 0.0, 2), (0.0, 0.0, 9), (math.nan, math.nan, 0)])
    assert [row["seed"] for row in worst_rows(data, "tunnelcd")] == [3, 2, 1, 0]


def test_ten_at_most_and_of_the_shown_method_only() -> None:
    data = run([(0.1 * (seed % 7), 1.0, 1) for seed in range(25)])
    other = run([(0.0, 0.0, 1)] * 25, "paper")
    both = RunData(data.folder, (*other.results, *data.results), (), (), {}, ())
    found = worst_rows(both, "tunnelcd")
    assert len(found) == 10
    assert {row["variant"] for row in found} == {"tunnelcd"}
    assert max(row["object_iou_point"] for row in found) == 0.2


def test_a_run_with_one_pair_of_each_scenario_shows_them_all_anyway() -> None:
    assert worst_rows(run([(0.1, 1.0, 1)]), "tunnelcd") == []


def test_what_is_said_holds_the_numbers_or_why_there_are_none() -> None:
    data = run([(0.25, 0.5, 4), (0.9, 1.0, 1)])
    refused = {**data.results[0], "status": "merge_refused", "error": "too smooth"}
    first, second = draw_worst(data, "tunnelcd", [data.results[0], refused])
    assert all(number in first.words for number in ("0.25", "0.50", "0.012"))
    assert "too smooth" in second.words
    assert first.picture is None
