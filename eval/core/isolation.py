"""Calls a function in a separate process, so that a crash of the function does not end the caller."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any


def run_isolated(call: Callable[..., object], *args: object) -> str:
    """Call a function with these arguments in a new Python process, and wait.

    The process ends when this one dies. The return value is dropped. Arguments and exceptions are pickled between this
    process and its own child; no file and no network is involved.

    Args:
        call: An importable function.
        *args: Arguments that can be pickled.

    Returns:
        "" if the function returned, else how its process ended: "signal 9", "exit code 3".

    Raises:
        Exception: The exception that the function raised.
    """
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    argv = [sys.executable, "-m", "eval.core.isolation"]
    with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment) as process:
        if process.stdin is None or process.stdout is None:
            raise RuntimeError("no pipes")
        try:
            # the pipe stays open until the answer comes: its end tells the child that this process died
            process.stdin.write(pickle.dumps((call, args)))
            process.stdin.flush()
        except BrokenPipeError:
            pass  # the child died before it read
        told = process.stdout.read()
    if not told:  # after an answer the exit code does not matter
        code = process.returncode
        return f"signal {-code}" if code < 0 else f"exit code {code}"
    error: Exception | None = pickle.loads(told)
    if error is not None:
        raise error
    return ""


def _serve() -> None:
    # keep what libraries print out of the answer
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    call, args = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    told: Any = None
    try:
        call(*args)
    except Exception as error:
        told = error
    answer.write(pickle.dumps(told))
    answer.close()


def _end_with_parent() -> None:
    while os.read(0, 1024):
        pass
    os._exit(1)


if __name__ == "__main__":
    _serve()
