"""The tables of a run and of a comparison, as the command line prints them."""

# ruff: noqa: PLC0415 - heavy imports stand inside the functions, so that --help and completion are instant
from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from eval.core.printing import MET, echo, print_table

if TYPE_CHECKING:
    from eval.report.comparison import Comparison

_SHOWN = (
    "region_recall", "region_precision", "region_recall_at_k", "n_regions", "object_iou_point", "object_f1_25",
    "merge_error_m", "t_total_s",
)  # fmt: skip
_MAX_LINES = 60


def print_results(folder: Path, quiet: bool) -> None:
    """Print means over pairs, and the tables that the plan of a run asks for."""
    if quiet:
        return
    import pandas as pd

    from eval.plans.coverage import measure_coverage
    from eval.plans.targets import read_targets
    from eval.running.predictions import list_incomplete_variants
    from eval.running.runfolder import RunFolder
    from eval.tables.merge_table import merge_overview

    results = pd.read_csv(folder / "results.csv")
    groups = results.groupby(["scenario", "variant"], sort=False)
    counts = groups["status"].agg(n="size", n_failed=lambda status: (status != "ok").sum())
    # a run that ends at the merge has nothing in the columns of what comes later
    shown = [name for name in _SHOWN if name in results.columns and results[name].notna().any()]
    print_table("means over pairs", counts.join(groups[shown].mean()).reset_index())
    cases = zip(results["scenario"], results["seed"].astype(int), results["variant"], strict=True)
    provenance = RunFolder(folder).stored_provenance()
    covered = measure_coverage(provenance, cases)
    targets = merge_overview(results, read_targets(provenance), is_whole=covered.is_whole)
    if not covered.is_whole:
        echo(covered.sentence, "")
    if len(targets):
        print_table("merge: share of the pairs within the target of their kind, with its 95 % interval", targets)
    for line in list_incomplete_variants(provenance, results):
        echo(f"note: {line}", "")
    if (folder / "regions_table.csv").is_file():
        _region_results(folder)
    if (folder / "objects_table.csv").is_file():
        _object_results(folder)


def _region_results(folder: Path) -> None:
    import pandas as pd

    from eval.tables.region_table import region_overview

    print_table(
        "regions: means over pairs, in and out of distribution; recall@0.1 is at 0.1 false regions per 100 m",
        region_overview(pd.read_csv(folder / "regions_table.csv")),
    )
    _targets(folder, "regions")


def _object_results(folder: Path) -> None:
    import pandas as pd

    from eval.tables.groups import group_overview
    from eval.tables.object_table import object_overview

    table = pd.read_csv(folder / "objects_table.csv")
    print_table(
        "objects: means over pairs, missed ones 0; matched: median IoU of those matched; moved_m, pile_vol: median "
        "error; recall and false regions per 100 m as proposed, and after withdrawal; seconds per proposed region",
        object_overview(table),
    )
    if (folder / "objects_by_group.csv").is_file():
        groups = group_overview(pd.read_csv(folder / "objects_by_group.csv"), str(table["variant"].iloc[0]))
        print_table(f"objects of {table['variant'].iloc[0]}, by kind of prop and by hull; volume: median error", groups)
    _targets(folder, "objects")


def print_comparison(found: Comparison) -> None:
    """Print what moved between two runs, and the sentences about it."""
    from eval.report.comparison import MOVED, overview, sentences

    table = overview(found.table)
    title = f"A: {found.names[0]}; B: {found.names[1]}; means over session pairs, B - A pair by pair"
    if len(table) > _MAX_LINES:
        title += f"; {len(table)} figures compared, those that moved"
        table = table[table["B is"].isin(MOVED)]
    if len(table):
        print_table(title, table)
    for line in sentences(found):
        echo(line)


def _targets(folder: Path, subject: str) -> None:
    import pandas as pd

    path = folder / f"{subject}_targets.csv"
    if path.is_file():
        targets = pd.read_csv(path)
        met = [MET[None if pd.isna(value) else bool(value)] for value in targets["is_met"]]
        print_table(f"{subject}: what is asked", targets.drop(columns="is_met").assign(met=met))
