"""Reads foreign files with native libraries in a process of its own, so that their crash is one message.

A library in C++ that parses a hostile file can crash, hang or use all memory. The process that calls it

- searches packages where the present process does, without the working folder, and reads no `PYTHON*` variable
  (`python -I`);
- has limits on memory, on CPU time and on the size of files it writes;
- ends when the process that started it ends;
- sends JSON and plain arrays through a pipe. Nothing is pickled, and both are checked where they arrive.
"""

from __future__ import annotations

import json
import math
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import traceback
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError
from cdpipe.core.threads import THREAD_VARIABLES, THREADS

if sys.platform != "win32":
    import resource

Arrays = dict[str, npt.NDArray[Any]]
Message = tuple[dict[str, Any], Arrays]

# Ninety times what one revolution of the largest sensor takes, and ten times the file: a library may hold a whole cloud
# several times over. 20 million points of 48 bytes, decompressed and sorted by field, take 2.3 GB. A library may start
# one thread per core, and each has a stack of 8 MB, of which it uses little, and a heap of its own.
MEMORY_BYTES, _MEMORY_RATIO, _MOST_MEMORY_BYTES = 450_000_000, 10, 3_000_000_000
_MEMORY_BYTES_PER_CORE = 16 << 20
# CPU time from one message to the next: the least, and the file size per further second. Reading is ten times faster.
CPU_S = 6
_BYTES_PER_CPU_S = 20_000_000
# Time from one message to the next, in units of that: a slow disk takes no CPU time.
_WAIT_FACTOR = 10
_MAX_HEADER_BYTES = 16 << 20
_MAX_MESSAGE_BYTES = 1 << 30
_MAX_WRITTEN_BYTES = 1 << 20
_NO_TIME, _NO_MEMORY = "took too long to read it", "ran out of memory while it read it"
_COPY, _SMALLER = "copy it again, or record it again", "thin it or split it; where it is damaged, copy it again"
# Imports this package by its file, so that the folder that holds it is not on the path.
_START = """
import importlib, importlib.util as util, json, os, sys
sys.path[:], file, name = json.loads(sys.argv[1])
package = name.partition(".")[0]
spec = util.spec_from_file_location(package, file, submodule_search_locations=[os.path.dirname(file)])
sys.modules[package] = util.module_from_spec(spec)
spec.loader.exec_module(sys.modules[package])
importlib.import_module(name).serve()
"""
_PACKAGE_FILE = Path(__file__).absolute().parents[1] / "__init__.py"


class IsolatedReader:
    """A process that reads one foreign file with the functions of one module.

    The process starts with the first request and serves one request after the other. It ends with this object.
    """

    def __init__(self, module: str, path: Path, library: str) -> None:
        """Keep what to start.

        Args:
            module: Module whose functions are called; it is imported only in that process.
            path: The file, or a folder of files, for messages and for the limits on CPU time and memory.
            library: Name of the native library in messages, e.g. "the vendor's SDK".
        """
        self._module, self._path, self._library = module, path, library
        self._process: _Process | None = None

    def read(self, function: str, **arguments: Any) -> Iterator[Message]:
        """Call a generator function with JSON arguments, and yield what it yields: a dict and named arrays.

        With an argument `path`, messages and limits are of that file. A caller may stop early. The process is then
        replaced for the next request.

        Raises:
            InputError: The function raised it, or its process crashed or exceeded a limit.
            RuntimeError: The function raised another exception; the text is its traceback.
        """
        process, self._process = self._process or _Process(), None
        path = Path(arguments.get("path", self._path))
        n_bytes = size_of(path)
        budget_s = CPU_S + n_bytes // _BYTES_PER_CPU_S
        limits = {"cpu_s": budget_s, "memory_bytes": memory_limit(n_bytes)}
        try:
            process.send({"module": self._module, "function": function, "arguments": arguments, **limits})
            while (message := process.receive(_WAIT_FACTOR * budget_s)) is not None:
                yield message
        except _EndedError as end:
            process.close()
            way_out = _SMALLER if str(end) == _NO_MEMORY else _COPY
            raise InputError(f"{path}: {self._library} {end}: {way_out}") from end
        except InputError:  # the process lives and has answered
            self._process = process
            raise
        except BaseException:
            process.close()
            raise
        self._process = process


