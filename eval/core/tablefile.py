"""Where a table is stored: NAME.csv, or NAME.csv.xz in a report that is kept small."""

from __future__ import annotations

from pathlib import Path


def table_file(path: Path) -> Path:
    """Return the file that holds a table.

    A run writes NAME.csv. A committed report stores its large tables as NAME.csv.xz, which `pandas.read_csv` reads
    unaided. NAME.csv comes first where both are there, because a run writes it.

    Args:
        path: Path of the table as a run writes it, NAME.csv.

    Returns:
        NAME.csv.xz where only that file is there, `path` otherwise.
    """
    compressed = path.with_name(f"{path.name}.xz")
    return compressed if compressed.is_file() and not path.is_file() else path
