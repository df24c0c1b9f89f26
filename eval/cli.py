"""The command line. Heavy imports stand inside the commands, so that --help and completion are instant.

Exit codes: 0 done, 2 the input is at fault (one line each on standard error), 1 a bug (a traceback), 130 interrupted.
"""

# ruff: noqa: PLC0415 - heavy imports stand inside the commands, see above
from __future__ import annotations

import errno
import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from eval.progress import shown_progress
from eval.provenance import fix_threads

if TYPE_CHECKING:
    import pandas as pd

    from eval.cluster import Where
    from eval.page_comparison import Comparison
    from eval.plan import Plan


# A full disk, a read-only one, a file too large for it, a folder or file of somebody else's.
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EACCES, errno.EPERM)


@contextmanager
def input_errors() -> Iterator[None]:
    """Turn what a user can cause into one line for each mistake and exit code 2; anything else stays a traceback."""
    from cdpipe.errors import TunnelcdError

    try:
        yield
    except TunnelcdError as error:
        for line in str(error).splitlines():
            sys.stderr.write(f"error: {line}\n")
        raise SystemExit(2) from error
    except OSError as error:
        if error.errno not in _DISK_ERRORS:
            raise
        sys.stderr.write(
            f"error: {error.filename or 'the output'}: {error.strerror}: give it a disk with room and leave to write\n"
        )
        raise SystemExit(2) from error


class _Funnel(TyperGroup):
    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        try:
            with input_errors():
                return super().invoke(ctx)
        except KeyboardInterrupt as error:
            kept = _KEPT.get(ctx.invoked_subcommand or "")
            told = f"finished {kept} are kept, the same command goes on from there" if kept else "nothing was written"
            sys.stderr.write(f"interrupted; {told}\n")
            raise typer.Exit(130) from error


_KEPT = {"run": "cells", "demo": "cells", "dataset": "tunnels"}
app = typer.Typer(
    cls=_Funnel,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="A benchmark for change detection between two LiDAR sessions of a tunnel.",
)

