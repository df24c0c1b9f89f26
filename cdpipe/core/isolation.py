"""Calls a function in a separate process, so that a crash of the function does not end the caller.

JSON passes between the two processes, over the standard input and output of the new one; nothing is unpickled, and no
file and no network is involved. The new process searches packages where the present one does, and never begins with
the working folder: a file there that is called `json.py` is not run.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cdpipe.core.errors import InputError, ScenarioError, TunnelcdError

_TOLD = (ScenarioError, InputError, TunnelcdError)  # raised again as what they are, the narrowest first


class ProcessDiedError(Exception):
    """A process ended before it answered; the text says how: "signal 9", "exit code 3"."""


def run_isolated(call: Callable[[Any], Any], document: Any) -> Any:
    """Call a function with a document in a new Python process, and wait. The process ends when this one dies.

    Args:
        call: A function of a module, by whose name the new process finds it.
        document: Its only argument: what JSON can hold.

    Returns:
        What the function returned, as JSON holds it (tuples are lists).

    Raises:
        ProcessDiedError: The process ended before it answered.
        TunnelcdError: Or `InputError`, `ScenarioError`, `OSError`: the function raised it.
        RuntimeError: The function raised anything else, whose traceback is on standard error.
    """
    argv = [sys.executable, "-P", "-m", __name__, call.__module__, call.__qualname__]
    # an editable installation has a mark on its path that would be the name of a folder here
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if Path(path).is_absolute())}
    with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment) as process:
        if process.stdin is None or process.stdout is None:
            raise RuntimeError("no pipes")
        try:
            # the pipe stays open until the answer comes: its end tells the child that this process died
            process.stdin.write(json.dumps(document).encode() + b"\n")
            process.stdin.flush()
        except BrokenPipeError:
            pass  # the child died before it read
        told = process.stdout.read()
    if not told.endswith(b"\n"):  # after a whole answer the exit code does not matter
        code = process.returncode
        raise ProcessDiedError(f"signal {-code}" if code < 0 else f"exit code {code}")
    answer = json.loads(told)
    if "error" in answer:
        raise _as_error(**answer["error"])
    return answer["value"]


def _serve(module: str, name: str) -> None:
    # keep what libraries print out of the answer
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    document = json.loads(sys.stdin.buffer.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        told = json.dumps({"value": getattr(importlib.import_module(module), name)(document)})
    except Exception as error:
        told = json.dumps({"error": _as_document(error)})
    answer.write(told.encode() + b"\n")
    answer.close()


def _as_document(error: Exception) -> dict[str, Any]:
    if isinstance(error, OSError):
        file = None if error.filename is None else str(error.filename)
        return {"kind": "OSError", "text": error.strerror or str(error), "number": error.errno, "file": file}
    kind = next((known.__name__ for known in _TOLD if isinstance(error, known)), "")
    if not kind:
        traceback.print_exception(error)
    return {"kind": kind, "text": str(error) if kind else f"{type(error).__name__}: {error}"}


def _as_error(kind: str, text: str, number: int | None = None, file: str | None = None) -> Exception:
    if kind == "OSError":
        return OSError(number, text, file)
    return next((known(text) for known in _TOLD if known.__name__ == kind), RuntimeError(text))


def _end_with_parent() -> None:
    while os.read(0, 1024):
        pass
    os._exit(1)


if __name__ == "__main__":
    _serve(*sys.argv[1:])
