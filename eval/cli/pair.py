"""Commands about one session, or one pair of them."""

# ruff: noqa: PLC0415 - heavy imports stand inside the commands, so that --help and completion are instant
from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from eval.cli.options import KindOfSite, OutFolder, Preset, Quiet, SetSettings
from eval.core.printing import print_table, say
from eval.core.progress import shown_progress


def describe(
    session: Annotated[Path, typer.Argument(help="session folder, or PLY scans with a TUM trajectory")],
    preset: Preset = "tunnelcd",
    settings: SetSettings = None,
    quiet: Quiet = False,
) -> None:
    """Compute a session's descriptors and store them beside it, as a robot would while mapping."""
    from cdpipe.model.config import load_config
    from eval.running.single import describe_session

    descriptors, path = describe_session(session, load_config(preset, settings or ()))
    say(quiet, f"{path}: {len(descriptors.q)} keyframes, {descriptors.name} {descriptors.checkpoint}")


def detect(
    before: Annotated[Path, typer.Argument(help="session folder, or PLY scans with a TUM trajectory")],
    after: Annotated[Path, typer.Argument(help="the later session")],
    out: OutFolder,
    preset: Preset = "tunnelcd",
    site: KindOfSite = "narrow",
    settings: SetSettings = None,
    quiet: Quiet = False,
) -> None:
    """Find what changed between two sessions, simulated or recorded; needs no truth."""
    from cdpipe.core.errors import MergeFailedError
    from cdpipe.model.config import load_config
    from eval.core.output import new_folder
    from eval.running.single import detect_pair, evidence_table, notes_on, object_table, region_table, write_detection

    config = load_config(preset, settings or (), site)
    for note in notes_on(before, after):
        typer.echo(f"note: {note}", err=True)
    try:
        with new_folder(out) as partial, shown_progress(quiet) as progress:
            report = detect_pair(before, after, config, progress.stage)
            write_detection(partial, preset, report)
    except MergeFailedError as error:
        if not quiet:
            print_table("merge: refused", evidence_table(error.evidence, config))
        raise
    if quiet:
        return
    print_table("merge: accepted", evidence_table(report.evidence, config))
    print_table("regions (map frame = the before session's odometry)", region_table(report))
    if not report.regions.is_reported.any():
        scores = report.regions.scores
        typer.echo(
            f"nothing reaches query.threshold = {config.query.threshold:g}; "
            f"the best of {len(scores)} candidates scores {scores[:1].max(initial=0.0):.4g}; "
            "--set query.n_regions=3 reports the best three whatever they score\n"
        )
    objects = object_table(report)
    print_table("objects", objects[[name for name in objects.columns if not name.startswith(("min_", "max_", "box_"))]])
    times = ", ".join(f"{name[2:-2]} {seconds:.3f} s" for name, seconds in report.seconds.items())
    typer.echo(f"{out}: answer.json, answer.npz, regions.csv, objects.csv, objects.ply ({times})")
