"""Tables that are none."""

from pathlib import Path

import pytest

from cdpipe.core.errors import InputError
from eval.core.tablefile import read_table


@pytest.mark.parametrize("row", ["1,2,3", "1,2," + ",".join("3" * 900)])
def test_a_row_with_more_cells_than_the_header_is_one_line(tmp_path: Path, row: str) -> None:
    path = tmp_path / "results.csv"
    path.write_text(f"seed,score\n1,2\n{row}\n" if row == "1,2,3" else f"seed,score\n{row}\n{row}\n")
    with pytest.raises(InputError, match=r"results\.csv: cannot be read as a table: .*") as error:
        read_table(path)
    assert "\n" not in str(error.value)
