"""Files of a page: all of them, or none."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.whole_file import whole_file
from eval.report.render import write_files


def test_files_of_a_page_take_their_places_when_all_are_written(tmp_path: Path) -> None:
    page, table = tmp_path / "a.html", tmp_path / "a.csv"
    write_files({page: "old", table: b"old"})
    (tmp_path / "sub").mkdir()
    with pytest.raises(InputError, match=r"sub: cannot be written: Is a directory"):
        write_files({page: "new", table: "new", tmp_path / "sub": "new"})
    assert (page.read_text(), table.read_text()) == ("old", "old")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv", "a.html", "sub"]


@pytest.mark.skipif(os.name != "posix", reason="locks of POSIX")
def test_files_that_another_writes_are_refused_all_together(tmp_path: Path) -> None:
    page, table = tmp_path / "a.html", tmp_path / "a.csv"
    write_files({page: "old", table: "old"})
    said = "a.csv: another `tunnelcd` writes there: wait until it ends, or name another$"
    with whole_file(table), pytest.raises(InputError, match=said):
        write_files({page: "new", table: "new"})
    assert page.read_text() == "old"
