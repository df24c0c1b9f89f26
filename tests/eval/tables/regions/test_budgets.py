"""What looking for changes costs, worked out by hand."""

import numpy as np
import pandas as pd
import pytest

from eval.tables.regions.budgets import BUDGETS, budget_rows, price_changes
from eval.tables.regions.curves import RankedPairs, ranked_pairs

NAN = float("nan")
ROW = {
    "scenario": "narrow", "variant": "m", "status": "ok", "score_radius_m": 4.5, "after_path_m": 200.0,
    "t_cd_s": 1.0, "t_oe_s": 2.0, "t_oe_per_region_s": 0.5, "n_regions": 3, "n_withdrawn": 1,
    "bytes_map_before": 12_000.0, "bytes_regions_before": 1_200.0, "n_observable": 1,
}  # fmt: skip


def tables(
    cases: list[dict[str, object]], regions: list[tuple[int, float, str, float]], changes: list[tuple[int, int]]
) -> tuple[RankedPairs, pd.DataFrame, pd.DataFrame]:
    results = pd.DataFrame([{**ROW, **each} for each in cases])
    names = ["seed", "score", "found_changes_proposed", "asked_points"]
    of_regions = pd.DataFrame(regions, columns=names).assign(scenario="narrow", is_withdrawn=False, found_changes="")
    of_changes = pd.DataFrame(changes, columns=["seed", "id"])
    of_changes = of_changes.assign(scenario="narrow", is_observable=True, n_truth_cells=20)
    return ranked_pairs(results, of_regions, of_changes, is_proposal=True), results, of_regions


def test_the_example_of_the_documentation() -> None:
    found = tables([{"seed": 1}], [(1, 9.0, "", 100), (1, 8.0, "1", 50), (1, 7.0, "", 200)], [(1, 1)])
    prices = price_changes(*found)
    assert prices["spheres"].tolist() == [1.0]
    assert prices["seconds"].tolist() == [1.0]
    assert prices["bytes"].tolist() == pytest.approx([0.25])


def test_recall_and_area_at_a_budget() -> None:
    # pair 1: changes at the first and the fourth of four looks; pair 2 is refused; in pair 3 no candidate finds one
    looks = [(1, 9.0, "1", 10), (1, 8.0, "", 10), (1, 7.0, "1", 10), (1, 6.0, "2", 10), (3, 9.0, "", 10)]
    refused = {"seed": 2, "status": "merge_refused", "after_path_m": 100.0}
    refused |= dict.fromkeys(("t_cd_s", "t_oe_s", "t_oe_per_region_s", "bytes_map_before", "bytes_regions_before"), NAN)
    ranked, *rest = tables(
        [{"seed": 1, "n_observable": 2}, refused, {"seed": 3}], looks, [(1, 1), (1, 2), (2, 1), (3, 1)]
    )
    assert price_changes(ranked, *rest)["spheres"].tolist() == [0.5, 2.0, np.inf, np.inf]
    rows = {(row["price"], row["budget"]): row for row in budget_rows(ranked, *rest)}
    assert len(rows) == sum(map(len, BUDGETS.values()))
    assert [rows["spheres", budget]["recall"] for budget in (0.5, 1.5, 2.0, 12.0)] == [0.25, 0.25, 0.5, 0.5]
    assert rows["spheres", 0.5]["area"] == pytest.approx(((1 - 0.5 / 12) + (1 - 2 / 12)) / 4)
    # 1,200 bytes are a tenth of the map, and 120 more for each look
    assert [rows["bytes", budget]["recall"] for budget in (0.1, 0.2)] == [0.0, 0.5]
    assert rows["bytes", 0.1]["area"] == 0.0
    assert rows["spheres", 2.0]["recall_low"] <= 0.5 <= rows["spheres", 2.0]["recall_high"]


def test_who_has_the_map_asks_for_nothing() -> None:
    found = tables([{"seed": 1, "bytes_regions_before": 12_000.0}], [(1, 9.0, "1", 500)], [(1, 1)])
    assert price_changes(*found)["bytes"].tolist() == [1.0]


def test_an_answer_that_states_no_points_has_no_price_in_bytes() -> None:
    ranked, *rest = tables([{"seed": 1}], [(1, 9.0, "1", NAN)], [(1, 1)])
    rows = {(row["price"], row["budget"]): row for row in budget_rows(ranked, *rest)}
    assert np.isnan(rows["bytes", 0.1]["recall"]) and np.isnan(rows["bytes", 0.1]["area"])
    assert rows["spheres", 0.5]["recall"] == 1.0


def test_a_pair_that_proposed_no_region_takes_the_seconds_of_the_others() -> None:
    none = {"seed": 2, "t_oe_s": 0.0, "t_oe_per_region_s": NAN, "n_regions": 0, "n_withdrawn": 0}
    found = tables([{"seed": 1}, none], [(2, 9.0, "1", 10)], [(2, 1)])
    # 2 s of extraction for the four proposed regions of both pairs
    assert price_changes(*found)["seconds"].tolist() == [(1.0 + 0.5) / 2]


def test_no_change_has_no_budget() -> None:
    assert budget_rows(*tables([{"seed": 1, "n_observable": 0}], [(1, 9.0, "", 10)], [])) == []


def test_a_sphere_that_is_smaller_than_it_may_be_is_charged_as_the_whole_map() -> None:
    # the score radius is 4.5 m, so spheres from 1.8 m on are charged by their points
    for radius_m, asked_share, price in ((1.79, (1.0 + 0.1) / 2, 1.0), (1.8, (0.001 + 0.1) / 2, 0.001)):
        looks = [(1, 9.0, "1", 1), (1, 8.0, "", 100)]
        ranked, results, regions = tables([{"seed": 1, "bytes_regions_before": 0.0}], looks, [(1, 1)])
        regions = regions.assign(radius_m=[radius_m, 4.5])
        assert price_changes(ranked, results, regions)["bytes"].tolist() == pytest.approx([price])
        of_bytes = [row for row in budget_rows(ranked, results, regions) if row["price"] == "bytes"]
        assert [row["asked_share"] for row in of_bytes] == pytest.approx([asked_share] * len(of_bytes))


def test_the_share_of_the_map_that_a_look_asks_for() -> None:
    rows = budget_rows(*tables([{"seed": 1}], [(1, 9.0, "1", 100), (1, 8.0, "", 50)], [(1, 1)]))
    shares = [row["asked_share"] for row in rows if row["price"] == "bytes"]
    assert shares == pytest.approx([0.075] * len(shares))
    assert np.isnan([row["asked_share"] for row in rows if row["price"] != "bytes"]).all()
    unstated = budget_rows(*tables([{"seed": 1}], [(1, 9.0, "1", 5), (1, 8.0, "", NAN)], [(1, 1)]))
    assert np.isnan([row["asked_share"] for row in unstated]).all()
    silent = budget_rows(*tables([{"seed": 1}], [], [(1, 1)]))
    assert np.isnan([row["asked_share"] for row in silent]).all()
