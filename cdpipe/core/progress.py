"""Progress of long work: what is called with it, and what does nothing with it."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Takes the name of a stage, the work done and the total work."""


def report_nothing(stage: str, done: int, total: int) -> None:
    """Do nothing with progress."""
