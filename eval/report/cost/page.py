"""Quality against cost on the page: a chart for regions and one for objects, each with its picture for papers."""

from __future__ import annotations

import pandas as pd

from eval.core.domains import domain_name
from eval.report.charts import Chart
from eval.report.cost.chart import pareto_figure
from eval.report.cost.pareto import F1, RECALL_AT_K, RECALL_AT_RATE
from eval.report.cost.plots import COSTS, pareto_png

_QUALITIES = {
    "regions": {RECALL_AT_RATE: "recall at 0.1 false regions per 100 m", RECALL_AT_K: "recall at K"},
    "objects": {F1: "F1 of objects at IoU 0.5"},
}


def draw_pareto(table: pd.DataFrame, *, is_contended: bool = False) -> list[Chart]:
    """Return the charts `pareto_regions` and `pareto_objects`, of those that `pareto_table` has rows for.

    A quality that is 0 for every method says nothing and is left out.

    Args:
        table: As `eval.report.cost.pareto.pareto_table` returns it.
        is_contended: Whether times were measured beside other work: said in the caption.
    """
    found = []
    more = " Times were measured beside other work." if is_contended else ""
    for subject, names in _QUALITIES.items():
        own = table[table["quality"].isin(names)]
        if len(own) and own["quality_value"].max() > 0:
            words = names[str(own["quality"].iloc[0])]
            title = f"{words[0].upper()}{words[1:]}, against what it costs"
            figure, picture = pareto_figure(own, words), pareto_png(own, words)
            found.append(Chart(f"pareto_{subject}", title, figure, _caption(own) + more, picture))
    return found


def _caption(own: pd.DataFrame) -> str:
    best = own[own["is_on_front"]]
    told = [
        f"{words.partition(' [')[0]}, {domain_name(domain)}: {', '.join(names)}"
        for cost, (words, _) in COSTS.items()
        for domain in dict.fromkeys(best["domain"])
        if (names := list(best[(best["cost"] == cost) & (best["domain"] == domain)]["variant"]))
    ]
    return (
        "Up is better, left is cheaper; joined and named are the methods that no other beats in both. Bars: 95 % "
        "interval of the quality over session pairs. Hollow: is told the truth, or ran fewer pairs, and does not "
        f"compete. On the front: {'; '.join(told)}."
    )
