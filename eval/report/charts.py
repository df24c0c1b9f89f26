"""Interactive charts of the page: drawings of `eval.core.charts` as plotly figures.

The page holds plotly.js once and fetches nothing. `eval.core.figures.picture` draws the same chart as a PNG file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cdpipe.core.names import visible
from eval.core.charts import BAR_SHARE, BLACK, GRID_COLOUR, HEAT_COLOURS, Axis, Drawing, Heat, Series
from eval.core.figures import picture, picture_address, png

_FONT = "system-ui, -apple-system, Segoe UI, Roboto, Helvetica Neue, DejaVu Sans, sans-serif"
_COLUMN_GAP, _ROW_GAP_PX, _ABOVE_PX, _BELOW_PX = 0.09, 84, 34, 56
_LEGEND_ROW_PX, _NAMES_IN_ROW = 22, 6
_PX_PER_PT = 1.6
_SHORT_DIGITS = 5
_IN_SCRIPT = {letter: f"\\u{ord(letter):04x}" for letter in "<>&"}
_IN_TEXT = {letter: f"&#{ord(letter)};" for letter in "<>&{$"}


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """A chart of the page.

    Attributes:
        name: Its place in the page, and the name of its PNG file.
        title: The heading above it.
        drawing: What it shows.
        caption: The text below it: what is shown, over how many pairs, with which intervals.
        has_png: Whether a PNG file for papers is written beside the page.
    """

    name: str
    title: str
    drawing: Drawing
    caption: str
    has_png: bool = False

    @property
    def png(self) -> bytes:
        """The chart as a PNG file for papers."""
        return png(picture(self.drawing))

    @property
    def address(self) -> str:
        """The chart as a picture, a data address."""
        return picture_address(self.drawing)

    @property
    def height_px(self) -> int:
        """Height on the page, pixels."""
        return _height_px(self.drawing)

    @property
    def json(self) -> str:
        """The figure as JSON that may stand inside a script element: it can neither end it nor begin a comment."""
        return script_json(plotly_figure(self.drawing))


def script_json(value: Any, digits: int = _SHORT_DIGITS) -> str:
    """Return a value as JSON that may stand inside a script element; numbers get so many digits, NaN becomes null."""
    text = json.dumps(_plain(value, digits), separators=(",", ":"), allow_nan=False)
    return "".join(_IN_SCRIPT.get(letter, letter) for letter in text)


def plotly_text(words: str) -> str:
    """Return text as plotly shows it: it would read tags, entities, `$formulas$`, and `%{x}` under the pointer."""
    return "".join(_IN_TEXT.get(letter, letter) for letter in visible(words))


def plotly_script() -> str:
    """Return the library that draws the charts, as one script."""
    from plotly.offline import get_plotlyjs  # noqa: PLC0415 - a page without charts needs none of it

    return str(get_plotlyjs())


def plotly_figure(drawing: Drawing) -> dict[str, Any]:
    """Return `data` and `layout` of plotly.js. A click on a name of the legend acts on its series in every panel."""
    n_rows, n_columns = len(drawing.rows), drawing.n_columns
    inner_px = n_rows * drawing.row_px
    layout: dict[str, Any] = {
        "height": _height_px(drawing), "autosize": True, "font": {"family": _FONT, "size": 12, "color": BLACK},
        "paper_bgcolor": "#fff", "plot_bgcolor": "#fff", "hovermode": "closest", "showlegend": bool(drawing.legend),
        "margin": {"l": 58, "r": 12, "t": _ABOVE_PX + _legend_px(drawing), "b": _BELOW_PX}, "annotations": [],
        "legend": {"orientation": "h", "x": 0, "xanchor": "left", "y": 1 + 28 / inner_px, "yanchor": "bottom",
                   "font": {"size": 11}},
        "barmode": "group", "bargap": 1.0 - BAR_SHARE,
    }  # fmt: skip
    data: list[dict[str, Any]] = []
    first = {id(series) for series in drawing.legend.values()}
    for row, panels in enumerate(drawing.rows):
        for column, panel in enumerate(panels):
            index = row * n_columns + column
            place = str(index + 1) if index else ""
            ids = {"xaxis": f"x{place}", "yaxis": f"y{place}"}
            x = _span(column, n_columns, _COLUMN_GAP)
            y = _span(n_rows - 1 - row, n_rows, _ROW_GAP_PX / inner_px)
            layout[f"xaxis{place}"] = {**_axis(panel.x), "domain": x, "anchor": ids["yaxis"]}
            layout[f"yaxis{place}"] = {**_axis(panel.y), "domain": y, "anchor": ids["xaxis"]}
            if panel.heading:
                layout["annotations"].append(_heading(panel.heading, x, y))
            if panel.heat is not None:
                data.append({**_heat(panel.heat), **ids})
            data += [{**_trace(series), "showlegend": id(series) in first, **ids} for series in panel.series]
    return {"data": data, "layout": layout}


def _height_px(drawing: Drawing) -> int:
    return _ABOVE_PX + _legend_px(drawing) + len(drawing.rows) * drawing.row_px + _BELOW_PX


def _legend_px(drawing: Drawing) -> int:
    return _LEGEND_ROW_PX * math.ceil(len(drawing.legend) / _NAMES_IN_ROW)


def _span(place: int, n: int, gap: float) -> list[float]:
    width = (1.0 - gap * (n - 1)) / n
    return [round(place * (width + gap), 4), round(place * (width + gap) + width, 4)]


def _heading(words: str, x: list[float], y: list[float]) -> dict[str, Any]:
    place = {"x": sum(x) / 2, "y": y[1], "xanchor": "center", "yanchor": "bottom", "yshift": 4}
    return {
        "xref": "paper",
        "yref": "paper",
        "showarrow": False,
        "text": plotly_text(words),
        "font": {"size": 13},
        **place,
    }


def _axis(axis: Axis) -> dict[str, Any]:
    found: dict[str, Any] = {
        "title": {"text": plotly_text(axis.title), "font": {"size": 12}}, "showline": True, "linecolor": BLACK,
        "linewidth": 1,
        "gridcolor": GRID_COLOUR, "zeroline": False, "ticks": "outside", "ticklen": 4, "tickangle": 0,
        "tickfont": {"size": round(_PX_PER_PT * axis.tick_pt)}, "automargin": True,
    }  # fmt: skip
    if axis.is_log:
        found["type"] = "log"
    if axis.span is not None:
        found["range"] = [math.log10(end) if axis.is_log else end for end in axis.span]
    if axis.marks is not None:
        found |= {"tickvals": list(axis.marks), "ticktext": [_lines(text) for text in axis.marks.values()]}
    return found


def _trace(series: Series) -> dict[str, Any]:
    look = series.look
    found: dict[str, Any] = {"x": np.asarray(series.x), "y": np.asarray(series.y)}
    found |= {"name": plotly_text(series.name), "legendgroup": series.name}
    found |= {"hovertemplate": series.hover} if series.hover else {"hoverinfo": "skip"}
    if series.intervals is not None:
        below, above = series.intervals
        bars = {"type": "data", "symmetric": False, "array": above, "arrayminus": below, "thickness": 1.1, "width": 2}
        colour = "#444" if series.style == "bars" else look.colour
        found["error_x" if series.is_across else "error_y"] = {**bars, "color": colour}
    if series.style == "bars":
        pattern = {"shape": "" if look.dash == "solid" else "/", "solidity": 0.4}
        return {**found, "type": "bar", "marker": {"color": look.colour, "pattern": pattern}}
    parts = {"lines": look.width > 0, "markers": bool(look.marker), "text": any(series.labels)}
    found |= {"mode": "+".join(part for part, is_there in parts.items() if is_there), "opacity": look.opacity}
    if look.width > 0:
        shape = "hv" if series.style == "steps" else "linear"
        found["line"] = {"color": look.colour, "width": look.width, "dash": look.dash, "shape": shape}
    if look.marker:
        symbol = look.marker + ("-open" if look.is_hollow else "")
        found["marker"] = {"size": _PX_PER_PT * look.size, "color": look.colour, "symbol": symbol}
    if parts["text"]:
        texts = [f"<b>{_lines(text)}</b>" if text else "" for text in series.labels]
        font = {"size": 10, "color": BLACK}
        found |= {"text": texts, "textposition": "top left", "textfont": font, "cliponaxis": False}
    return found


def _heat(heat: Heat) -> dict[str, Any]:
    texts = [[plotly_text(text) for text in row] for row in heat.texts]
    return {
        "type": "heatmap", "z": heat.values, "text": texts, "texttemplate": "%{text}", "zmin": heat.low,
        "zmax": heat.high, "colorscale": list(enumerate(HEAT_COLOURS)), "showscale": False, "xgap": 1, "ygap": 1,
        "textfont": {"size": 11, "color": BLACK}, "hovertemplate": heat.hover,
    }  # fmt: skip


def _lines(text: str) -> str:
    return "<br>".join(map(plotly_text, text.split("\n")))


def _plain(value: Any, digits: int = _SHORT_DIGITS) -> Any:
    """Return JSON's own types; numbers get as many digits as a screen can show, and what is undefined is null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item, digits) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return [_plain(item, digits) for item in value.tolist()]
    if isinstance(value, list | tuple):
        return [_plain(item, digits) for item in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
