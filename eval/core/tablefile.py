"""Where a table is stored, NAME.csv or NAME.csv.xz in a report that is kept small, and how it is read."""

from __future__ import annotations

import io
import lzma
from pathlib import Path

import pandas as pd

from cdpipe.core.errors import InputError
from cdpipe.core.files import read_bytes

# xz shrinks a constant column ten thousandfold: what a file may expand to is bounded by its own size.
_SMALL_BYTES = 64_000_000
_MAX_RATIO = 60


def table_file(path: Path) -> Path:
    """Return the file that holds a table.

    A run writes NAME.csv. A committed report stores its large tables as NAME.csv.xz. NAME.csv comes first where both
    are there, because a run writes it.

    Args:
        path: Path of the table as a run writes it, NAME.csv.

    Returns:
        NAME.csv.xz where only that file is there, `path` otherwise.
    """
    compressed = path.with_name(f"{path.name}.xz")
    return compressed if compressed.is_file() and not path.is_file() else path


def read_table(path: Path, *, low_memory: bool = True) -> pd.DataFrame:
    """Read a table, NAME.csv or NAME.csv.xz; one without a column gives an empty frame.

    Args:
        path: The file.
        low_memory: Whether pandas guesses the type of a column part by part.

    Raises:
        InputError: It is missing, or no table.
    """
    content = read_bytes(path, expected="expected a table written by `tunnelcd`")
    try:
        if path.suffix == ".xz":
            content = _decompress(content)
        return pd.read_csv(io.BytesIO(content), low_memory=low_memory)
    except pd.errors.EmptyDataError:
        return pd.DataFrame()
    except Exception as error:  # the parser of pandas lets through whatever a damaged file provokes
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: cannot be read as a table: {said:.200}") from error


def _decompress(content: bytes) -> bytes:
    most_bytes = _SMALL_BYTES + _MAX_RATIO * len(content)
    expander = lzma.LZMADecompressor(memlimit=_SMALL_BYTES * 4)
    expanded = expander.decompress(content, most_bytes)
    if not expander.eof:
        raise ValueError("cut short" if expander.needs_input else f"expands to more than {most_bytes} bytes")
    if expander.unused_data:
        raise ValueError("bytes follow its end")
    return expanded
