"""Charts as data, and their picture: series over two axes, in panels, with one legend.

A chart is described once. `picture` draws it with matplotlib; `eval.report.charts` makes the interactive form of the
same description for the page.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from cdpipe.core.geometry import Float64Array
from eval.core.figures import BLACK, BLUE, GREEN, ORANGE, VERMILLION, blank_figure

Dash = Literal["solid", "dash", "dot", "dashdot"]
COLOURS = (BLACK, BLUE, ORANGE, GREEN, VERMILLION)
GRID_COLOUR, HEAT_COLOURS = "#efefef", ("#ffffff", "#6baed6")
BAR_SHARE = 0.75
_PX_PER_IN = 88.0
_DASHES: dict[Dash, Any] = {"solid": "solid", "dash": (0, (5, 2)), "dot": (0, (1, 1.5)), "dashdot": "dashdot"}
_MARKERS = {
    "": "", "circle": "o", "square": "s", "diamond": "D", "triangle-up": "^", "triangle-down": "v", "pentagon": "p",
    "star": "*", "hexagon": "h", "x": "X",
}  # fmt: skip
SYMBOLS = tuple(_MARKERS)[1:]


@dataclass(frozen=True, slots=True)
class Look:
    """How a series is drawn.

    Attributes:
        colour: As #rrggbb.
        width: Of the line in points; 0: no line.
        dash: Of the line.
        marker: One of `SYMBOLS` at every point; "" for none.
        size: Of the marker, points.
        is_hollow: Whether the marker is an outline.
        opacity: From 0 to 1.
    """

    colour: str = BLACK
    width: float = 1.4
    dash: Dash = "solid"
    marker: str = ""
    size: float = 5.0
    is_hollow: bool = False
    opacity: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Points of one look.

    Attributes:
        x: (N,) places on the x axis.
        y: (N,) places on the y axis; NaN is left out.
        look: How they are drawn.
        name: Entry of the legend, shared by all series of that name; "" for none.
        style: Joined directly, joined by steps (the value holds until the next point), or bars up from 0.
        low: (N,) lower ends of the intervals around the points; None for no intervals.
        high: (N,) upper ends.
        is_across: Whether the intervals lie along x.
        labels: (N,) texts written beside the points; () for none.
        hover: What the page shows under the pointer: one template of plotly, or one text for each point.
    """

    x: npt.ArrayLike
    y: npt.ArrayLike
    look: Look = Look()
    name: str = ""
    style: Literal["line", "steps", "bars"] = "line"
    low: npt.ArrayLike | None = None
    high: npt.ArrayLike | None = None
    is_across: bool = False
    labels: Sequence[str] = ()
    hover: str | Sequence[str] = ""

    @property
    def intervals(self) -> Float64Array | None:
        """(2, N) lengths of the intervals below and above the points."""
        if self.low is None or self.high is None:
            return None
        middle = np.asarray(self.x if self.is_across else self.y, dtype=np.float64)
        return np.stack([middle - np.asarray(self.low), np.asarray(self.high) - middle])


