"""What stands between the axes of a panel, as SVG elements: lines, markers, intervals, bars, and the cells of a map."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from cdpipe.core.geometry import Float64Array
from cdpipe.core.names import visible
from eval.core.charts import BAR_SHARE, BLACK, DASHES, HEAT_COLOURS, Heat, Look, Series
from eval.tables.rows import is_told_the_truth

_PX_PER_PT = 1.3
_MOST_MARKERS = 6
# outlines around the origin, radius 1; two half circles make the circle
_SIDES = {
    "square": (4, 45.0, 1.0), "diamond": (4, 0.0, 1.0), "triangle-up": (3, -90.0, 1.0), "triangle-down": (3, 90.0, 1.0),
    "pentagon": (5, -90.0, 1.0), "hexagon": (6, 0.0, 1.0), "star": (5, -90.0, 0.45), "x": (4, 45.0, 0.3),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Place:
    """From the values of an axis to pixels between the axes: `start` lies at `start_px`, `end` at `end_px`."""

    start: float
    end: float
    start_px: float
    end_px: float
    is_log: bool = False

    def __call__(self, values: Float64Array) -> Float64Array:
        """Return (N,) pixels of (N,) values; a value without a place on a logarithmic axis is NaN."""
        with np.errstate(divide="ignore", invalid="ignore"):
            at, start, end = (
                np.log10(each) if self.is_log else np.asarray(each) for each in (values, self.start, self.end)
            )
        pixels = self.start_px + (self.end_px - self.start_px) * (at - start) / ((end - start) or 1.0)
        return np.where(np.isfinite(pixels), pixels, np.nan)

    @property
    def told(self) -> str:
        """The ends, and whether the axis is logarithmic, as the script of the page reads them."""
        return f"{self.start:.6g} {self.end:.6g} {int(self.is_log)}"


def px(value: float) -> str:
    """Write a pixel with one decimal at most."""
    written = f"{value:.1f}".removesuffix(".0")
    return "0" if written == "-0" else written


def draw_series(series: Sequence[Series], x: Place, y: Place, legend: Mapping[str, int]) -> Iterator[Markup]:
    """Yield the group of every series, the first at the back, behind them what is told the truth.

    Args:
        series: All of one panel; bars stand side by side.
        x: Of the values of the x axis.
        y: Of those of the y axis.
        legend: Place in the legend of every name; the group carries it.
    """
    bars = [each for each in series if each.style == "bars"]
    for each in sorted(series, key=lambda each: not is_told_the_truth(each.name)):
        across = np.asarray(each.x, dtype=np.float64)
        if each.style == "bars":
            across = across + BAR_SHARE * ((bars.index(each) + 0.5) / len(bars) - 0.5)
        at = x(across), y(np.asarray(each.y, dtype=np.float64))
        marked = mark_few(*at) if each.look.width and each.style != "bars" else at
        yield Markup("<g{}{}>{}{}{}{}</g>").format(
            Markup(' data-s="{}"').format(legend[each.name]) if each.name else "",
            _hover(each), _body(each, at, x, y, len(bars)), _intervals(each, across, x, y),
            draw_markers(each.look, *marked), _labels(each, at),
        )  # fmt: skip


def draw_swatch(series: Series) -> Markup:
    """Return the entry of a legend without its name: a bar, or a piece of the line, with the marker."""
    look = series.look
    if series.style == "bars":
        line = Markup('<rect x="7" y="1" width="16" height="12" fill="{}"/>').format(look.colour)
    else:
        line = Markup('<path class="line" d="M1 7H31"{}/>').format(_stroke(look)) if look.width else Markup("")
    marker = draw_markers(look, np.array([16.0]), np.array([7.0]))
    return Markup('<svg class="swatch">{}{}</svg>').format(line, marker)


def draw_heat(heat: Heat, x: Place, y: Place) -> Iterator[Markup]:
    """Yield the cells of a heat map with their texts."""
    n_rows, n_columns = heat.values.shape
    columns, rows = x(np.arange(n_columns + 1) - 0.5).tolist(), y(np.arange(n_rows + 1) - 0.5).tolist()
    for (row, column), value in np.ndenumerate(heat.values):
        left, top = columns[column], rows[row + 1]
        width, height = columns[column + 1] - left, rows[row] - top
        yield Markup(
            '<rect class="cell" x="{}" y="{}" width="{}" height="{}" fill="{}"/>'
            '<text class="cell" x="{}" y="{}">{}</text>'
        ).format(px(left), px(top), px(width), px(height), _heat_colour(heat, value), px(left + width / 2),
                 px(top + height / 2 + 4), visible(heat.texts[row][column]))  # fmt: skip


def _heat_colour(heat: Heat, value: float) -> str:
    if not np.isfinite(value):
        return "#fff"
    part = float(np.clip((value - heat.low) / ((heat.high - heat.low) or 1.0), 0.0, 1.0))
    ends = [[int(colour[place : place + 2], 16) for place in (1, 3, 5)] for colour in HEAT_COLOURS]
    return "#" + "".join(f"{round(low + part * (high - low)):02x}" for low, high in zip(*ends, strict=True))


def _hover(series: Series) -> Markup:
    """Return what the script shows beside a point: one template, or one text for each."""
    if not series.hover:
        return Markup("")
    if isinstance(series.hover, str):
        return Markup(' data-h="{}"').format(series.hover)
    return Markup(' data-t="{}"').format(json.dumps([visible(text) for text in series.hover], ensure_ascii=False))


def _body(series: Series, at: tuple[Float64Array, Float64Array], x: Place, y: Place, n_bars: int) -> Markup:
    look = series.look
    if series.style == "bars":
        half = BAR_SHARE / n_bars / 2 * abs(x(np.array([1.0]))[0] - x(np.array([0.0]))[0])
        floor = y(np.zeros(1))[0]
        d = "".join(f"M{px(a - half)} {px(floor)}V{px(b)}H{px(a + half)}V{px(floor)}z" for a, b in _points(*at))
        return Markup('<path class="bars" d="{}" fill="{}" data-p="{}"/>').format(d, look.colour, _pairs(*at))
    if not look.width:
        return Markup('<path class="places" data-p="{}"/>').format(_pairs(*at)) if series.hover else Markup("")
    d = trace_line(*at, is_stepped=series.style == "steps")
    return Markup('<path class="line" d="{}"{}/>').format(d, _stroke(look))


def trace_line(x: Float64Array, y: Float64Array, *, is_stepped: bool) -> str:
    """Return the `d` of a path through (N,) points in pixels, broken where one is NaN.

    A point is left out where it is written like the one before it, or where a step does not change its height.
    """
    parts: list[str] = []
    last: tuple[str, str] | None = None
    for across, up in zip(x, y, strict=True):
        if not np.isfinite(across) or not np.isfinite(up):
            last = None
            continue
        point = px(across), px(up)
        if last is None:
            parts.append(f"M{point[0]} {point[1]}")
        elif point != last:
            parts.append(f"H{point[0]}V{point[1]}" if is_stepped else f"L{point[0]} {point[1]}")
        last = point
    return "".join(parts)


def _stroke(look: Look) -> Markup:
    dashes = " ".join(px(_PX_PER_PT * length) for length in DASHES[look.dash])
    return Markup(' stroke="{}" stroke-width="{}"{}{}').format(
        look.colour, px(_PX_PER_PT * look.width), Markup(' stroke-dasharray="{}"').format(dashes) if dashes else "",
        Markup(' opacity="{}"').format(f"{look.opacity:g}") if look.opacity < 1 else "",
    )  # fmt: skip


def _points(x: Float64Array, y: Float64Array) -> list[tuple[float, float]]:
    is_there = np.isfinite(x) & np.isfinite(y)
    return list(zip(x[is_there].tolist(), y[is_there].tolist(), strict=True))


def _pairs(x: Float64Array, y: Float64Array) -> str:
    """Return all points, undefined ones as "-", so that texts keep their places."""
    is_there = np.isfinite(x) & np.isfinite(y)
    return ";".join(f"{px(a)},{px(b)}" if known else "-" for a, b, known in zip(x, y, is_there, strict=True))


def mark_few(x: Float64Array, y: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the points of a line that carry its marker: all of a few, every n-th of many."""
    step = max(-(-len(x) // _MOST_MARKERS), 1)
    return x[::step], y[::step]


def draw_markers(look: Look, x: Float64Array, y: Float64Array) -> Markup:
    """Return the markers of (N,) points in pixels as one path; nothing where the look has none."""
    if not look.marker:
        return Markup("")
    d = "".join(_marker(look.marker, across, up, _PX_PER_PT * look.size / 2) for across, up in _points(x, y))
    faint = Markup(' opacity="{}"').format(f"{look.opacity:g}") if look.opacity < 1 else ""
    if look.is_hollow:
        return Markup('<path class="hollow" d="{}" stroke="{}"{}/>').format(d, look.colour, faint)
    return Markup('<path class="marks" d="{}" fill="{}"{}/>').format(d, look.colour, faint)


def _marker(name: str, x: float, y: float, radius: float) -> str:
    if name not in _SIDES:
        r, across = short(radius), short(2 * radius)
        return f"M{px(x - radius)} {px(y)}a{r.strip()}{r} 0 1 0{across} 0{r}{r} 0 1 0-{across.strip()} 0z"
    n_sides, turn_deg, inner = _SIDES[name]
    n = n_sides if inner == 1.0 else 2 * n_sides
    angles = np.deg2rad(turn_deg) + 2 * np.pi * np.arange(n) / n
    radii = (1.3 if n_sides > 4 or inner == 1.0 else 1.5) * radius * np.where(np.arange(n) % 2 == 1, inner, 1.0)
    corners = np.round(radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]), 1)
    steps = "".join(f"{short(value)}" for value in np.diff(corners, axis=0).ravel())
    return f"M{px(x + corners[0, 0])} {px(y + corners[0, 1])}l{steps.strip()}z"


