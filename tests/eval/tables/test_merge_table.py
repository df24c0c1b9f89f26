"""What a run says about its merges, worked out by hand."""

import itertools

import numpy as np
import pandas as pd
import pytest

from eval.core.statistics import wilson_interval
from eval.plans.targets import Targets
from eval.tables.merge_table import ALL_FAMILIES, is_within_target, is_wrong, merge_overview, merge_table

NAN = float("nan")
SEEDS = itertools.count(1)
TARGETS = Targets(merge={"clean": 0.99, "drift": 0.95, "smooth": 1.0, "disjoint": 1.0})
SLIDES = "the sessions cannot be merged: it can slide; merge.min_hessian_ratio asks for 0.01"
UNLIKE = "the sessions cannot be merged: it does not fit; merge.min_agreement asks for 80%"


def case(
    kind: str, status: str = "ok", metres: float = NAN, degrees: float = 0.1, p95: float = NAN, **columns: object
) -> dict[str, object]:
    merged = status == "ok" and not np.isnan(metres)
    return {
        "scenario": f"merge/{columns.get('family', 'narrow')}",
        "family": "narrow",
        "seed": next(SEEDS),
        "variant": "ours",
        "status": status,
        "error": "",
        "pair_kind": kind,
        "merge_error_m": metres,
        "merge_error_deg": degrees if merged else NAN,
        "merge_error_along_m": metres / 2,
        "merge_error_m_p95": metres if np.isnan(p95) else p95,
        "t_merge_s": 0.04 if status == "ok" else NAN,
        **columns,
    }


def the_row(rows: list[dict[str, object]], kind: str, family: str = ALL_FAMILIES) -> dict[str, object]:
    table = merge_table(pd.DataFrame(rows), TARGETS)
    found = table[(table["pair_kind"] == kind) & (table["family"] == family)]
    assert len(found) == 1
    return found.iloc[0].to_dict()


def test_clean_pairs_by_hand() -> None:
    row = the_row(
        [
            case("clean", metres=0.01),
            case("clean", metres=0.05, degrees=0.3),  # just within
            case("clean", metres=0.051),  # not exact, but not wrong
            case("clean", metres=0.02, degrees=0.31),
            case("clean", metres=0.02, degrees=2.5),  # wrong in rotation alone
            case("clean", metres=30.0),
            case("clean", "merge_refused", error=UNLIKE),
            case("clean", "failed", error="no scans"),
        ],
        "clean",
    )
    counts = {name: row[name] for name in ("n_pairs", "n_accepted", "n_refused", "n_failed", "n_within_target")}
    assert counts == {"n_pairs": 8, "n_accepted": 6, "n_refused": 1, "n_failed": 1, "n_within_target": 2}
    assert row["share_within_target"] == 0.25
    assert (row["low"], row["high"]) == wilson_interval(2, 8)
    assert row["n_wrong_accepted"] == 2
    assert row["is_met"] is False
    # the accepted ones: 0.01, 0.02, 0.02, 0.05, 0.051, 30
    assert row["median_merge_error_m"] == pytest.approx(0.035)
    assert row["p95_merge_error_m"] == pytest.approx(0.051 + 0.75 * (30 - 0.051))
    assert (row["n_merge_error_m"], row["n_t_merge_s"], row["n_t_refine_s"]) == (6, 6, 0)
    assert np.isnan(row["median_t_refine_s"])


def test_ninety_nine_of_a_hundred_meet_the_target_unless_the_other_is_wrong_and_accepted() -> None:
    right = [case("clean", metres=0.01) for _ in range(99)]
    assert the_row([*right, case("clean", "merge_refused")], "clean")["is_met"] is True
    assert the_row([*right, case("clean", metres=0.2)], "clean")["is_met"] is True
    assert the_row([*right, case("clean", metres=0.6)], "clean")["is_met"] is False
    assert the_row([*right[1:], *[case("clean", "failed")] * 2], "clean")["is_met"] is False


def test_without_a_target_there_is_no_verdict_and_the_share_stays() -> None:
    table = merge_table(pd.DataFrame([case("clean", metres=0.01)]), Targets())
    assert (table["is_met"][0], table["share_within_target"][0]) == (None, 1.0)
    assert np.isnan(table["target_share"][0])


def test_drift_is_judged_along_the_path() -> None:
    rows = [case("drift", metres=0.02, p95=0.05), case("drift", metres=0.02, p95=0.06), case("drift", "merge_refused")]
    row = the_row(rows, "drift")
    assert (row["n_within_target"], row["n_wrong_accepted"], row["n_pairs"]) == (1, 0, 3)
    assert row["median_merge_error_m_p95"] == pytest.approx(0.055)


def test_smooth_may_be_refused_for_sliding_or_be_right() -> None:
    rows = [
        case("smooth", "merge_refused", error=SLIDES),
        case("smooth", "merge_refused", error=UNLIKE),
        case("smooth", metres=0.5, degrees=2.0),
        case("smooth", metres=0.51),
        case("smooth", "failed", error=SLIDES),
    ]
    row = the_row(rows, "smooth")
    assert is_within_target(pd.DataFrame(rows)).tolist() == [True, False, True, False, False]
    assert (row["n_within_target"], row["n_wrong_accepted"], row["n_named_degeneracy"]) == (2, 1, 1)


