"""How time and memory of the main parts grow with their input: `tunnelcd bench --growth`.

One size of an axis is measured in a process of its own. The exponent of a stage is fitted to its CPU time, because
machines are shared; wall clock and peak memory stand beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.errors import InputError
from cdpipe.core.isolation import ProcessDiedError, run_isolated
from cdpipe.core.progress import Progress, report_nothing
from cdpipe.core.whole_file import whole_file
from cdpipe.core.yamlfile import suggest
from eval.bench.exponents import fit_growth
from eval.bench.growth_axes import Axis, list_axes, measure_size
from eval.core.charts import COLOURS, SYMBOLS, Drawing, Look, Panel, Series, log_span
from eval.core.charts import Axis as ChartAxis
from eval.core.figures import picture, png
from eval.core.output import unwritable
from eval.core.provenance import git_commit, machine

LIMIT = 1.1
# Stages that take less CPU time than this at the largest size are not judged: start-up and noise decide.
_SHORTEST_S = 0.1
_MEMORY = "memory"
_PER_ROW, _ROW_PX = 3, 230


def choose_axes(only: Sequence[str]) -> list[Axis]:
    """Return the axes of some names, or all of them if none is named.

    Raises:
        InputError: A name is unknown.
    """
    every = list_axes()
    unknown = [name for name in only if name not in every]
    if unknown:
        wrong = "; ".join(f"{name!r} is no axis of growth{suggest(name, list(every))}" for name in unknown)
        raise InputError(f"--only: {wrong} (known: {', '.join(every)})")
    return [axis for name, axis in every.items() if not only or name in only]


def measure_growth(
    axes: Sequence[Axis],
    *,
    quick: bool = False,
    large: bool = False,
    on_progress: Progress = report_nothing,
    run: Callable[[Callable[[Any], Any], Any], Any] = run_isolated,
) -> dict[str, Any]:
    """Measure every size of some axes, and fit.

    Args:
        axes: What to measure.
        quick: Sizes of a test, which say nothing about growth.
        large: The largest sizes as well.
        on_progress: Called with axis and size, how many are done, and how many there are.
        run: Calls a function with a document, in a process of its own.

    Returns:
        `machine`, `commit`, `rows` (one for each axis and stage), `measured` (one for each axis, size and stage), and
        `failed`: sizes whose process died, as it does where memory does not suffice.
    """
    todo = [(axis, size) for axis in axes for size in _sizes(axis, quick=quick, large=large)]
    measured: list[dict[str, Any]] = []
    failed: list[dict[str, Any]] = []
    for done, (axis, size) in enumerate(todo):
        on_progress(f"{axis.name} {size:g}", done, len(todo))
        try:
            measured += _as_rows(axis.name, size, run(measure_size, {"axis": axis.name, "size": size}))
        except ProcessDiedError as error:
            failed.append({"axis": axis.name, "asked": size, "reason": str(error)})
    rows = [row for axis in axes for row in _fit_axis(axis, measured)]
    return {"machine": machine(), "commit": git_commit(), "rows": rows, "measured": measured, "failed": failed}


def _sizes(axis: Axis, *, quick: bool, large: bool) -> list[float]:
    return list(axis.quick) if quick else [*axis.sizes, *(axis.large if large else ())]


def _as_rows(axis: str, asked: float, found: Mapping[str, Any]) -> list[dict[str, Any]]:
    named = {"axis": axis, "asked": asked, "size": found["size"]}
    of_process = {"wall_s": None, "cpu_s": None, "peak_mb": found["peak_mb"], "base_mb": found["base_mb"]}
    stages = [{**named, "stage": name, **cost, "base_mb": None} for name, cost in found["stages"].items()]
    return [*stages, {**named, "stage": _MEMORY, **of_process}]


def _fit_axis(axis: Axis, measured: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of one axis: its stages by CPU time, and the memory of the whole process above its start."""
    own = [row for row in measured if row["axis"] == axis.name]
    rows = []
    for stage in [name for name in (*axis.stages, _MEMORY) if any(row["stage"] == name for row in own)]:
        of_stage = sorted((row for row in own if row["stage"] == stage), key=lambda row: row["size"])
        sizes = [row["size"] for row in of_stage]
        if stage == _MEMORY:
            figures, unit = [row["peak_mb"] - row["base_mb"] for row in of_stage], "MB"
        else:
            figures, unit = [row["cpu_s"] for row in of_stage], "CPU s"
        growth = fit_growth(sizes, figures)
        rows.append(
            {
                "axis": axis.name, "grows": axis.grows, "stage": stage, "unit": unit, "n": len(sizes),
                "smallest": sizes[0], "largest": sizes[-1], "first": figures[0], "value": figures[-1],
                "exponent": growth.exponent, "low": growth.low, "high": growth.high, "last": growth.last,
                "verdict": judge(growth.exponent, growth.last, figures[-1] if unit != "MB" else np.inf),
                "wall_s": of_stage[-1]["wall_s"], "peak_mb": of_stage[-1]["peak_mb"],
            }
        )  # fmt: skip
    return rows


