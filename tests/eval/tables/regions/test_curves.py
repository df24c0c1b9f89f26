"""Free response, ROC and recall by size, worked out by hand and against a slow twin."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.ranking import auroc
from eval.core.statistics import clustered_interval, interval_of
from eval.tables.groups import recall_by_size
from eval.tables.regions import curves
from eval.tables.regions.curves import (
    RankedPairs,
    found_at,
    free_response,
    parsed_ids,
    ranked_pairs,
    recall_at,
    resampled_recalls,
    roc_curve,
)

CASES = [  # seed, kind of site, status, way, observable changes
    (1, 4.5, "ok", 1000.0, 2),
    (2, 4.5, "ok", 2000.0, 0),
    (3, 4.5, "merge_refused", 100.0, 1),
    (4, 10.0, "ok", 500.0, 1),
]
CANDIDATES = [  # seed, score, what it finds
    (1, 9.0, "1"), (1, 8.0, ""), (1, 7.0, "1;2"), (1, 6.0, "3"), (2, 8.5, ""), (4, 300.0, ""), (4, 200.0, "1"),
]  # fmt: skip
CHANGES = [  # seed, id, observable, cells, reported, hull, returns
    (1, 1, True, 20, True, 0.2, 50),
    (1, 2, True, 20, False, 2.0, 500),
    (1, 3, False, 5, False, 0.2, 5),
    (3, 1, True, 20, False, 0.2, 50),
    (4, 1, True, 20, True, 2.0, 5000),
]


def results(cases: Sequence[tuple[object, ...]] = CASES) -> pd.DataFrame:
    columns = ["seed", "score_radius_m", "status", "after_path_m", "n_observable"]
    return pd.DataFrame(cases, columns=columns).assign(scenario="a", variant="ours", family="narrow")


def regions(rows: Sequence[tuple[object, ...]] = CANDIDATES) -> pd.DataFrame:
    names = {"scenario": "a", "variant": "ours", "is_withdrawn": False}
    return pd.DataFrame(rows, columns=["seed", "score", "found_changes"]).assign(**names)


def changes(rows: Sequence[tuple[object, ...]] = CHANGES) -> pd.DataFrame:
    columns = ["seed", "id", "is_observable", "n_truth_cells", "is_found", "hull_volume_m3", "n_returns"]
    return pd.DataFrame(rows, columns=columns).assign(scenario="a", variant="ours")


def by_hand() -> RankedPairs:
    return ranked_pairs(results(), regions(), changes())


def test_the_free_response_by_hand() -> None:
    # narrow: 3.1 km, so 3 false regions at 0.1 per 100 m; the refused pair counts as 1 there (10 times the 0.1 of its
    # 100 m), as 1 below and as 2 at 0.2; false regions at 8.5 and 8, changes at 9 and 7. Wide: 500 m, a false one at
    # 300 (0.2 per 100 m) before the change at 200. The refused pair's change is never found: four in all
    rates, recall = free_response(by_hand())
    np.testing.assert_allclose(rates, [0.0, 0.04, 0.1, 0.2])
    np.testing.assert_allclose(recall, [0.0, 1 / 4, 2 / 4, 3 / 4])
    found = {rate: recall_at(by_hand(), rate) for rate in (0.0, 0.032, 0.033, 0.096, 0.097, 0.1, 0.199, 0.2, 5.0)}
    assert list(found.values()) == [0.0, 0.0, 0.25, 0.25, 0.5, 0.5, 0.5, 0.75, 0.75]


def test_a_pair_with_too_many_false_regions_is_lost() -> None:
    # 100 m, 0.1 allowed per 100 m: more than one false region is lost, and counts as one. At 6 both changes of pair 2
    # would be found, but three false regions of pair 1 count as one, and its change as missed
    cases = [(1, 4.5, "ok", 100.0, 1), (2, 4.5, "ok", 900.0, 2)]
    rows = [(1, 9.0, "1"), (1, 8.0, ""), (2, 7.5, "1"), (1, 7.0, ""), (1, 6.5, ""), (2, 6.0, "2")]
    truth = [(seed, each, True, 20, False, 1.0, 10) for seed, each in ((1, 1), (2, 1), (2, 2))]
    ranked = ranked_pairs(results(cases), regions(rows), changes(truth))
    assert recall_at(ranked, 0.1) == 2 / 3
    assert recall_at(ranked, 0.099) == 1 / 3  # 0.99 allowed
    assert found_at(ranked, 0.099).tolist() == [True, False, False]
    # the best threshold, not the lowest: above 7 the change of pair 1 and one of pair 2
    assert found_at(ranked, 0.1).tolist() == [True, True, False]
    # ten times 0.31 are three: none is lost, and three are allowed
    assert recall_at(ranked, 0.31) == 1.0


def test_what_was_withdrawn_is_no_candidate_but_was_proposed() -> None:
    # without the false region at 8 the third (7.0), which finds the change 2, costs nothing more; without the one at 7
    # that change is never found
    found = regions()
    gone = found.assign(is_withdrawn=found["score"] == 8.0)
    rates, recall = free_response(ranked_pairs(results(), gone, changes()))
    np.testing.assert_allclose([rates[2], recall[2]], [0.079, 2 / 4])
    assert recall_at(ranked_pairs(results(), gone, changes()), 0.065) == 2 / 4
    assert recall_at(ranked_pairs(results(), gone, changes(), is_proposal=True), 0.065) == 1 / 4
    lost = found.assign(is_withdrawn=found["score"] == 7.0)
    assert recall_at(ranked_pairs(results(), lost, changes()), 10.0) == 2 / 4
    assert recall_at(ranked_pairs(results(), lost, changes(), is_proposal=True), 10.0) == 3 / 4


def test_what_is_looked_at_whatever_the_threshold_counts_at_every_one() -> None:
    # narrow: the refused pair counts as 1, and the false region at 8 stands always: 2 in 3.1 km are 0.065 per 100 m
    found = regions()
    of_false = found.assign(is_forced=found["score"] == 8.0)
    assert [recall_at(ranked_pairs(results(), of_false, changes()), rate) for rate in (0.032, 0.064)] == [0.0, 0.0]
    assert recall_at(ranked_pairs(results(), of_false, changes()), 0.065) == 1 / 4
    assert not found_at(ranked_pairs(results(), of_false, changes()), 0.064).any()
    # what was withdrawn does not stand; of proposals the scores count, and older tables have no such column
    gone = of_false.assign(is_withdrawn=found["score"] == 8.0)
    for each in (gone, gone.drop(columns="is_forced"), gone.assign(is_forced=np.nan)):
        np.testing.assert_array_equal(free_response(ranked_pairs(results(), each, changes()))[0][2], 0.079)
    for each in (of_false, found):
        assert recall_at(ranked_pairs(results(), each, changes(), is_proposal=True), 0.034) == 1 / 4
    # the one at 7 finds both changes of pair 1, and stands always: they cost nothing
    of_true = found.assign(is_forced=found["score"] == 7.0)
    assert recall_at(ranked_pairs(results(), of_true, changes()), 0.033) == 2 / 4
    assert found_at(ranked_pairs(results(), of_true, changes()), 0.033).tolist() == [True, True, False, False]


def test_the_rank_of_what_is_looked_at_anyway_is_that_of_its_score() -> None:
    # pair 1: at 9 change 1 is found, at 7 both; the candidate at 6 finds what cannot be observed
    for number in (2, 3):
        found = regions().assign(is_forced=regions().index == number)
        ranked = ranked_pairs(results(), found, changes())
        assert ranked.change_rank.tolist() == [0, 2, 7, 1]


def test_proposals_count_where_they_were_proposed() -> None:
    # the candidate at 9 was proposed beside the change 1, on nothing; the one at 7 finds it then
    found = regions()
    centred = found.assign(found_changes_proposed=found["found_changes"].mask(found["score"] == 9.0, ""))
    assert recall_at(ranked_pairs(results(), centred, changes()), 0.05) == recall_at(by_hand(), 0.05)
    proposals = ranked_pairs(results(), centred, changes(), is_proposal=True)
    assert proposals.is_false.sum() == by_hand().is_false.sum() + 1
    assert proposals.change_score[0] == 7.0
    # tables of older runs lack the column
    older = ranked_pairs(results(), found, changes(), is_proposal=True)
    np.testing.assert_array_equal(older.change_score, by_hand().change_score)


def test_a_later_candidate_on_a_found_change_counts_nothing_and_an_unobservable_one_is_not_false() -> None:
    ranked = by_hand()
    assert ranked.n_new.tolist() == [1, 0, 1, 0, 0, 0, 1]
    assert ranked.is_false.tolist() == [False, True, False, False, True, True, False]
    assert ranked.change_rank.tolist() == [0, 2, 7, 1]
    assert ranked.change_score.tolist() == [9.0, 7.0, -np.inf, 200.0]
    assert ranked.n_false_so_far.tolist() == [0, 1, 1, 1, 1, 1, 1]
    assert ranked.n_found_so_far.tolist() == [1, 1, 2, 2, 0, 0, 1]
    assert ranked.path_m.tolist() == [1000.0, 2000.0, 100.0, 500.0]
    assert ranked.is_answered.tolist() == [True, True, False, True]
    assert found_at(ranked, 0.1).tolist() == [True, True, False, False]
    assert found_at(ranked, 0.2).tolist() == [True, True, False, True]


def test_equal_scores_enter_together() -> None:
    # the false one of the other pair shares the score of the change: both or none
    rows = [(1, 9.0, "1"), (2, 9.0, "")]
    ranked = ranked_pairs(results(), regions(rows), changes())
    assert (recall_at(ranked, 0.06), recall_at(ranked, 0.065)) == (0.0, 0.25)
    assert not found_at(ranked, 0.06).any()


def test_without_changes_there_is_no_recall_and_without_candidates_none_is_found() -> None:
    unchanged = ranked_pairs(results([(1, 4.5, "ok", 100.0, 0)]), regions([(1, 2.0, "")]), changes([]))
    assert np.isnan(recall_at(unchanged, 0.1))
    assert len(free_response(unchanged)[0]) == 0
    silent = ranked_pairs(results(), regions([]), changes())
    assert recall_at(silent, 0.1) == 0.0
    assert [list(part) for part in free_response(silent)] == [[0.0], [0.0]]


def test_the_order_of_the_rows_and_the_scale_of_one_kind_of_site_change_nothing() -> None:
    expected = free_response(by_hand())
    shuffled = ranked_pairs(results(CASES[::-1]), regions(CANDIDATES[::-1]), changes(CHANGES[::-1]))
    scaled = regions([(seed, score * (1000.0 if seed == 4 else 1.0), found) for seed, score, found in CANDIDATES])
    for ranked in (shuffled, ranked_pairs(results(), scaled, changes())):
        for part, other in zip(free_response(ranked), expected, strict=True):
            np.testing.assert_array_equal(part, other)


def random_case(seed: int) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    draw = np.random.default_rng(seed)
    cases, found, truth = [], [], []
    for pair in range(12):
        n_changes = int(draw.integers(0, 4))
        status = "ok" if pair or not seed % 2 else "merge_refused"
        cases.append((pair, float(draw.choice([4.5, 10.0])), status, float(draw.uniform(50, 300)), n_changes))
        truth += [(pair, change + 1, True, 20, False, 1.0, 10) for change in range(n_changes)]
        for _ in range(int(draw.integers(0, 8)) if status == "ok" else 0):
            of = [str(change + 1) for change in range(n_changes) if draw.random() < 0.3]
            found.append((pair, float(draw.integers(0, 10)), ";".join(of)))
    return results(cases), regions(found), changes(truth)


def slow_recall(cases: pd.DataFrame, found: pd.DataFrame, n_observable: int, rate: float) -> float:
    n_found = 0
    for _, own in cases.groupby("score_radius_m"):
        best = 0
        candidates = found[found["seed"].isin(own["seed"])]
        for threshold in sorted(set(candidates["score"])):
            n_false, n_hits = 0.0, 0
            for seed, status, path_m in own[["seed", "status", "after_path_m"]].itertuples(index=False):
                kept = candidates[(candidates["score"] >= threshold) & (candidates["seed"] == seed)]
                most, n_its_false = max(1.0, rate * path_m / 10.0), int((kept["found_changes"] == "").sum())
                is_lost = status != "ok" or n_its_false > most
                n_false += most if is_lost else n_its_false
                n_hits += 0 if is_lost else len({i for ids in kept["found_changes"] for i in ids.split(";") if i})
            if n_false <= rate * own["after_path_m"].sum() / 100:
                best = max(best, n_hits)
        n_found += best
    return n_found / n_observable


@pytest.mark.parametrize("seed", range(6))
def test_recall_agrees_with_a_slow_twin_at_every_rate(seed: int) -> None:
    cases, found, truth = random_case(seed)
    ranked = ranked_pairs(cases, found, truth)
    rates, recall = free_response(ranked)
    for rate in (0.0, 0.1, 0.5, 1.0, 2.0, 5.0):  # of the drawn ones
        expected = slow_recall(cases, found, len(truth), rate)
        assert recall_at(ranked, rate) == pytest.approx(expected)
        assert recall[np.searchsorted(rates, rate, side="right") - 1] == pytest.approx(expected)
        assert found_at(ranked, rate).mean() == pytest.approx(expected)


@pytest.mark.parametrize("seed", range(6))
def test_no_refusal_and_no_false_region_raises_a_recall(seed: int) -> None:
    cases, found, truth = random_case(seed)
    before = {rate: recall_at(ranked_pairs(cases, found, truth), rate) for rate in (0.1, 0.3, 0.5, 2.0, 10.0)}
    for pair in cases["seed"]:
        refused = cases.assign(status=cases["status"].mask(cases["seed"] == pair, "merge_refused"))
        without = ranked_pairs(refused, found[found["seed"] != pair], truth)
        assert all(recall_at(without, rate) <= recall for rate, recall in before.items())
        if (cases["status"][cases["seed"] == pair] == "ok").all():
            noisier = pd.concat([found, regions([(pair, 5.0, ""), (pair, 9.0, "")])])
            assert all(recall_at(ranked_pairs(cases, noisier, truth), rate) <= old for rate, old in before.items())


def test_draws_are_of_pairs_within_a_kind_of_site_and_the_same_for_every_method() -> None:
    cases, found, truth = random_case(0)
    ours = resampled_recalls(ranked_pairs(cases, found, truth), 0.5)
    perfect = regions([(seed, 1.0, str(i)) for seed, i in zip(truth["seed"], truth["id"], strict=True)])
    theirs = resampled_recalls(ranked_pairs(cases, perfect, truth), 0.5)
    assert np.unique(theirs[~np.isnan(theirs)]).tolist() == [1.0]
    np.testing.assert_array_equal(ours, resampled_recalls(ranked_pairs(cases, found, truth), 0.5))
    low, high = interval_of(ours)
    assert 0 <= low < recall_at(ranked_pairs(cases, found, truth), 0.5) < high <= 1
    # one wide pair in the example: it is in every draw, so that its change is always among those to be found
    drawn = resampled_recalls(by_hand(), 0.2)
    assert drawn.min() > 0
    assert all(np.isnan(interval_of(np.full(3, np.nan))))


@pytest.mark.parametrize(
    ("cell", "ids"), [("1;12", (1, 12)), ("3", (3,)), (3.0, (3,)), (7, (7,)), ("", ()), (float("nan"), ()), (None, ())]
)
def test_found_changes_survive_a_table_that_was_read_back(cell: object, ids: tuple[int, ...]) -> None:
    assert parsed_ids(cell) == ids


def test_a_roc_by_hand() -> None:
    false, true = roc_curve(np.array([3.0, 2.0, 2.0, 1.0]), np.array([True, True, False, False]))
    assert (false.tolist(), true.tolist()) == ([0.0, 0.0, 0.5, 1.0], [0.0, 0.5, 1.0, 1.0])
    assert [len(part) for part in roc_curve(np.ones(3), np.ones(3, dtype=bool))] == [0, 0]


@pytest.mark.parametrize("n", [20, 300, 20_000])
def test_the_area_under_the_curve_is_the_auroc(n: int) -> None:
    draw = np.random.default_rng(n)
    positive = draw.random(n) < 0.3
    scores = np.round(draw.normal(positive, 1.0), 2)
    scores[draw.random(n) < 0.1] = np.nan
    false, true = roc_curve(scores, positive)
    assert len(false) <= 400
    assert (false[0], true[0], false[-1], true[-1]) == (0, 0, 1, 1)
    # thinned curves lose what lies between their points
    assert np.trapezoid(true, false) == pytest.approx(auroc(scores, positive), abs=0.0 if n == 20 else 2e-3, rel=1e-9)


def test_recall_by_size_by_hand() -> None:
    rows = {(row["measure"], row["low"]): row for row in recall_by_size(by_hand(), changes())}
    assert set(rows) == {("hull_volume_m3", 0.1), ("hull_volume_m3", 1.0), ("n_returns", 0.0), ("n_returns", 300.0),
                         ("n_returns", 3000.0)}  # fmt: skip
    # 0.2 m3: found in pair 1, not in the refused pair 3; the unobservable change is no part of any count
    small = rows["hull_volume_m3", 0.1]
    assert (small["n_changes"], small["n_pairs"]) == (2, 2)
    assert (small["recall_at_k"], small["recall_reported"], small["recall_at_rate"]) == (0.5, 0.5, 0.5)
    # 2 m3: the second of pair 1 (third candidate of K = 2) and that of pair 4 (second of K = 1)
    large = rows["hull_volume_m3", 1.0]
    assert (large["recall_at_k"], large["recall_reported"], large["recall_at_rate"]) == (0.0, 0.5, 0.5)
    assert (large["interval_low"], large["interval_high"]) == (0.0, 1.0)
    assert sum(row["n_changes"] for key, row in rows.items() if key[0] == "n_returns") == 4


def test_the_interval_of_a_share_draws_pairs() -> None:
    # ten hits of one pair are one draw, not ten: either all, none, or half
    hits, pair = np.repeat([1.0, 0.0], 10), np.repeat([3, 8], 10)
    assert clustered_interval(hits, pair) == (0.0, 1.0)
    assert all(np.isnan(clustered_interval(hits[:10], pair[:10])))


@pytest.mark.parametrize("rate", [0.5, 50.0, 500.0])
def test_candidates_too_bad_for_any_draw_need_not_be_looked_at(rate: float, monkeypatch: pytest.MonkeyPatch) -> None:
    ranked = ranked_pairs(*random_case(0))
    every = resampled_recalls(ranked, rate)
    monkeypatch.setattr(curves, "_FIRST_CANDIDATES", 1)
    resampled_recalls.cache_clear()
    np.testing.assert_array_equal(resampled_recalls(ranked, rate), every)


@pytest.mark.parametrize("seed", [1, 4])
def test_regions_and_changes_of_a_pair_that_results_does_not_count_are_refused(seed: int) -> None:
    counted = results()
    lost = counted.assign(n_observable=counted["n_observable"].where(counted["seed"] != seed))
    for without in (lost, counted[counted["seed"] != seed]):
        with pytest.raises(InputError, match=f"^a, seed {seed}: regions or changes without a row of results.csv"):
            ranked_pairs(without, regions(), changes())
