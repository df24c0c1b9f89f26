"""Detection limits and the table of displacement fields, worked out by hand."""

import numpy as np
import pandas as pd
import pytest

from eval.plans.targets import Targets
from eval.tables.surface.limits import EDGES_M, detection_limits, find_threshold, interpolate_limit
from eval.tables.surface.table import FILES, surface_tables

NAN = float("nan")


def window(true_m: float, answered_m: float, seed: int = 1, area_m2: float = 1.0, cover: float = 1.0) -> dict:
    return {
        "scenario": "surface/heave", "seed": seed, "variant": "ours", "area_m2": area_m2, "is_null": true_m == 0.0,
        "true_m": true_m, "answered_m": answered_m, "cover": cover,
    }  # fmt: skip


def null_windows(n: int = 21) -> list[dict]:
    """Answered 0 to 20 mm, so that the 95th percentile is 19 mm."""
    return [window(0.0, 0.001 * k * (-1) ** k, seed=k) for k in range(n)]


def test_limits_by_hand() -> None:
    rows = null_windows()
    rows += [window(0.02, value, seed) for seed, value in enumerate((0.0189, 0.0191, 0.018, -0.03))]
    rows += [window(0.04, value, seed) for seed, value in enumerate((0.03, 0.03, 0.03, 0.0))]
    low, high = detection_limits(pd.DataFrame(rows))
    assert low["threshold_m"] == pytest.approx(0.019)
    assert (low["n_null_windows"], low["n_windows"], high["n_windows"]) == (21, 4, 4)
    # the fourth has the wrong sign
    assert (low["found_share"], high["found_share"]) == (0.25, 0.75)
    # a half lies midway between a quarter and three quarters
    assert low["limit_m"] == high["limit_m"] == pytest.approx(np.sqrt(0.02 * 0.04))
    assert 0.0 <= low["found_share_low"] <= 0.25 <= low["found_share_high"] <= 1.0


def test_bins_hold_every_magnitude_from_the_least_edge_on_once() -> None:
    values = np.geomspace(EDGES_M[0], 4.9, 200)
    found = detection_limits(pd.DataFrame([*null_windows(), *(window(-value, -value) for value in values)]))
    assert sum(row["n_windows"] for row in found) == 200
    assert all(row["from_m"] <= row["magnitude_m"] < row["to_m"] for row in found)


def test_areas_have_thresholds_of_their_own() -> None:
    quiet = [{**row, "area_m2": 16.0, "answered_m": row["answered_m"] / 10} for row in null_windows()]
    rows = [*null_windows(), *quiet, window(0.01, 0.01), window(0.01, 0.01, area_m2=16.0)]
    small, large = detection_limits(pd.DataFrame(rows))
    assert (small["found_share"], large["found_share"]) == (0.0, 1.0)
    assert (small["limit_m"], large["limit_m"]) == pytest.approx((NAN, 0.01), nan_ok=True)


def test_null_windows_that_are_not_covered_lower_no_threshold() -> None:
    left_out = [window(0.0, 0.0, seed=k, cover=0.0) for k in range(500)]
    rows = [*null_windows(), window(0.02, 0.0185)]
    for each in (rows, [*rows, *left_out]):
        (row,) = detection_limits(pd.DataFrame(each))
        assert (row["threshold_m"], row["found_share"]) == (pytest.approx(0.019), 0.0)
    (row,) = detection_limits(pd.DataFrame([*left_out, window(0.02, 0.5)]))
    assert np.isnan(row["threshold_m"])
    assert row["found_share"] == 0.0


