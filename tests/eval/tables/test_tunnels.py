"""Pairs of one tunnel are drawn together."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from eval.core.statistics import mean_with_interval, paired_difference
from eval.report.comparing.columns import COMPARED
from eval.report.summary import means_by_method
from eval.tables.regions.curves import ranked_pairs, resampled_recalls
from eval.tables.rows import count_failed, means_with_intervals, tunnel_numbers, with_domain

TWINS = ("narrow", "dust/narrow", "dust/mist", "narrow[sensor.sub_rays=1]")


def test_worlds_that_differ_by_one_effect_or_by_settings_share_a_tunnel() -> None:
    worlds = [*TWINS, "wide", "dust/wide", "narrow", "nobody/knows"]
    assert tunnel_numbers(worlds, [5] * 6 + [6, 5]).tolist() == [0, 0, 0, 0, 1, 1, 2, 3]


def test_families_without_a_tunnel_of_their_own_have_that_of_the_extended_one() -> None:
    narrow = ["narrow", "odometry/legged", "null/narrow", "glare/null", "drift/narrow", "train/mine", "water/null"]
    others = ["surface/heave", "surface/null", "surface/wide", "disjoint/narrow", "tight", "train/gallery"]
    assert tunnel_numbers([*narrow, *others], [5] * 13).tolist() == [0] * 7 + [1, 1, 2, 3, 4, 5]


def test_twins_do_not_narrow_an_interval() -> None:
    values = {3: 0.2, 4: 0.5, 7: 0.9}
    rows = [{"scenario": world, "seed": seed, "x": value} for world in TWINS for seed, value in values.items()]
    found = means_with_intervals(pd.DataFrame(rows), ["x"])
    mean, low, high, _ = mean_with_interval(np.array(list(values.values())))
    assert (found["x"], found["x_low"], found["x_high"]) == pytest.approx((mean, low, high))
    a, b = np.zeros(12), np.tile(list(values.values()), 4)
    row = paired_difference(a, b, tunnels=np.tile([0, 1, 2], 4))
    assert (row["n_used"], row["n_tunnels"], row["low"], row["high"]) == pytest.approx((12, 3, low, high))


def test_a_world_that_was_not_made_failed_at_nothing() -> None:
    rows = pd.DataFrame({"status": ["ok", "failed", "merge_refused", "failed"], "n_observable": [1, np.nan, 2, 0]})
    assert count_failed(rows) == 2


def test_twins_are_drawn_together_in_pooled_recall() -> None:
    def drawn(worlds: tuple[str, ...]) -> np.ndarray:
        pairs = [{"scenario": world, "seed": seed} for world in worlds for seed in (3, 4, 7)]
        one = {"variant": "ours", "family": "narrow", "score_radius_m": 4.5, "status": "ok", "after_path_m": 1000.0}
        cases = pd.DataFrame([pair | one | {"n_observable": 1} for pair in pairs])
        regions = pd.DataFrame(
            [pair | {"score": 1.0, "found_changes": "1", "is_withdrawn": False} for pair in pairs if pair["seed"] != 7]
        )
        change = {"id": 1, "is_observable": True, "n_truth_cells": 20, "is_found": True}
        ranked = ranked_pairs(cases, regions, pd.DataFrame([pair | change for pair in pairs]))
        assert ranked.has_interval
        return resampled_recalls(ranked, 0.1)

    np.testing.assert_array_equal(drawn(("narrow",)), drawn(TWINS))


def test_the_headline_of_a_page_draws_tunnels() -> None:
    values = {3: 0.2, 4: 0.5, 7: 0.9}
    rows = [
        {"scenario": world, "family": "narrow", "seed": seed, "variant": "ours", "status": "ok", "region_recall": value}
        for world in TWINS for seed, value in values.items()
    ]  # fmt: skip
    column = next(column for column in COMPARED if column.key == "region_recall")
    (row,) = means_by_method(with_domain(rows), [column]).query("domain == 'in'").to_dict("records")
    _, low, high, _ = mean_with_interval(np.array(list(values.values())))
    assert (row["region_recall_low"], row["region_recall_high"]) == pytest.approx((low, high))
