"""Charts of the page that can be hovered, zoomed and filtered: plotly figures as plain JSON, drawn inside the file.

A chart is data and layout as plotly.js takes them. The library itself stands once in a page that has a chart, so that
nothing is fetched. What a chart shows for papers is a PNG file of its name beside the page, drawn by matplotlib.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from eval.core.figures import BLACK
from eval.report.regions.plots import DASHED, DOTTED, line_look

GRID_COLOUR, SOFT = "#efefef", "#5c5c5c"
_FONT = {"family": "system-ui, -apple-system, Segoe UI, Roboto, Helvetica Neue, DejaVu Sans, sans-serif", "size": 12}
_GAP, _ROW_GAP_PX = 0.09, 84
_LEGEND_ROW_PX, _NAMES_IN_ROW = 22, 6
_SHORT_DIGITS = 5


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """A chart of the page.

    Attributes:
        name: Its place in the page, and the name of its PNG file.
        title: What stands above it.
        figure: `data` and `layout` as plotly.js takes them; the layout has a height in pixels.
        caption: What stands below it: what is shown, over how many, with which intervals.
        png: The same as a picture file for papers; None where there is none.
    """

    name: str
    title: str
    figure: Mapping[str, Any]
    caption: str
    png: bytes | None = None

    @property
    def height_px(self) -> int:
        """Height, pixels."""
        return int(self.figure["layout"]["height"])

    @property
    def json(self) -> str:
        """The figure as JSON that may stand inside a script element: it cannot end that element."""
        return json.dumps(_plain(self.figure), separators=(",", ":"), allow_nan=False).replace("</", "<\\/")


def plotly_script() -> str:
    """Return the library that draws the charts, as one script."""
    from plotly.offline import get_plotlyjs  # noqa: PLC0415 - a page without charts needs none of it

    return str(get_plotlyjs())


def line_of(name: str, names: Sequence[str]) -> dict[str, Any]:
    """Return plotly's look of a method's line: the same colour, width and dashes as in the PNG files."""
    look = line_look(name, names)
    dashes = {DASHED: "dash", DOTTED: "dot", "dashdot": "dashdot"}
    return {"color": look["color"], "width": look["linewidth"], "dash": dashes.get(look.get("linestyle", ""), "solid")}


def layout(n_columns: int, n_rows: int, row_px: int, names: Sequence[str] = (), **more: Any) -> dict[str, Any]:
    """Return a layout of panels with a legend above them.

    Args:
        n_columns: Panels beside each other.
        n_rows: Panels below each other; panel i (from 0, row by row) has the axes `x{i + 1}`, `y{i + 1}`.
        row_px: Height of a row, pixels.
        names: What stands in the legend, which is as high as they need.
        more: What else the layout holds, or in place of what is here.
    """
    legend_px = _LEGEND_ROW_PX * math.ceil(len(names) / _NAMES_IN_ROW)
    below_px, above_px = 56, 34 + legend_px
    height_px = above_px + n_rows * row_px + below_px
    inner_px = n_rows * row_px
    found: dict[str, Any] = {
        "height": height_px, "autosize": True, "font": {**_FONT, "color": BLACK}, "paper_bgcolor": "#fff",
        "plot_bgcolor": "#fff", "margin": {"l": 58, "r": 12, "t": above_px, "b": below_px}, "hovermode": "closest",
        "showlegend": bool(names), "annotations": [],
        "legend": {"orientation": "h", "x": 0, "xanchor": "left", "y": 1 + 28 / inner_px, "yanchor": "bottom",
                   "font": {"size": 11}},
    }  # fmt: skip
    for index in range(n_columns * n_rows):
        row, column = divmod(index, n_columns)
        x, y = _span(column, n_columns, _GAP), _span(n_rows - 1 - row, n_rows, _ROW_GAP_PX / inner_px)
        found[_axis("xaxis", index)] = {**_look_of_axis(), "domain": x, "anchor": _axis("y", index)}
        found[_axis("yaxis", index)] = {**_look_of_axis(), "domain": y, "anchor": _axis("x", index)}
    return {**found, **more}


def set_axis(found: dict[str, Any], axis: str, index: int, title: str = "", **more: Any) -> None:
    """Change one axis ("x" or "y") of panel `index` (from 0) of a layout that is being built."""
    found[_axis(f"{axis}axis", index)] |= {"title": {"text": title, "font": {"size": 12}}, **more}


def add_heading(found: dict[str, Any], index: int, words: str) -> None:
    """Write above panel `index` (from 0) of a layout that is being built."""
    x, y = (found[_axis(f"{axis}axis", index)]["domain"] for axis in "xy")
    note = {"xref": "paper", "yref": "paper", "showarrow": False, "text": words, "font": {"size": 13}}
    found["annotations"].append(
        {**note, "x": (x[0] + x[1]) / 2, "y": y[1], "xanchor": "center", "yanchor": "bottom", "yshift": 4}
    )


def axes_of(index: int) -> dict[str, str]:
    """Return which axes a trace of panel `index` (from 0) belongs to."""
    return {"xaxis": _axis("x", index), "yaxis": _axis("y", index)}


def in_legend(name: str, seen: set[str]) -> dict[str, Any]:
    """Return how a method stands in the legend: once, and a click on it acts in every panel."""
    is_first = name not in seen
    seen.add(name)
    return {"name": name, "legendgroup": name, "showlegend": is_first}


def error_bars(values: Any, low: Any, high: Any, colour: str = "") -> dict[str, Any]:
    """Return bars from `low` to `high` around (N,) values; none where they are NaN."""
    values, low, high = (np.asarray(each, dtype=np.float64) for each in (values, low, high))
    bars = {"type": "data", "symmetric": False, "array": high - values, "arrayminus": values - low, "thickness": 1.1}
    return {**bars, "width": 2} | ({"color": colour} if colour else {})


def _look_of_axis() -> dict[str, Any]:
    return {
        "showline": True, "linecolor": BLACK, "linewidth": 1, "gridcolor": GRID_COLOUR, "zeroline": False,
        "ticks": "outside", "ticklen": 4, "tickfont": {"size": 11}, "automargin": True,
    }  # fmt: skip


def _axis(word: str, index: int) -> str:
    return word if index == 0 else f"{word}{index + 1}"


def _span(place: int, n: int, gap: float) -> list[float]:
    width = (1.0 - gap * (n - 1)) / n
    return [round(place * (width + gap), 4), round(place * (width + gap) + width, 4)]


def _plain(value: Any) -> Any:
    """Return JSON's own types; numbers get as many digits as a screen can show, and what is undefined is null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return [_plain(item) for item in value.tolist()]
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.{_SHORT_DIGITS}g}") if math.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