def test_the_threshold_rises_where_more_than_15_percent_of_all_null_windows_are_beyond_it() -> None:
    covered, none = np.full(20, 0.01), np.zeros(0)
    # 3 of 20 are 15 %, and equal but for rounding is not beyond
    assert find_threshold(covered, none, np.array([0.01 + 1e-10] * 17 + [0.02] * 3)) == pytest.approx((0.01, 0.15))
    raised, share = find_threshold(covered, none, np.array([0.01] * 16 + [0.02] * 4))
    assert (raised, share) == pytest.approx((0.02, 0.0))
    raised, share = find_threshold(covered, none, np.array([0.0] * 30 + [0.02] * 9 + [0.03] * 2))
    assert (raised, share) == pytest.approx((0.02, 2 / 41))
    assert np.isnan(find_threshold(none, np.full(20, 0.01), np.ones(20))).all()


def test_the_threshold_is_the_larger_one_of_those_by_either_kind_of_null_window() -> None:
    null, loud = np.linspace(0.0, 0.02, 21), np.linspace(0.0, 0.04, 21)
    everything = np.concatenate([null, loud])
    assert find_threshold(null, loud, everything) == pytest.approx((0.038, 1 / 42))
    assert find_threshold(loud, null, everything) == pytest.approx((0.038, 1 / 42))
    assert find_threshold(null, loud[1:], np.zeros(40))[0] == pytest.approx(0.0381)
    assert find_threshold(null, loud[2:], np.zeros(40))[0] == pytest.approx(0.019)  # 19 are too few


def test_a_window_is_covered_from_one_half_on_and_found_beyond_rounding_in_one_bin() -> None:
    half = [{**row, "cover": 0.5} for row in null_windows()]
    edge_m, threshold_m = EDGES_M[1], 0.019
    answers = (threshold_m + 2e-9, threshold_m + 0.5e-9, threshold_m, threshold_m - 0.5e-9)
    (row,) = detection_limits(pd.DataFrame([*half, *(window(edge_m, each) for each in answers)]))
    assert (row["threshold_m"], row["n_null_windows"]) == (pytest.approx(threshold_m), 21)
    assert (row["from_m"], row["n_windows"], row["found_share"]) == (edge_m, 4, 0.25)


def test_windows_of_checks_count_as_false_alarms_and_few_of_them_set_no_threshold() -> None:
    checks = [{**window(0.0, 0.5, seed=k), "is_check": True} for k in range(3)]
    rows = [{**row, "is_check": False} for row in (*null_windows(), window(0.02, 0.0195), window(0.02, 0.0191))]
    (row,) = detection_limits(pd.DataFrame([*rows, *checks]))
    # that of 20 mm and three more are 4 of 24 beyond 19 mm, 17 %: it rises
    assert (row["threshold_m"], row["n_null_windows"], row["false_share"]) == pytest.approx((0.5, 21, 0.0))
    assert (row["found_share"], row["n_check_windows"]) == (0.0, 3)
    (row,) = detection_limits(pd.DataFrame([*rows, *checks[:2]]))
    assert (row["threshold_m"], row["false_share"], row["found_share"]) == pytest.approx((0.019, 3 / 23, 1.0))
    # rows of an older run do not say so; of both together those that do count
    (row,) = detection_limits(pd.DataFrame([*null_windows(), window(0.02, 0.0195), *checks[:1]]))
    assert (row["threshold_m"], row["n_null_windows"]) == pytest.approx((0.019, 21))


def test_windows_of_checks_that_are_not_covered_lower_no_threshold() -> None:
    rows = [{**row, "is_check": False} for row in (*null_windows(), window(0.02, 0.03))]
    loud = [{**window(0.0, 0.002 * k, seed=k), "is_check": True} for k in range(21)]
    left_out = [{**window(0.0, 0.0, seed=k, cover=0.4), "is_check": True} for k in range(60)]
    (row,) = detection_limits(pd.DataFrame([*rows, *loud, *left_out]))
    assert (row["threshold_m"], row["n_check_windows"], row["found_share"]) == (pytest.approx(0.038), 21, 0.0)