def judge(exponent: float, last: float, largest_s: float) -> str:
    """Return "above" the limit, "rising" where only the last step is, "short" where the time says nothing, else ""."""
    if largest_s < _SHORTEST_S:
        return "short"
    if exponent > LIMIT:
        return "above"
    return "rising" if last > LIMIT else ""


def summarise_growth(table: Mapping[str, Any]) -> str:
    """Return one line: how many exponents are at most the limit, which are above it, and what was not measured."""
    rows = table["rows"]
    judged = [row for row in rows if row["verdict"] != "short" and row["exponent"] == row["exponent"]]
    told = []
    for verdict, words in (("above", f"above {LIMIT:g}"), ("rising", f"above {LIMIT:g} at the last step alone")):
        names = [f"{row['axis']}: {row['stage']}" for row in judged if row["verdict"] == verdict]
        told += [f"{words}: {', '.join(names)}"] if names else []
    died = [f"{each['axis']} {each['asked']:g} ({each['reason']})" for each in table["failed"]]
    told += [f"not measured, the process died: {', '.join(died)}"] if died else []
    n_above = sum(row["verdict"] == "above" for row in judged)
    return "; ".join([f"{len(judged) - n_above} of {len(judged)} exponents are at most {LIMIT:g}", *told])


def draw_growth(table: Mapping[str, Any]) -> Drawing:
    """Return the chart: one panel for each axis, CPU seconds of each stage over the size."""
    measured = [row for row in table["measured"] if row["stage"] != _MEMORY]
    names = list(dict.fromkeys(row["stage"] for row in measured))
    looks = {
        name: Look(COLOURS[k % len(COLOURS)], dash="solid" if k < len(COLOURS) else "dash", marker=SYMBOLS[k % 9])
        for k, name in enumerate(names)
    }
    axes = {row["axis"]: row["grows"] for row in table["rows"]}
    panels = [_panel(title, [row for row in measured if row["axis"] == axis], looks) for axis, title in axes.items()]
    return Drawing([panels[k : k + _PER_ROW] for k in range(0, len(panels), _PER_ROW)], _ROW_PX)


def _panel(title: str, rows: Sequence[Mapping[str, Any]], looks: Mapping[str, Look]) -> Panel:
    series = []
    for name in dict.fromkeys(row["stage"] for row in rows):
        own = sorted((row for row in rows if row["stage"] == name), key=lambda row: row["size"])
        series.append(Series([row["size"] for row in own], [row["cpu_s"] for row in own], looks[name], name))
    x = ChartAxis(title, log_span([row["size"] for row in rows]), is_log=True)
    return Panel(x, ChartAxis("CPU s", log_span([row["cpu_s"] for row in rows]), is_log=True), series)


def write_growth(table: Mapping[str, Any], path: Path) -> list[Path]:
    """Write the measurements as CSV and the chart, if any, as PNG beside the JSON file of `path`; return the paths.

    Raises:
        InputError: They cannot be written.
    """
    csv, image = path.with_suffix(".csv"), path.with_suffix(".png")
    try:
        with whole_file(csv) as partial:
            pd.DataFrame(table["measured"]).to_csv(partial, index=False, float_format="%.6g")
        if table["rows"]:  # no size of any axis may have been measured
            with whole_file(image) as partial:
                partial.write_bytes(png(picture(draw_growth(table))))
    except OSError as error:
        raise unwritable(path, error) from error
    return [csv, image] if table["rows"] else [csv]
