"""Commands that make sessions and measure worlds: simulate, graft, survey."""

# ruff: noqa: PLC0415 - heavy imports stand inside the commands, so that --help and completion are instant
from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from eval.cli.inputs import RECORDING, Deskew, Format, Metadata, Odometry, Origin, Topics, Trajectories, tell_recordings
from eval.cli.options import (
    Families,
    OldWorldSettings,
    OutFolder,
    Quiet,
    WorldSettings,
    complete_recording,
    complete_scenario,
    join_world_settings,
    world_mistakes,
)
from eval.core.terminal.printing import LINE, echo, print_table, say, shown_warnings
from eval.core.terminal.progress import shown_progress


def simulate(
    scenario: Annotated[
        str, typer.Argument(help="name from `list`, or a .yaml file", autocompletion=complete_scenario)
    ],
    out: OutFolder,
    seed: Annotated[int, typer.Option(min=0, help="seed of every distribution and of all noise")] = 0,
    sessions: Annotated[
        int, typer.Option(min=2, max=12, help="3 to 12: a story, DIR/session-01 ..., of which `pair` takes any two")
    ] = 2,
    world: WorldSettings = None,
    settings: OldWorldSettings = None,
    quiet: Quiet = False,
) -> None:
    """Simulate one pair of sessions with truth: DIR/before, DIR/after, DIR/truth."""
    from eval.core.output import new_folder
    from eval.graft import fill_pair
    from scenarios import load_scenario
    from sim.story import simulate_story

    with world_mistakes():
        drawn = load_scenario(scenario, seed, join_world_settings(world, settings))
    with shown_warnings(), new_folder(out) as partial, shown_progress(quiet) as progress:
        if sessions == 2:
            fill_pair(drawn, seed, partial, progress.stage)
        else:
            simulate_story(drawn, seed, sessions, partial, on_progress=progress.stage)
    told = "before, after, truth" if sessions == 2 else f"{sessions} sessions and story.json"
    say(quiet, f"{out}: {told} of {scenario}, seed {seed}")


def graft(
    out: OutFolder,
    recordings: Annotated[
        list[Path] | None, typer.Argument(metavar="SESSION [SESSION2]", help=RECORDING, show_default=False)
    ] = None,
    objects: Annotated[
        str,
        typer.Option(
            "--objects",
            help="props, rock that moves: a scenario's name or .yaml file; none: a real pair without changes",
            autocompletion=complete_scenario,
        ),
    ] = "none",
    seed: Annotated[int, typer.Option(min=0, help="seed of the props, their places and all noise")] = 0,
    split: Annotated[
        Literal["auto", "passes", "halves", "alternate"],
        typer.Option(help="of one recording; auto: two passes of one way, else every other revolution"),
    ] = "auto",
    before_T_after: Annotated[
        Path | None,
        typer.Option(
            "--before-T-after", metavar="FILE", help="merge of two recordings; else tunnelcd's", show_default=False
        ),
    ] = None,
    recording: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="public recording, see `list recordings`",
            show_default=False,
            autocompletion=complete_recording,
        ),
    ] = None,
    root: Annotated[
        Path | None, typer.Option(metavar="DIR", help="folder with the files of --recording", show_default=False)
    ] = None,
    clearance_m: Annotated[float, typer.Option("--clearance", min=0.1, help="m from the path to a prop")] = 0.8,
    reach_m: Annotated[float, typer.Option("--reach", min=1, help="m from the path within which props stand")] = 10.0,
    form: Format = None,
    topics: Topics = None,
    trajectory: Trajectories = None,
    odometry: Odometry = None,
    metadata: Metadata = None,
    deskew: Deskew = True,
    origin: Origin = None,
    quiet: Quiet = False,
) -> None:
    """Cast props into real recordings and move rock: DIR/before, DIR/after, and DIR/truth as `simulate` writes it."""
    from cdpipe.core.errors import InputError
    from eval.graft.adapters import locate_recording
    from eval.graft.making import make_pair
    from eval.graft.telling import tell_pair
    from scenarios.library import load_grafted
    from sim.session.truth import read_pair_truth

    if root is not None and recording is None:
        raise InputError("--root: it holds the files of a public recording: name that with --recording")
    public = {} if recording is None else locate_recording(recording, root)
    paths = [*(recordings or []), *(Path(name) for name in public.get("sessions", ()))]
    _refuse_contradictions(len(paths), split, before_T_after, clearance_m, reach_m)
    told = tell_recordings(paths, form, topics, trajectory, odometry, metadata, deskew=deskew, origin=origin)
    for name in ("format", "topics", *(() if trajectory else ("odometry",))):
        told[name] = told[name] or public.get(name, told[name])  # what is said on the command line holds
    told |= {"split": split, "clearance_m": clearance_m, "reach_m": reach_m}
    told |= {} if before_T_after is None else {"before_T_after": str(before_T_after)}
    drawn = load_grafted(objects, told, seed)
    with shown_warnings(), shown_progress(quiet) as progress:
        make_pair(drawn, seed, out, progress.stage)
    if not quiet:
        echo(f"{out}: before, after, truth; {objects} grafted, seed {seed}", *tell_pair(read_pair_truth(out)))


