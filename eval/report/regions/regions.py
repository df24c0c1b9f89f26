"""The regions on the page: who finds the changed places and at which price, with the targets of `tunnelcd`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from eval.core.domains import domain_name
from eval.core.tablefile import table_file
from eval.report.charts import Chart
from eval.report.cost.pareto import with_domain
from eval.report.merge.merge import covered_by
from eval.report.regions.charts import Bins, Curve, free_response_chart, roc_chart, size_chart
from eval.report.story import about_failures, joined
from eval.report.tables import Cell, Table, beside, best, used_pairs
from eval.running.run_data import BASELINES, RunData, off_grids
from eval.running.runfolder import reported
from eval.tables.columns import EN_DASH, UNDEFINED, Column, share, significant, spaced
from eval.tables.region_curves import RATES_PER_100M
from eval.tables.region_table import ALL_DOMAINS, FILES, MAIN_VARIANT, RIVALS


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
_MEASURES = {"hull_volume_m3": "hull of the object [m³]", "n_returns": "returns", "range_m": "shortest range [m]"}
_MAX_LINES = 5


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
        _roc(shown.get("roc"), table),
        _free_response(shown.get("froc"), table),
        _sizes(shown.get("regions_by_size"), table),
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


def _roc(curves: pd.DataFrame | None, table: pd.DataFrame) -> Chart | None:
    panels = _curves(curves, ("false_positive_rate", "true_positive_rate"))
    if not panels:
        return None
    return Chart(
        "roc",
        "How keyframe scores tell changed places from unchanged ones",
        roc_chart(panels),
        "Over all keyframes of all pairs at once, scores as they are (a keyframe that was never compared comes last). "
        f"Area of {MAIN_VARIANT if MAIN_VARIANT in set(table['variant']) else table['variant'].iloc[0]}: "
        + ", ".join(_areas(table, list(panels))),
        has_png=True,
    )


def _areas(table: pd.DataFrame, domains: Sequence[str]) -> list[str]:
    name = MAIN_VARIANT if MAIN_VARIANT in set(table["variant"]) else str(table["variant"].iloc[0])
    own = table[table["variant"] == name].set_index("domain")["region_auroc_pooled"]
    return [f"{share(float(own[domain]))} {domain_name(domain)}" for domain in domains if domain in own.index]


def _free_response(curves: pd.DataFrame | None, table: pd.DataFrame) -> Chart | None:
    panels = _curves(curves, ("false_regions_per_100m", "recall"))
    if not panels:
        return None
    for row in _records(table):
        curve = panels.get(str(row["domain"]), {}).get(str(row["variant"]))
        recall = row["n_found"] / row["n_observable"] if row["n_observable"] else math.nan
        if curve is not None and not math.isnan(row["false_regions_per_100m"]):
            own = (float(row["false_regions_per_100m"]), float(recall))
            panels[str(row["domain"])][str(row["variant"])] = Curve(curve.x, curve.y, own)
    return Chart(
        "free_response",
        "Changes found against false regions, as the threshold falls",
        free_response_chart(panels, RATES_PER_100M),
        f"Lines: every candidate, reported or not. Dots: the methods' own thresholds. Vertical: "
        f"{' and '.join(f'{rate:g}' for rate in RATES_PER_100M)} false regions per 100 m; what lies at the left border "
        "has 0.01 or fewer. Changed and unchanged pairs together; a pair without an answer misses all its changes.",
        has_png=True,
    )


def _sizes(sizes: pd.DataFrame | None, table: pd.DataFrame) -> Chart | None:
    if sizes is None or len(sizes) == 0:
        return None
    shown = _shown_methods(table)
    panels: dict[str, dict[str, dict[str, Bins]]] = {}
    for domain in [name for name in dict.fromkeys(sizes["domain"]) if name != "all"]:
        for measure, heading in _MEASURES.items():
            own = sizes[(sizes["domain"] == domain) & (sizes["measure"] == measure)]
            ranges = own[["low", "high"]].drop_duplicates().sort_values("low")
            methods = {
                name: _bins(own[own["variant"] == name], ranges) for name in shown if (own["variant"] == name).any()
            }
            if methods:
                panels.setdefault(str(domain), {})[heading] = methods
    if not panels:
        return None
    others = "" if len(shown) == table["variant"].nunique() else " All methods are in regions_by_size.csv."
    return Chart(
        "recall_by_size",
        "Recall by what a change is like",
        size_chart(panels),
        f"At {RATES_PER_100M[0]:g} false regions per 100 m. Under each bin the number of observable changes; bars: "
        f"95 % interval over pairs of {shown[-1]}.{others}",
        has_png=True,
    )


def _shown_methods(table: pd.DataFrame) -> list[str]:
    """Return up to five methods, the one whose interval is drawn last: ours, the rivals, and the best of the rest."""
    means = table.drop_duplicates("variant", keep="last").set_index("variant")["recall_at_0.1"]
    ranked = [str(name) for name in means.sort_values(ascending=False, kind="stable").index]
    first = [name for name in (MAIN_VARIANT, *RIVALS) if name in ranked]
    chosen = [*first, *(name for name in ranked if name not in first)][:_MAX_LINES]
    return chosen[::-1]


def _bins(own: pd.DataFrame, ranges: pd.DataFrame) -> Bins:
    rows = {float(row["low"]): row for row in _records(own)}
    names, values = [], []
    for low, high in ranges.itertuples(index=False, name=None):
        row = rows.get(float(low), {})
        bounds = f"≥{low:g}" if math.isinf(high) else f"<{high:g}" if low == 0 else f"{low:g}{EN_DASH}{high:g}"
        names.append(f"{bounds}\n{row.get('n_changes', 0)}")
        values.append([row.get(key, math.nan) for key in ("recall_at_rate", "interval_low", "interval_high")])
    return Bins(names, *np.array(values, dtype=np.float64).T)


def _curves(curves: pd.DataFrame | None, columns: tuple[str, str]) -> dict[str, dict[str, Curve]]:
    if curves is None or len(curves) == 0:
        return {}
    panels: dict[str, dict[str, Curve]] = {}
    for (domain, variant), own in curves[curves["domain"] != "all"].groupby(["domain", "variant"], sort=False):
        x, y = (own[column].to_numpy(dtype=np.float64) for column in columns)
        panels.setdefault(str(domain), {})[str(variant)] = Curve(x, y)
    return panels


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