OutFolder = Annotated[Path, typer.Option("--out", help="output folder, new or empty", show_default=False)]
RunOut = Annotated[Path, typer.Option("--out", help="run folder: new, empty, or to be continued", show_default=False)]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="no progress, no tables")]
Preset = Annotated[str, typer.Option("--preset", help="shipped preset, or a .yaml file")]
SetSettings = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="a setting; repeatable")]


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line and exit."""
    fix_threads()
    app(args=None if argv is None else list(argv), prog_name="tunnelcd")


@app.command()
def demo(out: RunOut, quiet: Quiet = False) -> None:
    """Both paper sites end to end: simulate, detect, score, report."""
    from eval.cluster import HERE
    from eval.page import write_page
    from eval.plan import load_plan

    _run(load_plan("paper"), out, HERE, force=False, limit=None, quiet=quiet)
    page = write_page(out)
    typer.echo(f"page: {page}")


@app.command()
def simulate(
    scenario: Annotated[str, typer.Argument(help="name from `list`, or a .yaml file")],
    out: OutFolder,
    seed: Annotated[int, typer.Option(min=0, help="draws every distribution and all noise")] = 0,
    settings: SetSettings = None,
    quiet: Quiet = False,
) -> None:
    """Make one pair of sessions with truth: DIR/before, DIR/after, DIR/truth."""
    from eval.output import new_folder
    from scenarios.library import load_scenario
    from sim.simulate import simulate_pair

    drawn = load_scenario(scenario, seed, settings or ())
    with new_folder(out) as partial, shown_progress(quiet) as progress:
        simulate_pair(drawn, seed, partial, on_progress=progress.stage)
    _say(quiet, f"{out}: before, after, truth of {scenario}, seed {seed}")


@app.command()
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

    from cdpipe.errors import InputError
    from eval.output import make_writable
    from eval.plan import parse_seeds
    from sim import survey as surveys
    from sim.survey_tables import markdown as as_markdown
    from sim.survey_tables import summary, write_csv

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
        _table("figures", table.iloc[1:].set_axis(["", *families], axis=1))
    failures = [failure for one in found for failure in one.failures]
    for failure in failures:
        typer.echo(f"failed: {failure.family}, seed {failure.seed}: {failure.reason}")
    n_worlds = sum(len(one.worlds) for one in found)
    _say(quiet, f"{n_worlds} worlds built, {len(failures)} failed{'' if out is None else f'; one row each in {out}'}")


@app.command()
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

    from cdpipe.errors import InputError
    from eval.looking import view_of
    from sim.viewer import require_viser, running_server, show, write_html

    require_viser()
    if html is not None:
        if not html.absolute().parent.is_dir():
            raise InputError(f"--html {html}: there is no folder {html.parent}")
        write_html(view_of(what, seed, settings or ()), html)
        _say(quiet, f"{html}: {what}, {html.stat().st_size / 1e6:.1f} MB, opens in any browser")
        return
    with running_server(port, host) as server:
        shown = view_of(what, seed, settings or ())
        show(server, shown)
        for note in shown.notes:
            typer.echo(note, err=True)
        _say(quiet, f"{what}: http://{host}:{server.get_port()} (Ctrl-C ends)")
        try:
            while True:
                time.sleep(1.0)
        except KeyboardInterrupt:
            return


@app.command()
def describe(
    session: Annotated[Path, typer.Argument(help="session folder, or PLY scans with a TUM trajectory")],
    preset: Preset = "tunnelcd",
    settings: SetSettings = None,
    quiet: Quiet = False,
) -> None:
    """Compute a session's descriptors and store them beside it, as a robot would while mapping."""
    from cdpipe.config import load_config
    from eval.single import describe_session

    descriptors, path = describe_session(session, load_config(preset, settings or ()))
    _say(quiet, f"{path}: {len(descriptors.q)} keyframes, {descriptors.name} {descriptors.checkpoint}")


@app.command()
def detect(
    before: Annotated[Path, typer.Argument(help="session folder, or PLY scans with a TUM trajectory")],
    after: Annotated[Path, typer.Argument(help="the later session")],
    out: OutFolder,
    preset: Preset = "tunnelcd",
    settings: SetSettings = None,
    quiet: Quiet = False,
) -> None:
    """Find what changed between two sessions, simulated or recorded; needs no truth."""
    from cdpipe.config import load_config
    from cdpipe.errors import MergeFailedError
    from eval.output import new_folder
    from eval.single import detect_pair, evidence_table, notes_on, object_table, region_table, write_detection

    config = load_config(preset, settings or ())
    for note in notes_on(before, after):
        typer.echo(f"note: {note}", err=True)
    try:
        with new_folder(out) as partial, shown_progress(quiet) as progress:
            report = detect_pair(before, after, config, progress.stage)
            write_detection(partial, preset, report)
    except MergeFailedError as error:
        if not quiet:
            _table("merge: refused", evidence_table(error.evidence, config))
        raise
    if quiet:
        return
    _table("merge: accepted", evidence_table(report.evidence, config))
    _table("regions (map frame = the before session's odometry)", region_table(report))
    if not report.regions.is_reported.any():
        scores = report.regions.scores
        typer.echo(
            f"nothing reaches query.threshold = {config.query.threshold:g}; "
            f"the best of {len(scores)} candidates scores {scores[:1].max(initial=0.0):.4g}; "
            "--set query.n_regions=3 reports the best three whatever they score\n"
        )
    objects = object_table(report)
    _table("objects", objects[[name for name in objects.columns if not name.startswith(("min_", "max_", "box_"))]])
    times = ", ".join(f"{name[2:-2]} {seconds:.3f} s" for name, seconds in report.seconds.items())
    typer.echo(f"{out}: answer.json, answer.npz, regions.csv, objects.csv, objects.ply ({times})")


