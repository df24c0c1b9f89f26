"""Number of threads of numeric libraries: one, so that the same input gives the same bytes and comparable times."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")
THREADS = 1
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


def fix_threads() -> None:
    """Ask every numeric library for one thread, unless the user's environment names a number.

    Works only before numpy and torch are first imported: these variables are read once.
    """
    for name in THREAD_VARIABLES:
        os.environ.setdefault(name, str(THREADS))


def allowed_threads() -> int:
    """Return how many threads the project's own loops may use: one, unless the user's environment names a number.

    Only loops with the same result for every number of threads may ask.
    """
    named = os.environ.get(THREAD_VARIABLES[0], "")
    return max(int(named), 1) if named.isdecimal() else THREADS


def in_threads(work: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """Return `work(item)` of every item, in order, by as many threads as are allowed.

    Only work with the same result in any order may be done so, and it pays only where numpy or scipy does it.
    """
    with ThreadPoolExecutor(allowed_threads()) as pool:
        return list(pool.map(work, items))
