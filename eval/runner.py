"""Runs a plan, one cell after the other; finished cells are kept, and a run that was cut off goes on where it stopped.

A cell is finished when its file holds the digest of what it depends on: the scenario as drawn, the files it names, the
effective settings, the weights, the version of the metrics, what the plan says of it (oracles, where it ends, the
kind of its pair), and whether KISS-Matcher was missing where its merge asks for it. A merge that is refused and
any other error of the input are rows of their own; a bug is not caught.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from cdpipe.answer import write_answer, write_failure
from cdpipe.coarse import is_kiss_matcher_installed
from cdpipe.config import DescriptorConfig, MapConfig
from cdpipe.descriptor import checkpoint_digest, sphere_digest, use_threads
from cdpipe.errors import InputError, MergeFailedError, ScenarioError, TunnelcdError
from eval.adapters import pipeline_input
from eval.domains import domain_of
from eval.ground_truth import GroundTruth, load_ground_truth
from eval.oracle_regions import Regions, regions_by_truth
from eval.oracles import merged_by_truth
from eval.plan import Cell, Plan, cells
from eval.progress import RunProgress, Silent
from eval.provenance import THREADS, describe_run, digest, now
from eval.rescoring import cell_document, score_stored
from eval.runfolder import RunFolder, remove, write_tables
from eval.scoring import METRICS_VERSION, CaseScore
from eval.stages import Merge, PairStages
from eval.worlds import worlds_of
from scenarios.library import load_scenario
from scenarios.references import file_digests
from scenarios.schema import Scenario
from sim.simulate import simulate_pair
from sim.truth import read_pair_truth


@dataclass(frozen=True, slots=True)
class RunOutcome:
    """How a run ended: cells done now, kept from earlier, and left over by --limit."""

    n_done: int
    n_kept: int
    n_left: int


@dataclass(frozen=True, slots=True, eq=False)
class _Todo:
    """A cell, the digest of what it depends on, and its place in the tables (scenario, variant)."""

    cell: Cell
    key: str
    place: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """One world and seed, and the cells still to be done.

    Attributes:
        name: Label of the world.
        family: Its scenario's.
        kind: What the plan calls such pairs, or "".
        seed: The seed.
        scenario: The scenario as drawn, None where it cannot be drawn.
        files: Digests of the files that the scenario names.
        error: Why it cannot be drawn.
        todo: Its cells.
    """

    name: str
    family: str
    kind: str
    seed: int
    scenario: Scenario | None
    files: Mapping[str, str]
    error: str
    todo: tuple[_Todo, ...]


def run_plan(
    plan: Plan,
    run: RunFolder,
    *,
    command: Sequence[str] = (),
    force: bool = False,
    limit: int | None = None,
    progress: RunProgress | None = None,
) -> RunOutcome:
    """Run the cells of a plan that are not finished, and put the tables together.

    Args:
        plan: The plan.
        run: The folder to run in.
        command: The command line, for the provenance.
        force: Start the plan's cells and pairs from nothing.
        limit: Do at most this many cells.
        progress: Told what is being done.

    Raises:
        InputError: A setting is wrong, or the folder cannot be written.
    """
    progress = progress or Silent()
    use_threads(THREADS)
    all_cells = cells(plan)
    provenance = _provenance(plan, all_cells, command)
    run.write_provenance(provenance)
    pairs = _pairs(run, plan, all_cells, force)
    n_todo = sum(len(pair.todo) for pair in pairs)
    n_run = n_todo if limit is None else min(limit, n_todo)
    n_done = 0
    for pair in pairs:
        todo = pair.todo[: n_run - n_done]
        if todo:
            _run_pair(run, pair, todo, progress, (n_done, n_run), provenance["git_commit"])
        n_done += len(todo)
    progress.cells("done", n_done, n_run)
    write_tables(run)
    run.write_provenance({**provenance, "finished": now()})
    return RunOutcome(n_done, len(all_cells) - n_todo, n_todo - n_done)


def _pairs(run: RunFolder, plan: Plan, all_cells: Sequence[Cell], force: bool) -> list[_Pair]:
    variants = list(dict.fromkeys(cell.variant for cell in all_cells))
    places = {world.label: (place, world) for place, world in enumerate(worlds_of(plan.scenarios))}
    pairs = []
    for (label, seed), group in groupby(all_cells, key=lambda cell: (cell.scenario, cell.seed)):
        place, world = places[label]
        scenario, files, error = None, {}, ""
        try:
            scenario = load_scenario(world.name, seed, world.settings)
            files = file_digests(scenario)
        except ScenarioError as mistake:
            error = str(mistake)
        every = [
            _Todo(cell, _key(cell, world.pair_kind, scenario, files), (place, variants.index(cell.variant)))
            for cell in group
        ]
        todo = [each for each in every if force or not _is_finished(run, each.cell, each.key)]
        # cells that share a map setting come one after the other, because only one setting's maps are held
        todo.sort(key=lambda each: each.cell.config.map.model_dump_json())
        family = world.name if scenario is None else scenario.family
        pairs.append(_Pair(label, family, world.pair_kind, seed, scenario, files, error, tuple(todo)))
        _remove_stale(run, pairs[-1], force)
    return pairs


def _is_finished(run: RunFolder, cell: Cell, key: str) -> bool:
    stored = run.read_cell(run.cell(cell.scenario, cell.seed, cell.variant))
    return stored is not None and stored["key"] == key and stored["row"].get("metrics_version") == METRICS_VERSION


def _remove_stale(run: RunFolder, pair: _Pair, force: bool) -> None:
    """Remove what is about to be redone, so that no table can hold it should the run be cut off."""
    if not pair.todo:
        return
    if force or not _is_simulated(run.pair(pair.name, pair.seed), pair):
        remove(run.pair(pair.name, pair.seed))
        remove(run.maps(pair.name, pair.seed))
    for each in pair.todo:
        remove(run.cell(pair.name, pair.seed, each.cell.variant))
        remove(run.answer(pair.name, pair.seed, each.cell.variant))


def _is_simulated(path: Path, pair: _Pair) -> bool:
    """Tell whether a pair is there, whole, of this very scenario, and made from the files as they are now."""
    if pair.scenario is None:
        return False
    try:
        truth = read_pair_truth(path)
    except InputError:
        return False
    is_same = digest(truth.scenario) == digest(pair.scenario.model_dump(mode="json"))
    return is_same and truth.seed == pair.seed and truth.files == pair.files


def _run_pair(
    run: RunFolder,
    pair: _Pair,
    todo: Sequence[_Todo],
    progress: RunProgress,
    counts: tuple[int, int],
    commit: str | None,
) -> None:
    """Run the cells of one pair; its maps are let go when this returns, before the next pair's are built."""
    done, total = counts
    progress.cells(f"{pair.name} {pair.seed}", done, total)
    opened: tuple[PairStages, GroundTruth] | str
    try:
        opened = _open(run, pair, progress)
    except ScenarioError as error:
        opened = str(error)
    for index, each in enumerate(todo):
        cell = each.cell
        progress.cells(f"{pair.name} {pair.seed} {cell.variant}", done + index, total)
        if isinstance(opened, str):
            score = _unmade(pair, opened)
        else:
            stages, truth = opened
            folder = run.answer(pair.name, pair.seed, cell.variant)
            _answer(stages, cell, truth, folder)
            score = score_stored(truth, folder)
        names = {"scenario": pair.name, "seed": pair.seed, "variant": cell.variant, "preset": cell.preset}
        identity = {**names, "pair_kind": pair.kind, "commit": commit}
        path = run.cell(pair.name, pair.seed, cell.variant)
        run.write_cell(path, cell_document(score, identity, each.key, each.place))


