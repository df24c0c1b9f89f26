"""A run folder whose large tables are compressed reads like the folder that the run wrote."""

import json
import math
from pathlib import Path

import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from eval.report.page import write_page
from eval.running.results.run_data import read_run, without_told_merges
from eval.scoring.scoring import METRICS_VERSION

IDENTITY = {"scenario": "regions/narrow", "variant": "tunnelcd"}
TABLES = {
    "results": [
        {**IDENTITY, "family": "regions/narrow", "seed": seed, "status": "ok", "metrics_version": METRICS_VERSION,
         "n_changes": 1, "n_observable": 1, "score_radius_m": 4.5, "after_path_m": 100.0, "region_recall": seed / 2,
         "is_unchanged_pair": False}
        for seed in (1, 2)
    ],
    "changes": [{**IDENTITY, "seed": 1, "id": 1, "is_observable": True, "n_truth_cells": 20}],
    "regions": [{**IDENTITY, "seed": 1, "region": 0, "score": 0.7, "outcome": "true", "found_changes": "1",
                 "found_changes_proposed": "1;2"}],
}  # fmt: skip


def written(folder: Path, ending: str) -> Path:
    """Write the tables into a new folder; the ending decides whether they are compressed."""
    folder.mkdir(parents=True)
    for name, rows in TABLES.items():
        pd.DataFrame(rows).to_csv(folder / f"{name}{ending}", index=False)
    return folder


def test_compressed_tables_give_the_same_rows_and_the_same_page(tmp_path: Path) -> None:
    plain, compressed = (written(tmp_path / ending / "run", ending) for ending in (".csv", ".csv.xz"))
    first, second = read_run(plain), read_run(compressed)
    for table in ("results", "changes", "regions"):
        pd.testing.assert_frame_equal(pd.DataFrame(getattr(first, table)), pd.DataFrame(getattr(second, table)))
    assert first.missing == second.missing
    pages = [write_page(run).read_text().replace(str(run), "run") for run in (plain, compressed)]
    assert pages[0] == pages[1]


def test_merge_errors_of_a_method_that_was_told_its_merge_are_left_out(tmp_path: Path) -> None:
    run = written(tmp_path / "run", ".csv")
    rows = [{**row, "variant": name, "merge_error_m": 0.0} for name in ("mine", "a") for row in TABLES["results"]]
    pd.DataFrame(rows).to_csv(run / "results.csv", index=False)
    folder = run / "evaluations" / "mine"
    folder.mkdir(parents=True)
    for merge, n_told in (("own", 0), ("ours", 2)):
        (folder / "evaluation.json").write_text(json.dumps({"name": "mine", "merge": merge}))
        shown, merging = without_told_merges(read_run(run))
        assert [math.isnan(row["merge_error_m"]) for row in shown.results] == [n_told > 0] * 2 + [False] * 2
        assert len(merging.results) == 4 - n_told
        assert sum("mine was told the merge by tunnelcd" in note for note in shown.left_out) == (n_told > 0)
    pd.DataFrame(rows[:2]).to_csv(run / "results.csv", index=False)  # alone it is compared with nothing
    shown, merging = without_told_merges(read_run(run))
    assert [row["merge_error_m"] for row in shown.results] == [0.0, 0.0] and len(merging.results) == 2


def test_what_a_run_wrote_comes_before_a_compressed_copy(tmp_path: Path) -> None:
    run = written(tmp_path / "run", ".csv.xz")
    pd.DataFrame([{**TABLES["results"][0], "region_recall": 0.25}]).to_csv(run / "results.csv", index=False)
    assert [row["region_recall"] for row in read_run(run).results] == [0.25]


@pytest.mark.parametrize(("table", "column"), [("results", "is_unchanged_pair"), ("changes", "is_observable")])
def test_a_number_in_the_place_of_a_truth_value_is_named(tmp_path: Path, table: str, column: str) -> None:
    run = written(tmp_path / "run", ".csv")
    for right in (1, 0.0, "", True):
        pd.DataFrame([{**row, column: right} for row in TABLES[table]]).to_csv(run / f"{table}.csv", index=False)
        read_run(run)
    pd.DataFrame([*TABLES[table], {**TABLES[table][0], "seed": 3, column: -0.1}]).assign(
        **{column: lambda frame: frame[column].astype(float)}
    ).to_csv(run / f"{table}.csv", index=False)
    line = len(TABLES[table]) + 2
    with pytest.raises(InputError, match=rf"{table}\.csv:{line}: {column} = -0\.1: expected True or False"):
        read_run(run)


def test_a_column_may_have_any_name(tmp_path: Path) -> None:
    run = written(tmp_path / "run", ".csv")
    pd.DataFrame([{**row, "self": 1e300, "frame": 0.5} for row in TABLES["results"]]).to_csv(
        run / "results.csv", index=False
    )
    data = read_run(run)
    assert [(math.isnan(row["self"]), row["frame"]) for row in data.results] == [(True, 0.5)] * 2
    assert any("self (2)" in told for told in data.left_out)


@pytest.mark.parametrize("content", [b"no such format", b""])
def test_a_damaged_copy_is_named(tmp_path: Path, content: bytes) -> None:
    run = written(tmp_path / "run", ".csv.xz")
    (run / "results.csv.xz").write_bytes(content)
    with pytest.raises(InputError, match=r"results\.csv\.xz"):
        read_run(run)


def test_a_copy_that_was_cut_short_is_named(tmp_path: Path) -> None:
    run = written(tmp_path / "run", ".csv.xz")
    content = (run / "results.csv.xz").read_bytes()
    (run / "results.csv.xz").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=r"results\.csv\.xz"):
        read_run(run)
