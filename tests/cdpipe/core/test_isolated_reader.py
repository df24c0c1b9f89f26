"""A reader in a process of its own: what it yields arrives, and its death is one line."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core import isolated_reader
from cdpipe.core.errors import InputError
from cdpipe.core.isolated_reader import IsolatedReader

ROOT = Path(__file__).parents[3]
HOSTILE = """
import ctypes, os, sys, time
import numpy as np
from cdpipe.core.errors import InputError

def arrays(n):
    for number in range(n):
        yield {"number": number, "half": 0.5}, {"a": np.arange(6).reshape(2, 3).T, "none": np.zeros((0, 4), "f4")}

def mistake(): raise InputError("x.osf: not good")
def bug(): raise KeyError("lost")
def crash():
    print("noise", flush=True)
    yield {}, {}
    ctypes.string_at(0)
def spin():
    while True: pass
def wait(): time.sleep(60)
def grow(): np.ones(1 << 32, "u1")
def take(n, path): yield {}, {"n": np.array([np.ones(n, "u1").sum()])}
def lie():
    for fd in range(3, 20):
        try: os.write(fd, b"\\xff" * 100)
        except OSError: pass
    time.sleep(60)
def objects(): yield {}, {"a": np.array([{}])}
def where(): yield {"path": sys.path, "pid": os.getpid()}, {}
"""


@pytest.fixture(name="read")
def read_fixture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[isolated_reader.Message]]:
    """Return what reads with a function of `HOSTILE`, in one process after the other."""
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "hostile.py").write_text(HOSTILE)
    (tmp_path / "x.osf").write_bytes(b"x")
    monkeypatch.syspath_prepend(tmp_path / "modules")
    reader = IsolatedReader("hostile", tmp_path / "x.osf", "the library")
    return lambda name, **arguments: list(reader.read(name, **arguments))


def test_dicts_and_arrays_arrive_as_they_were(read: Callable[..., list[isolated_reader.Message]]) -> None:
    for _ in range(2):
        messages = read("arrays", n=3)
        assert [about for about, _ in messages] == [{"number": number, "half": 0.5} for number in range(3)]
        np.testing.assert_array_equal(messages[2][1]["a"], [[0, 3], [1, 4], [2, 5]])
        assert (messages[2][1]["none"].shape, messages[2][1]["none"].dtype) == ((0, 4), np.float32)


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        ("crash", "x.osf: the library crashed while it read it (SIGSEGV): copy it again, or record it again"),
        ("grow", "x.osf: the library ran out of memory while it read it: "),
        ("lie", "x.osf: the library sent a damaged answer: "),
        ("objects", "x.osf: the library sent a damaged answer: "),
        ("mistake", "x.osf: not good"),
    ],
)
def test_a_death_is_one_line(read: Callable[..., list[isolated_reader.Message]], function: str, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        read(function)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(read("arrays", n=1)) == 1


@pytest.mark.parametrize(("function", "cpu_s", "wait_factor"), [("spin", 0.1, 100.0), ("wait", 6, 0.1)])
def test_too_long_is_one_line(
    read: Callable[..., list[isolated_reader.Message]],
    monkeypatch: pytest.MonkeyPatch,
    function: str,
    cpu_s: float,
    wait_factor: float,
) -> None:
    monkeypatch.setattr(isolated_reader, "CPU_S", cpu_s)
    monkeypatch.setattr(isolated_reader, "_WAIT_FACTOR", wait_factor)
    with pytest.raises(InputError, match=r"x\.osf: the library took too long to read it: "):
        read(function)


def test_a_folder_has_the_time_of_its_files(tmp_path: Path) -> None:
    (tmp_path / "bag" / "more").mkdir(parents=True)
    for name in ("a.db3", "more/b.db3"):
        with (tmp_path / "bag" / name).open("wb") as file:
            file.truncate(60_000_000)
    assert (
        isolated_reader.size_of(tmp_path / "bag")
        == 2 * isolated_reader.size_of(tmp_path / "bag" / "a.db3")
        == 120_000_000
    )


def test_memory_grows_with_the_file_and_what_helps_is_told(
    read: Callable[..., list[isolated_reader.Message]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(isolated_reader, "MEMORY_BYTES", 50_000_000)
    monkeypatch.setattr(isolated_reader, "_MEMORY_BYTES_PER_CORE", 0)
    for name, n_bytes in (("small.pcd", 100), ("large.pcd", 30_000_000)):
        with (tmp_path / name).open("wb") as file:
            file.truncate(n_bytes)
    small, large = (str(tmp_path / name) for name in ("small.pcd", "large.pcd"))
    assert len(read("take", n=1000, path=small)) == 1
    assert len(read("take", n=200_000_000, path=large)) == 1  # the same process
    with pytest.raises(InputError, match=r"small\.pcd: the library ran out of memory .*: thin it or split it"):
        read("take", n=200_000_000, path=small)


@pytest.mark.parametrize("n_bytes", [0, 10**6, 240_000_000, 10**11])
def test_memory_stays_below_the_promised_bound(n_bytes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(isolated_reader.os, "cpu_count", lambda: 2)
    assert isolated_reader.memory_limit(n_bytes) <= min(500_000_000 + 10 * n_bytes, 3_100_000_000)
    assert isolated_reader.memory_limit(240_000_000) > 72 * 20_000_000  # an E57 of the most points, thrice in memory


def test_a_reader_killed_before_its_answer_is_awaited_took_too_long(
    read: Callable[..., list[isolated_reader.Message]], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Early(threading.Timer):
        """A timer that has fired when `start` returns, as on a machine that is busy just then."""

        def start(self) -> None:
            super().start()
            self.join()

    monkeypatch.setattr(isolated_reader.threading, "Timer", Early)
    monkeypatch.setattr(isolated_reader, "_WAIT_FACTOR", 0.001)
    with pytest.raises(InputError, match=r"x\.osf: the library took too long to read it: "):
        read("wait")


def test_a_bug_stays_a_traceback(read: Callable[..., list[isolated_reader.Message]]) -> None:
    with pytest.raises(RuntimeError, match="KeyError: 'lost'"):
        read("bug")


def test_the_working_folder_is_not_on_its_path(
    read: Callable[..., list[isolated_reader.Message]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "numpy.py").write_text("raise RuntimeError('from the working folder')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", "mark", str(tmp_path), *sys.path])
    monkeypatch.setenv("PYTHONPATH", ".")
    ((about, _),) = read("where")
    assert not {"", ".", "mark", str(tmp_path)} & set(about["path"])


def test_it_ends_with_its_parent(tmp_path: Path) -> None:
    (tmp_path / "hostile.py").write_text(HOSTILE)
    code = f"""
import sys
from pathlib import Path
sys.path.insert(0, {str(tmp_path)!r})
from cdpipe.core.isolated_reader import IsolatedReader
reader = IsolatedReader("hostile", Path(sys.path[0]) / "hostile.py", "the library")
print(next(reader.read("where"))[0]["pid"], flush=True)
messages = reader.read("where")
print(next(messages)[0]["pid"], flush=True)
list(reader.read("wait"))
"""
    with subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pids = [int(parent.stdout.readline()) for _ in range(2)]
        time.sleep(0.1)
        parent.send_signal(signal.SIGKILL)
    deadline = time.monotonic() + 5.0
    while any(is_running(pid) for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not any(is_running(pid) for pid in pids)


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
