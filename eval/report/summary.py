"""The summary of a run: the headline figures of every method, best first, under one sentence about the run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from cdpipe.core.geometry import Float64Array, Int64Array
from eval.core.statistics import interval_over_tunnels, mean, median, statistic_of
from eval.report.comparing.columns import COMPARED, figures_of, is_time
from eval.report.merge.tables import name_kinds
from eval.report.pooled import POOLED, pooled_recalls
from eval.report.surface.surface import SURFACE_COLUMNS
from eval.report.tables import Cell, Table, methods_table, written_interval
from eval.running.results.cases import comparable, is_unmade
from eval.running.results.grids import off_grids
from eval.running.results.run_data import RunData, covered_by, ends_at_merge, shown_variant, stored_table
from eval.running.results.sides import is_contended
from eval.running.results.values import text
from eval.running.runfolder import reported
from eval.scoring.surface.windows import AREAS_M2
from eval.tables.columns import Column, fine, select, share, spaced
from eval.tables.merge_table import ALL_FAMILIES, RIGHT_DEG, RIGHT_M, kinds
from eval.tables.rows import (
    ALL_DOMAINS,
    DOMAINS,
    PAIR,
    by_domain,
    is_told_the_truth,
    numbers,
    records,
    stated,
    tunnels_of,
    with_domain,
)
from eval.tables.surface.table import limit_column

_MAX_METHODS = 8
HEADLINES = select(
    COMPARED, POOLED, "region_recall", "region_auroc", "false_regions_per_100m", "is_alarm", "object_iou_point",
    "object_f1_50", "merge_error_m", "t_total_s", "bytes_regions_before",
)  # fmt: skip
_ALARMS = ("is_alarm", "false_regions_per_100m")
SURFACE_HEADLINES = select(
    SURFACE_COLUMNS, "surface_cover", "surface_error_median_changed_m", "surface_level_inside", "surface_recall",
    "surface_region_precision", "surface_false_regions_per_100m", *map(limit_column, AREAS_M2), "t_surface_s",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Summary:
    """What a page shows first: what the run holds, its headline figures, and those of its pairs where they differ."""

    sentence: str
    table: Table
    of_pairs: Table | None = None


def draw_summary(data: RunData, merges: pd.DataFrame) -> Summary:
    """Return the summary of a run.

    Args:
        data: The run.
        merges: As `eval.tables.merge_table.merge_table` returns it.
    """
    told = _sentence(data, merges)
    if ends_at_merge(data):
        return Summary(told, _merge_headlines(merges))
    of_surface = surface_headlines(data)
    return Summary(told, _headlines(data)) if of_surface is None else Summary(told, of_surface, _headlines(data))


def means_by_method(results: pd.DataFrame, columns: Sequence[Column]) -> pd.DataFrame:
    """Return the mean of each column over the pairs of each method, of times the median.

    Args:
        results: Rows of results.csv, or their figures (`figures_of`), with their `domain`.
        columns: The columns.

    Returns:
        A row for each domain and variant: `n_pairs`, and each column with the 95 % interval `..._low` to `..._high`.
    """
    rows: list[dict[str, Any]] = []
    for domain, cases in by_domain(results):
        for variant, own in cases.groupby("variant", sort=False):
            row: dict[str, Any] = {"domain": domain, "variant": str(variant), "n_pairs": len(own)}
            tunnels = tunnels_of(own)
            for column in columns:
                row |= _mean(stated(own, column.key), tunnels, column.key)
            rows.append(row)
    return pd.DataFrame(rows)


def _mean(values: Float64Array, tunnels: Int64Array, key: str) -> dict[str, float]:
    low, high = interval_over_tunnels(values, tunnels, statistic_of(key))
    return {key: (median if is_time(key) else mean)(values), f"{key}_low": low, f"{key}_high": high}


def _headlines(data: RunData) -> Table:
    """Return the headline figures of each method, best first; what is told the truth comes last."""
    ranked, shown, figures = rank_methods(data)
    if len(ranked) == 0:
        return Table((), ())
    is_first = ranked.groupby("domain").cumcount() < _MAX_METHODS
    first = ranked[is_first | (ranked["variant"] == shown_variant(data))]
    caption = (
        f"Headline figures: one row is one method, best first, at most {_MAX_METHODS} for each domain; means over "
        "session pairs (times: median)"
    )
    return methods_table(first, shown, figures, caption)


def surface_headlines(data: RunData) -> Table | None:
    """Return the headline figures of a run about rock that moved; None of any other."""
    table = off_grids(stored_table(data, "surface_table"), data)
    if len(table) == 0 or "surface" not in reported(data.provenance):
        return None
    if table["domain"].nunique() > 1:
        table = table[table["domain"] != ALL_DOMAINS]
    oracles_last = table.sort_values("variant", key=lambda names: names.map(is_told_the_truth), kind="stable")
    shown = [column for column in SURFACE_HEADLINES if table[column.key].notna().any()]
    caption = "Headline figures: one row is one method; means over session pairs (times: median)"
    order = oracles_last.sort_values("domain", key=lambda names: names.map(DOMAINS.index), kind="stable")
    return methods_table(order, shown, with_domain(data.results), caption)


def rank_methods(data: RunData) -> tuple[pd.DataFrame, list[Column], pd.DataFrame]:
    """Return the headline figures of every method in each domain, best first, which of them are shown, and the pairs.

    What is told the truth comes last. Empty where no pair can be compared.
    """
    cases = comparable(data)
    if len(cases) == 0:
        return pd.DataFrame(), [], cases
    figures = figures_of(cases)
    table = means_by_method(figures, HEADLINES)
    if table["domain"].nunique() > 1:  # all pairs together stand in the tables below
        table = table[table["domain"] != ALL_DOMAINS]
    pooled = pooled_recalls(data, cases).drop(columns="n_pairs")
    if len(pooled):
        names = ["domain", "variant"]
        table = table.drop(columns=pooled.columns.difference(names)).merge(pooled, on=names, how="left")
    shown = [column for column in HEADLINES if table[column.key].notna().any()]
    # by what is better if higher, then by false alarms, as written; what is undefined comes last
    ranks = {column.key: -table[column.key].round(2).fillna(-math.inf) for column in shown if column.better == "high"}
    alarms = [column.key for column in shown if column.key in _ALARMS]
    ranks |= {key: table[key].round(2).fillna(math.inf) for key in alarms}
    order = pd.DataFrame({"domain": table["domain"], "oracle": table["variant"].map(is_told_the_truth), **ranks})
    return table.loc[order.sort_values(["domain", "oracle", *ranks], kind="stable").index], shown, figures


def _merge_headlines(merges: pd.DataFrame) -> Table:
    """Return the share of the pairs of each kind that each method merges as the kind asks, best first."""
    if len(merges) == 0:
        return Table((), ())
    own = merges[merges["family"] == ALL_FAMILIES]
    own = own.assign(pair_kind=name_kinds(own))
    kinds = list(dict.fromkeys(own["pair_kind"]))
    rows: list[tuple[float, tuple[Cell, ...]]] = []
    for variant, group in own.groupby("variant", sort=False):
        by_kind = {str(row["pair_kind"]): row for row in records(group)}
        cells = [_share_cell(by_kind.get(kind, {})) for kind in kinds]
        counts = (group["n_wrong_accepted"].sum(), group["n_refused"].sum(), group["n_failed"].sum())
        clean = next((row for kind, row in by_kind.items() if kind.startswith("clean")), {})
        error_m = clean.get("median_merge_error_m", math.nan)
        head = (Cell(spaced(str(variant))), Cell(str(group["n_pairs"].sum())))
        tail = (*(Cell(str(n)) for n in counts), Cell(fine(error_m)))
        rank = -float(group["n_within_target"].sum() / group["n_pairs"].sum()) + 10 * is_told_the_truth(str(variant))
        rows.append((rank, (*head, *cells, *tail)))
    rows.sort(key=lambda row: row[0])
    headings = ("method", "pairs", *(f"{kind}, right" for kind in kinds), "wrong, accepted", "refused", "failed",
                "error, clean pairs [m]")  # fmt: skip
    caption = "Headline figures: one row is one method, best first; share of the pairs merged as their kind asks"
    return Table(headings, tuple(("", cells) for _, cells in rows), caption)


def _share_cell(row: Mapping[str, Any]) -> Cell:
    value, low, high = (float(row.get(name, math.nan)) for name in ("share_within_target", "low", "high"))
    return Cell(share(value), interval=written_interval(low, high, share))


def _sentence(data: RunData, merges: pd.DataFrame) -> str:
    """Return how much the run holds, what went wrong in it, and how many targets are met."""
    results = pd.DataFrame(list(data.results))
    covered = covered_by(data)
    n_pairs, n_methods = len(results[PAIR].drop_duplicates()), results["variant"].nunique()
    parts = [] if covered.is_whole else [covered.sentence.removesuffix(".")]
    parts.append(f"{_counted(n_pairs, 'session pair')}, {_counted(n_methods, 'variant')}")
    if data.others and data.condition is not None:
        n_others = len({(row["scenario"], row["seed"]) for row in data.others})
        parts.append(
            f"figures are of the pairs with {data.condition.words}, those of {_counted(n_others, 'other pair')} stand "
            "in tables beside them"
        )
    bad = [row for row in data.results if text(row, "status") != "ok"]
    n_unmade = sum(is_unmade(row) for row in bad)
    if len(bad) > n_unmade:
        meaning = "ended without a merge" if ends_at_merge(data) else "gave no answer and count as finding nothing"
        parts.append(f"{len(bad) - n_unmade} of {len(results)} cases {meaning}")
    if n_unmade:
        n_lost = len({(row["scenario"], row["seed"]) for row in bad if is_unmade(row)})
        parts.append(f"{_counted(n_lost, 'pair')} could not be made and {'is' if n_lost == 1 else 'are'} in no mean")
    if n_assumed := int((numbers(results, "is_auroc_assumed")[(results["status"] == "ok").to_numpy()] == 1).sum()):
        parts.append(f"{_counted(n_assumed, 'answer')} without keyframe scores: AUROC 0.5 is assumed")
    own = merges[merges["family"] == ALL_FAMILIES] if len(merges) else merges
    wrong = (numbers(results, "merge_error_m") > RIGHT_M) | (numbers(results, "merge_error_deg") > RIGHT_DEG)
    # where pairs have a kind, a merge of sessions without a common place is wrong too
    n_of_kinds = int(own["n_wrong_accepted"].sum()) if len(own) else 0
    if n_wrong := n_of_kinds + int((wrong & (kinds(results) == "")).sum()):
        told = f"{_counted(n_wrong, 'accepted merge')} {'is' if n_wrong == 1 else 'are'} wrong"
        parts.append(f"{told} (over {RIGHT_M:g} m or {RIGHT_DEG:g} deg)")
    verdicts = list(own[own["variant"] == shown_variant(data)]["is_met"]) if len(own) else []
    for name in ("regions", "objects", "surface"):
        targets = stored_table(data, f"{name}_targets")
        verdicts += list(targets["is_met"]) if len(targets) else []
    verdicts = [bool(value) for value in verdicts if not pd.isna(value)]
    if verdicts and covered.is_whole:
        parts.append(f"{sum(verdicts)} of {len(verdicts)} targets of the plan are met")
    if is_contended(data):
        parts.append("times were measured beside other work")
    return f"{'; '.join(parts)}."


def _counted(n: int, word: str) -> str:
    return f"{n} {word}" if n == 1 else f"{n} {word}s"