@pytest.mark.parametrize("guessed_share", [0.08, 0.28, 0.5, 1.0])
def test_guesses_where_few_thresholds_come_from_do_not_pay(guessed_share: float) -> None:
    def judge(guessed_share: float) -> dict:
        n_guessed = round(50 * guessed_share)
        nulls = [{**window(0.0, 0.001 * (k % 8), seed=k), "is_check": False} for k in range(100)]
        checks = [
            {**window(0.0, 0.5 if k < n_guessed else 0.001 * (k % 8), seed=k), "is_check": True} for k in range(50)
        ]
        # 4 of 10 are found; of the others those at which it guesses with the right sign
        n_found = 4 + round(6 * guessed_share)
        moved = [{**window(0.02, 0.02 if k < n_found else 0.0, seed=k), "is_check": False} for k in range(10)]
        return detection_limits(pd.DataFrame([*nulls, *checks, *moved]))[0]

    honest, guessing = judge(0.0), judge(guessed_share)
    assert (honest["found_share"], honest["threshold_m"], honest["false_share"]) == pytest.approx((0.4, 0.007, 0.0))
    assert (guessing["found_share"], guessing["threshold_m"]) == pytest.approx((0.0, 0.5))


@pytest.mark.parametrize(
    ("shares", "limit_m"),
    [
        ([1.0, 1.0, 1.0], 0.01),
        ([0.0, 0.0, 0.4], NAN),
        ([0.0, 0.5, 1.0], 0.02),
        ([0.0, 0.5], 0.02),
        ([0.0, 1.0, 1.0], np.sqrt(0.01 * 0.02)),
        ([1.0, 0.0, 1.0], np.sqrt(0.02 * 0.04)),  # found by chance below what is missed
        ([], NAN),
    ],
)
def test_where_half_are_found(shares: list[float], limit_m: float) -> None:
    magnitudes = np.array([0.01, 0.02, 0.04])[: len(shares)]
    assert interpolate_limit(magnitudes, np.array(shares)) == pytest.approx(limit_m, nan_ok=True)


def case(seed: int, **columns: object) -> dict:
    return {
        "scenario": "surface/heave", "family": "surface/heave", "seed": seed, "variant": "ours", "status": "ok",
        "surface_cover": 1.0, "surface_recall": 1.0, "n_surface_changes": 3, "t_surface_s": 2.0, **columns,
    }  # fmt: skip


def test_a_pair_counts_though_its_rock_moved_too_little_to_be_observed() -> None:
    graft = {"scenario": "graft/mine", "family": "graft/mine"}
    results = pd.DataFrame([case(1, **graft), case(2, **graft, surface_cover=0.0, n_surface_changes=0)])
    (row,) = surface_tables(results, pd.DataFrame(null_windows()), Targets())["surface_table"].to_dict("records")
    assert (row["n_pairs"], row["surface_cover"]) == (2, 0.5)


def test_a_pair_without_an_answer_counts_and_a_pair_that_asks_nothing_does_not() -> None:
    results = pd.DataFrame(
        [
            case(1),
            case(2, status="merge_refused", surface_cover=0.0, surface_recall=0.0, t_surface_s=NAN),
            case(3, scenario="narrow", family="narrow", surface_cover=NAN, surface_recall=NAN, n_surface_changes=NAN),
        ]
    )
    windows = pd.DataFrame([*null_windows(), window(0.04, 0.03, seed=1)])
    found = surface_tables(results, windows, Targets())
    assert tuple(found) == FILES
    (row,) = found["surface_table"].to_dict("records")
    assert (row["domain"], row["n_pairs"], row["n_failed"], row["n_surface_changes"]) == ("in", 2, 1, 6)
    assert (row["surface_cover"], row["surface_recall"], row["t_surface_s"]) == (0.5, 0.5, 2.0)
    assert row["surface_recall_low"] <= 0.5 <= row["surface_recall_high"]
    # of the windows only those of its pairs count: null ones of seeds 1 and 2
    (limit,) = found["detection_limits"].to_dict("records")
    assert (limit["n_null_windows"], row["surface_limit_1m2_m"]) == (2, 0.04)
    assert len(found["surface_targets"]) == 0
    nothing = surface_tables(results[2:], windows, Targets())
    assert all(len(table) == 0 for table in nothing.values())