def test_a_merge_by_the_truth_has_a_row_and_no_verdict() -> None:
    rows = [case("clean", metres=0.01, variant=f"oracle-merge{noise}") for noise in ("", "[noise_m=0.1,noise_deg=0]")]
    rows.append(case("clean", metres=0.01))
    table = merge_table(pd.DataFrame(rows), TARGETS)
    assert table["is_met"].tolist() == [None, None, True] * 2
    assert table["target_share"].isna().tolist() == [True, True, False] * 2
    assert table["n_within_target"].tolist() == [1] * 6
    shown = merge_overview(pd.DataFrame(rows), TARGETS)
    assert shown["met"].tolist() == [None, None, True]
    assert merge_overview(pd.DataFrame(rows), TARGETS, is_whole=False)["met"].tolist() == [None] * 3


def test_accepted_pairs_that_are_off_somewhere_along_the_path_are_counted() -> None:
    rows = [
        case("drift", metres=0.02, p95=0.5),
        case("drift", metres=0.02, p95=0.51),
        case("drift", metres=2.0, p95=3.0),
        case("drift", "merge_refused", p95=9.0),
        case("drift"),
    ]
    assert the_row(rows, "drift")["n_p95_over_half_m"] == 2


def test_whoever_accepts_where_nothing_is_shared_is_wrong() -> None:
    rows = [
        case("disjoint", "merge_refused", error=UNLIKE),
        case("disjoint"),  # accepted: its error is undefined
        case("disjoint", metres=0.01),  # even if a number came out
        case("disjoint", "failed"),
        case("clean"),  # accepted without a place in common
    ]
    assert is_wrong(pd.DataFrame(rows)).tolist() == [False, True, True, False, True]
    row = the_row(rows, "disjoint")
    assert (row["n_pairs"], row["n_within_target"], row["n_wrong_accepted"], row["is_met"]) == (4, 1, 2, False)
    assert the_row(rows[:1], "disjoint")["is_met"] is True


def test_every_family_and_variant_has_its_row_and_no_pair_is_lost() -> None:
    rows = [
        *[case("disjoint", "merge_refused", family="wide", seed=seed) for seed in range(3)],
        *[case("clean", metres=0.01, family=name, seed=seed) for name in ("narrow", "wide") for seed in range(2)],
        case("clean", "failed", family="wide", seed=9),
        case("clean", metres=0.01, family="wide", variant="theirs"),
        case("", metres=9.0),
    ]
    table = merge_table(pd.DataFrame(rows), TARGETS)
    found = [tuple(row) for row in table[["pair_kind", "family", "variant", "n_pairs"]].itertuples(index=False)]
    assert found == [
        ("clean", "all", "ours", 5),
        ("clean", "all", "theirs", 1),
        ("clean", "narrow", "ours", 2),
        ("clean", "wide", "ours", 3),
        ("clean", "wide", "theirs", 1),
        ("disjoint", "all", "ours", 3),
        ("disjoint", "wide", "ours", 3),
    ]
    assert (table["n_accepted"] + table["n_refused"] + table["n_failed"] == table["n_pairs"]).all()
    assert merge_overview(pd.DataFrame(rows), TARGETS)["n"].tolist() == [5, 1, 3]


def test_the_order_of_the_rows_changes_no_number() -> None:
    draw = np.random.default_rng(0)
    rows = [
        case(kind, metres=float(draw.uniform(0, 0.1)), seed=seed)
        for kind in ("clean", "drift", "smooth")
        for seed in range(7)
    ]
    results = pd.DataFrame(rows)
    shuffled = results.iloc[draw.permutation(len(results))]
    pd.testing.assert_frame_equal(merge_table(results, TARGETS), merge_table(shuffled, TARGETS))


def test_a_run_without_kinds_has_no_row(tmp_path: object) -> None:
    for rows in ([case("", metres=0.1)], [{"scenario": "a", "variant": "b", "status": "ok"}]):
        assert len(merge_table(pd.DataFrame(rows), TARGETS)) == 0
        assert len(merge_overview(pd.DataFrame(rows), TARGETS)) == 0


@pytest.mark.parametrize(("n_hits", "n"), [(0, 10), (3, 7), (20, 20), (59, 60), (1, 1)])
def test_wilson_ends_are_where_the_score_test_turns(n_hits: int, n: int) -> None:
    share = n_hits / n
    for end in wilson_interval(n_hits, n):
        # |share - end| is 1.96 standard errors of `end`, but where the interval stops at 0 or 1
        assert abs(share - end) == pytest.approx(1.959964 * np.sqrt(end * (1 - end) / n), abs=1e-6)


def test_wilson_by_hand_and_of_nothing() -> None:
    # 20 of 20: 1 / (1 + 1.96^2 / 20)
    assert wilson_interval(20, 20) == pytest.approx((0.83887, 1.0), abs=1e-5)
    assert all(np.isnan(wilson_interval(0, 0)))


def test_a_world_that_was_not_made_asks_nothing_of_a_merge() -> None:
    rows = [case("clean", metres=0.01, n_observable=2) for _ in range(60)]
    row = the_row([*rows, case("clean", "failed", error="no place for a prop", n_observable=NAN)], "clean")
    assert (row["n_pairs"], row["n_failed"], row["share_within_target"], row["is_met"]) == (60, 0, 1.0, True)


def test_pairs_of_one_tunnel_make_no_narrower_interval() -> None:
    rows = [case("clean", metres=0.01, seed=seed) for seed in (1, 2, 3)]
    twins = [{**row, "scenario": f"merge/narrow[sensor.sub_rays={n}]"} for row in rows for n in (1, 7)]
    row = the_row(twins, "clean")
    assert (row["n_pairs"], row["low"], row["high"]) == (6, *wilson_interval(3, 3))
