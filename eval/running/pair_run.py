"""Runs the cells of one pair (a world and a seed) one after the other and writes them into the run folder.

The cells share the simulated sessions and the results of the stages. A process that runs a pair holds its lock, so an
orphaned worker and a resumed run never write the same files.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from cdpipe.core.errors import InputError, MergeFailedError, ScenarioError, TunnelcdError
from cdpipe.core.plugins import extra_version
from cdpipe.core.progress import Progress
from cdpipe.core.threads import THREADS
from cdpipe.core.whole_file import whole_file
from cdpipe.descriptors import checkpoint_digest, list_checkpoints, use_threads
from cdpipe.io.answer import write_answer, write_failure
from cdpipe.methods.registry import PACKAGES, list_extras
from cdpipe.model.config import WEIGHTS_FILES, MapConfig
from eval.core.domains import domain_of
from eval.core.output import remove
from eval.core.provenance import canonical_json, digest_parts, git_commit, now
from eval.core.terminal.interrupts import raise_lost_interrupt
from eval.core.terminal.progress import RunProgress
from eval.graft import make_pair
from eval.oracles.merge import merged_by_truth
from eval.oracles.regions import regions_by_truth
from eval.plans.variants import Cell
from eval.running.cell_file import cell_document
from eval.running.cell_rows import is_row_of_unmade
from eval.running.runfolder import RunFolder, write_json
from eval.running.scaling.keeping import Keep, dropped_file, is_dropped, read_dropped, require_same_bytes
from eval.running.stages.pair_stages import PairStages
from eval.running.stages.stage_cache import open_cache
from eval.scoring.scoring import METRICS_VERSION, CaseScore, describe_recording, score_stored
from eval.truth.adapters import pipeline_input
from eval.truth.ground_truth import GroundTruth, load_ground_truth
from scenarios.grafted import GraftScenario
from scenarios.library import load_scenario
from scenarios.references import without_paths
from scenarios.schema import Scenario

if sys.platform != "win32":
    import fcntl


@dataclass(frozen=True, slots=True, eq=False)
class Todo:
    """A cell to run, the digest of what it depends on, and its position in the tables (scenario, variant)."""

    cell: Cell
    key: str
    place: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """One world and seed, and its unfinished cells.

    Attributes:
        name: Label of the world.
        kind: What the plan calls such pairs, or "".
        scenario: The drawn scenario; None where the seed draws none, and `error` says why.
        files: Digests of the files that the scenario names.
        keep: What stays of it after its last cell.
    """

    name: str
    family: str
    kind: str
    seed: int
    scenario: GraftScenario | Scenario | None
    files: Mapping[str, str]
    error: str
    todo: tuple[Todo, ...]
    keep: Keep = "sessions"


@dataclass(frozen=True, slots=True)
class Made:
    """Provenance of the rows of a run: the commit, and whether workers shared the machine."""

    commit: str | None
    is_contended: bool = False


@dataclass(frozen=True, slots=True)
class Tools:
    """What a run takes from outside: tests pass their own, everybody else the defaults.

    Attributes:
        draw: Draws a scenario from its name, a seed and settings; raises `ScenarioError` where it cannot.
        simulate: Writes a pair from a scenario, a seed, the pair's folder and a listener to its progress.
        commit: Names the code that runs, as `git_commit` does.
        now: The present time, UTC, ISO 8601.
    """

    draw: Callable[[str, int, tuple[str, ...]], Scenario] = load_scenario
    simulate: Callable[[Scenario, int, Path, Progress], None] = make_pair
    commit: Callable[[], str | None] = git_commit
    now: Callable[[], str] = now


TOOLS = Tools()


class PairRun:
    """One pair being run; it owns the maps.

    A worker has no tools but its own: they do not travel with a task.
    """

    def __init__(
        self, run: RunFolder, pair: Pair, made: Made, progress: RunProgress, tools: Tools | None = None
    ) -> None:
        self._tools = tools or TOOLS
        self._run = run
        self._pair = pair
        self._made = made
        self._progress = progress
        self._opened: tuple[PairStages, GroundTruth] | str | None = None
        use_threads(THREADS)

    @property
    def is_open(self) -> bool:
        """Whether `open` was called."""
        return self._opened is not None

    def open(self) -> tuple[PairStages, GroundTruth] | str:
        """Simulate the pair unless it exists and open it, once; a text says why the pair cannot be made."""
        if self._opened is None:
            try:
                self._opened = _open(self._run, self._pair, self._made, self._progress, self._tools)
            except ScenarioError as error:
                self._opened = str(error)
        return self._opened

    def do(self, each: Todo) -> None:
        """Run a cell and write its answer and its file; a failure leaves nothing behind."""
        opened, cell = self.open(), each.cell
        if isinstance(opened, str):
            self._finish(each, score_unmade(self._pair, "failed", opened))
            return
        stages, truth = opened
        folder = self._run.answer(self._pair.name, self._pair.seed, cell.variant)
        try:
            _answer(stages, cell, truth, folder)
            raise_lost_interrupt()  # before what it may have spoilt is scored
            self._finish(each, score_stored(truth, folder, may_end_early=True), is_contended=stages.is_contended)
        except BaseException as error:
            remove(folder)
            if isinstance(error, OSError) and error.filename is None:
                error.filename = str(folder)  # the error of a full disk names no file
            raise

    def write_died(self, each: Todo, error: str) -> None:
        """Write the row of a cell that kills its process; it is scored like a failed cell where there is a truth."""
        status, folder = "worker_died", self._run.answer(self._pair.name, self._pair.seed, each.cell.variant)
        path = self._run.pair(self._pair.name, self._pair.seed)
        if not path.exists():
            self._finish(each, score_unmade(self._pair, status, error))
            return
        settings = each.cell.config.model_dump(mode="json")
        remove(folder)  # left by the process that died
        used = list_checkpoints(each.cell.config)
        write_failure(folder, each.cell.variant, status, error, {}, settings, each.cell.until, checkpoints=used)
        self._finish(each, score_stored(load_ground_truth(path), folder, may_end_early=True))

    def _finish(self, each: Todo, score: CaseScore, *, is_contended: bool = False) -> None:
        pair, cell = self._pair, each.cell
        names = {"scenario": pair.name, "seed": pair.seed, "variant": cell.variant, "preset": cell.preset}
        is_contended |= self._made.is_contended
        told = {"pair_kind": pair.kind, "commit": self._made.commit, "is_contended": is_contended}
        path = self._run.cell(pair.name, pair.seed, cell.variant)
        write_json(path, cell_document(score, {**names, **told}, each.key, each.place))


def is_finished(run: RunFolder, each: Todo) -> bool:
    """Tell whether a cell's file exists, is complete, and holds the present digest and metrics version.

    Raises:
        InputError: The file is that of another world or variant, whose name gives the same path.
    """
    cell = each.cell
    path = run.cell(cell.scenario, cell.seed, cell.variant)
    stored = run.read_cell(path)
    if stored is None:
        return False
    world, variant = stored["row"].get("scenario"), stored["row"].get("variant")
    if (world, variant) != (cell.scenario, cell.variant):
        raise InputError(
            f"{path}: holds {variant} on {world}, and {cell.variant} on {cell.scenario} has the same path: rename one, "
            "or name another run folder"
        )
    return bool(stored["key"] == each.key and stored["row"].get("metrics_version") == METRICS_VERSION)


def is_refused(run: RunFolder, world: str, seed: int) -> bool:
    """Tell whether the rows of a pair say that it cannot be made; `--force` tries it again."""
    cells = map(run.read_cell, sorted(run.cell(world, seed, "").parent.glob("*.json")))
    return any(is_row_of_unmade(cell["row"]) for cell in cells if cell is not None)


def is_pair_dropped(run: RunFolder, pair: Pair) -> bool | None:
    """Tell whether removed sessions were of this world; None where none were removed, or it cannot be told."""
    if pair.scenario is None:
        return None
    return is_dropped(run, pair.name, pair.seed, pair.scenario.model_dump(mode="json"), pair.files)


def pair_lock(run: RunFolder, pair: Pair) -> AbstractContextManager[None]:
    """Hold the lock of a pair, as `pair_lock_of` does."""
    return pair_lock_of(run, pair.name, pair.seed)


@contextmanager
def pair_lock_of(run: RunFolder, world: str, seed: int) -> Iterator[None]:
    """Hold the lock of a pair, waiting for it; the system releases it when the process dies."""
    if sys.platform == "win32":
        yield
        return
    path = run.pair(world, seed).with_name(f".{seed}.lock")
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            # the last holder removes the file; a lock on a removed file excludes nobody
            if not path.exists() or path.stat().st_ino != os.fstat(file.fileno()).st_ino:
                continue
            try:
                yield
            finally:
                path.unlink(missing_ok=True)
            return


def cell_key(cell: Cell, pair_kind: str, scenario: Scenario | None, files: Mapping[str, str]) -> str:
    """Return the digest of everything that a cell depends on, the metrics version apart."""
    return CellKeys().of_pair(cell.seed, pair_kind, scenario, files)(cell)


class CellKeys:
    """Makes the digests of cells. What the cells of a pair, or those of a method, share is written as JSON once."""

    def __init__(self) -> None:
        # the settings are held beside their text, so that no other settings get their id
        self._methods: dict[tuple[object, ...], tuple[Cell, Mapping[str, str]]] = {}

    def of_pair(
        self, seed: int, pair_kind: str, scenario: Scenario | None, files: Mapping[str, str]
    ) -> Callable[[Cell], str]:
        """Return the function that gives the digest of each cell of a pair."""
        drawn = None if scenario is None else without_paths(scenario.model_dump(mode="json"), files)
        shared = {"scenario": drawn, "files": {}, "seed": seed, "pair_kind": pair_kind}
        texts = {name: canonical_json(value) for name, value in shared.items()}
        return lambda cell: digest_parts({**texts, **self._of_method(cell)})

    def _of_method(self, cell: Cell) -> Mapping[str, str]:
        name = (id(cell.config), id(cell.oracle), cell.until, cell.oracle_regions)
        if name not in self._methods:
            texts = {key: canonical_json(value) for key, value in _describe_method(cell).items()}
            self._methods[name] = cell, texts
        return self._methods[name][1]


def _describe_method(cell: Cell) -> dict[str, object]:
    """Return what a cell depends on beside its pair."""
    merge = cell.config.merge
    asks_kiss_matcher = merge.method == "kiss-matcher" or (merge.method == "voting" and merge.fallback)
    extras = ["kiss-matcher"] if cell.oracle is None and asks_kiss_matcher else []
    if cell.until is None:
        # rivals of the displacement have the names of the sources that use the same package
        names = [cell.config.regions.source] * (not cell.oracle_regions) + [cell.config.surface.method]
        extras += dict.fromkeys(PACKAGES[name] for name in names if name in PACKAGES)
    weights = list_checkpoints(cell.config)
    return {
        # the digests name the weights, wherever their files lie
        "config": cell.config.model_dump(mode="json", exclude=WEIGHTS_FILES),
        "checkpoint": checkpoint_digest(cell.config.descriptor),
        **{name: found for name, found in weights.items() if name == cell.config.regions.source},
        "oracle": None if cell.oracle is None else cell.oracle.model_dump(mode="json"),
        **({"oracle_regions": True} if cell.oracle_regions else {}),
        "until": cell.until,
        # a cell that may depend on an extra runs again with another version of it, or without it
        **({"extras": {name: extra_version(name) for name in extras}} if extras else {}),
    }


def _open(
    run: RunFolder, pair: Pair, made: Made, progress: RunProgress, tools: Tools
) -> tuple[PairStages, GroundTruth]:
    """Simulate a pair unless it exists, store its maps for pictures, and open it with the kept stage results.

    Raises:
        ScenarioError: The seed draws no scenario, or one whose world cannot be built.
    """
    if pair.scenario is None:
        raise ScenarioError(pair.error)
    path = run.pair(pair.name, pair.seed)
    kept = run.stages(pair.name, pair.seed)
    if not path.exists():
        remove(kept)  # of an earlier simulation
        path.parent.mkdir(parents=True, exist_ok=True)
        record = read_dropped(dropped_file(run, pair.name, pair.seed))
        tools.simulate(pair.scenario, pair.seed, path, progress.stage)
        if record is not None:
            try:
                require_same_bytes(record, path)
            except InputError:
                remove(path)
                raise
    cache = open_cache(kept, (path / "before", path / "after"))
    sessions = pipeline_input(path, "before"), pipeline_input(path, "after")
    stages = PairStages(*sessions, progress.stage, cache, is_shared=made.is_contended)
    picture = run.maps(pair.name, pair.seed)
    if pair.keep == "sessions" and not picture.exists():
        write_maps(picture, stages)
    return stages, load_ground_truth(path)


def write_maps(path: Path, stages: PairStages) -> None:
    """Write the points of both maps for the page, with the recorded poses: answers are in their frames."""
    try:
        before, after = stages.maps(MapConfig())
    except TunnelcdError:
        return  # each cell of the pair records the same error
    points = {"before_points": before.points.astype(np.float32), "after_points": after.points.astype(np.float32)}
    with whole_file(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **points)


def _answer(stages: PairStages, cell: Cell, truth: GroundTruth, folder: Path) -> None:
    settings, noise, sessions = cell.config.model_dump(mode="json"), cell.oracle, (truth.before, truth.after)
    # the stages get what oracles make of the truth, and never the truth
    merge = None if noise is None else partial(merged_by_truth, truth=sessions, noise=noise, seed=cell.seed)
    propose = partial(regions_by_truth, truth, config=cell.config.query) if cell.oracle_regions else None
    try:
        report = stages.answer(cell.config, merge, propose, cell.until)
    except MergeFailedError as error:
        measured = error.evidence, settings, cell.until, error.seconds
        extras = list_extras(cell.config, error.evidence, proposes=False, measures=False)
        used = list_checkpoints(cell.config), extras
        write_failure(folder, cell.variant, "merge_refused", str(error), *measured, *used)
    except TunnelcdError as error:
        weights = list_checkpoints(cell.config)
        write_failure(folder, cell.variant, "failed", str(error), {}, settings, cell.until, checkpoints=weights)
    else:
        write_answer(folder, cell.variant, report, cell.until)


def score_unmade(pair: Pair, status: str, error: str) -> CaseScore:
    """Return the scores of a case without a world: there is no truth, so every score is undefined."""
    row = {"scenario": "", "family": pair.family, "pair_kind": "", "seed": pair.seed, "variant": "", "preset": ""}
    outcome = {"status": status, "error": error, "metrics_version": METRICS_VERSION}
    drawn = {} if pair.scenario is None else pair.scenario.model_dump(mode="json")
    told = {"domain": domain_of(pair.family), **describe_recording(drawn)}
    return CaseScore(row={**row, **outcome, **told}, changes=[], regions=[], objects=[])
