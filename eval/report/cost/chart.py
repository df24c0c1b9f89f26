"""Quality against cost as a plotly figure: every method a point with its name on hover, the front joined and named."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd

from eval.core.domains import domain_name
from eval.core.figures import BLACK, BLUE
from eval.report.charts import add_heading, axes_of, error_bars, in_legend, layout, line_of, set_axis
from eval.report.cost.plots import COSTS, is_apart, known_costs

_GREY = "#8a8a8a"
_MAX_IN_LEGEND = 24
_SYMBOLS = ("circle", "square", "diamond", "triangle-up", "triangle-down", "pentagon", "star", "hexagon", "x")

Figure = dict[str, Any]


def pareto_figure(own: pd.DataFrame, words: str) -> Figure:
    """Return the points of one quality, a row of panels for each domain and a column for each cost.

    Args:
        own: Rows of `eval.report.cost.pareto.pareto_table` of one quality.
        words: What the quality is called.
    """
    domains, costs = list(dict.fromkeys(own["domain"])), known_costs(own)
    names = [str(name) for name in dict.fromkeys(own["variant"])]
    is_named = len(names) <= _MAX_IN_LEGEND
    found = layout(len(costs), len(domains), 300, names if is_named else ())
    data: list[Figure] = []
    seen: set[str] = set()
    for row, domain in enumerate(domains):
        for column, cost in enumerate(costs):
            index = row * len(costs) + column
            points = _records(own[(own["domain"] == domain) & (own["cost"] == cost)])
            n_pairs = max((int(point["n_pairs"]) for point in points), default=0)
            add_heading(found, index, f"{domain_name(str(domain))}, {n_pairs} pairs")
            ends = _span(points, cost)
            set_axis(found, "x", index, COSTS[cost][0], type="log", range=ends, **_ticks(*ends))
            set_axis(found, "y", index, "" if column else words, range=[-0.06, 1.12])
            data += [{**_front(points, cost), **axes_of(index)}]
            for point in points:
                look = _look(point, points, names, is_named=is_named)
                data.append(
                    {
                        **_point(point, cost, is_named=is_named),
                        **look,
                        **axes_of(index),
                        **in_legend(str(point["variant"]), seen),
                    }
                )
    return {"data": data, "layout": found}


def _front(points: list[dict[str, Any]], cost: str) -> Figure:
    best = sorted((point for point in points if point["is_on_front"]), key=lambda point: point["cost_value"])
    line = {"color": BLUE, "width": 1.6, "shape": "hv"}
    x = [point["cost_value"] / COSTS[cost][1] for point in best]
    y = [point["quality_value"] for point in best]
    return {"x": x, "y": y, "mode": "lines", "line": line, "showlegend": False, "hoverinfo": "skip"}


def _span(points: list[dict[str, Any]], cost: str) -> list[float]:
    """Return the ends of the axis, powers of ten, with room for names; what costs nothing is not on it."""
    x = np.array([point["cost_value"] / COSTS[cost][1] for point in points], dtype=np.float64)
    ends = np.log10(x[x > 0]) if (x > 0).any() else np.zeros(1)
    return [float(ends.min()) - 0.6, float(ends.max()) + 0.2]


def _ticks(low: float, high: float) -> dict[str, Any]:
    """Return ticks at 1 and 3 of each power of ten; low and high are powers."""
    powers = range(math.floor(low), math.ceil(high) + 1)
    values = [digit * 10.0**power for power in powers for digit in (1.0, 3.0)]
    return {"tickvals": values, "ticktext": [f"{value:g}" for value in values]}


def _point(point: dict[str, Any], cost: str, *, is_named: bool) -> Figure:
    at, value = point["cost_value"] / COSTS[cost][1], point["quality_value"]
    interval = f"{value:.3f} (95 %: {point['low']:.3f} to {point['high']:.3f}, n {point['n_quality']})"
    hover = f"<b>{point['variant']}</b><br>{interval}<br>{at:.3g}, {COSTS[cost][0]}<extra></extra>"
    # a name with settings is as long as the panel is wide; the legend has it
    is_labelled = point["is_on_front"] and not (is_named and "[" in point["variant"])
    return {
        "x": [at], "y": [value], "mode": "markers+text" if is_labelled else "markers", "hovertemplate": hover,
        "text": [f"<b>{point['variant']}</b>" if is_labelled else ""], "textposition": "top left",
        "cliponaxis": False,
        "textfont": {"size": 10, "color": BLACK},
    }  # fmt: skip


def _look(point: dict[str, Any], points: list[dict[str, Any]], names: list[str], *, is_named: bool) -> Figure:
    place = names.index(str(point["variant"]))
    colour = line_of(names[place], names)["color"] if is_named else BLACK if point["is_on_front"] else _GREY
    symbol = _SYMBOLS[place % len(_SYMBOLS)] if is_named else "circle"
    hollow = "-open" if is_apart(point, points) else ""
    bars = error_bars([point["quality_value"]], [point["low"]], [point["high"]], colour)
    return {"marker": {"size": 9, "color": colour, "symbol": symbol + hollow}, "error_y": bars}


def _records(own: pd.DataFrame) -> list[dict[str, Any]]:
    return [{str(key): value for key, value in row.items()} for row in own.to_dict("records")]
