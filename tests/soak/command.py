"""A command of ours in a process that can be killed."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import resource
import signal
import sys
import types
from collections.abc import Sequence
from pathlib import Path

import psutil

# One process imports once and forks for each command, so that a command starts at once.
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    [
        "eval.cli.main",
        "eval.running.runner",
        "eval.report.page",
        "eval.training.training_run",
        "cdpipe.pipeline.detection",
    ]
)
_FIRST_WORD = {2: "error: ", 130: "interrupted"}


class Command:
    """A command in a process, session and working folder of its own.

    Args:
        argv: The words after `tunnelcd`.
        folder: The working folder; `stderr.txt` in it holds what the command says.
        file_bytes: The largest file that the command and its workers may write.
    """

    def __init__(self, argv: Sequence[object], folder: Path, file_bytes: int | None = None) -> None:
        self.argv = [str(word) for word in argv]
        self.is_killed = False
        self._log = folder / "stderr.txt"
        self._process = CONTEXT.Process(target=_serve, args=(self.argv, folder, self._log, file_bytes))
        self._process.start()

    @property
    def code(self) -> int | None:
        return self._process.exitcode

    def wait(self, seconds: float | None = None) -> bool:
        """Wait, and tell whether it has ended."""
        self._process.join(seconds)
        return self.code is not None

    def kill(self) -> bool:
        """Kill the command alone: its workers learn of it by themselves. Tell whether it was alive."""
        self.is_killed = self.code is None
        self._process.kill()
        self._process.join()
        return self.code == -signal.SIGKILL

    def interrupt(self) -> bool:
        """Press Ctrl-C, which reaches the command and its workers."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid or 0, signal.SIGINT)
            return True
        return False

    def workers(self) -> list[psutil.Process]:
        """Return the workers of `--workers`, and not the helpers of multiprocessing."""
        with contextlib.suppress(psutil.Error):
            children = psutil.Process(self._process.pid).children()
            return [child for child in children if "spawn_main" in " ".join(child.cmdline())]
        return []

    def complaint(self) -> str:
        """Return what it should not have said: a success says nothing, a failure one line."""
        if self.is_killed:
            return ""
        told = self._log.read_text(errors="replace") if self._log.exists() else ""
        if self.code == 0:
            return told
        is_line = told.count("\n") == 1 and told.startswith(_FIRST_WORD.get(self.code or 0, "\0"))
        return "" if is_line else f"exit code {self.code}: {told}"


def _serve(argv: list[str], folder: Path, log: Path, file_bytes: int | None) -> None:
    os.setsid()
    os.chdir(folder)
    for path, stream in ((Path(os.devnull), 1), (log, 2)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644), stream)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.modules["__main__"] = types.ModuleType("__main__")  # otherwise Dask's workers import the soak's
    if file_bytes is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, file_bytes))
    from eval.cli.main import main  # noqa: PLC0415 - in the process that runs it

    sys.argv = ["tunnelcd", *argv]
    main()
