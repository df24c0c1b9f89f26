"""Axes of difficulty: one thing at a time made harder in steps, all else as in the plan's first scenario.

axes:
  - name: size of the objects
    unit: m
    steps:                                               # easiest first
      - {value: 1, set: "props.change.size_m=[1, 1, 1]"}   # a setting of the world
      - {value: 0.6}                                     # the scenario as it is
  - name: keyframe distance
    unit: m
    steps: [{value: 1}, {value: 4, method: map.keyframe_spacing_m=4}]  # a setting of every method
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated

from pydantic import Field, model_validator

from cdpipe.core.yamlfile import Settings
from eval.plans.parts import MethodSettings
from eval.plans.worlds import ScenarioItem, World, WorldSettings


class Step(Settings):
    """One step of an axis: its value, and the settings of the world or of every method that make it."""

    value: float | str
    set: WorldSettings = ()
    method: MethodSettings = ()

    @model_validator(mode="after")
    def _is_of_one_kind(self) -> Step:
        if self.set and self.method:
            raise ValueError("expected set, a setting of the world, or method, a setting of every method: not both")
        return self


class Axis(Settings):
    """Steps in the order of their difficulty."""

    name: Annotated[str, Field(min_length=1, max_length=60)]
    unit: Annotated[str, Field(max_length=20)] = ""
    steps: Annotated[tuple[Step, ...], Field(min_length=2, max_length=20)]

    @model_validator(mode="after")
    def _steps_differ(self) -> Axis:
        values = [step.value for step in self.steps]
        if len(set(values)) < len(values):
            raise ValueError(f"axis {self.name!r}: expected every value once")
        made = [(step.set, step.method) for step in self.steps]
        if len(set(made)) < len(made):
            raise ValueError(f"axis {self.name!r}: two steps set the same: expected settings of its own for each")
        return self


def harder_item(item: ScenarioItem, axes: Iterable[Axis]) -> ScenarioItem:
    """Return an item of a plan with a world more for every step that sets something in the world."""
    steps = dict.fromkeys(step.set for axis in axes for step in axis.steps if step.set)
    return item.model_copy(update={"each": (*item.each, *(own for own in steps if own not in item.each))})


def world_of_step(base: World, step: Step) -> str:
    """Return the label of the world of a step."""
    return World(base.name, base.common, step.set, base.pair_kind, base.n_seeds, base.odometry).label


def method_steps(axes: Iterable[Axis]) -> list[tuple[str, ...]]:
    """Return the settings of every step that is one of the methods'."""
    return list(dict.fromkeys(step.method for axis in axes for step in axis.steps if step.method))
