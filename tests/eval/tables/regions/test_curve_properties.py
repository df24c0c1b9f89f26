"""What holds for recall at a rate of false regions, whatever the pairs and the answers: drawn tables (hypothesis)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from hypothesis import given, settings
from hypothesis import strategies as st

from eval.tables.regions.curves import found_at, free_response, ranked_pairs, recall_at
from tests.eval.tables.regions.test_curves import changes, regions, results

EXAMPLES = settings(max_examples=40, deadline=None, derandomize=True, database=None)
RATES = (0.0, 0.1, 0.5, 2.0, 10.0)
SCORES = st.integers(0, 5).map(float)
REFUSED = st.sampled_from(["merge_refused", "failed", "left_out"])


@dataclass(frozen=True)
class Tables:
    """The three tables of one method."""

    results: pd.DataFrame
    regions: pd.DataFrame
    changes: pd.DataFrame

    def recalls(self) -> list[float]:
        """Return the recall at each rate; a table without changes has none, which counts as 0 here."""
        ranked = ranked_pairs(self.results, self.regions, self.changes)
        return np.nan_to_num([recall_at(ranked, rate) for rate in RATES]).tolist()

    def with_regions(self, rows: pd.DataFrame) -> Tables:
        """Return the tables with other regions, candidates of a pair best first."""
        return Tables(self.results, rows.sort_values(["seed", "score"], ascending=[True, False]), self.changes)


@st.composite
def drawn_tables(draw: st.DrawFn) -> Tables:
    """Up to five pairs at two kinds of site, up to five candidates each; some scores are equal, some stand anyway."""
    cases, found, truth = [], [], []
    for pair in range(draw(st.integers(1, 5))):
        n_changes = draw(st.integers(0, 3))
        status = draw(st.sampled_from(["ok", "ok", "ok", "merge_refused"]))
        path_m = float(draw(st.sampled_from([50, 100, 300, 1000])))
        cases.append((pair, draw(st.sampled_from([4.5, 10.0])), status, path_m, n_changes))
        truth += [(pair, change + 1, True, 20, False, 1.0, 10) for change in range(n_changes)]
        ids = st.sets(st.integers(1, n_changes), max_size=2) if n_changes else st.just(set[int]())
        candidates = st.lists(st.tuples(SCORES, ids, st.booleans()), max_size=5 if status == "ok" else 0)
        found += [(pair, score, ";".join(map(str, sorted(of))), forced) for score, of, forced in draw(candidates)]
    rows = regions([row[:3] for row in found]).assign(is_forced=np.array([row[3] for row in found], dtype=bool))
    return Tables(results(cases), pd.DataFrame(), changes(truth)).with_regions(rows)


def is_never_more(less: list[float], more: list[float]) -> bool:
    return all(one <= other + 1e-12 for one, other in zip(less, more, strict=True))


@EXAMPLES
@given(tables=drawn_tables(), data=st.data())
def test_the_order_of_pairs_does_not_matter(tables: Tables, data: st.DataObject) -> None:
    order = data.draw(st.permutations(tables.results["seed"].tolist()))
    of_order = (
        pd.concat([part[part["seed"] == seed] for seed in order])
        for part in (tables.results, tables.regions, tables.changes)
    )
    ranked, turned = (ranked_pairs(each.results, each.regions, each.changes) for each in (tables, Tables(*of_order)))
    for part, other in zip(free_response(turned), free_response(ranked), strict=True):
        np.testing.assert_array_equal(part, other)
    assert found_at(turned, 0.5).sum() == found_at(ranked, 0.5).sum()


@EXAMPLES
@given(tables=drawn_tables(), data=st.data(), score=SCORES, is_forced=st.booleans())
def test_a_false_region_more_raises_no_recall(
    tables: Tables, data: st.DataObject, score: float, is_forced: bool
) -> None:
    seed = data.draw(st.sampled_from(tables.results["seed"].tolist()))
    added = regions([(seed, score, "")]).assign(is_forced=is_forced)
    more = pd.concat([tables.regions, added]) if len(tables.regions) else added  # an old pandas warns of empty ones
    assert is_never_more(tables.with_regions(more).recalls(), tables.recalls())


@EXAMPLES
@given(tables=drawn_tables(), data=st.data(), status=REFUSED)
def test_a_pair_that_is_refused_or_left_out_raises_no_recall(tables: Tables, data: st.DataObject, status: str) -> None:
    seeds = data.draw(st.sets(st.sampled_from(tables.results["seed"].tolist()), min_size=1))
    is_gone = tables.results["seed"].isin(seeds)
    without = Tables(
        tables.results.assign(status=tables.results["status"].mask(is_gone, status)),
        tables.regions[~tables.regions["seed"].isin(seeds)],
        tables.changes,
    )
    assert is_never_more(without.recalls(), tables.recalls())


@EXAMPLES
@given(tables=drawn_tables(), data=st.data())
def test_a_region_counted_twice_raises_no_recall_and_a_true_one_lowers_none(
    tables: Tables, data: st.DataObject
) -> None:
    if len(tables.regions) == 0:
        return
    row = data.draw(st.integers(0, len(tables.regions) - 1))
    again = tables.regions.iloc[[row]]
    twice = tables.with_regions(pd.concat([tables.regions, again])).recalls()
    assert is_never_more(twice, tables.recalls())
    if again["found_changes"].iloc[0]:
        assert twice == tables.recalls()


@EXAMPLES
@given(tables=drawn_tables())
def test_more_allowed_false_regions_lower_no_recall(tables: Tables) -> None:
    recalls = tables.recalls()
    assert is_never_more(recalls[:-1], recalls[1:])
    assert all(0.0 <= recall <= 1.0 for recall in recalls)
    rates, recall = free_response(ranked_pairs(tables.results, tables.regions, tables.changes))
    assert (np.diff(rates) > 0).all() and (np.diff(recall) > 0).all()
