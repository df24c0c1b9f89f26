"""What each setting of the world does to every variant: a table of paired differences and a picture of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from eval.core.figures import picture_address
from eval.core.statistics import ENOUGH_PAIRS
from eval.plans.worlds import get_group
from eval.report.settings.charts import Effect, effect_chart
from eval.report.tables import Cell, Picture, Table
from eval.running.run_data import RunData, of, over_pairs
from eval.tables.columns import RESULT_COLUMNS, UNDEFINED, Column, count
from eval.tables.effects import effects

_OBSERVABLE = Column("n_observable", "observable changes", None, count, "", "")
_KEYS = (
    "region_recall", "region_recall_at_k", "region_auroc", "false_regions_per_100m", "object_iou_point",
    "merge_error_m",
)  # fmt: skip
COLUMNS = (_OBSERVABLE, *(column for column in RESULT_COLUMNS if column.key in _KEYS))
_DRAWN = ("region_recall_at_k", "object_iou_point")
_MINUS = "\u2212"

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class EffectsOn:
    """What the settings over one world do; no picture where neither recall nor IoU is defined."""

    reference: str
    table: Table
    picture: Picture | None


def draw_effects(data: RunData) -> list[EffectsOn]:
    """Return table and picture for every world that others repeat with something set otherwise."""
    results = pd.DataFrame(list(data.results))
    known = [name for name in ("scenario", "seed", "variant", *(column.key for column in COLUMNS)) if name in results]
    found: dict[str, list[Row]] = {}
    for record in effects(results[known]).to_dict("records"):
        row = {str(key): value for key, value in record.items()}
        found.setdefault(row["reference"], []).append(row)
    return [_effects_on(data, reference, rows) for reference, rows in found.items()]


def signed(column: Column, value: float) -> str:
    """Write a difference as its column writes values, with its sign; one that is written as 0 has none."""
    if math.isnan(value):
        return UNDEFINED
    written = column.shown(abs(value))
    sign = "" if not any(digit in written for digit in "123456789") else "+" if value > 0 else _MINUS
    return f"{sign}{written}"


def shortened(settings: Sequence[str]) -> tuple[str, list[str]]:
    """Return the group that all settings belong to, "" if there is none, and the settings without it."""
    groups = {get_group(part) for text in settings for part in text.split(",")}
    group = groups.pop() if len(groups) == 1 else ""
    return group, [", ".join(part.removeprefix(f"{group}.") for part in text.split(",")) for text in settings]


def _effects_on(data: RunData, reference: str, rows: Sequence[Row]) -> EffectsOn:
    columns = [column for column in COLUMNS if any(row["n"] and row["metric"] == column.key for row in rows)]
    settings = list(dict.fromkeys(row["settings"] for row in rows))
    group, short = shortened(settings)
    names = dict(zip(settings, short, strict=True))
    title = f"{reference}: what each setting of its {group} does" if group else f"{reference}: what each setting does"
    table = Table(*_lines(data, rows, columns, names), f"{title}, on average")
    drawn = [column for column in columns if column.key in _DRAWN]
    return EffectsOn(reference, table, _picture(title, rows, drawn, names) if drawn else None)


def _lines(
    data: RunData, rows: Sequence[Row], columns: Sequence[Column], names: dict[str, str]
) -> tuple[tuple[str, ...], tuple[tuple[str, tuple[Cell, ...]], ...]]:
    """Headings and rows of the table: for each variant the world's own means, then every setting."""
    by_place = {(row["variant"], row["settings"], row["metric"]): row for row in rows}
    lines: list[tuple[str, tuple[Cell, ...]]] = []
    for variant in dict.fromkeys(row["variant"] for row in rows):
        plain = of(data.results, scenario=rows[0]["reference"], variant=variant)
        means = (Cell(column.shown(over_pairs(plain, column.key))) for column in columns)
        lines.append((variant, (Cell("as it is: mean"), Cell(str(len(plain))), *means)))
        for settings, name in names.items():
            found = [by_place.get((variant, settings, column.key)) for column in columns]
            n = max((int(row["n"]) for row in found if row is not None), default=0)
            cells = (
                Cell(UNDEFINED) if row is None else _cell(column, row)
                for column, row in zip(columns, found, strict=True)
            )
            lines.append((variant, (Cell(name), Cell(str(n)), *cells)))
    return ("setting", "pairs", *(column.heading for column in columns)), tuple(lines)


def _cell(column: Column, row: Row) -> Cell:
    is_clear = row["n"] >= ENOUGH_PAIRS and (row["low"] > 0 or row["high"] < 0)
    low, high = (signed(column, row[end]) for end in ("low", "high"))
    return Cell(signed(column, row["difference"]), is_clear, "" if math.isnan(row["low"]) else f"{low} to {high}")


def _picture(title: str, rows: Sequence[Row], columns: Sequence[Column], names: dict[str, str]) -> Picture:
    panels = {
        column.heading: [
            Effect(names[row["settings"]], row["variant"], row["difference"], row["low"], row["high"])
            for row in rows
            if row["metric"] == column.key
        ]
        for column in columns
    }
    counts = sorted({int(row["n"]) for row in rows if row["metric"] in _DRAWN})
    n = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    pairs = "pair" if n == "1" else "pairs"
    caption = f"Dots are means over {n} session {pairs}, lines their 95 % intervals; right of 0 is better."
    return Picture(title, picture_address(effect_chart(panels)), caption)
