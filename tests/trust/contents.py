"""What a file holds, wall-clock times apart: two folders that hold the same were made alike."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load

TIMES = ("seconds", "started", "finished", "is_contended")


def contents(folder: Path) -> dict[str, Any]:
    """Return what every file of a folder holds, by its name; hidden files too."""
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): content_of(path) for path in paths}


def content_of(path: Path) -> Any:
    """Return what a file holds; raises an error of its format where it is cut short."""
    data = path.read_bytes()
    match path.suffix:
        case ".json":
            return without_times(json.loads(data))
        case ".safetensors":  # the header of a training's state holds the seconds of every validation
            return {name: array.tobytes() for name, array in load(data).items()}
        case ".npz":
            with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
                # by the fingerprint a cache knows its files, by their stamps
                return {name: array.tobytes() for name, array in arrays.items() if not is_time(name, "fingerprint")}
        case ".csv":
            rows = list(csv.reader(io.StringIO(data.decode())))
            if not data.endswith(b"\n") or len({len(row) for row in rows}) > 1:
                raise ValueError("cut short")
            return rows
        case _:
            return data


def is_time(name: str, *also: str) -> bool:
    return name.startswith(("t_", "seconds.")) or name in (*TIMES, *also)


def without_times(document: Any) -> Any:
    if isinstance(document, dict):
        return {name: without_times(part) for name, part in document.items() if not is_time(name)}
    return [without_times(part) for part in document] if isinstance(document, list) else document


def find_damaged(folder: Path) -> Iterator[str]:
    """Yield the files under their final names that are cut short; hidden ones and answers in work do not count."""
    for path in sorted(folder.rglob("*")):
        parts = path.relative_to(folder).parts
        in_work = "answers" in parts and not (path.parent / "answer.json").exists()
        if not path.is_file() or in_work or any(part.startswith(".") for part in parts):
            continue
        try:
            content_of(path)
        except FileNotFoundError:
            continue  # removed in this moment
        except Exception as error:
            yield f"{path}: {error!r}"
