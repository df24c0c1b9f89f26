"""Makes the shards of a dataset, one per tunnel: in this process, on workers of this machine, or on a cluster.

Workers return the bytes of a shard and only this process writes, so that a cluster needs no shared disk. A shard is
written under a temporary name and renamed. A shard with the right digest is kept, so that an interrupted run continues.
A tunnel that cannot be built leaves a file with the reason, which is kept as well.
"""

from __future__ import annotations

import json
import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from cdpipe.core import files
from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.core.whole_file import whole_file
from cdpipe.training.shard import FORMAT, FORMAT_VERSION, SUFFIX, read_about
from eval.core.cluster import HERE, Where, connected, n_slots, require_usable
from eval.core.output import make_writable, only_writer
from eval.core.terminal.interrupts import raise_lost_interrupt
from eval.core.terminal.progress import RunProgress, Silent
from eval.plans.seeds import parse_seeds_option
from eval.plans.worlds import world_slug
from eval.running.runfolder import read_json, write_json
from eval.training.dataset import Recipe, make_shards, shard_digest
from eval.training.dataset_card import write_card
from scenarios.grafted import GraftScenario
from scenarios.library import load_scenario

_AHEAD = 2  # tunnels that wait in a cluster for each worker; more would only take memory


@dataclass(frozen=True, slots=True)
class Tunnel:
    """One tunnel to make; `digest` is that of its shard's inputs, "" where the scenario itself is refused."""

    family: str
    seed: int
    digest: str = ""
    refused: str = ""

    @property
    def file(self) -> str:
        """Name of its shard."""
        return f"{world_slug(self.family)}-{self.seed}{SUFFIX}"

    def files(self, afters: int) -> list[str]:
        """Names of its shards, one for each after session; the first is `file`."""
        stem = self.file.removesuffix(SUFFIX)
        return [self.file, *(f"{stem}-after-{number}{SUFFIX}" for number in range(2, afters + 1))]

    @property
    def refusal(self) -> str:
        """Name of the file with the reason why there is no shard."""
        return f"{self.file}.refused.json"


@dataclass(frozen=True, slots=True)
class DatasetOutcome:
    """Outcome of a run: tunnels made now, kept from earlier, refused (now or earlier), left by --limit."""

    n_made: int
    n_kept: int
    n_refused: int
    n_left: int
    n_pairs: int
    seconds: float


def make_dataset(
    families: Sequence[str],
    seeds: str,
    recipe: Recipe,
    out: Path,
    where: Where = HERE,
    limit: int | None = None,
    command: str = "",
    progress: RunProgress | None = None,
) -> DatasetOutcome:
    """Make the shards that are missing from `out`, and its index and data card.

    Args:
        families: Scenario names or files.
        seeds: "A:B", B excluded.
        recipe: Settings that all shards of the folder share.
        out: New, empty, or of an earlier run with the same recipe.
        where: Where to compute.
        limit: Compute at most this many tunnels.
        command: For the data card.
        progress: Receives each tunnel and its number of keyframe pairs.

    Raises:
        InputError: A family, the seeds, the folder or the scheduler is wrong; or another process fills the folder.
    """
    progress = progress or Silent()
    require_usable(where)
    tunnels = _tunnels(families, seeds, recipe)
    was_there = out.exists()
    make_writable(out)
    with only_writer(out, "tunnelcd dataset"):
        return _make_in(out, tunnels, recipe, where, limit, command, progress, was_there=was_there)


