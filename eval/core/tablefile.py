"""Where a table is stored, and how it is written and read.

NAME.csv, NAME.csv.xz in a report that is kept small, and NAME.parquet beside a large NAME.csv or in its place.
"""

from __future__ import annotations

import io
import lzma
import re
from pathlib import Path
from typing import Any

import pandas as pd

from cdpipe.core.errors import InputError
from cdpipe.core.files import read_bytes
from cdpipe.core.whole_file import whole_file
from eval.core.parquet import parquet_folder, read_parquet, write_parquet

# xz shrinks a constant column ten thousandfold: what a file may expand to is bounded by its own size.
_SMALL_BYTES = 64_000_000
_MAX_RATIO = 60
# What the parser of pandas takes for a cell, and what all cells may take, beside a multiple of the file's size; a cell
# of a CSV has two bytes at least, one of a packed table next to none.
_CELL_BYTES, _MIN_CELLS_BYTES, _CELLS_RATIO, _PACKED_CELLS_RATIO = 25, 400_000_000, 10, 100
_MOST_COLUMNS = 10_000
# Text that a spreadsheet takes for a formula, which may start a program; figures with a sign hold no letter.
_FORMULA = re.compile(r"[=@\t]|[+-].*[A-Za-z(|!]", re.DOTALL)


def table_file(path: Path) -> Path:
    """Return the file that holds a table.

    A run writes NAME.csv. A committed report stores its large tables as NAME.csv.xz. NAME.csv comes first where both
    are there, because a run writes it.

    Args:
        path: Path of the table as a run writes it, NAME.csv.

    Returns:
        NAME.csv.xz or NAME.parquet where only that is there, `path` otherwise.
    """
    if path.is_file():
        return path
    compressed, folder = path.with_name(f"{path.name}.xz"), parquet_folder(path)
    return compressed if compressed.is_file() else folder if folder.is_dir() else path


def plain_texts(frame: pd.DataFrame) -> pd.DataFrame:
    r"""Return a table whose texts and headings are texts to all who read its CSV.

    A `'` stands before what a spreadsheet would take for a formula. A carriage return, which ends a row and is not
    quoted, is written `\r`.
    """
    plain = frame.copy(deep=False)
    for name, column in frame.items():
        is_text = not pd.api.types.is_numeric_dtype(column)
        if is_text and any(_as_text(each) is not each for each in column.unique()):
            plain[name] = column.map(_as_text)
    return plain.rename(columns=_as_text)


def csv_text(frame: pd.DataFrame) -> str:
    """Return a table of a page as CSV: its texts may come from a stranger's files, and a spreadsheet runs none."""
    return str(plain_texts(frame).to_csv(index=False))


def _as_text(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    text = value.replace("\r", "\\r") if "\r" in value else value
    return f"'{text}" if _FORMULA.match(text) else text


def write_rows(path: Path, frame: pd.DataFrame) -> None:
    """Write a table of rows, NAME.csv, and its Parquet where it is large. Each appears whole or not at all."""
    write_parquet(path, frame[:0])  # none stands beside another CSV
    with whole_file(path) as partial:
        plain_texts(frame).to_csv(partial, index=False)
    write_parquet(path, frame)


def replace_table(new: Path, path: Path) -> None:
    """Let a table, NAME.csv and its Parquet, take the place of another one on the same disk."""
    write_parquet(path, pd.DataFrame())  # none stands beside another CSV
    new.replace(path)
    if parquet_folder(new).is_dir():
        parquet_folder(new).replace(parquet_folder(path))


def read_table(path: Path) -> pd.DataFrame:
    """Read a table, NAME.csv, NAME.csv.xz or NAME.parquet; one without a column gives an empty frame.

    Args:
        path: The file. The type of a column is that of all of its values.

    Raises:
        InputError: It is missing, or no table.
    """
    if path.is_dir():
        content = read_parquet(path)
    else:
        content = read_bytes(path, expected="expected a table written by `tunnelcd`")
    most_bytes = _MIN_CELLS_BYTES + _CELLS_RATIO * len(content)
    try:
        if path.suffix == ".xz":
            most_bytes = _MIN_CELLS_BYTES + _PACKED_CELLS_RATIO * len(content)
            content = _decompress(content)
        _check_cells(content, most_bytes)
        table = pd.read_csv(io.BytesIO(content), low_memory=False)
    except pd.errors.EmptyDataError:
        return pd.DataFrame()
    except Exception as error:  # the parser of pandas lets through whatever a damaged file provokes
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: cannot be read as a table: {said:.200}") from error
    if not isinstance(table.index, pd.RangeIndex):  # pandas makes an index of the first cells of such rows
        raise InputError(f"{path}: cannot be read as a table: rows have more cells than the header")
    return table


def _check_cells(content: bytes, most_bytes: int) -> None:
    """Raise ValueError where a table has more cells than there may be memory for, or more columns than any of ours."""
    n_cells, n_columns = content.count(b",") + content.count(b"\n"), 1 + content.partition(b"\n")[0].count(b",")
    if _CELL_BYTES * n_cells > most_bytes:
        raise ValueError(f"{n_cells} cells, more than {most_bytes // _CELL_BYTES}")
    if n_columns > _MOST_COLUMNS:
        raise ValueError(f"{n_columns} columns, more than {_MOST_COLUMNS}")


def _decompress(content: bytes) -> bytes:
    most_bytes = _SMALL_BYTES + _MAX_RATIO * len(content)
    expander = lzma.LZMADecompressor(memlimit=_SMALL_BYTES * 4)
    expanded = expander.decompress(content, most_bytes)
    if not expander.eof:
        raise ValueError("cut short" if expander.needs_input else f"expands to more than {most_bytes} bytes")
    if expander.unused_data:
        raise ValueError("bytes follow its end")
    return expanded
