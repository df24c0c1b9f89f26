"""The charts about regions, as plotly figures: ROC, free response, and recall by what a change is like.

Each has a twin in `eval.report.regions.plots`, of the same data and in the same looks, for papers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from eval.core.domains import domain_name
from eval.report.charts import SOFT, add_heading, axes_of, error_bars, in_legend, layout, line_of, set_axis
from eval.report.regions.plots import LEAST_RATE, MOST_RATE, Bins, Curve

Figure = dict[str, Any]
_TICKS = [0.01, 0.03, 0.1, 0.3, 1, 3, 10]


def roc_figure(panels: Mapping[str, Mapping[str, Curve]]) -> Figure:
    """Return true against false positive rate of the keyframes, a panel for each domain and a line for each method."""
    names = _names(panels.values())
    found = layout(len(panels), 1, 360, names)
    data: list[Figure] = []
    seen: set[str] = set()
    for index, (domain, curves) in enumerate(panels.items()):
        add_heading(found, index, domain_name(domain))
        set_axis(found, "x", index, "keyframes far from any change, called changed", range=[0, 1])
        set_axis(found, "y", index, "" if index else "keyframes near a change, called changed", range=[0, 1.01])
        chance = {"x": [0, 1], "y": [0, 1], "mode": "lines", "line": {"color": "#d0d0d0", "width": 1}}
        data.append({**chance, **axes_of(index), "showlegend": False, "hoverinfo": "skip"})
        data += [
            {"x": curve.x, "y": curve.y, "mode": "lines", "line": line_of(name, list(curves)), **axes_of(index),
             **in_legend(name, seen), "hovertemplate": "%{x:.3f} of far, %{y:.3f} of near keyframes"}
            for name, curve in curves.items()
        ]  # fmt: skip
    return {"data": data, "layout": found}


def free_response_figure(panels: Mapping[str, Mapping[str, Curve]], rates: Sequence[float]) -> Figure:
    """Return recall against false regions per 100 m, a panel for each domain; dots: the methods' own thresholds.

    Args:
        panels: Curves by domain and method.
        rates: Where vertical lines stand.
    """
    names = _names(panels.values())
    found = layout(len(panels), 1, 360, names, shapes=[])
    data: list[Figure] = []
    seen: set[str] = set()
    for index, (domain, curves) in enumerate(panels.items()):
        add_heading(found, index, domain_name(domain))
        ends = np.log10([LEAST_RATE * 0.93, MOST_RATE]).tolist()
        ticks = {"tickvals": _TICKS, "ticktext": [f"{value:g}" for value in _TICKS]}
        set_axis(found, "x", index, "false regions per 100 m", type="log", range=ends, **ticks)
        set_axis(found, "y", index, "" if index else "observable changes found", range=[0, 1.03])
        axes = axes_of(index)
        found["shapes"] += [
            {"type": "line", "xref": axes["xaxis"], "yref": f"{axes['yaxis']} domain", "x0": rate, "x1": rate, "y0": 0,
             "y1": 1, "line": {"color": "#c4c4c4", "width": 1}, "layer": "below"}
            for rate in rates
        ]  # fmt: skip
        for name, curve in curves.items():
            line = line_of(name, list(curves))
            # what comes at no false region at all stands at the left border
            x = np.clip(np.append(curve.x, MOST_RATE), LEAST_RATE, MOST_RATE)
            hover = "%{x:.3g} false regions per 100 m, recall %{y:.3f}"
            common = {**axes, "legendgroup": name, "name": name, "hovertemplate": hover}
            y = np.append(curve.y, curve.y[-1:])
            steps = {"x": x, "y": y, "mode": "lines", "line": {**line, "shape": "hv"}}
            data.append({**common, **steps, **in_legend(name, seen)})
            if curve.own is not None:
                dot = {"size": 9, "color": line["color"], "line": {"color": "#fff", "width": 1}}
                own = {"x": [float(np.clip(curve.own[0], LEAST_RATE, MOST_RATE))], "y": [curve.own[1]]}
                data.append({**common, **own, "mode": "markers", "marker": dot, "showlegend": False})
    return {"data": data, "layout": found}


def size_figure(panels: Mapping[str, Mapping[str, Mapping[str, Bins]]]) -> Figure:
    """Return recall over bins: a row for each domain, a column for each measure, a line for each method.

    Args:
        panels: Bins by domain, heading of the measure, and method; intervals are those of the last method.
    """
    names = _names(methods for measures in panels.values() for methods in measures.values())
    n_columns = max(map(len, panels.values()))
    found = layout(n_columns, len(panels), 260, names)
    data: list[Figure] = []
    seen: set[str] = set()
    for row, (domain, measures) in enumerate(panels.items()):
        for column, (measure, methods) in enumerate(measures.items()):
            index = row * n_columns + column
            bins = next(iter(methods.values()))
            ticks = {
                "tickvals": list(range(len(bins.names))),
                "ticktext": [n.replace("\n", "<br>n ") for n in bins.names],
            }
            set_axis(found, "x", index, measure, **ticks, range=[-0.4, len(bins.names) - 0.6], tickangle=0)
            found["xaxis" if index == 0 else f"xaxis{index + 1}"]["tickfont"] = {"size": 9, "color": SOFT}
            set_axis(found, "y", index, "" if column else f"recall, {domain_name(domain)}", range=[-0.02, 1.05])
            for place, (name, own) in enumerate(methods.items()):
                line = line_of(name, list(methods))
                x = np.arange(len(own.names)) + 0.07 * (place - (len(methods) - 1) / 2)
                bars = error_bars(own.recall, own.low, own.high, line["color"]) if name == list(methods)[-1] else {}
                trace = {"x": x, "y": own.recall, "mode": "lines+markers", "line": line, "marker": {"size": 5}}
                hover = {"hovertemplate": f"recall %{{y:.2f}}, {domain_name(domain)}"}
                more = {"error_y": bars} if bars else {}
                data.append({**trace, **more, **hover, **axes_of(index), **in_legend(name, seen)})
    return {"data": data, "layout": found}


def _names(groups: Any) -> list[str]:
    return list(dict.fromkeys(name for group in groups for name in group))