@app.command()
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
    from eval.converting import Options
    from eval.converting import convert as converted

    with shown_progress(quiet) as progress:
        told = converted(source, out, Options(metadata, trajectory, odometry, without_truth), progress)
    _say(quiet, told)


@app.command()
def score(
    folder: Annotated[Path, typer.Argument(help="a run folder; or a simulated pair, with the answer as second folder")],
    answer: Annotated[
        Path | None, typer.Argument(help="one answer to score against the pair", show_default=False)
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Score stored answers against the truth again; nothing is run."""
    if answer is not None:
        from eval.scoring import score_pair

        row = score_pair(folder, answer).row
        if not quiet:
            _row(row)
        return
    from eval.rescoring import rescore
    from eval.runfolder import open_run_folder

    run = open_run_folder(folder)
    with shown_progress(quiet) as progress:
        n_scored = rescore(run, progress)
    _results(run.path, quiet)
    _say(quiet, f"{folder}: {n_scored} answers scored again, tables rewritten")


@app.command("run")
def run_command(
    plan: Annotated[str, typer.Argument(help="name from `list`, or a .yaml file")],
    out: RunOut,
    seeds: Annotated[str | None, typer.Option(metavar="A:B", help="instead of the plan's; B excluded")] = None,
    settings: SetSettings = None,
    grid: Annotated[
        list[str] | None,
        typer.Option("--grid", metavar="KEY=V1,V2", help="run every variant at each value; repeatable"),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="processes; each takes its own pairs", show_default=False)
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="tcp://HOST:PORT", help="a Dask cluster that sees the run folder", show_default=False),
    ] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="do at most this many cells")] = None,
    force: Annotated[bool, typer.Option("--force", help="redo finished cells, simulation included")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="list the cells and what is finished, and stop")] = False,
    quiet: Quiet = False,
) -> None:
    """Run a plan: scenarios x seeds x variants. Finished cells are kept and skipped."""
    from eval.cluster import Where, require_usable
    from eval.plan import changed_plan, load_plan

    chosen = changed_plan(load_plan(plan), seeds=seeds, settings=settings or (), grid=grid or ())
    where = Where(workers, scheduler)
    require_usable(where)
    if dry_run:
        _list_cells(chosen, out, force=force, limit=limit)
    else:
        _run(chosen, out, where, force=force, limit=limit, quiet=quiet)


@app.command()
def report(
    folder: Annotated[str, typer.Argument(metavar="RUN", help="a run folder")],
    other: Annotated[
        str | None,
        typer.Argument(metavar="B", help="a second one, judged against the first; RUN:VARIANT is a method of one"),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option(metavar="VARIANT", help="judge every method of the run against this one", show_default=False),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="of a comparison; else the folder judged", show_default=False)
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Write one offline page with tables, plots and pictures of a run; or what moved between two runs."""
    from cdpipe.errors import InputError

    if other is None and against is None:
        from eval.page import write_page
        from eval.runfolder import open_run_folder

        if out is not None:
            raise InputError("--out: the page of a run lies in its folder: leave --out to a comparison")
        typer.echo(f"page: {write_page(open_run_folder(Path(folder)).path)}")
        return
    if other is not None and against is not None:
        raise InputError(f"--against {against}: a second run is named too: write {folder}:{against} {other} instead")
    from eval.page_comparison import compared, write_comparison
    from eval.sides import read_side

    first, second = (folder, other) if other is not None else (f"{folder}:{against}", folder)
    a, b = read_side(first), read_side(second)
    found = compared(a, b)
    page = write_comparison(found, out or b.path)
    if not quiet:
        _comparison(found)
    typer.echo(f"page: {page}")


@app.command()
def dataset(
    families: Annotated[list[str], typer.Argument(metavar="FAMILY...", help="names from `list`, or .yaml files")],
    seeds: Annotated[
        str, typer.Option(metavar="A:B", help="B excluded; below 10000 to train, 10000 to 19999 to validate")
    ],
    out: Annotated[Path, typer.Option("--out", help="data folder: new, empty, or to be continued", show_default=False)],
    settings: SetSettings = None,
    draws: Annotated[int, typer.Option(min=1, help="after images of each keyframe; the first is merged exactly")] = 4,
    error_m: Annotated[float, typer.Option(min=0, help="merge error of the others: shift, per component")] = 0.03,
    error_deg: Annotated[float, typer.Option(min=0, help="and turn, per component")] = 0.2,
    workers: Annotated[
        int | None, typer.Option(min=1, help="processes; each takes its own tunnels", show_default=False)
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="tcp://HOST:PORT", help="a Dask cluster instead", show_default=False)
    ] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="make at most this many tunnels")] = None,
    quiet: Quiet = False,
) -> None:
    """Make training data for descriptors, a shard for each tunnel. Finished tunnels are kept and skipped."""
    import shlex

    from eval.cluster import Where
    from eval.dataset import Recipe
    from eval.dataset_run import make_dataset

    recipe = Recipe(draws, error_m, error_deg, tuple(settings or ()))
    with shown_progress(quiet) as progress:
        outcome = make_dataset(
            families,
            seeds,
            recipe,
            out,
            Where(workers, scheduler),
            limit,
            shlex.join(["tunnelcd", *sys.argv[1:]]),
            progress,
        )
    left = f", {outcome.n_left} left by --limit" if outcome.n_left else ""
    refused = f", {outcome.n_refused} refused (README.md says why)" if outcome.n_refused else ""
    rate = f"; {outcome.n_pairs} keyframe pairs, {outcome.n_pairs / outcome.seconds:.1f}/s" if outcome.n_made else ""
    _say(quiet, f"{out}: {outcome.n_made} tunnels made, {outcome.n_kept} kept from earlier{refused}{left}{rate}")


