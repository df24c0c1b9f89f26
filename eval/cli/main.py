"""The command line: the commands by name, and how it ends.

Exit codes: 0 done, 2 the input is at fault (one line each on standard error), 1 a bug (a traceback), 130 interrupted.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from cdpipe.core.threads import fix_threads
from eval.cli import converting, tracing
from eval.cli import leaderboard as commands_leaderboard
from eval.cli import pair as commands_pair
from eval.cli import run as commands_run
from eval.cli import stories as commands_stories
from eval.cli import tools as commands_tools
from eval.cli import training as commands_training
from eval.cli import world as commands_world
from eval.core.exits import input_errors, run_app
from eval.core.printing import echo


class _Funnel(TyperGroup):
    def make_context(self, *arguments: Any, **options: Any) -> Any:
        """Read the arguments; typer would end an interrupt meanwhile without a word."""
        try:
            return super().make_context(*arguments, **options)
        except KeyboardInterrupt as error:
            sys.stderr.write("interrupted; nothing was written\n")
            raise typer.Exit(130) from error

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        try:
            with input_errors():
                return super().invoke(ctx)
        except KeyboardInterrupt as error:
            kept = _KEPT.get(ctx.invoked_subcommand or "")
            going_on = f"finished {kept} are kept, the same command goes on from there"
            told = going_on if kept else "nothing half-written is left"
            sys.stderr.write(f"interrupted; {told}\n")
            raise typer.Exit(130) from error


_KEPT = {
    "run": "cells", "demo": "cells", "dataset": "tunnels", "export": "pairs", "story": "comparisons",
    "evaluate": "pairs",
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
    "demo": commands_run.demo,
    "simulate": commands_world.simulate,
    "pair": commands_stories.pair,
    "graft": commands_world.graft,
    "survey": commands_world.survey,
    "view": commands_world.view,
    "describe": commands_pair.describe,
    "detect": commands_pair.detect,
    "story": commands_stories.story_command,
    "convert": converting.convert,
    "trace": tracing.trace,
    "score": commands_run.score,
    "run": commands_run.run_command,
    "merge-runs": commands_run.merge_runs_command,
    "export": commands_run.export,
    "template": commands_leaderboard.template,
    "evaluate": commands_leaderboard.evaluate,
    "submit": commands_leaderboard.submit,
    "leaderboard": commands_leaderboard.leaderboard,
    "report": commands_run.report,
    "dataset": commands_training.dataset,
    "train": commands_training.train,
    "bench": commands_tools.bench,
    "list": commands_tools.list_command,
    "check": commands_tools.check,
    "doctor": commands_tools.doctor,
}
for _name, _command in _COMMANDS.items():
    app.command(_name)(_command)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line and exit."""
    fix_threads()
    run_app(app, "tunnelcd", sys.argv[1:] if argv is None else argv, tuple(_COMMANDS))
