"""Reference rows for the pairs of an evaluation: of the run itself, and of the committed report of its plan."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from cdpipe.core.errors import InputError
from cdpipe.core.names import path_part
from eval.core.tablefile import table_file
from eval.running.results.run_data import RunData, read_run
from eval.running.results.sides import list_versions
from eval.scoring.scoring import METRICS_VERSION

REPORTS = Path(__file__).parents[2] / "reports"
"""The committed reports: beside the packages in a checkout, and nowhere where the package is installed alone."""


def find_reference(plan: str, folder: Path | None) -> RunData | None:
    """Read the reference results of a plan.

    Args:
        plan: Name of the plan.
        folder: A run folder or a report, or a folder that holds one called like the plan; None for the committed one.

    Returns:
        The tables; None without `folder` where there are none, or none of the present metrics.

    Raises:
        InputError: `folder` holds no results, or those of another metrics version.
    """
    own = [plan] if path_part(plan) == plan else []  # the name may come from a file of others
    places = [REPORTS / name for name in own] if folder is None else [folder, *(folder / name for name in own)]
    found = next((place for place in places if table_file(place / "results.csv").exists()), None)
    if found is None:
        if folder is None:
            return None
        raise InputError(f"--reference {folder}: holds no results.csv, nor {plan}/results.csv: name a run or a report")
    data = read_run(found)
    others = list_versions(data.results) - {str(METRICS_VERSION)}
    if not others:
        return data
    if folder is None:
        return None
    told = " and ".join(sorted(others))
    raise InputError(f"--reference {found}: has rows of metrics version {told}, these are of {METRICS_VERSION}")


def take_other_methods(data: RunData, name: str) -> RunData:
    """Return a run without the rows of one method."""
    return replace(data, results=tuple(row for row in data.results if row["variant"] != name))
