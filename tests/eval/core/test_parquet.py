"""Large tables as Parquet: what is read of it is what is read of the CSV."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from eval.core import parquet
from eval.core.tablefile import read_table, table_file, write_rows

pytest.importorskip("pyarrow", reason="the extra `parquet` is not installed")
resource = pytest.importorskip("resource", reason="there are no limits of processes")
N = 12


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parquet, "MIN_ROWS", 5)
    monkeypatch.setattr(parquet, "PART_ROWS", 4)


def rows() -> pd.DataFrame:
    return pd.DataFrame(
        {
            "scenario": ["b/x"] * 7 + ["a/x"] * 5,
            "seed": np.arange(N),
            "score": [0.1, np.nan, 1e-17, np.inf, -0.0, 3.0, 1 / 3, 1e300, 5.0, 6.0, 7.0, 8.0],
            "is_found": [True, False, None] * 4,
            "is_all": [True] * N,
            "nothing": [None] * N,
            "text": ["a, b", "", None, 'say "x"'] * 3,
        }
    )


def test_what_is_read_is_the_csv_to_the_byte(tmp_path: Path) -> None:
    path = tmp_path / "regions.csv"
    write_rows(path, rows())
    names = [part.name for part in sorted((tmp_path / "regions.parquet").iterdir())]
    assert names == ["00000-b__x.parquet", "00001-b__x.parquet", "00002-a__x.parquet", "00003-a__x.parquet"]
    assert table_file(path) == path
    assert parquet.read_parquet(tmp_path / "regions.parquet") == path.read_bytes()
    expected = read_table(path)
    path.unlink()
    assert table_file(path) == tmp_path / "regions.parquet"
    pd.testing.assert_frame_equal(read_table(table_file(path)), expected)


def test_other_programs_read_it(tmp_path: Path) -> None:
    write_rows(tmp_path / "regions.csv", rows())
    found = pd.read_parquet(tmp_path / "regions.parquet", filters=[("scenario", "==", "a/x")])
    assert found["seed"].tolist() == [7, 8, 9, 10, 11]


def test_a_small_table_has_none_and_loses_that_of_a_larger_one(tmp_path: Path) -> None:
    write_rows(tmp_path / "regions.csv", rows())
    write_rows(tmp_path / "regions.csv", rows()[:4])
    assert [path.name for path in tmp_path.iterdir()] == ["regions.csv"]


def test_without_the_extra_the_csv_stands_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_rows(tmp_path / "regions.csv", rows())
    monkeypatch.setattr(parquet.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"Parquet needs a package more: pip install 'tunnelcd\[parquet\]'"):
        read_table(tmp_path / "regions.parquet")
    write_rows(tmp_path / "regions.csv", rows())
    assert [path.name for path in tmp_path.iterdir()] == ["regions.csv"]


def test_damaged_parts_are_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "regions.parquet"
    write_rows(tmp_path / "regions.csv", rows())
    content = (folder / "00001-b__x.parquet").read_bytes()
    (folder / "00001-b__x.parquet").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=rf"^{folder}/00001-b__x.parquet: cannot be read as a table: [^\n]+$"):
        read_table(folder)
    pd.DataFrame({"other": [1]}).to_parquet(folder / "00001-b__x.parquet")
    with pytest.raises(InputError, match="has other columns than the parts before it"):
        read_table(folder)
    shutil.rmtree(folder)
    folder.mkdir()
    assert read_table(folder).empty


def test_metadata_that_the_library_trips_over_are_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_rows(tmp_path / "regions.csv", rows())
    folder = tmp_path / "regions.parquet"
    part = next(iter(sorted(folder.iterdir())))
    arrow = pytest.importorskip("pyarrow.parquet")
    table = arrow.read_table(part)
    damaged = {b"pandas": b'{"index_columns": [], "column_indexes": [], "columns": [{"numpy_type": "int64"}]}'}
    arrow.write_table(table.replace_schema_metadata(damaged), part)
    with pytest.raises(InputError, match="cannot be read as a table: 'name'"):
        parquet.read_parquet(folder)
    assert capfd.readouterr().err == ""


def test_a_part_that_expands_too_far_is_refused(tmp_path: Path) -> None:
    write_rows(tmp_path / "regions.csv", rows())
    with pytest.raises(InputError, match="expands to more than 50 bytes"):
        parquet.read_parquet(tmp_path / "regions.parquet", most_bytes=50)


def test_a_part_that_is_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    (tmp_path / "regions.parquet").mkdir()
    os.mkfifo(tmp_path / "regions.parquet" / "00000-a.parquet")
    with pytest.raises(InputError, match="it is a device or a pipe"):
        read_table(tmp_path / "regions.parquet")


def run_alone(folder: Path, code: str, *before: str) -> subprocess.CompletedProcess[bytes]:
    """Run a program in a folder: what the processes that it starts take is its own, and not that of earlier tests."""
    (folder / "read.py").write_text(code)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    words = [*before, sys.executable, "read.py"]
    return subprocess.run(words, cwd=folder, env=environment, capture_output=True, check=False)


def test_the_process_that_reads_has_limits_that_follow_the_size(tmp_path: Path) -> None:
    import pyarrow as pa  # noqa: PLC0415 - an extra
    from pyarrow import parquet as pq  # noqa: PLC0415 - an extra

    (tmp_path / "regions.parquet").mkdir()
    part = tmp_path / "regions.parquet" / "00000-a.parquet"
    one = pa.array(["x" * 200_000])
    column = pa.DictionaryArray.from_arrays(pa.array(np.zeros(20_000, np.int32)), one)
    pq.write_table(pa.table({"scenario": column}), part)  # 4 GB of text
    assert part.stat().st_size < 100_000
    code = "import resource\nfrom pathlib import Path\nfrom cdpipe.core.errors import InputError\n"
    code += "from eval.core.tablefile import read_table\nif __name__ == '__main__':\n    try:\n"
    code += "        read_table(Path('regions.parquet'))\n    except InputError as error:\n"
    code += "        print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss, error)\n"
    done = run_alone(tmp_path, code)
    peak_kb, _, told = done.stdout.decode().partition(" ")
    assert "cannot be read" in told or "was killed" in told, done
    assert int(peak_kb) < 1 << 20


def test_limits_that_are_lower_already_are_kept(tmp_path: Path) -> None:
    write_rows(tmp_path / "regions.csv", rows())
    expected = (tmp_path / "regions.csv").read_bytes()
    code = "import sys\nfrom pathlib import Path\nfrom eval.core.parquet import read_parquet\n"
    code += "if __name__ == '__main__':\n    sys.stdout.buffer.write(read_parquet(Path('regions.parquet')))\n"
    done = run_alone(tmp_path, code, "sh", "-c", 'ulimit -t 7 && exec "$@"', "sh")
    assert (done.stdout, done.stderr) == (expected, b"")
