"""Ctrl-C waits where it would do harm: during imports, and while worker processes start.

SIGTERM, by which a scheduler ends a job, and SIGHUP of a terminal that is closed are treated as Ctrl-C is. A signal
that this process was told to ignore (`nohup`) stays ignored.

Libraries swallow an interrupt that reaches them while they are imported, and then do without what they were importing
(`try: import x / except BaseException`), or turn it into an `ImportError`. Ctrl-C also reaches every process of a
terminal, also one that is just starting and knows no better than to print a traceback.

An interrupt is not lost either: Python may make another error of it (`Condition.wait` of a lock that it has just let go
raises "cannot release un-acquired lock"), or drop it (in `__del__` or a callback of C).
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing import resource_tracker
from threading import Timer, current_thread, main_thread
from types import FrameType

_AGAIN_S = 0.05
_SAME_S = 5.0
_IMPORT = "<frozen importlib._bootstrap>"
_ENDING = ("SIGTERM", "SIGHUP")  # Windows knows no SIGHUP
_raised: list[tuple[int, float]] = []  # interrupts of the program that runs: signal, monotonic time
_waiting: list[int] = []  # SIGTERM or SIGHUP that waits for the end of an import


@contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C raise `KeyboardInterrupt` in the main thread as always, but not before an import has ended.

    SIGTERM and SIGHUP raise it, too, unless they are ignored or whoever calls this handles them.
    """
    if current_thread() is not main_thread():
        yield
        return
    with ExitStack() as stack:
        stack.callback(_raised.clear)
        stack.callback(_waiting.clear)
        for number in (signal.SIGINT, *_ending_signals()):
            stack.callback(signal.signal, number, signal.signal(number, _interrupt_or_wait))
        yield


def tell_interrupt(what: str) -> int:
    """Write on standard error that the command was interrupted, by which signal, and what is left of its work.

    Returns:
        The exit code: 128 and the number of the signal, as a shell counts it.
    """
    number = _raised[0][0] if _raised else signal.SIGINT
    by = "" if number == signal.SIGINT else f" by {signal.Signals(number).name}"
    with suppress(OSError):  # the terminal may be gone
        sys.stderr.write(f"interrupted{by}; {what}\n")
        sys.stderr.flush()
    return 128 + number


@contextmanager
def interrupts_kept() -> Iterator[None]:
    """Raise `KeyboardInterrupt` again where another error came of it, as of a closed terminal that is written to."""
    try:
        yield
    except Exception as error:
        if _waiting and not _raised:
            _raised.append((_waiting[0], time.monotonic()))
        if _raised:
            raise KeyboardInterrupt from error
        raise


def is_ended() -> bool:
    """Return whether SIGTERM or SIGHUP interrupted the program, and not Ctrl-C."""
    return bool(_raised) and _raised[0][0] != signal.SIGINT


def raise_lost_interrupt() -> None:
    """Raise `KeyboardInterrupt` if one was raised before, so that whoever calls this does not know of it."""
    if _raised:
        raise KeyboardInterrupt


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Hold Ctrl-C, SIGTERM and SIGHUP back; the first that came is raised at the end.

    Threads and processes that start meanwhile, and those that they start, never get Ctrl-C nor SIGHUP: this process
    ends them. SIGTERM reaches them, as they may be ended by it.
    """
    if current_thread() is not main_thread() or not hasattr(signal, "pthread_sigmask"):
        yield  # a thread that no signal reaches, or Windows
        return
    resource_tracker.ensure_running()  # its start would let Ctrl-C through again
    pressed: list[int] = []
    with ExitStack() as stack:
        # also where the block fails: its processes may have got the same signal
        stack.callback(_raise_first, pressed)
        # the mask holds for this thread and what it starts; a signal that another thread takes comes to the handler
        for number in (signal.SIGINT, *_handled_signals()):
            handler = signal.signal(number, lambda number, _: pressed.append(number))
            stack.callback(signal.signal, number, handler)
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
        stack.callback(signal.pthread_sigmask, signal.SIG_SETMASK, mask)
        yield


def _raise_first(numbers: Sequence[int]) -> None:
    if numbers:
        signal.raise_signal(numbers[0])


def _ending_signals() -> list[int]:
    """Return the signals besides Ctrl-C that would end this process at once."""
    numbers = [int(getattr(signal, name)) for name in _ENDING if hasattr(signal, name)]
    return [number for number in numbers if signal.getsignal(number) == signal.SIG_DFL]


def _handled_signals() -> list[int]:
    """Return the signals besides Ctrl-C that `interruptible` handles here."""
    numbers = [int(getattr(signal, name)) for name in _ENDING if hasattr(signal, name)]
    return [number for number in numbers if signal.getsignal(number) is _interrupt_or_wait]


def _interrupt_or_wait(number: int, frame: FrameType | None) -> None:
    now = time.monotonic()
    # a shell that hangs up tells its jobs what the terminal has told them: the second one would end the cleaning up
    if number != signal.SIGINT and any(now - at < _SAME_S for _, at in _raised):
        return
    if not _is_importing(frame):
        _raised.append((number, now))
        signal.default_int_handler(number, frame)
    if number != signal.SIGINT:
        _waiting.append(number)
    again = Timer(_AGAIN_S, _press_again, (number,))
    again.daemon = True
    again.start()


def _press_again(number: int) -> None:
    """Send a signal to the main thread, so that what it waits for ends; not to the thread that calls this."""
    if signal.getsignal(number) == signal.SIG_DFL:
        return  # the program was interrupted meanwhile, and is ending
    to = main_thread().ident
    if to is not None and hasattr(signal, "pthread_kill"):
        signal.pthread_kill(to, number)
    else:  # Windows
        signal.raise_signal(number)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == _IMPORT:
            return True
        frame = frame.f_back
    return False
