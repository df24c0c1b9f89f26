"""Pictures by matplotlib's objects (no pyplot, no global state): of any chart, and what every figure shares."""

from __future__ import annotations

import base64
import io
from itertools import zip_longest
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from PIL import Image

from cdpipe.core.names import visible
from eval.core.charts import (
    BAR_SHARE,
    BLACK,
    DASHES,
    GRID_COLOUR,
    HEAT_COLOURS,
    SYMBOLS,
    Drawing,
    Heat,
    Look,
    Panel,
    Series,
)

DPI = 130
_SLIM_SCALE, _WEBP_QUALITY = 0.75, 20
_WIDTH_IN, _PX_PER_IN, _LEGEND_CHARACTERS, _LEGEND_LINE_IN = 9.0, 88.0, 145, 0.17
_MARKERS = dict(zip(("", *SYMBOLS), ("", "o", "s", "D", "^", "v", "p", "*", "h", "X"), strict=True))


def blank_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure of a size in inches."""
    return Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained", facecolor="white")


def png(figure: Figure) -> bytes:
    """Return a figure as a PNG file."""
    buffer = io.BytesIO()
    # no creation date or program version: the same run gives the same page
    FigureCanvasAgg(figure)
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def indexed_png(figure: Figure) -> bytes:
    """Return a figure as a PNG file in 256 colours: a third of the bytes, and no eye sees it."""
    picture = Image.open(io.BytesIO(png(figure))).convert("RGB")
    buffer = io.BytesIO()
    indexed = picture.quantize(256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    indexed.save(buffer, format="png", optimize=True)
    return buffer.getvalue()


def data_address(figure: Figure) -> str:
    """Return a figure as `data:image/png;base64,...`, in 256 colours."""
    return "data:image/png;base64," + base64.b64encode(indexed_png(figure)).decode("ascii")


def compress_address(address: str) -> str:
    """Return a `data:image/png` address as a smaller `data:image/webp` one: fewer pixels, edges a little blurred."""
    head, _, code = address.partition(",")
    if head != "data:image/png;base64":
        return address
    buffer, image = io.BytesIO(), Image.open(io.BytesIO(base64.b64decode(code))).convert("RGB")
    smaller = image.resize([round(_SLIM_SCALE * side) for side in image.size], Image.Resampling.LANCZOS)
    smaller.save(buffer, "webp", quality=_WEBP_QUALITY, method=6)
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def picture_address(drawing: Drawing) -> str:
    """Return the picture of a chart as `data:image/png;base64,...`."""
    return data_address(picture(drawing))


def picture(drawing: Drawing) -> Figure:
    """Return a chart as a matplotlib figure, 9 inches wide."""
    n_rows = len(drawing.rows)
    handles = [_legend_entry(name, series) for name, series in drawing.legend.items()]
    n_across = max(1, min(len(handles), 5, _LEGEND_CHARACTERS // (8 + max(map(len, drawing.legend), default=0))))
    above_in = 0.5 + _LEGEND_LINE_IN * -(-len(handles) // n_across)
    figure = blank_figure(_WIDTH_IN, above_in + n_rows * drawing.row_px / _PX_PER_IN)
    for row, panels in zip(figure.subplots(n_rows, drawing.n_columns, squeeze=False), drawing.rows, strict=True):
        for axes, panel in zip_longest(row, panels):
            if panel is None:
                axes.set_axis_off()
            else:
                _draw_panel(axes, panel)
    if handles:
        figure.legend(handles=handles, loc="outside upper center", ncols=n_across, fontsize=8, frameon=False)
    return figure


def plain_text(words: str) -> str:
    """Return text that matplotlib draws as it is: a name with dollars is no formula."""
    return "\n".join(map(visible, words.split("\n"))).replace("$", r"\$")


def _draw_panel(axes: Axes, panel: Panel) -> None:
    axes.grid(color=GRID_COLOUR, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.set_title(plain_text(panel.heading), fontsize=9)
    if panel.heat is not None:
        _draw_heat(axes, panel.heat)
    bars = [each for each in panel.series if each.style == "bars"]
    for series in panel.series:
        _draw_series(axes, series, bars)
    for name, axis in (("x", panel.x), ("y", panel.y)):
        own = axes.xaxis if name == "x" else axes.yaxis
        axes.set(**{f"{name}scale": "log" if axis.is_log else "linear"})
        own.set_label_text(plain_text(axis.title), fontsize=8)
        if axis.marks is not None:
            own.set_ticks(list(axis.marks), list(map(plain_text, axis.marks.values())))
        if axis.span is not None:  # after the ticks, which widen it
            axes.set(**{f"{name}lim": axis.span})
        own.set_tick_params(labelsize=axis.tick_pt)
    axes.minorticks_off()
    axes.spines[["top", "right"]].set_visible(False)


def _draw_series(axes: Axes, series: Series, bars: list[Series]) -> None:
    """Draw one series; `bars` are all series of the panel that are bars, which stand side by side."""
    x, y = np.asarray(series.x, dtype=np.float64), np.asarray(series.y, dtype=np.float64)
    look = series.look
    if series.style == "bars":
        x = x + BAR_SHARE * ((bars.index(series) + 0.5) / len(bars) - 0.5)
        hatch = "" if look.dash == "solid" else "///"
        axes.bar(x, y, BAR_SHARE / len(bars), color=look.colour, hatch=hatch, edgecolor="white", linewidth=0.0)
    else:
        axes.plot(x, y, drawstyle="steps-post" if series.style == "steps" else "default", **_line(look))
    if series.intervals is not None:
        lengths_y, lengths_x = (None, series.intervals) if series.is_across else (series.intervals, None)
        colour = BLACK if series.style == "bars" else look.colour
        axes.errorbar(x, y, lengths_y, lengths_x, fmt="none", ecolor=colour, elinewidth=1.0, alpha=0.6)
    for place, label in zip(zip(x, y, strict=True), series.labels, strict=False):
        axes.annotate(
            plain_text(label), place, (-3, 2), textcoords="offset points", fontsize=7, ha="right", va="bottom"
        )


def _draw_heat(axes: Axes, heat: Heat) -> None:
    colours = LinearSegmentedColormap.from_list("heat", HEAT_COLOURS)
    axes.imshow(heat.values, cmap=colours, vmin=heat.low, vmax=heat.high, origin="lower", aspect="auto")
    for (row, column), _ in np.ndenumerate(heat.values):
        axes.text(column, row, plain_text(heat.texts[row][column]), ha="center", va="center", fontsize=7)


def _line(look: Look) -> dict[str, Any]:
    return {
        "color": look.colour, "linewidth": look.width, "linestyle": _dashes(look),
        "marker": _MARKERS[look.marker], "markersize": look.size, "alpha": look.opacity,
        "markerfacecolor": "white" if look.is_hollow else look.colour,
    }  # fmt: skip


def _dashes(look: Look) -> Any:
    if not look.width:
        return "none"
    # matplotlib multiplies by the width of the line
    return (0, tuple(length / look.width for length in DASHES[look.dash])) if DASHES[look.dash] else "solid"


def _legend_entry(name: str, series: Series) -> Line2D | Patch:
    if series.style == "bars":
        return Patch(color=series.look.colour, label=plain_text(name))
    return Line2D([], [], label=plain_text(name), **_line(series.look))
