"""The conditions under which pairs were recorded, odometry and sensor, and of which of them a plan's figures are.

A plan whose targets name an odometry or a sensor runs pairs under several. Its figures are those of the pairs with this
odometry and this sensor; all others have rows of their own for comparison. A plan that names neither mixes them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.geometry import BoolArray
from eval.plans.targets import Targets
from eval.tables.rows import texts

COLUMNS = ("odometry", "sensor")
ANY = "all"


@dataclass(frozen=True, slots=True)
class Condition:
    """The odometry of both sessions and the sensor's profile; "all" for what a plan does not tell apart."""

    odometry: str = ANY
    sensor: str = ANY

    @property
    def columns(self) -> dict[str, str]:
        """The columns that name it in a table."""
        return {"odometry": self.odometry, "sensor": self.sensor}

    @property
    def words(self) -> str:
        """What it tells apart, "" for nothing."""
        return ", ".join(name for name in (self.odometry, self.sensor) if name != ANY)


def odometry_of(results: pd.DataFrame) -> np.ndarray[Any, np.dtype[np.object_]]:
    """Return (N,) the odometry of each pair: of both sessions, or "kiss-icp, drift"; "" where it is not known."""
    before, after = (texts(results, f"odometry_{session}") for session in ("before", "after"))
    pairs = zip(before, after, strict=True)
    return np.array([a if a == b else f"{a}, {b}" for a, b in pairs], dtype=object)


def by_condition(results: pd.DataFrame, targets: Targets) -> list[tuple[Condition, BoolArray]]:
    """Return each condition with (N,) its rows, first the one that the plan's figures are of.

    That is the one that the targets name, or the first row's where no pair has it. Rows whose world could not be made,
    or that are of an older version, do not tell theirs: they count there.

    Args:
        results: Rows of results.csv.
        targets: What the plan of the run asks for.
    """
    asked = {"odometry": targets.odometry, "sensor": targets.sensor}
    told = {"odometry": odometry_of(results), "sensor": texts(results, "sensor_profile")}
    names = [told[name] if asked[name] else [ANY] * len(results) for name in COLUMNS]
    of_rows = [Condition(*row) if all(row) else None for row in zip(*names, strict=True)]
    found = list(dict.fromkeys(each for each in of_rows if each is not None))
    wanted = Condition(asked["odometry"] or ANY, asked["sensor"] or ANY)
    main = wanted if wanted in found or not found else found[0]
    of_rows = [each or main for each in of_rows]
    conditions = [main, *(each for each in found if each != main)]
    return [(name, np.array([each == name for each in of_rows], dtype=np.bool_)) for name in conditions]


def of_condition(table: pd.DataFrame, condition: Condition) -> pd.DataFrame:
    """Return the rows of a derived table that are of a condition; all rows of a table that tells none apart."""
    for name, value in condition.columns.items():
        if name in table:
            table = table[table[name].fillna(ANY) == value]
    return table


def told_apart(table: pd.DataFrame) -> dict[str, str]:
    """Return the columns of a derived table in which its rows differ in condition, with their headings."""
    return {name: name for name in COLUMNS if name in table and table[name].nunique() > 1}


def condition_of_row(row: Mapping[str, Any]) -> Condition:
    """Return the condition that a row of a derived table names."""
    return Condition(*(str(row.get(name, ANY)) for name in COLUMNS))
