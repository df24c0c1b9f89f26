"""Recall at 0.1 false regions per 100 m of each method, over the pairs that its other figures are over."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import pandas as pd

from eval.core.statistics import interval_of
from eval.running.results.run_data import RunData, stored_table
from eval.tables.regions.curves import RankedPairs, ranked_pairs, recall_at, resampled_recalls
from eval.tables.rows import PAIR, by_domain, records

POOLED, POOLED_RATE_PER_100M = "recall_at_0.1", 0.1
COLUMNS = ("domain", "variant", "n_pairs", POOLED, f"{POOLED}_low", f"{POOLED}_high")
# columns of results.csv, regions.csv and changes.csv without which no candidate can be ranked
_NEEDED = (
    {"n_observable", "score_radius_m", "after_path_m", "status"}, {"score", "found_changes", *PAIR},
    {"id", "is_observable", "n_truth_cells", *PAIR},
)  # fmt: skip


def pooled_recalls(data: RunData, cases: pd.DataFrame) -> pd.DataFrame:
    """Return recall at a rate of false regions, with its 95 % interval, for each domain and variant of some cases.

    regions_table.csv has it over all pairs of a run, a world's repetitions with other settings among them. Where those
    are more, it is computed anew. Where it is not known of one method, because regions.csv or changes.csv is not there,
    it is NaN for all of the domain: else the others would be ranked by it alone.

    Args:
        data: The run.
        cases: Rows of results.csv with their `domain`, as `eval.running.results.cases.comparable` returns them.

    Returns:
        A row for each domain and variant, its columns `COLUMNS`; empty where the run has no regions_table.csv.
    """
    stored = stored_table(data, "regions_table")
    known = {(row["domain"], row["variant"]): row for row in records(stored)}
    rows: list[dict[str, Any]] = []
    for domain, part in by_domain(cases) if len(stored) else ():
        for variant, own in part.groupby("variant", sort=False):
            names = {"domain": domain, "variant": str(variant), "n_pairs": len(own)}
            row = known.get((domain, variant), {})
            is_whole = row.get("n_pairs") == len(own)
            figures = {key: row.get(key, math.nan) for key in COLUMNS[3:]} if is_whole else _recall(data, own)
            rows.append({**names, **figures})
    table = pd.DataFrame(rows, columns=list(COLUMNS))
    unknown = set(table.loc[table[POOLED].isna(), "domain"])
    table.loc[table["domain"].isin(unknown), list(COLUMNS[3:])] = math.nan
    return table


def _recall(data: RunData, own: pd.DataFrame) -> dict[str, float]:
    pairs = tuple((str(name), int(seed)) for name, seed in own[PAIR].itertuples(index=False))
    ranked = rank_pairs(data, str(own["variant"].iloc[0]), pairs)
    if ranked is None:
        return dict.fromkeys(COLUMNS[3:], math.nan)
    is_enough = ranked.has_interval
    drawn = resampled_recalls(ranked, POOLED_RATE_PER_100M) if is_enough else np.zeros(0)
    low, high = interval_of(drawn) if is_enough else (math.nan, math.nan)
    return {POOLED: recall_at(ranked, POOLED_RATE_PER_100M), f"{POOLED}_low": low, f"{POOLED}_high": high}


@lru_cache(maxsize=8)  # one method is compared with all others
def rank_pairs(data: RunData, variant: str, pairs: tuple[tuple[str, int], ...]) -> RankedPairs | None:
    """Return the candidates and changes of one variant on some pairs; None where columns are missing."""
    tables = [_items(rows, variant, pairs) for rows in (data.results, data.regions, data.changes)]
    if not all(needed <= set(table) for needed, table in zip(_NEEDED, tables, strict=True)):
        return None
    return ranked_pairs(*tables)


def _items(rows: Sequence[Mapping[str, Any]], variant: str, pairs: Iterable[tuple[str, int]]) -> pd.DataFrame:
    """Return the rows of one variant on some pairs, in their order; none of a table that is there has its columns."""
    wanted = set(pairs)
    kept = [row for row in rows if row["variant"] == variant and (row["scenario"], row["seed"]) in wanted]
    return pd.DataFrame(kept or None, columns=list(rows[0]) if rows else None)
