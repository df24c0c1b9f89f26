"""Commands about one session, or one pair of them."""

# ruff: noqa: PLC0415 - heavy imports stand inside the commands, so that --help and completion are instant
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from eval.cli.options import KindOfSite, OutFolder, Preset, Quiet, SetSettings
from eval.core.printing import echo, print_table, say, shown_warnings
from eval.core.progress import shown_progress

if TYPE_CHECKING:
    import pandas as pd

    from cdpipe.core.geometry import Float64Array
    from cdpipe.model.config import PipelineConfig


def describe(
    session: Annotated[Path, typer.Argument(help="session folder, or PLY scans with a TUM trajectory")],
    preset: Preset = "tunnelcd",
    settings: SetSettings = None,
    quiet: Quiet = False,
) -> None:
    """Compute a session's descriptors and store them beside it, as a robot would while mapping."""
    import cdpipe

    with shown_warnings():
        descriptors, path = cdpipe.describe(session, preset, settings or ())
    say(quiet, f"{path}: {len(descriptors.q)} keyframes, {descriptors.name} {descriptors.checkpoint}")


def detect(
    before: Annotated[Path, typer.Argument(help="session folder, or PLY scans with a TUM trajectory")],
    after: Annotated[Path, typer.Argument(help="the later session")],
    out: OutFolder,
    preset: Preset = "tunnelcd",
    site: KindOfSite = "narrow",
    settings: SetSettings = None,
    assume_aligned: Annotated[
        bool, typer.Option("--assume-aligned", help="both sessions are in one frame already: do not search the merge")
    ] = False,
    before_T_after: Annotated[
        Path | None,
        typer.Option("--before-T-after", metavar="FILE", help="known merge, 4x4 as text or JSON", show_default=False),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Find what changed between two sessions, simulated or recorded; needs no truth."""
    import cdpipe
    from cdpipe.core.errors import MergeFailedError
    from cdpipe.mapping.session_check import is_same_session
    from eval.core.output import new_folder

    config = cdpipe.load_config(preset, settings or (), site)
    known = _read_known_merge(before_T_after, assume_aligned=assume_aligned)
    if is_same_session(cdpipe.open_session(before), cdpipe.open_session(after)):
        same = f"{before} and {after} are one and the same recording: nothing can have changed between them"
        echo(f"note: {same}", err=True)
    try:
        with shown_warnings(), new_folder(out) as partial, shown_progress(quiet) as progress:
            report = cdpipe.detect(before, after, preset, settings or (), site, cdpipe.Hooks(progress.stage), known)
            cdpipe.save_report(report, partial, preset)
    except MergeFailedError as error:
        if not quiet:
            print_table("merge: refused", _evidence_table(error.evidence, config))
        raise
    if quiet:
        return
    verdict = "accepted" if known is None else "known, not judged"
    print_table(f"merge: {verdict}", _evidence_table(report.evidence, config))
    print_table("regions (map frame = the before session's odometry)", report.to_pandas("regions"))
    if not report.regions.is_reported.any():
        scores = report.regions.scores
        echo(
            f"nothing reaches query.threshold = {config.query.threshold:g}; "
            f"the best of {len(scores)} candidates scores {max(scores.tolist(), default=0.0):.4g}; "
            "--set query.n_regions=3 reports the best three whatever they score",
            "",
        )
    objects = report.to_pandas("objects")
    print_table("objects", objects[[name for name in objects.columns if not name.startswith(("min_", "max_", "box_"))]])
    times = ", ".join(f"{name[2:-2]} {seconds:.3f} s" for name, seconds in report.seconds.items())
    echo(f"{out}: answer.json, answer.npz, regions.csv, objects.csv, objects.ply ({times})")


def _read_known_merge(path: Path | None, *, assume_aligned: bool) -> Float64Array | None:
    import numpy as np

    from cdpipe.core.errors import InputError
    from cdpipe.io.known_merge import read_known_merge

    if path is None:
        return np.eye(4) if assume_aligned else None
    if assume_aligned:
        raise InputError(f"--before-T-after {path}: --assume-aligned says another merge: give one of them")
    return read_known_merge(path)


def _evidence_table(evidence: Mapping[str, float], config: PipelineConfig) -> pd.DataFrame:
    """Return one row per figure that a merge measured: what it is, from where on it is accepted, and whether it is."""
    import numpy as np
    import pandas as pd

    from cdpipe.merge.evidence import GATES

    gates = {name: (f"merge.{setting}", getattr(config.merge, setting)) for name, setting in GATES}
    rows = []
    for name, value in evidence.items():
        if name.startswith("map_points_"):
            continue
        setting, least = gates.get(name, ("", np.nan))
        is_judged = name in gates and "is_known" not in evidence
        passed = "-" if not is_judged else ("yes" if value >= least else "no")
        rows.append((name, float(value), least, passed, setting))
    return pd.DataFrame(rows, columns=["evidence", "measured", "at least", "passed", "setting"])
