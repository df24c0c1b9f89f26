"""Large tables as Parquet beside their CSV: NAME.parquet/00000-<world>.parquet, ..., in the order of the rows.

A file holds rows of one world, `PART_ROWS` at most. Needs the extra `parquet`; without it the CSV stands alone. The
CSV is what we read where it is there. Parquet that stands alone is turned into CSV by a process of its own, because
its reader is native code and the file may be another's.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pandas as pd

from cdpipe.core.errors import InputError
from cdpipe.core.files import require_plain_file
from cdpipe.core.isolated_reader import limit_memory, limit_time
from cdpipe.core.isolation import ProcessDiedError, run_isolated
from cdpipe.core.names import path_part
from eval.core.output import new_folder

MIN_ROWS = 100_000
"""Tables with fewer rows have no Parquet: a reader of CSV is fast enough."""
PART_ROWS = 1_000_000
_MIN_MEMORY, _MEMORY_RATIO = 512 << 20, 10  # of the process that reads, beside the size of the Parquet
_MIN_CPU_S, _BYTES_PER_CPU_S = 8, 200_000
_MAX_RATIO = 200  # of a table's CSV to its Parquet
_SMALL_BYTES = 64_000_000


def parquet_folder(path: Path) -> Path:
    """Return where the Parquet of the table NAME.csv lies."""
    return path.with_suffix(".parquet")


def write_parquet(path: Path, frame: pd.DataFrame) -> None:
    """Write the Parquet of a large table NAME.csv, and remove that of an earlier one. Without the extra, none is made.

    Raises:
        OSError: The disk is full.
    """
    folder = parquet_folder(path)
    shutil.rmtree(folder, ignore_errors=True)
    if len(frame) < MIN_ROWS or importlib.util.find_spec("pyarrow") is None:
        return
    import pyarrow as pa  # noqa: PLC0415 - an extra
    from pyarrow import parquet  # noqa: PLC0415 - an extra

    schema = pa.Schema.from_pandas(frame, preserve_index=False)
    with new_folder(folder) as partial:
        for index, (world, part) in enumerate(_parts(frame)):
            table = pa.Table.from_pandas(part, schema=schema, preserve_index=False)
            parquet.write_table(table, partial / f"{index:05d}-{path_part(world.replace('/', '__'))}.parquet")


def read_parquet(folder: Path, most_bytes: int | None = None) -> bytes:
    """Return the CSV of a table that is there as Parquet alone.

    Args:
        folder: NAME.parquet.
        most_bytes: What the CSV may take, else a multiple of the folder's size.

    Raises:
        InputError: The extra is not installed, or the folder is no table.
    """
    if importlib.util.find_spec("pyarrow") is None:
        raise InputError(f"{folder}: Parquet needs a package more: pip install 'tunnelcd[parquet]'")
    parts = sorted(folder.glob("*.parquet"))
    n_bytes = sum(require_plain_file(part) for part in parts)
    with TemporaryDirectory(prefix="tunnelcd-") as scratch:
        out = Path(scratch, "table.csv")
        asked: dict[str, Any] = {"parts": [str(part.resolve()) for part in parts], "out": str(out), "n_bytes": n_bytes}
        asked |= {"most_bytes": _SMALL_BYTES + _MAX_RATIO * n_bytes if most_bytes is None else most_bytes}
        try:
            run_isolated(write_csv_of_parts, asked)
        except ProcessDiedError as death:
            raise InputError(f"{folder}: its reader was killed ({death}): make the table anew") from death
        except RuntimeError as error:
            raise InputError(f"{folder}: cannot be read as a table: {error!s:.200}") from error
        return out.read_bytes()


def write_csv_of_parts(asked: dict[str, Any]) -> None:
    """Write the rows of Parquet files into one CSV; runs in a process of its own.

    Raises:
        InputError: They are no parts of one table, or hold more than they may.
    """
    os.environ["ARROW_DEFAULT_MEMORY_POOL"] = "system"
    from pyarrow import parquet  # noqa: PLC0415 - an extra

    limit_time(_MIN_CPU_S + asked["n_bytes"] // _BYTES_PER_CPU_S)
    limit_memory(_MIN_MEMORY + _MEMORY_RATIO * asked["n_bytes"])
    names: list[str] = []
    with Path(asked["out"]).open("w", newline="") as file:
        for part in asked["parts"]:
            try:
                source = parquet.ParquetFile(part)
                found = list(source.schema_arrow.names)
                if names and found != names:
                    raise InputError(f"{part}: has other columns than the parts before it")
                for batch in source.iter_batches(batch_size=50_000):
                    batch.to_pandas().to_csv(file, index=False, header=not names)
                    names = found
                    if file.tell() > asked["most_bytes"]:
                        raise InputError(f"{part}: expands to more than {asked['most_bytes']} bytes")
            except InputError:
                raise
            except Exception as error:  # damaged metadata make pyarrow raise anything, KeyError among it
                said = str(error).splitlines()[0] if str(error) else type(error).__name__
                raise InputError(f"{part}: cannot be read as a table: {said:.200}") from error


def _parts(frame: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield runs of rows of one world, at most `PART_ROWS` each, in the order of the table."""
    worlds = frame["scenario"].astype(str)
    for _, of_world in frame.groupby((worlds != worlds.shift()).cumsum(), sort=False):
        world = str(of_world["scenario"].iloc[0])
        yield from ((world, of_world[first : first + PART_ROWS]) for first in range(0, len(of_world), PART_ROWS))
