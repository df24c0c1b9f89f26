"""What disturbs a run: kills of the client, of workers and of the scheduler; the number of workers rises and falls."""

from __future__ import annotations

import contextlib
import logging
import os
import random
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Protocol

import distributed
import psutil

from tests.soak.command import Command

MOST_WORKERS = 4


class Disturber(Protocol):
    """Starts the clients of one run, and disturbs them."""

    def start(self) -> Command:
        """Start a client that goes on with the run."""

    def disturb(self, client: Command) -> str:
        """Disturb it; return what was done, "" if there was nothing to disturb."""

    def end(self) -> None:
        """End what was started beside the client."""


class OneMachine:
    """`run` in one process, or with `--workers`.

    Args:
        folder: Where the run lies, as `run`.
        plan: The plan.
        rng: Draws the numbers of workers, and who is killed.
        target: "serial" (the client, without workers), "client", "worker" or "Ctrl-C".
    """

    def __init__(self, folder: Path, plan: Path, rng: random.Random, target: str) -> None:
        self._folder, self._plan, self._rng, self._target = folder, plan, rng, target

    def start(self) -> Command:
        n_workers = self._rng.randint(1, MOST_WORKERS)
        workers = () if self._target == "serial" else ("--workers", n_workers)
        return Command(["run", self._plan, "--out", "run", "--quiet", *workers], self._folder)

    def disturb(self, client: Command) -> str:
        if self._target == "Ctrl-C":
            return "pressed Ctrl-C" if client.interrupt() else ""
        if self._target == "worker":
            workers = client.workers()
            return f"killed 1 of {len(workers)} workers" if workers and kill(self._rng.choice(workers)) else ""
        return "killed the client" if client.kill() else ""

    def end(self) -> None:
        """Nothing was started beside the client."""


class OwnCluster:
    """`run --scheduler`: a `dask scheduler` and `dask worker`s that come and go.

    Args:
        folder: Where the run lies, as `run`; a temporary folder of Dask's workers beside it.
        plan: The plan.
        rng: Draws the numbers of workers, and who is killed.
        target: "client", "worker", "scheduler" or "all", one of the three each time.
    """

    def __init__(self, folder: Path, plan: Path, rng: random.Random, target: str) -> None:
        self._folder, self._plan, self._rng, self._target = folder, plan, rng, target
        self._workers: list[psutil.Popen] = []
        self._scheduler: psutil.Popen | None = None
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self._port = probe.getsockname()[1]
        self._address = f"tcp://127.0.0.1:{self._port}"

    def start(self) -> Command:
        if self._scheduler is None or self._scheduler.poll() is not None:
            host = ("--host", "127.0.0.1", "--port", str(self._port))
            self._scheduler = self._dask("distributed.cli.dask_scheduler", *host)
        self._wait_for_a_worker(self._rng.randint(1, MOST_WORKERS))
        return Command(["run", self._plan, "--out", "run", "--quiet", "--scheduler", self._address], self._folder)

    def disturb(self, client: Command) -> str:
        target = self._rng.choice(["client", "worker", "scheduler"]) if self._target == "all" else self._target
        self._resize(self._rng.randint(1, MOST_WORKERS))
        if target == "client":
            return "killed the client" if client.kill() else ""
        if target == "scheduler":
            return "killed the scheduler" if self._scheduler is not None and kill(self._scheduler) else ""
        # a worker or the process that watches over it
        alive = [each for worker in self._workers if worker.poll() is None for each in (worker, *_children(worker))]
        return f"killed 1 of {len(self._workers)} workers" if alive and kill(self._rng.choice(alive)) else ""

    def end(self) -> None:
        for process in [*self._workers, *([self._scheduler] if self._scheduler else [])]:
            for each in (*_children(process), process):
                kill(each)
            process.wait()

    def _resize(self, n_workers: int) -> None:
        """Start workers, or let workers end, as `dask worker` ends by SIGTERM."""
        self._workers = [worker for worker in self._workers if worker.poll() is None]
        for worker in self._workers[n_workers:]:
            with contextlib.suppress(psutil.NoSuchProcess):
                worker.terminate()
        missing = n_workers - len(self._workers)
        self._workers += [
            self._dask("distributed.cli.dask_worker", self._address, "--nthreads", "1") for _ in range(missing)
        ]

    def _wait_for_a_worker(self, n_workers: int) -> None:
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        for _ in range(60):
            self._resize(n_workers)  # workers of a killed scheduler end after a while
            with contextlib.suppress(OSError), distributed.Client(self._address, timeout=10) as client:
                client.wait_for_workers(1, timeout=10)
                return
            time.sleep(0.2)
        raise TimeoutError(f"{self._address}: no worker comes")

    def _dask(self, module: str, *words: str) -> psutil.Popen:
        argv = [sys.executable, "-m", module, *words, "--no-dashboard"]
        temporary = {"DASK_TEMPORARY_DIRECTORY": str(self._folder / "dask")}
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        return psutil.Popen(argv, cwd=self._folder, env={**os.environ, **temporary}, start_new_session=True, **silent)


def kill(process: psutil.Process) -> bool:
    """Kill a process, and tell whether it was alive."""
    try:
        process.kill()
    except psutil.NoSuchProcess:
        return False
    return True


def _children(process: psutil.Process) -> list[psutil.Process]:
    with contextlib.suppress(psutil.NoSuchProcess):
        # not the processes of their own in which a worker tries a suspect cell again: their death is the cell's
        return [each for each in process.children() if "spawn_main" in " ".join(each.cmdline())]
    return []
