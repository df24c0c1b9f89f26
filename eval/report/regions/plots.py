"""Plots over the methods of a run about regions: ROC, free response, and recall by what a change is like."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter

from cdpipe.core.geometry import Float64Array
from eval.core.domains import domain_name
from eval.core.figures import BLACK, BLUE, GREEN, ORANGE, VERMILLION, blank_figure, png

_WIDTH_IN = 9.0
_SKY, _PURPLE, _GREY, _TEAL, _WINE = "#56B4E9", "#CC79A7", "#8a8a8a", "#44AA99", "#882255"
DASHED, DOTTED = (0, (5, 2)), (0, (1, 1.5))
_LOOKS: dict[str, dict[str, Any]] = {
    "tunnelcd": {"color": BLACK, "linewidth": 2.2},
    "voxel-diff": {"color": ORANGE, "linewidth": 1.6},
    "c2c": {"color": VERMILLION, "linewidth": 1.6},
    "sphere-difference": {"color": GREEN, "linewidth": 1.6},
    "paper": {"color": BLUE, "linewidth": 1.4},
    "paper-paired": {"color": BLUE, "linewidth": 1.4, "linestyle": DASHED},
    "paper-topn": {"color": BLUE, "linewidth": 1.4, "linestyle": "dashdot"},
    "m3c2": {"color": _TEAL, "linewidth": 1.6},
    "dufomap": {"color": _WINE, "linewidth": 1.6},
    "scan-context": {"color": _PURPLE, "linewidth": 1.2},
    "solid": {"color": _PURPLE, "linewidth": 1.2, "linestyle": DASHED},
    "untrained": {"color": _SKY, "linewidth": 1.2},
    "random-regions": {"color": _GREY, "linewidth": 1.2, "linestyle": DOTTED},
}
_OTHERS: tuple[dict[str, Any], ...] = tuple(
    {"color": colour, "linewidth": 1.2, "linestyle": "dashdot"} for colour in (BLUE, ORANGE, GREEN, VERMILLION, _PURPLE)
)
LEAST_RATE, MOST_RATE = 0.01, 10.0


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
        names: What stands under each.
        recall: (N,) recall, NaN where there is no change.
        low: (N,) lower end of its interval, NaN for none.
        high: (N,) upper end.
    """

    names: Sequence[str]
    recall: Float64Array
    low: Float64Array
    high: Float64Array


def roc_plot(panels: Mapping[str, Mapping[str, Curve]]) -> bytes:
    """Draw true against false positive rate as PNG, a panel for each domain and a line for each method."""
    figure, axes_of = _panels([list(panels)], 4.1)
    for axes, (domain, curves) in zip(axes_of[0], panels.items(), strict=True):
        axes.plot([0, 1], [0, 1], color="#d0d0d0", linewidth=0.8)
        for name, curve in curves.items():
            axes.plot(curve.x, curve.y, **line_look(name, list(curves)))
        axes.set(xlim=(0, 1), ylim=(0, 1.005), aspect="equal")
        axes.set_title(domain_name(domain), fontsize=9)
        axes.set_xlabel("keyframes far from any change, called changed", fontsize=8)
    axes_of[0][0].set_ylabel("keyframes near a change, called changed", fontsize=8)
    _legend(figure, panels.values())
    return png(figure)


def free_response_plot(panels: Mapping[str, Mapping[str, Curve]], rates: Sequence[float]) -> bytes:
    """Draw recall against false regions per 100 m, a panel for each domain, as PNG; dots: the methods' own thresholds.

    Args:
        panels: Curves by domain and method.
        rates: Where vertical lines stand.
    """
    figure, axes_of = _panels([list(panels)], 4.1)
    for axes, (domain, curves) in zip(axes_of[0], panels.items(), strict=True):
        for rate in rates:
            axes.axvline(rate, color="#c4c4c4", linewidth=0.8)
        for name, curve in curves.items():
            look = line_look(name, list(curves))
            # what comes at no false region at all stands at the left border
            x = np.clip(np.append(curve.x, MOST_RATE), LEAST_RATE, MOST_RATE)
            axes.plot(x, np.append(curve.y, curve.y[-1:]), drawstyle="steps-post", **look)
            if curve.own is not None:
                own = (float(np.clip(curve.own[0], LEAST_RATE, MOST_RATE)), curve.own[1])
                axes.plot(*own, marker="o", markersize=5, color=look["color"], markeredgecolor="white", zorder=4)
        axes.set_xscale("log")
        axes.set(xlim=(LEAST_RATE, MOST_RATE), ylim=(0, 1.02))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_title(domain_name(domain), fontsize=9)
        axes.set_xlabel("false regions per 100 m", fontsize=8)
    axes_of[0][0].set_ylabel("observable changes found", fontsize=8)
    _legend(figure, panels.values())
    return png(figure)


def size_plot(panels: Mapping[str, Mapping[str, Mapping[str, Bins]]]) -> bytes:
    """Draw recall over bins as PNG: a row for each domain, a column for each measure, a line for each method.

    Args:
        panels: Bins by domain, heading of the measure, and method; intervals are drawn of the last method.
    """
    figure, axes_of = _panels([list(measures) for measures in panels.values()], 2.6)
    for row, (domain, measures) in zip(axes_of, panels.items(), strict=True):
        for axes, (measure, methods) in zip(row, measures.items(), strict=True):
            for index, (name, bins) in enumerate(methods.items()):
                look = line_look(name, list(methods))
                bin_places = np.arange(len(bins.names))
                # side by side, that lines at one height do not hide each other
                places = bin_places + 0.07 * (index - (len(methods) - 1) / 2)
                axes.plot(places, bins.recall, marker="o", markersize=3.5, **look)
                if name == list(methods)[-1]:
                    axes.vlines(places, bins.low, bins.high, color=look["color"], linewidth=1.0, alpha=0.6)
                axes.set_xticks(bin_places, bins.names, fontsize=5.5)
            axes.set_xlim(-0.4, len(bin_places) - 0.6)
            axes.set(ylim=(-0.02, 1.04))
            axes.set_xlabel(measure, fontsize=8)
        row[0].set_ylabel(f"recall, {domain_name(domain)}", fontsize=8)
    _legend(figure, [methods for measures in panels.values() for methods in measures.values()])
    return png(figure)


def _panels(rows: Sequence[Sequence[str]], height_in: float) -> tuple[Figure, list[list[Axes]]]:
    figure = blank_figure(_WIDTH_IN, 0.5 + height_in * len(rows))
    grid = figure.subplots(len(rows), max(map(len, rows)), squeeze=False)
    for row, names in zip(grid, rows, strict=True):
        for axes in row[len(names) :]:
            axes.set_axis_off()
        for axes in row:
            axes.tick_params(labelsize=7)
            axes.grid(color="#efefef", linewidth=0.6)
            axes.set_axisbelow(True)
            for side in ("top", "right"):
                axes.spines[side].set_visible(False)
    return figure, [list(row[: len(names)]) for row, names in zip(grid, rows, strict=True)]


def line_look(name: str, names: Sequence[str]) -> dict[str, Any]:
    """Return matplotlib's look of a method's line: its own, or one of a few in the order of `names`."""
    unknown = [each for each in names if each not in _LOOKS]
    return _LOOKS[name] if name in _LOOKS else _OTHERS[unknown.index(name) % len(_OTHERS)]


def _legend(figure: Figure, groups: Any) -> None:
    every = [list(group) for group in groups]
    looks = {name: line_look(name, names) for names in every for name in names}
    handles = [Line2D([], [], label=name, **look) for name, look in looks.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=min(len(handles), 5), fontsize=8, frameon=False)
