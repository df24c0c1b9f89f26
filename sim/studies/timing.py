"""Timing of a piece of work against a rival in the same run."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Clock = Callable[[], float]


@dataclass(frozen=True, slots=True)
class Contest:
    """Times of one piece of work, and of the same work done by a rival.

    Attributes:
        unit: Unit of the figure, e.g. "Mray/s", or "s" for a time.
        seconds: Time of each repetition.
        work: Work of one repetition in `unit` times seconds; None: the figure is the time itself.
        rival: Name of the rival, or None.
        rival_seconds: Times of the rival's repetitions for the same work.
        target: Factor by which it should be faster than the rival, or None.
    """

    unit: str
    seconds: tuple[float, ...]
    work: float | None = None
    rival: str | None = None
    rival_seconds: tuple[float, ...] = ()
    target: float | None = None


@dataclass(frozen=True, slots=True)
class SkippedContest(Contest):
    """Work that this machine cannot do.

    Attributes:
        reason: What it lacks.
    """

    reason: str = ""


def timed(action: Callable[[], Any], repeats: int, clock: Clock = time.perf_counter) -> tuple[float, ...]:
    """Time an action, after one call that does not count."""
    action()
    return tuple(_once(action, clock) for _ in range(repeats))


def raced(
    ours: Callable[[], Any], rival: Callable[[], Any], repeats: int, clock: Clock
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Time two actions in turns, so that other load affects both; the first calls do not count.

    Args:
        ours: One piece of work.
        rival: The same amount of work.
        repeats: Repetitions of each.
        clock: `time.thread_time` for work in this thread alone, which excludes other programs.
    """
    ours()
    rival()
    pairs = []
    for number in range(repeats):
        if number % 2:
            second, first = _once(rival, clock), _once(ours, clock)
        else:
            first, second = _once(ours, clock), _once(rival, clock)
        pairs.append((first, second))
    return tuple(pair[0] for pair in pairs), tuple(pair[1] for pair in pairs)


def _once(action: Callable[[], Any], clock: Clock) -> float:
    start = clock()
    action()
    return clock() - start
