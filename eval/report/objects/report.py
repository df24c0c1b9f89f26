"""The objects on the page: how cleanly each rule cuts them out, the targets, and the best and worst of `tunnelcd`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd

from eval.core.domains import domain_name, domain_of
from eval.core.figures import picture_address
from eval.core.tablefile import table_file
from eval.report.cost.pareto import with_domain
from eval.report.merge.merge import covered_by
from eval.report.objects.cases import object_cases, voxel_variants
from eval.report.objects.charts import SizeLine, SizePanel, iou_by_size_chart
from eval.report.objects.objects import Picture
from eval.report.objects.tables import groups_table, methods_table, records, withdrawal_table
from eval.report.regions.regions import targets_table
from eval.report.story import about_failures, joined
from eval.report.tables import Table
from eval.running.run_data import RunData, off_grids
from eval.running.runfolder import reported
from eval.tables.columns import share, spaced
from eval.tables.merge_table import numbers
from eval.tables.object_groups import main_changes
from eval.tables.object_table import FILES
from eval.tables.region_table import ALL_DOMAINS, MAIN_VARIANT


@dataclass(frozen=True, slots=True)
class ObjectPart:
    """What the page shows of the objects of a run; `judged` are those of its sentences that are about the targets."""

    sentences: tuple[str, ...]
    judged: tuple[str, ...]
    tables: tuple[Table, ...]
    plots: tuple[Picture, ...]
    cases: tuple[Picture, ...]
    missing: tuple[str, ...]


def draw_objects(data: RunData) -> ObjectPart | None:
    """Return tables, plot and pictures of the objects; None where the plan of the run does not ask for them."""
    if "objects" not in reported(data.provenance):
        return None
    table, groups, targets = (_read(data, name) for name in FILES)
    if len(table) == 0:
        line = "objects_table.csv is not in the run folder: `tunnelcd score` makes it."
        return ObjectPart((line,), (line,), (), (), (), (line,))
    if len(targets) == 0:
        targets = pd.DataFrame(columns=["target", "domain", "variant", "is_met"])
    table, groups = (each if len(each) == 0 else off_grids(each, data) for each in (table, groups))
    main = _main_variant(table)
    rivals = voxel_variants(data, main)
    cases, missing = object_cases(data, main)
    rows = with_domain(data.results)
    tables = [methods_table(table, rows), withdrawal_table(table, rows), targets_table(targets)]
    tables += [groups_table(groups, domain, main, rivals) for domain in _domains(table)]
    plot = _size_plot(groups, data, main)
    return ObjectPart(
        tuple(story(table, targets, data, main)),
        tuple(about_targets(targets, data)),
        tuple(each for each in tables if each.rows),
        () if plot is None else (plot,),
        tuple(cases),
        tuple(missing),
    )


def about_targets(targets: pd.DataFrame, data: RunData) -> list[str]:
    """Say how much of the plan was run, if not all, and how many targets are met."""
    covered = covered_by(data)
    sentences = [covered.sentence] if covered is not None and not covered.is_whole else []
    judged = targets[targets["is_met"].notna()]
    missed = [str(row["target"]) for row in records(judged) if not row["is_met"]]
    if len(judged):
        words = f"{len(judged) - len(missed)} of the {len(judged)} targets that this run can judge are met"
        sentences.append(f"{words}; missed: {joined(missed)}." if missed else f"{words}.")
    return sentences


def story(table: pd.DataFrame, targets: pd.DataFrame, data: RunData, main: str) -> list[str]:
    """Return the first sentences of the page: verdict, then what each rule reaches."""
    sentences = about_targets(targets, data)
    for domain in _domains(table):
        own = [row for row in records(table[table["domain"] == domain]) if not math.isnan(row["object_iou_point"])]
        told = [f"{spaced(str(row['variant']))} {share(row['object_iou_point'])}" for row in own]
        if told:
            sentences.append(
                f"{domain_name(domain).capitalize()}, point IoU with missed objects as 0: {', '.join(told)}."
            )
        of_main = [row for row in own if row["variant"] == main]
        if of_main and not math.isnan(of_main[0]["iou_matched_median"]):
            row = of_main[0]
            sentences.append(
                f"{domain_name(domain).capitalize()}, {main} matched {row['n_matched']} of {row['n_changes']} objects, "
                f"with a median IoU of {share(row['iou_matched_median'])}."
            )
    sentences += about_failures(data)
    n_pairs = int(table.drop_duplicates("variant", keep="last")["n_pairs"].max())
    sentences.append(f"n = {n_pairs} session pairs; intervals are 95 % over session pairs.")
    return sentences


def _size_plot(groups: pd.DataFrame, data: RunData, main: str) -> Picture | None:
    """Draw the IoU of every object of the main variant and the means of all variants over the volume of the hull."""
    if len(groups) == 0:
        return None
    names = [main, *(str(name) for name in groups["variant"].unique() if name != main)]
    changes = pd.DataFrame(list(data.changes))
    own = main_changes(changes[changes["variant"] == main])
    families = {str(row["scenario"]): str(row.get("family", row["scenario"])) for row in data.results}
    domain = np.array([domain_of(families.get(str(name), str(name))) for name in own["scenario"]], dtype=object)
    panels = {}
    for name in [each for each in dict.fromkeys(groups["domain"]) if each != ALL_DOMAINS]:
        sizes = groups[(groups["domain"] == name) & (groups["measure"] == "hull_volume_m3")]
        lines = {each: _line(sizes[sizes["variant"] == each]) for each in names if (sizes["variant"] == each).any()}
        inside = own[domain == name]
        panels[str(name)] = SizePanel(numbers(inside, "hull_volume_m3"), numbers(inside, "iou_point"), lines)
    return Picture(
        "Point IoU by the size of the object",
        picture_address(iou_by_size_chart(panels, names)),
        f"A dot for every observable object, answered by {main}, missed ones at 0; lines: means of each method in bins "
        f"of the hull's volume; bars: 95 % interval over pairs of {main}.",
    )


def _line(sizes: pd.DataFrame) -> SizeLine:
    low, high = (np.clip(numbers(sizes, name), *ends) for name, ends in (("low", (0.03, 10.0)), ("high", (0.1, 30.0))))
    interval = (numbers(sizes, f"iou_point_{end}") for end in ("low", "high"))
    return SizeLine(np.sqrt(low * high), numbers(sizes, "iou_point"), *interval)


def _read(data: RunData, name: str) -> pd.DataFrame:
    """Return a table of the run folder, empty where there is none."""
    path = table_file(data.folder.path / f"{name}.csv")
    return pd.read_csv(path, keep_default_na=True) if path.is_file() else pd.DataFrame()


def _main_variant(table: pd.DataFrame) -> str:
    return MAIN_VARIANT if (table["variant"] == MAIN_VARIANT).any() else str(table["variant"].iloc[0])


def _domains(table: pd.DataFrame) -> list[str]:
    return [str(name) for name in table["domain"].unique() if name != ALL_DOMAINS]
