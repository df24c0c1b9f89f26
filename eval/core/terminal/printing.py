"""How the command line prints tables, rows and lines.

Names and messages come from users and files, so every line is written as `cdpipe.core.names.visible` shows it: a
terminal obeys none of it.
"""

# ruff: noqa: PLC0415 - heavy imports stand inside the functions, so that --help and completion are instant
from __future__ import annotations

import json
import math
import shutil
import sys
import textwrap
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.names import visible
from cdpipe.core.whole_file import whole_file
from eval.core.output import make_writable, unwritable

if TYPE_CHECKING:
    import pandas as pd
    from rich.table import Table

MET = {True: "met", False: "missed", None: "-"}


LINE = 80
"""Columns of a terminal."""
# wider than any table: the terminal then wraps long lines, where rich would cut numbers off
ANY_WIDTH = 500
_LINES_OF_A_FRAME = 4  # above the headings, the headings, the rule below them, and below the rows


def print_table(title: str, frame: pd.DataFrame, columns: int = ANY_WIDTH) -> None:
    """Print a table under its title, with a dash for NaN and None; cells are folded where it has too few columns."""
    from rich.console import Console

    Console(width=columns, markup=False, emoji=False).print(_as_table(title, frame, columns))


def print_fitted(title: str, frame: pd.DataFrame, gives_way: Sequence[Sequence[str]], max_lines: int = 0) -> list[str]:
    """Print of a table what a terminal has room for.

    Args:
        title: Stands above it.
        frame: The whole table.
        gives_way: Groups of its columns that are left out where not all fit, the first group first. Others are folded.
        max_lines: Rows at the end are left out and counted beyond so many lines; 0 for no limit.

    Returns:
        The names of the columns left out.
    """
    left_out: list[str] = []
    for group in gives_way:
        if not _is_folded(frame):
            break
        names = [name for name in group if name in frame.columns]
        frame = frame.drop(columns=names)
        left_out += names
    n_rows = min(len(frame), max_lines or len(frame))
    while max_lines and n_rows and _height(title, frame[:n_rows]) > max_lines - (n_rows < len(frame)):
        n_rows -= 1
    print_table(title, frame[:n_rows], LINE)
    if n_rows < len(frame):
        echo(f"and {len(frame) - n_rows} more rows")
    return left_out


def _as_table(title: str, frame: pd.DataFrame, columns: int) -> Table:
    from rich import box
    from rich.table import Table

    is_narrow = columns < ANY_WIDTH
    table = Table(title=visible(title), title_justify="left", box=box.SIMPLE_HEAD, collapse_padding=is_narrow)
    for name in frame.columns:
        table.add_column(visible(str(name)), no_wrap=not is_narrow, overflow="fold")
    for row in frame.itertuples(index=False):
        table.add_row(*(_cell(value) for value in row))
    return table


def _is_folded(frame: pd.DataFrame) -> bool:
    """Return whether a terminal has too few columns for a table: a cell or a heading takes more than one line."""
    return _height("", frame) > len(frame) + _LINES_OF_A_FRAME


def _height(title: str, frame: pd.DataFrame) -> int:
    from rich.console import Console

    return len(Console(width=LINE, markup=False).render_lines(_as_table(title, frame, LINE), pad=False))


def print_row(row: dict[str, Any]) -> None:
    """Print one row, one line per column."""
    width = max(map(len, row))
    for name, value in row.items():
        echo(f"{name:<{width}}  {_cell(value)}")


def echo(*lines: str, err: bool = False) -> None:
    """Print lines to standard output, or to standard error."""
    for line in lines:
        typer.echo(visible(line), err=err)


def line_width() -> int:
    """Return the columns of the terminal; where standard output is none, as many as any line needs."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else ANY_WIDTH


def echo_json(value: Any) -> None:
    """Print a value as JSON for programs; what is undefined is null."""
    typer.echo(_as_json(value))


def tell_json(value: Any, *, as_json: bool, file: Path | None) -> None:
    """Print a value as JSON if asked to, and write it to a file if one is named.

    Raises:
        InputError: The file cannot be written.
    """
    if as_json:
        echo_json(value)
    if file is not None:
        try:
            with whole_file(file) as partial:
                partial.write_text(f"{_as_json(value)}\n", encoding="utf-8")
        except OSError as error:
            raise unwritable(file, error) from error


def require_json_file(file: Path | None) -> None:
    """Check before the work that a new file can be written, if one is named. JSON bears no mark of who wrote it.

    Raises:
        InputError: It exists, or its folder is missing or cannot be written.
    """
    if file is None:
        return
    try:
        is_folder, is_there = file.is_dir(), file.exists() or file.is_symlink()
    except OSError as error:
        raise unwritable(file, error) from error
    if is_folder:
        raise InputError(f"--out {file}: is a folder: name a file")
    # standard output may be a terminal, a pipe or, behind `>`, a plain file
    if is_there and (not file.is_file() or file.absolute().parts[1:2] in (("dev",), ("proc",))):
        raise InputError(f"--out {file}: is no plain file: leave it out, and --json prints on standard output")
    if is_there:
        raise InputError(f"--out {file}: exists: name a new file, or remove this one")
    if not file.absolute().parent.is_dir():
        raise InputError(f"--out {file}: there is no folder {file.parent}: make it, or name another one")
    make_writable(file.absolute().parent)


def _as_json(value: Any) -> str:
    return json.dumps(_plain(value), indent=1, allow_nan=False)


def _plain(value: Any) -> Any:
    """Return JSON's own types."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "item"):  # a number of numpy
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, bool | int | float) else str(value)


def echo_wrapped(text: str, columns: int) -> None:
    """Print a text in lines of at most so many columns, broken at blanks; a longer word has a line of its own."""
    for line in textwrap.wrap(visible(text), columns, break_long_words=False, break_on_hyphens=False):
        typer.echo(line)


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
