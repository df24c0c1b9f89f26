"""`tunnelcd trace`: a mesh of a mine becomes a scenario with nodes, drifts, a route and a picture."""

# ruff: noqa: PLC0415 - heavy imports stand inside the functions, so that --help and completion are instant
from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Literal

import typer

from eval.cli.options import Quiet
from eval.core.terminal.printing import say, warn
from eval.core.terminal.progress import shown_progress


def trace(
    mesh: Annotated[Path, typer.Argument(metavar="MESH", help="tunnel walls: .stl, .obj, .ply or .glb")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE.yaml", help="new scenario", show_default=False)],
    units: Annotated[
        Literal["m", "cm", "mm", "in", "ft"] | None, typer.Option(help="of the file; m if left out", show_default=False)
    ] = None,
    up: Annotated[
        Literal["x", "y", "z"] | None,
        typer.Option(help="axis of the file that points up; left out: y of a .glb, else z", show_default=False),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="FILE.png", help="plan and long sections; left out: beside --out", show_default=False),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Find the centrelines of a tunnel mesh and write a scenario along them: nodes, drifts, routes, one added box."""
    from cdpipe.core.whole_file import whole_file
    from eval.core.output import made_parents, make_writable, unwritable
    from scenarios.schema import MeshFile
    from sim.trace import draft_scenario, format_scenario, save_picture, trace_mesh

    picture = _refuse_names(mesh, out, picture)
    file = MeshFile(path=str(mesh), units=units or "m", up=up or ("y" if mesh.suffix.lower() == ".glb" else "z"))
    with made_parents(out), made_parents(picture), shown_progress(quiet) as progress:
        for path in (out, picture):
            make_writable(path.absolute().parent)
        found = trace_mesh(
            file,
            is_sure_of_units=units is not None,
            is_sure_of_up=up is not None,
            on_progress=progress.stage,
        )
        draft = draft_scenario(found, progress.stage)
        text = format_scenario(draft, found, out.absolute().parent)
        try:
            with whole_file(picture) as partial_picture:
                save_picture(found, partial_picture)
                with whole_file(out) as partial:
                    partial.write_text(text, encoding="utf-8")
        except OSError as error:
            raise unwritable(Path(error.filename2 or error.filename or picture), error) from error
    for note in found.notes:
        warn(f"{mesh}: {note}")
    if draft.trouble:
        warn(f"{out}: the example could not be driven: {draft.trouble}")
    widths = sorted(drift.width_m for drift in found.drifts)
    say(
        quiet,
        f"{out}: {found.length_m:.0f} m of drift, {widths[0]:.1f} to {widths[-1]:.1f} m wide, "
        f"{len(found.nodes)} nodes, a route from {draft.route[0]} to {draft.route[-1]}; look at {picture}, "
        f"then run tunnelcd simulate {shlex.quote(str(out))} --out pair",
    )


def _refuse_names(mesh: Path, out: Path, picture: Path | None) -> Path:
    """Refuse names before the work begins; return the name of the picture.

    Raises:
        InputError: A name has another suffix than it must have, stands for something that exists, or is not UTF-8 and
            so cannot stand in a scenario.
    """
    from cdpipe.core.errors import InputError
    from scenarios.library import SUFFIXES

    if out.suffix not in SUFFIXES:
        raise InputError(f"--out {out}: a scenario is a .yaml file: name a new one")
    picture = picture or out.with_suffix(".png")
    if picture.suffix.lower() != ".png":
        raise InputError(f"--picture {picture}: the picture is a PNG: name a new .png file")
    if mesh.is_dir():
        raise InputError(f"{mesh}: is a folder: name the mesh, a .stl, .obj, .ply or .glb file")
    for option, path in (("--out", out), ("--picture", picture)):
        if path.exists() or path.is_symlink():
            raise InputError(f"{option} {path}: exists: name a new file, or remove this one")
    try:
        str(mesh).encode()
    except UnicodeEncodeError as error:
        raise InputError(f"{mesh}: its name is not UTF-8, and no scenario could hold it: rename the file") from error
    return picture
