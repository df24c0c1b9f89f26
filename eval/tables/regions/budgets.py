"""What proposals save: the changes found against what looking for them costs.

A method lets somebody look at its candidates, best first. Each look has a price, and there are three of them:

- `spheres`: looks per 100 m of the after path;
- `seconds`: seconds after the merge per 100 m of that path: the query, and the extraction of a region for each look;
- `bytes`: what one robot sends the other, as a share of the bytes of the before map: what the method keeps of the
  before session (descriptors, or the map itself), and the points of the before map in each sphere that is looked at.

A change is found at the price of the first look whose sphere, as it was proposed, finds it. It costs infinitely much
where no candidate does, and where the pair has no answer. A sphere finds what lies within the score radius, however
small it is. So one below 0.4 score radii, smaller than any of ours, is charged as the whole map.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.geometry import Float64Array
from cdpipe.extract.extract import ASKED_POINTS
from eval.core.statistics import clustered_interval
from eval.tables.regions.curves import RankedPairs
from eval.tables.rows import PAIR, numbers

# The budgets at which recall is stated; areas run from no budget to the last one.
BUDGETS: Mapping[str, tuple[float, ...]] = MappingProxyType({
    "spheres": (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0),
    "seconds": (0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0),
    "bytes": (0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.2, 0.5, 1.0, 2.0),
})  # fmt: skip
# the share of the map's bytes up to which the area is taken
_AREA_ENDS = {"spheres": 12.0, "seconds": 10.0, "bytes": 0.1}
BYTES_PER_POINT = 12
# widths of drifts give spheres of 4.5 m and more, where the score radius is 10 m at most
_LEAST_RADIUS = 0.4


def budget_rows(ranked: RankedPairs, results: pd.DataFrame, regions: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the recall of one variant at each budget; no row without an observable change.

    Args:
        ranked: Its candidates as proposed (`is_proposal`), and its changes.
        results: Its rows of results.csv.
        regions: Its rows of regions.csv, candidates of a pair best first.

    Returns:
        `price`, `budget`, `recall` with its 95 % interval over pairs, and `area`, the mean recall from no budget to 12
        spheres or 10 s per 100 m, or 10 % of the map's bytes, with its interval. They are NaN where an answer does not
        state what the price needs. In rows of bytes, `asked_share` is the mean share of the map that a look asks for:
        small spheres make it small.
    """
    asked_share = _share_of_a_look(results, regions)
    prices = price_changes(ranked, results, regions)
    rows = []
    for price, budgets in BUDGETS.items():
        costs = prices[price]
        area = _mean_over_changes(np.clip(1.0 - costs / _AREA_ENDS[price], 0.0, 1.0), ranked)
        for budget in budgets:
            found = np.where(np.isnan(costs), np.nan, costs <= budget)
            recall = _mean_over_changes(found, ranked)
            names = {"price": price, "budget": budget, "n_changes": len(costs)}
            share = asked_share if price == "bytes" else math.nan
            rows.append({**names, **_named("recall", recall), **_named("area", area), "asked_share": share})
    return rows if len(ranked.change_pair) else []


def price_changes(ranked: RankedPairs, results: pd.DataFrame, regions: pd.DataFrame) -> dict[str, Float64Array]:
    """Return (C,) what each change costs, by price: infinite where it is not found, NaN where it is not known."""
    cases = results.assign(look_s=_seconds_per_look(results)).set_index(PAIR)
    path, query_s, look_s, kept, whole = (
        dict(zip(cases.index, numbers(cases, name), strict=True))
        for name in ("after_path_m", "t_cd_s", "look_s", "bytes_regions_before", "bytes_map_before")
    )
    asked = _asked_bytes(results, regions)
    prices = {name: np.full(len(ranked.change_pair), np.inf) for name in BUDGETS}
    for change in np.flatnonzero(np.isfinite(ranked.change_score)).tolist():
        pair, n_looks = ranked.pairs[ranked.change_pair[change]], int(ranked.change_rank[change]) + 1
        # who has the whole map asks for nothing
        sent = kept[pair] + (0.0 if kept[pair] >= whole[pair] else float(asked[pair][n_looks - 1]))
        prices["spheres"][change] = 100.0 * n_looks / path[pair]
        prices["seconds"][change] = 100.0 * (query_s[pair] + n_looks * look_s[pair]) / path[pair]
        prices["bytes"][change] = sent / whole[pair]
    return prices


