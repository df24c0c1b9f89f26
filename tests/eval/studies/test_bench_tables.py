"""Several runs of the speed table become one row each; a table of growth is told apart by its columns."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cdpipe.core.errors import InputError
from eval.studies.bench_tables import main, unite_runs

ROW = {
    "name": "casting", "value": 8.0, "unit": "Mray/s", "rival": "mj_multiRay", "rival_value": 1.0, "ratio": 8.0,
    "target": 5.0, "met": True, "n": 7, "spread": 0.1, "reason": "",
}  # fmt: skip
GROWTH = {
    "axis": "length", "grows": "path", "stage": "mapping", "unit": "s", "n": 5, "smallest": 62.5, "largest": 1000.0,
    "first": 0.8, "value": 11.2, "exponent": 0.92, "low": 0.74, "high": 1.1, "last": 1.14, "verdict": "rising",
}  # fmt: skip
MACHINE = {"cpu": "a processor", "cores": 2, "threads": {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "unset"}}


def test_runs_are_united_by_their_medians() -> None:
    slow, failed = ROW | {"value": 4.0, "ratio": 4.0, "met": False}, ROW | {
        "value": None, "ratio": None, "met": False, "reason": "refused",
    }  # fmt: skip
    united = unite_runs([[ROW], [slow], [failed]])
    assert united.loc[0].to_dict() == {
        "row": "casting", "figure": "6 (4 to 8) Mray/s", "rival": "mj_multiRay; refused", "rival's": "1 (1 to 1)",
        "ratio": "6 (4 to 8)", "target": "5", "met": "1 of 3",
    }  # fmt: skip


def test_a_row_without_target_is_not_judged() -> None:
    united = unite_runs([[ROW | {"target": None, "met": None, "rival": None, "rival_value": None, "ratio": None}]])
    assert united.loc[0, ["rival", "rival's", "ratio", "target", "met"]].tolist() == ["-"] * 5


def test_the_program_writes_both_kinds_of_table(tmp_path: Path) -> None:
    files = [tmp_path / "bench.json", tmp_path / "growth.json"]
    for path, row in zip(files, (ROW, GROWTH), strict=True):
        path.write_text(json.dumps({"machine": MACHINE, "rows": [row]}))
    main(files, tmp_path / "tables.md")
    page = (tmp_path / "tables.md").read_text()
    assert "a processor, 2 cores, OMP_NUM_THREADS=1." in page
    assert "| casting | 8 Mray/s | mj_multiRay | 1 | 8 | 5 | 1 of 1 |" in page
    assert "| length | mapping | 62.5 to 1000 | 0.8 to 11.2 s | 0.92 (0.74 to 1.10) | rising |" in page


def test_an_exponent_of_two_sizes_has_no_interval(tmp_path: Path) -> None:
    path = tmp_path / "growth.json"
    path.write_text(json.dumps({"machine": MACHINE, "rows": [GROWTH | {"low": None, "high": None}]}))
    main([path], tmp_path / "tables.md")
    assert "| 0.92 | rising |" in (tmp_path / "tables.md").read_text()


def test_another_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "profile.json"
    path.write_text(json.dumps({"machine": MACHINE, "rows": [{"stage": "mapping"}]}))
    with pytest.raises(InputError, match=r"profile.json: no table of `tunnelcd bench`"):
        main([path], tmp_path / "tables.md")
    assert not (tmp_path / "tables.md").exists()


@pytest.mark.parametrize(
    ("key", "value"),
    [("machine", {}), ("machine", [1]), ("rows", [ROW, {}]), ("rows", [ROW, ROW | {"name": []}]),
     ("rows", [ROW | {"value": "much"}]), ("rows", [GROWTH, 3]), ("rows", [GROWTH | {"low": "little"}])],
)  # fmt: skip
def test_a_damaged_table_is_one_line(key: str, value: object, tmp_path: Path) -> None:
    path = tmp_path / "bench.json"
    path.write_text(json.dumps({"machine": MACHINE, "rows": [ROW]} | {key: value}))
    with pytest.raises(InputError, match=r"^\S*bench.json: damaged tables [^\n]*: name files of --out$"):
        main([path], tmp_path / "tables.md")
