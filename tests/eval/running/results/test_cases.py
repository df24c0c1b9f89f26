"""Which variants the tables of a page show where a run holds nothing but the points of grids."""

from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from eval.plans.targets import read_targets
from eval.report.framing.headline import write_answer
from eval.report.tables import results_table, unchanged_table
from eval.running.results.cases import comparable, named_variants
from eval.running.results.run_data import RunData
from eval.running.runfolder import RunFolder
from eval.tables.merge_table import merge_table

POINTS = {f"{preset}[a.x={x},b.y={y}]": x + y for preset in "pq" for x in (1, 2) for y in (3, 4)}


def run(folder: Path, cases: Iterable[tuple[str, str, float]]) -> RunData:
    rows = tuple(
        {"scenario": world, "family": "narrow", "variant": name, "seed": 1, "status": "ok", "n_observable": 1,
         "is_unchanged_pair": world == "still", "object_pq": value / 10, "region_recall": 1 - value / 10}
        for world, name, value in cases
    )  # fmt: skip
    return RunData(RunFolder(folder), rows, (), (), {}, ())


def test_a_run_of_grid_points_alone_shows_the_best_of_each_preset(tmp_path: Path) -> None:
    data = run(tmp_path, [(world, name, value) for world in ("one", "still") for name, value in POINTS.items()])
    best = ["p[a.x=2,b.y=4]", "q[a.x=2,b.y=4]"]
    assert named_variants(data, "one") == named_variants(data, "still") == best
    assert len(results_table(data).rows) == len(unchanged_table(data).rows) == 2
    for table in (results_table(data), unchanged_table(data)):
        assert "of the points of a grid that of highest object PQ" in table.caption
    # the summary is of all points
    assert len(comparable(data)) == 16
    told = write_answer(data, merge_table(pd.DataFrame(list(data.results)), read_targets({})))
    assert told.startswith("Highest region recall, in distribution: p[a.x=1, …] and q[a.x=1, …] (0.60)")


def test_beside_other_methods_the_points_of_a_grid_stand_in_its_heat_maps_alone(tmp_path: Path) -> None:
    points = [(world, name, value) for world in ("one", "two") for name, value in POINTS.items()]
    data = run(tmp_path, [("one", "c2c", 0.0), *points])
    assert named_variants(data, "one") == ["c2c"]
    assert set(comparable(data)["variant"]) == {"c2c"}
    # nothing else was run here
    assert named_variants(data, "two") == ["p[a.x=2,b.y=4]", "q[a.x=2,b.y=4]"]
    plain = run(tmp_path, [("one", "c2c", 0.0)])
    assert results_table(plain).caption == "Every preset on every scenario"