def _asked_bytes(results: pd.DataFrame, regions: pd.DataFrame) -> dict[tuple[str, int], Float64Array]:
    """Return the bytes of all spheres up to each candidate of a pair, best first."""
    if not len(regions):
        return {}
    # sorted at once: a frame for each of thousands of pairs takes most of the time of a table
    place = regions.groupby(PAIR, sort=False).ngroup().to_numpy()
    order = np.lexsort((-numbers(regions, "score"), place))
    asked, ends = _bytes_per_look(results, regions)[order], np.flatnonzero(np.diff(place[order])) + 1
    firsts = order[np.concatenate([[0], ends])]
    names = zip(regions["scenario"].iloc[firsts], regions["seed"].iloc[firsts], strict=True)
    parts = np.split(asked, ends)
    return {(str(name), int(seed)): np.cumsum(own) for (name, seed), own in zip(names, parts, strict=True)}


def _bytes_per_look(results: pd.DataFrame, regions: pd.DataFrame) -> Float64Array:
    """Return (R,) the bytes that each candidate's sphere asks for; the whole map where it is smaller than it may be."""
    asked = BYTES_PER_POINT * numbers(regions, ASKED_POINTS)
    is_small = numbers(regions, "radius_m") < _LEAST_RADIUS * _of_pairs(results, regions, "score_radius_m")
    return np.where(is_small, np.fmax(asked, _of_pairs(results, regions, "bytes_map_before")), asked)


def _share_of_a_look(results: pd.DataFrame, regions: pd.DataFrame) -> float:
    """Return the mean of what each candidate asks for as a share of its map; NaN where one does not state it."""
    if not len(regions):
        return math.nan
    return float(np.mean(_bytes_per_look(results, regions) / _of_pairs(results, regions, "bytes_map_before")))


def _of_pairs(results: pd.DataFrame, regions: pd.DataFrame, column: str) -> Float64Array:
    """Return (R,) a column of results.csv for the pair of each candidate."""
    of_pair = dict(zip(results.set_index(PAIR).index, numbers(results, column), strict=True))
    return np.array([of_pair.get(pair, math.nan) for pair in zip(regions["scenario"], regions["seed"], strict=True)])


def _seconds_per_look(results: pd.DataFrame) -> Float64Array:
    """Return the seconds of one extraction in each pair; those of all pairs where a pair proposed no region."""
    whole_s, per_region_s = numbers(results, "t_oe_s"), numbers(results, "t_oe_per_region_s")
    n_proposed = np.nansum(numbers(results, "n_regions") + numbers(results, "n_withdrawn"))
    pooled_s = np.nansum(whole_s) / n_proposed if n_proposed else math.nan
    return np.where(np.isnan(per_region_s) & ~np.isnan(whole_s), pooled_s, per_region_s)


def _mean_over_changes(values: Float64Array, ranked: RankedPairs) -> tuple[float, float, float]:
    """Return the mean over all changes and its interval; NaN where one has no value: else a pair would be left out."""
    if len(values) == 0 or np.isnan(values).any():
        return math.nan, math.nan, math.nan
    return float(values.mean()), *clustered_interval(values.astype(np.float64), ranked.tunnels[ranked.change_pair])


def _named(name: str, values: tuple[float, float, float]) -> dict[str, float]:
    return dict(zip((name, f"{name}_low", f"{name}_high"), values, strict=True))
