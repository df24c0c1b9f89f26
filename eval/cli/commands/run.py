"""Commands about run folders: run a plan, score the answers again, write the report."""

# ruff: noqa: PLC0415 - heavy imports stand inside the commands, so that --help and completion are instant
from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from eval.cli.options import (
    AsJson,
    JsonFile,
    Quiet,
    RunOut,
    Scheduler,
    SetSettings,
    Wide,
    Workers,
    complete_method,
    complete_plan,
    complete_preset,
    complete_setting,
    require_method_settings,
)
from eval.cli.printed_results import print_comparison, print_pair_row, print_results, print_summary
from eval.core.terminal.printing import count_pairs, echo, require_json_file, say, tell_json, warn
from eval.core.terminal.progress import shown_progress

if TYPE_CHECKING:
    from eval.core.cluster import Where
    from eval.plans.plan import Plan
    from eval.running.scaling.mirror import Mirror
    from eval.running.scaling.shards import Shard


def demo(out: RunOut, quiet: Quiet = False) -> None:
    """Both paper sites end to end: simulate, detect, score, report."""
    from eval.core.cluster import HERE
    from eval.plans.plan import load_plan
    from eval.report.page import write_page

    _run(load_plan("paper"), out, HERE, force=False, limit=None, quiet=quiet)
    page = write_page(out)
    echo(f"page: {page}")


def run_command(
    plan: Annotated[str, typer.Argument(help="name from `list`, or a .yaml file", autocompletion=complete_plan)],
    out: RunOut,
    seeds: Annotated[str | None, typer.Option(metavar="A:B", help="replaces the plan's seeds; B excluded")] = None,
    split: Annotated[
        str,
        typer.Option(
            metavar="dev|sealed",
            help="sealed: other seeds, drawn from this version's name; sealed:0.1.0: from that one's",
        ),
    ] = "dev",
    preset: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="run this preset in place of the plan's variants; may be repeated",
            autocompletion=complete_preset,
        ),
    ] = None,
    settings: SetSettings = None,
    grid: Annotated[
        list[str] | None,
        typer.Option(
            "--grid",
            metavar="KEY=V1,V2",
            help="run every variant at each value; may be repeated",
            autocompletion=complete_setting,
        ),
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    limit: Annotated[int | None, typer.Option(min=1, help="compute at most this many cells")] = None,
    force: Annotated[bool, typer.Option("--force", help="compute finished cells again, simulation included")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="list the cells and which are finished; run none")] = False,
    shard: Annotated[
        str | None,
        typer.Option(metavar="I/N", help="run every N-th pair, from the I-th on; `merge-runs` unites shards"),
    ] = None,
    keep: Annotated[
        Literal["answers", "sessions", "nothing"] | None,
        typer.Option(help="what stays of a pair after its last cell; of `nothing` rows do", show_default="sessions"),
    ] = None,
    rows_to: Annotated[
        str | None,
        typer.Option(metavar="URL", help="copy rows and answers there as well, and go on from those there"),
    ] = None,
    wide: Wide = False,
    quiet: Quiet = False,
) -> None:
    """Run a plan: scenarios x seeds x variants. Finished cells are kept."""
    from cdpipe.core.errors import InputError
    from eval.core.cluster import Where, exposure, require_reachable, require_usable
    from eval.plans.changes import change_plan
    from eval.plans.plan import load_plan
    from eval.running.scaling.shards import parse_shard

    for option, given in (("set", settings), ("grid", grid)):
        require_method_settings(given, "write it into the plan, as `set` of a scenario", option)
    chosen = change_plan(
        load_plan(plan), seeds=seeds, split=split, presets=preset or (), settings=settings or (), grid=grid or ()
    )
    where, part = Where(workers, scheduler), None if shard is None else parse_shard(shard)
    require_usable(where)
    if dry_run and rows_to is not None:
        raise InputError("--dry-run looks into the run folder alone: leave --rows-to out")
    if dry_run:
        _list_cells(chosen, out, force=force, limit=limit, shard=part)
        _warn_of_unread_settings(chosen)
        return
    require_reachable(where)
    warn(exposure(where))
    mirror = None if rows_to is None else _open_mirror(rows_to, out)
    _run(chosen, out, where, force=force, limit=limit, shard=part, keep=keep, mirror=mirror, quiet=quiet, wide=wide)