@dataclass(frozen=True, slots=True, eq=False)
class Heat:
    """A heat map: (R, C) values in cells around the places 0 to C - 1 of x and 0 to R - 1 of y.

    Attributes:
        values: (R, C) numbers, NaN for an empty cell.
        texts: (R, C) what stands in the cells.
        low: The value that is white.
        high: The value that is blue.
        hover: Template of plotly for what the page shows under the pointer.
    """

    values: Float64Array
    texts: Sequence[Sequence[str]]
    low: float
    high: float
    hover: str = ""


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis of a panel.

    Attributes:
        title: Its name with its unit.
        span: Its ends, which may fall; None where the data decide. A logarithmic axis needs it.
        is_log: Whether it is logarithmic.
        ticks: What stands at which place; None for a choice by `span` or by the data.
        tick_pt: Size of that, points.
    """

    title: str = ""
    span: tuple[float, float] | None = None
    is_log: bool = False
    ticks: Mapping[float, str] | None = None
    tick_pt: float = 7.0

    @property
    def marks(self) -> Mapping[float, str] | None:
        """The ticks that are given, or 1 and 3 of every power of ten on a logarithmic axis."""
        if self.ticks is not None or not self.is_log or self.span is None:
            return self.ticks
        powers = range(math.floor(math.log10(min(self.span))), math.ceil(math.log10(max(self.span))) + 1)
        digits = (1.0, 3.0) if len(powers) < 6 else (1.0,)
        return {value: f"{value:g}" for power in powers for digit in digits if (value := digit * 10.0**power)}


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """Series over two axes, the first at the back."""

    x: Axis
    y: Axis
    series: Sequence[Series]
    heading: str = ""
    heat: Heat | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """Rows of panels, `row_px` high on the page; rows may differ in length."""

    rows: Sequence[Sequence[Panel]]
    row_px: int

    @property
    def n_columns(self) -> int:
        """Panels in the longest row."""
        return max(map(len, self.rows))

    @property
    def legend(self) -> dict[str, Series]:
        """The first series of every name, in the order of the panels."""
        found: dict[str, Series] = {}
        for each in (series for row in self.rows for panel in row for series in panel.series if series.name):
            found.setdefault(each.name, each)
        return found


def named_ticks(names: Sequence[str]) -> dict[float, str]:
    """Return ticks at 0, 1, 2 ... of an axis of names."""
    return {float(place): name for place, name in enumerate(names)}


def picture(drawing: Drawing) -> Figure:
    """Return the chart as a matplotlib figure, 9 inches wide (6 where the panels are in one column)."""
    n_rows, is_wide = len(drawing.rows), drawing.n_columns > 1
    figure = blank_figure(9.0 if is_wide else 6.0, 0.5 + n_rows * drawing.row_px / _PX_PER_IN)
    for row, panels in zip(figure.subplots(n_rows, drawing.n_columns, squeeze=False), drawing.rows, strict=True):
        for axes, panel in zip_longest(row, panels):
            if panel is None:
                axes.set_axis_off()
            else:
                _draw_panel(axes, panel)
    handles = [_legend_entry(name, series) for name, series in drawing.legend.items()]
    if handles:
        n_columns = min(len(handles), 5 if is_wide else 3)
        figure.legend(handles=handles, loc="outside upper center", ncols=n_columns, fontsize=8, frameon=False)
    return figure


def _draw_panel(axes: Axes, panel: Panel) -> None:
    axes.grid(color=GRID_COLOUR, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.set_title(panel.heading, fontsize=9)
    if panel.heat is not None:
        _draw_heat(axes, panel.heat)
    bars = [each for each in panel.series if each.style == "bars"]
    for series in panel.series:
        if series.style == "bars":
            _draw_bars(axes, series, (bars.index(series) - (len(bars) - 1) / 2) / len(bars), BAR_SHARE / len(bars))
        else:
            _draw_series(axes, series)
    for name, axis in (("x", panel.x), ("y", panel.y)):
        own = axes.xaxis if name == "x" else axes.yaxis
        axes.set(**{f"{name}scale": "log" if axis.is_log else "linear"})
        own.set_label_text(axis.title, fontsize=8)
        if axis.marks is not None:
            own.set_ticks(list(axis.marks), list(axis.marks.values()))
        if axis.span is not None:  # after the ticks, which widen it
            axes.set(**{f"{name}lim": axis.span})
        own.set_tick_params(labelsize=axis.tick_pt)
    axes.minorticks_off()
    axes.spines[["top", "right"]].set_visible(False)


def _draw_series(axes: Axes, series: Series) -> None:
    x, y = np.asarray(series.x, dtype=np.float64), np.asarray(series.y, dtype=np.float64)
    look = series.look
    axes.plot(x, y, drawstyle="steps-post" if series.style == "steps" else "default", **_line(look))
    if series.intervals is not None:
        lengths_y, lengths_x = (None, series.intervals) if series.is_across else (series.intervals, None)
        axes.errorbar(x, y, lengths_y, lengths_x, fmt="none", ecolor=look.colour, elinewidth=1.0, alpha=0.6)
    for place, label in zip(zip(x, y, strict=True), series.labels, strict=False):
        axes.annotate(
            label,
            place,
            (-3, 2),
            textcoords="offset points",
            ha="right",
            va="bottom",
            fontsize=7,
            annotation_clip=False,
        )


def _draw_bars(axes: Axes, series: Series, offset: float, width: float) -> None:
    hatch = "" if series.look.dash == "solid" else "///"
    x = np.asarray(series.x, dtype=np.float64) + BAR_SHARE * offset
    axes.bar(x, np.asarray(series.y), width, color=series.look.colour, hatch=hatch, edgecolor="white", linewidth=0.0)
    if series.intervals is not None:
        axes.errorbar(x, np.asarray(series.y), yerr=series.intervals, fmt="none", ecolor="#444444", elinewidth=1.0)


def _draw_heat(axes: Axes, heat: Heat) -> None:
    colours = LinearSegmentedColormap.from_list("heat", HEAT_COLOURS)
    axes.imshow(heat.values, cmap=colours, vmin=heat.low, vmax=heat.high, origin="lower", aspect="auto")
    for (row, column), _ in np.ndenumerate(heat.values):
        axes.text(column, row, heat.texts[row][column], ha="center", va="center", fontsize=7)


def _line(look: Look) -> dict[str, Any]:
    return {
        "color": look.colour, "linewidth": look.width, "linestyle": _DASHES[look.dash] if look.width else "none",
        "marker": _MARKERS[look.marker], "markersize": look.size, "alpha": look.opacity,
        "markerfacecolor": "white" if look.is_hollow else look.colour,
    }  # fmt: skip


def _legend_entry(name: str, series: Series) -> Line2D | Patch:
    if series.style == "bars":
        return Patch(color=series.look.colour, label=name)
    return Line2D([], [], label=name, **_line(series.look))
