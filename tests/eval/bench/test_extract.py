from __future__ import annotations

import json

import numpy as np
import pytest

from cdpipe.extract.surface_rule import cut_by_surface
from cdpipe.model.report import ChangeRegions
from eval.bench.bench import list_contests, measure
from eval.bench.extract import ExtractSite, extract_contests, extract_sites

NAMES = ["extract-voxel-{}", "extract-voxel-{}-both"] + [
    f"extract-surface-{{}}{step}" for step in ("", "-crop", "-index", "-realign", "-returns", "-site", "-all-in")
]


@pytest.fixture(scope="module")
def site() -> ExtractSite:
    """The smallest world there is, in which a box was added."""
    return ExtractSite(1500, "smoke/one_box", 0.5, 1.5, "a guess", repeats=2)


def test_rows_of_both_sizes_stand_in_the_table() -> None:
    names = [name for name in list_contests() if name.startswith("extract-")]
    assert names == [name.format(size) for size in (2500, 15000) for name in NAMES]
    limits = [(each.voxel_s, each.surface_s, each.paper, each.all_in_s) for each in extract_sites()]
    assert limits == [(0.0005, 0.0015, "0.5 ms", None), (0.0025, 0.006, "5.7 to 11 ms", 0.025)]


def test_real_rows_of_a_small_world(site: ExtractSite) -> None:
    rows = {row["name"]: row for row in measure(dict(extract_contests(site)))["rows"]}
    assert list(rows) == [name.format(1500) for name in NAMES]
    assert all(0 < row["value"] < 5 and (row["unit"], row["n"]) == ("s", 2) for row in rows.values())
    limits = {name: row["rival_value"] for name, row in rows.items() if row["target"] is not None}
    assert limits == {
        "extract-voxel-1500": 0.5,
        "extract-surface-1500": 1.5,
        "extract-surface-1500-realign": 0.05,
    }
    assert rows["extract-voxel-1500"]["rival"] == "its limit, 500 ms (the paper: a guess)"
    json.dumps(rows)


def test_what_is_timed_is_what_the_rule_does(site: ExtractSite) -> None:
    region, config = site.region, site.config.extract
    # points move by interpolation, so one on the border may fall out
    assert abs(np.count_nonzero(region.spheres["after"].is_inside) - 1500) <= 1
    regions = ChangeRegions(
        region.centre_map[None],
        region.radius_m,
        np.zeros(1),
        np.zeros((1, 2), np.int64),
        np.ones(1, np.bool_),
        np.zeros(0),
    )
    groups = cut_by_surface(site.merged, regions, config)
    own, _ = region.returns
    places = region.merged.after.positions_of(own)
    timed = region.look_closely(config)
    assert len(timed) == 1
    (added,) = [group for group in groups if group.session == "after"]
    assert added.returns is not None
    # the box that the scenario adds is among the returns looked at, and every cell found holds some of it
    assert set(added.returns.tolist()) <= set(own.tolist())
    assert 0 < len(timed[0]) < len(added.returns) < len(places)
