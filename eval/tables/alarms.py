"""Which unchanged pairs count as an alarm: not those alone in which a region is reported."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.geometry import BoolArray, Float64Array
from eval.tables.merge_table import kinds
from eval.tables.rows import numbers
from eval.tables.targets import is_unchanged_pair

_REFUSABLE = ("smooth", "disjoint")


def may_be_refused(results: pd.DataFrame) -> BoolArray:
    """Return (N,) whether each row of results.csv is of a kind of pair at which a refusal can be right."""
    return np.isin(kinds(results), _REFUSABLE)


def count_alarms(results: pd.DataFrame) -> Float64Array:
    """Return (N,) whether each row counts as an alarm; NaN where something changed, or where a refusal can be right.

    Who refuses the pairs on which he would cry wolf is not silent, nor is who answers objects without regions.
    """
    # truth values that a table held beside empty cells are read back as texts
    words = {"true": 1.0, "false": 0.0}
    stated = results["is_alarm"].map(lambda value: words.get(str(value).lower(), value))
    alarms = numbers(results.assign(is_alarm=stated), "is_alarm")
    if "is_unchanged_pair" not in results:
        return alarms
    is_unanswered = (results["status"] != "ok").to_numpy(dtype=np.bool_) & ~may_be_refused(results)
    cries = is_unanswered | (numbers(results, "n_objects") > 0)
    return np.where(is_unchanged_pair(results) & cries, 1.0, alarms)


def with_counted_alarms(results: pd.DataFrame, plan: Any) -> pd.DataFrame:
    """Return results.csv with `is_alarm` as it counts in tables of means; as it is where the plan ends at the merge."""
    ends_at_merge = isinstance(plan, Mapping) and plan.get("until") == "merge"
    if "is_alarm" not in results or ends_at_merge:
        return results
    return results.assign(is_alarm=count_alarms(results))