def _make_in(
    out: Path,
    tunnels: Sequence[Tunnel],
    recipe: Recipe,
    where: Where,
    limit: int | None,
    command: str,
    progress: RunProgress,
    *,
    was_there: bool,
) -> DatasetOutcome:
    is_new = not (out / "dataset.json").is_file()
    _take_folder(out, recipe, command)
    missing = [tunnel for tunnel in tunnels if not _is_done(out, tunnel, recipe.afters)]
    # a limit is of tunnels that are made: those that are refused at once take no time
    todo = [tunnel for tunnel in missing if tunnel.refused]
    todo += [tunnel for tunnel in missing if not tunnel.refused][:limit]
    start, n_pairs = time.perf_counter(), []
    if todo:
        progress.cells("the first tunnel", 0, len(todo))
    try:
        for tunnel in todo:
            for name in tunnel.files(recipe.afters):
                (out / name).unlink(missing_ok=True)  # of another digest, and not to be read any more
        with closing(_computed(todo, recipe, where)) as results:
            for n_done, (tunnel, result) in enumerate(results, start=1):
                raise_lost_interrupt()
                _keep(out, tunnel, result)
                told = "refused"
                if not isinstance(result, str):
                    n_pairs.append(len(result) * int(read_about(out / tunnel.file)["counts"]["n_before"]))
                    told = f"{n_pairs[-1]} keyframe pairs"
                progress.cells(f"{tunnel.family} {tunnel.seed}: {told}", n_done, len(todo))
    finally:
        if is_new and [path.name for path in out.iterdir()] == ["dataset.json"]:
            # no tunnel was made, e.g. where a scheduler cannot be reached: leave nothing behind
            (out / "dataset.json").unlink()
            if not was_there:
                out.rmdir()
        else:
            write_card(out)
    n_refused = sum((out / tunnel.refusal).is_file() for tunnel in tunnels)
    n_kept, seconds = len(tunnels) - len(missing), time.perf_counter() - start
    return DatasetOutcome(len(n_pairs), n_kept, n_refused, len(missing) - len(todo), sum(n_pairs), seconds)


def _tunnels(families: Sequence[str], seeds: str, recipe: Recipe) -> list[Tunnel]:
    """Return the tunnels seed by seed, so that an interrupted run has tunnels of every family."""
    numbers = parse_seeds_option(seeds)
    if len({world_slug(family).casefold() for family in families}) < len(families):
        raise InputError(f"families {', '.join(families)}: one is named twice, or two would share their files")
    tunnels = [_tunnel(family, seed, recipe) for seed in numbers for family in families]
    # the data card lists single bad draws; a family without any draw is a mistake of the user
    of_family = ([tunnel for tunnel in tunnels if tunnel.family == family] for family in families)
    if mistakes := [own[0].refused for own in of_family if all(tunnel.refused for tunnel in own)]:
        raise InputError("\n".join(mistakes))
    return tunnels


def _tunnel(family: str, seed: int, recipe: Recipe) -> Tunnel:
    try:
        scenario = load_scenario(family, seed, recipe.settings)
        if recipe.afters > 1 and isinstance(scenario, GraftScenario):
            raise InputError(f"--afters {recipe.afters}: the sessions of {family} are recorded: leave it out")
        return Tunnel(family, seed, shard_digest(scenario, seed, recipe))
    except ScenarioError as error:
        return Tunnel(family, seed, refused=str(error))


def _take_folder(out: Path, recipe: Recipe, command: str) -> None:
    """Mark an empty folder, or check that it has the same recipe, and add the command to its list."""
    path = out / "dataset.json"
    present = {"format": FORMAT, "format_version": FORMAT_VERSION, "recipe": json.loads(json.dumps(recipe.document()))}
    commands: list[str] = []
    if path.is_file():
        document = files.read_json(path, "name a new folder")
        try:
            commands = [str(words) for words in document.pop("commands")]
        except (KeyError, TypeError) as error:
            raise InputError(f"{path}: damaged ({error}): name a new folder") from error
        found = document.get("format"), document.get("format_version")
        files.require_format(path, found, FORMAT, FORMAT_VERSION, "name a new folder, and run the command again")
        if document != present:
            raise InputError(
                f"{out}: made with {_told(document.get('recipe'))}, not with {_told(present['recipe'])}: all shards of "
                "a folder are made alike; name another folder"
            )
    elif any(out.iterdir()):
        raise InputError(f"{out}: not empty and not a dataset: name a new folder, or empty this one")
    write_json(path, {**present, "commands": [*commands, *([command] if command not in commands else [])]})


