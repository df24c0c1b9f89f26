"""Differences between two runs, or between two methods of one run, with intervals and verdicts.

A difference B - A is the mean over the session pairs that both sides have. Its interval is a bootstrap over these
pairs. A verdict needs at least six pairs and an interval that excludes 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, Int64Array
from eval.core.statistics import ENOUGH_PAIRS, paired_difference
from eval.plans.targets import read_targets
from eval.report.comparing.columns import COMPARED, figures_of, is_time
from eval.report.pooled import POOLED, POOLED_RATE_PER_100M, rank_pairs
from eval.running.results.run_data import RunData
from eval.running.results.sides import Side, check_extras, check_versions, matched_variants
from eval.tables.columns import Column
from eval.tables.conditions import Condition, by_condition
from eval.tables.regions.curves import recall_at, recall_difference
from eval.tables.rows import ALL_DOMAINS, DOMAINS, PAIR, numbers, stated_columns, tunnels_of, with_pair

BETTER, WORSE, NOISE = "better", "worse", "no difference beyond noise"
SAME, TOO_FEW, NOT_JUDGED = "the same", "too few pairs", "not judged"
COLUMNS = (
    "scope", "where", "variant_a", "variant_b", "metric", "good", "n_pairs", "n_used", "n_only_a", "n_only_b",
    "mean_a", "mean_b", "difference", "low", "high", "verdict",
)  # fmt: skip
_ORDER = {column.key: place for place, column in enumerate(COMPARED)}


def compare(a: Side, b: Side, *, times_count: bool = True, seed: int = 0) -> pd.DataFrame:
    """Compare two sides pair by pair: every variant that both have, or the only variant of a side with all others.

    Args:
        a: The reference.
        b: The side that the verdicts are about.
        times_count: Whether times may be judged: both runs are of one machine that did nothing else.
        seed: Seed of the bootstrap.

    Returns:
        One row for each scenario and each domain, variant and figure with a number on both sides: `scope` ("domain",
        "scenario"); `where`, its name, `all` for both domains, which are of the pairs with the odometry and the sensor
        of A's plan where the sides share any; `variant_a`, `variant_b`; `metric`; `good`, the
        direction; `n_pairs` that both sides have, `n_used` of them with a number on both, `n_only_a` and `n_only_b`
        with one on one side only; `mean_a`, `mean_b` over the used ones, their `difference` (b - a), its 95 % interval
        `low` to `high` over tunnels; `verdict` on B. Pooled recall has the recalls in place of means.

    Raises:
        InputError: The sides share no session pair, or their metrics versions differ.
    """
    check_versions(a, b)
    check_extras(a)
    check_extras(b)
    of_plan = _pairs_of_plan(a)
    unmade = [set(_pairs(side.results)) - set(_pairs(with_pair(side.results))) for side in (a, b)]
    figures = [figures_of(_without(side.results, unmade[0] & unmade[1])) for side in (a, b)]
    compared = [column.key for column in COMPARED if all(column.key in frame for frame in figures)]
    rows: list[dict[str, Any]] = []
    for variants in matched_variants(a, b):
        own = [frame[frame["variant"] == name] for frame, name in zip(figures, variants, strict=True)]
        for scope, where, pairs in _groups(own[0], own[1], of_plan):
            names = {"scope": scope, "where": where, "variant_a": variants[0], "variant_b": variants[1]}
            first, second = (stated_columns(frame.set_index(PAIR).loc[pairs], compared) for frame in own)
            found = paired_differences(first, second, seed)
            if scope == "domain":
                found += pooled_difference((a, b), variants, pairs, seed)
            found.sort(key=lambda row: _ORDER[row["metric"]])
            rows += [{**names, "n_pairs": len(pairs), **row} for row in found]
    if not rows:
        raise InputError(f"{a.name} and {b.name} share no session pair and variant: nothing can be paired")
    for row in rows:
        is_judged = times_count or not is_time(row["metric"])
        row["verdict"] = verdict(row) if is_judged else NOT_JUDGED
    rows.sort(key=_place)
    return pd.DataFrame(rows, columns=list(COLUMNS))


def condition_compared(side: Side) -> Condition | None:
    """Return the odometry and sensor that domains are compared over; None where the plan of a side tells none apart."""
    conditions = by_condition(side.results, read_targets(side.data.provenance))
    return conditions[0][0] if len(conditions) > 1 else None


def _pairs_of_plan(side: Side) -> pd.MultiIndex:
    """Return the pairs that the figures of a side's plan are of, by odometry and sensor (`by_condition`)."""
    _, is_its = by_condition(side.results, read_targets(side.data.provenance))[0]
    return _pairs(side.results[is_its])


def _pairs(results: pd.DataFrame) -> pd.MultiIndex:
    return pd.MultiIndex.from_frame(results[PAIR])


def _without(results: pd.DataFrame, pairs: set[Any]) -> pd.DataFrame:
    """Return the rows of results.csv that are of none of some pairs, whose worlds neither side could make."""
    return results[~_pairs(results).isin(list(pairs))] if pairs else results


def paired_differences(a: pd.DataFrame, b: pd.DataFrame, seed: int = 0) -> list[dict[str, Any]]:
    """Return the difference of each compared column over the pairs that have a number on both sides.

    Args:
        a: (N, columns) figures of one side, a row for each session pair, by scenario and seed.
        b: The same pairs in the same order.
        seed: Seed of the bootstrap.

    Returns:
        A row for each column that at least one pair has on both sides.
    """
    columns = [column for column in COMPARED if column.key in a and column.key in b]
    tunnels = tunnels_of(a.index.to_frame())
    found = [
        {"metric": column.key, "good": column.better,
         **_difference(numbers(a, column.key), numbers(b, column.key), tunnels, seed)}
        for column in columns
    ]  # fmt: skip
    return [row for row in found if row["n_used"]]