def short(value: float) -> str:
    """Write a number of a path with one decimal at most, a space before it where no sign parts it from the last."""
    written = px(value).replace("0.", ".", 1) if abs(value) < 1 else px(value)
    return written if written.startswith("-") else f" {written}"


def _intervals(series: Series, across: Float64Array, x: Place, y: Place) -> Markup:
    """Return the intervals around the points as one path."""
    if series.intervals is None:
        return Markup("")
    up = np.asarray(series.y, dtype=np.float64)
    below, above = series.intervals
    if series.is_across:
        ends = zip(x(across - below), x(across + above), y(up), strict=True)
        d = "".join(f"M{px(low)} {px(at)}H{px(high)}" for low, high, at in ends if np.isfinite([low, high, at]).all())
    else:
        ends = zip(y(up - below), y(up + above), x(across), strict=True)
        d = "".join(f"M{px(at)} {px(low)}V{px(high)}" for low, high, at in ends if np.isfinite([low, high, at]).all())
    colour = BLACK if series.style == "bars" else series.look.colour
    return Markup('<path class="interval" d="{}" stroke="{}"/>').format(d, colour) if d else Markup("")


def _labels(series: Series, at: tuple[Float64Array, Float64Array]) -> Markup:
    found = Markup("")
    for x, y, text in zip(*at, series.labels, strict=False):
        if text and np.isfinite(x) and np.isfinite(y):
            found += Markup('<text class="label" x="{}" y="{}">{}</text>').format(px(x - 5), px(y - 4), visible(text))
    return found
