from .cells import expand_cells
from .changes import change_plan
from .files import plan_names
from .plan import Plan, load_plan
from .seeds import parse_seeds
from .variants import Cell

__all__ = [
    "Cell",
    "Plan",
    "change_plan",
    "expand_cells",
    "load_plan",
    "parse_seeds",
    "plan_names",
]
