"""What a clone weighs, and that its committed reports, large tables compressed, can still be read."""

import subprocess
from pathlib import Path

import pytest

from eval.running.results.run_data import read_run

ROOT = Path(__file__).parents[1]
MB = 1_000_000
MAX_PAGE_MB, MAX_TABLE_MB, MAX_TREE_MB = 2, 0.3, 25
RUNS = sorted(path.parent.relative_to(ROOT).as_posix() for path in ROOT.glob("reports/**/results.csv*"))


@pytest.fixture(name="tracked", scope="module")
def tracked_fixture() -> dict[Path, int]:
    """Return the size in bytes of every tracked file that is there."""
    if not (ROOT / ".git").exists():
        pytest.skip("no git checkout")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    paths = (ROOT / name for name in listed.split("\0") if name)
    return {path: path.lstat().st_size for path in paths if path.is_file()}


def too_large(tracked: dict[Path, int], pattern: str, limit_mb: float) -> list[str]:
    found = [path for path, n_bytes in tracked.items() if path.match(pattern) and n_bytes > limit_mb * MB]
    return [path.relative_to(ROOT).as_posix() for path in found]


def test_no_page_is_large(tracked: dict[Path, int]) -> None:
    assert too_large(tracked, "*.html", MAX_PAGE_MB) == []


def test_no_table_is_large(tracked: dict[Path, int]) -> None:
    assert too_large(tracked, "*.csv", MAX_TABLE_MB) == [], "store it as NAME.csv.xz: `xz -9`"


def test_the_tree_is_small(tracked: dict[Path, int]) -> None:
    assert sum(tracked.values()) < MAX_TREE_MB * MB


@pytest.mark.parametrize("run", RUNS)
def test_a_committed_run_is_read(run: str) -> None:
    data = read_run(ROOT / run)
    assert data.provenance["tool"] == "tunnelcd"
    assert len(data.results) > 1
