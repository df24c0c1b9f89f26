"""Commands about stories: two sessions of one as a pair, and the report of all."""

# ruff: noqa: PLC0415 - heavy imports stand inside the commands, so that --help and completion are instant
from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from eval.cli.inputs import read_metres, with_surface
from eval.cli.options import KindOfSite, OutFolder, Preset, Quiet, SetSettings
from eval.core.terminal.printing import LINE, echo, print_table, say, shown_warnings
from eval.core.terminal.progress import shown_progress

Story = Annotated[Path, typer.Argument(metavar="STORY", help="folder of `simulate --sessions N`")]


def pair(
    story: Story,
    before: Annotated[int, typer.Argument(min=1, help="number of the before session")],
    after: Annotated[int, typer.Argument(min=1, help="number of the after session; it may be the earlier one")],
    out: OutFolder,
    quiet: Quiet = False,
) -> None:
    """Make two sessions of a story a pair with its truth, as `simulate` writes one."""
    from eval.core.output import new_folder
    from sim.story import PairMaker

    maker = PairMaker(story)
    with new_folder(out) as partial, shown_progress(quiet) as progress:
        truth = maker.make(before, after, partial, progress.stage)
    rock = f", {len(truth.surface_changes)} of rock" if truth.surface_changes else ""
    say(quiet, f"{out}: sessions {before} and {after} of {story}: {len(truth.changes)} changes of props{rock}")


def story_command(
    story: Story,
    out: Annotated[Path, typer.Option("--out", help="folder: new, empty, or of an earlier report to continue")],
    preset: Preset = "tunnelcd",
    site: KindOfSite = "narrow",
    settings: SetSettings = None,
    at: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y,Z", help="follow this place too: metres, odometry of session 1; may be repeated"),
    ] = None,
    with_truth: Annotated[
        bool, typer.Option("--with-truth/--without-truth", help="compare with the truth of a simulated story")
    ] = True,
    quiet: Quiet = False,
) -> None:
    """Compare session 1 of a story with every later one: displacement of places and props over the sessions."""
    import numpy as np

    from eval.stories import write_story_page
    from eval.stories.comparisons import Method, run_comparisons
    from eval.stories.places import is_measured

    given = [np.array(read_metres("at", text)) for text in at or ()]
    method = Method(preset, site, tuple(with_surface(preset, settings or (), site)))
    with shown_warnings(), shown_progress(quiet, rate="sessions") as progress:
        comparisons = run_comparisons(story, out, method, progress, with_truth=with_truth)
    moved = write_story_page(story, out, method, comparisons, given)
    if moved.empty:
        measured = is_measured(comparisons)
        say(quiet, "no region of rock moved in any session" if measured else "rock was not measured in any session")
    elif not quiet:
        print_table("displacement since session 1, mm, and 95 % level of detection", moved, LINE)
    echo(f"page: {out / 'index.html'}")
