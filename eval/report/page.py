"""One offline page about a run, with tables and pictures like the paper's, and its tables as CSV and LaTeX beside it.

The page reads a run folder and runs nothing. Everything it shows is inside the file: no script, font or picture is
fetched, and what draws its charts stands in it once. Only 3-D views are files of their own. What a folder lacks is
named on the page; only a folder without results.csv is refused.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from cdpipe.model.config import settings_table
from eval.core.charts import BLACK, BLUE, CONTEXT, ORANGE, VERMILLION
from eval.core.statistics import ENOUGH_PAIRS
from eval.plans.targets import read_targets
from eval.report.charts import Chart, plotly_script
from eval.report.cost.charts import draw_pareto
from eval.report.cost.pareto import pareto_table
from eval.report.latex import latex_tables, to_latex
from eval.report.merge.merge import draw_merge
from eval.report.merge.tables import MERGE_COLUMNS
from eval.report.objects.report import draw_objects
from eval.report.objects.tables import OBJECT_COLUMNS
from eval.report.paper import time_table, volume_table
from eval.report.regions.regions import REGION_COLUMNS, draw_regions
from eval.report.render import rendered, written
from eval.report.scenarios import draw_scenarios
from eval.report.settings.effects import draw_effects
from eval.report.settings.factors import draw_factors
from eval.report.settings.grids import PQ_COLUMN, draw_grids
from eval.report.site.site import draw_site
from eval.report.site.views import Views, write_views
from eval.report.site.worst import draw_worst, worst_rows
from eval.report.summary import draw_summary
from eval.report.tables import Cell, Table, results_table, to_csv, unchanged_table
from eval.running.run_data import (
    RunData,
    ends_at_merge,
    first_seed,
    flag,
    named_variants,
    of,
    read_run,
    scenarios,
    shown_variant,
    text,
)
from eval.running.runfolder import read_json
from eval.running.sides import Side, check_versions, is_contended
from eval.tables.columns import RESULT_COLUMNS, TIME_MEANINGS, UNDEFINED
from eval.tables.merge_table import merge_table

POINT_COLOURS = (
    (BLUE, "right"), (BLACK, "missed"), (VERMILLION, "wrong"), (ORANGE, "part of another answered object"),
    (CONTEXT, "surroundings"),
)  # fmt: skip


def write_page(run: Path, views: Views = "chosen") -> Path:
    """Write `index.html` and the tables table1, table2 (.csv, .tex), results.tex and summary.tex into a run folder.

    Also regions_table.tex and objects_table.tex where there are the tables, and pareto.csv with its pictures where
    methods can be compared by their cost. Of a run whose plan ends at the merge the page shows the merge alone. Where
    pairs have a kind, merge.csv is written.

    Args:
        run: The folder; results.csv must be there, anything else may be missing.
        views: Which pairs get a 3-D view, a file of its own below `views/` that the page links to; "none" for a page
            that is to stand without them.

    Returns:
        Path of the page.

    Raises:
        InputError: There are no results, they are of several metrics versions, or the folder cannot be written.
    """
    data = read_run(run)
    check_versions(Side(data), Side(data))
    files: dict[str, str | bytes] = {**latex_tables(data)}
    if len(merges := merge_table(pd.DataFrame(list(data.results)), read_targets(data.provenance))):
        files["merge.csv"] = merges.to_csv(index=False)
    if ends_at_merge(data):
        files["index.html"] = rendered("page.html", _merge_content(data, merges))
    else:
        tables = {"results": results_table(data), "table1": time_table(data), "table2": volume_table(data)}
        files["results.tex"] = to_latex(tables["results"])
        for name in ("table1", "table2"):
            files[f"{name}.csv"] = to_csv(tables[name])
            files[f"{name}.tex"] = to_latex(tables[name])
        points = pareto_table(data)
        if len(points):
            files["pareto.csv"] = points.to_csv(index=False)
        content = _content(data, merges, tables, draw_pareto(points, is_contended=is_contended(data)), views)
        files |= {f"{each.name}.png": each.png for each in content["charts"] if each.has_png}
        files["index.html"] = rendered("page.html", content)
    for name, file in files.items():
        written(run / name, file)
    return run / "index.html"


def _content(
    data: RunData, merges: pd.DataFrame, tables: Mapping[str, Table], pareto: Sequence[Chart], views: Views
) -> dict[str, Any]:
    regions, objects = draw_regions(data), draw_objects(data)
    worlds = scenarios(data, unchanged=False)
    # a run about objects alone shows its best and worst in their own section, and no maps
    is_mapped = regions is not None or objects is None
    sites = [draw_site(data, scenario) for scenario in worlds] if is_mapped else []
    variant = shown_variant(data)
    worst = worst_rows(data, variant)
    links = write_views(data, variant, [(str(row["scenario"]), int(row["seed"])) for row in worst], views)
    grids, factors, by_scenario = draw_grids(data), draw_factors(data), draw_scenarios(data)
    unchanged = unchanged_table(data)
    n_unchanged = len({(row["scenario"], row["seed"]) for row in data.results if flag(row, "is_unchanged_pair")})
    merge = draw_merge(data)
    missing = [*data.missing, *(line for site in sites for line in site.missing), *merge.missing, *links.missing]
    missing += [] if regions is None else regions.missing
    missing += [] if objects is None else objects.missing
    missing += [] if worlds else ["No scenario with changes was run."]
    if objects is None:
        missing += [] if n_unchanged else ["No unchanged pair was run, so false alarms are not measured."]
        missing += [] if grids else ["No grid of two settings was run."]
    charts = [*(regions.plots if regions is not None else ()), *pareto, *by_scenario, *grids, *factors]
    return {
        **_about(data, missing),
        "summary": draw_summary(data, merges),
        "regions": regions,
        "region_columns": [] if regions is None else REGION_COLUMNS,
        "objects": objects,
        "object_columns": [] if objects is None else OBJECT_COLUMNS,
        "merge": merge,
        "results": tables["results"],
        "unchanged": unchanged,
        "n_unchanged": n_unchanged,
        "effects": draw_effects(data),
        "enough_pairs": ENOUGH_PAIRS,
        "table1": tables["table1"],
        "table2": tables["table2"],
        "grids": grids,
        "factors": factors,
        "by_scenario": by_scenario,
        "pareto": pareto,
        "views": links,
        "worst": draw_worst(data, variant, worst) if is_mapped else [],
        "worst_variant": variant,
        "charts": charts,
        "plotly": plotly_script() if charts else "",
        "sites": sites,
        "columns": (*RESULT_COLUMNS, *([PQ_COLUMN] if grids else [])),
        "time_meanings": TIME_MEANINGS,
        "point_colours": POINT_COLOURS,
    }


def _merge_content(data: RunData, merges: pd.DataFrame) -> dict[str, Any]:
    """Return the content of a page that shows the merge alone."""
    merge = draw_merge(data)
    # what a run without regions and objects does not hold is not missing
    missing = [line for line in data.missing if line.startswith("provenance.json")]
    return {
        **_about(data, [*missing, *merge.missing]),
        "summary": draw_summary(data, merges),
        "merge": merge,
        "columns": MERGE_COLUMNS,
        "views": None,
        "charts": (),
        "plotly": "",
    }


def _about(data: RunData, missing: Sequence[str]) -> dict[str, Any]:
    """Return what every page tells of its run."""
    return {
        "plan": str(data.provenance.get("plan", {}).get("name", "")),
        "machine": machine_text(data.provenance),
        "command": str(data.provenance.get("command") or "unknown"),
        "finished": str(data.provenance.get("finished") or "unknown"),
        "missing": list(dict.fromkeys(missing)),
        "failures": failures(data),
        "settings": settings(data),
        "provenance": json.dumps(data.provenance, indent=2, ensure_ascii=False),
        "commits": commits_text(data),
    }


def failures(data: RunData) -> list[str]:
    """Return one line for every pair and reason without an answer, naming the variants it met."""
    found: dict[tuple[str, int, str], list[str]] = {}
    for row in data.results:
        status, error = text(row, "status"), text(row, "error")
        if status != "ok":
            reason = status.replace("_", " ") + (f": {error}" if error else "")
            found.setdefault((str(row["scenario"]), int(row["seed"]), reason), []).append(str(row["variant"]))
    return [
        f"{scenario}, seed {seed}, {', '.join(variants)}: {reason}"
        for (scenario, seed, reason), variants in found.items()
    ]


def machine_text(provenance: Mapping[str, Any]) -> str:
    """Return the machine in a few words: processor, cores, memory, threads."""
    machine = provenance.get("machine")
    if not isinstance(machine, Mapping):
        return "unknown"
    threads = machine.get("threads")
    used = threads.get("OMP_NUM_THREADS", "unknown") if isinstance(threads, Mapping) else "unknown"
    parts = [
        str(machine.get("cpu", "unknown processor")),
        f"{machine.get('cores', 'unknown')} cores",
        f"{machine.get('memory_gb', 'unknown')} GB",
        str(machine.get("platform", "")),
        f"OMP_NUM_THREADS {used}",
    ]
    return ", ".join(part for part in parts if part)


def commits_text(data: RunData) -> str:
    """Return which commits made how many of the answers, "" where all are of one; cells are kept when code changes."""
    counts = Counter(text(row, "commit") or "unknown" for row in data.results)
    if len(counts) < 2:
        return ""
    named = ", ".join(f"{commit} ({n} {'row' if n == 1 else 'rows'})" for commit, n in counts.items())
    return f"The answers were made by more than one commit: {named}. A + marks a tree that differed from its commit."


def settings(data: RunData) -> Table:
    """Return the effective settings of every named variant, from its answers, sites that differ side by side."""
    found: dict[str, list[dict[str, str]]] = {}
    for scenario in [*scenarios(data, unchanged=False), *scenarios(data, unchanged=True)]:
        seed = first_seed(data, scenario)
        for name in named_variants(data, scenario):
            if of(data.results, scenario=scenario, seed=seed, variant=name):
                document = read_json(data.folder.answer(scenario, seed, name) / "answer.json")
                found.setdefault(name, []).append(_flat(document.get("config") or {}))
    keys = [key for key, _, _ in settings_table()]
    keys += sorted({key for configs in found.values() for config in configs for key in config} - set(keys))
    rows = []
    for key in keys:
        values = [
            " / ".join(dict.fromkeys(config[key] for config in configs if key in config)) or UNDEFINED
            for configs in found.values()
        ]
        differs = len(set(values)) > 1
        rows.append(("", (Cell(key), *(Cell(value, differs) for value in values))))
    return Table(("setting", *found), tuple(rows), "Effective settings")


def _flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    flat: dict[str, str] = {}
    for key, value in config.items():
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{prefix}{key}."))
        else:
            flat[prefix + key] = "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
    return flat
