"""What a run says about the merge: who accepted, refused or failed, how right the accepted ones are, target by target.

The unit is the session pair. Nothing is dropped: a refused or failed pair counts among the pairs of its row, and it is
within a target only where the target says that refusing is right.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.geometry import BoolArray
from eval.plans.targets import Targets, is_oracle
from eval.tables.conditions import ANY, odometry_of, told_apart
from eval.tables.rows import numbers, texts, wilson_over_tunnels, with_pair

RIGHT_M, RIGHT_DEG = 0.5, 2.0
EXACT_M, EXACT_DEG = 0.05, 0.3
ALL_FAMILIES = "all"
ERRORS = (
    "merge_error_m", "merge_error_deg", "merge_error_along_m", "merge_error_m_p95", "merge_error_deg_p95",
)  # fmt: skip
TIMES = ("t_index_s", "t_merge_s", "t_refine_s")
_NAMES = ("pair_kind", "odometry", "family", "variant")
# what a refusal says of a place that can slide along the tunnel: the setting of the gate that it names
DEGENERACY = "min_hessian_ratio"


# what each kind of pair asks of a merge; a plan says which share of the pairs must do so
RULES = {
    "clean": f"accepted, median error at most {EXACT_M:g} m and {EXACT_DEG:g} deg",
    "drift": f"accepted, 95th percentile of the error along the path at most {EXACT_M:g} m",
    "smooth": f"refused because it can slide, or right to {RIGHT_M:g} m and {RIGHT_DEG:g} deg",
    "disjoint": "refused",
}


def is_accepted(results: pd.DataFrame) -> BoolArray:
    """Return (N,) whether each case was merged; only then does it have an error."""
    return np.asarray(results["status"] == "ok", dtype=np.bool_)


def is_right(results: pd.DataFrame) -> BoolArray:
    """Return (N,) whether each case's median error is defined and at most 0.5 m and 2 deg."""
    metres, degrees = numbers(results, "merge_error_m"), numbers(results, "merge_error_deg")
    return np.asarray((metres <= RIGHT_M) & (degrees <= RIGHT_DEG) & (kinds(results) != "disjoint"), dtype=np.bool_)


def is_wrong(results: pd.DataFrame) -> BoolArray:
    """Return (N,) whether each case was accepted and is not right.

    Where the sessions share no place the error is undefined: whoever accepts is wrong.
    """
    return is_accepted(results) & ~is_right(results)


def is_within_target(results: pd.DataFrame) -> BoolArray:
    """Return (N,) whether each case does what its kind of pair asks for; False for kinds without a target."""
    kind, accepted = kinds(results), is_accepted(results)
    refused = np.asarray(results["status"] == "merge_refused", dtype=np.bool_)
    exact = (numbers(results, "merge_error_m") <= EXACT_M) & (numbers(results, "merge_error_deg") <= EXACT_DEG)
    within = {
        "clean": accepted & exact,
        "drift": accepted & (numbers(results, "merge_error_m_p95") <= EXACT_M),
        "smooth": (refused & names_degeneracy(results)) | (accepted & is_right(results)),
        "disjoint": refused,
    }
    return np.asarray(np.select([kind == name for name in within], list(within.values()), default=False))


def names_degeneracy(results: pd.DataFrame) -> BoolArray:
    """Return (N,) whether each case's error names the gate on the ratio of Hessian eigenvalues."""
    return np.array([DEGENERACY in word for word in texts(results, "error")], dtype=np.bool_)


def kinds(results: pd.DataFrame) -> np.ndarray[Any, np.dtype[np.object_]]:
    """Return the (N,) kinds of pair, "" where none was given."""
    return texts(results, "pair_kind")


