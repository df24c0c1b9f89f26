"""A copy of rows and answers at a URL of fsspec: a bucket, another machine, another disk, or memory.

A run works in its own folder, on a disk of its machine. After each pair it copies the answers of the pair and then its
cells, and the tables at the end. A run that begins takes the finished cells from there, so it goes on where an earlier
one on another machine ended. Sessions, maps and stages are not copied: they can be made again. The records of removed
sessions (`eval.running.scaling.keeping`) are, as they tell how.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from cdpipe.core.errors import InputError
from cdpipe.core.files import parse_json
from cdpipe.core.files.json_file import MAX_BYTES
from cdpipe.core.whole_file import whole_file
from cdpipe.io.answer import ANSWER_FILES
from eval.core.provenance import TOOL
from eval.core.terminal.progress import RunProgress, Silent
from eval.running.pair_run import Pair
from eval.running.runfolder import RunFolder, read_json, write_json
from eval.running.scaling.keeping import RECORDS, dropped_file, list_records

_PART = r"(?!\.)[A-Za-z0-9._=,-]{1,210}"
_CELL = re.compile(rf"cells/{_PART}/\d{{1,15}}/{_PART}\.json", re.ASCII)
_DROPPED = re.compile(rf"{RECORDS}/{_PART}/\d{{1,15}}\.json", re.ASCII)
_STORED_ANSWER = re.compile(rf"answers/{_PART}/\d{{1,15}}/{_PART}/answer\.(json|npz)", re.ASCII)
_MAX_ANSWER_BYTES = 1 << 30
_RECORD = "copied.json"  # in the run folder: when the newest cell or record was written that is at a URL


class Mirror:
    """Rows and answers of a run at a URL.

    Args:
        url: What fsspec understands, `s3://bucket/run`, `sftp://host/run`, `memory://run`, or a folder.

    Raises:
        InputError: fsspec does not know it, or a package for it is missing.
    """

    def __init__(self, url: str) -> None:
        if _password_of(url) is not None:
            raise InputError("a URL with a password would stand in provenance.json: leave it to fsspec's configuration")
        self.url = url
        self._fs, self._root = _open(url)
        self._fetched: dict[str, int] = {}  # what was taken from there, and when it was written here

    def provenance(self) -> dict[str, Any]:
        """Return the provenance of the run there; {} where there is none.

        Raises:
            InputError: Something else is there.
        """
        with self._told():
            is_there, path = self._fs.exists(self._place("provenance.json")), self._place("provenance.json")
            content = self._read(path, MAX_BYTES) if is_there else b"{}"
            is_used = not is_there and self._fs.exists(self._root) and bool(self._fs.find(self._root))
        if is_used:
            raise InputError(f"{self.url}: not empty and not a copy of a run: name another place")
        try:
            document = parse_json(content)
        except ValueError as error:
            raise InputError(f"{self.url}/provenance.json: damaged, not JSON ({error}): name another place") from error
        if is_there and (not isinstance(document, dict) or document.get("tool") != TOOL):
            raise InputError(f"{self.url}/provenance.json: not written by {TOOL}: name another place")
        return dict(document)

    def fetch(self, run: RunFolder, progress: RunProgress | None = None) -> None:
        """Take the finished cells, and the records of removed sessions, that the folder lacks.

        Raises:
            InputError: They cannot be read.
        """
        stored = [name for name in self._list("cells") if _CELL.fullmatch(name)]
        stored += [name for name in self._list(RECORDS) if _DROPPED.fullmatch(name)]
        names = [name for name in stored if not (run.path / name).exists()]
        self._get(run.path, names, progress or Silent())
        self._fetched |= {name: (run.path / name).stat().st_mtime_ns for name in names}

    def fetch_all(self, folder: Path, progress: RunProgress | None = None) -> None:
        """Take provenance, cells, answers and records of removed sessions into an empty folder.

        Raises:
            InputError: There is no run there, or it cannot be read.
        """
        if not self.provenance():
            raise InputError(f"{self.url}: no copy of a run is there (no provenance.json)")
        names = [name for name in self._list("cells") if _CELL.fullmatch(name)]
        names += [name for name in self._list("answers") if _STORED_ANSWER.fullmatch(name)]
        names += [name for name in self._list(RECORDS) if _DROPPED.fullmatch(name)]
        self._get(folder, [*names, "provenance.json"], progress or Silent())

    def forget(self, run: RunFolder, pairs: Iterable[Pair]) -> None:
        """Remove cells and records of pairs that run which the folder lacks, so that no later run takes the old ones.

        They were taken before (`fetch`): what is gone since is about to run again, or is about another world.

        Raises:
            InputError: They cannot be removed.
        """
        running = [pair for pair in pairs if pair.todo]
        places = {_relative(run, run.cell(pair.name, pair.seed, "any").parent) for pair in running}
        records = {_relative(run, dropped_file(run, pair.name, pair.seed)) for pair in running}
        with self._told():
            for name in [*self._list("cells"), *self._list(RECORDS)]:
                if (name.rpartition("/")[0] in places or name in records) and not (run.path / name).exists():
                    self._fs.rm_file(self._place(name))

    def copy_pair(self, run: RunFolder, pair: Pair) -> None:
        """Copy the answers of the cells of a pair that ran, and then the cells, whose files say that they are finished.

        A record of its sessions, if they were removed, comes first: cells of a later run are of the same ones.

        Raises:
            InputError: The place cannot be written.
        """
        record = dropped_file(run, pair.name, pair.seed)
        self._put(run, [record] if record.is_file() else [])
        cells = [run.cell(pair.name, pair.seed, each.cell.variant) for each in pair.todo]
        for cell in cells:
            self._copy_cell(run, cell)
        self._note_copied(run, [record, *cells])

    def copy_cells(self, run: RunFolder) -> None:
        """Copy provenance, and the records and cells that are not there or were written here since the last copy.

        The first are of an interrupted pair, or of a run that began without a copy; the others of a command that was
        not told of it. With its provenance a copy that an interrupt cuts short is one of a run.

        Raises:
            InputError: The place cannot be written.
        """
        self._put(run, [run.path / "provenance.json"])
        stored, copied_ns = {*self._list("cells"), *self._list(RECORDS)}, self._copied_ns(run)

        def is_due(file: Path) -> bool:
            name, written_ns = _relative(run, file), file.stat().st_mtime_ns
            return name not in stored or (written_ns > copied_ns and self._fetched.get(name) != written_ns)

        records, cells = list_records(run), sorted(run.path.glob("cells/*/*/*.json"))
        self._put(run, [*filter(is_due, records)])
        for cell in filter(is_due, cells):
            self._copy_cell(run, cell)
        if cells:
            self._note_copied(run, [*records, *cells])

    def _note_copied(self, run: RunFolder, files: Iterable[Path]) -> None:
        """Note when the newest of these files was written that is there; one that is newer is copied again."""
        times_ns = [file.stat().st_mtime_ns for file in files if file.exists()]
        noted = {**read_json(run.path / _RECORD), self._key: max([self._copied_ns(run), *times_ns])}
        write_json(run.path / _RECORD, noted)

    def _copied_ns(self, run: RunFolder) -> int:
        noted = read_json(run.path / _RECORD).get(self._key)
        return noted if isinstance(noted, int) else 0

    @property
    def _key(self) -> str:
        """Name of the place, however its URL is written."""
        protocol = self._fs.protocol
        return f"{protocol if isinstance(protocol, str) else protocol[0]}:{self._root}"

    def _copy_cell(self, run: RunFolder, cell: Path) -> None:
        answer = run.path / "answers" / cell.relative_to(run.path / "cells").with_suffix("")
        files = [answer / name for name in reversed(ANSWER_FILES)]  # answer.json says that the other is whole
        self._put(run, [*(file for file in files if file.is_file()), cell])

    def copy_tables(self, run: RunFolder) -> None:
        """Copy provenance and tables.

        Raises:
            InputError: The place cannot be written.
        """
        tables = [*sorted(run.path.glob("*.csv")), *sorted(run.path.glob("*.parquet/*.parquet"))]
        self._put(run, [*tables, run.path / "provenance.json"])

    def _put(self, run: RunFolder, files: Sequence[Path]) -> None:
        with self._told():
            for file in files:
                place = self._place(_relative(run, file))
                self._fs.makedirs(place.rpartition("/")[0], exist_ok=True)
                self._fs.put_file(str(file), place)

    def _get(self, folder: Path, names: Sequence[str], progress: RunProgress) -> None:
        for done, name in enumerate(names):
            progress.stage(f"from {self.url}", done, len(names))
            with self._told():
                content = self._read(self._place(name), MAX_BYTES if name.endswith(".json") else _MAX_ANSWER_BYTES)
            with whole_file(folder / name) as partial:
                partial.write_bytes(content)
        progress.stage(f"from {self.url}", len(names), len(names))

    def _read(self, place: str, most_bytes: int) -> bytes:
        size = self._fs.size(place)
        if size is None or size > most_bytes:
            raise InputError(f"{place}: {size} bytes, more than the {most_bytes} that it may have")
        return bytes(self._fs.cat_file(place))

    def _list(self, folder: str) -> list[str]:
        """Return the files below a folder, by their names below the root."""
        with self._told():
            place = self._place(folder)
            found = self._fs.find(place) if self._fs.exists(place) else []
            return sorted(str(name).removeprefix(f"{self._root}/") for name in found)

    def _place(self, name: str) -> str:
        return f"{self._root}/{name}"

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Turn whatever a file system raises into one line."""
        try:
            yield
        except InputError:
            raise
        except Exception as error:
            said = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise InputError(f"{self.url}: {said:.200}: what is finished is kept in the run folder") from error


def is_url(text: str) -> bool:
    """Tell whether a run is named by a URL and not by its folder."""
    return "://" in text


def _password_of(url: str) -> str | None:
    try:
        return urlsplit(url).password
    except ValueError as error:
        raise InputError(f"{url}: no URL: {error}") from error


def _open(url: str) -> tuple[Any, str]:
    from fsspec.core import url_to_fs  # noqa: PLC0415 - slow to import

    try:
        fs, root = url_to_fs(url)
    except ImportError as error:
        raise InputError(f"{url}: {error!s:.200}") from error
    except Exception as error:  # whatever a file system raises
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{url}: no place that fsspec can open: {said:.200}") from error
    return fs, str(root).rstrip("/")


def _relative(run: RunFolder, path: Path) -> str:
    return path.relative_to(run.path).as_posix()
