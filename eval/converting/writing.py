"""Writes one file or folder of a format, complete or not at all, and says what was written."""

# ruff: noqa: PLC0415 - heavy imports stand inside the functions
from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from cdpipe.core.errors import InputError
from cdpipe.model.types import ScanSource
from eval.converting.formats import FORMATS, OutFormat
from eval.converting.request import Request
from eval.converting.truth import knows_changes
from eval.converting.writers import require_formats
from eval.core.output import new_files, new_folder, unwritable
from eval.core.terminal.progress import RunProgress


def write_session(request: Request, out: Path, name: str) -> str:
    """Write a session or a recording as a format of `FORMATS`; return the line to print.

    Raises:
        InputError: The format takes worlds alone or has no room for the truth, there is none, or the output exists or
            cannot be written.
    """
    form = FORMATS[name]
    if form.write is None:
        raise InputError(f"{out}: {form.about}: expected a scenario (a name from `list`, or a .yaml file), or a pair")
    if request.with_truth and not form.truth:
        raise InputError(f"{out}: {form.about} has no room for the truth: leave --with-truth out")
    if request.with_truth and not (request.own_session().path / "truth").is_dir():
        raise InputError(f"{request.source.name}: there is no truth in it: leave --with-truth out")
    truth = form.truth if request.session is None or knows_changes(request.session) else form.truth_of_story
    if request.with_truth and not truth:
        raise InputError(
            f"{request.source.name}: a session of a story: the truth in a {form.about} is that of a pair: make one, "
            "`tunnelcd pair STORY 1 2 --out PAIR`, or leave --with-truth out"
        )
    with _output(out, form, has_second=bool(form.beside) and (request.with_truth or not form.truth)) as partial:
        form.write(request, partial)
    n_scans = len(request.source.odom_T_sensor)
    what = "revolution" if request.session is not None else "scan" if request.outgoing().has_scans else "station"
    told = truth if request.with_truth else "without truth"
    return f"{out}: {n_scans} {what}{'' if n_scans == 1 else 's'}, {told}, {_size_mb(out):.1f} MB"


def require_map(out: Path, name: str) -> None:
    """Refuse a format that cannot hold the map of an answer, or that needs an extra which is missing.

    Raises:
        InputError: It cannot, or the extra is missing.
    """
    if not FORMATS[name].is_map:
        maps = ", ".join(suffix for each in FORMATS.values() if each.is_map for suffix in each.suffixes)
        raise InputError(f"{out}: an answer becomes a map with scalar fields: name a new file that ends in {maps}")
    if name == "laz":
        require_formats(out)


def write_answer_map(
    sessions: tuple[ScanSource, ScanSource], answer: Path, out: Path, name: str, cell_m: float, progress: RunProgress
) -> str:
    """Write both sessions of an answer and what it found as one map; return the line to print.

    Raises:
        InputError: The format is no map, the answer does not fit, or the output exists or cannot be written.
    """
    from cdpipe.io.out.answer_map import gather_answer_map
    from cdpipe.io.out.clouds import write_laz, write_ply

    require_map(out, name)
    with _output(out, FORMATS[name]) as partial:
        cloud = gather_answer_map(sessions, answer, cell_m, progress.stage)
        (write_laz if name == "laz" else write_ply)(partial, cloud)
    n_changed = int((cloud.scalars["change"] > 0).sum())
    return f"{out}: {len(cloud.points)} points, {n_changed} of them on objects, {_size_mb(out):.1f} MB"


def write_world(what: str, out: Path, name: str, seed: int | None, settings: Sequence[str], *, with_truth: bool) -> str:
    """Write the world of a scenario or a simulated pair as GLB; return the line to print.

    Raises:
        InputError: The format is another one, or what is named is no world.
        ScenarioError: The world cannot be built.
    """
    from scenarios import load_scenario
    from scenarios.library import SUFFIXES
    from sim.view.glb import write_glb
    from sim.view.view import is_pair, view_pair, view_scenario

    form = FORMATS[name]
    if name != "glb":
        raise InputError(f"{what}: a world: it becomes a GLB, a new file that ends in .glb; `simulate` makes sessions")
    pair = Path(what)
    if pair.exists() and not is_pair(pair) and pair.suffix not in SUFFIXES:
        raise InputError(f"{what}: a session has no surfaces: name the scenario, or the simulated pair")
    if is_pair(pair) and not with_truth:
        raise InputError(f"{pair}: the world of a pair is its truth: add --with-truth")
    if with_truth and not is_pair(pair):
        raise InputError(
            f"{what}: a scenario has no sessions that could be without their truth: leave --with-truth out"
        )
    if is_pair(pair) and (seed is not None or settings):
        raise InputError(f"{pair}: a folder holds what was simulated: leave --seed and --world out")
    with _output(out, form) as partial:
        view = view_pair(pair) if is_pair(pair) else view_scenario(load_scenario(what, seed or 0, settings), seed or 0)
        n_meshes, n_triangles = write_glb(view, partial)
    return f"{out}: {view.title}, {n_meshes} meshes, {n_triangles} triangles, {_size_mb(out):.1f} MB"


@contextmanager
def _output(out: Path, form: OutFormat, *, has_second: bool = False) -> Iterator[Path]:
    """Yield where to write; what lies there gets its name when the block succeeds, and is removed when it fails.

    Raises:
        InputError: The output exists already or cannot be written, or the block raises it; the text names the output.
    """
    paths = [out, out.with_suffix(form.beside)] if has_second else [out]
    if len(set(paths)) < len(paths):
        raise InputError(f"{out}: the name of the file that is written beside it, {form.beside}: name it otherwise")
    with new_folder(out) if form.is_folder else new_files(*paths) as folder:
        partial = folder if form.is_folder else folder / out.name
        try:
            yield partial
        except InputError as error:
            raise type(error)(str(error).replace(str(partial), str(out))) from error
        except OSError as error:
            raise unwritable(out, error) from error


def _size_mb(path: Path) -> float:
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    return sum(file.stat().st_size for file in files) / 1e6
