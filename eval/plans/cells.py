"""The cells of a plan: each of its variants on each seed of each world."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from cdpipe.core.errors import InputError
from cdpipe.model.config import PipelineConfig, explain_idle_setting, list_idle_settings
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
    mistakes += _find_idle_settings(every)
    if mistakes:
        raise InputError("\n".join(dict.fromkeys(mistakes)))
    return found


def _find_idle_settings(methods: Sequence[tuple[Method, PipelineConfig]]) -> Iterator[str]:
    """Yield a line on each setting that no method of a plan reads: one `set` is for all of them."""
    sources: dict[str, list[str]] = {}
    read: set[str] = set()
    for method, config in methods:
        given = (*method.shared, *method.named, *method.silent)
        idle = list_idle_settings(config, given)
        read.update(each for each in given if each not in idle)
        for setting in idle:
            sources.setdefault(setting, []).append(config.regions.source)
    yield from (explain_idle_setting(setting, own) for setting, own in sources.items() if setting not in read)


def list_planned_cases(plan: Plan) -> set[tuple[str, int, str]]:
    """Return (scenario, seed, variant) of all cells."""
    return {
        (world.label, seed, method.variant)
        for world in plan.worlds
        for method in list_methods(plan, world)
        for seed in plan.seeds[: world.n_seeds]
    }
