"""Whether two run folders hold the same answers and rows, to the byte; times and the commit apart.

Run both with the same command, one before and one after a change that should move no number:

    python tests/same_numbers.py RUN_BEFORE RUN_AFTER
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

TABLES = ("results", "changes", "regions", "objects", "keyframes")


def is_time(column: str) -> bool:
    """Tell whether a column says when, by which code or how fast a row was made."""
    return column.startswith("t_") or column in ("commit", "is_contended")


def differences(one: Path, other: Path) -> Iterator[str]:
    """Yield one line for each answer and table that differs or stands in one folder only."""
    answers = {
        folder: {file.parent.relative_to(folder) for file in folder.glob("answers/*/*/*/answer.json")}
        for folder in (one, other)
    }
    yield from (f"{name}: in one folder only" for name in sorted(answers[one] ^ answers[other]))
    for name in sorted(answers[one] & answers[other]):
        if _document(one / name) != _document(other / name):
            yield f"{name}/answer.json"
        if _arrays(one / name) != _arrays(other / name):
            yield f"{name}/answer.npz"
    for table in TABLES:
        if _rows(one / f"{table}.csv") != _rows(other / f"{table}.csv"):
            yield f"{table}.csv"


def _document(answer: Path) -> str:
    document = json.loads((answer / "answer.json").read_text())
    return json.dumps({name: value for name, value in document.items() if name != "seconds"})


def _arrays(answer: Path) -> list[tuple[str, str, tuple[int, ...], bytes]]:
    if not (answer / "answer.npz").is_file():
        return []
    with np.load(answer / "answer.npz", allow_pickle=False) as arrays:
        return [(name, array.dtype.str, array.shape, array.tobytes()) for name, array in arrays.items()]


def _rows(path: Path) -> str:
    if not path.is_file():
        return ""
    table = pd.read_csv(path, dtype=str, keep_default_na=False)
    return table[[column for column in table if not is_time(column)]].to_csv()


if __name__ == "__main__":
    before, after = map(Path, sys.argv[1:])
    found = list(differences(before, after))
    n_answers = len(list(before.glob("answers/*/*/*/answer.json")))
    sys.stdout.write(
        "".join(f"differs: {line}\n" for line in found) + f"{n_answers} answers, {len(found)} differences\n"
    )
    sys.exit(bool(found) or n_answers == 0)
