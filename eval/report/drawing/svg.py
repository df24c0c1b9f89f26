"""Panels of charts as SVG elements of a page: no library, no identifier, nothing that a name could end or begin.

The script of the page reads the places of points and the spans of the axes from the elements (`templates/charts.js`).
`eval.core.figures.picture` draws the same panel for papers.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from matplotlib.ticker import MaxNLocator

from cdpipe.core.geometry import Float64Array
from cdpipe.core.names import visible
from eval.core.charts import Axis, Panel
from eval.report.drawing.marks import Place, draw_heat, draw_series, px

# between the axes, by panels side by side; what stands left of them is added
_PLOT_PX = {1: 840, 2: 390, 3: 280, 4: 225}
_LINE_PX, _CHARACTER_PX = 12, 6.0
_ABOVE_PX, _RIGHT_PX, _TITLE_PX = 22, 14, 17
_PADDING = 0.05


@dataclass(frozen=True, slots=True)
class _Frame:
    """Where the area between the axes lies in a panel, and what stands at its ticks, pixels."""

    left: float
    width: float
    height: float
    below: float
    x: Place
    y: Place
    x_ticks: Mapping[float, str]
    y_ticks: Mapping[float, str]


def draw_panel(panel: Panel, n_columns: int, height_px: int, legend: Mapping[str, int]) -> Markup:
    """Return a panel as one `<svg>`.

    Args:
        panel: What it shows.
        n_columns: Panels side by side in the chart, which say how wide one is drawn.
        height_px: Height of the area between the axes.
        legend: Place in the legend of every name.
    """
    frame = _frame(panel, _PLOT_PX[min(n_columns, max(_PLOT_PX))], height_px)
    full_px = round(frame.left + frame.width + _RIGHT_PX)
    within = Markup(
        '<svg class="plot" x="{}" y="{}" width="{}" height="{}" data-x="{}" data-y="{}" overflow="{}">'
        '<rect class="back" width="{}" height="{}"/>'
    ).format(px(frame.left), _ABOVE_PX, px(frame.width), height_px, frame.x.told, frame.y.told,
             "hidden" if _has_more(panel, frame) else "visible", px(frame.width), height_px)  # fmt: skip
    parts = [
        Markup('<svg class="panel" viewBox="0 0 {} {}" style="--w:{}" role="img" aria-label="{}">').format(
            full_px, px(_ABOVE_PX + height_px + frame.below), full_px, _name(panel)
        ),
        _words(panel.heading, frame.left + frame.width / 2, 14, "heading"),
        *_axes(panel, frame),
        within,
        *([] if panel.heat is None else draw_heat(panel.heat, frame.x, frame.y)),
        *draw_series(panel.series, frame.x, frame.y, legend),
        Markup("</svg></svg>"),
    ]
    return Markup("").join(parts)


def _has_more(panel: Panel, frame: _Frame) -> bool:
    """Tell whether a series leaves the area between the axes, a pixel apart."""
    for series in panel.series:
        for place, values, length in ((frame.x, series.x, frame.width), (frame.y, series.y, frame.height)):
            at = place(np.asarray(values, dtype=np.float64))
            if np.any((at < -1) | (at > length + 1)):
                return True
    return False


def _frame(panel: Panel, width: float, height_px: float) -> _Frame:
    spans = [_span(panel, name) for name in ("x", "y")]
    x_ticks, y_ticks = (_ticks(axis, span) for axis, span in zip((panel.x, panel.y), spans, strict=True))
    left = 10 + _TITLE_PX * bool(panel.y.title) + _CHARACTER_PX * _widest(y_ticks.values())
    below = 8 + _TITLE_PX * bool(panel.x.title) + _LINE_PX * _highest(x_ticks.values())
    x = Place(*spans[0], 0.0, width, panel.x.is_log)
    y = Place(*spans[1], height_px, 0.0, panel.y.is_log)
    return _Frame(left, width, height_px, below, x, y, x_ticks, y_ticks)


def _span(panel: Panel, name: str) -> tuple[float, float]:
    """Return the ends of an axis: its own, those of the cells of a heat map, or those of the data with room around."""
    axis: Axis = getattr(panel, name)
    if panel.heat is not None:
        return -0.5, panel.heat.values.shape[name == "x"] - 0.5
    if axis.span is not None:
        return axis.span
    found: list[Float64Array] = [np.asarray(list(axis.ticks or ()), dtype=np.float64)]
    for series in panel.series:
        values = np.asarray(getattr(series, name), dtype=np.float64)
        found.append(values)
        if series.style == "bars":
            found.append(np.array([-0.5, 0.5]) + values[[0, -1]] if name == "x" and len(values) else np.zeros(1))
        if series.intervals is not None and series.is_across == (name == "x"):
            found += [values - series.intervals[0], values + series.intervals[1]]
    every = np.concatenate(found)
    every = every[np.isfinite(every)]
    low, high = (float(every.min()), float(every.max())) if len(every) else (0.0, 1.0)
    room = _PADDING * ((high - low) or 1.0)
    return low - room, high + room


def _ticks(axis: Axis, span: tuple[float, float]) -> dict[float, str]:
    """Return what stands at which place, between the ends of the axis."""
    low, high = min(span), max(span)
    marks = axis.marks
    if marks is None:
        marks = {float(value): f"{value:.6g}" for value in MaxNLocator(5).tick_values(low, high)}
    room = 1e-9 * (high - low)
    return {value: visible_lines(text) for value, text in marks.items() if low - room <= value <= high + room}


def visible_lines(text: str) -> str:
    """Return text with control characters as escapes, line breaks apart."""
    return "\n".join(map(visible, text.split("\n")))


def _widest(texts: Iterable[str]) -> int:
    return max((len(line) for text in texts for line in text.split("\n")), default=0)


def _highest(texts: Iterable[str]) -> int:
    return max((text.count("\n") + 1 for text in texts), default=0)


def _axes(panel: Panel, frame: _Frame) -> list[Markup]:
    """Return grid lines, the two axes, their ticks and their titles."""
    bottom, right = _ABOVE_PX + frame.height, frame.left + frame.width
    across = [(frame.left + float(place), text) for place, text in zip(*_placed(frame.x, frame.x_ticks), strict=True)]
    along = [(_ABOVE_PX + float(place), text) for place, text in zip(*_placed(frame.y, frame.y_ticks), strict=True)]
    lines = [f"M{px(at)} {px(bottom)}V{_ABOVE_PX}" for at, _ in across]
    lines += [f"M{px(frame.left)} {px(at)}H{px(right)}" for at, _ in along]
    border = f"M{px(frame.left)} {_ABOVE_PX}V{px(bottom)}H{px(right)}"
    parts = [] if panel.heat is not None else [Markup('<path class="grid" d="{}"/>').format("".join(lines))]
    parts.append(Markup('<path class="border" d="{}"/>').format(border))
    parts += [_words(text, at, bottom + 14, "tick") for at, text in across]
    parts += [_words(text, frame.left - 5, at + 3.5, "tick end") for at, text in along]
    parts.append(_words(panel.x.title, frame.left + frame.width / 2, bottom + frame.below - 4, "title"))
    if panel.y.title:
        turned = Markup('<g transform="translate(11 {}) rotate(-90)">{}</g>')
        parts.append(turned.format(px(_ABOVE_PX + frame.height / 2), _words(panel.y.title, 0, 0, "title")))
    return parts


def _placed(place: Place, ticks: Mapping[float, str]) -> tuple[Float64Array, list[str]]:
    return place(np.array(list(ticks), dtype=np.float64)), list(ticks.values())


def _words(text: str, x: float, y: float, name: str) -> Markup:
    """Return text at a place, a line below the other; nothing where there is none."""
    if not text:
        return Markup("")
    first, *more = visible_lines(text).split("\n")
    lower = Markup("").join(Markup('<tspan x="{}" dy="{}">{}</tspan>').format(px(x), _LINE_PX, line) for line in more)
    return Markup('<text class="{}" x="{}" y="{}">{}{}</text>').format(name, px(x), px(y), first, lower)


def _name(panel: Panel) -> str:
    named = [text for text in (panel.heading, panel.y.title, panel.x.title) if text]
    return visible(", ".join(named)) or "panel"
