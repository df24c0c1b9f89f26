"""Commands about one session, or one pair of them."""

# ruff: noqa: PLC0415 - heavy imports stand inside the commands, so that --help and completion are instant
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from eval.cli.inputs import (
    RECORDING,
    Deskew,
    Format,
    Metadata,
    Odometry,
    Topics,
    Trajectories,
    how_to_read,
    open_inputs,
    open_sources,
)
from eval.cli.options import KindOfSite, OutFolder, Preset, Quiet, SetSettings
from eval.core.printing import echo, print_table, say, shown_warnings
from eval.core.progress import shown_progress

if TYPE_CHECKING:
    import pandas as pd

    from cdpipe.core.geometry import Float64Array
    from cdpipe.model.config import PipelineConfig
    from cdpipe.model.report import SurfaceField


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
    quiet: Quiet = False,
) -> None:
    """Compute a session's descriptors and store them beside it, as a robot would while mapping."""
    import cdpipe

    hows = how_to_read(1, form, topics, trajectory, odometry, metadata, deskew=deskew)
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
        bool, typer.Option("--surface", help="measure how far the rock moved, too (surface.method=planes)")
    ] = False,
    form: Format = None,
    topics: Topics = None,
    trajectory: Trajectories = None,
    odometry: Odometry = None,
    metadata: Metadata = None,
    deskew: Deskew = True,
    quiet: Quiet = False,
) -> None:
    """Find what changed between two sessions, simulated or recorded; needs no truth."""
    import cdpipe
    from cdpipe.core.errors import MergeFailedError
    from cdpipe.mapping.session_check import is_same_session
    from eval.core.output import new_folder

    settings = [*(["surface.method=planes"] if surface else []), *(settings or [])]
    config = cdpipe.load_config(preset, settings, site)
    known = _read_known_merge(before_T_after, assume_aligned=assume_aligned)
    hows = how_to_read(2, form, topics, trajectory, odometry, metadata, deskew=deskew)
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
    except MergeFailedError as error:
        if not quiet:
            print_table("merge: refused", _evidence_table(error.evidence, config))
        raise
    if quiet:
        return
    verdict = "accepted" if known is None else "known, not judged"
    print_table(f"merge: {verdict}", _evidence_table(report.evidence, config))
    print_table("regions (map frame = the before session's odometry)", report.to_pandas("regions"))
    if report.regions.is_proposed.any() and not report.regions.is_reported.any():
        echo("every region is withdrawn: none holds an object of its own", "")
    elif not report.regions.is_reported.any():
        scores = report.regions.scores
        echo(
            f"nothing reaches query.threshold = {config.query.threshold:g}; "
            f"the best of {len(scores)} candidates scores {max(scores.tolist(), default=0.0):.4g}; "
            "--set query.n_regions=3 reports the best three whatever they score",
            "",
        )
    objects = report.to_pandas("objects")
    print_table("objects", objects[[name for name in objects.columns if not name.startswith(("min_", "max_", "box_"))]])
    if report.surface is not None:
        print_table("rock that moved, mm (positive: into the void)", _surface_table(report.surface))
    times = ", ".join(f"{name[2:-2]} {seconds:.3f} s" for name, seconds in report.seconds.items())
    more = "" if report.surface is None else ", surface.csv, surface.ply, surface.png"
    echo(f"{out}: answer.json, answer.npz, regions.csv, objects.csv, objects.ply{more} ({times})")


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


def _surface_table(surface: SurfaceField) -> pd.DataFrame:
    import numpy as np
    import pandas as pd

    columns = ["region", "chainage_m", "angle_deg", "area_m2", "mean_mm", "largest_mm", "volume_m3"]
    rows = []
    for number, item in enumerate(surface.regions):
        own = surface.region == number
        places = [np.nan, np.nan]
        if surface.chainage_m is not None and surface.angle_deg is not None:
            turn = np.deg2rad(surface.angle_deg[own])
            angle_deg = np.rad2deg(np.arctan2(np.sin(turn).mean(), np.cos(turn).mean()))
            places = [float(np.median(surface.chainage_m[own])), float(angle_deg)]
        sizes = item.area_m2, 1000 * item.mean_m, 1000 * item.largest_m, item.volume_m3
        rows.append((number, *places, *sizes))
    return pd.DataFrame(rows, columns=columns)


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