def _open(run: RunFolder, pair: _Pair, progress: RunProgress) -> tuple[PairStages, GroundTruth]:
    """Simulate a pair unless it is there, store its maps for pictures, and open it.

    Raises:
        ScenarioError: The seed draws no scenario, or one whose world cannot be built.
    """
    if pair.scenario is None:
        raise ScenarioError(pair.error)
    path = run.pair(pair.name, pair.seed)
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        simulate_pair(pair.scenario, pair.seed, path, on_progress=progress.stage)
    stages = PairStages(pipeline_input(path, "before"), pipeline_input(path, "after"), progress.stage)
    picture = run.maps(pair.name, pair.seed)
    if not picture.exists():
        _write_maps(picture, stages)
    return stages, load_ground_truth(path)


def _write_maps(path: Path, stages: PairStages) -> None:
    try:
        before, after = stages.maps(MapConfig())
    except TunnelcdError:
        return  # each cell of the pair meets the same error and records it
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.partial.npz")
    np.savez_compressed(
        partial,
        allow_pickle=False,
        before_points=before.points.astype(np.float32),
        after_points=after.points.astype(np.float32),
    )
    partial.replace(path)


def _answer(stages: PairStages, cell: Cell, truth: GroundTruth, folder: Path) -> None:
    settings = cell.config.model_dump(mode="json")
    try:
        if cell.until is None:
            report = stages.answer(cell.config, _oracle(cell, truth), _true_regions(cell, truth))
        else:
            report = stages.merge_answer(cell.config, _oracle(cell, truth))
    except MergeFailedError as error:
        measured = error.evidence, settings, cell.until, error.seconds
        write_failure(folder, cell.variant, "merge_refused", str(error), *measured)
    except TunnelcdError as error:
        write_failure(folder, cell.variant, "failed", str(error), {}, settings, cell.until)
    else:
        write_answer(folder, cell.variant, report, cell.until)


