"""Tables I and II of the paper, its values beside ours."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from eval.report.tables import Cell, Table
from eval.running.run_data import (
    SHOWN_PRESETS,
    Row,
    RunData,
    defined,
    named_variants,
    of,
    over_pairs,
    scenarios,
    text,
)
from eval.tables.columns import EN_DASH, UNDEFINED, count, significant


@dataclass(frozen=True, slots=True)
class Published:
    """What the paper gives for one site: texts as printed, and (least, greatest) over its regions."""

    t_merge: str
    t_cd: str
    t_oe: str
    map_points: tuple[int, int]
    v_sphere: tuple[int, int]
    v_oe: str
    s_points: tuple[int, int]
    oe_points: tuple[int, int]


# Stathoulopoulos, Koval, Nikolakopoulos, IROS 2023, Tables I and II
PUBLISHED = {
    "paper/site1": Published(
        t_merge="0.051",
        t_cd="0.016-0.019",
        t_oe="0.0004-0.0005",
        map_points=(53_117, 63_942),
        v_sphere=(206, 223),
        v_oe="0.30-0.51",
        s_points=(648, 2_470),
        oe_points=(25, 71),
    ),
    "paper/site2": Published(
        t_merge="0.184",
        t_cd="0.109-0.115",
        t_oe="0.0057-0.0110",
        map_points=(1_263_631, 1_439_038),
        v_sphere=(1_423, 1_589),
        v_oe="12-38",
        s_points=(11_391, 16_186),
        oe_points=(470, 673),
    ),
}
_TIME_HEADINGS = (
    "method", "t_index [s]", "t_merge [s]", "t_refine [s]", "t_descriptor [s]", "t_cd / region [s]",
    "t_oe / region [s]", "t_total [s]", "with merge [s]", "as the paper [s]",
)  # fmt: skip
_TIMES = (
    "t_index_s", "t_merge_s", "t_refine_s", "t_descriptor_s", "t_cd_per_region_s", "t_oe_per_region_s",
    "t_total_s", "t_total_with_merge_s", "t_total_paper_s",
)  # fmt: skip
_VOLUME_HEADINGS = (
    "method", "map points before", "map points after", "V_sphere [m³]", "V_OE [m³]", "points in sphere",
    "points on object",
)  # fmt: skip


def time_table(data: RunData) -> Table:
    """Return Table I: medians over the pairs."""

    def published(site: Published) -> tuple[str, ...]:
        of_regions = site.t_cd, site.t_oe
        return (UNDEFINED, site.t_merge, UNDEFINED, UNDEFINED, *of_regions, UNDEFINED, UNDEFINED, UNDEFINED)

    def ours(scenario: str, variant: str) -> tuple[str, ...]:
        group = of(data.results, scenario=scenario, variant=variant)
        return tuple(significant(over_pairs(group, column)) for column in _TIMES)

    return _beside_the_paper(data, _TIME_HEADINGS, published, ours, "Table I: time")


def volume_table(data: RunData) -> Table:
    """Return Table II: least and greatest over regions that find a change; the paper's rows are changed areas.

    Volumes and points of spheres and objects are those of the after map, so removed objects count in neither.
    """

    def published(site: Published) -> tuple[str, ...]:
        sizes = (count(n) for n in site.map_points)
        return (*sizes, _span(site.v_sphere), site.v_oe, _span(site.s_points), _span(site.oe_points))

    def ours(scenario: str, variant: str) -> tuple[str, ...]:
        group = of(data.results, scenario=scenario, variant=variant)
        candidates = of(data.regions, scenario=scenario, variant=variant)
        regions = [row for row in candidates if text(row, "outcome") in ("true", "duplicate")]
        sizes = (_whole(over_pairs(group, f"map_points_{name}")) for name in ("before", "after"))
        volumes = (_range(regions, column, significant) for column in ("v_sphere_m3", "v_oe_m3"))
        points = (_range(regions, column, _whole) for column in ("s_points", "oe_points"))
        return (*sizes, *volumes, *points)

    return _beside_the_paper(
        data, _VOLUME_HEADINGS, published, ours, "Table II: volumes and points; spheres and objects of the after map"
    )


def _beside_the_paper(
    data: RunData,
    headings: tuple[str, ...],
    published: Callable[[Published], tuple[str, ...]],
    ours: Callable[[str, str], tuple[str, ...]],
    caption: str,
) -> Table:
    rows: list[tuple[str, tuple[Cell, ...]]] = []
    for scenario in scenarios(data, unchanged=False):
        if scenario in PUBLISHED:
            values = (value.replace("-", EN_DASH) for value in published(PUBLISHED[scenario]))
            rows.append((scenario, (Cell("published"), *map(Cell, values))))
        rows += [
            (scenario, (Cell(f"ours, {name}"), *map(Cell, ours(scenario, name))))
            for name in named_variants(data, scenario)
            if name in SHOWN_PRESETS
        ]
    return Table(headings, tuple(rows), caption)


def _whole(value: float) -> str:
    return count(value if math.isnan(value) else float(round(value)))


def _span(ends: tuple[int, int]) -> str:
    return f"{count(ends[0])}-{count(ends[1])}"


def _range(regions: Sequence[Row], column: str, shown: Callable[[float], str]) -> str:
    values = defined(regions, column)
    if len(values) == 0:
        return UNDEFINED
    low, high = shown(float(values.min())), shown(float(values.max()))
    return low if low == high else f"{low}{EN_DASH}{high}"
