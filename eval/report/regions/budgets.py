"""What proposals save: recall against spheres looked at, seconds and bytes sent, and the areas below these curves."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from eval.core.charts import Axis, Drawing, Panel, Series, log_span
from eval.core.domains import domain_name
from eval.report.drawing.charts import Chart
from eval.report.drawing.looks import look_of
from eval.report.tables import Cell, Table, best_rows, interval_of_row
from eval.running.results.grids import split_variant
from eval.tables.columns import Column, share, spaced
from eval.tables.rows import ALL_DOMAINS, is_told_the_truth, records

_PRICES = {
    "spheres": "spheres looked at per 100 m",
    "seconds": "seconds per 100 m, after the merge",
    "bytes": "bytes sent, share of the before map",
}
_AREAS = {"spheres": "up to 12 spheres / 100 m", "seconds": "up to 10 s / 100 m", "bytes": "up to 10 % of the map"}
_AREA = Column("area", "area", "high", share)
_ALL_SITES = "all"
_RULE, _SHOWN_RULE = "extract.method", "surface"


def shown_budgets(budgets: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of budgets.csv of all sites together, one variant for each source where several rules were run.

    What is proposed does not depend on the extraction. So of such variants those with the surface rule stay, under the
    name of their preset.
    """
    if len(budgets) == 0:
        return budgets
    own = budgets[budgets["site"] == _ALL_SITES]
    rules = {name: split_variant(name)[1].get(_RULE) for name in dict.fromkeys(own["variant"].astype(str))}
    if _SHOWN_RULE not in rules.values() or len({rule for rule in rules.values() if rule}) < 2:
        return own
    kept = {name: split_variant(name)[0] for name, rule in rules.items() if rule == _SHOWN_RULE}
    return own[own["variant"].isin(kept)].replace({"variant": kept})


def draw_budgets(budgets: pd.DataFrame) -> Chart | None:
    """Return recall against each price: a row for each domain, a column for each price, a line for each method."""
    rows = []
    for domain, own in _domains(shown_budgets(budgets)):
        names = list(dict.fromkeys(own["variant"].astype(str)))
        row: list[Panel] = []
        for price, title in _PRICES.items():
            its = own[(own["price"] == price) & own["recall"].notna()]
            lines = [
                Series(part["budget"], part["recall"], look_of(name), name, hover="{x:.3g}: recall {y:.3f}")
                for name in names
                if len(part := its[its["variant"] == name])
            ]
            y_title = "" if row else f"recall, {domain_name(domain)}"
            x_axis = Axis(title, log_span(own.loc[own["price"] == price, "budget"], 1.1, 1.1), is_log=True)
            row.append(Panel(x_axis, Axis(y_title, (-0.02, 1.05)), lines))
        rows.append(row)
    caption = (
        "Candidates are looked at best first; a change is found at the first proposed sphere that finds it. Bytes: "
        "what the method keeps of the before session, and the before map's points in the spheres; of whole-map methods "
        "the map. Lines: all pairs together; a pair without an answer finds nothing."
    )
    title = "What proposals save: changes found against what looking for them costs"
    return Chart("budgets", title, Drawing(rows, 260), caption, has_png=True) if rows else None


def budget_areas(budgets: pd.DataFrame) -> Table:
    """Return the areas below the curves of `draw_budgets`: a row for each method, best first by bytes, oracles last."""
    shown = shown_budgets(budgets)
    rows = []
    for domain, own in _domains(shown):
        firsts = own.drop_duplicates(["variant", "price"])
        of_variant = {str(name): part for name, part in firsts.groupby("variant", sort=False)}
        areas = {name: dict(zip(part["price"], records(part), strict=True)) for name, part in of_variant.items()}
        names = sorted(areas, key=lambda name: (is_told_the_truth(name), -np.nan_to_num(areas[name]["bytes"]["area"])))
        its = {price: [areas[name][price] for name in names] for price in _PRICES}
        counts = {price: [int(row["n_changes"]) for row in rows_of] for price, rows_of in its.items()}
        marks = {price: best_rows(its[price], _AREA, counts[price]) for price in _PRICES}
        for place, name in enumerate(names):
            cells = [_area_cell(areas[name][price], is_best=marks[price][place]) for price in _PRICES]
            rows.append((domain_name(domain), (Cell(spaced(name)), *cells)))
    caption = "What proposals save: mean recall from no budget to the one in the heading; interval: 95 % over tunnels"
    return Table(("method", *_AREAS.values()), tuple(rows), caption)


def _area_cell(row: Mapping[str, Any], *, is_best: bool) -> Cell:
    return Cell(share(row["area"]), is_best, interval=interval_of_row(row, "area", share))


def _domains(table: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    if len(table):
        for domain, own in table[table["domain"] != ALL_DOMAINS].groupby("domain", sort=False):
            yield str(domain), own
