"""One answer as the command line prints it: tables of at most 80 columns, and one sentence at the end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from eval.core.terminal.printing import LINE, echo, echo_wrapped, print_table

if TYPE_CHECKING:
    from cdpipe.model.report import ChangeReport


# the seconds of an answer in the order of the stages
_STAGES = {
    "t_descriptor_s": "descriptors", "t_index_s": "indexing", "t_merge_s": "merge", "t_refine_s": "refinement",
    "t_cd_s": "regions", "t_oe_s": "objects", "t_returns_s": "of it returns", "t_surface_s": "rock",
}  # fmt: skip


def print_answer(report: ChangeReport, out: Path, files: Sequence[str], threshold: float) -> None:
    """Print the regions, the objects and the rock of an answer, its files in `out`, and the sentence about it."""
    from eval.report.answer.tables import (  # noqa: PLC0415 - --help and completion are instant
        tabulate_objects,
        tabulate_regions,
        tabulate_rock,
    )

    regions = report.regions
    print_table("regions (map frame = the before session's odometry)", tabulate_regions(report), LINE)
    if regions.is_proposed.any() and not regions.is_reported.any():
        echo("every region is withdrawn: none holds an object of its own", "")
    elif not regions.is_reported.any():
        echo_wrapped(
            f"nothing reaches query.threshold = {threshold:g}; "
            f"the best of {len(regions.scores)} candidates scores {max(regions.scores.tolist(), default=0.0):.4g}; "
            "--set query.n_regions=3 reports the best three whatever they score",
            LINE,
        )
        echo("")
    print_table("objects", tabulate_objects(report), LINE)
    if report.surface is not None:
        print_table("rock that moved, mm (positive: into the void)", tabulate_rock(report.surface), LINE)
    names = [name for name in dict.fromkeys([*_STAGES, *report.seconds]) if name in report.seconds]
    times = ", ".join(f"{_STAGES.get(name, name)} {report.seconds[name]:.3f} s" for name in names)
    echo_wrapped(f"times: {times}", LINE)
    echo_wrapped(f"{out}: {', '.join(files)}", LINE)
    echo(str(report))
