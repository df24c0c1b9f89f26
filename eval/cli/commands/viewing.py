"""`tunnelcd view`: a world, a session or an answer in the browser or as one page."""

# ruff: noqa: PLC0415 - heavy imports stand inside the commands, so that --help and completion are instant
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from eval.cli.inputs import (
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
    sampled_points,
)
from eval.cli.options import (
    OldWorldSettings,
    Quiet,
    WorldSettings,
    complete_scenario,
    join_world_settings,
    world_mistakes,
)
from eval.core.terminal.printing import echo, say, shown_warnings, warn
from eval.core.terminal.progress import RunProgress, shown_progress

if TYPE_CHECKING:
    from cdpipe.io.foreign import HowToRead
    from eval.report.answer.content import AnswerContent
    from sim.view.view import View


def view(
    what: Annotated[
        str,
        typer.Argument(
            help="scenario (name or .yaml file), pair, session or recording; of an answer: the before session",
            autocompletion=complete_scenario,
        ),
    ],
    after: Annotated[Path | None, typer.Argument(help="the later session of an answer", show_default=False)] = None,
    answer: Annotated[Path | None, typer.Argument(help="folder that `detect` wrote", show_default=False)] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="seed of a scenario; 0 if left out", show_default=False)
    ] = None,
    world: WorldSettings = None,
    settings: OldWorldSettings = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="port of the server; 0 takes a free one")] = 8080,
    host: Annotated[
        str, typer.Option(help="address of the server; 0.0.0.0 admits other machines, with a warning")
    ] = "localhost",
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="write one offline page and end", show_default=False)
    ] = None,
    form: Format = None,
    topics: Topics = None,
    trajectory: Trajectories = None,
    odometry: Odometry = None,
    metadata: Metadata = None,
    deskew: Deskew = True,
    origin: Origin = None,
    quiet: Quiet = False,
) -> None:
    """Show a world, a pair, a session, a recording, or what an answer found between two of them, in the browser."""
    from cdpipe.core.errors import InputError
    from eval.core.output import require_replaceable
    from sim.view.viewer import PAGE_MARK

    if html is not None and not html.absolute().parent.is_dir():
        raise InputError(f"--html {html}: there is no folder {html.parent}: make it, or name another one")
    if html is not None:
        require_replaceable(html, PAGE_MARK.encode(), "page of this version of `tunnelcd view`")
    asked = join_world_settings(world, settings)
    hows = how_to_read(
        1 if after is None else 2, form, topics, trajectory, odometry, metadata, deskew=deskew, origin=origin
    )
    with _sessions_at_hand([Path(what), *([] if after is None else [after])], quiet):
        if after is not None:
            _view_answer(_require_answer(what, after, answer, seed, asked), hows, port, host, html, quiet)
        else:
            _view_one(what, seed, asked, hows[0], port, host, html, quiet)


@contextmanager
def _sessions_at_hand(paths: Sequence[Path], quiet: bool) -> Iterator[None]:
    """Make sessions again that `run --keep` removed from a run folder, for the time of the block."""
    if all(path.exists() or path.parent == Path() for path in paths):
        yield
        return
    from eval.running.scaling.remaking import remade_below

    with ExitStack() as stack:
        with shown_progress(quiet) as progress:
            stack.enter_context(remade_below(paths, progress))
        yield


def _view_one(
    what: str,
    seed: int | None,
    settings: Sequence[str],
    how: HowToRead,
    port: int,
    host: str,
    html: Path | None,
    quiet: bool,
) -> None:
    from cdpipe.core.errors import InputError

    if (Path(what) / "answer.json").is_file():
        raise InputError(f"{what}: an answer, without its sessions: `tunnelcd view BEFORE AFTER {what}`")
    _require_viser_for(host, port, html)
    load = partial(_load_with_progress, what, seed, settings, how, quiet=quiet)
    if html is None:
        _serve(load, what, port, host, quiet)
        return
    from sim.view.viewer import write_html

    shown = load()
    write_html(shown, html)
    _tell_notes(shown)
    say(quiet, f"{html}: {what}, {html.stat().st_size / 1e6:.1f} MB, opens in any browser")


def _require_answer(
    before: str, after: Path, answer: Path | None, seed: int | None, settings: Sequence[str] | None
) -> tuple[Path, Path, Path]:
    """Return the before session, the after session and the answer.

    Raises:
        InputError: The answer is not named, or options of a scenario are.
    """
    from cdpipe.core.errors import InputError

    if answer is None and (after / "answer.json").is_file():
        raise InputError(f"{after}: an answer, no session: name the session before, the one after and then the answer")
    if answer is None:
        raise InputError(
            f"{before} {after}: two sessions without an answer: `tunnelcd detect {before} {after} --out ANSWER` makes "
            "one; then view both sessions and ANSWER; or view one session alone"
        )
    if seed is not None or settings:
        raise InputError(f"{before}: a session holds what was recorded: leave --seed and --world out")
    return Path(before), after, answer


