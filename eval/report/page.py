"""One offline page about a run, with its tables as CSV and LaTeX files beside it.

The page reads a run folder and runs nothing. The file holds every script, font and picture that it shows, and fetches
nothing; only 3-D views are files of their own. The page names what the folder lacks. A folder without results.csv is
refused.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from cdpipe.core.errors import InputError
from cdpipe.model.config import settings_table
from eval.core.charts import BLACK, BLUE, CONTEXT, ORANGE, VERMILLION
from eval.core.output import require_no_links
from eval.core.statistics import ENOUGH_PAIRS
from eval.core.tablefile import csv_text
from eval.core.terminal.progress import RunProgress
from eval.plans.targets import read_targets
from eval.report.cost import draw_pareto, pareto_table
from eval.report.drawing.charts import Chart
from eval.report.framing.glossary import describe_columns, describe_methods, index_entries
from eval.report.framing.headline import write_answer, write_title
from eval.report.framing.kept import KeptPage, keep, read_kept
from eval.report.hardness import draw_hardness
from eval.report.latex import latex_tables, to_latex
from eval.report.merge.merge import draw_merge
from eval.report.merge.tables import MERGE_COLUMNS
from eval.report.objects.report import draw_objects
from eval.report.objects.tables import OBJECT_COLUMNS
from eval.report.paper import time_table, volume_table
from eval.report.regions.regions import REGION_COLUMNS, draw_regions
from eval.report.render import render_page, write_files
from eval.report.scenarios import draw_scenarios
from eval.report.settings.effects import draw_effects
from eval.report.settings.factorial import draw_factorial, factorial_table
from eval.report.settings.factors import draw_factors
from eval.report.settings.grids import PQ_COLUMN, draw_grids, name_equal_grids
from eval.report.site.site import draw_site
from eval.report.site.views import Views, write_views
from eval.report.site.worst import draw_worst, worst_rows
from eval.report.summary import HEADLINES, draw_summary
from eval.report.surface.surface import SURFACE_COLUMNS, draw_surface
from eval.report.tables import Cell, Table, results_table, to_csv, unchanged_table
from eval.running.results.cases import first_seed, named_variants, scenarios
from eval.running.results.run_data import (
    RunData,
    ends_at_merge,
    figures_of_plan,
    plan_name,
    read_run,
    shown_variant,
    without_told_merges,
)
from eval.running.results.sides import Side, check_extras, check_versions, is_contended
from eval.running.results.values import flag, select_rows, text
from eval.running.runfolder import read_json
from eval.running.scaling.remaking import remade_when_asked
from eval.tables.columns import RESULT_COLUMNS, TIME_MEANINGS, UNDEFINED
from eval.tables.merge_table import merge_table

POINT_COLOURS = (
    (BLUE, "right"), (BLACK, "missed"), (VERMILLION, "wrong"), (ORANGE, "part of another answered object"),
    (CONTEXT, "surroundings"),
)  # fmt: skip


def write_page(
    run: Path,
    views: Views = "chosen",
    *,
    is_slim: bool = True,
    keeps: bool = False,
    progress: RunProgress | None = None,
) -> Path:
    """Write `index.html` and the tables table1, table2 (.csv, .tex), results.tex and summary.tex into a run folder.

    Further files: regions_table.tex and objects_table.tex where the tables exist, pareto.csv and its pictures where
    methods can be compared by cost, and merge.csv where pairs have a kind. The page of a run that ends at the merge
    shows the merge alone.

    Args:
        run: The folder; results.csv must be there, anything else may be missing.
        views: Which pairs get a 3-D view, a file of its own below `views/` that the page links to; "none" for a page
            that is to stand without them.
        is_slim: Whether pictures are compressed: fewer pixels, edges a little blurred, a quarter of the bytes.
        keeps: Whether pictures and tables of the page that lies there are kept where the folder cannot make them.
        progress: Told of pairs that are made again for their pictures, unless `views` is "none".

    Returns:
        Path of the page.

    Raises:
        InputError: There are no results, they are of several metrics versions, a table lacks a column, or the folder
            holds a link or cannot be written.
    """
    require_no_links(run)
    whole = read_run(run)
    check_versions(Side(whole), Side(whole))
    data = figures_of_plan(whole)
    check_extras(Side(data))
    try:
        kept = read_kept(run / "index.html") if keeps else KeptPage()
        with remade_when_asked(data.folder, progress, is_wanted=views != "none") as folder:
            files = _draw(replace(data, folder=folder), views, kept, is_slim=is_slim)
    except KeyError as error:
        raise InputError(
            f"{run}: a table lacks column {error}: `tunnelcd score {run}` makes the tables anew"
        ) from error
    # two that write at once meet at the page
    write_files({run / name: files[name] for name in ("index.html", *files)})
    return run / "index.html"


def _draw(data: RunData, views: Views, kept: KeptPage, *, is_slim: bool) -> dict[str, str | bytes]:
    """Return every file of a page by its name."""
    targets = read_targets(data.provenance)
    every = pd.DataFrame(list(data.every_result))
    data, merging = without_told_merges(data)
    merges = merge_table(pd.DataFrame(list(merging.results)), targets)
    content = _about(data, merges) | {"merge": draw_merge(merging)}
    files: dict[str, str | bytes] = {**latex_tables(data)}
    if len(merges):
        files["merge.csv"] = csv_text(merge_table(every, targets))
    if not ends_at_merge(data):
        hardness = draw_hardness(data)
        if hardness is not None:
            files["breaking_points.tex"] = to_latex(hardness.table)
        points = pareto_table(data)
        if len(points):
            files["pareto.csv"] = csv_text(points)
        crossed = factorial_table(data)
        if len(crossed):
            files["factorial.csv"] = csv_text(crossed)
        drawn = {
            "hardness": () if hardness is None else hardness.plots,
            "pareto": draw_pareto(points, is_contended=is_contended(data)),
            "factorial": draw_factorial(crossed),
        }
        content |= _sections(data, drawn, views) | {"hardness": hardness}
        files["results.tex"] = to_latex(content["results"])
        for name in ("table1", "table2"):
            files |= {f"{name}.csv": to_csv(content[name]), f"{name}.tex": to_latex(content[name])}
    content["is_slim"] = is_slim
    content["missing"] = list(dict.fromkeys([*data.left_out, *content["missing"], *content["merge"].missing]))
    content = keep(content, kept)
    files["index.html"] = render_page("page.html", content | _define(data, content))
    files |= {f"{chart.name}.png": chart.png for chart in content["charts"] if chart.has_png}
    return files


def _define(data: RunData, content: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the methods and columns of a page are, and where that stands."""
    variants = list(dict.fromkeys(str(row["variant"]) for row in data.every_result))
    status = "ok, or the reason why there is no answer: the merge was refused, or the case failed."
    besides = "" if content["ends_at_merge"] else "A case that is not ok scores 0 in recall and in every object column."
    methods = describe_methods(variants)
    columns = describe_columns(content["columns"], [*content.get("time_meanings", ()), ("status", status, besides)])
    return {"methods": methods, "definitions": columns, "glossary": index_entries(methods, columns, variants)}


