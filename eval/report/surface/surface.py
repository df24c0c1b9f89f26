"""Rock that moved on the page: how well each method measures it, and how small a displacement each one finds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from eval.core.charts import Axis, Drawing, Panel, Series
from eval.core.domains import domain_name
from eval.report.drawing.charts import Chart
from eval.report.drawing.looks import look_of
from eval.report.surface.unrolled import draw_unrolled
from eval.report.tables import Section, conditions_table, methods_table, targets_table, with_rows
from eval.running.results.grids import off_grids
from eval.running.results.run_data import RunData, every_condition, stored_table
from eval.running.results.values import number
from eval.running.runfolder import reported
from eval.scoring.surface.windows import AREAS_M2
from eval.tables.columns import Column, scaled, select, share, significant
from eval.tables.rows import ALL_DOMAINS, is_told_the_truth, with_domain
from eval.tables.surface.limits import EDGES_M, MAGNITUDES_M
from eval.tables.surface.table import limit_column

_mm = scaled(1000.0)
_CAPTION = "Rock that moved: one row is one method on the pairs in or out of the training distribution"
_CONDITIONS_CAPTION = "Rock that moved, by odometry: the first row of a method is what the other figures are of"
SURFACE_COLUMNS = (
    Column("surface_cover", "surface measured", "high", share,
           "Share of the judged places, one per 0.25 m of rock that both sessions saw, with an answered displacement "
           "within 0.3 m."),
    Column("surface_error_median_changed_m", "error where rock moved, median [mm]", "low", _mm,
           "Answered less true displacement at the judged places that moved more than 1 mm; nothing answered "
           "counts as 0."),
    Column("surface_error_p95_changed_m", "95th percentile [mm]", "low", _mm),
    Column("surface_bias_changed_m", "bias [mm]", None, _mm,
           "Mean error in the direction in which the rock moved: negative where too little is answered."),
    Column("surface_error_median_unchanged_m", "error elsewhere, median [mm]", None, _mm,
           "The same where nothing moved. A method that measures less of the surface errs less: read it beside the "
           "share measured."),
    Column("surface_error_p95_unchanged_m", "95th percentile, elsewhere [mm]", None, _mm),
    Column("surface_bias_unchanged_m", "bias, elsewhere [mm]", None, _mm),
    Column("surface_level_inside", "inside its level", None, share,
           "Share of the unchanged places measured whose displacement is within the claimed 95 % level of detection; "
           "0.95 is right. A place without a level is not inside."),
    Column("surface_level_median_m", "level, median [mm]", None, _mm,
           "A level that is too low costs the share inside instead.", "Undefined where no level is claimed."),
    Column("surface_recall", "recall", "high", share,
           "Share of the observable surface changes of which answered regions hold at least half of the places that "
           "moved most, with the right sign.", "Undefined where no rock moved."),
    Column("surface_region_precision", "precision of area", "high", share,
           "Share of the judged places in answered regions that moved more than 1 mm.",
           "0 where no region is answered; undefined where no rock moved and none is."),
    Column("surface_false_regions_per_100m", "false regions / 100 m", "low", share,
           "Answered regions with no place that moved."),
    Column("surface_volume_error_share", "volume off by [share]", "low", share,
           "Size of (answered - true) / true volume, at most 1, over observable scars and rubble; 1 where unanswered.",
           "Undefined on pairs without scars and rubble."),
    *(Column(limit_column(area), f"limit, {area:g} m² [mm]", "low", _mm,
             "Smallest displacement of which half of the windows of this area are found, with 5 % false alarms.",
             "Undefined where half of the largest are not found.") for area in AREAS_M2),
    Column("t_surface_s", "time [s]", "low", significant, "Median over pairs.", "Undefined where it is not stated."),
)  # fmt: skip
_COMPARED = select(
    SURFACE_COLUMNS, "surface_cover", "surface_error_median_changed_m", "surface_bias_changed_m",
    "surface_level_inside", "surface_recall", "surface_region_precision",
)  # fmt: skip


def draw_surface(data: RunData) -> Section | None:
    """Return tables, detection limits and unrolled maps; None where the run has no such figures."""
    if "surface" not in reported(data.provenance) or all(
        np.isnan(number(row, "surface_cover")) for row in data.every_result
    ):
        return None
    table, limits = (off_grids(stored_table(data, name), data) for name in ("surface_table", "detection_limits"))
    if len(table) == 0:
        return Section(missing=("surface_table.csv is not in the run folder: `tunnelcd score` makes it.",))
    rows = with_domain(data.results)
    pictures, missing = draw_unrolled(data)
    tables = [
        methods_table(table, SURFACE_COLUMNS, rows, _CAPTION),
        conditions_table(off_grids(every_condition(data, "surface_table"), data), _COMPARED, _CONDITIONS_CAPTION),
        targets_table(stored_table(data, "surface_targets")),
    ]
    plots = tuple(_limits_chart(own, str(domain)) for domain, own in _domains(limits))
    return Section(with_rows(tables), plots, pictures=tuple(pictures), missing=tuple(missing))


def _domains(limits: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    if len(limits) == 0:
        return []
    found = [(str(domain), own) for domain, own in limits.groupby("domain", sort=False)]
    own_merge = [(domain, own) for domain, own in found if not own["variant"].map(is_told_the_truth).all()]
    return [(domain, own) for domain, own in own_merge if domain != ALL_DOMAINS]


def _limits_chart(limits: pd.DataFrame, domain: str) -> Chart:
    """Draw the found share over the magnitude of the displacement, a panel for each area and a line for each method."""
    limits = limits[~limits["variant"].map(is_told_the_truth).astype(bool)]
    names = [str(name) for name in limits["variant"].unique()]
    panels = [
        _limits_panel(limits[limits["area_m2"] == area], area, names, is_first=index == 0)
        for index, area in enumerate(AREAS_M2)
    ]
    n_windows = int(limits.groupby("variant")["n_windows"].sum().max())
    caption = (
        "Share of the windows that are found, over the size of their mean displacement. The threshold of each method "
        "and area lets 5 % of its null windows pass. Bars: 95 % interval, tunnels drawn. "
        f"{domain_name(domain).capitalize()}, {n_windows} windows; detection_limits.csv has every point, and those of "
        "methods that were told the merge."
    )
    return Chart(f"detection_limits_{domain}", f"Detection limits, {domain_name(domain)}", Drawing([panels], 325),
                 caption, has_png=True)  # fmt: skip


def _limits_panel(limits: pd.DataFrame, area_m2: float, names: Sequence[str], *, is_first: bool) -> Panel:
    lines = []
    for name in names:
        own = limits[limits["variant"] == name]
        if len(own):
            magnitude_mm = 1000.0 * own["magnitude_m"].to_numpy(dtype=np.float64)
            share_found = own["found_share"].to_numpy(dtype=np.float64)
            low, high = own["found_share_low"], own["found_share_high"]
            lines.append(
                Series(magnitude_mm, share_found, look_of(name), name, low=low, high=high, hover="{x:.1f} mm: {y:.2f}")
            )
    ticks = {1000.0 * each: f"{1000 * each:g}" for each in MAGNITUDES_M}
    x = Axis("displacement [mm]", (1000.0 * EDGES_M[0], 600.0), is_log=True, ticks=ticks)
    y = Axis("windows found" if is_first else "", (-0.03, 1.03))
    return Panel(x, y, lines, f"{area_m2:g} m²")
