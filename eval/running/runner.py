"""Runs a plan in this process or on workers. Finished cells are kept; an interrupted run continues where it stopped.

A cell is finished when its file holds the digest of everything that it depends on: the drawn scenario and the files it
names, the effective settings, the weights, the metrics version, the plan's entries (oracles, `until`, kind of pair),
and whether KISS-Matcher was missing where the merge needs it. A refused merge, a cell that kills its worker and any
other error of the input become rows; a bug is not caught.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.descriptors import list_checkpoints
from cdpipe.methods.registry import load_source
from cdpipe.surface.measure import require_method
from eval.core.cluster import HERE, Where, connected, require_usable
from eval.core.output import remove
from eval.core.provenance import describe_run, digest
from eval.core.terminal.progress import RunProgress, Silent
from eval.plans.cells import expand_cells
from eval.plans.plan import Plan
from eval.plans.variants import Cell
from eval.running.pair_run import TOOLS, Made, Pair, PairRun, Tools, is_pair_dropped, is_refused, pair_lock
from eval.running.run_workers import remove_traces, run_on_workers
from eval.running.runfolder import RunFolder, current_results, keep_makers, write_json, write_tables
from eval.running.scaling.keeping import Keep, drop_pair, dropped_file, remove_leftovers
from eval.running.scaling.merged_provenance import resume_provenance
from eval.running.scaling.mirror import Mirror
from eval.running.scaling.remaking import remake_pair
from eval.running.scaling.shards import Shard, choose_cells, require_same_shard
from eval.running.schedule import limit_pairs, schedule_pairs
from eval.running.stages.pair_stages import PairStages
from eval.truth.ground_truth import GroundTruth
from scenarios.references import without_paths
from sim.session.truth import read_pair_truth


@dataclass(frozen=True, slots=True)
class RunOutcome:
    """How a run ended: number of cells done now, kept from before, left by `--limit`, and that kill workers."""

    n_done: int
    n_kept: int
    n_left: int
    n_died: int = 0


def run_plan(
    plan: Plan,
    run: RunFolder,
    *,
    command: Sequence[str] = (),
    force: bool = False,
    limit: int | None = None,
    where: Where = HERE,
    shard: Shard | None = None,
    keep: Keep | None = None,
    mirror: Mirror | None = None,
    progress: RunProgress | None = None,
    tools: Tools | None = None,
) -> RunOutcome:
    """Run the unfinished cells of a plan and write the tables.

    Args:
        plan: The plan.
        run: The folder to run in; workers write into it too.
        command: The command line, for the provenance.
        force: Run all cells again and simulate all pairs again.
        limit: Run at most this many cells.
        where: In this process, on workers of this machine, or on a cluster.
        shard: Run the pairs of this shard alone.
        keep: What stays of a pair after its last cell; None leaves its sessions, and makes none again.
        mirror: Where rows and answers are copied to, and finished ones taken from.
        progress: Receives the progress.
        tools: What draws and simulates worlds, and names the code and the time; workers simulate with their own.

    Raises:
        InputError: A setting is wrong, a method's extra is missing, the folder cannot be written or holds another
            world or variant where one of the plan belongs, cells of another split or shard, or the cluster or the
            mirror cannot be used.
    """
    progress, tools = progress or Silent(), tools or TOOLS
    require_usable(where)
    _require_either(force, limit)
    earlier_runs = _earlier_runs(run, mirror)
    for place, earlier in earlier_runs:
        _require_one_split(place, earlier, plan)
        require_same_shard(place, earlier, shard)
    place, earlier = next(((place, told) for place, told in earlier_runs if told), ("", {}))
    all_cells = expand_cells(plan)
    own_cells = choose_cells(all_cells, shard)
    provenance = {**_provenance(plan, all_cells, command, tools), **({} if shard is None else {"shard": str(shard)})}
    if mirror is not None:
        if earlier and not run.stored_provenance():  # an interrupt may leave cells of it
            write_json(run.path / "provenance.json", {**earlier, "finished": None})
        mirror.fetch(run, progress)
    schedule = partial(schedule_pairs, run, plan, all_cells, force, tools, shard=shard, keep=keep, progress=progress)
    pairs = _schedule_leanly(schedule, run, keep)
    chosen = limit_pairs(pairs, limit)
    n_todo, n_run = (sum(len(pair.todo) for pair in some) for some in (pairs, chosen))
    _require_extras(chosen)
    _tell_idle(where, len(chosen), progress)
    made = Made(provenance["git_commit"])
    results = None if n_todo else current_results(run, run.stored_provenance(), provenance)
    if not n_run:
        provenance = keep_makers(provenance, run.stored_provenance())
    elif earlier and _keeps_cells(run, pairs):
        provenance = resume_provenance(place, earlier, provenance)
    # an unusable cluster is reported before anything is written
    with nullcontext() if where == HERE or not chosen else connected(where, len(chosen)) as client:
        if results is None:
            write_json(run.path / "provenance.json", {**provenance, "finished": None})
        remove_traces(run)
        # cells left by --limit may be outdated as well, and no table may hold outdated cells
        remove_leftovers(run)
        for pair in pairs:
            _remove_stale(run, pair, force)
        if mirror is not None:
            mirror.forget(run, pairs)
            mirror.copy_cells(run)
        done = None if mirror is None else partial(mirror.copy_pair, run)
        if client is None:
            _run_here(run, chosen, made, progress, tools, done)
        else:
            run_on_workers(client, run, chosen, made, progress, done)
    progress.cells("done", n_run, n_run)
    if results is None:
        results = write_tables(run)
        write_json(run.path / "provenance.json", {**provenance, "finished": provenance["finished"] or tools.now()})
    if mirror is not None:
        mirror.copy_cells(run)
        mirror.copy_tables(run)
    _settle(run, pairs, keep, mirror, progress, tools)
    n_kept, n_died = len(own_cells) - n_todo, int((results["status"] == "worker_died").sum())
    return RunOutcome(n_run, n_kept, n_todo - n_run, n_died)


def _require_either(force: bool, limit: int | None) -> None:
    if force and limit is not None:
        raise InputError("--force removes every finished cell of the plan, and --limit runs a part: leave one out")


def list_cells(
    plan: Plan, path: Path, *, force: bool = False, limit: int | None = None, shard: Shard | None = None
) -> list[tuple[Cell, str]]:
    """Return each cell of a plan and its state, "finished", "to do", or "left" by `limit`; writes nothing.

    Raises:
        InputError: A setting is wrong, or the folder holds something else than a run.
    """
    _require_either(force, limit)
    run = RunFolder(path)
    if path.is_dir() and any(path.iterdir()):
        _require_one_split(str(path), run.provenance(), plan)
        require_same_shard(str(path), run.provenance(), shard)
    elif path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file: name a folder to run in")
    all_cells = expand_cells(plan)
    pairs = schedule_pairs(run, plan, all_cells, force, TOOLS, shard=shard, is_lean=True)
    own_cells = choose_cells(all_cells, shard)
    todo, chosen = ({each.cell for pair in some for each in pair.todo} for some in (pairs, limit_pairs(pairs, limit)))
    return [(cell, "to do" if cell in chosen else "left" if cell in todo else "finished") for cell in own_cells]


def list_plan_pairs(plan: Plan, run: RunFolder, tools: Tools = TOOLS) -> list[Pair]:
    """Return the pairs of a plan without cells to run, for methods that are not the plan's own.

    Raises:
        InputError: A setting of the plan is wrong, or the folder holds another world or cells of another split.
    """
    _require_one_split(str(run.path), run.stored_provenance(), plan)
    return [replace(pair, todo=()) for pair in schedule_pairs(run, plan, expand_cells(plan), False, tools)]


def open_pair(
    run: RunFolder, pair: Pair, progress: RunProgress, tools: Tools = TOOLS
) -> tuple[PairStages, GroundTruth] | str:
    """Simulate a pair unless it exists and open it; a text says why it cannot be made. The caller holds its lock."""
    if not is_simulated(run.pair(pair.name, pair.seed), pair):
        _remove_pair(run, pair)
    return PairRun(run, pair, Made(None), progress, tools).open()


def start_provenance(plan: Plan, run: RunFolder, command: Sequence[str], tools: Tools = TOOLS) -> None:
    """Write the provenance of a run folder that has none, as of a plan without methods; one that is there stays."""
    if not run.stored_provenance():
        told = dict(_provenance(plan, [], command, tools))
        told["plan"] = {**told["plan"], "variants": [], "grid": []}
        write_json(run.path / "provenance.json", {**told, "finished": tools.now()})


def _run_here(
    run: RunFolder,
    pairs: Sequence[Pair],
    made: Made,
    progress: RunProgress,
    tools: Tools,
    done: Callable[[Pair], None] | None = None,
) -> None:
    n_done, n_run = 0, sum(len(pair.todo) for pair in pairs)
    for pair in pairs:
        with pair_lock(run, pair):
            here = PairRun(run, pair, made, progress, tools)
            progress.cells(f"{pair.name} {pair.seed}", n_done, n_run)
            here.open()
            for each in pair.todo:
                progress.cells(f"{pair.name} {pair.seed} {each.cell.variant}", n_done, n_run)
                here.do(each)
                n_done += 1
            if pair.keep != "sessions":
                drop_pair(run, pair.name, pair.seed, pair.keep)
        if done is not None:
            done(pair)


def _earlier_runs(run: RunFolder, mirror: Mirror | None) -> list[tuple[str, Mapping[str, Any]]]:
    """Return the place and the provenance of what was run before, here and where rows are copied to."""
    here = str(run.path), run.stored_provenance()
    return [here] if mirror is None else [here, (mirror.url, mirror.provenance())]


def _keeps_cells(run: RunFolder, pairs: Sequence[Pair]) -> bool:
    """Tell whether a folder holds finished cells besides those that are to run."""
    todo = {run.cell(pair.name, pair.seed, each.cell.variant) for pair in pairs for each in pair.todo}
    return any(cell not in todo for cell in run.path.glob("cells/*/*/*.json"))


def _require_one_split(place: str, provenance: Mapping[str, Any], plan: Plan) -> None:
    """Refuse a folder with cells of another split: its tables would mix seeds that were looked at with sealed ones."""
    earlier = provenance.get("plan")
    if isinstance(earlier, Mapping) and earlier.get("split", "") != plan.split:
        told = [split or "as plans name them" for split in (str(earlier.get("split", "")), plan.split)]
        way = "give --split sealed, or name another folder" if not plan.split else "name another folder"
        raise InputError(f"{place}: its seeds are {told[0]}, these are {told[1]}: {way}")


def _require_extras(pairs: Sequence[Pair]) -> None:
    """Refuse to begin where methods need packages that are not installed; name all of them at once."""
    mistakes: dict[str, None] = {}
    cells = {each.cell.variant: each.cell for pair in pairs for each in pair.todo}
    for cell in cells.values():
        try:
            require_method(cell.config.surface.method)
            if load_source(cell.config).detect is not None and cell.oracle_regions:
                raise InputError(
                    f"{cell.variant}: regions.source = {cell.config.regions.source} finds regions and objects at once: "
                    "regions from the truth need a source with `propose`"
                )
        except InputError as error:
            mistakes[str(error)] = None
    if mistakes:
        raise InputError("\n".join(mistakes))


def _tell_idle(where: Where, n_pairs: int, progress: RunProgress) -> None:
    """Note that workers stay idle where there are fewer pairs: the cells of a pair share stages and are not split."""
    if where.workers is not None and 0 < n_pairs < where.workers:
        pairs = "1 pair is" if n_pairs == 1 else f"{n_pairs} pairs are"
        progress.note(
            f"--workers {where.workers}: {pairs} left to do, and each keeps one worker busy (its cells share stages), "
            f"so {where.workers - n_pairs} will not be started"
        )


def _remove_stale(run: RunFolder, pair: Pair, force: bool) -> None:
    """Remove what is about to run again, so that no table holds it if the run is interrupted."""
    if not pair.todo:
        return
    if force or not (is_simulated(run.pair(pair.name, pair.seed), pair) or is_pair_dropped(run, pair)):
        _remove_pair(run, pair)
        remove(dropped_file(run, pair.name, pair.seed))
    for each in pair.todo:
        remove(run.cell(pair.name, pair.seed, each.cell.variant))
        remove(run.answer(pair.name, pair.seed, each.cell.variant))


def _remove_pair(run: RunFolder, pair: Pair) -> None:
    """Remove a pair and its maps, and where it is of another world every row, answer and record about that.

    A damaged pair, or one that cannot be drawn any more, may be of the same world: answers of others stay.
    """
    held = run.pair(pair.name, pair.seed)
    if _is_of_another_world(held, pair) or is_pair_dropped(run, pair) is False:
        for kind in ("cells", "answers"):
            remove(run.path / kind / held.parent.name / held.name)
        remove(dropped_file(run, pair.name, pair.seed))  # last: it tells of which world they are
    remove(held)
    remove(run.maps(pair.name, pair.seed))


def _settle(
    run: RunFolder, pairs: Sequence[Pair], keep: Keep | None, mirror: Mirror | None, progress: RunProgress, tools: Tools
) -> None:
    """Give the pairs that were finished before what `--keep` says: remove their sessions, or make those that lack."""
    for pair in pairs:
        if pair.todo or keep is None:
            continue
        if keep == "sessions":
            if dropped_file(run, pair.name, pair.seed).is_file():
                remake_pair(run, pair.name, pair.seed, progress, tools)
            elif _lacks_sessions(run, pair) and pair.scenario is not None:
                with pair_lock(run, pair):
                    opened = PairRun(run, pair, Made(None), progress, tools).open()
                if isinstance(opened, str):
                    progress.note(f"{pair.name} {pair.seed}: cannot be made: {opened}")
        elif keep == "nothing" or run.pair(pair.name, pair.seed).is_dir():
            with pair_lock(run, pair):
                drop_pair(run, pair.name, pair.seed, keep)
    if mirror is not None and keep is not None:
        mirror.copy_cells(run)  # with the records of what was removed


def _schedule_leanly(schedule: Callable[..., list[Pair]], run: RunFolder, keep: Keep | None) -> list[Pair]:
    """Return the pairs; finished ones come with their scenarios only where sessions are to be made from these."""
    pairs = schedule(is_lean=True)
    if keep == "sessions" and any(_lacks_sessions(run, pair) for pair in pairs):
        return schedule(is_lean=False)
    return pairs


def _lacks_sessions(run: RunFolder, pair: Pair) -> bool:
    """Tell whether a finished pair that can be made was removed by hand, or left behind by `merge-runs`: no record."""
    is_there = run.pair(pair.name, pair.seed).is_dir() or dropped_file(run, pair.name, pair.seed).is_file()
    return not (pair.todo or is_there or is_refused(run, pair.name, pair.seed))


def is_simulated(path: Path, pair: Pair) -> bool:
    """Tell whether the pair exists, is complete, and was made from this scenario and the present files."""
    return _compare_world(path, pair) is True


def _is_of_another_world(path: Path, pair: Pair) -> bool:
    """Tell whether the pair exists, is complete, and was made from another scenario or from other files."""
    return _compare_world(path, pair) is False


def _compare_world(path: Path, pair: Pair) -> bool | None:
    """Return whether a pair was made from its scenario and the present files; None where either cannot be told."""
    if pair.scenario is None:
        return None
    try:
        truth = read_pair_truth(path)
    except InputError:
        return None
    worlds = (truth.scenario, truth.files), (pair.scenario.model_dump(mode="json"), pair.files)
    one, other = (digest(without_paths(drawn, files)) for drawn, files in worlds)
    return one == other and truth.seed == pair.seed


def _provenance(plan: Plan, all_cells: Sequence[Cell], command: Sequence[str], tools: Tools) -> Mapping[str, Any]:
    configs = {f"{cell.scenario} {cell.variant}": cell.config.model_dump(mode="json") for cell in all_cells}
    checkpoints: dict[str, str] = {}
    for cell in all_cells:
        files = {
            "sphere": cell.config.sphere.weights,
            "range-net": cell.config.range_net.weights,
            cell.config.descriptor.method: cell.config.descriptor.weights,
        }
        for name, digest_of_weights in list_checkpoints(cell.config).items():
            checkpoints[f"{name} {files[name]}".strip()] = digest_of_weights
    return describe_run(plan.model_dump(mode="json"), configs, checkpoints, command, tools.commit(), tools.now())
