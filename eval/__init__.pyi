from .plans.plan import load_plan
from .report.page import write_page
from .report.plot import plot
from .running.predictions import evaluate
from .running.runner import run_plan
from .scoring.scoring import score

__all__ = ["evaluate", "load_plan", "plot", "run_plan", "score", "write_page"]
