"""The cells of a plan: each of its variants on each seed of each world."""

from __future__ import annotations

from cdpipe.core.errors import InputError
from eval.plans.plan import Plan, list_methods
from eval.plans.variants import Cell


def expand_cells(plan: Plan) -> list[Cell]:
    """Return all cells: by scenario, then seed, then variant, grids last.

    Raises:
        InputError: The settings of a variant contradict each other or its preset.
    """
    found: list[Cell] = []
    mistakes: list[str] = []
    for world in plan.worlds:
        methods = []
        for method in list_methods(plan, world):
            try:
                methods.append((method, method.config()))
            except InputError as error:
                mistakes += str(error).split("\n")
        found += [
            method.cell(world, seed, config, plan.until)
            for seed in plan.seeds[: world.n_seeds]
            for method, config in methods
        ]
    if mistakes:
        raise InputError("\n".join(dict.fromkeys(mistakes)))
    return found


def list_planned_cases(plan: Plan) -> set[tuple[str, int, str]]:
    """Return (scenario, seed, variant) of all cells."""
    return {
        (world.label, seed, method.variant)
        for world in plan.worlds
        for method in list_methods(plan, world)
        for seed in plan.seeds[: world.n_seeds]
    }
