"""Means, counts and intervals of a small results table, by hand and against their definitions."""

import numpy as np
import pandas as pd
import pytest

from cdpipe.core.geometry import stream
from cdpipe.core.ranking import auroc
from eval.core import statistics
from eval.core.statistics import bootstrap_interval, summarise

NAN = float("nan")


def results() -> pd.DataFrame:
    rows = [
        ("a", "x", 0, "paper", "ok", 1.0, NAN, 2.0, True),
        ("a", "x", 1, "paper", "ok", 0.5, 0.25, 4.0, False),
        ("a", "x", 2, "paper", "merge_refused", 0.0, NAN, NAN, NAN),
        ("b", "x", 0, "paper", "ok", 0.75, NAN, 30.0, NAN),
        ("a", "x", 0, "ours", "ok", 1.0, 1.0, 1.0, False),
        ("a", "x", 1, "ours", "ok", 0.75, 1.0, 1.0, False),
        ("a", "x", 2, "ours", "ok", 0.5, 1.0, 1.0, False),
    ]
    names = ["scenario", "family", "seed", "variant", "status"]
    frame = pd.DataFrame(rows, columns=[*names, "region_recall", "region_precision", "t_total_s", "is_alarm"])
    return frame.assign(preset=frame["variant"], error="", metrics_version=1, score_radius_m=4.5)


def line(summary: pd.DataFrame, group: str, variant: str, metric: str) -> pd.Series:
    of_group = summary[(summary.iloc[:, 0] == group) & (summary["variant"] == variant) & (summary["metric"] == metric)]
    assert len(of_group) == 1
    return of_group.iloc[0]


def test_values_and_counts_by_hand() -> None:
    summary = summarise(results())
    recall = line(summary, "a", "paper", "region_recall")
    assert (recall["value"], recall["value_ok"]) == (0.5, 0.75)
    assert tuple(recall[["n", "n_failed", "n_used", "n_used_ok"]]) == (3, 1, 3, 2)
    precision = line(summary, "a", "paper", "region_precision")
    assert (precision["value"], precision["n"], precision["n_used"]) == (0.25, 3, 1)
    assert np.isnan(precision["low"])
    time = line(summary, "a", "paper", "t_total_s")
    assert (time["statistic"], time["value"], time["n_used"]) == ("median", 3.0, 2)
    # a refused pair is neither silent nor an alarm
    assert tuple(line(summary, "a", "paper", "is_alarm")[["value", "n_used"]]) == (0.5, 2)
    undefined = line(summary, "b", "paper", "region_precision")
    assert np.isnan(undefined["value"])
    assert undefined["n_used"] == 0
    assert set(summary["metric"]) == {"region_recall", "region_precision", "t_total_s", "is_alarm"}


def test_a_family_takes_all_its_scenarios_together() -> None:
    recall = line(summarise(results(), by="family"), "x", "paper", "region_recall")
    assert (recall["value"], recall["n"]) == ((1.0 + 0.5 + 0.0 + 0.75) / 4, 4)


def test_other_variants_change_no_interval() -> None:
    draw = stream(0, "summary")
    frame = pd.DataFrame({"scenario": "a", "variant": ["p"] * 20 + ["q"] * 20, "status": "ok", "m": draw.random(40)})
    alone = line(summarise(frame[frame["variant"] == "q"]), "a", "q", "m")
    together = line(summarise(frame), "a", "q", "m")
    assert tuple(alone[["low", "high"]]) == tuple(together[["low", "high"]])


def test_the_interval_of_the_mean_is_near_its_closed_form() -> None:
    # a sample of 400 with standard deviation 1: the mean is known to 1.96 / sqrt(400)
    values = stream(1, "normal").standard_normal(400)
    values = (values - values.mean()) / values.std()
    low, high = bootstrap_interval(values)
    assert low == pytest.approx(-0.098, abs=0.006)
    assert high == pytest.approx(0.098, abs=0.006)


def test_the_interval_leaves_nan_out_after_drawing() -> None:
    values = np.array([1.0, NAN, 3.0, NAN, 5.0])
    low, high = bootstrap_interval(values)
    assert 1.0 <= low < 3.0 < high <= 5.0
    assert bootstrap_interval(np.array([2.0, NAN, 2.0])) == (2.0, 2.0)
    assert bootstrap_interval(np.array([1.0, 2.0, 9.0]), "median")[1] == 9.0
    for few in ([], [1.0], [1.0, NAN]):
        assert np.isnan(bootstrap_interval(np.array(few))).all()


def test_the_interval_is_that_of_the_seed() -> None:
    values = stream(2, "values").random(12)
    assert bootstrap_interval(values, seed=4) == bootstrap_interval(values, seed=4)
    assert bootstrap_interval(values, seed=4) != bootstrap_interval(values, seed=5)


def test_pooled_ranking_is_that_of_all_keyframes_together() -> None:
    draw = stream(3, "pooled")
    n = 60
    keyframes = pd.DataFrame(
        {
            "scenario": "a",
            "seed": draw.integers(0, 3, n),
            "variant": "paper",
            "score": draw.random(n),
            "label": draw.integers(-1, 2, n),
        }
    )
    pooled = line(summarise(results(), keyframes=keyframes), "a", "paper", "region_auroc_pooled")
    used = keyframes[keyframes["label"] >= 0]
    assert pooled["value"] == auroc(used["score"].to_numpy(), used["label"].to_numpy() == 1)
    assert (pooled["statistic"], pooled["n_used"]) == ("pooled", 3)


def test_pooled_ranking_of_the_cases_that_are_ok_is_of_their_keyframes_alone() -> None:
    one = {"scenario": "a", "variant": "paper"}
    keyframes = pd.DataFrame(
        [one | {"seed": 0, "score": float(n), "label": n} for n in (0, 1)]
        + [one | {"seed": 1, "score": 0.0, "label": n} for n in (0, 1)]
    )
    cases = pd.DataFrame([one | {"seed": 0, "status": "ok"}, one | {"seed": 1, "status": "merge_refused"}])
    pooled = line(summarise(cases, keyframes=keyframes), "a", "paper", "region_auroc_pooled")
    assert (pooled["value"], pooled["value_ok"]) == (0.75, 1.0)
    assert (pooled["n_used"], pooled["n_used_ok"]) == (2, 1)


def test_the_interval_of_many_pairs_is_that_of_gathered_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(1).normal(size=300)
    for has_nan in (False, True):
        values[:40] = np.nan if has_nan else values[:40]
        gathered = statistics.bootstrap_interval(values)
        with monkeypatch.context() as patch:
            patch.setattr(statistics, "MANY_PAIRS", 100)
            np.testing.assert_allclose(statistics.bootstrap_interval(values), gathered, rtol=1e-12)
