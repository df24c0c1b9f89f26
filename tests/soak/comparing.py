"""What a disturbed run lost, doubled, changed or left half-written, against the undisturbed one."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from eval.running.cell_rows import IDENTITY
from tests.same_numbers import TABLES, differences, is_time
from tests.trust.contents import contents

_OF_TIMES = ("table1.csv", "pareto.csv")
Found = dict[str, list[str]]


def compare_runs(usual: Path, run: Path) -> Found:
    """Return what differs between two finished runs with their pages, by the column of the soak's table."""
    ours, theirs = _rows(usual), _rows(run)
    once = theirs[~theirs.index.duplicated()].reindex(columns=ours.columns.union(theirs.columns))
    both = ours.index.intersection(once.index)
    is_unlike = (ours.reindex(columns=once.columns).loc[both] != once.loc[both]).any(axis=1)
    others = [line for line in differences(usual, run) if line != "results.csv"]
    pages, other_pages = _page_tables(usual), _page_tables(run)
    others += [name for name in pages.keys() | other_pages.keys() if pages.get(name) != other_pages.get(name)]
    return {
        "lost": [str(key) for key in ours.index.difference(once.index)],
        "doubled": [str(key) for key in theirs.index[theirs.index.duplicated()]],
        "differ": [*(str(key) for key in both[is_unlike]), *others],
        "half_written": [str(path.relative_to(run)) for path in run.rglob(".*")],
    }


def compare_files(usual: Path, folder: Path) -> Found:
    """Return what differs between the files of two folders, times apart."""
    ours, theirs = contents(usual), contents(folder)
    more = theirs.keys() - ours.keys()
    hidden = {name for name in more if "/." in f"/{name}"}
    return {
        "lost": sorted(ours.keys() - theirs.keys()),
        "doubled": sorted(more - hidden),
        "differ": sorted(name for name in ours.keys() & theirs.keys() if ours[name] != theirs[name]),
        "half_written": sorted(hidden),
    }


def _rows(run: Path) -> pd.DataFrame:
    table = _table(run / "results.csv")
    return table[[column for column in table if not is_time(column)]].set_index(list(IDENTITY))


def _page_tables(run: Path) -> dict[str, str]:
    """Return every other table of a run and of its page, without its times."""
    paths = [path for path in run.glob("*.csv") if path.name not in _OF_TIMES and path.stem not in TABLES]
    tables = {path.name: _table(path) for path in paths}
    return {
        name: (table if "metric" not in table else table[~table["metric"].map(is_time)]).to_csv()
        for name, table in tables.items()
    }


def _table(path: Path) -> pd.DataFrame:
    return pd.read_csv(path, dtype=str, keep_default_na=False)
