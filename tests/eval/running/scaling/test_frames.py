"""Tables of rows that arrive one by one are those of all rows at once, to the byte."""

import random
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cdpipe.core.errors import InputError
from eval.running.cell_rows import collect_tables
from eval.running.runfolder import RunFolder, read_json, write_json
from eval.running.scaling.frames import RowTable, sort_cells

_VALUES = {
    "text": st.sampled_from(["a", "b, c", "", None]),
    "whole": st.integers(-5, 5),
    "number": st.one_of(st.floats(allow_nan=True, allow_infinity=False), st.just(None)),
    "flag": st.one_of(st.booleans(), st.just(None)),
    "nothing": st.just(None),
    "sparse": st.one_of(st.just(None), st.integers(0, 3)),
}


@settings(max_examples=150, deadline=None)
@given(st.lists(st.fixed_dictionaries({}, optional=_VALUES), max_size=9), st.integers(1, 12))
def test_chunks_are_the_table_of_all_rows(rows: list[dict[str, Any]], chunk_values: int) -> None:
    table = RowTable(chunk_values)
    for row in rows:
        table.add([row])
    found, expected = table.frame(), pd.DataFrame(rows)
    assert found.to_csv() == expected.to_csv()
    assert list(found.columns) == list(expected.columns)
    used = [name for name in expected if expected[name].notna().any()]
    assert found[used].dtypes.to_dict() == expected[used].dtypes.to_dict()


def test_tables_in_chunks_are_the_same_bytes(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = collect_tables(RunFolder(whole))
    monkeypatch.setattr(RowTable.__init__, "__defaults__", (20,))
    other = collect_tables(RunFolder(whole))
    assert {name: table.to_csv() for name, table in one.items()} == {
        name: table.to_csv() for name, table in other.items()
    }
    assert len(one["keyframes"]) > 20


def test_rows_follow_the_plan_and_not_the_names_of_folders(tmp_path: Path) -> None:
    run, places = RunFolder(tmp_path), [(k, seed, v) for k in range(3) for seed in (9, 10) for v in range(2)]
    cells = {}
    for k, seed, v in random.Random(0).sample(places, len(places)):
        names = {"scenario": f"{'cab'[k]}/x", "seed": seed, "variant": f"v{1 - v}"}
        path = run.cell(names["scenario"], seed, names["variant"])
        empty: dict[str, Any] = {"changes": [], "regions": [], "objects": [], "keyframes": []}
        write_json(path, {"format_version": 1, "key": "", "order": [k, v], "row": names, **empty})
        cells[path] = k, seed, v
    assert [cells[path] for path in sort_cells(cells, {f"{w}__x": f"{w}/x" for w in "abc"})] == places
    rows = collect_tables(run)["results"]
    assert [("cab".index(row.scenario[0]), row.seed, 1 - int(row.variant[1])) for row in rows.itertuples()] == places
    # a cell that lies elsewhere has the place of its row
    moved = run.cell("c/x", 9, "v1").rename(run.cell("b/x", 10, "z"))
    assert read_json(moved)["row"]["scenario"] == "c/x"
    rows = collect_tables(run)["results"]
    assert [("cab".index(row.scenario[0]), row.seed, 1 - int(row.variant[1])) for row in rows.itertuples()] == places


@pytest.mark.parametrize(
    "content", [b"[" * 200_000, b'{"a": 1, "order": [1e999, 1]}', b'{"order": [[], {}]}', b"\xff", b""]
)
def test_a_file_that_is_no_cell_has_a_place_and_no_row(tmp_path: Path, content: bytes) -> None:
    run = RunFolder(tmp_path)
    path = run.cell("a/x", 1, "v")
    path.parent.mkdir(parents=True)
    path.write_bytes(content)
    assert sort_cells([path], {}) == [path]
    with pytest.raises(InputError, match="no finished cell"):
        collect_tables(run)
