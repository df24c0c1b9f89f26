"""Runs the pairs of a plan on workers, which write their cells into the run folder themselves.

A task is a pair with its unfinished cells. Finished cells are on the disk and survive any death, so workers need the
run folder under the same path as the client (on several machines, a shared disk). A worker leaves a trace file beside
a cell before it begins the cell and removes it afterwards. A trace that is found names the cell during which a worker
died. That cell is tried again in a process of its own and becomes a row of status `worker_died` if that process dies
too. Other cells are not suspected, also where a worker has several threads.
"""

from __future__ import annotations

import socket
import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from cdpipe.core.errors import InputError
from cdpipe.core.isolation import ProcessDiedError, run_isolated
from eval.core.cluster import is_shared, n_slots
from eval.core.terminal.progress import RunProgress, Silent
from eval.running.pair_run import Made, Pair, PairRun, Todo, cell_key, is_finished, pair_lock
from eval.running.runfolder import RunFolder
from eval.running.scaling.keeping import drop_pair
from eval.scoring.scoring import METRICS_VERSION
from scenarios.references import file_digests

_AHEAD = 2  # pairs that wait in a cluster for each of its threads
_LOOK_S = 0.5
_NO_WORKERS_S = 60.0
# Of a suspect: with its worker, and then alone, where somebody else may still kill the worker that only watches. With
# three, a soak that killed the only worker every six seconds made a cell of ten seconds a row `worker_died`.
_TRIES = 6
_TRACE, _TOKEN = ".begun", ".workers"


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """A worker's task: a pair, the run folder, and the token that shows that the run still goes on."""

    folder: Path
    token: str
    pair: Pair
    made: Made
    metrics_version: int = METRICS_VERSION

    def as_json(self) -> str:
        """Return the document that a worker receives."""
        return _TASK.dump_json(self).decode()


_TASK = TypeAdapter(Task)


def run_on_workers(
    client: Any,
    run: RunFolder,
    pairs: Sequence[Pair],
    made: Made,
    progress: RunProgress,
    done: Callable[[Pair], None] | None = None,
) -> None:
    """Run pairs on the workers of a Dask client; returns when all of their cells are finished.

    `done` is told each finished pair.

    Raises:
        InputError: The workers do not see the folder, or go away.
    """
    folder = run.path.absolute()
    token = uuid.uuid4().hex
    (folder / _TOKEN).write_text(token)
    try:
        _Dispatch(client, folder, token, pairs, made, progress, done).run()
        _remove_begun(run)  # a worker may die between the end of a cell and that of its trace
    finally:
        # workers of a cluster outlive this process; without the token they stop after their present cell
        if _token(folder) == token:
            (folder / _TOKEN).unlink(missing_ok=True)


def remove_traces(run: RunFolder) -> None:
    """Remove the traces of an earlier run, and stop its workers that may still be running."""
    (run.path / _TOKEN).unlink(missing_ok=True)
    _remove_begun(run)


def _remove_begun(run: RunFolder) -> None:
    for trace in [*run.path.glob(f"cells/*/*/.*{_TRACE}"), *run.path.glob(f"pairs/*/.*{_TRACE}")]:
        trace.unlink(missing_ok=True)


class _Dispatch:
    """Keeps the workers busy until all pairs are done."""

    def __init__(
        self,
        client: Any,
        folder: Path,
        token: str,
        pairs: Sequence[Pair],
        made: Made,
        progress: RunProgress,
        done: Callable[[Pair], None] | None = None,
    ) -> None:
        self._tell_done = done
        self._client = client
        self._run = RunFolder(folder)
        self._token = token
        self._made = made
        self._progress = progress
        self._waiting = deque(pairs)
        self._flying: dict[Any, Pair] = {}
        self._n_killed: Counter[tuple[str, int]] = Counter()
        self._n_total = sum(len(pair.todo) for pair in pairs)
        self._n_done = 0

    def run(self) -> None:
        from distributed import wait  # noqa: PLC0415 - an extra, and slow to import

        seen = time.monotonic()
        while self._waiting or self._flying:
            slots = n_slots(self._client)
            self._submit(_AHEAD * max(1, slots))
            self._tell(max(1, slots))
            if slots:
                seen = time.monotonic()
            elif time.monotonic() - seen > _NO_WORKERS_S:
                raise InputError("the cluster has no workers left: start some, and run the same command again")
            try:
                done = wait(list(self._flying), timeout=_LOOK_S, return_when="FIRST_COMPLETED").done
            except TimeoutError:
                continue
            for future in done:
                self._take(future, self._flying.pop(future))

    def _submit(self, n_flying: int) -> None:
        while self._waiting and len(self._flying) < n_flying:
            pair = self._waiting.popleft()
            made = replace(self._made, is_contended=is_shared(self._client))
            task = Task(self._run.path, self._token, pair, made)
            self._flying[self._client.submit(work_on, task.as_json(), pure=False)] = pair

    def _take(self, future: Any, pair: Pair) -> None:
        from distributed import KilledWorker  # noqa: PLC0415 - as above

        try:
            problem = future.result()
        except KilledWorker as error:
            # Dask gives up a task after some deaths of workers, even a task that only waited on them
            self._n_killed[pair.name, pair.seed] += 1
            if self._n_killed[pair.name, pair.seed] > len(pair.todo) + 2:
                raise InputError(f"{pair.name} {pair.seed}: workers die before they begin one of its cells") from error
            self._waiting.append(pair)
            return
        finally:
            future.release()  # otherwise a finished pair runs again when its worker dies later
        if problem:
            taken = _token(self._run.path) != self._token
            raise InputError(f"{self._run.path}: another run has taken the folder" if taken else problem)
        self._n_done += len(pair.todo)
        if self._tell_done is not None:
            self._tell_done(pair)

    def _tell(self, n_named: int) -> None:
        """Report progress by counting the files of finished cells."""
        at_work = list(self._flying.values())
        paths = [self._run.cell(pair.name, pair.seed, each.cell.variant) for pair in at_work for each in pair.todo]
        n_done = self._n_done + sum(path.exists() for path in paths)
        names = ", ".join(f"{pair.name} {pair.seed}" for pair in at_work[:n_named])
        self._progress.cells(names, n_done, self._n_total)


