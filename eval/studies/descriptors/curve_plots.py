"""The chart of `eval.studies.descriptors.curves`: a column for each thing that was varied, a row for each measure."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from eval.core.charts import BLUE, VERMILLION, Axis, Drawing, Look, Panel, Series, log_span

_MEASURES = (
    ("log_likelihood", 1.0, "log-likelihood"),
    ("auroc", 1.0, "AUROC, mean of tunnels"),
    ("unchanged_above_0", 100.0, "unchanged above 0 [%]"),
    ("changes_found", 100.0, "changes found at 0 [%]"),
)
# column, title of the axis
_VARIED = (
    ("numbers", "numbers stored per keyframe"),
    ("width", "channels, shipped = 1"),
    ("tunnels", "training tunnels"),
    ("bits", "bits of each stored number"),
)
_GROUPS = (("", BLUE, "all validation tunnels"), ("_tight", VERMILLION, "family tight"))
_READERS = ((True, "reads the after image"), (False, "compares the numbers alone"))
_BASE = {"numbers": 64, "width": 1.0, "share": 1.0, "bits": 32}


def curves_chart(table: pd.DataFrame) -> Drawing:
    """Draw every measure against budget, width, data and precision, as far as they were varied.

    Args:
        table: Rows of curves.csv; those without a seed are of the shipped network.
    """
    own, shipped = table[table["seed"].notna()], table[table["seed"].isna()]
    shown = [(name, label) for name, label in _VARIED if name == "bits" or varying(own, name, True)[name].nunique() > 1]
    rows = []
    for measure, scale, title in _MEASURES:
        series = {name: list(_lines(own, name, measure, scale)) for name, _ in shown}
        # two bits a number would flatten everything else: that panel has an axis of its own
        values = [value for name, _ in shown if name != "bits" for each in series[name] for value in np.ravel(each.y)]
        room = 0.05 * float(np.ptp(values or [0.0])) or 0.5
        span = (min(values) - room, max(values) + room) if values else None
        series["bits"] += _stars(shipped, measure, scale)
        row: list[Panel] = []
        for name, label in shown:
            ticks = {float(tick): f"{tick:g}" for tick in np.unique(table[name].dropna())}
            x_title = label if measure == _MEASURES[-1][0] else ""
            x = Axis(x_title, log_span(list(ticks), 1.2, 1.2), is_log=True, ticks=ticks)
            row.append(Panel(x, Axis("" if row else title, None if name == "bits" else span), series[name]))
        rows.append(row)
    return Drawing(rows, 200)


def varying(table: pd.DataFrame, varied: str, reads_after: bool) -> pd.DataFrame:
    """Return the rows that differ from the base point in one thing alone."""
    mask = table["reads_after"].astype(bool) == reads_after
    for name, value in _BASE.items():
        if name != {"tunnels": "share"}.get(varied, varied):
            mask &= table[name] == value
    return table[mask]


def _lines(table: pd.DataFrame, name: str, measure: str, scale: float) -> Iterator[Series]:
    """Yield for each group and kind of network every trained network as a dot, and the line of their means."""
    for group, colour, group_name in _GROUPS:
        for reads_after, reader in _READERS if measure + group in table else ():
            chosen = varying(table, name, reads_after)
            values = scale * chosen[measure + group]
            means = values.groupby(chosen[name]).mean()
            dots = Look(colour, 0.0, marker="circle", size=4.0, is_hollow=not reads_after, opacity=0.75)
            yield Series(chosen[name], values, dots)
            look = Look(colour, 1.2, "solid" if reads_after else "dash")
            yield Series(means.index, means, look, f"{group_name}, {reader}")


def _stars(shipped: pd.DataFrame, measure: str, scale: float) -> Iterator[Series]:
    for group, colour, group_name in _GROUPS:
        if measure + group in shipped:
            look = Look(colour, 0.0, marker="star", size=8.0)
            yield Series(shipped["bits"], scale * shipped[measure + group], look, f"{group_name}, shipped weights")
