"""Every column of the table of regions, its budgets, its curves and its overview, worked out by hand."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from eval.core.statistics import interval_of, wilson_interval
from eval.tables.regions.curves import ranked_pairs, resampled_recalls
from eval.tables.regions.table import region_overview, region_tables
from tests.eval.tables.regions.test_table import NAN, TARGETS, changed, tables, the_row, the_target, unchanged


def test_every_count_of_a_row() -> None:
    rows = [
        changed("regions/narrow", 1, n_observable=3, n_found_changes=2, is_auroc_assumed=0, region_auroc=0.9,
                region_precision=0.5, region_recall_proposed=1.0, region_recall_at_k_proposed=0.75,
                t_cd_per_region_s=0.1, bytes_map_before=2000.0, after_path_m=2000.0),
        changed("regions/narrow", 2, n_observable=1, n_found_changes=1, is_auroc_assumed=1, region_auroc=0.5,
                region_precision=0.25, region_recall_proposed=0.5, region_recall_at_k_proposed=0.25,
                t_cd_per_region_s=0.3, t_descriptor_per_keyframe_s=0.03),
        unchanged("regions/narrow", 3, t_cd_per_region_s=0.2, t_descriptor_per_keyframe_s=0.05),
        # of a refused pair no way, false region, second or byte counts
        changed("regions/narrow", 4, status="merge_refused", n_false_regions=100, after_path_m=9000.0,
                is_auroc_assumed=1, bytes_map_before=NAN, t_cd_per_region_s=9.0, t_descriptor_per_keyframe_s=9.0,
                n_found_changes=NAN),
    ]  # fmt: skip
    row = the_row(tables(rows)["regions_table"], "in")
    counts = {
        "n_pairs": 4, "n_refused": 1, "n_failed": 1, "n_auroc": 2, "n_auroc_assumed": 2, "n_changed": 3,
        "n_observable": 5, "n_found": 3, "n_unchanged": 1, "n_silent": 1, "silent_share": 1.0, "km": 4.0,
        "km_unchanged": 1.0, "false_regions_per_100m": 0.0, "false_regions_per_100m_unchanged": 0.0,
    }  # fmt: skip
    assert {name: row[name] for name in counts} == counts
    assert (row["silent_low"], row["silent_high"]) == wilson_interval(1, 1)
    means = {
        "region_auroc": 0.7, "region_precision": 0.375, "region_recall_proposed": 0.75,
        "region_recall_at_k_proposed": 0.5, "region_recall": 0.0, "region_recall_at_k": 0.0,
        "t_cd_per_region_s": 0.2, "t_descriptor_per_keyframe_s": 0.03,
        "bytes_map_before": 4000 / 3, "bytes_regions_before": 100.0, "bytes_ratio": 40 / 3,
    }  # fmt: skip
    assert {name: row[name] for name in means} == pytest.approx(means)
    assert (row["region_auroc_low"], row["region_auroc_high"]) == (0.5, 0.9)


def test_without_an_unchanged_pair_or_a_way_there_is_no_share_and_no_rate() -> None:
    row = the_row(tables([changed("regions/narrow", 1)])["regions_table"], "in")
    assert (row["n_unchanged"], row["n_silent"], row["km_unchanged"]) == (0, 0, 0.0)
    assert np.isnan([row["silent_share"], row["false_regions_per_100m_unchanged"]]).all()
    refused = the_row(tables([changed("regions/narrow", 1, status="merge_refused")])["regions_table"], "in")
    assert refused["km"] == 0.0 and np.isnan(refused["false_regions_per_100m"])


@pytest.mark.parametrize(("kept", "ratio"), [(1.0, 1000.0), (0.0, NAN)])
def test_who_keeps_a_byte_keeps_something(kept: float, ratio: float) -> None:
    row = the_row(tables([changed("regions/narrow", 1, bytes_regions_before=kept)])["regions_table"], "in")
    assert row["bytes_ratio"] == pytest.approx(ratio, nan_ok=True)


def test_a_short_way_has_a_rate_of_false_regions() -> None:
    rows = [unchanged("regions/narrow", 1, after_path_m=1.0, n_false_regions=1, alarm=1.0)]
    row = the_row(tables(rows)["regions_table"], "in")
    assert (row["false_regions_per_100m"], row["false_regions_per_100m_unchanged"]) == (100.0, 100.0)


def test_recall_at_a_rate_has_an_interval_over_tunnels_and_a_twin_for_proposals() -> None:
    rows = [changed("regions/narrow", seed, after_path_m=5000.0) for seed in range(4)]
    found = [
        {"scenario": "regions/narrow", "seed": seed, "variant": "tunnelcd", "score": score, "found_changes": of,
         "is_withdrawn": gone}
        for seed, score, of, gone in [(0, 9.0, "1", False), (1, 5.0, "1", True), (2, 1.0, "", False)]
    ]  # fmt: skip
    every = tables(rows, regions=found)
    row, budgets = the_row(every["regions_table"], "in"), every["budgets"]
    # what was withdrawn was looked at: budgets are of proposals
    assert set(budgets["recall"][(budgets["price"] == "spheres") & (budgets["site"] == "narrow")]) == {0.5}
    truth = pd.DataFrame([{**each, "id": 1, "is_observable": True, "n_truth_cells": 20} for each in rows])
    kept = ranked_pairs(pd.DataFrame(rows), pd.DataFrame(found), truth)
    for rate in (0.1, 0.5):
        name = f"recall_at_{rate}"
        assert (row[name], row[f"{name}_proposed"]) == (0.25, 0.5)
        assert (row[f"{name}_low"], row[f"{name}_high"]) == interval_of(resampled_recalls(kept, rate))
    alone = the_row(tables(rows[:1])["regions_table"], "in")
    assert alone["recall_at_0.1"] == 1.0
    assert np.isnan([alone[f"recall_at_{rate}_{end}"] for rate in (0.1, 0.5) for end in ("low", "high")]).all()


def test_the_free_response_of_each_domain_and_method() -> None:
    froc = tables([changed("narrow", 1), changed("cave", 1), changed("narrow", 1, "c2c")])["froc"]
    curves = {
        names: own[["false_regions_per_100m", "recall"]].to_numpy().tolist()
        for names, own in froc.groupby(["domain", "variant"])
    }
    # the candidates of `tunnelcd` alone find something
    every, none = [[0.0, 1.0]], [[0.0, 0.0]]
    assert curves == {
        ("in", "tunnelcd"): every, ("out", "tunnelcd"): every, ("all", "tunnelcd"): every,
        ("in", "c2c"): none, ("all", "c2c"): none,
    }  # fmt: skip


def test_every_method_is_in_every_table_in_the_order_of_the_rows() -> None:
    rows = [changed(family, 1, variant) for variant in ("tunnelcd", "paper", "c2c") for family in ("narrow", "cave")]
    keyframes = [
        {"scenario": row["scenario"], "seed": 1, "variant": row["variant"], "score": score, "label": score}
        for row in rows
        for score in (0, 1)
    ]
    found = tables(rows, keyframes=keyframes)
    expected = [(domain, name) for domain in ("in", "out", "all") for name in ("tunnelcd", "paper", "c2c")]
    for name in ("regions_table", "regions_by_size", "budgets", "roc", "froc"):
        rows_of = found[name][["domain", "variant"]].drop_duplicates()
        assert list(rows_of.itertuples(index=False, name=None)) == expected
        assert found[name].index.tolist() == list(range(len(found[name])))


def test_a_run_is_judged_unless_it_is_said_to_lack_pairs() -> None:
    items = dict.fromkeys(("changes", "regions", "keyframes"), pd.DataFrame(columns=["scenario", "seed", "variant"]))
    rows = pd.DataFrame([unchanged("narrow", seed, region_auroc=0.9) for seed in range(3)])
    items["keyframes"] = pd.DataFrame(columns=["scenario", "seed", "variant", "label", "score"])
    assert the_target(region_tables(rows, items, TARGETS)["regions_targets"], "AUROC", "in")["is_met"] is True


def test_budgets_of_all_sites_and_of_each_kind() -> None:
    rows = [changed("regions/narrow", 1), changed("null/narrow", 2), changed("regions/wide", 1, after_path_m=100.0)]
    budgets = tables(rows)["budgets"]
    assert list(budgets["site"].unique()) == ["all", "narrow", "wide"]
    of_site = {site: own.drop(columns="site").reset_index(drop=True) for site, own in budgets.groupby("site")}
    assert {site: set(own["n_changes"]) for site, own in of_site.items()} == {"all": {3}, "narrow": {2}, "wide": {1}}
    # each kind of site has the budgets that it has alone
    for site, own in (("narrow", rows[:2]), ("wide", rows[2:])):
        alone = tables(own)["budgets"]
        alone = alone[alone["site"] == "all"].drop(columns="site").reset_index(drop=True)
        pd.testing.assert_frame_equal(of_site[site], alone)
    # the last part of a name counts
    deeper = tables([changed("own/null/narrow", 1), changed("mine/narrow", 1)])["budgets"]
    assert list(deeper["site"].unique()) == ["all", "narrow"]
    # rows that name no family are told apart by their world
    nameless = [{name: value for name, value in row.items() if name != "family"} for row in rows]
    names = ["all", "regions/narrow", "null/narrow", "regions/wide"]
    assert list(tables(nameless)["budgets"]["site"].unique()) == names


def test_budgets_of_bytes_are_of_what_candidates_ask_for() -> None:
    names = {"scenario": "narrow", "seed": 1, "variant": "tunnelcd", "is_withdrawn": False}
    found = [{**names, "score": 1.0, "found_changes": "1", "asked_points": 10.0, "radius_m": 4.5}]
    budgets = tables([changed("narrow", 1)], regions=found)["budgets"]
    of_bytes = budgets[(budgets["price"] == "bytes") & (budgets["site"] == "all")].set_index("budget")
    # of 1,000 bytes of map 100 are kept, and ten points of 12 bytes are asked for
    assert of_bytes.loc[[0.2, 0.5], "recall"].tolist() == [0.0, 1.0]
    assert of_bytes["asked_share"].to_numpy() == pytest.approx(0.12)


def test_the_overview_shows_each_number_under_its_heading() -> None:
    rows = [
        changed("narrow", seed, region_auroc=0.5 + seed / 10, region_recall=seed / 4, region_recall_at_k=seed / 5,
                region_precision=seed / 6, n_false_regions=seed, bytes_regions_before=50.0, t_cd_per_region_s=0.2)
        for seed in range(1, 4)
    ]  # fmt: skip
    rows += [unchanged("narrow", 9), unchanged("narrow", 10, alarm=1.0), changed("cave", 1)]
    table = tables(rows)["regions_table"]
    overview, row = region_overview(table).iloc[0], table.iloc[0]
    headings = {
        "domain": "domain", "variant": "variant", "n": "n_pairs", "failed": "n_failed", "auroc": "region_auroc",
        "low": "region_auroc_low", "high": "region_auroc_high", "pooled": "region_auroc_pooled",
        "recall_at_k": "region_recall_at_k", "recall": "region_recall", "precision": "region_precision",
        "false/100m": "false_regions_per_100m", "recall@0.1": "recall_at_0.1", "low ": "recall_at_0.1_low",
        "high ": "recall_at_0.1_high", "silent": "silent_share", "of": "n_unchanged", "km": "km_unchanged",
        "bytes 1/": "bytes_ratio", "t_desc/kf": "t_descriptor_per_keyframe_s", "t_cd/region": "t_cd_per_region_s",
    }  # fmt: skip
    assert list(overview.index) == list(headings)
    for heading, column in headings.items():
        assert overview[heading] == row[column] or np.isnan([overview[heading], row[column]]).all()
