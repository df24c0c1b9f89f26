"""Tables I and II of the paper, its values beside ours."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from eval.report.tables import Cell, Table
from eval.running.results.cases import named_variants, pictured_variants, scenarios
from eval.running.results.run_data import RunData
from eval.running.results.values import Row, defined, over_pairs, select_rows, text
from eval.tables.columns import EN_DASH, THIN_SPACE, UNDEFINED, count, significant

# Stathoulopoulos, Koval, Nikolakopoulos, IROS 2023, as printed; "-" alone: the paper gives no value
_PUBLISHED_TIMES = {
    "paper/site1": ("-", "0.051", "-", "-", "0.016-0.019", "0.0004-0.0005", "-", "-", "-"),
    "paper/site2": ("-", "0.184", "-", "-", "0.109-0.115", "0.0057-0.0110", "-", "-", "-"),
}
_PUBLISHED_VOLUMES = {
    "paper/site1": ("53 117", "63 942", "206-223", "0.30-0.51", "648-2 470", "25-71"),
    "paper/site2": ("1 263 631", "1 439 038", "1 423-1 589", "12-38", "11 391-16 186", "470-673"),
}
_TIMES = {
    "t_index [s]": "t_index_s", "t_merge [s]": "t_merge_s", "t_refine [s]": "t_refine_s",
    "t_descriptor [s]": "t_descriptor_s", "t_cd / region [s]": "t_cd_per_region_s",
    "t_oe / region [s]": "t_oe_per_region_s", "t_total [s]": "t_total_s", "with merge [s]": "t_total_with_merge_s",
    "as the paper [s]": "t_total_paper_s",
}  # fmt: skip
_VOLUME_HEADINGS = (
    "map points before", "map points after", "V_sphere [m³]", "V_OE [m³]", "points in sphere", "points on object",
)  # fmt: skip


def time_table(data: RunData) -> Table:
    """Return Table I: medians over the pairs."""

    def ours(scenario: str, variant: str) -> list[str]:
        group = select_rows(data.results, scenario=scenario, variant=variant)
        return [significant(over_pairs(group, column)) for column in _TIMES.values()]

    return _beside_the_paper(data, tuple(_TIMES), _PUBLISHED_TIMES, ours, "Table I: time")


def volume_table(data: RunData) -> Table:
    """Return Table II: least and greatest over regions that find a change; the paper's rows are changed areas.

    Volumes and points of spheres and objects are those of the after map, so removed objects count in neither.
    """

    def ours(scenario: str, variant: str) -> list[str]:
        group = select_rows(data.results, scenario=scenario, variant=variant)
        candidates = select_rows(data.regions, scenario=scenario, variant=variant)
        regions = [row for row in candidates if text(row, "outcome") in ("true", "duplicate")]
        sizes = (_whole(over_pairs(group, f"map_points_{name}")) for name in ("before", "after"))
        volumes = (_range(regions, column, significant) for column in ("v_sphere_m3", "v_oe_m3"))
        points = (_range(regions, column, _whole) for column in ("s_points", "oe_points"))
        return [*sizes, *volumes, *points]

    caption = "Table II: volumes and points; spheres and objects of the after map"
    return _beside_the_paper(data, _VOLUME_HEADINGS, _PUBLISHED_VOLUMES, ours, caption)


def _beside_the_paper(
    data: RunData,
    headings: tuple[str, ...],
    published: Mapping[str, tuple[str, ...]],
    ours: Callable[[str, str], list[str]],
    caption: str,
) -> Table:
    rows: list[tuple[str, tuple[Cell, ...]]] = []
    for scenario in scenarios(data, unchanged=False):
        if scenario in published:
            values = (value.replace("-", EN_DASH).replace(" ", THIN_SPACE) for value in published[scenario])
            rows.append((scenario, (Cell("published"), *map(Cell, values))))
        pictured = pictured_variants(data, scenario)
        rows += [
            (scenario, (Cell(f"ours, {name}"), *map(Cell, ours(scenario, name))))
            for name in named_variants(data, scenario)
            if name in pictured
        ]
    return Table(("method", *headings), tuple(rows), caption)


def _whole(value: float) -> str:
    return count(value if math.isnan(value) else float(round(value)))


def _range(regions: Sequence[Row], column: str, shown: Callable[[float], str]) -> str:
    values = defined(regions, column)
    if len(values) == 0:
        return UNDEFINED
    low, high = shown(float(values.min())), shown(float(values.max()))
    return low if low == high else f"{low}{EN_DASH}{high}"
