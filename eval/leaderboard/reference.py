"""Reference rows for the pairs of an evaluation: of the run itself, and of the committed report of its plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from cdpipe.core.errors import InputError
from cdpipe.core.names import path_part
from eval.core.tablefile import table_file
from eval.core.terminal.printing import count_pairs
from eval.plans.splits import sealed_by, version_name
from eval.running.results.run_data import RunData, read_run
from eval.running.results.sides import list_versions
from eval.running.runfolder import RunFolder
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
    found = _find_folder(plan, folder)
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


def _find_folder(plan: str, folder: Path | None) -> Path | None:
    own = [plan] if path_part(plan) == plan else []  # the name may come from a file of others
    places = [REPORTS / name for name in own] if folder is None else [folder, *(folder / name for name in own)]
    return next((place for place in places if table_file(place / "results.csv").exists()), None)


def why_nothing_compares(
    plan: str, pairs: Sequence[tuple[str, int]], reference: RunData | None, run: Path, name: str
) -> str:
    """Say before an evaluation why there is no reference row of its pairs; "" where there is one.

    Args:
        plan: Name of the plan.
        pairs: (scenario, seed) of each pair.
        reference: What `find_reference` found.
        run: Folder of the evaluation: other methods in it are a reference, too.
        name: The method, whose own rows are none.
    """
    cells = RunFolder(run)
    own = {cells.cell(*pair, name) for pair in pairs}
    if any(set(path.parent.glob("*.json")) - {path} for path in own):
        return ""
    if reference is not None:
        held = {(row["scenario"], row["seed"]) for row in reference.results if row["variant"] != name}
        return "" if held.intersection(pairs) else f"nothing to compare with: {why_no_pair(reference, len(pairs))}"
    old = _find_folder(plan, None)
    told = f"plan {plan} has no reference results" if old is None else f"{old} is of another metrics version"
    return f"nothing to compare with: {told}: run the plan into {run}, or name a run or a report with --reference"


def why_no_pair(reference: RunData, n_pairs: int) -> str:
    """Say that a reference holds none of the pairs of an evaluation, and which pairs it holds."""
    plan = reference.provenance.get("plan")
    split = str(plan.get("split", "")) if isinstance(plan, Mapping) else ""
    version = split.removeprefix("sealed by ")
    if version == split:
        seeds = [row["seed"] for row in reference.results]
        told = f"of other worlds or seeds ({min(seeds)} to {max(seeds)})"
    else:
        told = f"of split sealed of {version}: evaluate with {_advise_split(version)}"
    return f"{reference.folder.path} holds none of these {count_pairs(n_pairs)}; its pairs are {told}"


def _advise_split(version: str) -> str:
    """Return the option that draws the seeds of a version, which only that version and later ones do."""
    if version == version_name():
        return "--split sealed"
    split = f"sealed:{version.rpartition(' ')[2]}"
    try:
        sealed_by(split)
    except InputError:
        return f"{version} and --split sealed"
    return f"--split {split}"


def take_other_methods(data: RunData, name: str) -> RunData:
    """Return a run without the rows of one method."""
    return replace(data, results=tuple(row for row in data.results if row["variant"] != name))
