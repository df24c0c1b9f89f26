"""The cells of a plan: each of its variants on each seed of each world."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from cdpipe.core.errors import InputError
from cdpipe.model.config import (
    PipelineConfig,
    explain_idle_setting,
    explain_unread_setting,
    list_idle_settings,
    list_unread_settings,
)
from eval.plans.plan import Plan, list_methods
from eval.plans.variants import Cell, Method


def expand_cells(plan: Plan) -> list[Cell]:
    """Return all cells: by scenario, then seed, then variant, grids last.

    Raises:
        InputError: The settings of a variant contradict each other or its preset, or no method reads one of them.
    """
    found: list[Cell] = []
    every: list[tuple[Method, PipelineConfig]] = []
    mistakes: list[str] = []
    for world in plan.worlds:
        methods = []
        for method in list_methods(plan, world):
            try:
                methods.append((method, method.config()))
            except InputError as error:
                mistakes += str(error).split("\n")
        every += methods
        found += [
            method.cell(world, seed, config, plan.until)
            for seed in plan.seeds[: world.n_seeds]
            for method, config in methods
        ]
    idle = _find_settings(every, list_idle_settings)
    mistakes += (explain_idle_setting(each, [config.regions.source for config in own]) for each, own in idle.items())
    if mistakes:
        raise InputError("\n".join(dict.fromkeys(mistakes)))
    return found


def explain_unread_settings(plan: Plan) -> list[str]:
    """Return a line on each setting that the extraction of no method of a plan reads: it only makes equal rows.

    Raises:
        InputError: As `expand_cells`.
    """
    every = [(method, method.config()) for world in plan.worlds for method in list_methods(plan, world)]
    found = _find_settings(every, list_unread_settings)
    return [
        explain_unread_setting(setting, [config.extract.method for config in own]) for setting, own in found.items()
    ]


def _find_settings(
    methods: Sequence[tuple[Method, PipelineConfig]], list_of: Callable[[PipelineConfig, Sequence[str]], list[str]]
) -> dict[str, list[PipelineConfig]]:
    """Return the settings that no method of a plan reads, each with the methods: one `set` is for all of them."""
    found: dict[str, list[PipelineConfig]] = {}
    read: set[str] = set()
    for method, config in methods:
        given = (*method.shared, *method.named, *method.silent)
        idle = list_of(config, given)
        read.update(each for each in given if each not in idle)
        for setting in idle:
            found.setdefault(setting, []).append(config)
    return {setting: own for setting, own in found.items() if setting not in read}


def list_planned_cases(plan: Plan) -> set[tuple[str, int, str]]:
    """Return (scenario, seed, variant) of all cells."""
    return {
        (world.label, seed, method.variant)
        for world in plan.worlds
        for method in list_methods(plan, world)
        for seed in plan.seeds[: world.n_seeds]
    }