def _oracle(cell: Cell, truth: GroundTruth) -> Merge | None:
    """Return what merges in the method's place; the stages get its result and never the truth in it."""
    noise = cell.oracle
    if noise is None:
        return None
    return lambda before, after: merged_by_truth(before, after, (truth.before, truth.after), noise, cell.seed)


def _true_regions(cell: Cell, truth: GroundTruth) -> Regions | None:
    """Return what proposes regions in the method's place; the stages after it get these alone."""
    if not cell.oracle_regions:
        return None
    return lambda scans: regions_by_truth(truth, scans, cell.config.query)


def _unmade(pair: _Pair, error: str) -> CaseScore:
    """Score a case whose world cannot be made: there is no truth, so all but the identity is undefined."""
    row = {"scenario": "", "family": pair.family, "pair_kind": "", "seed": pair.seed, "variant": "", "preset": ""}
    outcome = {"status": "failed", "error": error, "metrics_version": METRICS_VERSION}
    return CaseScore(row={**row, **outcome, "domain": domain_of(pair.family)}, changes=[], regions=[], objects=[])


def _key(cell: Cell, pair_kind: str, scenario: Scenario | None, files: Mapping[str, str]) -> str:
    merge = cell.config.merge
    asks_kiss_matcher = merge.method == "kiss-matcher" or (merge.method == "voting" and merge.fallback)
    is_missed = cell.oracle is None and asks_kiss_matcher and not is_kiss_matcher_installed()
    return digest(
        {
            "scenario": None if scenario is None else scenario.model_dump(mode="json"),
            "files": dict(files),
            "seed": cell.seed,
            "config": cell.config.model_dump(mode="json"),
            "checkpoint": checkpoint_digest(cell.config.descriptor),
            **({"sphere": sphere_digest()} if cell.config.query.compare == "sphere" else {}),
            "oracle": None if cell.oracle is None else cell.oracle.model_dump(mode="json"),
            **({"oracle_regions": True} if cell.oracle_regions else {}),
            "until": cell.until,
            "pair_kind": pair_kind,
            # what was made without the extra is made again once it is there; nothing is said where it is
            **({"kiss_matcher": "absent"} if is_missed else {}),
        }
    )


def _provenance(plan: Plan, all_cells: Sequence[Cell], command: Sequence[str]) -> dict[str, Any]:
    configs = {f"{cell.scenario} {cell.variant}": cell.config.model_dump(mode="json") for cell in all_cells}
    methods = dict.fromkeys(cell.config.descriptor.method for cell in all_cells)
    checkpoints: dict[str, str] = {method: checkpoint_digest(DescriptorConfig(method=method)) for method in methods}
    if any(cell.config.query.compare == "sphere" for cell in all_cells):
        checkpoints["sphere"] = sphere_digest()
    return describe_run(plan.model_dump(mode="json"), configs, checkpoints, command)
