"""Intervals and differences of recall at a rate of false regions, and the edges of what counts, by hand."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from cdpipe.core.geometry import stream
from eval.core.statistics import N_RESAMPLES, interval_of
from eval.tables.regions.curves import (
    RankedPairs,
    found_at,
    free_response,
    ranked_pairs,
    recall_at,
    recall_difference,
    resampled_recalls,
    roc_curve,
)
from tests.eval.tables.regions.test_curves import changes, random_case, regions, results

# two kinds of site with two pairs each, and their changes
CASES = [
    (1, 4.5, "ok", 1000.0, 2), (2, 4.5, "ok", 2000.0, 1), (3, 10.0, "ok", 1000.0, 1), (4, 10.0, "ok", 1000.0, 3),
]  # fmt: skip
TRUTH = [(1, 1), (1, 2), (2, 1), (3, 1), (4, 1), (4, 2), (4, 3)]


def ranked(found: list[tuple[int, float, str]], cases: list[tuple[object, ...]] | None = None) -> RankedPairs:
    truth = [(seed, each, True, 20, False, 1.0, 10) for seed, each in TRUTH]
    return ranked_pairs(results(CASES if cases is None else cases), regions(found), changes(truth))


def two_in_a_tunnel(found: list[tuple[int, float, str]]) -> RankedPairs:
    """The first pair stands in a second world of its tunnel as well, with the answer `found` of seed 1."""
    truth = [(seed, each, True, 20, False, 1.0, 10) for seed, each in TRUTH]
    return ranked_pairs(
        *(
            pd.concat([part, part[part["seed"] == 1].assign(scenario="a[before.height_m=2]")])
            for part in (results(CASES), regions(found), changes(truth))
        )
    )


def test_draws_agree_with_a_slow_twin() -> None:
    found = [(1, 9.0, "1"), (1, 8.0, "2"), (2, 7.0, ""), (2, 6.0, "1"), (3, 9.0, ""), (3, 2.0, "1"), (4, 3.0, "1;3")]
    ours = two_in_a_tunnel(found)
    every = resampled_recalls(ours, 0.1, 3)
    assert len(every) == N_RESAMPLES
    tunnels_of_site = [[(1, 1), (2,)], [(3,), (4,)]]  # the pairs of each tunnel, by seed
    draws = [stream(3, "bootstrap", f"site {site}").integers(2, size=(N_RESAMPLES, 2)) for site in range(2)]
    for number in (*range(12), N_RESAMPLES - 1):
        n_found, n_observable = 0, 0
        for tunnels, drawn in zip(tunnels_of_site, draws, strict=True):
            seeds = [seed for tunnel in drawn[number] for seed in tunnels[tunnel]]
            # each copy of a pair counts, with its own way, changes and false regions
            n_observable += sum(CASES[seed - 1][4] for seed in seeds)
            n_found += most_found(found, seeds, 0.1)
        assert every[number] == pytest.approx(n_found / n_observable)


def most_found(found: list[tuple[int, float, str]], seeds: list[int], rate: float) -> int:
    allowed, best = rate * sum(CASES[seed - 1][3] for seed in seeds) / 100, 0
    for threshold in {score for _, score, _ in found}:
        kept = [each for seed in seeds for each in found if each[0] == seed and each[1] >= threshold]
        if sum(ids == "" for *_, ids in kept) <= allowed:
            best = max(best, sum(len(ids.split(";")) for *_, ids in kept if ids))
    return best


def test_the_draws_of_another_seed_are_others() -> None:
    ours = ranked([(1, 9.0, "1"), (4, 3.0, "1;3")])
    first, again, other = (resampled_recalls(ours, 0.1, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first, resampled_recalls(ours, 0.1))
    assert (first != other).any()


def test_a_difference_is_taken_draw_by_draw() -> None:
    few, many = ranked([(1, 9.0, "1")]), ranked([(1, 9.0, "1"), (1, 8.0, "2"), (4, 3.0, "1;3")])
    assert recall_difference(few, many, 0.1)[0] == pytest.approx(3 / 7)
    assert recall_difference(many, few, 0.1)[0] == pytest.approx(-3 / 7)
    cases, found, truth = random_case(0)
    noisy = ranked_pairs(cases, found, truth)
    perfect = regions([(seed, 1.0, str(i)) for seed, i in zip(truth["seed"], truth["id"], strict=True)])
    best = ranked_pairs(cases, perfect, truth)
    intervals = [recall_difference(noisy, best, 0.5, seed)[1:] for seed in (0, 5)]
    for seed, interval in zip((0, 5), intervals, strict=True):
        assert interval == interval_of(resampled_recalls(best, 0.5, seed) - resampled_recalls(noisy, 0.5, seed))
    assert intervals[0] != intervals[1] and intervals[0] == recall_difference(noisy, best, 0.5)[1:]
    # who differs from himself in no draw has no width
    assert recall_difference(many, many, 0.1) == (0.0, 0.0, 0.0)


def test_a_difference_without_an_interval() -> None:
    ours, fewer = ranked([(1, 9.0, "1")]), ranked([(1, 9.0, "1")], CASES)
    shorter = ranked_pairs(results(CASES[:2]), regions([]), changes([(1, 1, True, 20, False, 1.0, 10)]))
    difference, *interval = recall_difference(ours, shorter, 0.1)
    assert difference == pytest.approx(-1 / 7) and np.isnan(interval).all()
    assert not np.isnan(recall_difference(ours, fewer, 0.1)).any()
    # changes in a single tunnel say nothing about others
    cases = [(1, 4.5, "ok", 1000.0, 2), (2, 4.5, "ok", 1000.0, 0)]
    truth = [(1, each, True, 20, False, 1.0, 10) for each in (1, 2)]
    one = ranked_pairs(results(cases), regions([(1, 9.0, "1")]), changes(truth))
    none = ranked_pairs(results(cases), regions([]), changes(truth))
    assert recall_difference(none, one, 0.1)[0] == 0.5
    assert np.isnan(recall_difference(none, one, 0.1)[1:]).all() and not one.has_interval


def test_a_single_change_has_a_recall_and_a_curve() -> None:
    one = ranked_pairs(
        results([(1, 4.5, "ok", 1000.0, 1)]), regions([(1, 2.0, "1")]), changes([(1, 1, True, 1, True, 1.0, 1)])
    )
    assert recall_at(one, 0.1) == 1.0
    assert [part.tolist() for part in free_response(one)] == [[0.0], [1.0]]
    assert resampled_recalls(one, 0.1).tolist() == [1.0] * N_RESAMPLES


def test_what_fills_no_cell_is_no_change_to_find() -> None:
    cases, found = [(1, 4.5, "ok", 1000.0, 1)], regions([(1, 2.0, "1;2;3")])
    truth = changes([(1, 1, True, 0, False, 1.0, 1), (1, 2, True, 1, False, 1.0, 1), (1, 3, False, 9, False, 1.0, 1)])
    assert ranked_pairs(results(cases), found, truth).change_rows.tolist() == [1]
    assert ranked_pairs(results(cases), found, truth).change_score.tolist() == [2.0]


def test_no_pair_at_all_has_no_recall() -> None:
    none = ranked_pairs(results([]), regions([]), changes([]))
    assert np.isnan(recall_at(none, 0.1)) and not none.has_interval and len(none.tunnels) == 0
    assert [len(part) for part in free_response(none)] == [0, 0]
    assert found_at(none, 0.1).tolist() == []
    unmade = results([(1, 4.5, "failed", np.nan, np.nan)])  # a world that was not made
    assert ranked_pairs(unmade, regions([]), changes([])).pairs == ()


def test_a_pair_with_just_ten_times_the_allowed_false_regions_is_kept() -> None:
    # 300 m: ten times the 0.3 allowed are 3, and all 3 km allow as many
    cases = [(1, 4.5, "ok", 300.0, 1), (2, 4.5, "ok", 2700.0, 0)]
    truth = changes([(1, 1, True, 20, False, 1.0, 10)])
    for n_false, recall in ((3, 1.0), (4, 0.0)):
        found = regions([*((1, 9.0 - each, "") for each in range(n_false)), (1, 1.0, "1")])
        tables = ranked_pairs(results(cases), found, truth)
        assert recall_at(tables, 0.1) == recall
        assert found_at(tables, 0.1).tolist() == [bool(recall)]


def test_no_change_of_a_lost_pair_is_found_and_one_false_region_loses_none() -> None:
    # both changes of the second pair, at 8, are worth the first pair, which the false region at 8 loses
    cases = [(1, 4.5, "ok", 100.0, 1), (2, 4.5, "ok", 1900.0, 2)]
    truth = changes([(seed, each, True, 20, False, 1.0, 10) for seed, each in ((1, 1), (2, 1), (2, 2))])
    found = regions([(1, 9.0, "1"), (1, 8.5, ""), (1, 8.0, ""), (2, 8.0, "1;2")])
    tables = ranked_pairs(results(cases), found, truth)
    assert recall_at(tables, 0.1) == 2 / 3
    assert found_at(tables, 0.1).tolist() == [False, True, True]
    # a single false region is allowed on the shortest way
    cases = [(1, 4.5, "ok", 50.0, 1), (2, 4.5, "ok", 950.0, 0)]
    one = ranked_pairs(results(cases), regions([(1, 9.0, ""), (1, 8.0, "1")]), truth.iloc[:1])
    assert (recall_at(one, 0.1), found_at(one, 0.1).tolist()) == (1.0, [True])


def test_a_pair_is_lost_once_whatever_comes_after() -> None:
    # 50 m keep one false region: the second loses the change of the first pair, and the third no other
    cases = [(1, 4.5, "ok", 50.0, 1), (2, 4.5, "ok", 950.0, 2)]
    truth = changes([(seed, each, True, 20, False, 1.0, 10) for seed, each in ((1, 1), (2, 1), (2, 2))])
    for own in ([(1, 8.0, "")], [(1, 8.0, ""), (1, 7.0, "")], [(1, 8.0, ""), (1, 7.0, ""), (1, 6.5, "")]):
        found = regions([(1, 9.0, "1"), *own, (2, 6.0, "1;2")])
        expected = 1.0 if len(own) == 1 else 2 / 3
        assert recall_at(ranked_pairs(results(cases), found, truth), 0.1) == expected


def test_every_column_of_a_pair_is_its_own() -> None:
    cases, found, truth = random_case(3)
    tables = ranked_pairs(cases, found, truth)
    assert tables.pairs == tuple(("a", seed) for seed in range(12))
    assert tables.tunnels.tolist() == list(range(12))
    assert tables.n_observable.tolist() == cases["n_observable"].tolist()
    assert tables.site.tolist() == (cases["score_radius_m"] == 10.0).astype(int).tolist()
    assert tables.pair.tolist() == found["seed"].tolist()
    assert tables.change_pair.tolist() == truth["seed"].tolist()
    assert tables.change_rows.tolist() == list(range(len(truth)))


def test_a_thinned_roc_keeps_its_ends_and_its_order() -> None:
    # every other place is near a change: 2,000 corners
    is_positive = np.arange(2000) % 2 == 0
    false, true = roc_curve(-np.arange(2000.0), is_positive)
    assert len(false) == 400
    assert (false[0], true[0], false[-1], true[-1]) == (0.0, 0.0, 1.0, 1.0)
    assert (np.diff(false) >= 0).all() and (np.diff(true) >= 0).all()
    # the corners that are kept lie evenly along the curve
    assert np.diff(false).max() <= 0.004 and np.diff(true).max() <= 0.004
    assert np.abs(false - true).max() <= 0.0011
    # one class alone has no curve, whichever it is; one place of each has one
    for one in (np.zeros(3, dtype=bool), np.ones(3, dtype=bool)):
        assert [len(part) for part in roc_curve(np.arange(3.0), one)] == [0, 0]
    assert [part.tolist() for part in roc_curve(np.array([2.0, 1.0]), np.array([True, False]))] == [
        [0, 0, 1],
        [0, 1, 1],
    ]
