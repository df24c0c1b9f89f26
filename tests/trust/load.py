"""Large input: peak memory and time of `detect` on 10 km, of a score of 1,000 changes, and of a plan of 5,000 cells.

    python -m tests.trust.load [--only maps|changes|cells] [--km 10] [--changes 1000] [--cells 5000] [--keyframes 150]
                               [--folder DIR]

Every row is measured in a process of its own; `maps` has a row for each stage. Ends with 1 if a limit is exceeded.
Needs Linux, which says the peak memory of a part of a process.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

import cdpipe
from cdpipe.core.geometry import make_pose, stream, yaw_pose
from cdpipe.io.answer import Answer
from cdpipe.model.report import ChangedObject, ChangeRegions, ChangeReport, ObjectShape
from eval.bench.corridor import CorridorScans
from eval.bench.meter import StageMeter, peak_mb
from eval.plans.cells import expand_cells
from eval.plans.plan import load_plan
from eval.plans.worlds import list_worlds
from eval.running.pair_run import CellKeys
from eval.running.runfolder import RunFolder, write_json
from eval.scoring.scoring import score_answer
from eval.truth.ground_truth import GroundTruth, SessionTruth, ground_truth
from eval.truth.scoring_points import ScoringPoints
from scenarios.library import load_scenario
from scenarios.references import file_digests
from sim.session.truth import PairTruth
from tests.eval.changes import change

MAPS_GB, SCORE_S, PLAN_S, PAGE_MB, CELLS_GB = 8.0, 60.0, 60.0, 30.0, 8.0
# A plan of so many cells may take `PLAN_S`, a larger one as much more.
_PLAN_CELLS = 5000
# A tunnel of this radius has a million map points a kilometre. A heap lies every 50 m in one session or the other.
_RADIUS_M, _SPACING_M, _HEAPS_M = 4.4, 2.0, 50.0
_CELLS_OF_CHANGE, _OTHER_CELLS = 300, 2_000_000
_N_PIXELS = 1 << 15
# A cell of the plan `smoke` has a short tunnel; these are the numbers of items of a usual one.
_ITEMS = {"keyframes": 150, "regions": 15, "objects": 4, "changes": 4}


class Row(NamedTuple):
    """One row of the table; a limit that is not a number is none."""

    what: str
    size: str
    peak_gb: float
    seconds: float
    limit: str = ""
    is_within: bool = True


def measure_maps(km: float) -> list[Row]:
    """Detect changes between two drives of some kilometres."""
    places = np.arange(_HEAPS_M / 2, 1000 * km, _HEAPS_M)
    before = CorridorScans(1000 * km, _RADIUS_M, _SPACING_M, places[::2].tolist(), seed=1)
    pose = yaw_pose(0.7, (30.0, -20.0, 1.0))
    after = CorridorScans(1000 * km, _RADIUS_M, _SPACING_M, places[1::2].tolist(), seed=2, odom_T_world=pose)
    meter = StageMeter()
    report = cdpipe.detect(before, after, hooks=meter, settings=["query.threshold=-20"])
    meter.start("")
    n_points = [report.evidence[f"map_points_{name}"] / 1e6 for name in ("before", "after")]
    size = f"{km:g} km, {n_points[0]:.1f} + {n_points[1]:.1f} million map points"
    stages = [Row(f"detect: {name}", "", cost.peak_mb / 1e3, cost.wall_s) for name, cost in meter.costs.items()]
    peak_gb, seconds = max(row.peak_gb for row in stages), sum(row.seconds for row in stages)
    return [*stages, Row("detect", size, peak_gb, seconds, f"{MAPS_GB:g} GB", peak_gb <= MAPS_GB)]


def measure_changes(n: int) -> list[Row]:
    """Score an answer that finds all of many changes, 10 m apart."""
    truth = _crowded_truth(n)
    objects = [_answered(truth, index) for index in range(n)]
    centres = np.column_stack([10.0 * np.arange(n) + 5.0, np.zeros((n, 2))])
    pairs = np.zeros((n, 2), dtype=np.int64)
    scores = stream(0, "scores").random(10 * n + 1)
    regions = ChangeRegions(centres, 4.5, -np.arange(n, dtype=np.float64), pairs, np.ones(n, np.bool_), scores)
    scans = np.arange(10 * n + 1)
    report = ChangeReport(make_pose(), {}, regions, tuple(objects), {}, {}, (scans, scans))
    start = time.monotonic()
    row = score_answer(Answer("ok", "", "all", report, {}, {}), truth).row
    seconds = time.monotonic() - start
    assert row["object_iou_point"] == row["region_recall"] == 1.0
    size = f"{n} changes, objects and regions"
    return [Row("score", size, peak_mb() / 1e3, seconds, f"{SCORE_S:g} s", seconds <= SCORE_S)]


def measure_cells(n: int, n_keyframes: int = 150, place: str | None = None) -> list[Row]:
    """Schedule a plan from nothing, run it where its cells are all finished, and write its tables and its page.

    The times are those of the processor: the commands wait for nobody, and other programs do not count.
    """
    with tempfile.TemporaryDirectory(dir=place) as folder:
        plan, run = _finished_plan(Path(folder), n, n_keyframes)
        schedule = _tunnelcd("run", str(plan), "--out", str(Path(folder, "new")), "--dry-run")
        resume = _tunnelcd("run", str(plan), "--out", str(run), "--quiet")
        page = _tunnelcd("report", str(run))
        page_mb = (run / "index.html").stat().st_size / 1e6
    peak_gb, seconds = max(resume[0], page[0]), resume[1] + page[1]
    limit_s = PLAN_S * max(1.0, n / _PLAN_CELLS)
    return [
        Row("run --dry-run: nothing is finished", f"{n} cells", *schedule),
        Row("run: nothing left to do, tables written", f"{n} cells, {n_keyframes} keyframes each", *resume),
        Row("report", f"page of {page_mb:.1f} MB", *page, f"{PAGE_MB:g} MB", page_mb <= PAGE_MB),
        Row("run and report", f"{n} cells", peak_gb, seconds, f"{limit_s:g} s", seconds <= limit_s),
        Row("run and report", f"{n} cells", peak_gb, seconds, f"{CELLS_GB:g} GB", peak_gb <= CELLS_GB),
    ]


def _crowded_truth(n: int) -> GroundTruth:
    changes = []
    for number in range(1, n + 1):
        session, kind = ("before", "removed") if number % 2 else ("after", "added")
        pose = make_pose(translation=(10.0 * number - 5.0, 0.0, 0.0)).tolist()
        changes.append(change(number, session, kind, world_T_object=pose))
    pair = PairTruth("narrow", 0, 4.5, tuple(changes), {}, {})
    return ground_truth(pair, {"before": _crowded_session(n, 1), "after": _crowded_session(n, 0)})


def _crowded_session(n: int, parity: int) -> SessionTruth:
    """Return a session that drives along x past those of n changes whose number has a parity."""
    rng = stream(parity, "crowded")
    ids = np.concatenate([np.repeat(np.arange(2 - parity, n + 1, 2), _CELLS_OF_CHANGE), np.zeros(_OTHER_CELLS, int)])
    x_m = np.where(ids > 0, 10.0 * ids - 5.0 + rng.uniform(-0.5, 0.5, len(ids)), rng.uniform(0.0, 10.0 * n, len(ids)))
    order = np.argsort(x_m)
    points = np.column_stack([x_m, rng.uniform(-0.5, 0.5, (len(ids), 2))])[order].astype(np.float32)
    scans = np.sort(x_m.astype(np.int64))
    pixels = np.arange(len(scans)) - np.searchsorted(scans, scans)
    poses = make_pose(translation=np.column_stack([np.arange(10.0 * n + 1), np.zeros((10 * n + 1, 2))]))
    nearest_m = np.full(n + 1, 2.0, dtype=np.float32)
    change_of, instance = ids[order].astype(np.int16), np.zeros(len(ids), dtype=np.int16)
    found = ScoringPoints(scans * _N_PIXELS + pixels, points, change_of, instance, len(poses), _N_PIXELS, nearest_m)
    return SessionTruth(poses, poses, found)


def _answered(truth: GroundTruth, index: int) -> ChangedObject:
    """Return the object that is exactly a change."""
    item, rows = truth.pair.changes[index], truth.change_rows[index]
    points = truth.sessions[item.session].scoring_points
    returns = np.column_stack([points.scans(rows), points.pixels(rows)]).astype(np.int32)
    shape = ObjectShape(make_pose(), np.ones(3), 1.0)
    return ChangedObject(item.session, item.kind, index, returns, truth.points_odom(index), 1.0, shape=shape)


def _finished_plan(folder: Path, n: int, n_keyframes: int = 150) -> tuple[Path, Path]:
    """Run the plan `smoke`, and copy its cells to as many seeds as make n cells.

    Returns:
        The plan and its run folder.
    """
    plan, run, made = folder / "load.yaml", RunFolder(folder / "run"), RunFolder(folder / "made")
    _tunnelcd("run", "smoke", "--out", str(made.path), "--quiet")
    smoke = load_plan("smoke")
    n_seeds = n // (len(smoke.scenarios) * len(smoke.variants))
    document = {**smoke.model_dump(mode="json", exclude_unset=True), "seeds": f"20000:{20000 + n_seeds}"}
    plan.write_text(yaml.safe_dump({**document, "name": "load", "report": ["regions", "objects"]}))
    cells = expand_cells(load_plan(str(plan)))
    worlds = {world.label: world for world in list_worlds(smoke.scenarios)}
    rng, keys, sizes = stream(0, "cells"), CellKeys(), {**_ITEMS, "keyframes": n_keyframes}
    stored_cells: dict[tuple[str, str], Any] = {}
    for (name, seed), group in groupby(cells, key=lambda cell: (cell.scenario, cell.seed)):
        scenario = load_scenario(worlds[name].name, seed, worlds[name].settings)
        key = keys.of_pair(seed, worlds[name].pair_kind, scenario, file_digests(scenario))
        for cell in group:
            if (name, cell.variant) not in stored_cells:
                stored_cells[name, cell.variant] = made.read_cell(made.cell(name, smoke.seeds[0], cell.variant))
            stored = stored_cells[name, cell.variant]
            assert stored is not None
            copied = {**_copied(stored, seed, float(rng.uniform(0.9, 1.0)), sizes), "key": key(cell)}
            write_json(run.cell(name, seed, cell.variant), copied)
    write_json(run.path / "provenance.json", made.provenance())
    return plan, run.path


def _copied(stored: Mapping[str, Any], seed: int, factor: float, sizes: Mapping[str, int]) -> dict[str, Any]:
    """Return a cell for another seed, its scores times a factor, with as many items as a usual cell has."""
    copy = json.loads(json.dumps(stored))
    shares = [
        key for key, value in copy["row"].items() if type(value) is float and key.startswith(("region_", "object_"))
    ]
    copy["row"] |= {"seed": seed, **{key: factor * copy["row"][key] for key in shares}}
    for table, n in sizes.items():
        items = [{**item, "seed": seed} for item in copy[table]]
        if table in ("keyframes", "regions"):
            items = [{**items[k % len(items)], table[:-1]: k} for k in range(n if items else 0)]
        copy[table] = items
    return copy


def _tunnelcd(*words: str) -> tuple[float, float]:
    """Run a command; return its peak memory, GB, and the seconds of the processor that it took."""
    command = [sys.executable, "-c", "from eval.cli.main import main; main()", *words]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{' '.join(words)}: exit code {process.returncode}")
    return usage.ru_maxrss / 1e6, usage.ru_utime + usage.ru_stime


def main() -> int:
    """Measure, print the table as it grows, and return 1 if a limit is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=["maps", "changes", "cells"])
    parser.add_argument("--km", type=float, default=10.0)
    parser.add_argument("--changes", type=int, default=1000)
    parser.add_argument("--cells", type=int, default=5000)
    parser.add_argument("--keyframes", type=int, default=150, help="of each cell")
    parser.add_argument("--folder", help="where the run folder lies while it is measured")
    chosen = parser.parse_args()
    every = {
        "maps": (measure_maps, (chosen.km,)),
        "changes": (measure_changes, (chosen.changes,)),
        "cells": (measure_cells, (chosen.cells, chosen.keyframes, chosen.folder)),
    }
    sys.stdout.write("| what | size | peak GB | seconds | limit |\n| --- | --- | --- | --- | --- |\n")
    is_within = True
    for name, (measure, sizes) in every.items():
        if chosen.only in (None, name):
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
                rows = process.submit(measure, *sizes).result()
            for row in rows:
                verdict = f"{row.limit}: {'met' if row.is_within else 'exceeded'}" if row.limit else ""
                sys.stdout.write(f"| {row.what} | {row.size} | {row.peak_gb:.2f} | {row.seconds:.1f} | {verdict} |\n")
            sys.stdout.flush()
            is_within &= all(row.is_within for row in rows)
    return 0 if is_within else 1


if __name__ == "__main__":
    sys.exit(main())
