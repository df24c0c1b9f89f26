"""Hooks around the stages, and what a stage returns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Generic, Literal, TypeVar

from cdpipe.core.progress import Progress, report_nothing
from cdpipe.model.config import PipelineConfig

T = TypeVar("T")
Stage = Literal["maps", "descriptors", "spheres", "merge", "regions"]


@dataclass(frozen=True, slots=True, eq=False)
class Done(Generic[T]):
    """The result of a stage, and the wall-clock seconds of its parts by name."""

    value: T
    seconds: Mapping[str, float] = field(default_factory=dict)


class Hooks:
    """Hooks around the stages. Here each stage runs once; override `run` to cache results, `time` to repeat a step.

    Args:
        on_stage: Called before a stage with its name, the work done and the total work; while a session is mapped
            also with `stage: step`, and the scans done and in all.
    """

    def __init__(self, on_stage: Progress = report_nothing) -> None:
        self.on_stage = on_stage

    def run(self, stage: Stage, config: PipelineConfig, compute: Callable[[], Done[T]]) -> Done[T]:
        """Return the result of a stage that depends only on the sessions and the settings."""
        return compute()

    def time(self, compute: Callable[[], Done[T]]) -> Done[T]:
        """Return the result of a step that is not cached."""
        return compute()
