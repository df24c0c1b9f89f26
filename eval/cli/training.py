"""Commands that make training data and descriptors."""

# ruff: noqa: PLC0415 - heavy imports stand inside the commands, so that --help and completion are instant
from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from eval.cli.options import Families, Quiet, Scheduler, SetSettings, Workers
from eval.core.printing import say, warn
from eval.core.progress import shown_progress


def dataset(
    families: Families,
    seeds: Annotated[
        str, typer.Option(metavar="A:B", help="B excluded; below 10000 to train, 10000 to 19999 to validate")
    ],
    out: Annotated[Path, typer.Option("--out", help="data folder: new, empty, or of an earlier run to continue")],
    settings: SetSettings = None,
    draws: Annotated[int, typer.Option(min=1, help="after images of each keyframe; the first is merged exactly")] = 4,
    error_m: Annotated[float, typer.Option(min=0, help="merge error of the other draws: translation, 1 sigma")] = 0.03,
    error_deg: Annotated[float, typer.Option(min=0, help="rotation, 1 sigma per component")] = 0.2,
    afters: Annotated[int, typer.Option(min=1, max=12, help="after sessions of each tunnel, one shard each")] = 1,
    workers: Workers = None,
    scheduler: Scheduler = None,
    limit: Annotated[int | None, typer.Option(min=1, help="make at most this many tunnels")] = None,
    quiet: Quiet = False,
) -> None:
    """Make training data for descriptors, one shard per tunnel. Finished tunnels are kept."""
    from eval.core.cluster import Where, exposure, require_reachable, require_usable
    from eval.training.dataset import Recipe
    from eval.training.dataset_run import make_dataset

    recipe, where = Recipe(draws, error_m, error_deg, tuple(settings or ()), afters), Where(workers, scheduler)
    require_usable(where)
    require_reachable(where)
    warn(exposure(where))
    with shown_progress(quiet, rate="tunnels") as progress:
        command = shlex.join(["tunnelcd", *sys.argv[1:]])
        outcome = make_dataset(families, seeds, recipe, out, where, limit, command, progress)
    left = f", {outcome.n_left} left by --limit" if outcome.n_left else ""
    refused = f", {outcome.n_refused} refused (README.md says why)" if outcome.n_refused else ""
    rate = f"; {outcome.n_pairs} keyframe pairs, {outcome.n_pairs / outcome.seconds:.1f}/s" if outcome.n_made else ""
    say(quiet, f"{out}: {outcome.n_made} tunnels made, {outcome.n_kept} kept from earlier{refused}{left}{rate}")


def train(
    data: Annotated[Path, typer.Argument(metavar="DIR", help="made by `tunnelcd dataset`, tunnels of both splits")],
    out: Annotated[Path, typer.Option("--out", help="folder for checkpoint, model card and curves")],
    descriptor: Annotated[str, typer.Option(help="sphere, 3deg, or the network of range-net")] = "sphere",
    steps: Annotated[int, typer.Option(min=1, help="largest number of training steps")] = 4000,
    seed: Annotated[int, typer.Option(min=0, help="seed of the initial weights and of every draw")] = 0,
    threads: Annotated[int, typer.Option(min=1, help="number of torch's threads; another gives other weights")] = 2,
    patience: Annotated[int, typer.Option(min=1, help="stop after this many validations without a better score")] = 6,
    quiet: Quiet = False,
) -> None:
    """Train a descriptor: checkpoint (safetensors), model card, curves. The same command resumes an interrupted run."""
    from cdpipe.core.errors import InputError
    from cdpipe.training.fit import FitConfig
    from eval.training.training_run import SOURCES, train_descriptor

    if descriptor not in SOURCES:
        raise InputError(f"--descriptor {descriptor}: expected {' or '.join(SOURCES)}")
    command = shlex.join(["tunnelcd", *sys.argv[1:]])
    with shown_progress(quiet) as progress:
        config = FitConfig(seed, steps, patience=patience)
        checkpoint, card = train_descriptor(data, out, descriptor, config, threads, command, progress)
    scores = ", ".join(f"{name} {value}" for name, value in card["validation"]["trained"].items())
    say(quiet, f"{checkpoint}: best of step {card['best_step']} on validation tunnels: {scores}")
