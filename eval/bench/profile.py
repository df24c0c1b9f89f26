"""Where the time of a pair goes, stage by stage: `tunnelcd bench --profile`.

`simulate` is measured by its own steps, each after the other: world, drives, all scans into memory, all files. `detect`
is measured by the hooks of the pipeline; reading is booked apart from the stage that reads.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cdpipe
from cdpipe.core.errors import InputError
from cdpipe.core.isolation import ProcessDiedError, run_isolated
from cdpipe.core.progress import Progress, report_nothing
from cdpipe.core.threads import THREADS
from cdpipe.core.whole_file import whole_file
from cdpipe.descriptors import use_threads
from cdpipe.io.readers import open_session
from cdpipe.io.session import SessionWriter
from eval.bench.meter import MeteredScans, StageMeter
from eval.core.output import unwritable
from eval.core.provenance import git_commit, machine
from scenarios.library import load_scenario
from sim.scene import build_world
from sim.session.planning import plan_drives_in
from sim.session.revolution import Drive
from sim.session.simulate import THREADS as CASTING
from sim.session.simulate import HeldSession, LabelledSession, hold_session
from sim.session.truth import write_labels, write_true_poses

SITES = ("paper/site1", "paper/site2")
_SIMULATE = ("world", "drives", "scans", "writing")
_DETECT = (
    "reading", "consistency", "mapping", "descriptors", "sphere descriptors", "merge", "query", "extraction", "surface",
)  # fmt: skip
# Parts of a stage that the report times by itself, by the wall clock.
_PARTS = {"t_index_s": "merge: index", "t_merge_s": "merge: search", "t_refine_s": "merge: refinement"}


def measure_profile(
    scenarios: Sequence[str] = SITES,
    seed: int = 0,
    *,
    has_surface: bool = False,
    on_progress: Progress = report_nothing,
    run: Callable[[Callable[[Any], Any], Any], Any] = run_isolated,
) -> dict[str, Any]:
    """Simulate and compare a pair of each scenario, each in a process of its own.

    Args:
        scenarios: Names or files.
        seed: Seed of the worlds.
        has_surface: Whether the displacement of the rock is measured as well.
        on_progress: Called with the scenario, how many are done, and how many there are.
        run: Calls a function with a document, in a process of its own.

    Returns:
        `machine`, `commit`, `seed`, and `rows`: scenario, command, stage, wall_s, cpu_s, share (of the command's CPU
        time), peak_mb. A part of a stage, whose name holds a colon, has wall_s alone.

    Raises:
        InputError: A scenario is unknown, its pair cannot be merged, or its process died.
    """
    for name in scenarios:
        load_scenario(name, seed)  # a mistake is told before the first is measured
    rows = []
    for done, name in enumerate(scenarios):
        on_progress(name, done, len(scenarios))
        try:
            rows += run(measure_scenario, {"scenario": name, "seed": seed, "has_surface": has_surface})
        except ProcessDiedError as error:
            raise InputError(f"{name}: the process that measures it died ({error}): is there enough memory?") from error
    return {"machine": machine(), "commit": git_commit(), "seed": seed, "rows": rows}


def measure_scenario(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of one scenario: for `run_isolated`. The document has `scenario`, `seed` and `has_surface`."""
    name, seed = document["scenario"], document["seed"]
    use_threads(THREADS)
    with TemporaryDirectory() as folder:
        simulated = _simulate(name, seed, Path(folder))
        compared, seconds = _detect(Path(folder), has_surface=document["has_surface"])
    of_detect = _rows(name, "detect", compared, _DETECT)
    after_merge = 1 + [row["stage"] for row in of_detect].index("merge")
    parts = [_row(name, "detect", stage, wall_s=seconds.get(part)) for part, stage in _PARTS.items()]
    of_detect[after_merge:after_merge] = parts
    return _rows(name, "simulate", simulated, _SIMULATE) + of_detect


def _simulate(name: str, seed: int, folder: Path) -> StageMeter:
    """Write both sessions, with their truth, into a folder."""
    scenario, meter = load_scenario(name, seed), StageMeter()
    meter.start("world")
    world = build_world(scenario, seed)
    meter.start("drives")
    drives = plan_drives_in(world, scenario, seed)
    del world
    with ThreadPoolExecutor(min(CASTING, os.cpu_count() or 1)) as pool:
        for drive in drives:
            meter.start("scans")
            held = hold_session(drive, pool)
            meter.start("writing")
            _write(drive, held, folder / drive.name)
    meter.start("")
    return meter


