from .cluster import HERE, Where
from .domains import domain_of, is_change_in_distribution
from .output import make_writable, new_folder
from .provenance import git_commit
from .statistics import bootstrap_interval, mean_with_interval, summarise, wilson_interval
from .terminal.exits import run_program
from .terminal.progress import RunProgress, Silent, shown_progress

__all__ = [
    "HERE",
    "RunProgress",
    "Silent",
    "Where",
    "bootstrap_interval",
    "domain_of",
    "git_commit",
    "is_change_in_distribution",
    "make_writable",
    "mean_with_interval",
    "new_folder",
    "run_program",
    "shown_progress",
    "summarise",
    "wilson_interval",
]