@app.command()
def train(
    data: Annotated[Path, typer.Argument(metavar="DIR", help="made by `tunnelcd dataset`, tunnels of both splits")],
    out: Annotated[Path, typer.Option("--out", help="checkpoint, model card, curves", show_default=False)],
    descriptor: Annotated[str, typer.Option(help="sphere or 3deg")] = "sphere",
    steps: Annotated[int, typer.Option(min=1, help="at most")] = 4000,
    seed: Annotated[int, typer.Option(min=0, help="of the first weights and of every draw")] = 0,
    threads: Annotated[int, typer.Option(min=1, help="of torch")] = 2,
    patience: Annotated[int, typer.Option(min=1, help="validations without a better score until it stops")] = 6,
    quiet: Quiet = False,
) -> None:
    """Train a descriptor: checkpoint (safetensors), model card, curves. A run that was cut off goes on."""
    import shlex

    from cdpipe.descriptor.fit import FitConfig
    from cdpipe.errors import InputError
    from eval.training_run import TASKS, train_descriptor

    if descriptor not in TASKS:
        raise InputError(f"--descriptor {descriptor}: expected {' or '.join(TASKS)}")
    command = shlex.join(["tunnelcd", *sys.argv[1:]])
    with shown_progress(quiet) as progress:
        trained = train_descriptor(
            data, out, descriptor, FitConfig(seed, steps, patience=patience), threads, command, progress
        )
    scores = ", ".join(f"{name} {value}" for name, value in trained.card["validation"]["trained"].items())
    _say(quiet, f"{trained.checkpoint}: best of step {trained.card['best_step']} on validation tunnels: {scores}")


