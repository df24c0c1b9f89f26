"""The objects on the page: how cleanly each rule cuts them out, the targets, and the best and worst of a method."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from eval.core.charts import Axis, Drawing, Look, Panel, Series
from eval.core.domains import domain_name
from eval.report.drawing.charts import Chart
from eval.report.drawing.looks import look_of
from eval.report.objects.cases import object_cases, voxel_variants
from eval.report.objects.tables import OBJECT_COLUMNS, OBJECT_COUNTS, WITHDRAWAL_COLUMNS, groups_table
from eval.report.tables import Section, conditions_table, methods_table, targets_table, with_rows
from eval.running.results.grids import off_grids
from eval.running.results.run_data import RunData, every_condition, shown_variant, stored_table
from eval.running.runfolder import reported
from eval.tables.columns import select
from eval.tables.groups import main_changes
from eval.tables.rows import ALL_DOMAINS, numbers, with_domain

_CAPTION = "Objects: one row is one method on the pairs in or out of the training distribution"
_WITHDRAWAL_CAPTION = "Regions before and after those without an object are withdrawn: one row is one method"
_CONDITIONS_CAPTION = "Objects by odometry and sensor: the first row of a method is what the other figures are of"
_COMPARED = select(
    OBJECT_COLUMNS, "object_iou_point", "iou_matched_median", "object_f1_50", "object_precision_50", "kind_accuracy",
    "object_iou_point_partial",
)  # fmt: skip
_DOTS = Look("#a8a8a8", 0.0, marker="circle", size=3.0)
_LEAST_M3, _MOST_M3 = 0.02, 60.0


def draw_objects(data: RunData) -> Section | None:
    """Return tables, plot and pictures of the objects; None where the plan of the run does not ask for them."""
    if "objects" not in reported(data.provenance):
        return None
    table, groups = (off_grids(stored_table(data, name), data) for name in ("objects_table", "objects_by_group"))
    if len(table) == 0:
        return Section(missing=("objects_table.csv is not in the run folder: `tunnelcd score` makes it.",))
    main, rows = shown_variant(data), with_domain(data.results)
    pictures, missing = object_cases(data, main)
    domains = [str(name) for name in table["domain"].unique() if name != ALL_DOMAINS]
    tables = [
        methods_table(table, OBJECT_COLUMNS, rows, _CAPTION, counts=OBJECT_COUNTS),
        methods_table(table, WITHDRAWAL_COLUMNS, rows, _WITHDRAWAL_CAPTION),
        conditions_table(off_grids(every_condition(data, "objects_table"), data), _COMPARED, _CONDITIONS_CAPTION),
        targets_table(stored_table(data, "objects_targets")),
        *(groups_table(groups, domain, main, voxel_variants(data, main)) for domain in domains),
    ]
    plots = (_size_plot(groups, data, main),) if len(groups) and data.changes else ()
    return Section(with_rows(tables), plots, pictures=tuple(pictures), missing=tuple(missing))


def _size_plot(groups: pd.DataFrame, data: RunData, main: str) -> Chart:
    """Draw the IoU of every object of the main variant and the means of all variants over the volume of the hull."""
    names = [main, *(str(name) for name in groups["variant"].unique() if name != main)]
    domains = with_domain(data.results).drop_duplicates("scenario").set_index("scenario")["domain"]
    changes = pd.DataFrame(list(data.changes))
    objects = main_changes(changes[changes["variant"] == main])
    objects = objects.assign(domain=objects["scenario"].map(domains))
    sizes = groups[groups["measure"] == "hull_volume_m3"]
    panels: list[Panel] = []
    for domain in [str(each) for each in groups["domain"].unique() if each != ALL_DOMAINS]:
        own = objects[objects["domain"] == domain]
        lines = _size_lines(sizes[sizes["domain"] == domain], names)
        dots = Series(np.clip(numbers(own, "hull_volume_m3"), _LEAST_M3, _MOST_M3), numbers(own, "iou_point"), _DOTS)
        x = Axis("hull of the object [m³]", (0.8 * _LEAST_M3, 1.25 * _MOST_M3), is_log=True)
        y = Axis("" if panels else "point IoU", (-0.03, 1.03))
        panels.append(Panel(x, y, [dots, *lines], f"{domain_name(domain)}, {len(own)} objects"))
    return Chart(
        "object_sizes",
        "Point IoU by the size of the object",
        Drawing([panels], 325),
        f"A dot for every observable object, answered by {main}, missed ones at 0; lines: means of each method in bins "
        f"of the hull's volume; bars: 95 % interval of {main}, drawn over tunnels.",
    )


def _size_lines(sizes: pd.DataFrame, names: Sequence[str]) -> list[Series]:
    """Return the line of each method through the middles of its bins; the intervals are those of the first method."""
    lines = []
    for name in names:
        own = sizes[sizes["variant"] == name]
        middles_m3 = np.sqrt(own["low"].clip(0.03, 10.0) * own["high"].clip(0.1, 30.0))
        low, high = (own["iou_point_low"], own["iou_point_high"]) if name == names[0] else (None, None)
        lines.append(Series(middles_m3, own["iou_point"], look_of(name), name, low=low, high=high, hover="IoU {y:.2f}"))
    return [line for line in lines if np.size(line.y)]
