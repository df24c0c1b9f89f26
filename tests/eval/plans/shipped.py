"""Shipped plans: each process checks and expands a plan once for all its tests, as this takes seconds."""

from __future__ import annotations

from functools import cache

from eval.plans.cells import expand_cells
from eval.plans.plan import Plan, load_plan
from eval.plans.variants import Cell


@cache
def plan_of(name: str) -> Plan:
    return load_plan(name)


@cache
def cells_of(name: str) -> tuple[Cell, ...]:
    return tuple(expand_cells(plan_of(name)))
