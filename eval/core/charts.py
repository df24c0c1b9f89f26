"""Charts as data: series over two axes, in panels, with one legend.

A chart is described once. `eval.core.figures.picture` draws it with matplotlib for papers; `eval.report.drawing.charts`
makes the elements of a page from the same description.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import Float64Array

Dash = Literal["solid", "dash", "dot", "dashdot", "longdash", "dashdotdot"]
# lengths drawn and left out in turn, points
DASHES: Mapping[Dash, tuple[float, ...]] = {
    "solid": (), "dash": (4.5, 2.0), "dot": (1.3, 1.6), "dashdot": (5.0, 1.8, 1.3, 1.8), "longdash": (9.0, 2.5),
    "dashdotdot": (6.0, 1.6, 1.2, 1.6, 1.2, 1.6),
}  # fmt: skip
# after Okabe and Ito, which the colour-blind can tell apart
BLUE, ORANGE, GREEN, VERMILLION, BLACK = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#1a1a1a"
CONTEXT = "#c4c4c4"
COLOURS = (BLACK, BLUE, ORANGE, GREEN, VERMILLION)
GRID_COLOUR, HEAT_COLOURS = "#efefef", ("#ffffff", "#6baed6")
BAR_SHARE = 0.75
SYMBOLS = (
    "circle", "square", "diamond", "triangle-up", "triangle-down", "pentagon", "star", "hexagon", "x",
)  # fmt: skip


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
        hover: What the page shows beside a point: one template with places as `{x:.3f}` or `{y:.2g}`, or one text for
            each point, shown as it is.
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
        """(2, N) lengths of the intervals below and above the points; 0 where a point lies beyond its interval's end.

        A bootstrap interval need not hold its estimate.
        """
        if self.low is None or self.high is None:
            return None
        middle = np.asarray(self.x if self.is_across else self.y, dtype=np.float64)
        return np.maximum([middle - np.asarray(self.low), np.asarray(self.high) - middle], 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Heat:
    """A heat map: (R, C) values in cells around the places 0 to C - 1 of x and 0 to R - 1 of y.

    Attributes:
        values: (R, C) numbers, NaN for an empty cell.
        texts: (R, C) what stands in the cells.
        low: The value that is white.
        high: The value that is blue.
    """

    values: Float64Array
    texts: Sequence[Sequence[str]]
    low: float
    high: float


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


def log_span(values: npt.ArrayLike, below: float = 1.5, above: float = 1.5) -> tuple[float, float]:
    """Return the ends of a logarithmic axis around the positive ones of (N,) values; around 1 where there are none.

    Args:
        values: What is not positive or not finite is left out.
        below: How many times smaller than the least the lower end is.
        above: How many times larger than the greatest the upper end is.
    """
    found = np.asarray(values, dtype=np.float64)
    is_shown = (found > 0) & np.isfinite(found)
    found = found[is_shown] if is_shown.any() else np.ones(1)
    return float(found.min()) / below, float(found.max()) * above
