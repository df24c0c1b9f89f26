"""How the command line prints tables, rows and lines."""

# ruff: noqa: PLC0415 - heavy imports stand inside the functions, so that --help and completion are instant
from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    import pandas as pd

MET = {True: "met", False: "missed", None: "-"}


def print_table(title: str, frame: pd.DataFrame) -> None:
    """Print a table under its title, with a dash for NaN and None."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for name in frame.columns:
        table.add_column(str(name), no_wrap=True)
    for row in frame.itertuples(index=False):
        table.add_row(*(_cell(value) for value in row))
    # wider than any table: the terminal then wraps long lines, where rich would cut numbers off
    Console(width=500, markup=False).print(table)


def print_row(row: dict[str, Any]) -> None:
    """Print one row, one line per column."""
    width = max(map(len, row))
    for name, value in row.items():
        typer.echo(f"{name:<{width}}  {_cell(value)}")


def say(quiet: bool, text: str) -> None:
    """Print a line, unless --quiet."""
    if not quiet:
        typer.echo(text)


def warn(text: str) -> None:
    """Print a warning on standard error, also with --quiet; nothing for an empty text."""
    if text:
        typer.echo(f"warning: {text}", err=True)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:.4g}"
    return str(value)
