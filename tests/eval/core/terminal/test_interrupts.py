"""Ctrl-C during an import, and while processes start."""

from __future__ import annotations

import contextlib
import errno
import importlib
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Timer

import pytest

from cdpipe.core.errors import InputError
from eval.core.terminal import interrupts
from eval.core.terminal.exits import input_errors
from eval.core.terminal.interrupts import interruptible, interrupts_held, interrupts_kept, raise_lost_interrupt

LIBRARY = """import signal
try:
    signal.raise_signal(signal.SIGINT)
    is_whole = True
except BaseException:
    is_whole = False
"""
IS_HELD = "import signal; print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))"


@pytest.fixture(autouse=True)
def heard() -> Iterator[None]:
    """A shell starts background commands deaf to Ctrl-C; the tests hear it all the same."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def is_held_in_a_new_process() -> bool:
    return subprocess.run([sys.executable, "-c", IS_HELD], check=True, capture_output=True).stdout == b"True\n"


def test_an_import_ends_before_the_interrupt_comes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "swallows_every_exception.py").write_text(LIBRARY)
    monkeypatch.syspath_prepend(tmp_path)
    before, start = signal.getsignal(signal.SIGINT), time.monotonic()
    with pytest.raises(KeyboardInterrupt), interruptible():
        library = importlib.import_module("swallows_every_exception")
        assert library.is_whole
        time.sleep(60)
    assert time.monotonic() - start < 30  # what the main thread waits for has ended
    assert signal.getsignal(signal.SIGINT) == before


def test_an_interrupt_comes_at_once_without_an_import() -> None:
    with pytest.raises(KeyboardInterrupt), interruptible():
        signal.raise_signal(signal.SIGINT)
        pytest.fail("it waited")


def test_what_a_library_makes_of_an_interrupt_is_an_interrupt() -> None:
    with pytest.raises(KeyboardInterrupt) as caught, interruptible(), interrupts_kept():
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            raise RuntimeError("cannot release un-acquired lock")
    assert isinstance(caught.value.__cause__, RuntimeError)
    with pytest.raises(RuntimeError), interruptible(), interrupts_kept():
        raise RuntimeError("nobody pressed anything")


def test_an_interrupt_that_a_library_drops_comes_later() -> None:
    with pytest.raises(KeyboardInterrupt), interruptible():
        with contextlib.suppress(BaseException):
            signal.raise_signal(signal.SIGINT)
        raise_lost_interrupt()
    with interruptible():
        raise_lost_interrupt()  # that was another program's


def test_a_held_interrupt_comes_at_the_end_and_never_to_processes_started_meanwhile() -> None:
    reached = []
    with pytest.raises(KeyboardInterrupt), interrupts_held():
        signal.raise_signal(signal.SIGINT)
        reached.append(is_held_in_a_new_process())
    assert reached == [True]
    assert not is_held_in_a_new_process()
    with interrupts_held():
        pass  # nobody pressed anything


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="signals of POSIX")
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_the_end_of_a_job_is_an_interrupt_and_its_repetition_leaves_the_cleaning_up_alone(name: str) -> None:
    number, cleaned = signal.Signals[name], []
    before = signal.signal(number, signal.SIG_DFL)
    try:
        with pytest.raises(KeyboardInterrupt), interruptible():
            assert callable(signal.getsignal(number))
            try:
                signal.raise_signal(number)
            finally:
                signal.raise_signal(number)
                cleaned.append(True)
        assert cleaned == [True]
        assert signal.getsignal(number) == signal.SIG_DFL
        with pytest.raises(KeyboardInterrupt), interruptible(), interrupts_held():
            signal.raise_signal(number)
            cleaned.append(True)
        assert cleaned == [True, True]
        with pytest.raises(KeyboardInterrupt), interruptible(), interrupts_held():
            signal.raise_signal(number)
            raise RuntimeError("a worker got it as well and ended")
        signal.signal(number, signal.SIG_IGN)
        with interruptible(), interrupts_held():
            signal.raise_signal(number)
    finally:
        signal.signal(number, before)


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="signals of POSIX")
def test_an_error_of_a_terminal_that_was_closed_during_an_import_is_the_interrupt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "hangs_up.py").write_text("import signal\nsignal.raise_signal(signal.SIGHUP)\n")
    monkeypatch.syspath_prepend(tmp_path)
    timers: list[Timer] = []
    monkeypatch.setattr(Timer, "start", lambda timer: timers.extend([timer]))
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        with interruptible():
            with pytest.raises(KeyboardInterrupt), interrupts_kept():
                importlib.import_module("hangs_up")
                raise OSError(errno.EIO, "Input/output error")  # of the next line that is told
            assert len(timers) == 1
            assert interrupts.tell_interrupt("nothing was written") == 128 + signal.SIGHUP
        with pytest.raises(OSError, match="Input/output"), interruptible(), interrupts_kept():
            raise OSError(errno.EIO, "Input/output error")
        timers[0].function(*timers[0].args)  # comes too late to end the process
    finally:
        signal.signal(signal.SIGHUP, before)


def test_an_error_ends_with_its_code_where_standard_error_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(_: str) -> int:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(sys.stderr, "write", gone)
    with pytest.raises(SystemExit) as ended, input_errors():
        raise InputError("x: missing")
    assert ended.value.code == 2