class _EndedError(Exception):
    """The process ended before its answer was complete; the text says how."""


@dataclass(frozen=True, slots=True)
class _ArrayHeader:
    name: str
    dtype: np.dtype[Any]
    shape: tuple[int, ...]


def size_of(path: Path) -> int:
    """Return the bytes of a file, or of all files in a folder, as a ROS 2 bag is; 0 of what is not there."""
    files = path.rglob("*") if path.is_dir() else (path,)
    return sum(each.stat().st_size for each in files if each.is_file())


def memory_limit(n_bytes: int) -> int:
    """Return how many bytes more a process may take that reads a file of `n_bytes`."""
    most_bytes = min(MEMORY_BYTES + _MEMORY_RATIO * n_bytes, _MOST_MEMORY_BYTES)
    return most_bytes + (os.cpu_count() or 1) * _MEMORY_BYTES_PER_CORE


def _command() -> list[str]:
    """Return the command that calls `serve` in a process of its own, on our import path without the working folder."""
    here = Path.cwd()
    folders = [folder for folder in sys.path if Path(folder).is_absolute() and Path(folder) != here]
    return [sys.executable, "-I", "-c", _START, json.dumps([folders, str(_PACKAGE_FILE), __name__])]


class _Process:
    """A started process: requests go to its standard input, messages come from its standard output."""

    def __init__(self) -> None:
        environment = {**os.environ, **dict.fromkeys(THREAD_VARIABLES, str(THREADS))}
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        self._process = subprocess.Popen(
            _command(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env=environment,
            bufsize=0,
        )
        self.close = weakref.finalize(self, _end, self._process, self._errors)

    def send(self, request: Mapping[str, Any]) -> None:
        """Send one request as a line of JSON."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(request).encode() + b"\n")
        except BrokenPipeError as error:
            raise self._ended() from error

    def receive(self, wait_s: float) -> Message | None:
        """Return the next message, or None after the last one of the request."""
        is_late = threading.Event()

        def kill() -> None:
            is_late.set()
            self._process.kill()

        killer = threading.Timer(wait_s, kill)
        killer.start()
        try:
            return self._receive()
        except EOFError as error:
            raise self._ended(has_time=not is_late.is_set()) from error
        finally:
            killer.cancel()

    def _receive(self) -> Message | None:
        n_bytes = int.from_bytes(self._take(8), "little")
        if n_bytes > _MAX_HEADER_BYTES:
            raise _EndedError("sent a damaged answer")
        try:
            header = json.loads(self._take(n_bytes))
            listed = [_ArrayHeader(name, np.dtype(kind), tuple(shape)) for name, kind, shape in header["arrays"]]
            kind, value = header["kind"], header["value"]
            n_bytes = sum(_size(each) for each in listed)
        except (ValueError, LookupError, TypeError, RecursionError) as error:
            raise _EndedError("sent a damaged answer") from error
        if n_bytes > _MAX_MESSAGE_BYTES:
            raise _EndedError("sent a damaged answer")
        if kind == "mistake":
            raise InputError(value)
        if kind == "memory":
            raise _EndedError(_NO_MEMORY)
        if kind == "bug":
            raise RuntimeError(value)
        if kind == "end":
            return None
        arrays = {each.name: np.frombuffer(self._take(_size(each)), each.dtype).reshape(each.shape) for each in listed}
        return value, arrays

    def _take(self, n_bytes: int) -> bytearray:
        assert self._process.stdout is not None
        taken = bytearray(n_bytes)
        view, at = memoryview(taken), 0
        while at < n_bytes:
            n_read = self._process.stdout.readinto(view[at:])  # type: ignore[attr-defined]
            if not n_read:
                raise EOFError
            at += n_read
        return taken

    def _ended(self, *, has_time: bool = True) -> _EndedError:
        code = self._process.wait()
        self._errors.seek(0)
        told = self._errors.read(_MAX_WRITTEN_BYTES).decode(errors="replace")
        self.close()
        if not has_time or code == -_signal("SIGXCPU"):
            return _EndedError(_NO_TIME)
        if code == -_signal("SIGKILL") or "bad_alloc" in told:
            return _EndedError(_NO_MEMORY)
        if code == 1:  # Python itself failed to start
            raise RuntimeError(f"the reading process ended with exit code {code}: {told}")
        name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        return _EndedError(f"crashed while it read it ({name})")


def _signal(name: str) -> int:
    """Return the number of a signal, or a number that none has where the platform does not know it."""
    return int(getattr(signal, name, 0x7FFF))


def _size(header: _ArrayHeader) -> int:
    if header.dtype.kind not in "biuf" or any(not isinstance(n, int) or n < 0 for n in header.shape):
        raise ValueError("not an array of numbers")
    n_items = 1
    for n in header.shape:
        n_items *= n
    return n_items * header.dtype.itemsize


def _end(process: subprocess.Popen[bytes], errors: BinaryIO) -> None:
    process.kill()
    for pipe in (process.stdin, process.stdout, errors):
        if pipe is not None:
            pipe.close()
    process.wait()


def serve() -> None:
    """Answer the requests of an `IsolatedReader`; called in its process."""
    # keep what libraries print out of the answer
    answer = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)
    requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def listen() -> None:
        # a thread of its own sees the end of the pipe, and so of the parent, also during a request
        for line in sys.stdin.buffer:
            requests.put(line)
        os._exit(1)

    threading.Thread(target=listen, daemon=True).start()
    while True:
        _answer(json.loads(requests.get()), lambda *message: _write(answer, *message))


def _answer(request: Mapping[str, Any], send: Callable[[str, Any, Arrays], None]) -> None:
    try:
        limit_time(request["cpu_s"])
        module = import_module(request["module"])
        limit_memory(request["memory_bytes"], _MAX_WRITTEN_BYTES)
        messages: Iterable[Message] = getattr(module, request["function"])(**request["arguments"])
        for value, arrays in messages:
            send("message", value, arrays)
            limit_time(request["cpu_s"])
    except InputError as error:
        send("mistake", str(error), {})
    except MemoryError:
        send("memory", None, {})
    except Exception:
        send("bug", traceback.format_exc(), {})
    else:
        send("end", None, {})


def _write(answer: BinaryIO, kind: str, value: Any, arrays: Arrays) -> None:
    listed = [(name, array.dtype.str, array.shape) for name, array in arrays.items()]
    header = json.dumps({"kind": kind, "value": value, "arrays": listed}).encode()
    parts = [memoryview(len(header).to_bytes(8, "little") + header)]
    parts += [np.ascontiguousarray(array).data.cast("B") for array in arrays.values() if array.size]
    for part in parts:
        at = 0
        while at < len(part):
            at += answer.write(part[at:])


def limit_time(cpu_s: float) -> None:
    """Let the process use `cpu_s` more seconds of CPU time; the kernel ends it with SIGXCPU after that."""
    if sys.platform == "win32":
        return
    usage = resource.getrusage(resource.RUSAGE_SELF)
    hard_s = resource.getrlimit(resource.RLIMIT_CPU)[1]
    _limit(resource.RLIMIT_CPU, math.ceil(usage.ru_utime + usage.ru_stime + cpu_s), hard_s)


def limit_memory(most_bytes: int, most_written_bytes: int | None = None) -> None:
    """Let the process take so many bytes more, and write neither a larger file nor a core dump.

    The bytes count from the first call in a process on; a later call may let it take more, or less.
    RLIMIT_DATA counts what is private and writable, which is what a parser allocates. RLIMIT_AS would also count the
    shared libraries, the file where a library maps it, and the address space that the heap of each thread reserves:
    64 MB that are hardly used.
    """
    if sys.platform == "win32":
        return
    _limit(resource.RLIMIT_DATA, _held_bytes() + most_bytes, resource.getrlimit(resource.RLIMIT_DATA)[1])
    if most_written_bytes is not None:
        _limit(resource.RLIMIT_FSIZE, most_written_bytes)
    _limit(resource.RLIMIT_CORE, 0)


@cache
def _held_bytes() -> int:
    """Return the private and writable bytes of this process at the first call."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[5]) * resource.getpagesize() if statm.exists() else 0


def _limit(kind: int, most: int, hard: int | None = None) -> None:
    """Set a limit of this process, or keep a lower one that it was started with."""
    if sys.platform == "win32":
        return
    held = resource.getrlimit(kind)[1]
    if held != resource.RLIM_INFINITY:
        most = min(most, held)
    resource.setrlimit(kind, (most, most if hard is None else hard))
