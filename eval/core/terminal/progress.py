"""Progress of a run: bars on a terminal, lines in a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from cdpipe.core.names import visible

_PACE_S = 1800.0  # a cell may take minutes, and a rate needs two cells


class RunProgress:
    """Receives the progress of a run; subclasses show it."""

    def cells(self, label: str, done: int, total: int) -> None:
        """Take the number of finished cells; `label` names the next one."""

    def stage(self, name: str, done: int, total: int) -> None:
        """Take the progress of one stage."""

    def note(self, text: str) -> None:
        """Take a remark about the whole run."""


class Silent(RunProgress):
    """Shows nothing."""


class Bars(RunProgress):
    """Two bars on standard error, one for cells and one for the stage, with rate and time left. A context manager."""

    def __init__(self) -> None:
        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            _Rate(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            speed_estimate_period=_PACE_S,
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
        self._progress.update(self._cells, description=visible(label), completed=done, total=total, visible=True)

    def stage(self, name: str, done: int, total: int) -> None:
        """Move the bar of the stage; a new name starts a new bar."""
        if name != self._stage_name:
            self._progress.reset(self._stage, description=f"  {visible(name)}", total=total)
            self._stage_name = name
        self._progress.update(self._stage, completed=done, total=total, visible=done < total)

    def note(self, text: str) -> None:
        """Write a line above the bars."""
        line = f"note: {visible(text)}"
        self._progress.console.print(line, markup=False, emoji=False, highlight=False, soft_wrap=True)


class Lines(RunProgress):
    """One line on standard error for each cell and stage, for logs.

    Args:
        rate: Name of what is counted; with a name, lines hold the rate per minute and the time left.
    """

    def __init__(self, rate: str = "") -> None:
        self._last = ""
        self._rate = rate
        self._start: tuple[float, int] | None = None

    def cells(self, label: str, done: int, total: int) -> None:
        """Write the label, once."""
        line = f"[{done}/{total}] {label}"
        self._write(line, self._pace(done, total))

    def stage(self, name: str, done: int, total: int) -> None:
        """Write the name, once; a step of a stage, `stage: step`, is not told."""
        self._write(f"  {name.partition(': ')[0]}")

    def note(self, text: str) -> None:
        """Write the line."""
        self._write(f"note: {text}")

    def _pace(self, done: int, total: int) -> str:
        if self._start is None:
            self._start = time.perf_counter(), done
        seconds, n_new = time.perf_counter() - self._start[0], done - self._start[1]
        if not self._rate or not n_new or not seconds:
            return ""
        left = f", {duration((total - done) * seconds / n_new)} left" if done < total else ""
        return f"; {60 * n_new / seconds:.3g} {self._rate}/min{left}"

    def _write(self, line: str, pace: str = "") -> None:
        if line != self._last:
            sys.stderr.write(f"{visible(line)}{pace}\n")
            self._last = line


@contextmanager
def shown_progress(quiet: bool, rate: str = "") -> Iterator[RunProgress]:
    """Yield bars on a terminal, lines in a log (with a rate where one is named), or nothing if quiet."""
    if quiet:
        yield Silent()
    elif not sys.stderr.isatty():
        yield Lines(rate)
    else:
        with Bars() as bars:
            yield bars


def duration(seconds: float) -> str:
    """Return a time in words: "1 h 05 min", "3 min 20 s", "7 s"."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


class _Rate(ProgressColumn):
    """Steps per second; per minute below 0.1 per second."""

    def render(self, task: Task) -> Text:
        """Render the speed of a task."""
        speed = task.finished_speed or task.speed
        if not speed:
            return Text("-/s")
        if speed >= 10:
            return Text(f"{speed:.0f}/s")
        return Text(f"{speed:.2g}/s" if speed >= 0.1 else f"{60 * speed:.2g}/min")
