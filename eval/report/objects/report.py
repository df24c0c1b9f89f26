"""The objects on the page: how cleanly each rule cuts them out, the targets, and the best and worst of a method."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from eval.core.domains import domain_of
from eval.core.figures import picture_address
from eval.report.objects.cases import object_cases, voxel_variants
from eval.report.objects.charts import SizeLine, SizePanel, iou_by_size_chart
from eval.report.objects.tables import OBJECT_COLUMNS, OBJECT_COUNTS, WITHDRAWAL_COLUMNS, groups_table
from eval.report.tables import Picture, Table, methods_table, targets_table
from eval.running.run_data import RunData, off_grids, shown_variant, stored_table
from eval.running.runfolder import reported
from eval.tables.groups import main_changes
from eval.tables.rows import ALL_DOMAINS, numbers, with_domain

_CAPTION = "Objects: one row is one method on the pairs in or out of the training distribution"
_WITHDRAWAL_CAPTION = "Regions before and after those without an object are withdrawn: one row is one method"


@dataclass(frozen=True, slots=True)
class ObjectPart:
    """What the page shows of the objects of a run: tables, plots, single objects, and what is not there."""

    tables: tuple[Table, ...]
    plots: tuple[Picture, ...]
    cases: tuple[Picture, ...]
    missing: tuple[str, ...]


def draw_objects(data: RunData) -> ObjectPart | None:
    """Return tables, plot and pictures of the objects; None where the plan of the run does not ask for them."""
    if "objects" not in reported(data.provenance):
        return None
    table, groups = (off_grids(stored_table(data, name), data) for name in ("objects_table", "objects_by_group"))
    if len(table) == 0:
        return ObjectPart((), (), (), ("objects_table.csv is not in the run folder: `tunnelcd score` makes it.",))
    main, rows = shown_variant(data), with_domain(data.results)
    cases, missing = object_cases(data, main)
    domains = [str(name) for name in table["domain"].unique() if name != ALL_DOMAINS]
    tables = [
        methods_table(table, OBJECT_COLUMNS, rows, _CAPTION, counts=OBJECT_COUNTS),
        methods_table(table, WITHDRAWAL_COLUMNS, rows, _WITHDRAWAL_CAPTION),
        targets_table(stored_table(data, "objects_targets")),
        *(groups_table(groups, domain, main, voxel_variants(data, main)) for domain in domains),
    ]
    plot = _size_plot(groups, data, main)
    plots = () if plot is None else (plot,)
    return ObjectPart(tuple(each for each in tables if each.rows), plots, tuple(cases), tuple(missing))


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