def _about(data: RunData, merges: pd.DataFrame) -> dict[str, Any]:
    """Return what every page shows: the run, its summary and its merges, and nothing of regions and objects."""
    return {
        "plan": plan_name(data),
        "split": str(plan.get("split", "")) if isinstance(plan := data.provenance.get("plan"), Mapping) else "",
        "machine": describe_machine(data.provenance),
        "command": str(data.provenance.get("command") or "unknown"),
        "finished": str(data.provenance.get("finished") or "unknown"),
        "failures": list_failures(data),
        "settings": tabulate_settings(data),
        "provenance": json.dumps(data.provenance, indent=1, ensure_ascii=False),
        "commits": describe_commits(data),
        "title": write_title(data),
        "answer": write_answer(data, merges),
        "summary": draw_summary(data, merges),
        "ends_at_merge": ends_at_merge(data),
        "hardness": None,
        "columns": MERGE_COLUMNS,
        "views": None,
        "charts": (),
        # the other tables are not missing where a run ends at the merge
        "missing": [line for line in data.missing if line.startswith("provenance.json")],
    }


def _sections(data: RunData, drawn: Mapping[str, Sequence[Chart]], views: Views) -> dict[str, Any]:
    """Return what a page shows of regions, objects and times; `missing` lists what could not be shown of them.

    Args:
        data: The run.
        drawn: Charts that are drawn already: of what is hard, of cost, of sources crossed with extractions.
        views: Which pairs get a 3-D view.
    """
    regions, objects, unchanged = draw_regions(data), draw_objects(data), unchanged_table(data)
    surface = draw_surface(data)
    worlds, variant = scenarios(data, unchanged=False), shown_variant(data)
    # a run about objects alone shows its best and worst in their own section, and no maps
    is_mapped = regions is not None or objects is None
    sites = [draw_site(data, scenario) for scenario in worlds] if is_mapped else []
    worst = worst_rows(data, variant)
    links = write_views(data, variant, [(str(row["scenario"]), int(row["seed"])) for row in worst], views)
    grids, factors, by_scenario = draw_grids(data), draw_factors(data), draw_scenarios(data)
    n_unchanged = len({(row["scenario"], row["seed"]) for row in data.results if flag(row, "is_unchanged_pair")})
    missing = [
        *data.missing,
        *(line for part in (*sites, links, regions, objects, surface) if part for line in part.missing),
    ]
    equal_grids = name_equal_grids(data)
    missing += equal_grids if worlds else ["No scenario with changes was run.", *equal_grids]
    if objects is None:
        missing += [] if n_unchanged else ["No unchanged pair was run, so false alarms are not measured."]
        missing += [] if grids or equal_grids or drawn["factorial"] else ["No grid of two settings was run."]
    of_regions = () if regions is None else regions.plots
    of_surface = () if surface is None else surface.plots
    charts = [
        *drawn["hardness"], *of_regions, *of_surface, *drawn["pareto"], *drawn["factorial"], *by_scenario, *grids,
        *factors,
    ]  # fmt: skip
    return {
        "regions": regions,
        "objects": objects,
        "surface": surface,
        "results": results_table(data),
        "unchanged": unchanged,
        "n_unchanged": n_unchanged,
        "effects": draw_effects(data),
        "enough_pairs": ENOUGH_PAIRS,
        "table1": time_table(data),
        "table2": volume_table(data),
        "factorial": drawn["factorial"],
        "grids": grids,
        "factors": factors,
        "by_scenario": by_scenario,
        "pareto": drawn["pareto"],
        "views": links,
        "worst": draw_worst(data, variant, worst) if is_mapped else [],
        "worst_variant": variant,
        "charts": charts,
        "sites": sites,
        "columns": (
            *(() if regions is None else REGION_COLUMNS), *(() if objects is None else OBJECT_COLUMNS),
            *(() if surface is None else SURFACE_COLUMNS),
            *RESULT_COLUMNS, *HEADLINES, *([PQ_COLUMN] if grids else []),
        ),
        "time_meanings": TIME_MEANINGS,
        "point_colours": POINT_COLOURS,
        "missing": missing,
    }  # fmt: skip