def merge_table(results: pd.DataFrame, targets: Targets) -> pd.DataFrame:
    """Return one row for each kind of pair, odometry and variant, and the same for each family.

    Args:
        results: Rows as in results.csv.
        targets: What the plan of the run asks for.

    Returns:
        `pair_kind`; `odometry` of both sessions; `family`, "all" in the rows over all; `variant`; the counts `n_pairs`,
        `n_accepted`, `n_refused`, `n_failed`, `n_within_target`; `share_within_target` of all pairs with its 95 %
        Wilson interval `low` to `high`, as of so many pairs as there are tunnels; `target_share`; `n_wrong_accepted`;
        `n_p95_over_half_m`, accepted pairs whose 95th percentile along the path is over 0.5 m; `is_met`: the share
        reaches the target's and none is wrong and accepted (neither target nor verdict for a merge by the truth);
        `n_named_degeneracy` of the refusals; `median_` and `p95_` over the accepted pairs of each error, `n_` of them
        defined, and the median, 95th percentile and number of each time. Rows without a kind, and of worlds that were
        not made, are left out.
    """
    results = with_pair(results)
    kind = kinds(results)
    family = results["family" if "family" in results else "scenario"]
    odometry = odometry_of(results)
    results = results.copy()  # one block: pandas warns of a hundred columns in pieces
    cases = results.assign(pair_kind=kind, family=family, odometry=np.where(odometry == "", ANY, odometry))[kind != ""]
    rows: list[dict[str, Any]] = []
    for keys in (["pair_kind", "odometry", "variant"], ["pair_kind", "odometry", "family", "variant"]):
        for values, group in cases.groupby(keys, sort=False):
            names = {"family": ALL_FAMILIES, **dict(zip(keys, values, strict=True))}
            rows.append({**{key: names[key] for key in _NAMES}, **_counts(group, targets)})
    if not rows:
        return pd.DataFrame(columns=[*_NAMES, "n_pairs"])
    return pd.DataFrame(rows).sort_values("pair_kind", key=_kind_order, kind="stable", ignore_index=True)


def merge_overview(results: pd.DataFrame, targets: Targets, *, is_whole: bool = True) -> pd.DataFrame:
    """Return the rows of `merge_table` over all families with the columns that a terminal has room for.

    Args:
        results: Rows as in results.csv.
        targets: What the plan of the run asks for.
        is_whole: Whether all that was planned is in them; otherwise nothing is said to be met or not.
    """
    table = merge_table(results, targets)
    if len(table) == 0:
        return table
    shown = table[table["family"] == ALL_FAMILIES]
    names = {
        "pair_kind": "pair_kind", **told_apart(table), "variant": "variant", "n_pairs": "n", "n_accepted": "accepted",
        "n_refused": "refused", "n_failed": "failed", "share_within_target": "within", "low": "low", "high": "high",
        "target_share": "target", "is_met": "met", "n_wrong_accepted": "wrong_accepted",
        "n_p95_over_half_m": "p95_over_0.5m",
        "median_merge_error_m": "error_m", "median_merge_error_deg": "error_deg",
        "median_merge_error_m_p95": "error_m_p95", "median_t_merge_s": "t_merge_s",
    }  # fmt: skip
    overview = shown[list(names)].rename(columns=names)
    return overview if is_whole else overview.assign(met=None)


def _counts(group: pd.DataFrame, targets: Targets) -> dict[str, Any]:
    accepted, status = is_accepted(group), group["status"]
    n_within, n_wrong = int(is_within_target(group).sum()), int(is_wrong(group).sum())
    kind, nan = str(group["pair_kind"].iloc[0]), float("nan")
    has_rule = kind in RULES
    share = n_within / len(group) if has_rule else nan
    low, high = wilson_over_tunnels(is_within_target(group), group) if has_rule else (nan, nan)
    asked = None if is_oracle(str(group["variant"].iloc[0])) else targets.share(kind)
    n_refused = int((status == "merge_refused").sum())
    return {
        "n_pairs": len(group),
        "n_accepted": int(accepted.sum()),
        "n_refused": n_refused,
        "n_failed": len(group) - int(accepted.sum()) - n_refused,
        "n_within_target": n_within,
        "share_within_target": share,
        "low": low,
        "high": high,
        "target_share": nan if asked is None else asked,
        "n_wrong_accepted": n_wrong,
        "n_p95_over_half_m": int((accepted & (numbers(group, "merge_error_m_p95") > RIGHT_M)).sum()),
        "is_met": None if asked is None else bool(share >= asked and n_wrong == 0),
        "n_named_degeneracy": int((names_degeneracy(group) & np.asarray(status == "merge_refused")).sum()),
        **_spread(group[accepted], (*ERRORS, *TIMES)),
    }


def _spread(group: pd.DataFrame, columns: Sequence[str]) -> dict[str, float]:
    found: dict[str, float] = {}
    for column in columns:
        values = numbers(group, column)
        values = values[~np.isnan(values)]
        median, p95 = np.percentile(values, (50, 95)) if len(values) else (np.nan, np.nan)
        found |= {f"median_{column}": float(median), f"p95_{column}": float(p95), f"n_{column}": len(values)}
    return found


def _kind_order(column: pd.Series[str]) -> pd.Series[int]:
    order = list(RULES)
    return column.map(lambda name: order.index(name) if name in order else len(order))
