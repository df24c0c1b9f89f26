"""`tunnelcd convert`: sessions, answers and worlds in formats of other tools; a recording becomes a session."""

# ruff: noqa: PLC0415 - heavy imports stand inside the functions, so that --help and completion are instant
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from eval.cli.inputs import (
    RECORDING,
    Deskew,
    Format,
    Metadata,
    Odometry,
    Origin,
    Topics,
    Trajectories,
    guess_formats,
    how_to_read,
    open_inputs,
    open_sources,
)
from eval.cli.options import OldWorldSettings, Quiet, WorldSettings, join_world_settings, world_mistakes
from eval.core.terminal.printing import say, shown_warnings
from eval.core.terminal.progress import RunProgress, shown_progress

if TYPE_CHECKING:
    from cdpipe.io.foreign import HowToRead

_FEW_SCANS = 10
_CELL_M = 0.05
_ANSWER = 3  # inputs of an answer's map: before, after, answer


def convert(
    sources: Annotated[
        list[Path],
        typer.Argument(metavar="SRC...", help=f"{RECORDING}; or BEFORE AFTER ANSWER; or a scenario, for a .glb"),
    ],
    out: Annotated[Path, typer.Argument(metavar="DST", help="new file, whose ending tells the format, or new folder")],
    to: Annotated[
        str | None, typer.Option("--to", metavar="NAME", help="format, where the ending does not tell (CONVERT.md)")
    ] = None,
    metadata: Metadata = None,
    trajectory: Trajectories = None,
    odometry: Odometry = None,
    form: Format = None,
    topics: Topics = None,
    deskew: Deskew = True,
    origin: Origin = None,
    with_truth: Annotated[
        bool, typer.Option("--with-truth/--without-truth", help="the truth of a simulated session leaves, too")
    ] = False,
    cell: Annotated[
        float | None,
        typer.Option(min=0.01, max=1000, help="one point per cell of a map, metres", show_default=str(_CELL_M)),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="seed of a scenario; 0 if left out", show_default=False)
    ] = None,
    world: WorldSettings = None,
    settings: OldWorldSettings = None,
    quiet: Quiet = False,
) -> None:
    """Convert a session, an answer or a world to a format of other tools; or a recording to a session.

    DST ends in .osf .pcap .mcap .bag .tum .kitti .laz .las .ply .rrd or .glb, or is a folder: of PCD files, or what
    --to says (ros2, semantic-kitti). A recording and a folder: an OSF or PCAP becomes a session folder, any other
    format deskewed PLY scans with a TUM trajectory, which `detect` takes as a session.

    BEFORE AFTER ANSWER become one map with scalar fields, .laz or .ply. A scenario becomes a .glb.
    """
    from cdpipe.core.errors import InputError

    if len(sources) not in (1, _ANSWER):
        raise InputError(f"{len(sources)} inputs: expected one, or BEFORE AFTER ANSWER, and then the output")
    if out.is_file():  # before hours of reading
        raise InputError(f"{out} exists already: name a new file or remove it")
    if out.is_dir() and any(out.iterdir()):
        raise InputError(f"{out}: is not empty: name a new or empty folder for the output")
    _refuse_cell(cell, sources, out, to)
    cell_m = _CELL_M if cell is None else cell
    asked = join_world_settings(world, settings)
    hows = how_to_read(min(len(sources), 2), form, topics, trajectory, odometry, metadata, deskew=deskew, origin=origin)
    with shown_warnings(), shown_progress(quiet) as progress:
        if len(sources) == _ANSWER:
            _refuse_truth(sources[-1], with_truth)
            _refuse_world(sources[-1], seed, asked)
            say(quiet, _convert_answer(sources, out, to, hows, cell_m, progress))
            return
        source = sources[0]
        if _is_world(source, out, to):
            for how in hows:
                how.require_nothing(source, "a world has no recording to read")
            with world_mistakes():
                say(quiet, _convert_world(source, out, to, seed, asked, with_truth=with_truth))
            return
        _refuse_world(source, seed, asked)
        if _is_session(source, hows[0]):
            say(quiet, _export(source, out, to, None, progress, cell_m, with_truth=with_truth))
            return
        (name,) = guess_formats([source], hows)
        _refuse_truth(source, with_truth)
        if out.suffix or to is not None:
            _refuse_format(source, name, out, to)
            say(quiet, _export(source, out, to, hows[0], progress, cell_m, with_truth=False))
        else:
            say(quiet, _import(source, out, name, hows[0], progress))


def _refuse_cell(cell: float | None, sources: Sequence[Path], out: Path, to: str | None) -> None:
    """Raise `InputError` if the edge of cells is given and no map is written."""
    from cdpipe.core.errors import InputError
    from eval.converting.formats import FORMATS, choose_format

    is_map = len(sources) == _ANSWER or ((out.suffix or to is not None) and FORMATS[choose_format(out, to)].is_map)
    if cell is not None and not is_map:
        raise InputError(f"{out}: --cell {cell:g} is of maps (.laz, .las, .ply): leave it out")


def _refuse_truth(source: Path, with_truth: bool) -> None:
    from cdpipe.core.errors import InputError

    if with_truth:
        raise InputError(f"{source}: a recording has no truth: leave --with-truth out")


