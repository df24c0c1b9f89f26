"""How many changes are found at which price: the free-response curve over candidates, and the ROC over keyframes.

The free-response curve lets the threshold fall over all candidates that were not withdrawn, reported or not, and counts
the observable changes found against the false regions per 100 m of after path, over changed and unchanged pairs alike.
Below a method's own threshold nothing was looked at and nothing withdrawn: there the curve is that of mere proposals.
Scores of some methods mean something else in a wide drift than in a narrow one, as the radius does, so a threshold
belongs to one method and one kind of site (`score_radius_m`): at each rate every kind of site has the best threshold
of those that keep its own rate.
A region that a method looks at whatever the threshold (`is_forced`), and does not withdraw, counts at every threshold.
A pair with more than ten times the allowed false regions, and more than one, is lost: it misses all its changes and
counts as so many. A pair without an answer is lost at every threshold, so no refusal raises a recall.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pandas as pd

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, stream
from cdpipe.core.ranking import comparable, last_of_ties
from eval.core.statistics import N_RESAMPLES, interval_of
from eval.tables.rows import PAIR, forced, tunnel_numbers

RATES_PER_100M = (0.1, 0.5)
# columns of items that an empty table must have here, and for what is made beside the curves
NEEDED = ("id", "is_observable", "is_found", "n_truth_cells", "score", "found_changes", "is_withdrawn", "label")
_BATCH = 100
# So many of the best candidates are looked at first.
_FIRST_CANDIDATES = 256
_MAX_ROC_POINTS = 400
_ROUNDING = 1e-9
# the score of what no threshold silences; thresholds that nothing reaches are infinite
_ABOVE_ALL = np.finfo(np.float64).max
# False regions of a lost pair, as a multiple of those allowed on its way; at least one.
_LOST_AT = 10.0
_DRAWN_RATES = (0.0, *(float(f"{rate:.2g}") for rate in np.geomspace(0.01, 100.0, 41)))


@dataclass(frozen=True, slots=True, eq=False)
class RankedPairs:
    """What one method gave on P pairs: R candidates that pass suppression, and C observable changes.

    Attributes:
        pairs: (scenario, seed) of each pair, sorted.
        site: (P,) int64 kind of site of each, from 0.
        path_m: (P,) way of the after session.
        is_answered: (P,) whether there is an answer.
        n_observable: (P,) int64 observable changes.
        pair: (R,) int64 pair of each candidate.
        score: (R,) its score.
        n_new: (R,) int64 observable changes that it finds and no better candidate of its pair does.
        is_false: (R,) whether it finds no change at all.
        n_false_so_far: (R,) int64 false ones of its pair that are as good, itself included.
        n_found_so_far: (R,) int64 observable changes that they and it find.
        change_pair: (C,) int64 pair of each change.
        change_score: (C,) score of the best candidate that finds it, -inf for none.
        change_rank: (C,) int64 place from 0 of the best candidate of its pair, each by its own score, R for none.
        change_rows: (C,) int64 its row in the table of changes.
    """

    pairs: tuple[tuple[str, int], ...]
    tunnels: Int64Array
    site: Int64Array
    path_m: Float64Array
    is_answered: BoolArray
    n_observable: Int64Array
    pair: Int64Array
    score: Float64Array
    n_new: Int64Array
    is_false: BoolArray
    n_false_so_far: Int64Array
    n_found_so_far: Int64Array
    change_pair: Int64Array
    change_score: Float64Array
    change_rank: Int64Array
    change_rows: Int64Array

    @property
    def has_interval(self) -> bool:
        """Whether there are changes in more than one tunnel."""
        return len(np.unique(self.tunnels[self.n_observable > 0])) > 1


def ranked_pairs(
    results: pd.DataFrame, regions: pd.DataFrame, changes: pd.DataFrame, *, is_proposal: bool = False
) -> RankedPairs:
    """Put together the candidates and changes of one variant.

    Args:
        results: Its rows of results.csv.
        regions: Its rows of regions.csv, candidates of a pair best first.
        changes: Its rows of changes.csv.
        is_proposal: Count the candidates that were withdrawn as well, and all of them where they were proposed.

    Raises:
        InputError: A region or an observable change is of a pair without a row of results.csv that counts its changes.
    """
    if not is_proposal:
        regions = regions[~regions["is_withdrawn"].astype(bool)]
    cases = results[results["n_observable"].notna()].sort_values(PAIR)
    pairs = [(str(scenario), int(seed)) for scenario, seed in zip(cases["scenario"], cases["seed"], strict=True)]
    place = {pair: index for index, pair in enumerate(pairs)}
    is_observable = changes["is_observable"].astype(bool).to_numpy() & (changes["n_truth_cells"].to_numpy() > 0)
    rows = np.flatnonzero(is_observable)
    for each in (changes.iloc[rows], regions):
        _require_pairs(each, place)
    number = {
        (place[str(scenario), int(seed)], int(change)): index
        for index, (scenario, seed, change) in enumerate(
            changes.iloc[rows][[*PAIR, "id"]].itertuples(index=False, name=None)
        )
    }
    of_pair = np.array([place[str(a), int(b)] for a, b in regions[PAIR].itertuples(index=False, name=None)], np.int64)
    scores = regions["score"].to_numpy(dtype=np.float64)
    rank = _rank(scores, of_pair)
    if not is_proposal:
        scores = np.where(forced(regions), _ABOVE_ALL, scores)
    n_new, is_false = np.zeros(len(scores), np.int64), np.zeros(len(scores), np.bool_)
    change_score = np.full(len(rows), -np.inf)
    change_rank = np.full(len(rows), len(scores), np.int64)
    is_told = is_proposal and "found_changes_proposed" in regions  # tables of older runs lack the column
    found_changes = regions["found_changes_proposed" if is_told else "found_changes"].tolist()
    order = np.lexsort((np.arange(len(scores)), -scores, of_pair))
    for candidate in order.tolist():
        pair, found = int(of_pair[candidate]), parsed_ids(found_changes[candidate])
        is_false[candidate] = not found
        its = [i for change in found if (i := number.get((pair, change))) is not None]
        change_rank[its] = np.minimum(change_rank[its], rank[candidate])
        new = [i for i in its if change_score[i] == -np.inf]
        change_score[new], n_new[candidate] = scores[candidate], len(new)
    return RankedPairs(
        pairs=tuple(pairs),
        tunnels=tunnel_numbers(*zip(*pairs, strict=True)) if pairs else np.zeros(0, np.int64),
        site=np.unique(cases["score_radius_m"].to_numpy(dtype=np.float64), return_inverse=True)[1].astype(np.int64),
        path_m=cases["after_path_m"].to_numpy(dtype=np.float64),
        is_answered=(cases["status"] == "ok").to_numpy(dtype=np.bool_),
        n_observable=cases["n_observable"].to_numpy().astype(np.int64),
        pair=of_pair,
        score=scores,
        n_new=n_new,
        is_false=is_false,
        n_false_so_far=_so_far(is_false.astype(np.int64), of_pair, order),
        n_found_so_far=_so_far(n_new, of_pair, order),
        change_pair=np.array([pair for pair, _ in number], dtype=np.int64),
        change_score=change_score,
        change_rank=change_rank,
        change_rows=rows,
    )


def _rank(scores: Float64Array, pair: Int64Array) -> Int64Array:
    """Return (R,) the place from 0 of each candidate of a pair by its own score, of equal ones in their order."""
    order = np.lexsort((np.arange(len(scores)), -scores, pair))
    return _so_far(np.ones(len(scores), np.int64), pair, order) - np.int64(1)


def _so_far(counts: Int64Array, pair: Int64Array, order: Int64Array) -> Int64Array:
    """Return (R,) the sum of the counts of each pair from its first candidate in `order` to each."""
    return pd.Series(counts[order], order).groupby(pair[order]).cumsum().sort_index().to_numpy(dtype=np.int64)


def _require_pairs(items: pd.DataFrame, place: Mapping[tuple[str, int], int]) -> None:
    for scenario, seed in items[PAIR].drop_duplicates().itertuples(index=False, name=None):
        if (str(scenario), int(seed)) not in place:
            raise InputError(
                f"{scenario}, seed {seed}: regions or changes without a row of results.csv that counts the changes "
                "(n_observable): `tunnelcd score RUN` makes the tables anew"
            )


def parsed_ids(value: object) -> tuple[int, ...]:
    """Return the ids of a cell of `found_changes`: "1;3", or a number where a table was read back with one id each."""
    text = "" if value is None or (isinstance(value, float) and np.isnan(value)) else str(value)
    return tuple(int(float(part)) for part in text.split(";") if part)


def free_response(ranked: RankedPairs) -> tuple[Float64Array, Float64Array]:
    """Return the free-response curve: `recall_at` of 0 and of rates from 0.01 to 100, ten a decade.

    Returns:
        (N,) false regions per 100 m, rising from 0, and the (N,) recall at each; a step lies at every point. Both empty
        without an observable change.
    """
    if int(ranked.n_observable.sum()) == 0:
        return np.zeros(0), np.zeros(0)
    recall = np.array([recall_at(ranked, rate) for rate in _DRAWN_RATES])
    is_step = np.concatenate([[True], np.diff(recall) > 0])
    return np.array(_DRAWN_RATES)[is_step], recall[is_step]


def recall_at(ranked: RankedPairs, rate_per_100m: float) -> float:
    """Return the recall where no kind of site has more false regions per 100 m; NaN without an observable change."""
    return float(_recalls(ranked, rate_per_100m, np.ones((1, len(ranked.pairs))))[0])


@lru_cache(maxsize=64)  # a method is compared with all others, at each rate
def resampled_recalls(ranked: RankedPairs, rate_per_100m: float, seed: int = 0) -> Float64Array:
    """Return `recall_at` of bootstrap draws of tunnels within each kind of site, thresholds set anew in each draw.

    Two methods that ran the same pairs get the same draws, so that their difference can be taken draw by draw.
    """
    weights = _drawn_weights(ranked, seed)
    batches = range(0, N_RESAMPLES, _BATCH)
    return np.concatenate([_recalls(ranked, rate_per_100m, weights[first : first + _BATCH]) for first in batches])


def _drawn_weights(ranked: RankedPairs, seed: int) -> Float64Array:
    """Return (N_RESAMPLES, P) how often each draw of tunnels, within each kind of site, holds each pair."""
    weights = np.zeros((N_RESAMPLES, len(ranked.pairs)))
    for site in np.unique(ranked.site):
        own = np.flatnonzero(ranked.site == site)
        tunnel, names = pd.factorize(ranked.tunnels[own])
        n = len(names)
        draws = stream(seed, "bootstrap", f"site {site}").integers(n, size=(N_RESAMPLES, n))
        times = np.bincount((n * np.arange(N_RESAMPLES)[:, None] + draws).ravel(), minlength=n * N_RESAMPLES)
        weights[:, own] = times.reshape(N_RESAMPLES, n)[:, tunnel]
    return weights


def recall_difference(
    a: RankedPairs, b: RankedPairs, rate_per_100m: float, seed: int = 0
) -> tuple[float, float, float]:
    """Return `recall_at` of b less that of a, and the low and high end of its 95 % interval, draw by draw.

    The interval is NaN for different pairs, and for fewer than two tunnels with an observable change.
    """
    difference = recall_at(b, rate_per_100m) - recall_at(a, rate_per_100m)
    if a.pairs != b.pairs or not a.has_interval:
        return difference, float("nan"), float("nan")
    drawn = [resampled_recalls(each, rate_per_100m, seed) for each in (a, b)]
    return difference, *interval_of(drawn[1] - drawn[0])


def found_at(ranked: RankedPairs, rate_per_100m: float) -> BoolArray:
    """Return (C,) which changes are found at the thresholds of `recall_at`."""
    n_pairs = len(ranked.pairs)
    thresholds = np.full(n_pairs, np.inf)
    for site in np.unique(ranked.site).tolist():
        is_allowed, n_found, scores = _at_thresholds(ranked, site, rate_per_100m, np.ones((1, n_pairs)))
        n_found = np.where(is_allowed, n_found, 0.0)[0]
        if n_found.any():
            thresholds[ranked.site == site] = scores[n_found.argmax()]
    is_false = ranked.is_false & (ranked.score >= thresholds[ranked.pair])
    n_false = np.bincount(ranked.pair[is_false], minlength=n_pairs)
    is_kept = ranked.is_answered & (n_false <= _false_of_a_lost_pair(ranked, rate_per_100m))
    is_found = np.isfinite(ranked.change_score) & (ranked.change_score >= thresholds[ranked.change_pair])
    return np.asarray(is_found & is_kept[ranked.change_pair], dtype=np.bool_)


def roc_curve(scores: Float64Array, is_positive: BoolArray) -> tuple[Float64Array, Float64Array]:
    """Return false and true positive rates as the threshold falls, corners first to last, thinned to a few hundred.

    Args:
        scores: (N,) scores; NaN ranks below every number, and equal scores enter together.
        is_positive: (N,) which of them are positives.

    Returns:
        Two (M,) arrays from (0, 0) to (1, 1); both empty if either class is.
    """
    n_positive = int(np.count_nonzero(is_positive))
    n_negative = len(is_positive) - n_positive
    if n_positive == 0 or n_negative == 0:
        return np.zeros(0), np.zeros(0)
    falling = comparable(scores)
    order = np.argsort(-falling, kind="stable")
    last = last_of_ties(falling[order])
    true = np.concatenate([[0], np.cumsum(is_positive[order])[last]]) / n_positive
    false = np.concatenate([[0], np.cumsum(~is_positive[order])[last]]) / n_negative
    # a point on the straight line between its neighbours tells nothing
    turn = np.diff(false[:-1]) * np.diff(true[1:]) != np.diff(false[1:]) * np.diff(true[:-1])
    kept = np.flatnonzero(np.concatenate([[True], turn, [True]]))
    if len(kept) > _MAX_ROC_POINTS:
        kept = kept[np.unique(np.linspace(0, len(kept) - 1, _MAX_ROC_POINTS).round().astype(np.int64))]
    return false[kept], true[kept]


def _recalls(ranked: RankedPairs, rate_per_100m: float, weights: Float64Array) -> Float64Array:
    """Return the (B,) recalls of (B, P) weights of the pairs; NaN where no drawn pair has an observable change."""
    n_found = np.zeros(len(weights))
    for site in np.unique(ranked.site).tolist():
        n_first, n_candidates = _FIRST_CANDIDATES, len(ranked.score)
        while True:
            is_allowed, found, _ = _at_thresholds(ranked, site, rate_per_100m, weights, n_first)
            # worse candidates only add false regions
            if n_first >= n_candidates or not is_allowed[:, -1:].any():
                break
            n_first *= 4
        n_found += np.where(is_allowed, found, 0.0).max(axis=1, initial=0.0)
    n_observable = weights @ ranked.n_observable
    recalls = np.full(len(weights), np.nan)
    np.divide(n_found, n_observable, out=recalls, where=n_observable > 0)
    return recalls


def _at_thresholds(
    ranked: RankedPairs, site: int, rate_per_100m: float, weights: Float64Array, n_first: int | None = None
) -> tuple[BoolArray, Float64Array, Float64Array]:
    """Let the threshold fall at one kind of site, over its `n_first` best candidates, all of them by default.

    Returns:
        (B, N) whether each of N thresholds keeps the rate, and the changes found there; (N,) the thresholds.
    """
    own = _falling(ranked, site)[:n_first]
    last = last_of_ties(ranked.score[own])
    pair, n_false, n_found = ranked.pair[own], ranked.n_false_so_far[own], ranked.n_found_so_far[own]
    of_lost = _false_of_a_lost_pair(ranked, rate_per_100m)
    most, n_false_before = of_lost[pair], n_false - ranked.is_false[own]
    cost = np.minimum(n_false, most) - np.minimum(n_false_before, most)
    gain = np.where(n_false <= most, n_found, 0) - np.where(n_false_before <= most, n_found - ranked.n_new[own], 0)
    drawn = weights[:, pair]
    is_here = ranked.site == site
    of_refused = weights @ (of_lost * (is_here & ~ranked.is_answered))
    counted = np.cumsum(drawn * cost, axis=1)[:, last] + of_refused[:, None]
    allowed = weights @ (rate_per_100m * ranked.path_m * is_here / 100.0)
    return counted <= allowed[:, None] + _ROUNDING, np.cumsum(drawn * gain, axis=1)[:, last], ranked.score[own][last]


def _false_of_a_lost_pair(ranked: RankedPairs, rate_per_100m: float) -> Float64Array:
    """Return (P,) as how many false regions each pair counts if it is lost."""
    return np.maximum(_LOST_AT * rate_per_100m * ranked.path_m / 100.0 + _ROUNDING, 1.0)


@lru_cache(maxsize=64)
def _falling(ranked: RankedPairs, site: int) -> Int64Array:
    """Return the candidates of one kind of site, best first."""
    own = np.flatnonzero(ranked.site[ranked.pair] == site)
    return own[np.argsort(-ranked.score[own], kind="stable")]
