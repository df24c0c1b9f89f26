"""A plan as pairs with the cells that are left to do in a run folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby

from cdpipe.core.errors import InputError, ScenarioError
from eval.core.terminal.progress import RunProgress, Silent
from eval.plans.plan import Plan
from eval.plans.variants import Cell
from eval.plans.worlds import world_slug
from eval.running.pair_run import CellKeys, Pair, Todo, Tools, is_finished
from eval.running.runfolder import RunFolder
from eval.running.scaling.keeping import Keep
from eval.running.scaling.shards import Shard, choose_cells
from scenarios.library import scenarios_read_once
from scenarios.references import file_digests

_MANY_PAIRS = 1000  # fewer are drawn before anybody waits for them


def schedule_pairs(
    run: RunFolder,
    plan: Plan,
    all_cells: Sequence[Cell],
    force: bool,
    tools: Tools,
    *,
    shard: Shard | None = None,
    keep: Keep | None = None,
    is_lean: bool = False,
    progress: RunProgress | None = None,
) -> list[Pair]:
    """Return the pairs of a plan, or of a shard of it, with the cells that are left to do.

    Args:
        run: The folder, whose finished cells are kept.
        plan: The plan.
        all_cells: All of its cells.
        force: Whether finished cells are done again.
        tools: What draws scenarios.
        shard: The shard, None for all pairs.
        keep: What stays of a pair after its last cell.
        is_lean: Whether finished pairs come without their scenario: thousands of them take gigabytes.
        progress: Receives the progress.

    Raises:
        InputError: The folder holds another world or variant where one of the plan belongs, or a setting is wrong.
    """
    variants = {name: place for place, name in enumerate(dict.fromkeys(cell.variant for cell in all_cells))}
    places = {world.label: (place, world) for place, world in enumerate(plan.worlds)}
    for label in places:
        if (row := run.any_row(world_slug(label))) is not None and row["scenario"] != label:
            raise InputError(
                f"{run.path}: holds the world {row['scenario']}, and {label} has the same folder: rename one, or name "
                "another run folder"
            )
    pairs: list[Pair] = []
    keys, maps = CellKeys(), _MapSettings()
    cells = choose_cells(all_cells, shard)
    n_pairs = len({(cell.scenario, cell.seed) for cell in cells})
    with scenarios_read_once():
        for (label, seed), group in groupby(cells, key=lambda cell: (cell.scenario, cell.seed)):
            place, world = places[label]
            if n_pairs >= _MANY_PAIRS:
                (progress or Silent()).stage("scenarios", len(pairs) + 1, n_pairs)
            scenario, files, error = None, {}, ""
            try:
                scenario = tools.draw(world.name, seed, world.settings)
                files = file_digests(scenario)
            except ScenarioError as mistake:
                error = str(mistake)
            key = keys.of_pair(seed, world.pair_kind, scenario, files)
            every = [Todo(cell, key(cell), (place, variants[cell.variant])) for cell in group]
            todo = [each for each in every if not is_finished(run, each) or force]
            # cells with the same map settings run one after the other: only one pair of maps is held
            todo.sort(key=lambda each: maps.text(each.cell))
            family = world.name if scenario is None else scenario.family
            drawn = scenario if todo or not is_lean else None
            pair = Pair(label, family, world.pair_kind, seed, drawn, files, error, tuple(todo), keep or "sessions")
            pairs.append(pair)
    return pairs


def limit_pairs(pairs: Sequence[Pair], limit: int | None) -> list[Pair]:
    """Return the pairs that have cells to run, with at most `limit` cells in total."""
    left = sum(len(pair.todo) for pair in pairs) if limit is None else limit
    chosen = []
    for pair in pairs:
        todo = pair.todo[:left]
        left -= len(todo)
        if todo:
            # what a later run goes on with is kept
            chosen.append(replace(pair, todo=todo, keep=pair.keep if len(todo) == len(pair.todo) else "sessions"))
    return chosen


class _MapSettings:
    """Map settings as text, written once for all cells that share their settings."""

    def __init__(self) -> None:
        self._texts: dict[int, str] = {}

    def text(self, cell: Cell) -> str:
        """Return the map settings of a cell of a plan, which holds its settings while this is used."""
        name = id(cell.config)
        if name not in self._texts:
            self._texts[name] = cell.config.map.model_dump_json()
        return self._texts[name]
