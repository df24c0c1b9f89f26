"""What a run tells while it works."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text


class RunProgress(Protocol):
    """Told what is being done."""

    def cells(self, label: str, done: int, total: int) -> None:
        """So many cells of the run are finished; `label` is what comes next."""

    def stage(self, name: str, done: int, total: int) -> None:
        """One stage has come so far."""


class Silent:
    """Says nothing."""

    def cells(self, label: str, done: int, total: int) -> None:
        """Say nothing."""

    def stage(self, name: str, done: int, total: int) -> None:
        """Say nothing."""


class Bars:
    """Two bars on standard error, cells and the stage in work, with rate and time left. A context manager."""

    def __init__(self) -> None:
        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            _Rate(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
        )
        self._cells = self._progress.add_task("cells", total=None, visible=False)
        self._stage = self._progress.add_task("", total=None, visible=False)
        self._stage_name = ""

    def __enter__(self) -> Bars:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.update(self._stage, visible=False)
        self._progress.stop()

    def cells(self, label: str, done: int, total: int) -> None:
        """Move the bar of the run."""
        self._progress.update(self._cells, description=label, completed=done, total=total, visible=True)

    def stage(self, name: str, done: int, total: int) -> None:
        """Move the bar of the stage; a new name starts a new bar."""
        if name != self._stage_name:
            self._progress.reset(self._stage, description=f"  {name}", total=total)
            self._stage_name = name
        self._progress.update(self._stage, completed=done, total=total, visible=done < total)


class Lines:
    """One line on standard error for each cell and stage: for logs, where bars would overwrite nothing."""

    def __init__(self) -> None:
        self._last = ""

    def cells(self, label: str, done: int, total: int) -> None:
        """Write the label, once."""
        self._write(f"[{done}/{total}] {label}")

    def stage(self, name: str, done: int, total: int) -> None:
        """Write the name, once."""
        self._write(f"  {name}")

    def _write(self, line: str) -> None:
        if line != self._last:
            sys.stderr.write(f"{line}\n")
            self._last = line


@contextmanager
def shown_progress(quiet: bool) -> Iterator[RunProgress]:
    """Yield bars on a terminal, lines in a log, nothing if quiet."""
    if quiet:
        yield Silent()
    elif not sys.stderr.isatty():
        yield Lines()
    else:
        with Bars() as bars:
            yield bars


class _Rate(ProgressColumn):
    """Steps per second."""

    def render(self, task: Task) -> Text:
        """Render the speed of a task."""
        speed = task.finished_speed or task.speed
        return Text(f"{speed:.2g}/s" if speed else "-/s")