def test_bounds_on_displacement_are_judged_once_the_run_is_whole() -> None:
    results = pd.DataFrame([case(1, surface_error_median_m=0.004), case(2, surface_error_median_m=0.008)])
    bound = {"column": "surface_error_median_m", "name": "error"}
    targets = Targets(method="ours", surface=({**bound, "at_most": 0.005}, {**bound, "at_most": 0.006}))
    windows = pd.DataFrame([*null_windows(), *(window(0.04, 0.03, seed=seed) for seed in (1, 2))])
    judged = surface_tables(results, windows, targets)["surface_targets"]
    assert list(judged["value"]) == pytest.approx([0.006, 0.006])
    assert list(judged["is_met"]) == [False, True]
    unfinished = surface_tables(results, windows, targets, is_whole=False)["surface_targets"]
    assert list(unfinished["is_met"]) == [None, None]


def test_a_field_of_zeros_meets_no_bound_on_errors() -> None:
    results = pd.DataFrame([case(1, surface_error_median_m=0.0), case(2, surface_error_median_m=0.0)])
    targets = Targets(method="ours", surface=({"column": "surface_error_median_m", "name": "e", "at_most": 0.005},))
    for answered_m, is_met in ((0.0, False), (0.03, True)):
        windows = pd.DataFrame([*null_windows(), *(window(0.04, answered_m, seed=seed) for seed in (1, 2))])
        (row,) = surface_tables(results, windows, targets)["surface_targets"].to_dict("records")
        assert row["is_met"] is is_met


def test_a_bound_may_be_on_another_odometry_and_on_what_is_less_than_a_rival() -> None:
    errors = {("ours", "kiss-icp"): 0.004, ("ours", "drift"): 0.002, ("c2c", "kiss-icp"): 0.01, ("c2c", "drift"): 0.001}
    results = pd.DataFrame(
        [
            case(seed, variant=variant, surface_error_median_m=error, odometry_before=name, odometry_after=name)
            for (variant, name), error in errors.items() for seed in (1, 2)
        ]
    )  # fmt: skip
    column = {"column": "surface_error_median_m", "at_most": 0}
    bounds = (
        {**column, "name": "less", "less": "c2c"},
        {**column, "name": "drift", "odometry": "drift"},
        {**column, "name": "both", "odometry": "drift", "less": "c2c"},
        {**column, "name": "no rival", "less": "c2m"},
    )
    windows = [*null_windows(), *(window(0.04, 0.03, seed=seed) for seed in (1, 2))]
    windows = [{**row, "variant": variant} for row in windows for variant in ("ours", "c2c")]
    targets = Targets(method="ours", odometry="kiss-icp", surface=bounds)
    judged = surface_tables(results, pd.DataFrame(windows), targets)["surface_targets"]
    assert list(judged["target"]) == ["less", "drift", "both"]
    assert list(judged["value"]) == pytest.approx([-0.006, 0.002, 0.001])
    assert list(judged["is_met"]) == [True, False, False]


def test_a_rival_without_a_limit_is_behind() -> None:
    results = pd.DataFrame([case(seed, variant=variant) for variant in ("ours", "c2c") for seed in (1, 2)])
    rows = [{**row, "variant": variant} for row in null_windows() for variant in ("ours", "c2c")]
    answered = {"ours": 0.03, "c2c": 0.0}
    rows += [{**window(0.04, value, seed), "variant": name} for name, value in answered.items() for seed in (1, 2)]
    bound = {"column": "surface_limit_1m2_m", "name": "limit", "at_most": 0}
    for method, rival, is_met in (("ours", "c2c", True), ("c2c", "ours", False)):
        targets = Targets(method=method, surface=({**bound, "less": rival},))
        (row,) = surface_tables(results, pd.DataFrame(rows), targets)["surface_targets"].to_dict("records")
        assert row["is_met"] is is_met
