"""Tables of a run folder: read, and refused where a figure or the name of a row is not what it must be."""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.errors import InputError
from eval.core.tablefile import read_table
from eval.running.cell_rows import TEXT_COLUMNS
from eval.running.results.values import Row
from eval.tables.rows import records

_CASE = ("scenario", "seed", "variant")
REQUIRED = (*_CASE, "status")
# No figure of a pair is larger: a terabyte has 1e12 bytes, a century 3e9 seconds.
LARGEST = 1e15
# ends of bins and of intervals, of which the last bin has none
_UNBOUNDED = ("low", "high")
_NUMBER = re.compile(r"[-+.\deE]+")
_IDS = re.compile(r"\d{1,9}(;\d{1,9})*")
_ID_LISTS = ("found_changes", "found_changes_proposed")


def require_cases(path: Path, results: pd.DataFrame) -> None:
    """Refuse rows without a valid seed and repeated cases: every mean would be wrong."""
    for line, seed in enumerate(results["seed"], start=2):
        if not float(pd.to_numeric(seed, errors="coerce")).is_integer():
            raise InputError(f"{path}:{line}: seed = {seed}: expected a whole number")
    is_repeated = results.duplicated(["scenario", "seed", "variant"]).to_numpy()
    if is_repeated.any():
        index = int(np.argmax(is_repeated))
        row = results.iloc[index]
        case = f"{row['scenario']}, seed {int(row['seed'])}, {row['variant']}"
        raise InputError(f"{path}:{index + 2}: {case} stands there twice")


def read_rows(path: Path, left_out: list[str]) -> tuple[Row, ...]:
    """Return the rows of a table; a sentence about figures that are read as NaN is added to `left_out`."""
    frame = read_table(path)
    _require_values(path, frame)
    counts = {name: int((frame[name].abs() > LARGEST).sum()) for name in _figures(frame)}
    if told := ", ".join(f"{name} ({n})" for name, n in counts.items() if n):
        left_out.append(
            f"{path.name}: infinite or larger than {LARGEST:g}, and therefore left out: {told}. "
            f"`tunnelcd score {path.parent}` scores the answers again."
        )
    return tuple(records(without_unusable(frame)))


def _require_values(path: Path, frame: pd.DataFrame) -> None:
    """Refuse text among numbers, which no mean or chart can hold, and rows without the columns that name them."""
    if absent := {*_CASE} - set(frame) if len(frame) else set():
        raise InputError(f"{path}: column {', '.join(sorted(absent))} is missing: expected a table of `tunnelcd run`")
    require_numbers(path, frame, {*TEXT_COLUMNS, "seed"})  # seeds are checked by their values


def require_numbers(path: Path, frame: pd.DataFrame, texts: Collection[str]) -> None:
    """Refuse text in a column that is not of `texts`, a list of ids that is none, and a number for a truth value."""
    for name in frame:
        _require_truth_values(path, frame[name])
        if pd.api.types.is_numeric_dtype(frame[name]) or (name in texts and name not in _ID_LISTS):
            continue
        are_ids = name in _ID_LISTS
        wrong = [
            (line, value)
            for line, value in enumerate(frame[name], start=2)
            if not (isinstance(value, bool) or pd.isna(value) or (are_ids and _IDS.fullmatch(str(value))))
        ]
        if wrong:  # one text makes all numbers of its column texts
            line, value = next((each for each in wrong if not _NUMBER.fullmatch(str(each[1]))), wrong[0])
            raise InputError(f"{path}:{line}: {name} = {value!r:.40}: expected a number")


def _require_truth_values(path: Path, column: pd.Series[Any]) -> None:
    if not (str(column.name).startswith("is_") and pd.api.types.is_numeric_dtype(column)):
        return
    is_none = ~(column.isna() | column.isin([0, 1])).to_numpy(dtype=bool)
    if is_none.any():
        line = int(np.argmax(is_none))
        raise InputError(f"{path}:{line + 2}: {column.name} = {column.iloc[line]}: expected True or False")


def without_unusable(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a table with NaN for figures that no mean, axis or cell can hold."""
    names, usable = _figures(frame), frame.copy()
    usable[names] = frame[names].mask(frame[names].abs() > LARGEST)
    return usable


def _figures(frame: pd.DataFrame) -> list[str]:
    """Return the columns of a table that hold figures, ends of bins and intervals apart."""
    return [name for name in frame.select_dtypes("float").columns if name not in _UNBOUNDED]
