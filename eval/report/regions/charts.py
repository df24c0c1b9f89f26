"""The charts about regions: ROC, free response, and recall by what a change is like."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cdpipe.core.geometry import Float64Array
from eval.core.charts import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    VERMILLION,
    Axis,
    Dash,
    Drawing,
    Look,
    Panel,
    Series,
    named_ticks,
)
from eval.core.domains import domain_name

_SKY, _PURPLE, _GREY, _TEAL, _WINE = "#56B4E9", "#CC79A7", "#8a8a8a", "#44AA99", "#882255"
_LOOKS = {
    "tunnelcd": Look(BLACK, 2.2),
    "voxel-diff": Look(ORANGE, 1.6),
    "c2c": Look(VERMILLION, 1.6),
    "sphere-difference": Look(GREEN, 1.6),
    "paper": Look(BLUE),
    "paper-paired": Look(BLUE, dash="dash"),
    "paper-topn": Look(BLUE, dash="dashdot"),
    "m3c2": Look(_TEAL, 1.6),
    "dufomap": Look(_WINE, 1.6),
    "scan-context": Look(_PURPLE, 1.2),
    "solid": Look(_PURPLE, 1.2, "dash"),
    "untrained": Look(_SKY, 1.2),
    "random-regions": Look(_GREY, 1.2, "dot"),
}
_DASHES: tuple[Dash, ...] = ("dashdot", "dot")
_OTHERS = tuple(Look(colour, 1.2, dash) for dash in _DASHES for colour in (BLUE, ORANGE, GREEN, VERMILLION, _PURPLE))
_FAINT, _LIMIT = Look("#d0d0d0", 0.8), Look("#c4c4c4", 0.8)
_LEAST_RATE, _MOST_RATE = 0.01, 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A curve of (N,) points, and where the method's own threshold lies on it or beside it, None where it has none."""

    x: Float64Array
    y: Float64Array
    own: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Bins:
    """Recall of one method in N bins.

    Attributes:
        names: Text below each bin.
        recall: (N,) recall, NaN where there is no change.
        low: (N,) lower end of its interval, NaN for none.
        high: (N,) upper end.
    """

    names: Sequence[str]
    recall: Float64Array
    low: Float64Array
    high: Float64Array


def look_of(name: str, names: Sequence[str]) -> Look:
    """Return the look of a method: its own, or one of a few in the order of `names`."""
    unknown = [each for each in names if each not in _LOOKS]
    return _LOOKS[name] if name in _LOOKS else _OTHERS[unknown.index(name) % len(_OTHERS)]


def roc_chart(panels: Mapping[str, Mapping[str, Curve]]) -> Drawing:
    """Draw true against false positive rate of the keyframes, a panel for each domain and a line for each method."""
    found: list[Panel] = []
    for domain, curves in panels.items():
        lines = [
            Series(curve.x, curve.y, look_of(name, list(curves)), name,
                   hover="%{x:.3f} of the unchanged, %{y:.3f} of the changed keyframes")
            for name, curve in curves.items()
        ]  # fmt: skip
        x = Axis("false positive rate (keyframes far from any change)", (0.0, 1.0))
        y = Axis("" if found else "true positive rate (keyframes near a change)", (0.0, 1.01))
        found.append(Panel(x, y, [Series([0, 1], [0, 1], _FAINT), *lines], domain_name(domain)))
    return Drawing([found], 360)


def free_response_chart(panels: Mapping[str, Mapping[str, Curve]], rates: Sequence[float]) -> Drawing:
    """Draw recall against false regions per 100 m, a panel for each domain; dots: the methods' own thresholds.

    Args:
        panels: Curves by domain and method. A rate below 0.01 is drawn at 0.01, the left border.
        rates: Places of vertical lines, false regions per 100 m.
    """
    found: list[Panel] = []
    for domain, curves in panels.items():
        series = [Series([rate, rate], [0.0, 1.03], _LIMIT) for rate in rates]
        for name, curve in curves.items():
            look = look_of(name, list(curves))
            common: dict[str, Any] = {"name": name, "hover": "%{x:.3g} false regions per 100 m, recall %{y:.3f}"}
            x = np.clip(np.append(curve.x, _MOST_RATE), _LEAST_RATE, _MOST_RATE)
            series.append(Series(x, np.append(curve.y, curve.y[-1:]), look, style="steps", **common))
            if curve.own is not None:
                at = float(np.clip(curve.own[0], _LEAST_RATE, _MOST_RATE))
                series.append(Series([at], [curve.own[1]], replace(look, width=0.0, marker="circle"), **common))
        x_axis = Axis("false regions per 100 m", (0.93 * _LEAST_RATE, _MOST_RATE), is_log=True)
        y_axis = Axis("" if found else "recall of observable changes", (0.0, 1.03))
        found.append(Panel(x_axis, y_axis, series, domain_name(domain)))
    return Drawing([found], 360)


def size_chart(panels: Mapping[str, Mapping[str, Mapping[str, Bins]]]) -> Drawing:
    """Draw recall over bins: a row for each domain, a column for each measure, a line for each method.

    Args:
        panels: Bins by domain, heading of the measure, and method; intervals are those of the last method.
    """
    rows = []
    for domain, measures in panels.items():
        row: list[Panel] = []
        for measure, methods in measures.items():
            series = []
            for place, (name, own) in enumerate(methods.items()):
                # side by side, so that equal values do not hide each other
                x = np.arange(len(own.names)) + 0.07 * (place - (len(methods) - 1) / 2)
                low, high = (own.low, own.high) if name == list(methods)[-1] else (None, None)
                look = replace(look_of(name, list(methods)), marker="circle", size=3.5)
                series.append(Series(x, own.recall, look, name, low=low, high=high, hover="recall %{y:.2f}"))
            names = [text.replace("\n", "\nn ") for text in next(iter(methods.values())).names]
            x_axis = Axis(measure, (-0.4, len(names) - 0.6), ticks=named_ticks(names), tick_pt=5.5)
            y_axis = Axis("" if row else f"recall, {domain_name(domain)}", (-0.02, 1.05))
            row.append(Panel(x_axis, y_axis, series))
        rows.append(row)
    return Drawing(rows, 260)