def merge_runs_command(
    folders: Annotated[list[str], typer.Argument(metavar="RUN...", help="run folders of one plan, or URLs of rows")],
    out: Annotated[Path, typer.Option("--out", help="run folder: new or empty", show_default=False)],
    keep: Annotated[
        Literal["answers", "sessions"], typer.Option(help="`answers`: leave sessions and maps behind")
    ] = "sessions",
    wide: Wide = False,
    quiet: Quiet = False,
) -> None:
    """Unite the run folders of shards, or of parts of a plan, into one. A cell that two hold must be the same."""
    from contextlib import ExitStack
    from tempfile import TemporaryDirectory

    from cdpipe.core.errors import InputError
    from eval.running.scaling.merging import merge_runs
    from eval.running.scaling.mirror import Mirror, is_url

    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: is a file or not empty: name a new or empty folder for the output")
    with ExitStack() as stack, shown_progress(quiet, rate="cells") as progress:
        places = []
        for folder in folders:
            places.append(Path(folder))
            if is_url(folder):
                places[-1] = Path(stack.enter_context(TemporaryDirectory(prefix="tunnelcd-")))
                Mirror(folder).fetch_all(places[-1], progress)
        found = merge_runs(places, out, command=_command(), keep=keep, names=folders, progress=progress)
    for note in found.notes:
        warn(note)
    print_results(out, quiet, wide=wide)
    shared = f", {found.n_shared} of them in several and equal" if found.n_shared else ""
    say(quiet, f"{out}: {found.n_cells} cells of {len(folders)} runs{shared}")


def score(
    folder: Annotated[Path, typer.Argument(help="a run folder; or a simulated pair, followed by an answer")],
    answer: Annotated[Path | None, typer.Argument(help="folder of one answer to the pair", show_default=False)] = None,
    predictions: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="answers of others, DIR/<scenario>/<seed>/answer.json", show_default=False),
    ] = None,
    name: Annotated[
        str | None, typer.Option("--as", metavar="NAME", help="their variant in the tables", show_default=False)
    ] = None,
    as_json: AsJson = False,
    out: JsonFile = None,
    wide: Wide = False,
    quiet: Quiet = False,
) -> None:
    """Score stored answers against the truth again, or the answers of another program; no method is run."""
    require_json_file(out)
    _require_scorable(folder, answer, predictions, name)
    if answer is not None:
        from eval.running.scaling.remaking import remade_below
        from eval.scoring.scoring import score

        with shown_progress(quiet) as progress, remade_below([folder], progress):
            row = score(answer, folder)
        tell_json(row, as_json=as_json, file=out)
        if not as_json and not quiet:
            print_pair_row(row, wide=wide)
        return
    from eval.core.output import only_writer
    from eval.running.predictions import add_predictions
    from eval.running.rescoring import rescore
    from eval.running.runfolder import open_run_folder

    run = open_run_folder(folder)
    with only_writer(run.path), shown_progress(quiet) as progress:
        if predictions is not None and name is not None:
            n_scored, told = add_predictions(run, predictions, name, progress), f"predictions scored as {name}"
        else:
            n_scored, told = rescore(run, progress), "answers scored again"
    if as_json or out is not None:
        import pandas as pd

        tell_json(pd.read_csv(run.path / "results.csv").to_dict("records"), as_json=as_json, file=out)
    if as_json:
        return
    if wide or quiet:
        print_results(run.path, quiet, wide=wide)
    else:
        print_summary(run.path)
    say(quiet, f"{folder}: {n_scored} {told}, tables rewritten")


def _require_scorable(folder: Path, answer: Path | None, predictions: Path | None, name: str | None) -> None:
    """Refuse what `score` cannot take together.

    Raises:
        InputError: One line with what to give instead.
    """
    from cdpipe.core.errors import InputError

    if (predictions is None) != (name is None):
        raise InputError("--predictions and --as: a run takes predictions under a name: give both, or neither")
    if answer is not None and predictions is not None:
        raise InputError("--predictions: goes with a run folder alone, not with one pair and its answer")
    if (folder / "answer.json").is_file() and answer != folder:
        raise InputError(f"{folder}: an answer; its pair comes first: `tunnelcd score {answer or 'PAIR'} {folder}`")
    if answer is None and (folder / "truth" / "changes.json").is_file():
        raise InputError(f"{folder}: a pair of sessions; name an answer to it, too: `tunnelcd score {folder} ANSWER`")
    if answer is not None and (folder / "provenance.json").is_file() and (folder / "pairs").is_dir():
        raise InputError(
            f"{folder}: a run, no pair: name a pair below {folder / 'pairs'}; answers to all of its pairs go by "
            f"`tunnelcd score {folder} --predictions DIR --as NAME`"
        )


def export(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="a run folder")],
    out: Annotated[
        Path, typer.Option("--out", help="folder: new, empty, or of an earlier export to continue", show_default=False)
    ],
    blind: Annotated[
        bool,
        typer.Option("--blind/--with-truth", help="without truth and under opaque names; or the pairs as they are"),
    ] = True,
    quiet: Quiet = False,
) -> None:
    """Copy the sessions of a run for another program: without truth, under names that tell nothing."""
    from eval.running.export import export_blind, export_with_truth
    from eval.running.runfolder import open_run_folder

    run = open_run_folder(folder)
    with shown_progress(quiet) as progress:
        n_written = (export_blind if blind else export_with_truth)(run, out, progress)
    told = "without truth; blind.json of the run says which is which" if blind else "with truth"
    say(quiet, f"{out}: {count_pairs(n_written)} of sessions written now, {told}")


