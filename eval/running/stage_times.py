"""How the stages of a pair are timed.

Times are wall clock of one process on fixed threads, one stage after the other: the first call warms up; where it took
less than a second, the median of three further calls is the time, otherwise the first call is. Of a stage with parts
each part is timed so, and the parts by themselves. Where workers share the machine times say little, and one call is
enough.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Protocol, TypeVar

REPEAT_BELOW_S = 1.0
REPEATS = 3


class HasSeconds(Protocol):
    """What says itself how long each of its parts took."""

    @property
    def seconds(self) -> Mapping[str, float]:
        """Wall-clock seconds by name."""


TimedT = TypeVar("TimedT", bound=HasSeconds)


def time_parts(call: Callable[[], TimedT], repeats: int = REPEATS) -> tuple[TimedT, Mapping[str, float]]:
    """Return a call's result and the seconds of its parts by the rule of this module."""
    start = time.perf_counter()
    result = call()
    if repeats == 0 or time.perf_counter() - start >= REPEAT_BELOW_S:
        return result, result.seconds
    runs = [call().seconds for _ in range(repeats)]
    return result, {name: statistics.median(run[name] for run in runs) for name in result.seconds}