def _view_answer(
    paths: tuple[Path, Path, Path], hows: Sequence[HowToRead], port: int, host: str, html: Path | None, quiet: bool
) -> None:
    from eval.report.answer.content import read_content
    from eval.report.answer.page import write_answer_page
    from eval.report.answer.view import view_answer

    def read() -> AnswerContent:
        with shown_warnings(), shown_progress(quiet) as progress:
            before, after = open_sources(*open_inputs(paths[:2], hows, progress))
            return read_content(before, after, paths[2], progress.stage)

    if html is None:
        _require_viser_for(host, port, html)
        _serve(lambda: view_answer(read()), str(paths[2]), port, host, quiet)
        return
    content = read()
    write_answer_page(content, html)
    say(quiet, f"{html}: {html.stat().st_size / 1e6:.1f} MB, opens in any browser")
    say(quiet, str(content.report))


def _require_viser_for(host: str, port: int, html: Path | None) -> None:
    """Warn of a server that other machines reach.

    Raises:
        InputError: viser is not installed.
    """
    from eval.core.exposure import is_loopback
    from sim.view.viewer import require_viser

    require_viser()
    if html is None and not is_loopback(host):
        warn(f"--host {host}: everybody who reaches port {port} sees the scene; the server asks for no password")


def _serve(load: Callable[[], View], what: str, port: int, host: str, quiet: bool) -> None:
    """Show a view until the user interrupts."""
    import time

    from eval.core.terminal.interrupts import is_ended
    from sim.view.viewer import running_server, show

    with running_server(port, host) as server:
        shown = load()
        show(server, shown)
        _tell_notes(shown)
        say(quiet, f"{what}: http://{host}:{server.get_port()} (Ctrl-C ends)")
        try:
            while True:
                time.sleep(1.0)
        except KeyboardInterrupt:
            if is_ended():
                raise


def _tell_notes(shown: View) -> None:
    for note in shown.notes:
        echo(note, err=True)


def _load_with_progress(what: str, seed: int | None, settings: Sequence[str], how: HowToRead, *, quiet: bool) -> View:
    with world_mistakes(), shown_warnings(), shown_progress(quiet) as progress:
        return load_view(what, seed, settings, how, progress)


def load_view(
    what: str,
    seed: int | None = None,
    settings: Sequence[str] = (),
    how: HowToRead | None = None,
    progress: RunProgress | None = None,
) -> View:
    """Return the view of a scenario (name or YAML file), of a simulated pair, of a session, or of a recording.

    Args:
        what: Name, file or folder. A scenario's name takes precedence over a folder without a session.
        seed: Seed of a scenario; 0 if None. A folder has its own.
        settings: `a.b=value` pairs written over a scenario.
        how: How a recording is to be read.
        progress: Told of the reading.

    Raises:
        InputError: It does not exist or is damaged, or a seed or a setting is given for a folder.
        ScenarioError: The scenario has mistakes, or its world cannot be built.
    """
    from cdpipe.core.errors import InputError
    from cdpipe.core.yamlfile import suggest
    from cdpipe.io.foreign import HowToRead, holds_scans
    from cdpipe.io.session import is_session
    from scenarios import load_scenario, scenario_names
    from scenarios.library import SUFFIXES
    from sim.view.returns import MAX_POINTS
    from sim.view.view import is_pair, view_folder, view_points, view_scenario

    path, names, how = Path(what), scenario_names(), how or HowToRead()
    is_named = path.is_dir() or (path.exists() and path.suffix not in SUFFIXES)
    if is_pair(path) or is_session(path) or (is_named and what not in names):
        if seed is not None or settings:
            raise InputError(f"{what}: a folder holds what was recorded: leave --seed and --world out")
        if is_pair(path) or is_session(path):
            how.require_nothing(what, "a session has its own poses and sensor")
        if is_pair(path) or is_session(path) or (path.is_dir() and not holds_scans(path)):
            return view_folder(path)
        (source,) = open_sources(*open_inputs([path], [how], progress or RunProgress()))
        return view_points(what, sampled_points(source, MAX_POINTS), source.odom_T_sensor)
    if what not in names and path.suffix not in SUFFIXES:
        hint = suggest(what, names) or "; `tunnelcd list` names the scenarios"
        raise InputError(f"{what}: neither a folder nor a scenario{hint}")
    how.require_nothing(what, "a world has no recording to read")
    return view_scenario(load_scenario(what, seed or 0, settings), seed or 0)
