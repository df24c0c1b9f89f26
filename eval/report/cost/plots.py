"""Quality against cost as a picture for papers: every method a point, those that no other beats joined and in black."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from matplotlib.transforms import Bbox

from eval.core.domains import domain_name
from eval.core.figures import BLACK, BLUE, blank_figure, png
from eval.report.cost.pareto import BYTES, TIME
from eval.report.objects.tables import is_told_the_truth
from eval.tables.columns import spaced

_GREY = "#8a8a8a"
_PANEL_HEIGHT_IN = 3.5
_FONT_PT = 7.0
_WRAPPED_AT = 26
# where a name may stand beside its point, in points; the first that is free is taken
_PLACES = tuple((dx, dy) for dy in (5, -10, 14, -19, 24, -29, 34, -39, 44, -49) for dx in (6, -6))
_N_NEAR = 4
# a name that stands farther off is tied to its point
_LEADER: dict[str, Any] = {"arrowstyle": "-", "color": _GREY, "linewidth": 0.5, "shrinkA": 0, "shrinkB": 2}
COSTS = {TIME: ("time of a pair [s], median", 1.0), BYTES: ("kept of the before map [kB], mean", 1000.0)}


def pareto_png(own: pd.DataFrame, words: str) -> bytes:
    """Return the picture of one quality as PNG, a row of panels for each domain and a column for each cost.

    Args:
        own: Rows of `eval.report.cost.pareto.pareto_table` of one quality.
        words: What the quality is called.
    """
    return png(_figure(own, words))


def known_costs(own: pd.DataFrame) -> list[str]:
    """Return which costs a table of points has, in their order."""
    return [cost for cost in COSTS if (own["cost"] == cost).any()]


def is_apart(point: Mapping[str, Any], points: Sequence[Mapping[str, Any]]) -> bool:
    """Tell whether a point does not compete: `eval.report.cost.pareto`."""
    most = max(other["n_pairs"] for other in points if not is_told_the_truth(other["variant"]))
    return is_told_the_truth(point["variant"]) or point["n_pairs"] < most


def _figure(own: pd.DataFrame, words: str) -> Figure:
    domains = list(dict.fromkeys(own["domain"]))
    costs = known_costs(own)
    figure = blank_figure(9.0, 0.3 + _PANEL_HEIGHT_IN * len(domains))
    panels = []
    for row, domain in zip(figure.subplots(len(domains), len(costs), squeeze=False), domains, strict=True):
        for axes, cost in zip(row, costs, strict=True):
            points = own[(own["domain"] == domain) & (own["cost"] == cost)].to_dict("records")
            panels.append((axes, [{str(key): value for key, value in point.items()} for point in points], cost))
            _panel(*panels[-1])
            n_pairs = max((int(point["n_pairs"]) for point in points), default=0)
            axes.set_title(f"{domain_name(str(domain))}, {n_pairs} pairs", fontsize=9)
        row[0].set_ylabel(words, fontsize=8)
    figure.draw_without_rendering()  # names are placed in the final layout
    for axes, points, cost in panels:
        _names(axes, points, cost)
    return figure


def _panel(axes: Axes, points: Sequence[Mapping[str, Any]], cost: str) -> None:
    words, unit = COSTS[cost]
    best = sorted((point for point in points if point["is_on_front"]), key=lambda point: point["cost_value"])
    x = np.array([point["cost_value"] / unit for point in points], dtype=np.float64)
    if len(points):
        # room at the right for names, and below for what costs nothing
        axes.set_xscale("log")
        axes.set_xlim(x[x > 0].min(initial=x.max() or 1.0) / 1.8, x.max() * 5.0)
    axes.set_ylim(-0.12, 1.12)
    front_x = [point["cost_value"] / unit for point in best]
    axes.plot(front_x, [point["quality_value"] for point in best], color=BLUE, linewidth=1.2, drawstyle="steps-post")
    for point, at in zip(points, x, strict=True):
        colour = BLACK if point["is_on_front"] else _GREY
        axes.vlines(at, point["low"], point["high"], color=colour, linewidth=0.9, alpha=0.6)
        order = 5 if point["is_on_front"] else 3 if is_apart(point, points) else 4
        face = "white" if is_apart(point, points) else colour
        axes.plot(at, point["quality_value"], "o", markersize=5, color=colour, markerfacecolor=face, zorder=order)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_yticks(np.linspace(0, 1, 6))
    axes.set_xlabel(words, fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(color="#efefef", linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _names(axes: Axes, points: Sequence[Mapping[str, Any]], cost: str) -> None:
    """Write names beside their points, the front's first, each where it hides no other name and no point."""
    scale = axes.figure.dpi / 72.0
    unit = COSTS[cost][1]
    places = [axes.transData.transform((point["cost_value"] / unit, point["quality_value"])) for point in points]
    taken = [Bbox.from_bounds(x - 3 * scale, y - 3 * scale, 6 * scale, 6 * scale) for x, y in places]
    order = sorted(range(len(points)), key=lambda index: not points[index]["is_on_front"])
    for index in order:
        point, (x, y) = points[index], places[index]
        text = _wrapped(spaced(point["variant"]))
        if is_apart(point, points) and not is_told_the_truth(point["variant"]):
            text += f" (n {point['n_pairs']})"
        lines = text.split("\n")
        width, height = 0.62 * _FONT_PT * max(map(len, lines)) * scale, 1.25 * _FONT_PT * len(lines) * scale
        boxes = [_box(x, y, offset, (width, height), scale) for offset in _PLACES]
        inside = axes.bbox
        free = [
            number
            for number, box in enumerate(boxes)
            if box.x0 >= inside.x0 and box.x1 <= inside.x1 and box.y0 >= inside.y0 and box.y1 <= inside.y1
            and box.count_overlaps(taken) == 0
        ]  # fmt: skip
        if not free and not point["is_on_front"]:
            continue  # pareto.csv has it
        chosen = free[0] if free else 0
        taken.append(boxes[chosen])
        dx, dy = _PLACES[chosen]
        axes.annotate(
            text, (point["cost_value"] / unit, point["quality_value"]), (dx, dy), textcoords="offset points",
            fontsize=_FONT_PT, color=BLACK if point["is_on_front"] else _GREY, va="bottom",
            ha="left" if dx > 0 else "right",
            weight="bold" if point["is_on_front"] else "normal",
            arrowprops={**_LEADER, "relpos": (0.0 if dx > 0 else 1.0, 0.5)} if chosen >= _N_NEAR else None,
        )  # fmt: skip


def _box(x: float, y: float, offset: tuple[int, int], size: tuple[float, float], scale: float) -> Bbox:
    left = x + offset[0] * scale - (0.0 if offset[0] > 0 else size[0])
    return Bbox.from_bounds(left, y + offset[1] * scale, *size)


def _wrapped(name: str) -> str:
    """Break a long name at its spaces."""
    lines = [""]
    for word in name.split(" "):
        if lines[-1] and len(lines[-1]) + len(word) >= _WRAPPED_AT:
            lines.append(word)
        else:
            lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines)
