"""The page and the command that say what moved between two runs."""

import html
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from eval.report.comparing.differences import BETTER, COLUMNS
from eval.report.comparing.page import COLOURS, compare_sides, detail_tables, matrix_table, overview, sentences
from eval.running.results.sides import Side, read_side
from eval.scoring.scoring import METRICS_VERSION

Command = Callable[..., tuple[int, str, str]]


def write_run(folder: Path, recalls: dict[str, float], n_pairs: int = 8, **columns: object) -> Path:
    """Write a run folder in which each method has the same recall on every pair, and a merge error of 1 cm."""
    rows = [
        {"scenario": scenario, "family": scenario, "seed": seed, "variant": name, "status": "ok",
         "metrics_version": METRICS_VERSION, "region_recall": value, "merge_error_m": 0.01,
         "region_recall_at_k": value + 0.001 * seed, **columns}
        for name, value in recalls.items() for scenario in ("regions/narrow", "regions/cave") for seed in range(n_pairs)
    ]  # fmt: skip
    folder.mkdir()
    pd.DataFrame(rows).to_csv(folder / "results.csv", index=False)
    (folder / "provenance.json").write_text(json.dumps({"tool": "tunnelcd", "machine": {"cpu": "made up"}}))
    return folder


@pytest.fixture(name="runs")
def runs_fixture(tmp_path: Path) -> tuple[Path, Path]:
    """Return two runs: one method better, one the same, one only in the first."""
    a = write_run(tmp_path / "old", {"tunnelcd": 0.5, "c2c": 0.2, "solid<b>": 0.1})
    return a, write_run(tmp_path / "new", {"tunnelcd": 0.75, "c2c": 0.2}, merge_error_m=0.0101)


def sides(*paths: Path | str) -> list[Side]:
    return [read_side(str(path)) for path in paths]


def test_the_first_sentence_counts_and_the_last_names_what_is_not_paired(runs: tuple[Path, Path]) -> None:
    told = sentences(compare_sides(*sides(*runs)))
    # answered, recall, recall at K, merge error of two methods: two recalls are better, two errors worse
    for words in ("8 figures", "2 better", "2 worse", "4 the same"):
        assert words in told[0]
    assert "solid<b>: 16 rows" in told[-1]


def test_the_tables_say_the_same_as_the_file(runs: tuple[Path, Path]) -> None:
    found = compare_sides(*sides(*runs))
    matrix = matrix_table(found.table)
    assert [group for group, _ in matrix.groups()] == ["in distribution", "out of distribution", "all pairs"]
    place = matrix.headings.index("region recall")
    cells = [cells[place] for _, rows in matrix.groups() for cells in rows]
    assert [cell.text for cell in cells] == ["+0.25", "0.00"] * 3
    assert [cell.colour for cell in cells] == [COLOURS[BETTER], ""] * 3
    details = detail_tables(found.table)
    assert [table.caption for table in details][3:] == ["regions/cave", "regions/narrow"]
    assert sum(len(table.rows) for table in details) == len(found.table)
    shown = overview(found.table)
    assert shown["B is"].tolist().count(BETTER) == 2
    assert set(shown["pairs"]) == {16}


def test_against_names_the_method_once(runs: tuple[Path, Path]) -> None:
    found = compare_sides(*sides(f"{runs[0]}:c2c", runs[0]))
    assert found.names == ("old:c2c", "old")
    assert set(overview(found.table)["variant"]) == {"tunnelcd", "solid<b>"}
    turned = compare_sides(*sides(runs[0], f"{runs[0]}:c2c"))
    assert set(overview(turned.table)["variant"]) == {"against tunnelcd", "against solid<b>"}
    np.testing.assert_allclose(np.sort(turned.table["difference"]), np.sort(-found.table["difference"]))


def test_a_method_has_one_name_in_every_table(tmp_path: Path) -> None:
    a = write_run(tmp_path / "a", {"tunnelcd": 0.5, "c2c": 0.2})
    b = write_run(tmp_path / "b", {"theirs": 0.6})
    # c2c was not run on this scenario
    table = pd.read_csv(a / "results.csv")
    table = table[(table["variant"] != "c2c") | (table["scenario"] != "regions/cave")]
    table.to_csv(a / "results.csv", index=False)
    found = compare_sides(*sides(a, f"{b}:theirs")).table
    of_cave = next(table for table in detail_tables(found) if table.caption == "regions/cave")
    assert {group for group, _ in of_cave.rows} == {"against tunnelcd"}


def test_the_command_writes_table_and_page(runs: tuple[Path, Path], tmp_path: Path, command: Command) -> None:
    a, b = runs
    code, printed, err = command("report", a, b)
    assert (code, err) == (0, "")
    assert f"page: {b / 'comparison.html'}" in printed
    assert "+0.25" in printed
    assert "variant solid<b>: 16 rows" in printed
    table = pd.read_csv(b / "comparison.csv")
    assert tuple(table) == COLUMNS
    page = (b / "comparison.html").read_text()
    assert "solid<b>" not in page and "Filter rows" in page
    assert "solid&lt;b&gt;" in page
    for word in set(re.findall(r'(?:src|href)="([^"]*)"', page)):
        assert word.startswith(("data:", "#"))
    assert page.count("<script") == 1  # ours: it sorts and filters
    text = html.unescape(re.sub(r"<[^>]+>", " ", page))
    assert "B is better" in text
    assert not (a / "comparison.csv").exists()
    code, printed, _ = command("report", a, "--against", "c2c", "--out", tmp_path / "apart", "-q")
    assert (code, printed) == (0, f"page: {tmp_path / 'apart' / 'comparison.html'}\n")
    assert set(pd.read_csv(tmp_path / "apart" / "comparison.csv")["variant_a"]) == {"c2c"}


def test_more_lines_than_a_terminal_takes_are_cut_to_those_that_moved(tmp_path: Path, command: Command) -> None:
    names = [f"method-{number}" for number in range(20)]
    a = write_run(tmp_path / "a", dict.fromkeys(names, 0.5))
    b = write_run(tmp_path / "b", {**dict.fromkeys(names, 0.5), "method-7": 0.75})
    _, printed, _ = command("report", a, b)
    assert "80 figures compared, those that moved" in " ".join(printed.split())
    assert len([line for line in printed.splitlines() if line.strip().startswith("method-")]) == 2


def test_mistakes_are_one_line_each(runs: tuple[Path, Path], tmp_path: Path, command: Command) -> None:
    a, b = runs
    old = write_run(tmp_path / "v1", {"tunnelcd": 0.5}, metrics_version=METRICS_VERSION - 1)
    for arguments, words in (
        ((old, b), f"{old}: metrics version {METRICS_VERSION - 1} and {b}: metrics version {METRICS_VERSION}"),
        ((a, tmp_path / "absent"), "no such run folder: expected RUN or RUN:VARIANT"),
        ((a, "--against", "c3c"), 'no variant c3c; did you mean "c2c"?'),
        ((a, b, "--against", "c2c"), f"a second run is named too: write {a}:c2c {b} instead"),
        ((a, "--out", tmp_path / "x"), "leave --out to a comparison"),
    ):
        code, _, err = command("report", *arguments)
        assert code == 2
        assert len(err.splitlines()) == 1
        assert words in err
    assert not (tmp_path / "x").exists()