@app.command()
def bench(
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.json", help="also write the table", show_default=False)
    ] = None,
    only: Annotated[list[str] | None, typer.Option(metavar="NAME", help="this row alone; repeatable")] = None,
    quiet: Quiet = False,
) -> None:
    """Measure the speed table, each figure beside its rival in the same run. A missed target is told, not an error."""
    import pandas as pd

    from eval.bench import chosen, contests, make_ready, measure, reasons, verdict, write_table
    from eval.progress import Lines, Silent

    rows = chosen(contests(), only or ())
    if out is not None:
        make_ready(out)
    # lines, never bars: a thread that redraws them would be measured too
    table = measure(rows, (Silent() if quiet else Lines()).cells)
    if out is not None:
        write_table(table, out)
    if quiet:
        return
    shown = pd.DataFrame(table["rows"]).assign(met=[_MET[row["met"]] for row in table["rows"]]).drop(columns="reason")
    cpu, cores = table["machine"]["cpu"], table["machine"]["cores"]
    _table(f"speed, {cpu}, {cores} cores; ratio: times faster than the rival", shown)
    for line in reasons(table["rows"]):
        typer.echo(line)
    typer.echo(f"{verdict(table['rows'])}{'' if out is None else f'; {out}'}")


@app.command("list")
def list_command() -> None:
    """Name the scenarios, plans, presets and sensor profiles there are."""
    from cdpipe.config import preset_names
    from cdpipe.ouster import profile_names
    from eval.plan import plan_names
    from scenarios.library import scenario_names

    groups = {
        "scenarios": scenario_names(),
        "plans": plan_names(),
        "presets": preset_names(),
        "sensor profiles": profile_names(),
    }
    for title, names in groups.items():
        typer.echo(f"{title}:")
        for name in names:
            typer.echo(f"  {name}")


@app.command()
def check(files: Annotated[list[str], typer.Argument(help="scenario, plan or preset: a name or a .yaml file")]) -> None:
    """Validate scenarios, plans and presets without running anything."""
    from cdpipe.errors import InputError
    from eval.checking import check_file

    mistakes: list[str] = []
    for file in files:
        try:
            typer.echo(f"{file}: {check_file(file)}, no mistakes")
        except InputError as error:
            mistakes += str(error).splitlines()
    if mistakes:
        raise InputError("\n".join(mistakes))


def _list_cells(plan: Plan, out: Path, *, force: bool, limit: int | None) -> None:
    from collections import Counter

    from eval.runner import listed

    every = listed(plan, out, force=force, limit=limit)
    for cell in every:
        typer.echo(f"{cell.state:<8}  {cell.scenario} {cell.seed} {cell.variant}")
    count = Counter(cell.state for cell in every)
    left = f", {count['left']} left by --limit" if count["left"] else ""
    typer.echo(
        f"{out}: {len(every)} cells: {count['finished']} finished, {count['to do']} to do{left}; nothing was run"
    )


def _run(plan: Plan, out: Path, where: Where, *, force: bool, limit: int | None, quiet: bool) -> None:
    from eval.plan import cells
    from eval.runfolder import removed_if_empty, start_run_folder
    from eval.runner import run_plan

    cells(plan)  # settings that contradict each other are refused before a folder is made
    command = ["tunnelcd", *sys.argv[1:]]
    with removed_if_empty(out), shown_progress(quiet, rate="cells") as progress:
        run = start_run_folder(out)
        outcome = run_plan(plan, run, command=command, force=force, limit=limit, where=where, progress=progress)
    _results(out, quiet)
    left = f", {outcome.n_left} left by --limit" if outcome.n_left else ""
    died = f", {outcome.n_died} of all killed their workers" if outcome.n_died else ""
    _say(quiet, f"{out}: {outcome.n_done} cells done, {outcome.n_kept} kept from earlier{left}{died}")


_MET = {True: "met", False: "missed", None: "-"}
_SHOWN = (
    "region_recall", "region_precision", "region_recall_at_k", "n_regions", "object_iou_point", "object_f1_25",
    "merge_error_m", "t_total_s",
)  # fmt: skip


