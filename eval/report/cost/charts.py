"""Quality against cost: a chart for regions and one for objects; every method a point, the Pareto front joined."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from eval.core.charts import BLACK, BLUE, SYMBOLS, Axis, Drawing, Look, Panel, Series, log_span
from eval.core.domains import domain_name
from eval.report.charts import Chart
from eval.report.cost.pareto import BYTES, F1, RECALL_AT_K, RECALL_AT_RATE, TIME
from eval.report.regions.charts import look_of
from eval.tables.rows import is_told_the_truth

_QUALITIES = {
    "regions": {RECALL_AT_RATE: "recall at 0.1 false regions per 100 m", RECALL_AT_K: "recall at K"},
    "objects": {F1: "F1 of objects at IoU 0.5"},
}
_COSTS = {TIME: ("time of a pair [s], median", 1.0), BYTES: ("kept of the before map [kB], mean", 1000.0)}
_GREY = "#8a8a8a"
_FRONT = Look(BLUE, 1.6)
_MAX_IN_LEGEND = 24

Point = Mapping[str, Any]


def draw_pareto(table: pd.DataFrame, *, is_contended: bool = False) -> list[Chart]:
    """Return the charts `pareto_regions` and `pareto_objects`, of those that `pareto_table` has rows for.

    A quality that is 0 for every method is left out.

    Args:
        table: As `eval.report.cost.pareto.pareto_table` returns it.
        is_contended: Whether other work ran on the machine while times were measured: said in the caption.
    """
    found = []
    more = " Times were measured beside other work." if is_contended else ""
    for subject, names in _QUALITIES.items():
        own = table[table["quality"].isin(names)]
        if len(own) and own["quality_value"].max() > 0:
            words = names[str(own["quality"].iloc[0])]
            title = f"{words[0].upper()}{words[1:]}, against its cost"
            found.append(Chart(f"pareto_{subject}", title, _drawing(own, words), _caption(own) + more, has_png=True))
    return found


def _drawing(own: pd.DataFrame, words: str) -> Drawing:
    """Return a row of panels for each domain and a column for each cost, of the rows of one quality."""
    names = [str(name) for name in dict.fromkeys(own["variant"])]
    rows = []
    for domain in dict.fromkeys(own["domain"]):
        row: list[Panel] = []
        for cost, (title, unit) in _COSTS.items():
            if not (own["cost"] == cost).any():
                continue
            chosen = own[(own["domain"] == domain) & (own["cost"] == cost)]
            points: list[Point] = [
                {**{str(key): value for key, value in point.items()}, "x": point["cost_value"] / unit}
                for point in chosen.to_dict("records")
            ]
            n_pairs = max((int(point["n_pairs"]) for point in points), default=0)
            best = sorted((point for point in points if point["is_on_front"]), key=lambda point: float(point["x"]))
            front_x, front_y = ([each[key] for each in best] for key in ("x", "quality_value"))
            # room for names at the left; a cost of 0 has no place on the axis
            x = Axis(title, log_span([point["x"] for point in points], 4.0, 1.6), is_log=True)
            y = Axis("" if row else words, (-0.06, 1.12))
            series = [
                Series(front_x, front_y, _FRONT, style="steps"),
                *(_series(point, points, names, title) for point in points),
            ]
            row.append(Panel(x, y, series, f"{domain_name(str(domain))}, {n_pairs} pairs"))
        rows.append(row)
    return Drawing(rows, 300)


def _series(point: Point, points: Sequence[Point], names: Sequence[str], title: str) -> Series:
    """Return one method, with a legend where it has room; without one the front alone is named, beside its points."""
    name, is_best = str(point["variant"]), bool(point["is_on_front"])
    has_legend, place = len(names) <= _MAX_IN_LEGEND, names.index(name)
    colour = look_of(name, names).colour if has_legend else BLACK if is_best else _GREY
    marker = SYMBOLS[place % len(SYMBOLS)] if has_legend else "circle"
    interval = f"95 %: {point['low']:.3f} to {point['high']:.3f}, n {point['n_quality']}"
    # a name with settings is as long as the panel is wide; the legend has it
    label = name if is_best and not (has_legend and "[" in name) else ""
    return Series(
        [point["x"]], [point["quality_value"]], Look(colour, 0.0, marker=marker, is_hollow=_is_apart(point, points)),
        name if has_legend else "", low=[point["low"]], high=[point["high"]], labels=[label],
        hover=f"<b>{name}</b><br>{point['quality_value']:.3f} ({interval})<br>{point['x']:.3g}, {title}<extra></extra>",
    )  # fmt: skip


def _is_apart(point: Point, points: Sequence[Point]) -> bool:
    """Tell whether a point does not compete: `eval.report.cost.pareto`."""
    most = max(other["n_pairs"] for other in points if not is_told_the_truth(other["variant"]))
    return is_told_the_truth(point["variant"]) or point["n_pairs"] < most


def _caption(own: pd.DataFrame) -> str:
    best = own[own["is_on_front"]]
    told = [
        f"{words.partition(' [')[0]}, {domain_name(domain)}: {', '.join(names)}"
        for cost, (words, _) in _COSTS.items()
        for domain in dict.fromkeys(best["domain"])
        if (names := list(best[(best["cost"] == cost) & (best["domain"] == domain)]["variant"]))
    ]
    return (
        "Higher is better, farther left is cheaper. The line joins the methods that no other method beats in both. "
        "Bars: 95 % interval of the quality over session pairs. Hollow: the method is given the truth, or ran fewer "
        f"pairs, and does not compete. On the front: {'; '.join(told)}."
    )
