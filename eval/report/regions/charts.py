"""The charts about regions: ROC, free response, and recall by what a change is like."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from eval.core.charts import Axis, Drawing, Look, Panel, Series, named_ticks
from eval.core.domains import domain_name
from eval.report.drawing.charts import Chart
from eval.report.drawing.looks import line_of, look_of
from eval.tables.columns import EN_DASH, share
from eval.tables.regions.curves import RATES_PER_100M
from eval.tables.rows import ALL_DOMAINS

_FAINT, _LIMIT = Look("#d0d0d0", 0.8), Look("#c4c4c4", 0.8)
_LEAST_RATE, _MOST_RATE = 0.01, 10.0
_MEASURES = {"hull_volume_m3": "hull of the object [m³]", "n_returns": "returns", "range_m": "shortest range [m]"}
_MAX_LINES = 5


def draw_roc(curves: pd.DataFrame, table: pd.DataFrame, main: str) -> Chart | None:
    """Return true against false positive rate of the keyframes, a panel for each domain and a line for each method.

    Args:
        curves: Rows of roc.csv.
        table: Rows of regions_table.csv.
        main: The method whose areas are named.
    """
    panels: list[Panel] = []
    areas = table[table["variant"] == main].set_index("domain")["region_auroc_pooled"]
    told = []
    for domain, methods in _domains(curves):
        lines = [
            Series(own["false_positive_rate"], own["true_positive_rate"], line_of(method), method,
                   hover="{x:.3f} of the unchanged, {y:.3f} of the changed keyframes")
            for method, own in methods.items()
        ]  # fmt: skip
        x = Axis("false positive rate (keyframes far from any change)", (0.0, 1.0))
        y = Axis("" if panels else "true positive rate (keyframes near a change)", (0.0, 1.01))
        panels.append(Panel(x, y, [Series([0, 1], [0, 1], _FAINT), *lines], domain_name(domain)))
        told += [f"{share(float(areas[domain]))} {domain_name(domain)}"] if domain in areas.index else []
    caption = (
        "All keyframes of all pairs together, scores as they are; a keyframe that was never compared comes last. Area "
        f"under the curve of {main}: {', '.join(told)}."
    )
    title = "How keyframe scores tell changed places from unchanged ones"
    return Chart("roc", title, Drawing([panels], 360), caption, has_png=True) if panels else None


def draw_free_response(curves: pd.DataFrame, table: pd.DataFrame) -> Chart | None:
    """Return recall against false regions per 100 m, a panel for each domain; dots: the methods' own thresholds.

    A rate below 0.01 is drawn at 0.01, the left border; lines end at 10, where dots of more are drawn.

    Args:
        curves: Rows of froc.csv.
        table: Rows of regions_table.csv.
    """
    panels: list[Panel] = []
    own_places = table.assign(recall=table["n_found"] / table["n_observable"].where(table["n_observable"] > 0))
    for domain, methods in _domains(curves):
        series = [Series([rate, rate], [0.0, 1.03], _LIMIT) for rate in RATES_PER_100M]
        for name, curve in methods.items():
            look, hover = line_of(name), "{x:.3g} false regions per 100 m, recall {y:.3f}"
            drawn = curve[curve["false_regions_per_100m"] <= _MOST_RATE]
            x = np.append(drawn["false_regions_per_100m"], _MOST_RATE).clip(_LEAST_RATE, _MOST_RATE)
            y = np.append(drawn["recall"], drawn["recall"].iloc[-1] if len(drawn) else 0.0)
            series.append(Series(x, y, look, name, "steps", hover=hover))
            own = own_places[(own_places["domain"] == domain) & (own_places["variant"] == name)]
            own = own[own["false_regions_per_100m"].notna()]
            if len(own):
                at = own["false_regions_per_100m"].clip(_LEAST_RATE, _MOST_RATE)
                dot = replace(look_of(name), width=0.0)
                series.append(Series(at, own["recall"], dot, name, hover=hover))
        x_axis = Axis("false regions per 100 m", (0.93 * _LEAST_RATE, _MOST_RATE), is_log=True)
        y_axis = Axis("" if panels else "recall of observable changes", (0.0, 1.03))
        panels.append(Panel(x_axis, y_axis, series, domain_name(domain)))
    rates = " and ".join(f"{rate:g}" for rate in RATES_PER_100M)
    caption = (
        f"Lines: every candidate, reported or not. Dots: the methods' own thresholds. Vertical lines: {rates} false "
        "regions per 100 m. Rates of 0.01 and less are at the left border, dots of 10 and more at the right one. "
        "Changed and unchanged pairs together; a pair without an answer misses all its changes, and counts more false "
        "regions than it is allowed."
    )
    title = "Changes found against false regions, as the threshold falls"
    return Chart("free_response", title, Drawing([panels], 360), caption, has_png=True) if panels else None


def draw_sizes(sizes: pd.DataFrame, table: pd.DataFrame, first: Sequence[str]) -> Chart | None:
    """Return recall by what a change is like: a row for each domain, a column for each measure, a line for each method.

    Args:
        sizes: Rows of regions_by_size.csv.
        table: Rows of regions_table.csv.
        first: Methods that are shown before any other; the interval is that of the first.
    """
    shown, rows = _shown_methods(table, first), []
    for domain, methods in _domains(sizes):
        row: list[Panel] = []
        for measure, title in _MEASURES.items():
            bins = {name: methods[name][methods[name]["measure"] == measure] for name in shown if name in methods}
            bins = {name: own.sort_values("low") for name, own in bins.items() if len(own)}
            if bins:
                row.append(_size_panel(bins, title, "" if row else f"recall, {domain_name(domain)}"))
        rows += [row] if row else []
    others = "" if len(shown) == table["variant"].nunique() else " All methods are in regions_by_size.csv."
    caption = (
        f"At {RATES_PER_100M[0]:g} false regions per 100 m. n: observable changes of the bin; bars: 95 % interval of "
        f"{shown[-1]}, drawn over tunnels with the threshold held fixed.{others}"
    )
    title = "Recall by what a change is like"
    return Chart("recall_by_size", title, Drawing(rows, 260), caption, has_png=True) if rows else None


def _size_panel(bins: Mapping[str, pd.DataFrame], title: str, y_title: str) -> Panel:
    """Return the lines of some methods over the bins of one measure; the interval is that of the last method."""
    lows = sorted({low for own in bins.values() for low in own["low"]})
    series = []
    for place, (name, own) in enumerate(bins.items()):
        # side by side, so that equal values do not hide each other
        x = np.array([lows.index(low) for low in own["low"]]) + 0.07 * (place - (len(bins) - 1) / 2)
        low, high = (own["interval_low"], own["interval_high"]) if name == list(bins)[-1] else (None, None)
        series.append(Series(x, own["recall_at_rate"], look_of(name), name, low=low, high=high, hover="recall {y:.2f}"))
    every = pd.concat(bins.values()).drop_duplicates("low").sort_values("low")
    names = [
        f"{f'≥{low:g}' if math.isinf(high) else f'<{high:g}' if low == 0 else f'{low:g}{EN_DASH}{high:g}'}\nn {n}"
        for low, high, n in every[["low", "high", "n_changes"]].itertuples(index=False, name=None)
    ]
    x_axis = Axis(title, (-0.4, len(names) - 0.6), ticks=named_ticks(names), tick_pt=5.5)
    return Panel(x_axis, Axis(y_title, (-0.02, 1.05)), series)


def _domains(table: pd.DataFrame) -> Iterator[tuple[str, dict[str, pd.DataFrame]]]:
    """Yield every domain but all pairs together, with the rows of each of its methods."""
    if len(table) == 0:
        return
    for domain, own in table[table["domain"] != ALL_DOMAINS].groupby("domain", sort=False):
        yield str(domain), {str(name): rows for name, rows in own.groupby("variant", sort=False)}


def _shown_methods(table: pd.DataFrame, wanted: Sequence[str]) -> list[str]:
    """Return up to five methods, the one whose interval is drawn last: ours, the rivals, and the best of the rest."""
    means = table.drop_duplicates("variant", keep="last").set_index("variant")["recall_at_0.1"]
    ranked = [str(name) for name in means.sort_values(ascending=False, kind="stable").index]
    first = [name for name in dict.fromkeys(wanted) if name in ranked]
    chosen = [*first, *(name for name in ranked if name not in first)][:_MAX_LINES]
    return chosen[::-1]
