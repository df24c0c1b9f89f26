"""Charts of a page: drawings of `eval.core.charts` as SVG elements with a legend of buttons.

`eval.core.figures.picture` draws the same chart as a PNG file for papers.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from eval.core.charts import Drawing
from eval.core.figures import indexed_png, picture
from eval.report.drawing.marks import draw_swatch
from eval.report.drawing.svg import draw_panel

_SHORT_DIGITS = 5
_IN_SCRIPT = {letter: f"\\u{ord(letter):04x}" for letter in "<>&"}


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
        return indexed_png(picture(self.drawing))

    @property
    def legend(self) -> list[tuple[str, Markup]]:
        """Every name with a piece of its line."""
        return [(name, draw_swatch(series)) for name, series in self.drawing.legend.items()]

    @property
    def rows(self) -> list[list[Markup]]:
        """The panels, row by row."""
        legend = {name: place for place, name in enumerate(self.drawing.legend)}
        n_columns, height_px = self.drawing.n_columns, self.drawing.row_px
        return [[draw_panel(panel, n_columns, height_px, legend) for panel in row] for row in self.drawing.rows]

    @property
    def is_joined(self) -> bool:
        """Whether panels need their neighbours: the names of an axis stand at the first one alone."""
        axes = [axis for row in self.drawing.rows for panel in row for axis in (panel.x, panel.y)]
        return any(axis.ticks and not any(axis.ticks.values()) for axis in axes)


def script_json(value: Any, digits: int = _SHORT_DIGITS) -> str:
    """Return a value as JSON that may stand inside a script element; numbers get so many digits, NaN becomes null."""
    text = json.dumps(_plain(value, digits), separators=(",", ":"), allow_nan=False)
    return "".join(_IN_SCRIPT.get(letter, letter) for letter in text)


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
