"""The regions on the page: how many changed places each method finds, at how many false ones; and the targets."""

from __future__ import annotations

import pandas as pd

from eval.core.domains import domain_name
from eval.plans.targets import read_targets
from eval.report.regions.budgets import budget_areas, draw_budgets
from eval.report.regions.charts import draw_free_response, draw_roc, draw_sizes
from eval.report.tables import (
    Cell,
    Section,
    Table,
    conditions_table,
    interval_of_row,
    methods_table,
    targets_table,
    with_rows,
)
from eval.running.results.grids import off_grids
from eval.running.results.run_data import RunData, every_condition, shown_variant, stored_table
from eval.running.runfolder import reported
from eval.tables.columns import Column, scaled, select, share, significant
from eval.tables.rows import records, with_domain

_ms = scaled(1000.0)
REGION_COLUMNS = (
    Column("region_auroc", "AUROC", "high", share,
           "How well scores tell places near a change from places far from any; mean over pairs, 0.5 for one without "
           "an answer, below it the 95 % bootstrap interval, drawn over tunnels.",
           "Undefined for a pair with places of one class only."),
    Column("region_auroc_pooled", "pooled", "high", share,
           "The same over all places of all pairs at once, scores as they are."),
    Column("region_recall_at_k", "recall at K", "high", share,
           "Share of the K observable changes of a pair that its K best candidates find, without what was withdrawn.",
           "0 without an answer."),
    Column("recall_at_0.1", "recall at 0.1 false", "high", share,
           "Share of all observable changes found at the lowest threshold with at most 0.1 false regions per 100 m of "
           "after path, changed and unchanged pairs together; a threshold for each method and kind of site.",
           "A pair without an answer misses its changes and counts as ten times the false regions allowed on it."),
    Column("recall_at_0.5", "at 0.5", "high", share, "The same at 0.5 false regions per 100 m."),
    Column("recall_at_0.1_proposed", "at 0.1, proposed", "high", share,
           "At 0.1 false regions per 100 m as if no region had been withdrawn: what the scores alone can do."),
    Column("region_recall", "recall", "high", share, "Share found at the method's own, calibrated threshold."),
    Column("region_precision", "precision", "high", share, "True among true and false regions.",
           "0 for a changed pair where nothing was reported."),
    Column("false_regions_per_100m", "false / 100 m", None, share,
           "False regions at the method's own threshold, over the whole way of all pairs together."),
    Column("bytes_ratio", "map / kept", None, significant,
           "How many times smaller than the thinned before map that is which a method keeps of it to find regions; "
           "1: the map itself."),
    Column("t_descriptor_per_keyframe_s", "t_descriptor / keyframe [ms]", None, _ms,
           "Median; can be done while mapping."),
    Column("t_cd_per_region_s", "t_cd / region [ms]", None, _ms, "Median.",
           "Undefined where no region was reported."),
)  # fmt: skip
_CURVES = ("roc", "froc", "regions_by_size", "budgets")
_CAPTION = "Regions: one row is one method on the pairs in or out of the training distribution"


_CONDITIONS_CAPTION = "Regions by odometry and sensor: the first row of a method is what the other figures are of"
_COMPARED = select(
    REGION_COLUMNS, "region_auroc", "region_recall_at_k", "recall_at_0.1", "recall_at_0.5", "region_recall",
    "region_precision", "false_regions_per_100m",
)  # fmt: skip


def draw_regions(data: RunData) -> Section | None:
    """Return tables and plots of the regions; None where the plan of the run does not ask for them."""
    if "regions" not in reported(data.provenance):
        return None
    found = {name: off_grids(stored_table(data, name), data) for name in ("regions_table", *_CURVES)}
    table, main = found["regions_table"], shown_variant(data)
    if len(table) == 0:
        return Section(missing=("regions_table.csv is not in the run folder: `tunnelcd score` makes it.",))
    methods = methods_table(table, REGION_COLUMNS, with_domain(data.results), _CAPTION)
    conditions = conditions_table(
        off_grids(every_condition(data, "regions_table"), data), _COMPARED, _CONDITIONS_CAPTION
    )
    tables = (
        methods, conditions, silence_table(table), targets_table(stored_table(data, "regions_targets")),
        budget_areas(found["budgets"]),
    )  # fmt: skip
    first = [main, *(target.less for target in read_targets(data.provenance).regions if target.less)]
    plots = (
        draw_roc(found["roc"], table, main), draw_free_response(found["froc"], table),
        draw_budgets(found["budgets"]), draw_sizes(found["regions_by_size"], table, first),
    )  # fmt: skip
    return Section(with_rows(tables), tuple(each for each in plots if each is not None))


def silence_table(table: pd.DataFrame) -> Table:
    """Return how often every method stays silent where nothing changed; no row where no pair is unchanged."""
    table = table[table["n_unchanged"] > 0]
    if len(set(table["domain"])) == 2:  # one, and the same again as all pairs
        table = table[table["domain"] != "all"]
    rows = []
    for row in records(table):
        cells = (
            Cell(str(row["variant"])),
            Cell(share(row["silent_share"]), interval=interval_of_row(row, "silent", share)),
            Cell(f"{row['n_silent']:.0f} of {row['n_unchanged']:.0f}"),
            Cell(share(row["false_regions_per_100m_unchanged"])),
            Cell(significant(row["km_unchanged"])),
        )
        rows.append((domain_name(str(row["domain"])), cells))
    headings = ("method", "silent", "pairs", "false / 100 m", "km driven")
    return Table(headings, tuple(rows), "Unchanged pairs: one row is one method; interval: Wilson's 95 % over tunnels")
