"""The regions on the page: who finds the changed places and at which price, with the targets of `tunnelcd`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd

from eval.core.domains import domain_name
from eval.core.tablefile import table_file
from eval.report.charts import Chart
from eval.report.cost.pareto import with_domain
from eval.report.merge.merge import covered_by
from eval.report.regions.charts import draw_free_response, draw_roc, draw_sizes
from eval.report.story import about_failures, joined
from eval.report.tables import Cell, Table, beside, best, used_pairs
from eval.running.run_data import BASELINES, RunData, off_grids
from eval.running.runfolder import reported
from eval.tables.columns import EN_DASH, UNDEFINED, Column, share, significant, spaced
from eval.tables.region_table import ALL_DOMAINS, FILES, MAIN_VARIANT


def _ms(seconds: float) -> str:
    return significant(1000.0 * seconds)


REGION_COLUMNS = (
    Column("region_auroc", "AUROC", "high", share,
           "How well keyframe scores tell places near a change from places far from any; mean over pairs, below it the "
           "95 % bootstrap interval over pairs.",
           "Undefined for a pair without an answer, or with keyframes of one class only."),
    Column("region_auroc_pooled", "pooled", "high", share,
           "The same over all keyframes of all pairs at once, scores as they are.", ""),
    Column("region_recall_at_k", "recall at K", "high", share,
           "Share of the K observable changes of a pair that its K best candidates find, without what was withdrawn.",
           "0 without an answer."),
    Column("recall_at_0.1", "recall at 0.1 false", "high", share,
           "Share of all observable changes found at the lowest threshold with at most 0.1 false regions per 100 m of "
           "after path, changed and unchanged pairs together; a threshold for each method and kind of site.",
           "0 for the changes of a pair without an answer."),
    Column("recall_at_0.5", "at 0.5", "high", share, "The same at 0.5 false regions per 100 m.", ""),
    Column("recall_at_0.1_proposed", "at 0.1, proposed", "high", share,
           "At 0.1 false regions per 100 m as if no region had been withdrawn: what the scores alone can do.", ""),
    Column("region_recall", "recall", "high", share, "Share found at the method's own, calibrated threshold.", ""),
    Column("region_precision", "precision", "high", share, "True among true and false regions.",
           "Undefined where nothing was reported."),
    Column("false_regions_per_100m", "false / 100 m", None, share,
           "False regions at the method's own threshold, over the whole way of all pairs together.", ""),
    Column("bytes_ratio", "map / kept", None, significant,
           "How many times smaller than the thinned before map that is which a method keeps of it to find regions; "
           "1: the map itself.", ""),
    Column("t_descriptor_per_keyframe_s", "t_descriptor / keyframe [ms]", None, _ms,
           "Median; can be done while mapping.", ""),
    Column("t_cd_per_region_s", "t_cd / region [ms]", None, _ms, "Median.",
           "Undefined where no region was reported."),
)  # fmt: skip
_SILENT = Column("silent_share", "silent", "high", share, "", "")


@dataclass(frozen=True, slots=True)
class RegionPart:
    """What the page shows of the regions of a run.

    Attributes:
        sentences: The first paragraph of a page about regions alone.
        judged: Those of its sentences that say how much was run, and which targets are met.
        tables: Every method, silence, targets.
        plots: ROC, free response, recall by size.
        missing: What is not there.
    """

    sentences: tuple[str, ...]
    judged: tuple[str, ...]
    tables: tuple[Table, ...]
    plots: tuple[Chart, ...]
    missing: tuple[str, ...]


def draw_regions(data: RunData) -> RegionPart | None:
    """Return tables and plots of the regions; None where the plan of the run does not ask for them."""
    if "regions" not in reported(data.provenance):
        return None
    files = {name: table_file(data.folder.path / f"{name}.csv") for name in FILES}
    found = {name: pd.read_csv(path) for name, path in files.items() if path.is_file()}
    missing = tuple(
        f"{name}.csv is not in the run folder: `tunnelcd score` makes it." for name in FILES[:1] if name not in found
    )
    if "regions_table" not in found:
        return RegionPart((missing[0],), (missing[0],), (), (), missing)
    shown = {name: off_grids(each, data) if "variant" in each else each for name, each in found.items()}
    table = shown["regions_table"]
    targets = found.get("regions_targets", pd.DataFrame(columns=["target", "is_met"]))
    tables = (regions_table(table, with_domain(data.results)), silence_table(table), targets_table(targets))
    plots = (
        draw_roc(shown.get("roc"), table),
        draw_free_response(shown.get("froc"), table),
        draw_sizes(shown.get("regions_by_size"), table),
    )
    return RegionPart(
        tuple(story(table, targets, data)),
        tuple(about_targets(targets, data)),
        tuple(each for each in tables if each.rows),
        tuple(each for each in plots if each is not None),
        missing,
    )


def regions_table(table: pd.DataFrame, cases: pd.DataFrame) -> Table:
    """Return every method in and out of distribution, the best of each domain marked.

    Args:
        table: Rows of regions_table.csv.
        cases: Rows of results.csv with their `domain`, which tell over how many pairs a mean is.
    """
    rows: list[tuple[str, tuple[Cell, ...]]] = []
    for domain, own in table.groupby("domain", sort=False):
        of_domain = cases if domain == ALL_DOMAINS else cases[cases["domain"] == domain]
        marks, counts = {}, {}
        for column in REGION_COLUMNS:
            counts[column.key] = [used_pairs(of_domain, str(name), column.key) for name in own["variant"]]
            marks[column.key] = best(list(own[column.key]), column, [n for n, _ in counts[column.key]])
        for index, row in enumerate(_records(own)):
            cells = (
                _cell(row, column, marks[column.key][index], counts=counts[column.key][index])
                for column in REGION_COLUMNS
            )
            pairs = Cell(str(row["n_pairs"]), interval=f"{row['n_failed']} failed" if row["n_failed"] else "")
            rows.append((_group(str(domain), row), (Cell(spaced(str(row["variant"]))), pairs, *cells)))
    headings = ("method", "pairs", *(column.heading for column in REGION_COLUMNS))
    return Table(headings, tuple(rows), "Every method, in and out of the training distribution")


def silence_table(table: pd.DataFrame) -> Table:
    """Return how often every method stays silent where nothing changed; no row where no pair is unchanged."""
    table = table[table["n_unchanged"] > 0]
    if len(set(table["domain"])) == 2:  # one, and the same again as all pairs
        table = table[table["domain"] != "all"]
    rows = []
    for row in _records(table):
        cells = (
            Cell(str(row["variant"])),
            _cell(row, _SILENT, is_best=False, low="silent_low", high="silent_high"),
            Cell(f"{row['n_silent']:.0f} of {row['n_unchanged']:.0f}"),
            Cell(share(row["false_regions_per_100m_unchanged"])),
            Cell(significant(row["km_unchanged"])),
        )
        rows.append((domain_name(str(row["domain"])), cells))
    headings = ("method", "silent", "pairs", "false / 100 m", "km driven")
    return Table(headings, tuple(rows), "Pairs in which nothing changed (interval: Wilson's 95 % over pairs)")


def targets_table(targets: pd.DataFrame) -> Table:
    """Return what is asked of `tunnelcd` and whether it is met; what is missed is bold."""
    rows = []
    for row in _records(targets):
        is_met = row["is_met"]
        word = UNDEFINED if pd.isna(is_met) else "met" if bool(is_met) else "missed"
        interval = "" if math.isnan(row["low"]) else f"{significant(row['low'])} to {significant(row['high'])}"
        cells = (
            Cell(f"{row['target']} ({row['variant']})"), Cell(domain_name(str(row["domain"]))), Cell(str(row["asked"])),
            Cell(significant(row["value"]), interval=interval), Cell(str(row["n"])), Cell(word, word == "missed"),
        )  # fmt: skip
        rows.append(("", cells))
    return Table(("target", "where", "asked", "found", "pairs", ""), tuple(rows), "What is asked, and what is found")


def about_targets(targets: pd.DataFrame, data: RunData) -> list[str]:
    """Say how much of the plan was run, if not all, and how many targets are met."""
    covered = covered_by(data)
    sentences = [covered.sentence] if covered is not None and not covered.is_whole else []
    judged = targets[targets["is_met"].notna()]
    missed: dict[str, list[str]] = {}
    for row in _records(judged):
        if not row["is_met"]:
            missed.setdefault(str(row["target"]), []).append(str(row["domain"]))
    if len(judged):
        n_met = len(judged) - sum(map(len, missed.values()))
        words = f"{n_met} of the {len(judged)} targets that this run can judge are met"
        named = [f"{name} ({', '.join(domains)})" for name, domains in missed.items()]
        sentences.append(f"{words}; missed: {joined(named)}." if named else f"{words}.")
    return sentences


def story(table: pd.DataFrame, targets: pd.DataFrame, data: RunData) -> list[str]:
    """Return the first sentences of the page: verdict, then who wins where by how much."""
    sentences = about_targets(targets, data)
    for domain, own in table[table["domain"] != "all"].groupby("domain", sort=False):
        for column, name in (("recall_at_0.1", "recall at 0.1 false regions per 100 m"), ("region_auroc", "AUROC")):
            sentences += _winner(str(domain), own, column, name)
    sentences += _silence(table)
    whole = table.drop_duplicates("variant", keep="last")
    sentences += about_failures(data)
    sentences.append(
        f"n = {int(whole['n_pairs'].max())} session pairs, {len(whole)} methods; intervals are 95 % over session pairs."
    )
    return sentences


def _winner(domain: str, own: pd.DataFrame, column: str, name: str) -> list[str]:
    """Say who is best, by how much, and where `tunnelcd` stands if it is not."""
    written = {
        str(row["variant"]): round(float(row[column]), 2) for row in _records(own) if not math.isnan(row[column])
    }
    if not written:
        return []
    top = max(written.values())
    winners = [variant for variant, value in written.items() if value == top]
    others = {variant: value for variant, value in written.items() if variant not in winners}
    verb = "tie at" if len(winners) > 1 else "is best with"
    told = f"{domain_name(domain).capitalize()}, {name}: {joined(winners)} {verb} {share(top)}"
    second = max(others, key=lambda variant: others[variant], default="")
    if second:
        told += f", {share(top - others[second])} ahead of {second} ({share(others[second])})"
    if MAIN_VARIANT in others and second != MAIN_VARIANT:
        told += f"; {MAIN_VARIANT} has {share(others[MAIN_VARIANT])}"
    told += "."
    if set(winners) <= set(BASELINES):
        told += f" A simple baseline wins here ({joined(winners)})."
    return [told]


def _silence(table: pd.DataFrame) -> list[str]:
    own = table.drop_duplicates("variant", keep="last")
    own = own[own["n_unchanged"] > 0]
    parts = [f"{row['variant']} {row['n_silent']:.0f} of {row['n_unchanged']:.0f}" for row in _records(own)]
    km = float(own["km_unchanged"].max()) if len(own) else 0.0
    return [f"Silent where nothing changed ({significant(km)} km): {', '.join(parts)}."] if parts else []


def _cell(
    row: Mapping[str, Any],
    column: Column,
    is_best: bool,
    low: str = "",
    high: str = "",
    counts: tuple[int, int] = (0, 0),
) -> Cell:
    ends = [float(row.get(name, math.nan)) for name in (low or f"{column.key}_low", high or f"{column.key}_high")]
    interval = "" if math.isnan(ends[0]) else f"{column.shown(ends[0])}{EN_DASH}{column.shown(ends[1])}"
    return Cell(column.shown(float(row[column.key])), is_best, beside(interval, *counts))


def _group(domain: str, row: Mapping[str, Any]) -> str:
    pairs = "1 pair" if row["n_pairs"] == 1 else f"{row['n_pairs']} pairs"
    return f"{domain_name(domain)}: {pairs}, {row['n_observable']} observable changes"


def _records(table: pd.DataFrame) -> list[dict[str, Any]]:
    return [{str(key): value for key, value in row.items()} for row in table.to_dict("records")]
