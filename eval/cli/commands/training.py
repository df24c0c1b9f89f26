"""Commands that make training data and descriptors."""

# ruff: noqa: PLC0415 - heavy imports stand inside the commands, so that --help and completion are instant
from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from eval.cli.options import (
    OldWorldSettings,
    Quiet,
    Scheduler,
    Workers,
    WorldSettings,
    complete_release,
    complete_scenario,
    join_world_settings,
    world_mistakes,
)
from eval.core.terminal.printing import count_pairs, say, warn
from eval.core.terminal.progress import shown_progress

if TYPE_CHECKING:
    from eval.core.cluster import Where


def dataset(
    families: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="FAMILY",
            help="names from `list`, or .yaml files",
            show_default=False,
            autocompletion=complete_scenario,
        ),
    ] = None,
    seeds: Annotated[
        str | None,
        typer.Option(metavar="A:B", help="B excluded; below 10000 to train, 10000 to 19999 to validate"),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="data folder: new, empty, or of an earlier run to continue; a release: or FILE.zip"),
    ] = None,
    world: WorldSettings = None,
    settings: OldWorldSettings = None,
    draws: Annotated[int, typer.Option(min=1, help="after images of each keyframe; the first is merged exactly")] = 4,
    error_m: Annotated[
        float, typer.Option(min=0, max=10, help="merge error of the other draws: translation, 1 sigma")
    ] = 0.03,
    error_deg: Annotated[float, typer.Option(min=0, max=180, help="rotation, 1 sigma per component")] = 0.2,
    afters: Annotated[int, typer.Option(min=1, max=12, help="after sessions of each tunnel, one shard each")] = 1,
    release: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="pack pairs of sessions to hand out instead: `lite`",
            show_default=False,
            autocompletion=complete_release,
        ),
    ] = None,
    unpack: Annotated[
        Path | None, typer.Option(metavar="FILE.zip", help="check and unpack a release instead", show_default=False)
    ] = None,
    with_truth: Annotated[bool, typer.Option("--with-truth", help="of --unpack: pairs with their truth")] = False,
    workers: Workers = None,
    scheduler: Scheduler = None,
    limit: Annotated[int | None, typer.Option(min=1, help="make at most this many tunnels, or pairs")] = None,
    quiet: Quiet = False,
) -> None:
    """Make training data for descriptors, one shard per tunnel; or a release of pairs. What is finished is kept."""
    from cdpipe.core.errors import InputError
    from eval.core.cluster import Where, exposure, require_reachable, require_usable
    from eval.training.dataset import Recipe
    from eval.training.dataset_run import make_dataset

    where = Where(workers, scheduler)
    recipe = Recipe(draws, error_m, error_deg, tuple(join_world_settings(world, settings)), afters)
    if out is None:
        raise InputError("dataset: no place for the data: name it with --out")
    if release is not None or unpack is not None:
        if release is not None and unpack is not None:
            raise InputError("--release packs pairs, --unpack unpacks them: name one of both")
        what = f"--release {release}" if unpack is None else f"--unpack {unpack}"
        if families or seeds or recipe != Recipe():
            more = "FAMILY, --seeds, --world, --draws, --error-m, --error-deg and --afters"
            raise InputError(f"{what}: has pairs and settings of its own: leave {more} out")
        if unpack is not None and (where != Where() or limit is not None):
            raise InputError(f"{what}: it is unpacked here and as a whole: leave --workers, --scheduler, --limit out")
        if with_truth and unpack is None:
            raise InputError("--with-truth: a release holds the truth, apart from the sessions: leave it out")
        _release_or_unpack(release, unpack, out, where, limit, quiet=quiet, with_truth=with_truth)
        return
    if not families or seeds is None or with_truth:
        raise InputError(
            "dataset: expected FAMILY... with --seeds A:B and --out DIR; --release NAME with --out FILE.zip; or "
            "--unpack FILE.zip with --out DIR"
        )
    require_usable(where)
    require_reachable(where)
    warn(exposure(where))
    with world_mistakes(), shown_progress(quiet, rate="tunnels") as progress:
        command = shlex.join(["tunnelcd", *sys.argv[1:]])
        outcome = make_dataset(families, seeds, recipe, out, where, limit, command, progress)
    left = f", {outcome.n_left} left by --limit" if outcome.n_left else ""
    refused = f", {outcome.n_refused} refused (README.md says why)" if outcome.n_refused else ""
    rate = f"; {outcome.n_pairs} keyframe pairs, {outcome.n_pairs / outcome.seconds:.1f}/s" if outcome.n_made else ""
    say(quiet, f"{out}: {outcome.n_made} tunnels made, {outcome.n_kept} kept from earlier{refused}{left}{rate}")


def _release_or_unpack(
    name: str | None,
    file: Path | None,
    out: Path,
    where: Where,
    limit: int | None,
    *,
    quiet: bool,
    with_truth: bool,
) -> None:
    from eval.core.provenance import digest_file
    from eval.release.archive import unpack_release
    from eval.release.content import load_release
    from eval.release.making import make_release

    if file is not None:
        with shown_progress(quiet) as progress:
            n_pairs = unpack_release(file, out, with_truth=with_truth, progress=progress)
        kind = "with truth" if with_truth else "without truth"
        say(quiet, f"{out}: {count_pairs(n_pairs)} {kind}, all digests right")
        return
    with shown_progress(quiet, rate="pairs") as progress:
        outcome = make_release(load_release(name or ""), out, where, limit, progress)
    made = f"{count_pairs(outcome.n_made)} made, {outcome.n_kept} kept from earlier"
    if outcome.n_left:
        say(quiet, f"{out}: {made}, {outcome.n_left} left by --limit: the same command goes on from there")
        return
    digest = f", SHA-256 {digest_file(out)}" if out.is_file() else ""
    say(quiet, f"{out}: {made}; {outcome.n_bytes / 1e6:.0f} MB{digest}")


def train(
    data: Annotated[Path, typer.Argument(metavar="DIR", help="made by `tunnelcd dataset`, tunnels of both splits")],
    out: Annotated[Path, typer.Option("--out", help="folder for checkpoint, model card and curves")],
    descriptor: Annotated[str, typer.Option(help="sphere, 3deg, or the network of range-net")] = "sphere",
    steps: Annotated[int, typer.Option(min=1, help="largest number of training steps")] = 4000,
    seed: Annotated[int, typer.Option(min=0, max=2**64 - 1, help="seed of the initial weights and of every draw")] = 0,
    threads: Annotated[int, typer.Option(min=1, help="number of torch's threads; another gives other weights")] = 2,
    patience: Annotated[int, typer.Option(min=1, help="stop after this many validations without a better score")] = 6,
    device: Annotated[Literal["cpu", "cuda"], typer.Option(help="where the network computes; cuda: a GPU")] = "cpu",
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
        checkpoint, card = train_descriptor(data, out, descriptor, config, threads, command, progress, device)
    if card["validation"].get("calibration", {}).get("slope") == 0:
        warn("the network ranks the validation tunnels no better than chance: train it on more tunnels, or longer")
    scores = ", ".join(f"{name} {value}" for name, value in card["validation"]["trained"].items())
    say(quiet, f"{checkpoint}: best of step {card['best_step']} on validation tunnels: {scores}")
