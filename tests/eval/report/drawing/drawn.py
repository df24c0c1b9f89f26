"""Reads the SVG elements of a chart back: what each panel shows, in the values of its axes."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field

import numpy as np
from markupsafe import Markup

from eval.core.charts import Drawing
from eval.report.drawing.charts import Chart


@dataclass
class DrawnSeries:
    """One series: its name, points and ends of intervals in values of the axes, and the elements that draw it."""

    name: str
    points: np.ndarray
    ends: np.ndarray
    labels: list[str]
    hover: str
    texts: str
    elements: dict[str, ET.Element]

    @property
    def colour(self) -> str:
        line, marks = self.elements.get("line"), self.elements.get("marks", self.elements.get("bars"))
        return line.attrib["stroke"] if line is not None else marks.attrib["fill"] if marks is not None else ""


@dataclass
class DrawnPanel:
    """One panel: its texts by class, its series, and the cells of its heat map as (text, fill)."""

    texts: dict[str, list[str]]
    series: list[DrawnSeries]
    cells: list[tuple[str, str]] = field(default_factory=list)
    x_px: tuple[float, float] = (0.0, 0.0)
    y_px: tuple[float, float] = (0.0, 0.0)


def read_panels(drawing: Drawing) -> list[list[DrawnPanel]]:
    """Return the panels of a drawing as the page holds them, row by row."""
    chart = Chart("a", "", drawing, "")
    names = [name for name, _ in chart.legend]
    return [[_panel(panel, names) for panel in row] for row in chart.rows]


def _panel(drawn: Markup, names: list[str]) -> DrawnPanel:
    root = ET.fromstring(drawn)
    texts: dict[str, list[str]] = {}
    plot = next(each for each in root.iter("svg") if each.get("class") == "plot")
    for each in root.iter("text"):
        texts.setdefault(each.get("class", ""), []).append("\n".join(each.itertext()))
    rects = [each.attrib["fill"] for each in plot.findall("rect") if each.get("class") == "cell"]
    cells = list(zip(texts.get("cell", []), rects, strict=True))
    left, top, width, height = (float(plot.attrib[name]) for name in ("x", "y", "width", "height"))
    series = [_series(each, plot, names) for each in plot.findall("g")]
    return DrawnPanel(texts, series, cells, (left, left + width), (top, top + height))


def _series(group: ET.Element, plot: ET.Element, names: list[str]) -> DrawnSeries:
    elements = {each.get("class", ""): each for each in group}
    found: list[tuple[float, float]] = []
    if (told := next((each.get("data-p") for each in group if each.get("data-p")), None)) is not None:
        pairs = (("nan,nan" if pair == "-" else pair).split(",") for pair in told.split(";"))
        found = [(float(x), float(y)) for x, y in pairs]
    elif "line" in elements:
        found = _vertices(elements["line"].attrib["d"])
    ends = _vertices(elements["interval"].attrib["d"]) if "interval" in elements else []
    return DrawnSeries(
        names[int(group.attrib["data-s"])] if "data-s" in group.attrib else "",
        _values(found, plot), _values(ends, plot), [each.text or "" for each in group.findall("text")],
        group.get("data-h", ""), group.get("data-t", ""), elements,
    )  # fmt: skip


def _vertices(d: str) -> list[tuple[float, float]]:
    found, x, y = [], 0.0, 0.0
    for letter, first, second in re.findall(r"([MLHV])([-\d.]+)(?: ([-\d.]+))?", d):
        x = x if letter == "V" else float(first)
        y = y if letter == "H" else float(first if letter == "V" else second)
        found.append((x, y))
    return found


def _values(points: list[tuple[float, float]], plot: ET.Element) -> np.ndarray:
    pixels = np.array(points, dtype=np.float64).reshape(-1, 2)
    shares = pixels / [float(plot.attrib["width"]), float(plot.attrib["height"])]
    shares[:, 1] = 1.0 - shares[:, 1]
    columns = []
    for share, name in zip(shares.T, ("x", "y"), strict=True):
        start, end, is_log = (float(each) for each in plot.attrib[f"data-{name}"].split())
        columns.append(start * (end / start) ** share if is_log else start + share * (end - start))
    return np.column_stack(columns)