def work_on(document: str) -> str:
    """Run the unfinished cells of a task; runs on a worker.

    Returns:
        "", or why this worker cannot.
    """
    try:
        task = _TASK.validate_json(document)
    except ValidationError as error:
        mistake = f"a worker on {socket.gethostname()} cannot read its task ({error.errors()[0]['msg']})"
        return f"{mistake}: start it anew with the same version of tunnelcd and of its plug-ins"
    if problem := _unfit(task):
        return problem
    run, pair = RunFolder(task.folder), task.pair
    with pair_lock(run, pair):
        here = PairRun(run, pair, task.made, Silent())
        death = ""
        for each in [each for each in pair.todo if not is_finished(run, each)]:
            if _token(task.folder) != task.token:
                return "the run was stopped"
            trace = run.cell(pair.name, pair.seed, each.cell.variant).with_suffix(_TRACE)
            trace = trace.with_name(f".{trace.name}")
            if not death and not _n_begun(trace):
                death = _death_of_opening(task, here)
            death_of_cell = death or _death_of_cell(task, here, each, trace)
            if death_of_cell:
                here.write_died(each, death_of_cell)
        if pair.keep != "sessions":
            drop_pair(run, pair.name, pair.seed, pair.keep)
    return ""


def open_and_run(document: str) -> None:
    """Open a task's pair, and run its cells; runs in a process of its own."""
    task = _TASK.validate_json(document)
    alone = PairRun(RunFolder(task.folder), task.pair, task.made, Silent())
    alone.open()
    for each in task.pair.todo:
        alone.do(each)


def _death_of_opening(task: Task, here: PairRun) -> str:
    """Simulate and open a pair, first in a process of its own where that killed a worker; return what is said of it."""
    if here.is_open:
        return ""
    trace = RunFolder(task.folder).pair(task.pair.name, task.pair.seed).with_name(f".{task.pair.seed}{_TRACE}")
    with _traced(trace) as n_begun:
        if n_begun >= _TRIES:
            return f"its worker died {n_begun} times while its pair was made"
        if n_begun and (death := _death_alone(_only(task))):
            return death
        here.open()
    return ""


def _death_of_cell(task: Task, here: PairRun, each: Todo, trace: Path) -> str:
    """Run a cell here, or in a process of its own where a worker died during it; return what is said of its death."""
    with _traced(trace) as n_begun:
        if n_begun >= _TRIES:
            return f"its worker died {n_begun} times during it"
        if n_begun:
            return _death_alone(_only(task, each))
        here.do(each)
    return ""


def _death_alone(task: Task) -> str:
    """Run a task in a process of its own, and return what is said of its death, "" if it lives."""
    try:
        run_isolated(open_and_run, task.as_json())
    except ProcessDiedError as death:
        return f"killed its worker, and again where it ran alone ({death})"
    return ""


@contextmanager
def _traced(trace: Path) -> Iterator[int]:
    """Hold a trace file that only a death leaves behind; yield how often the work was begun before."""
    n_begun = _n_begun(trace)
    trace.parent.mkdir(parents=True, exist_ok=True)
    try:
        trace.write_text(str(n_begun + 1))
        yield n_begun
    finally:
        trace.unlink(missing_ok=True)


def _n_begun(trace: Path) -> int:
    try:
        return int(trace.read_text() or 1)
    except FileNotFoundError:
        return 0


def _only(task: Task, *todo: Todo) -> Task:
    return replace(task, pair=replace(task.pair, todo=todo))


def _unfit(task: Task) -> str:
    """Return why this process cannot run the client's task, "" if it can."""
    here, pair = socket.gethostname(), task.pair
    if _token(task.folder) != task.token:
        return f"{task.folder}: a worker on {here} does not see it: workers need the same folder under the same path"
    try:
        files = {} if pair.scenario is None else file_digests(pair.scenario)
        keys = [cell_key(each.cell, pair.kind, pair.scenario, files) for each in pair.todo]
    except InputError as error:
        return f"a worker on {here}: {error}"
    if keys != [each.key for each in pair.todo] or task.metrics_version != METRICS_VERSION:
        return (
            f"{pair.name} {pair.seed}: a worker on {here} has other files, weights, extras or metrics than this "
            "process: start it anew with the same version of tunnelcd"
        )
    return ""


def _token(folder: Path) -> str:
    try:
        return (folder / _TOKEN).read_text()
    except OSError:
        return ""