def _refuse_format(source: Path, name: str, out: Path, to: str | None) -> None:
    """Raise `InputError` if a recording holds too little for the format that is asked for.

    Sessions of ours alone become some; and a single file of a format that holds scans one a file becomes a map alone.
    """
    from cdpipe.core.errors import InputError
    from cdpipe.io.foreign.sniff import FORMATS as RECORDINGS
    from cdpipe.io.foreign.sniff import OUSTER
    from eval.converting.formats import FORMATS, choose_format, endings_of_recordings

    form = FORMATS[choose_format(out, to)]
    if RECORDINGS[name].in_folders and not source.is_dir() and not form.is_map:
        raise InputError(f"{source}: a map without its scans has no poses or times: name a new .laz or .ply")
    if form.is_ours_alone and name in OUSTER:
        way = f"make one of it first, `tunnelcd convert {source} FOLDER`"
        raise InputError(f"{source}: only a session folder becomes {form.about}: {way}")
    if form.is_ours_alone:
        way = f"name a new file that ends in {', '.join(endings_of_recordings())}"
        raise InputError(f"{source}: {form.about} needs the columns of an Ouster, and these are bare points: {way}")


def _refuse_world(source: Path, seed: int | None, settings: Sequence[str]) -> None:
    from cdpipe.core.errors import InputError

    if seed is not None or settings:
        raise InputError(f"{source}: a session holds what was recorded: leave --seed and --world out")


def _is_world(source: Path, out: Path, to: str | None) -> bool:
    """Return whether a GLB is asked for, or what is named is a scenario and no file or folder of recordings."""
    from eval.converting.formats import FORMATS
    from scenarios import scenario_names

    is_scenario = not source.is_dir() and (source.suffix in (".yaml", ".yml") or str(source) in scenario_names())
    return is_scenario or to == "glb" or (to is None and out.suffix.lower() in FORMATS["glb"].suffixes)


def _is_session(source: Path, how: HowToRead) -> bool:
    """Return whether a folder is a session of ours.

    Raises:
        InputError: It is a pair, an answer, or a session with options of a recording.
    """
    from cdpipe.core.errors import InputError
    from cdpipe.io.session import is_session

    if (source / "answer.json").is_file():
        raise InputError(f"{source}: an answer, without its sessions: `tunnelcd convert BEFORE AFTER {source} map.laz`")
    if is_session(source / "before"):
        raise InputError(f"{source}: a pair of sessions: convert {source / 'before'} and {source / 'after'} one by one")
    if is_session(source):
        to_write = "" if how.format is None else " (the format that is written is --to)"
        how.require_nothing(source, f"a session has its own poses and sensor{to_write}")
    return is_session(source)


def _convert_answer(
    sources: Sequence[Path], out: Path, to: str | None, hows: Sequence[HowToRead], cell_m: float, progress: RunProgress
) -> str:
    from eval.converting.formats import choose_format
    from eval.converting.writing import require_map, write_answer_map

    name = choose_format(out, to)
    require_map(out, name)  # before hours of reading
    before, after = open_sources(*open_inputs(sources[:2], hows, progress))
    return write_answer_map((before, after), sources[2], out, name, cell_m, progress)


def _convert_world(
    source: Path, out: Path, to: str | None, seed: int | None, settings: Sequence[str], *, with_truth: bool
) -> str:
    from eval.converting.formats import choose_format
    from eval.converting.writing import write_world

    return write_world(str(source), out, choose_format(out, to), seed, settings, with_truth=with_truth)


def _import(source: Path, out: Path, name: str, how: HowToRead, progress: RunProgress) -> str:
    from cdpipe.io.foreign import convert_recording
    from cdpipe.io.foreign.sniff import OUSTER
    from cdpipe.io.readers import import_ouster
    from eval.core.output import made_parents, new_folder

    if name not in OUSTER:
        with new_folder(out) as partial:
            n_scans, poses = convert_recording(source, partial, how, progress.stage)
        told = "1 scan" if n_scans == 1 else f"{n_scans} scans"
        return f"{out}: {told} as PLY, trajectory.tum, poses: {poses}{_too_short(n_scans)}"
    with made_parents(out):
        imported = import_ouster(source, out, how, progress.stage)
    revolutions = "1 revolution" if imported.n_scans == 1 else f"{imported.n_scans} revolutions"
    told = f"{out}: session of {revolutions}, {imported.sensor}, poses: {imported.poses}"
    if imported.n_left_out:
        told += f"; {imported.n_left_out} left out, of which half the columns or fewer arrived"
    return told + _too_short(imported.n_scans)


def _too_short(n_scans: int) -> str:
    """Return what to record where there are too few scans to compare two recordings."""
    if n_scans >= _FEW_SCANS:
        return ""
    return "; so few are one place, seldom enough to compare: record a path of ten metres or more, twice"


def _export(
    source: Path,
    out: Path,
    to: str | None,
    how: HowToRead | None,
    progress: RunProgress,
    cell_m: float,
    *,
    with_truth: bool,
) -> str:
    """Write a session, or a recording that is read as `how` says, in another format."""
    from cdpipe.io.readers import open_session
    from cdpipe.io.session import read_session
    from eval.converting.formats import choose_format
    from eval.converting.request import Request
    from eval.converting.writing import write_session

    opened = open_session(source, how, progress.stage)
    session = read_session(source) if how is None else None
    request = Request(opened, session, progress, with_truth, cell_m)
    return write_session(request, out, choose_format(out, to))
