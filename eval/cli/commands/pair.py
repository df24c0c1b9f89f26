"""Commands about one session, or one pair of them."""

# ruff: noqa: PLC0415 - heavy imports stand inside the commands, so that --help and completion are instant
from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cdpipe.core.progress import Progress
from eval.cli.inputs import (
    RECORDING,
    Deskew,
    Format,
    Metadata,
    Odometry,
    Origin,
    Topics,
    Trajectories,
    how_to_read,
    open_inputs,
    open_sources,
    with_surface,
)
from eval.cli.options import KindOfSite, OutFolder, Preset, Quiet, SetSettings, require_method_settings
from eval.cli.printed_answer import print_answer
from eval.core.terminal.printing import LINE, echo, print_table, say, shown_warnings
from eval.core.terminal.progress import shown_progress

if TYPE_CHECKING:
    import pandas as pd

    from cdpipe.core.geometry import Float64Array
    from cdpipe.model.config import PipelineConfig
    from cdpipe.model.report import ChangeReport, SurfaceField
    from cdpipe.model.types import ScanSource


def describe(
    session: Annotated[Path, typer.Argument(help=RECORDING)],
    preset: Preset = "tunnelcd",
    settings: SetSettings = None,
    form: Format = None,
    topics: Topics = None,
    trajectory: Trajectories = None,
    odometry: Odometry = None,
    metadata: Metadata = None,
    deskew: Deskew = True,
    origin: Origin = None,
    quiet: Quiet = False,
) -> None:
    """Compute a session's descriptors and store them beside it, as a robot would while mapping."""
    import cdpipe

    require_method_settings(settings)
    hows = how_to_read(1, form, topics, trajectory, odometry, metadata, deskew=deskew, origin=origin)
    with shown_warnings(), shown_progress(quiet) as progress:
        (source,) = open_inputs([session], hows, progress)
        descriptors, path = cdpipe.describe(source, preset, settings or ())
    say(quiet, f"{path}: {len(descriptors.q)} keyframes, {descriptors.name} {descriptors.checkpoint}")


def detect(
    before: Annotated[Path, typer.Argument(help=RECORDING)],
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
    surface: Annotated[
        bool,
        typer.Option("--surface", help="measure how far the rock moved, too: surface.method=planes, unless it is set"),
    ] = False,
    html: Annotated[
        bool, typer.Option("--html", help="also write answer.html: the pair in 3-D and its objects, one offline page")
    ] = False,
    form: Format = None,
    topics: Topics = None,
    trajectory: Trajectories = None,
    odometry: Odometry = None,
    metadata: Metadata = None,
    deskew: Deskew = True,
    origin: Origin = None,
    quiet: Quiet = False,
) -> None:
    """Find what changed between two sessions, simulated or recorded; needs no truth."""
    import cdpipe
    from cdpipe.core.errors import MergeFailedError
    from cdpipe.mapping.session_check import is_same_session
    from cdpipe.model.config import require_settings_are_read
    from eval.core.output import new_folder

    require_method_settings(settings)
    settings = with_surface(preset, settings or [], site) if surface else settings or []
    config = cdpipe.load_config(preset, settings, site)
    hows = how_to_read(2, form, topics, trajectory, odometry, metadata, deskew=deskew, origin=origin)
    origins_m = [how.subtracted_m(path) for how, path in zip(hows, (before, after), strict=True)]
    known = _read_known_merge(before_T_after, origins_m, assume_aligned=assume_aligned)
    cdpipe.require_usable(config, is_merge_known=known is not None)  # before hours of reading
    require_settings_are_read(config, settings)
    try:
        with shown_warnings(), new_folder(out) as partial, shown_progress(quiet) as progress:
            earlier, later = open_inputs([before, after], hows, progress)
            if is_same_session(*open_sources(earlier, later)):
                same = f"{before} and {after} are one and the same recording: nothing can have changed between them"
                echo(f"note: {same}", err=True)
            report = cdpipe.detect(earlier, later, preset, settings, site, cdpipe.Hooks(progress.stage), known)
            cdpipe.save_report(report, partial, preset)
            if report.surface is not None:
                _draw_surface(report.surface, partial / "surface.png")
            if html:
                _write_page(open_sources(earlier, later), preset, report, partial / "answer.html", progress.stage)
    except MergeFailedError as error:
        if not quiet:
            print_table("merge: refused", _evidence_table(error.evidence, config), LINE)
        raise
    if quiet:
        return
    verdict = "accepted" if known is None else "known, not judged"
    print_table(f"merge: {verdict}", _evidence_table(report.evidence, config), LINE)
    files = ["answer.json", "answer.npz", "regions.csv", "objects.csv", "objects.ply"]
    files += [] if report.surface is None else ["surface.csv", "surface.columns.txt", "surface.ply", "surface.png"]
    print_answer(report, out, [*files, *(["answer.html"] if html else [])], config.query.threshold)


def _write_page(
    sessions: Sequence[ScanSource],
    method: str,
    report: ChangeReport,
    file: Path,
    on_stage: Progress,
) -> None:
    from eval.report.answer.content import gather_content
    from eval.report.answer.page import write_answer_page

    before, after = sessions
    write_answer_page(gather_content((before, after), method, report, on_stage), file)


def _draw_surface(surface: SurfaceField, path: Path) -> None:
    """Write the unrolled tunnel as a picture: chainage against angle, coloured by displacement."""
    import numpy as np

    from eval.core.figures import png
    from eval.report.surface.unrolled import draw_panels

    if surface.chainage_m is None or surface.angle_deg is None:
        return
    moved_m = np.abs(surface.displacement_m[surface.region >= 0])
    panels = [("displacement of the rock", surface.displacement_m)]
    figure, _ = draw_panels(panels, surface.chainage_m, surface.angle_deg, moved_m[np.isfinite(moved_m)])
    path.write_bytes(png(figure))


def _read_known_merge(
    path: Path | None, origins_m: Sequence[tuple[float, float, float]], *, assume_aligned: bool
) -> Float64Array | None:
    import numpy as np

    from cdpipe.core.errors import InputError
    from cdpipe.io.known_merge import read_known_merge

    if path is None:
        return np.eye(4) if assume_aligned else None
    if assume_aligned:
        raise InputError(f"--before-T-after {path}: --assume-aligned says another merge: give one of them")
    return read_known_merge(path, origins_m)


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
