"""Tables from rows that arrive one by one, in about the memory of the tables: rows as dicts take ten times as much."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from cdpipe.core.errors import InputError
from cdpipe.core.files import read_json

# Values that are held in dicts, a hundred bytes each. A table with no more is made at once.
CHUNK_VALUES = 1_000_000
_HEAD_BYTES = 400
_ORDER = re.compile(rb'"order": \[\s*(\d{1,9}),\s*(\d{1,9})\s*\],\s*"row": \{')


class RowTable:
    """Collects rows, and makes the table that `pd.DataFrame(rows)` would be."""

    def __init__(self, chunk_values: int = CHUNK_VALUES) -> None:
        self._chunk_values = chunk_values
        self._n_values = 0
        self._rows: list[Mapping[str, Any]] = []
        self._chunks: list[pd.DataFrame] = []
        self._texts: dict[str, str] = {}

    def add(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Add rows."""
        for row in rows:
            self._rows.append(row)
            self._n_values += len(row)
        if self._n_values >= self._chunk_values:
            self._pack()

    def frame(self) -> pd.DataFrame:
        """Return the table of all rows, without a column where there is none; the collection is empty afterwards."""
        if not self._chunks:
            rows, self._rows = self._rows, []
            return pd.DataFrame(rows)
        self._pack()
        chunks, self._chunks = self._chunks, []
        return join_chunks(chunks)

    def _pack(self) -> None:
        """Turn the rows into a chunk; equal texts of all chunks are one object."""
        if self._rows:
            share = self._texts.setdefault
            rows = [
                {name: share(value, value) if type(value) is str else value for name, value in row.items()}
                for row in self._rows
            ]
            self._chunks.append(pd.DataFrame(rows))
            self._rows, self._n_values = [], 0


def join_chunks(chunks: list[pd.DataFrame]) -> pd.DataFrame:
    """Return one table of chunks of rows, its columns in the order in which rows first name them.

    A chunk says nothing of the type of a column in which it has no value: types are those of the other chunks.
    """
    columns = list(dict.fromkeys(name for chunk in chunks for name in chunk))
    has_values = {name for chunk in chunks for name in chunk if chunk[name].notna().any()}
    kept = []
    for chunk in chunks:
        idle = [name for name in chunk if name in has_values and chunk[name].isna().all()]
        kept.append(chunk.drop(columns=idle))
    chunks.clear()
    return pd.concat(kept, ignore_index=True)[columns]


def sort_cells(paths: Iterable[Path], names: Mapping[str, str]) -> list[Path]:
    """Return the files of cells in the order of their rows, as far as the heads of the files tell.

    Args:
        paths: Files `cells/<world>/<seed>/<variant>.json`.
        names: Name of each world by its folder.
    """
    places = {path: _read_place(path) for path in paths}

    def order(path: Path) -> tuple[int, str, int, int]:
        world, seed = path.parts[-3:-1]
        first, second = places[path]
        return first, names.get(world, world), int(seed) if seed.isdecimal() else 0, second

    return sorted(sorted(places), key=order)


def _read_place(path: Path) -> tuple[int, int]:
    """Return the position of a cell's rows: of its scenario, and of its variant."""
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if found := _ORDER.search(head):
        return int(found[1]), int(found[2])
    try:
        first, second = read_json(path, "")["order"]
        return int(first), int(second)
    except (InputError, ValueError, TypeError, KeyError, OverflowError):
        return 0, 0  # what is no cell has no rows