def _told(recipe: Any) -> str:
    """Return a recipe as options of the command."""
    try:
        options = f"--draws {recipe['draws']} --error-m {recipe['error_m']:g} --error-deg {recipe['error_deg']:g}"
        options += f" --afters {recipe['afters']:d}" if "afters" in recipe else ""
        return " ".join([options, *(f"--world {setting}" for setting in recipe["settings"])])
    except (KeyError, TypeError, ValueError):
        return "something else"


def _is_done(out: Path, tunnel: Tunnel, afters: int) -> bool:
    """Return whether all of a tunnel's shards, or its refusal, have the present digest."""
    refusal = out / tunnel.refusal
    if refusal.is_file():
        return bool(read_json(refusal).get("digest") == tunnel.digest != "")
    paths = [out / name for name in tunnel.files(afters)]
    if not all(path.is_file() for path in paths):
        return False
    try:
        return all(read_about(path)["digest"] == tunnel.digest for path in paths)
    except (InputError, KeyError):
        return False


def _keep(out: Path, tunnel: Tunnel, result: list[bytes] | str) -> None:
    """Write the shards of a tunnel, or the reason why there is none, each completely or not at all."""
    if isinstance(result, str):
        about = {"family": tunnel.family, "seed": tunnel.seed, "digest": tunnel.digest, "reason": result}
        write_json(out / tunnel.refusal, about)
        return
    for name, content in zip(tunnel.files(len(result)), result, strict=True):
        with whole_file(out / name) as partial:
            partial.write_bytes(content)
    (out / tunnel.refusal).unlink(missing_ok=True)


def attempt_task(document: str) -> list[bytes] | str:
    """Return a tunnel's shards, or the reason why it cannot be built; runs on the worker."""
    return _attempt(*_TASK.validate_json(document))


_TASK = TypeAdapter(tuple[Tunnel, Recipe])


def _attempt(tunnel: Tunnel, recipe: Recipe) -> list[bytes] | str:
    try:
        return make_shards(tunnel.family, tunnel.seed, recipe)
    except ScenarioError as error:
        return str(error)


def _computed(tunnels: Sequence[Tunnel], recipe: Recipe, where: Where) -> Generator[tuple[Tunnel, list[bytes] | str]]:
    """Yield each tunnel with its shards, or with the reason why there is none, in order of completion."""
    yield from ((tunnel, tunnel.refused) for tunnel in tunnels if tunnel.refused)
    wanted = [tunnel for tunnel in tunnels if not tunnel.refused]
    if where == HERE:
        yield from ((tunnel, _attempt(tunnel, recipe)) for tunnel in wanted)
    elif wanted:
        with connected(where, len(wanted)) as client:
            yield from _from_cluster(client, wanted, recipe)


def _from_cluster(client: Any, tunnels: Sequence[Tunnel], recipe: Recipe) -> Iterator[tuple[Tunnel, list[bytes] | str]]:
    from distributed import as_completed  # noqa: PLC0415 - an extra, and slow to import

    waiting = iter(tunnels)
    tunnel_of: dict[Any, Tunnel] = {}

    def submitted(n: int) -> list[Any]:
        futures = []
        for _, tunnel in zip(range(n), waiting, strict=False):
            futures.append(client.submit(attempt_task, _TASK.dump_json((tunnel, recipe)).decode(), pure=False))
            tunnel_of[futures[-1].key] = tunnel
        return futures

    coming = as_completed(submitted(_AHEAD * max(1, n_slots(client))))
    for future in coming:
        result = future.result()
        tunnel = tunnel_of.pop(future.key)
        future.release()
        for more in submitted(1):
            coming.add(more)
        yield tunnel, result