def _refuse_contradictions(
    n_recordings: int, split: str, before_T_after: Path | None, clearance_m: float, reach_m: float
) -> None:
    """Refuse what `scenarios.grafted.Recording` refuses by its keys, by the names of the options."""
    from cdpipe.core.errors import InputError

    if split != "auto" and n_recordings == 2:
        raise InputError(f"--split {split}: splits one recording, and there are 2: leave it out")
    if before_T_after is not None and n_recordings == 1:
        raise InputError(
            f"--before-T-after {before_T_after}: merges two recordings, and there is 1, whose parts are in one frame: "
            "leave it out"
        )
    if reach_m <= clearance_m:
        raise InputError(f"--reach {reach_m:g}: expected more than --clearance, {clearance_m:g}: props stand between")


def survey(
    families: Families,
    seeds: Annotated[str, typer.Option(metavar="A:B", help="B excluded")] = "0:10",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.csv", help="also write one row per seed", show_default=False)
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="number of processes")] = 1,
    markdown: Annotated[bool, typer.Option("--markdown", help="print the table in Markdown")] = False,
    quiet: Quiet = False,
) -> None:
    """Build the worlds of families without scanning them; print size, density, changes, repose and roughness."""
    import pandas as pd

    from cdpipe.core.errors import InputError
    from eval.core.output import make_writable, require_replaceable
    from eval.plans.seeds import parse_seeds_option
    from scenarios import load_scenario
    from sim.studies import survey as surveys
    from sim.studies.survey import markdown as as_markdown
    from sim.studies.survey import summary, write_csv

    numbers = parse_seeds_option(seeds)
    for family in families:
        load_scenario(family, numbers[0])  # before a folder is made
    if out is not None:
        make_writable(out.absolute().parent)
        require_replaceable(out, b"family,seed,before_path_m", "table of `tunnelcd survey`")
    with shown_progress(quiet) as progress:
        found = [surveys.survey(family, numbers, workers, progress.cells) for family in families]
    failures = [failure for one in found for failure in one.failures]
    if failures and not any(one.worlds for one in found):
        raise InputError("\n".join(dict.fromkeys(f"{failure.family}: {failure.reason}" for failure in failures)))
    if out is not None:
        write_csv(out, found)
    if markdown:
        echo(*as_markdown(found).split("\n"))
    elif not quiet:
        table = pd.DataFrame([summary(one) for one in found]).T.reset_index()
        print_table("figures", table.iloc[1:].set_axis(["", *families], axis=1), LINE)
    for failure in failures:
        echo(f"failed: {failure.family}, seed {failure.seed}: {failure.reason}")
    n_worlds = sum(len(one.worlds) for one in found)
    say(quiet, f"{n_worlds} worlds built, {len(failures)} failed{'' if out is None else f'; one row each in {out}'}")
