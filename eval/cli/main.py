"""The command line: the commands by name, and how it ends.

Exit codes: 0 done, 2 the input is at fault (one line each on standard error), 1 a bug (a traceback), 130 interrupted
(128 + n by signal n: 143 SIGTERM, 129 SIGHUP).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from cdpipe.core.threads import fix_threads
from eval.cli.commands import converting, leaderboard, pair, run, stories, tools, tracing, training, viewing, world
from eval.core.terminal.exits import input_errors, run_app
from eval.core.terminal.interrupts import interrupts_kept, tell_interrupt
from eval.core.terminal.printing import echo


class _Funnel(TyperGroup):
    def make_context(self, *arguments: Any, **options: Any) -> Any:
        """Read the arguments; typer would end an interrupt meanwhile without a word."""
        try:
            return super().make_context(*arguments, **options)
        except KeyboardInterrupt as error:
            raise typer.Exit(tell_interrupt("nothing was written")) from error

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        try:
            with input_errors(), interrupts_kept():
                return super().invoke(ctx)
        except KeyboardInterrupt as error:
            options = {word.partition("=")[0] for word in sys.argv}  # --unpack=FILE is --unpack FILE
            kept = None if "--unpack" in options else _KEPT.get(ctx.invoked_subcommand or "")
            kept = "pairs" if kept is not None and "--release" in options else kept
            again = "the same command without --force" if "--force" in options else "the same command"
            going_on = f"finished {kept} are kept, {again} goes on from there"
            told = going_on if kept else "nothing half-written is left"
            raise typer.Exit(tell_interrupt(told)) from error


_KEPT = {
    "run": "cells", "demo": "cells", "dataset": "tunnels", "export": "pairs", "story": "comparisons",
    "evaluate": "pairs", "train": "steps up to the last validation",
}  # fmt: skip
app = typer.Typer(
    cls=_Funnel,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="A benchmark for change detection between two LiDAR sessions of a tunnel.",
)


def _print_version(is_asked: bool) -> None:
    if is_asked:
        echo(f"tunnelcd {metadata.version('tunnelcd')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="print the version and end")
    ] = False,
) -> None:
    """Measure change detection between two LiDAR sessions of a tunnel."""


# in the order in which --help tells them
_COMMANDS: dict[str, Callable[..., None]] = {
    "demo": run.demo,
    "simulate": world.simulate,
    "pair": stories.pair,
    "graft": world.graft,
    "survey": world.survey,
    "view": viewing.view,
    "describe": pair.describe,
    "detect": pair.detect,
    "story": stories.story_command,
    "convert": converting.convert,
    "trace": tracing.trace,
    "score": run.score,
    "run": run.run_command,
    "merge-runs": run.merge_runs_command,
    "export": run.export,
    "template": leaderboard.template,
    "evaluate": leaderboard.evaluate,
    "submit": leaderboard.submit,
    "leaderboard": leaderboard.leaderboard,
    "report": run.report,
    "dataset": training.dataset,
    "train": training.train,
    "bench": tools.bench,
    "list": tools.list_command,
    "check": tools.check,
    "doctor": tools.doctor,
}
for _name, _command in _COMMANDS.items():
    app.command(_name)(_command)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line and exit."""
    fix_threads()
    run_app(app, "tunnelcd", sys.argv[1:] if argv is None else argv, tuple(_COMMANDS))
