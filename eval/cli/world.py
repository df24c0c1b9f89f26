"""Commands about worlds and sessions: make them, look at them, bring them from elsewhere."""

# ruff: noqa: PLC0415 - heavy imports stand inside the commands, so that --help and completion are instant
from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from eval.cli.options import OutFolder, Quiet, SetSettings
from eval.core.printing import print_table, say
from eval.core.progress import shown_progress


def simulate(
    scenario: Annotated[str, typer.Argument(help="name from `list`, or a .yaml file")],
    out: OutFolder,
    seed: Annotated[int, typer.Option(min=0, help="draws every distribution and all noise")] = 0,
    settings: SetSettings = None,
    quiet: Quiet = False,
) -> None:
    """Make one pair of sessions with truth: DIR/before, DIR/after, DIR/truth."""
    from eval.core.output import new_folder
    from scenarios.library import load_scenario
    from sim.session.simulate import simulate_pair

    drawn = load_scenario(scenario, seed, settings or ())
    with new_folder(out) as partial, shown_progress(quiet) as progress:
        simulate_pair(drawn, seed, partial, on_progress=progress.stage)
    say(quiet, f"{out}: before, after, truth of {scenario}, seed {seed}")


def survey(
    families: Annotated[list[str], typer.Argument(metavar="FAMILY...", help="names from `list`, or .yaml files")],
    seeds: Annotated[str, typer.Option(metavar="A:B", help="B excluded")] = "0:10",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.csv", help="also one row per seed", show_default=False)
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="processes; each takes its own seeds")] = 1,
    markdown: Annotated[bool, typer.Option("--markdown", help="print the table in Markdown")] = False,
    quiet: Quiet = False,
) -> None:
    """Build the worlds of families without scanning them, and tell size, density, changes, repose, roughness."""
    import pandas as pd

    from cdpipe.core.errors import InputError
    from eval.core.output import make_writable
    from eval.plans.plan import parse_seeds
    from sim.studies import survey as surveys
    from sim.studies.survey_tables import markdown as as_markdown
    from sim.studies.survey_tables import summary, write_csv

    try:
        numbers = parse_seeds(seeds)
    except ValueError as error:
        raise InputError(f"--seeds {seeds}: {error}") from error
    if out is not None:
        make_writable(out.absolute().parent)
    with shown_progress(quiet) as progress:
        found = [surveys.survey(family, numbers, workers, progress.cells) for family in families]
    if out is not None:
        write_csv(out, found)
    if markdown:
        typer.echo(as_markdown(found))
    elif not quiet:
        table = pd.DataFrame([summary(one) for one in found]).T.reset_index()
        print_table("figures", table.iloc[1:].set_axis(["", *families], axis=1))
    failures = [failure for one in found for failure in one.failures]
    for failure in failures:
        typer.echo(f"failed: {failure.family}, seed {failure.seed}: {failure.reason}")
    n_worlds = sum(len(one.worlds) for one in found)
    say(quiet, f"{n_worlds} worlds built, {len(failures)} failed{'' if out is None else f'; one row each in {out}'}")


def view(
    what: Annotated[str, typer.Argument(help="scenario (name or .yaml file), simulated pair, or session folder")],
    seed: Annotated[int | None, typer.Option(min=0, help="of a scenario; 0 if left out", show_default=False)] = None,
    settings: SetSettings = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="of the server; 0 takes a free one")] = 8080,
    host: Annotated[str, typer.Option(help="address to listen on; 0.0.0.0 lets other machines look")] = "localhost",
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="write one offline page and end", show_default=False)
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Look at a world, a simulated pair or a session in the browser."""
    import time

    from cdpipe.core.errors import InputError
    from eval.cli.looking import view_of
    from sim.view.viewer import require_viser, running_server, show, write_html

    require_viser()
    if html is not None:
        if not html.absolute().parent.is_dir():
            raise InputError(f"--html {html}: there is no folder {html.parent}")
        write_html(view_of(what, seed, settings or ()), html)
        say(quiet, f"{html}: {what}, {html.stat().st_size / 1e6:.1f} MB, opens in any browser")
        return
    with running_server(port, host) as server:
        shown = view_of(what, seed, settings or ())
        show(server, shown)
        for note in shown.notes:
            typer.echo(note, err=True)
        say(quiet, f"{what}: http://{host}:{server.get_port()} (Ctrl-C ends)")
        try:
            while True:
                time.sleep(1.0)
        except KeyboardInterrupt:
            return


def convert(
    source: Annotated[Path, typer.Argument(metavar="SRC", help="session folder; or a recording, .osf or .pcap")],
    out: Annotated[Path, typer.Argument(metavar="DST", help="new .osf file; or new session folder")],
    metadata: Annotated[
        Path | None,
        typer.Option(metavar="FILE.json", help="of a .pcap's sensor; else the .json of its name", show_default=False),
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(metavar="FILE.tum", help="poses of the sensor, stamped by its clock", show_default=False),
    ] = None,
    odometry: Annotated[
        str | None, typer.Option(metavar="kiss-icp", help="estimate the poses", show_default=False)
    ] = None,
    without_truth: Annotated[
        bool, typer.Option("--without-truth", help="leave LABEL and INSTANCE out of the .osf")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Write a session as OSF for the vendor's SDK, or bring an OSF or PCAP of an Ouster in as a session."""
    from eval.cli.converting import Options
    from eval.cli.converting import convert as converted

    with shown_progress(quiet) as progress:
        told = converted(source, out, Options(metadata, trajectory, odometry, without_truth), progress)
    say(quiet, told)