def _difference(a: Float64Array, b: Float64Array, tunnels: Int64Array, seed: int = 0) -> dict[str, Any]:
    """Return `paired_difference`, and whether each pair with both numbers has the same one on both sides."""
    used = ~np.isnan(a) & ~np.isnan(b)
    is_same = bool(used.any()) and bool((a[used] == b[used]).all())
    return {**paired_difference(a, b, seed, tunnels), "is_same": is_same}


def verdict(row: Mapping[str, Any]) -> str:
    """Return the word for a difference b - a.

    Args:
        row: `good`, the direction ("high" or "low") in which the figure should move; `n_used` and `n_tunnels`, over
            how many session pairs of how many tunnels the difference is; `difference` and its 95 % interval `low` to
            `high`, NaN for none; `is_same`: no pair differs. Where that is not told, no draw of pairs may differ.
    """
    low, high = row["low"], row["high"]
    if row.get("is_same", row["difference"] == low == high == 0.0):
        return SAME
    if row.get("n_tunnels", row["n_used"]) < ENOUGH_PAIRS or math.isnan(low):
        return TOO_FEW
    if low <= 0.0 <= high:
        return NOISE
    return BETTER if (low > 0.0) == (row["good"] == "high") else WORSE


def _groups(a: pd.DataFrame, b: pd.DataFrame, of_plan: pd.MultiIndex) -> list[tuple[str, str, pd.MultiIndex]]:
    """Return scope, name and the pairs that both sides have, for each domain (those `of_plan`) and each scenario."""
    pairs = pd.MultiIndex.from_frame(a[PAIR]).intersection(pd.MultiIndex.from_frame(b[PAIR])).sort_values()
    if len(pairs) == 0:
        return []
    is_of_plan = pairs.isin(of_plan)
    main = pairs[is_of_plan] if is_of_plan.any() else pairs
    domain_of_pair = a.set_index(PAIR)["domain"].loc[main].to_numpy()
    present = [name for name in DOMAINS if (domain_of_pair == name).any()]
    found = [("domain", name, main[domain_of_pair == name]) for name in present]
    if len(present) > 1:
        found.append(("domain", ALL_DOMAINS, main))
    scenario = pairs.get_level_values("scenario")
    return found + [("scenario", str(name), pairs[scenario == name]) for name in scenario.unique()]


def pooled_difference(
    sides: tuple[Side, Side], variants: tuple[str, str], pairs: pd.Index[Any], seed: int = 0
) -> list[dict[str, Any]]:
    """Return the difference of recall at 0.1 false regions per 100 m, both recalls drawn together.

    Args:
        sides: Whose candidates and changes.
        variants: Of which method on each side.
        pairs: (scenario, seed) of the pairs that both have.
        seed: Seed of the bootstrap.

    Returns:
        One row as of `paired_differences`, or none where it is undefined.
    """
    wanted = tuple(pairs)
    first, second = (rank_pairs(side.data, variant, wanted) for side, variant in zip(sides, variants, strict=True))
    if first is None or second is None:
        return []
    n_used = int(np.count_nonzero(first.n_observable))
    if n_used == 0 or first.pairs != second.pairs:
        return []
    recalls = [recall_at(each, POOLED_RATE_PER_100M) for each in (first, second)]
    difference, low, high = recall_difference(first, second, POOLED_RATE_PER_100M, seed)
    return [
        {
            "metric": POOLED, "good": "high", "n_used": n_used,
            "n_tunnels": len(np.unique(first.tunnels[first.n_observable > 0])), "n_only_a": 0, "n_only_b": 0,
            "mean_a": recalls[0], "mean_b": recalls[1], "difference": difference, "low": low, "high": high,
        }
    ]  # fmt: skip


def is_told_apart(
    of_method: Mapping[str, pd.DataFrame], column: Column, first: str, second: str, data: RunData
) -> bool | None:
    """Tell whether two methods of a run differ beyond noise in a column; None where it has no number for each pair.

    Arguments as of `judge_methods`.
    """
    found = judge_methods(of_method, column, first, second, data)
    return found in (BETTER, WORSE) if found else None


def judge_methods(of_method: Mapping[str, pd.DataFrame], column: Column, first: str, second: str, data: RunData) -> str:
    """Return the verdict on the difference of two methods of a run; "" where there is no number for each pair.

    Args:
        of_method: Figures of each method, a row for each session pair, by scenario and seed.
        column: The column.
        first: One method.
        second: The other.
        data: The run.
    """
    own = [of_method[first], of_method[second]]
    pairs = own[0].index.intersection(own[1].index)
    if column.key == POOLED:
        rows = pooled_difference((Side(data), Side(data)), (first, second), pairs)
    elif column.key in own[0]:
        a, b = (numbers(frame[[column.key]].loc[pairs], column.key) for frame in own)
        tunnels = tunnels_of(pairs.to_frame())
        rows = [_difference(a, b, tunnels)]
    else:
        rows = []
    return verdict({"good": "high", **rows[0]}) if rows else ""


def _place(row: Mapping[str, Any]) -> tuple[bool, int, str]:
    """Return the sort key of a row: domains first, then scenarios by name."""
    is_scenario = row["scope"] == "scenario"
    return is_scenario, 0 if is_scenario else DOMAINS.index(row["where"]), row["where"]
