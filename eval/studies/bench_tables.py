"""The tables of several runs of `tunnelcd bench` and `tunnelcd bench --growth`, for a page.

    python -m eval.studies.bench_tables bench-1.json bench-2.json bench-3.json growth.json --out tables.md

One row is one row of the speed table: the medians of its runs, with the lowest and highest in brackets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer

from cdpipe.core.errors import InputError
from cdpipe.core.files.json_file import read_json
from cdpipe.core.whole_file import whole_file
from eval.core.output import unwritable
from eval.core.terminal.exits import run_program
from eval.studies.reality.tables import format_markdown

_FIGURES = {"name", "value", "unit", "rival", "rival_value", "ratio", "target", "met", "reason"}
_GROWTH = {"axis", "stage", "smallest", "largest", "first", "value", "unit", "exponent", "low", "high", "verdict"}


def main(
    files: Annotated[list[Path], typer.Argument(help="files of `tunnelcd bench --out`, of --growth too")],
    out: Annotated[Path, typer.Option(help="Markdown file")],
) -> None:
    """Write the tables of several runs as Markdown."""
    tables = [(path, read_json(path, "a table of `tunnelcd bench --out`")) for path in files]
    try:
        parts = _format_tables(tables)
    except (LookupError, TypeError, ValueError, ArithmeticError, AttributeError) as error:
        told = f"{type(error).__name__} {' '.join(str(error).split()):.100}"
        raise InputError(f"{', '.join(map(str, files))}: damaged tables ({told}): name files of --out") from error
    try:
        with whole_file(out) as partial:
            partial.write_text("\n".join(parts), encoding="utf-8")
    except OSError as error:
        raise unwritable(out, error) from error


def _format_tables(tables: Sequence[tuple[Path, dict[str, Any]]]) -> list[str]:
    """Return the parts of the page; of a table that is damaged, whatever that provokes."""
    speed = [table for path, table in tables if not _is_growth(path, table)]
    growth = [table for path, table in tables if _is_growth(path, table)]
    parts = [tell_machine(table) for _, table in tables[:1]]
    if speed:
        parts += [f"Speed, {len(speed)} runs:\n", format_markdown(unite_runs([table["rows"] for table in speed]))]
    parts += [f"Growth:\n\n{format_markdown(list_growth(table['rows']))}" for table in growth]
    return parts


def tell_machine(table: Mapping[str, Any]) -> str:
    """Return one line: processor, cores and threads."""
    made = table["machine"]
    threads = ", ".join(f"{name}={value}" for name, value in made["threads"].items() if value != "unset")
    return f"{made['cpu']}, {made['cores']} cores, {threads or 'threads unset'}.\n"


def unite_runs(runs: Sequence[Sequence[Mapping[str, Any]]]) -> pd.DataFrame:
    """Return one row for each name, by the first run's order: medians, extremes, and how many runs met the target."""
    names = list(dict.fromkeys(row["name"] for rows in runs for row in rows))
    found = {name: [row for rows in runs for row in rows if row["name"] == name] for name in names}
    return pd.DataFrame([_unite(name, rows) for name, rows in found.items()])


def list_growth(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return one row for each stage of each axis."""
    return pd.DataFrame(
        [
            {
                "axis": row["axis"],
                "stage": row["stage"],
                "sizes": f"{_short(row['smallest'])} to {_short(row['largest'])}",
                "figure": f"{_short(row['first'])} to {_short(row['value'])} {row['unit']}",
                "exponent": _exponent(row),
                "verdict": row["verdict"],
            }
            for row in rows
        ]
    )


def _exponent(row: Mapping[str, Any]) -> str:
    if row["exponent"] is None:
        return "-"
    if row["low"] is None:  # of two sizes
        return f"{row['exponent']:.2f}"
    return f"{row['exponent']:.2f} ({row['low']:.2f} to {row['high']:.2f})"


def _unite(name: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    judged = [row["met"] for row in rows if row["met"] is not None]
    reasons = dict.fromkeys(row["reason"] for row in rows if row["reason"])
    return {
        "row": name,
        "figure": _spread([row["value"] for row in rows], rows[0]["unit"]),
        "rival": "; ".join([rows[0]["rival"] or "-", *reasons]),
        "rival's": _spread([row["rival_value"] for row in rows], ""),
        "ratio": _spread([row["ratio"] for row in rows], ""),
        "target": _short(rows[0]["target"]),
        "met": f"{sum(judged)} of {len(judged)}" if judged else "-",
    }


def _spread(values: Sequence[float | None], unit: str) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    around = f" ({_short(min(known))} to {_short(max(known))})" if len(known) > 1 else ""
    return f"{_short(float(np.median(known)))}{around} {unit}".strip()


def _short(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}" if abs(value) < 1e3 else f"{value:.0f}"


def _is_growth(path: Path, table: Any) -> bool:
    """Tell the tables apart by their columns.

    Raises:
        InputError: It is neither.
    """
    rows = table.get("rows") if isinstance(table, dict) else None
    first = rows[0] if isinstance(rows, list) and rows and isinstance(rows[0], dict) else {}
    if not isinstance(table, dict) or "machine" not in table or not (set(first) >= _FIGURES or set(first) >= _GROWTH):
        raise InputError(f"{path}: no table of `tunnelcd bench` or `tunnelcd bench --growth`: name a file of --out")
    return set(first) >= _GROWTH


if __name__ == "__main__":
    run_program(main, "eval.studies.bench_tables")
