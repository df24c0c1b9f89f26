"""How hard it may get: the recall of every method at every step of every axis of a plan, and where it breaks.

A method breaks at the first step at which it finds fewer than half of the changes, with at most 0.1 false regions per
100 m: thresholds are set anew at every step, so none is to blame. A pair without an answer finds nothing.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd

from eval.core.statistics import interval_of, mean
from eval.plans.axes import Step, world_of_step
from eval.plans.plan import Plan, list_methods, with_step
from eval.tables.regions.curves import NEEDED, ranked_pairs, recall_at, resampled_recalls
from eval.tables.rows import count_failed, numbers, of_cases

FILES = ("hard", "breaking_points")
RATE_PER_100M = 0.1
BROKEN_BELOW = 0.5
_RECALL = f"recall_at_{RATE_PER_100M:g}"
_COUNTS = ("n_pairs", "n_judged", "n_failed", "n_observable")
_MEANS = ("region_auroc", "object_iou_point", "object_f1_50")


def hardness_table(results: pd.DataFrame, regions: pd.DataFrame, changes: pd.DataFrame, plan: Plan) -> pd.DataFrame:
    """Return a row for every axis, step and method of a plan.

    Args:
        results: Rows of results.csv.
        regions: Rows of regions.csv.
        changes: Rows of changes.csv.
        plan: Says which rows are of which step.

    Returns:
        `axis`, `unit`, `step` (1 is the easiest), `value`, `variant`, `scenario`; `n_planned` pairs, `n_pairs` that
        were run, `n_judged` of these with a world, `n_failed` without an answer, `n_observable` changes; recall at 0.1
        false regions per 100 m with its 95 % interval over pairs, and means over pairs of AUROC, IoU and F1. Numbers
        are NaN where no pair was run, or where nobody could see a change.
    """
    rows: list[dict[str, Any]] = []
    tables = results, regions, changes
    of_case = [_by_case(table) for table in tables]
    for axis in plan.axes:
        for number, step in enumerate(axis.steps, start=1):
            world = world_of_step(plan.base, step)
            names = {"axis": axis.name, "unit": axis.unit, "step": number, "value": step.value}
            for variant, run in zip(_variants_of_step(plan, Step(value=0)), _variants_of_step(plan, step), strict=True):
                own = [found.get((world, run), table[:0]) for found, table in zip(of_case, tables, strict=True)]
                n_planned = len(plan.seeds[: plan.base.n_seeds])
                told = {"variant": variant, "scenario": world, "n_planned": n_planned}
                rows.append({**names, **told, **_measure(*own)})
    return pd.DataFrame(rows)


def _by_case(table: pd.DataFrame) -> dict[Any, pd.DataFrame]:
    return dict(list(table.groupby(["scenario", "variant"], sort=False))) if len(table) else {}


def breaking_points(table: pd.DataFrame) -> pd.DataFrame:
    """Return a row for every axis and method of `hardness_table`: where it breaks.

    Returns:
        `step` and `value` of the first step with a recall below one half, 0 and "" where it holds; `recall`, the
        recall there with its 95 % interval, and that of the last step where it holds; `n_judged`, the pairs of that
        step, and `n_failed`, those of them without an answer; `is_measured`, whether every planned pair of all steps up
        to that one was run and has a world, and there was a change to find at each.
    """
    rows = []
    for (axis, variant), own in table.groupby(["axis", "variant"], sort=False) if len(table) else ():
        recall = own[_RECALL].to_numpy(dtype=np.float64)
        broken = np.flatnonzero(~(recall >= BROKEN_BELOW))
        place = int(broken[0]) if len(broken) else len(own) - 1
        is_run = (own["n_judged"] >= own["n_planned"]).to_numpy() & ~np.isnan(recall)
        is_measured = bool(is_run[: place + 1].all())
        holds = len(broken) == 0
        at = own.iloc[place]
        rows.append(
            {
                "axis": axis, "unit": at["unit"], "variant": variant, "step": 0 if holds else int(at["step"]),
                "value": "" if holds else at["value"], "recall": float(recall[place]), **_spread(at),
                "is_measured": is_measured,
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


def _spread(at: pd.Series[Any]) -> dict[str, float]:
    """Return the interval of the recall of a row of `hardness_table`, and the pairs that it is of."""
    ends = {f"recall_{end}": float(at.get(f"{_RECALL}_{end}", math.nan)) for end in ("low", "high")}
    return {**ends, "n_judged": int(at["n_judged"]), "n_failed": int(at["n_failed"])}


def _variants_of_step(plan: Plan, step: Step) -> list[str]:
    """Return the name of every method of the base world with the method's settings of a step."""
    alone = plan.model_copy(update={"axes": ()})
    methods = list_methods(alone, plan.base)
    return [with_step(method, step.method).variant for method in methods]


def _measure(results: pd.DataFrame, regions: pd.DataFrame, changes: pd.DataFrame) -> dict[str, float]:
    if len(results) == 0:
        return {**dict.fromkeys(_COUNTS, 0), **dict.fromkeys((_RECALL, *_MEANS), math.nan)}
    ranked = ranked_pairs(results, *(of_cases(items, results, NEEDED) for items in (regions, changes)))
    low, high = interval_of(resampled_recalls(ranked, RATE_PER_100M)) if ranked.has_interval else (math.nan, math.nan)
    return {
        "n_pairs": len(results),
        "n_judged": len(ranked.pairs),
        "n_failed": count_failed(results),
        "n_observable": int(ranked.n_observable.sum()),
        _RECALL: recall_at(ranked, RATE_PER_100M),
        f"{_RECALL}_low": low,
        f"{_RECALL}_high": high,
        **{name: mean(numbers(results, name)) for name in _MEANS},
    }
