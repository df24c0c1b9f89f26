from .changes import changed_plan
from .files import plan_names
from .plan import Plan, cells, load_plan, parse_seeds
from .variants import Cell

__all__ = [
    "Cell",
    "Plan",
    "cells",
    "changed_plan",
    "load_plan",
    "parse_seeds",
    "plan_names",
]
