"""How the command line prints tables, rows and lines.

Names and messages come from users and files, so every line is written as `cdpipe.core.names.visible` shows it: a
terminal obeys none of it.
"""

# ruff: noqa: PLC0415 - heavy imports stand inside the functions, so that --help and completion are instant
from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer

from cdpipe.core.errors import InputWarning
from cdpipe.core.names import visible

if TYPE_CHECKING:
    import pandas as pd

MET = {True: "met", False: "missed", None: "-"}


def print_table(title: str, frame: pd.DataFrame) -> None:
    """Print a table under its title, with a dash for NaN and None."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(title=visible(title), title_justify="left", box=box.SIMPLE_HEAD)
    for name in frame.columns:
        table.add_column(visible(str(name)), no_wrap=True)
    for row in frame.itertuples(index=False):
        table.add_row(*(_cell(value) for value in row))
    # wider than any table: the terminal then wraps long lines, where rich would cut numbers off
    Console(width=500, markup=False, emoji=False).print(table)


def print_row(row: dict[str, Any]) -> None:
    """Print one row, one line per column."""
    width = max(map(len, row))
    for name, value in row.items():
        echo(f"{name:<{width}}  {_cell(value)}")


def echo(*lines: str, err: bool = False) -> None:
    """Print lines to standard output, or to standard error."""
    for line in lines:
        typer.echo(visible(line), err=err)


def count_pairs(n: int) -> str:
    """Return a number of pairs in words: "1 pair", "2 pairs"."""
    return "1 pair" if n == 1 else f"{n} pairs"


def say(quiet: bool, text: str) -> None:
    """Print a line, unless --quiet."""
    if not quiet:
        echo(text)


def warn(text: str) -> None:
    """Print a warning on standard error, also with --quiet; nothing for an empty text."""
    if text:
        echo(f"warning: {text}", err=True)


@contextmanager
def shown_warnings() -> Iterator[None]:
    """Print what the readers warn of, one line each, when the block ends."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        try:
            yield
        finally:
            for text in dict.fromkeys(str(each.message) for each in caught if each.category is InputWarning):
                warn(text)
    for each in caught:
        if each.category is not InputWarning:
            warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:.4g}"
    return visible(str(value))
