"""Tables that are none."""

import lzma
from pathlib import Path

import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from eval.core.tablefile import read_table, write_rows


@pytest.mark.parametrize("row", ["1,2,3", "1,2," + ",".join("3" * 900)])
def test_a_row_with_more_cells_than_the_header_is_one_line(tmp_path: Path, row: str) -> None:
    path = tmp_path / "results.csv"
    path.write_text(f"seed,score\n1,2\n{row}\n" if row == "1,2,3" else f"seed,score\n{row}\n{row}\n")
    with pytest.raises(InputError, match=r"results\.csv: cannot be read as a table: .*") as error:
        read_table(path)
    assert "\n" not in str(error.value)


def test_a_packed_table_of_empty_cells_is_refused_before_it_is_parsed(tmp_path: Path) -> None:
    path = tmp_path / "regions.csv.xz"
    path.write_bytes(lzma.compress(b",".join(b"c" for _ in range(1000)) + b"\n" + b"," * 40_000_000, preset=0))
    assert path.stat().st_size < 100_000
    with pytest.raises(InputError, match=r"40001000 cells, more than \d+$"):
        read_table(path)


def test_more_columns_than_any_table_of_ours_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "regions.csv"
    path.write_bytes(b"a" + b",a" * 9_999 + b"\n")
    assert len(read_table(path).columns) == 10_000
    path.write_bytes(b"a" + b",a" * 10_000 + b"\n")
    with pytest.raises(InputError, match=r"10001 columns, more than 10000$"):
        read_table(path)


FORMULAS = ('=cmd|"/C calc"!A0', "@SUM(1)", "+1-2+cmd|x!A0", '-2 +HYPERLINK("http://x")', "\t=1")


def test_no_text_is_a_formula_of_a_spreadsheet(tmp_path: Path) -> None:
    """The error of an answer, a prop's name or a heading may come from a stranger."""
    plain = ["a=1", "-0.5", "+3", "", "x -y"]
    frame = pd.DataFrame({"error": [*FORMULAS, *plain], "=1+1": -1.5, "n": [None, *range(9)]})
    write_rows(path := tmp_path / "results.csv", frame)
    read = read_table(path)
    assert list(read.columns) == ["error", "'=1+1", "n"]
    assert read["error"].fillna("").tolist() == [*(f"'{text}" for text in FORMULAS), *plain]
    assert (read["'=1+1"] == -1.5).all()
    write_rows(path, read)
    pd.testing.assert_frame_equal(read_table(path), read)


def test_a_carriage_return_ends_no_row(tmp_path: Path) -> None:
    write_rows(path := tmp_path / "results.csv", pd.DataFrame({"error": ["a\rb", "c\nd"], "n": [1, 2]}))
    assert read_table(path).to_numpy().tolist() == [["a\\rb", 1], ["c\nd", 2]]