def _write(drive: Drive, held: LabelledSession, folder: Path) -> None:
    """Write a session that is in memory, and its truth."""
    session = held.session
    assert isinstance(session, HeldSession)
    provenance, n_chunk = dict(session.provenance), session.chunk_scans
    with SessionWriter(folder, drive.sensor, n_chunk, provenance, session.n_returns) as writer:
        for index, chunk in enumerate(session.held):
            writer.add(chunk)
            rows = slice(index * n_chunk, (index + 1) * n_chunk)
            write_labels(writer.folder, index, held.instance[rows], held.change[rows])
        write_true_poses(writer.folder, held.world_T_sensor)
        writer.close(session.odom_T_sensor)


def _detect(pair: Path, *, has_surface: bool) -> tuple[StageMeter, Mapping[str, float]]:
    """Compare both sessions of a pair; return the costs of the stages, and the seconds of the report."""
    meter = StageMeter()
    with meter.aside("reading"):
        before, after = (MeteredScans(open_session(pair / name), meter) for name in ("before", "after"))
    settings = ["surface.method=planes"] if has_surface else []
    report = cdpipe.detect(before, after, settings=settings, hooks=meter)
    meter.start("")
    return meter, report.seconds


def _rows(scenario: str, command: str, meter: StageMeter, stages: Sequence[str]) -> list[dict[str, Any]]:
    total_s = sum(cost.cpu_s for cost in meter.costs.values())
    return [
        _row(scenario, command, stage, cost.wall_s, cost.cpu_s, cost.cpu_s / total_s, _known(cost.peak_mb))
        for stage in stages
        if (cost := meter.costs.get(stage)) is not None
    ]


def _row(
    scenario: str,
    command: str,
    stage: str,
    wall_s: float | None = None,
    cpu_s: float | None = None,
    share: float | None = None,
    peak_mb: float | None = None,
) -> dict[str, Any]:
    told = {"scenario": scenario, "command": command, "stage": stage}
    return {**told, "wall_s": wall_s, "cpu_s": cpu_s, "share": share, "peak_mb": peak_mb}


def _known(peak_mb: float) -> float | None:
    return None if math.isnan(peak_mb) else peak_mb  # JSON has no NaN


def as_markdown(table: Mapping[str, Any]) -> str:
    """Return the table for a page: one row for each stage, CPU seconds, share and wall-clock seconds by scenario."""
    rows, made = table["rows"], table["machine"]
    scenarios = list(dict.fromkeys(row["scenario"] for row in rows))
    stages = list(dict.fromkeys((row["command"], row["stage"]) for row in rows))
    found = {(row["scenario"], row["command"], row["stage"]): row for row in rows}
    threads = ", ".join(f"{name}={value}" for name, value in made["threads"].items() if value != "unset")
    commit = (table["commit"] or "unknown")[:9]
    lines = [
        f"{made['cpu']}, {made['cores']} cores, {threads or 'threads unset'}, commit {commit}, seed {table['seed']}.",
        "",
        "| command | stage | " + " | ".join(f"{name}: CPU s | share | wall s | peak MB" for name in scenarios) + " |",
        "|---|---|" + "---|" * (4 * len(scenarios)),
    ]
    for command, stage in stages:
        cells = [_cells(found.get((name, command, stage))) for name in scenarios]
        lines.append(f"| {command} | {stage} | " + " | ".join(cells) + " |")
    for command in dict.fromkeys(command for command, _ in stages):
        sums = [[row for row in rows if (row["scenario"], row["command"]) == (name, command)] for name in scenarios]
        lines.append(f"| {command} | all | " + " | ".join(map(_total, sums)) + " |")
    return "\n".join(lines) + "\n"


def _cells(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return " | | | "
    formats = {"cpu_s": "{:.2f}", "share": "{:.0%}", "wall_s": "{:.2f}", "peak_mb": "{:.0f}"}
    return " | ".join("" if row[name] is None else form.format(row[name]) for name, form in formats.items())


def _total(rows: Sequence[Mapping[str, Any]]) -> str:
    whole = [row for row in rows if row["cpu_s"] is not None]
    peaks = [row["peak_mb"] for row in whole if row["peak_mb"] is not None]
    cpu_s, wall_s = (sum(row[name] for row in whole) for name in ("cpu_s", "wall_s"))
    return f"{cpu_s:.1f} | | {wall_s:.1f} | {f'{max(peaks):.0f}' if peaks else ''}"


def write_markdown(table: Mapping[str, Any], path: Path) -> Path:
    """Write the table for a page beside the JSON file of `path`; return where.

    Raises:
        InputError: It cannot be written.
    """
    page = path.with_suffix(".md")
    try:
        with whole_file(page) as partial:
            partial.write_text(as_markdown(table), encoding="utf-8")
    except OSError as error:
        raise unwritable(page, error) from error
    return page
