"""Commands for a method of others: evaluate it, pack its results, and make the leaderboard page."""

# ruff: noqa: PLC0415 - heavy imports stand inside the commands, so that --help and completion are instant
from __future__ import annotations

import sys
from itertools import chain
from pathlib import Path
from textwrap import wrap
from typing import Annotated, Literal

import typer

from eval.cli.options import Quiet, RunOut, complete_plan
from eval.core.terminal.printing import count_pairs, echo, say, warn
from eval.core.terminal.progress import shown_progress


def template(
    file: Annotated[Path, typer.Argument(metavar="FILE.py", help="the new file")],
    merge: Annotated[
        Literal["own", "given"], typer.Option(help="`given`: shorter, for `evaluate --merge given` or `ours`")
    ] = "own",
    quiet: Quiet = False,
) -> None:
    """Write a whole method of some lines, for you to change: what `evaluate` calls."""
    from shlex import quote

    from eval.leaderboard.templates import write_template

    write_template(file, merge)
    words, option = (
        ("{before} {after} {out}", "") if merge == "own" else ("{before} {after} {out} {merge}", " --merge given")
    )
    say(
        quiet,
        f'tunnelcd evaluate --plan smoke --command "python {quote(str(file))} {words}"{option} --as mine --out bench',
    )


def evaluate(
    plan: Annotated[
        str,
        typer.Option(
            "--plan", help="name from `list`, or a .yaml file", show_default=False, autocompletion=complete_plan
        ),
    ],
    command: Annotated[
        str,
        typer.Option(
            "--command",
            metavar='"PROGRAM {before} {after} {out}"',
            help="what answers one pair; {merge} as well where one is given",
            show_default=False,
        ),
    ],
    name: Annotated[str, typer.Option("--as", metavar="NAME", help="its name in the tables", show_default=False)],
    out: RunOut,
    merge: Annotated[
        Literal["given", "ours", "own"],
        typer.Option(help="{merge} is the true one (`given`), that of tunnelcd (`ours`), or the method brings its own"),
    ] = "own",
    seeds: Annotated[str | None, typer.Option(metavar="A:B", help="replaces the plan's seeds; B excluded")] = None,
    split: Annotated[
        str,
        typer.Option(
            metavar="dev|sealed",
            help="sealed: other seeds, drawn from this version's name; sealed:0.1.0: from that one's",
        ),
    ] = "dev",
    time_limit: Annotated[float, typer.Option(min=0.1, max=86_400, help="seconds for one pair, wall clock")] = 600.0,
    reference: Annotated[
        Path | None,
        typer.Option(help="run or report to compare with; else the committed report of the plan", show_default=False),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="answer finished pairs again")] = False,
    quiet: Quiet = False,
) -> None:
    """Score a program of yours on the pairs of a plan, beside the reference results. Finished pairs are kept."""
    from eval.leaderboard.calls import require_an_answer
    from eval.leaderboard.command import parse_command
    from eval.leaderboard.evaluation import Method, evaluate_command
    from eval.leaderboard.reference import find_reference, why_nothing_compares
    from eval.plans.cells import list_planned_cases
    from eval.plans.changes import change_plan
    from eval.plans.plan import load_plan
    from eval.running.runfolder import held_run_folder

    method = Method(name, parse_command(command, gets_merge=merge != "own"), merge, time_limit)
    chosen = change_plan(load_plan(plan), seeds=seeds, split=split)
    committed = find_reference(chosen.name, reference)
    pairs = sorted({(world, seed) for world, seed, _ in list_planned_cases(chosen)})
    warn(why_nothing_compares(chosen.name, pairs, committed, out, name))
    with held_run_folder(out) as run, shown_progress(quiet, rate="pairs") as progress:
        argv = ["tunnelcd", *sys.argv[1:]]
        outcome = evaluate_command(chosen, run, method, command=argv, force=force, progress=progress)
    _compare(out, name, committed, quiet=quiet)
    kept = f", {outcome.n_kept} kept from earlier" if outcome.n_kept else ""
    n_pairs = outcome.n_done + outcome.n_kept
    told = f"{count_pairs(outcome.n_done)} asked now{kept}; {outcome.n_failed} of {n_pairs} without an answer"
    say(quiet, f"{out}: {told}")
    if outcome.n_failed_kept:
        warn(f"{count_pairs(outcome.n_failed_kept)} without an answer are kept from earlier: --force asks all again")
    require_an_answer(run, name)


def _compare(out: Path, name: str, committed: object, *, quiet: bool) -> None:
    """Write the tables that compare a method with the reference, and print the first."""
    import pandas as pd

    from eval.leaderboard.calls import describe_calls, evaluation_folder, read_evaluation
    from eval.leaderboard.comparison import compare_with_reference, list_lines, write_tables_of
    from eval.running.results.run_data import RunData, read_run
    from eval.running.runfolder import RunFolder

    run = RunFolder(out)
    data, evaluation = read_run(out), read_evaluation(run, name)
    pairs = set(evaluation.pairs)
    rows = [row for row in data.results if row["variant"] == name and (row["scenario"], row["seed"]) in pairs]
    references = [data, *([committed] if isinstance(committed, RunData) else [])]
    found = compare_with_reference(pd.DataFrame(rows), name, references, describe_calls(run, evaluation))
    folder = evaluation_folder(run, name)
    write_tables_of(found, folder)
    if not quiet:
        notes = (wrap(f"note: {text}", 80, subsequent_indent="      ", break_long_words=False) for text in found.notes)
        echo(*list_lines(found), *chain.from_iterable(notes))
        echo(f"in {folder}: table.csv, differences.csv, comparison.csv")


def submit(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="folder of `evaluate`")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE.zip", help="the file", show_default=False)],
    name: Annotated[
        str, typer.Option("--as", metavar="NAME", help="which method, where DIR holds several", show_default=False)
    ] = "",
    quiet: Quiet = False,
) -> None:
    """Pack the rows, answers and provenance of an evaluated method into one file."""
    from eval.leaderboard.packing import pack_submission
    from eval.running.runfolder import open_run_folder

    n_pairs = pack_submission(open_run_folder(folder), name, out)
    say(quiet, f"{out}: {count_pairs(n_pairs)}, {out.stat().st_size / 1e6:.3g} MB")


def leaderboard(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="made by `submit`")],
    out: Annotated[Path, typer.Option("--out", metavar="PAGE.html", help="the page", show_default=False)],
    pairs: Annotated[
        Path | None,
        typer.Option(metavar="RUN", help="run that holds the pairs: all answers are scored again", show_default=False),
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(help="run or report with reference rows; else the committed ones", show_default=False),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Check packed results and make one offline page of them, beside the reference rows."""
    from eval.leaderboard.page import require_page, write_leaderboard
    from eval.leaderboard.submission import read_submission, score_again
    from eval.running.runfolder import open_run_folder

    require_page(out)
    run = None if pairs is None else open_run_folder(pairs)
    found = []
    with shown_progress(quiet) as progress:
        for done, path in enumerate(files):
            progress.cells(str(path), done, len(files))
            each = read_submission(path)
            found.append(each if run is None else score_again(each, run))
        progress.cells("done", len(files), len(files))
    write_leaderboard(found, out, reference)
    echo(f"page: {out}")