def report(
    folder: Annotated[str, typer.Argument(metavar="RUN", help="a run folder")],
    other: Annotated[
        str | None,
        typer.Argument(metavar="B", help="a second run, compared with the first; RUN:VARIANT is one method of a run"),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option(
            metavar="VARIANT",
            help="compare every method of the run with this one",
            show_default=False,
            autocompletion=complete_method,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="folder of a comparison; else the second run's", show_default=False),
    ] = None,
    views: Annotated[
        Literal["chosen", "none", "all"],
        typer.Option(help="3-D views beside the page: of the first and the worst pairs, none, or all"),
    ] = "chosen",
    slim: Annotated[
        bool, typer.Option("--slim/--sharp", help="pictures compressed; or with every pixel, four times the bytes")
    ] = True,
    keep: Annotated[
        bool, typer.Option("--keep", help="keep pictures of the page that is there where their sessions are gone")
    ] = False,
    index: Annotated[
        bool, typer.Option("--index", help="RUN is a folder of reports: write the page that leads to all of them")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Write one offline page with tables, plots and pictures of a run; or of the differences between two runs."""
    from cdpipe.core.errors import InputError

    if index:
        from eval.report.framing.catalogue import write_index

        if other is not None or against is not None or out is not None:
            raise InputError("--index: an index is of one folder of reports: leave B, --against and --out out")
        if views != "chosen" or keep or not slim:
            raise InputError("--index: an index has no pictures: leave --views, --keep and --sharp out")
        echo(f"page: {write_index(Path(folder))}")
        return
    if other is None and against is None:
        from eval.report.page import write_page
        from eval.running.runfolder import open_run_folder

        if out is not None:
            raise InputError("--out: the page of a run lies in its folder: leave --out to a comparison")
        run = open_run_folder(Path(folder))
        with shown_progress(quiet) as progress:
            page = write_page(run.path, views, is_slim=slim, keeps=keep, progress=progress)
        echo(f"page: {page}")
        return
    if views != "chosen" or keep or not slim:
        raise InputError("the page of a comparison has no pictures: leave --views, --keep and --sharp out")
    if other is not None and against is not None:
        raise InputError(f"--against {against}: a second run is named too: write {folder}:{against} {other} instead")
    from eval.report.comparing.page import compare_sides, write_comparison
    from eval.running.results.sides import read_side

    first, second = (folder, other) if other is not None else (f"{folder}:{against}", folder)
    a, b = read_side(first), read_side(second)
    found = compare_sides(a, b)
    page = write_comparison(found, out or b.path)
    if not quiet:
        print_comparison(found)
    echo(f"page: {page}")


def _list_cells(plan: Plan, out: Path, *, force: bool, limit: int | None, shard: Shard | None) -> None:
    from collections import Counter

    from eval.running.runner import list_cells

    every = list_cells(plan, out, force=force, limit=limit, shard=shard)
    for cell, state in every:
        echo(f"{state:<8}  {cell.scenario} {cell.seed} {cell.variant}")
    count = Counter(state for _, state in every)
    left = f", {count['left']} left by --limit" if count["left"] else ""
    echo(f"{out}: {len(every)} cells: {count['finished']} finished, {count['to do']} to do{left}; nothing was run")


def _command() -> str:
    return shlex.join(["tunnelcd", *sys.argv[1:]])


def _open_mirror(url: str, out: Path) -> Mirror:
    from cdpipe.core.errors import InputError
    from eval.running.scaling.mirror import Mirror, is_url

    place = url.removeprefix("file://")
    if not is_url(place) and Path(place).resolve() == out.resolve():
        raise InputError(f"--rows-to {url}: is the run folder itself: name another place")
    return Mirror(url)


def _warn_of_unread_settings(plan: Plan) -> None:
    from eval.plans.cells import explain_unread_settings

    for text in explain_unread_settings(plan):
        warn(text)


def _run(plan: Plan, out: Path, where: Where, *, quiet: bool, wide: bool = False, **options: Any) -> None:
    from eval.plans.cells import expand_cells
    from eval.running.runfolder import held_run_folder
    from eval.running.runner import run_plan
    from eval.running.scaling.shards import choose_cells

    # raises where settings contradict each other, or there are too many shards, before a folder is made
    choose_cells(expand_cells(plan), options.get("shard"))
    _warn_of_unread_settings(plan)
    command = ["tunnelcd", *sys.argv[1:]]
    with held_run_folder(out) as run, shown_progress(quiet, rate="cells") as progress:
        outcome = run_plan(plan, run, command=command, where=where, progress=progress, **options)
    print_results(out, quiet, wide=wide)
    left = f", {outcome.n_left} left by --limit" if outcome.n_left else ""
    died = f", {outcome.n_died} of all killed their workers" if outcome.n_died else ""
    say(quiet, f"{out}: {outcome.n_done} cells done, {outcome.n_kept} kept from earlier{left}{died}")
