"""Ctrl-C waits where it would do harm: during imports, and while worker processes start.

Libraries swallow an interrupt that reaches them while they are imported, and then do without what they were importing
(`try: import x / except BaseException`), or turn it into an `ImportError`. Ctrl-C also reaches every process of a
terminal, also one that is just starting and knows no better than to print a traceback.

An interrupt is not lost either: Python may make another error of it (`Condition.wait` of a lock that it has just let go
raises "cannot release un-acquired lock"), or drop it (in `__del__` or a callback of C).
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from threading import Timer, current_thread, main_thread
from types import FrameType

_AGAIN_S = 0.05
_IMPORT = "<frozen importlib._bootstrap>"
_raised: list[int] = []  # interrupts of the program that runs


@contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C raise `KeyboardInterrupt` in the main thread as always, but not before an import has ended."""
    if current_thread() is not main_thread():
        yield
        return
    handler = signal.signal(signal.SIGINT, _interrupt_or_wait)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        _raised.clear()


@contextmanager
def interrupts_kept() -> Iterator[None]:
    """Raise `KeyboardInterrupt` again where another error came of it."""
    try:
        yield
    except Exception as error:
        if _raised:
            raise KeyboardInterrupt from error
        raise


def raise_lost_interrupt() -> None:
    """Raise `KeyboardInterrupt` if one was raised before, so that whoever calls this does not know of it."""
    if _raised:
        raise KeyboardInterrupt


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Hold Ctrl-C back; it is raised at the end.

    Threads and processes that start meanwhile, and those that they start, never get it: this process ends them.
    """
    if current_thread() is not main_thread() or not hasattr(signal, "pthread_sigmask"):
        yield  # a thread that no signal reaches, or Windows
        return
    resource_tracker.ensure_running()  # its start would let Ctrl-C through again
    pressed: list[int] = []
    # the mask holds for this thread and what it starts; a signal that another thread takes comes to the handler
    handler = signal.signal(signal.SIGINT, lambda number, _: pressed.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, handler)
    if pressed:
        signal.raise_signal(signal.SIGINT)


def _interrupt_or_wait(number: int, frame: FrameType | None) -> None:
    if not _is_importing(frame):
        _raised.append(number)
        signal.default_int_handler(number, frame)
    again = Timer(_AGAIN_S, _press_again, (number,))
    again.daemon = True
    again.start()


def _press_again(number: int) -> None:
    """Send a signal to the main thread, so that what it waits for ends; not to the thread that calls this."""
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