def list_failures(data: RunData) -> list[str]:
    """Return one line for every pair and reason without an answer, naming the variants it met."""
    found: dict[tuple[str, int, str], list[str]] = {}
    for row in data.every_result:
        status, error = text(row, "status"), text(row, "error")
        if status != "ok":
            reason = status.replace("_", " ") + (f": {error}" if error else "")
            found.setdefault((str(row["scenario"]), int(row["seed"]), reason), []).append(str(row["variant"]))
    return [
        f"{scenario}, seed {seed}, {', '.join(variants)}: {reason}"
        for (scenario, seed, reason), variants in found.items()
    ]


def describe_machine(provenance: Mapping[str, Any]) -> str:
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


def describe_commits(data: RunData) -> str:
    """Return which commits made how many of the answers, "" where all are of one; cells are kept when code changes."""
    counts = Counter(text(row, "commit") or "unknown" for row in data.every_result)
    if len(counts) < 2:
        return ""
    named = ", ".join(f"{commit} ({n} {'row' if n == 1 else 'rows'})" for commit, n in counts.items())
    return f"The answers were made by more than one commit: {named}. A + marks a tree that differed from its commit."


def tabulate_settings(data: RunData) -> Table:
    """Return the effective settings of every named variant, from its answers, sites that differ side by side."""
    found: dict[str, list[dict[str, str]]] = {}
    for scenario in [*scenarios(data, unchanged=False), *scenarios(data, unchanged=True)]:
        seed = first_seed(data, scenario)
        for name in named_variants(data, scenario):
            if select_rows(data.results, scenario=scenario, seed=seed, variant=name):
                document = read_json(data.folder.answer(scenario, seed, name) / "answer.json")
                config = document.get("config")
                found.setdefault(name, []).append(_flat(config) if isinstance(config, Mapping) else {})
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
