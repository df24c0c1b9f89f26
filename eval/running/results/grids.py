"""Grids of a run: variants of one preset that differ in two settings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import pandas as pd

from eval.running.results.run_data import RunData


@dataclass(frozen=True, slots=True, eq=False)
class GridOf:
    """The points of one preset on a grid of two settings.

    Attributes:
        scenario: Where it was run.
        preset: Over which preset, and what else was set to one value.
        keys: The two settings; rows first.
        values: Their values, as texts, in rising order.
        points: Name of the variant at each pair of values.
    """

    scenario: str
    preset: str
    keys: tuple[str, str]
    values: tuple[tuple[str, ...], tuple[str, ...]]
    points: Mapping[tuple[str, str], str]


def find_grids(data: RunData) -> list[GridOf]:
    """Find the grids: variants of one preset that set the same keys, two of them to several values, the rest to one.

    A grid has a variant at each pair of values. Fewer are variants of their own, and stand in the tables.
    """
    found: dict[tuple[str, str, tuple[str, ...]], dict[str, dict[str, str]]] = {}
    for row in data.results:
        preset, settings = split_variant(str(row["variant"]))
        found.setdefault((str(row["scenario"]), preset, tuple(settings)), {})[str(row["variant"])] = settings
    result = []
    for (scenario, preset, keys), variants in found.items():
        values = {key: sorted_values({settings[key] for settings in variants.values()}) for key in keys}
        varied = [key for key in keys if len(values[key]) >= 2]
        if len(varied) == 2 and len(variants) == len(values[varied[0]]) * len(values[varied[1]]):
            row_key, column_key = varied
            fixed = ", ".join(f"{key}={values[key][0]}" for key in keys if key not in varied)
            points = {(settings[row_key], settings[column_key]): name for name, settings in variants.items()}
            axes = (values[row_key], values[column_key])
            name = f"{preset} with {fixed}" if fixed else preset
            result.append(GridOf(scenario, name, (row_key, column_key), axes, points))
    return result


@lru_cache(maxsize=8)
def grid_points(data: RunData) -> set[tuple[str, str]]:
    """Return the scenario and the variant of every point of a grid."""
    return {(grid.scenario, name) for grid in find_grids(data) for name in grid.points.values()}


def off_grids(table: pd.DataFrame, data: RunData) -> pd.DataFrame:
    """Return the rows of a table whose `variant` is more than a point of a grid; all rows where none is.

    `eval.report.settings.grids` shows the points of grids, hundreds of them, in less space.
    """
    if "variant" not in table:
        return table
    points = grid_points(data)
    shown = {variant for world, variant, _ in data.cases if (world, variant) not in points}
    rows = table[table["variant"].isin(shown)]
    return rows if len(rows) else table


def split_variant(variant: str) -> tuple[str, dict[str, str]]:
    """Return the preset of a variant and its settings: "a[k=1,l=2]" gives "a" and {"k": "1", "l": "2"}."""
    preset, bracket, rest = variant.partition("[")
    if not bracket or not rest.endswith("]"):
        return variant, {}
    settings: dict[str, str] = {}
    for part in rest[:-1].split(","):
        key, _, value = part.partition("=")
        settings[key.strip()] = value.strip()
    return preset, settings


def sorted_values(values: Iterable[str]) -> tuple[str, ...]:
    """Return the values of a setting in rising order, numbers before words."""

    def order(value: str) -> tuple[int, float, str]:
        try:
            return 0, float(value), value
        except ValueError:
            return 1, 0.0, value

    return tuple(sorted(values, key=order))