def _results(folder: Path, quiet: bool) -> None:
    if quiet:
        return
    import pandas as pd

    from eval.coverage import coverage
    from eval.merge_table import merge_overview
    from eval.runfolder import RunFolder

    results = pd.read_csv(folder / "results.csv")
    results["n_failed"] = results["status"] != "ok"
    groups = results.groupby(["scenario", "variant"], sort=False)
    counts = groups["n_failed"].agg(n="size", n_failed="sum")
    # a run that ends at the merge has nothing in the columns of what comes later
    shown = [name for name in _SHOWN if name in results.columns and results[name].notna().any()]
    _table("means over pairs", counts.join(groups[shown].mean()).reset_index())
    cases = zip(results["scenario"], results["seed"].astype(int), results["variant"], strict=True)
    is_told = (folder / "provenance.json").is_file()
    covered = coverage(RunFolder(folder).provenance(), cases) if is_told else None
    is_whole = covered is None or covered.is_whole
    targets = merge_overview(results, is_whole=is_whole)
    if covered is not None and not is_whole:
        typer.echo(f"{covered.sentence}\n")
    if len(targets):
        _table("merge: share of the pairs within the target of their kind, with its 95 % interval", targets)
    if (folder / "regions_table.csv").is_file():
        _region_results(folder)
    if (folder / "objects_table.csv").is_file():
        _object_results(folder)


def _region_results(folder: Path) -> None:
    import pandas as pd

    from eval.region_table import region_overview

    _table(
        "regions: means over pairs, in and out of distribution; recall@0.1 is at 0.1 false regions per 100 m",
        region_overview(pd.read_csv(folder / "regions_table.csv")),
    )
    _targets(folder, "regions")


def _object_results(folder: Path) -> None:
    import pandas as pd

    from eval.object_groups import group_overview
    from eval.object_table import object_overview

    table = pd.read_csv(folder / "objects_table.csv")
    _table(
        "objects: means over pairs, missed ones 0; matched: median IoU of those matched; moved_m, pile_vol: median "
        "error; recall and false regions per 100 m as proposed, and after withdrawal; seconds per proposed region",
        object_overview(table),
    )
    if (folder / "objects_by_group.csv").is_file():
        groups = group_overview(pd.read_csv(folder / "objects_by_group.csv"), str(table["variant"].iloc[0]))
        _table(f"objects of {table['variant'].iloc[0]}, by kind of prop and by hull; volume: median error", groups)
    _targets(folder, "objects")


_MAX_LINES = 60


def _comparison(found: Comparison) -> None:
    from eval.page_comparison import MOVED, overview, sentences

    table = overview(found.table)
    title = f"A: {found.names[0]}; B: {found.names[1]}; means over session pairs, B - A pair by pair"
    if len(table) > _MAX_LINES:
        title += f"; {len(table)} figures compared, those that moved"
        table = table[table["B is"].isin(MOVED)]
    if len(table):
        _table(title, table)
    for line in sentences(found):
        typer.echo(line)


def _targets(folder: Path, subject: str) -> None:
    import pandas as pd

    path = folder / f"{subject}_targets.csv"
    if path.is_file():
        targets = pd.read_csv(path)
        met = [_MET[None if pd.isna(value) else bool(value)] for value in targets["is_met"]]
        _table(f"{subject}: what is asked", targets.drop(columns="is_met").assign(met=met))


def _table(title: str, frame: pd.DataFrame) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for name in frame.columns:
        table.add_column(str(name), no_wrap=True)
    for row in frame.itertuples(index=False):
        table.add_row(*(_cell(value) for value in row))
    # wider than any table: a narrow terminal wraps the lines, where rich would cut off the numbers
    Console(width=500, markup=False).print(table)


def _row(row: dict[str, Any]) -> None:
    width = max(map(len, row))
    for name, value in row.items():
        typer.echo(f"{name:<{width}}  {_cell(value)}")


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:.4g}"
    return str(value)


def _say(quiet: bool, text: str) -> None:
    if not quiet:
        typer.echo(text)
