"""LaTeX tables: balanced and escaped whatever a method is called, and who is bold, who is marked."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from eval.report.latex import latex_tables
from eval.running.results.run_data import RunData
from eval.running.runfolder import RunFolder

NAN = float("nan")
NASTY = r"50%_of&{this}#~^\$[a=1,b_c=0.5]"


def run(folder: Path, recalls: dict[str, list[float]], **columns: object) -> RunData:
    """Return a run of the recall of every method on pairs 0, 1, ..."""
    rows = [
        {"scenario": "regions/narrow", "family": "regions/narrow", "seed": seed, "variant": name, "status": "ok",
         "is_unchanged_pair": False, "region_recall": value, "merge_error_m": 0.01, **columns}
        for name, values in recalls.items() for seed, value in enumerate(values)
    ]  # fmt: skip
    return RunData(RunFolder(folder), tuple(rows), (), (), {"plan": {"name": "main_50%"}}, ())


def line_of(source: str, name: str) -> list[str]:
    """Return the cells of a method's line."""
    lines = [[cell.strip() for cell in line.removesuffix(r"\\").split(" & ")] for line in source.splitlines()]
    found = [cells[1:] for cells in lines if len(cells) > 1 and cells[1] == name]
    assert len(found) == 1
    return found[0]


def assert_whole(source: str) -> None:
    """Braces pair up, environments nest, every line has as many cells as columns, no special letter stands free."""
    depth = 0
    for letter in re.sub(r"\\[\\{}]", "", source):
        depth += {"{": 1, "}": -1}.get(letter, 0)
        assert depth >= 0
    assert depth == 0
    opened: list[str] = []
    for which, name in re.findall(r"\\(begin|end)\{(\w+\*?)\}", source):
        if which == "begin":
            opened.append(name)
        else:
            assert opened.pop() == name
    assert opened == []
    columns = re.search(r"\\begin\{tabular\}\{(\w+)\}", source)
    assert columns is not None
    body = source[source.index(r"\toprule") : source.index(r"\bottomrule")].splitlines()
    for line in body:
        if line.endswith(r"\\"):
            cells = 1 + len(re.findall(r"(?<!\\)&", line))
            spanned = re.match(r"\\multicolumn\{(\d+)\}", line)
            assert (int(spanned[1]) if spanned else cells) == len(columns[1])
    text = source[source.index(r"\begin") :]
    assert not re.search(r"(?<!\\)[%#]", text)
    assert not re.search(r"(?<!\\)_", text)
    assert text.isascii()


def test_names_are_escaped_and_tables_whole(tmp_path: Path) -> None:
    source = latex_tables(run(tmp_path, {NASTY: [0.5] * 6, "tunnelcd": [0.9] * 6}))["summary.tex"]
    assert_whole(source.replace(r"\label{tab:summary}", ""))
    assert r"50\%\_of\&\{this\}\#\textasciitilde{}\textasciicircum{}\textbackslash{}\$ [a=1, b\_c=0.5] & 6" in source
    assert r"main\_50\%" in source


def test_the_best_is_bold_and_what_cannot_be_told_from_it_is_marked(tmp_path: Path) -> None:
    recalls = {
        "best": [0.8, 0.9, 1.0, 0.8, 0.9, 1.0],
        "near": [0.9, 0.8, 0.9, 0.9, 0.8, 0.9],  # differences of both signs
        "worse": [0.5, 0.6, 0.7, 0.5, 0.6, 0.7],
        "oracle-merge+oracle-regions": [1.0] * 6,
    }  # fmt: skip
    source = latex_tables(run(tmp_path, recalls))["summary.tex"]
    assert line_of(source, "best")[2] == r"\textbf{0.90}"
    assert line_of(source, "near")[2] == r"0.87$^\dagger$"
    assert line_of(source, "worse")[2] == "0.60"
    assert line_of(source, "oracle-merge + oracle-regions")[2] == "1.00"
    # equal everywhere: nobody is best
    assert {line_of(source, name)[3] for name in ("best", "near", "worse")} == {"0.010"}


def test_equal_as_written_are_both_bold_and_five_pairs_tell_nothing_apart(tmp_path: Path) -> None:
    recalls = {"a": [0.9] * 5, "b": [0.901] * 5, "c": [0.1] * 5}
    source = latex_tables(run(tmp_path, recalls))["summary.tex"]
    assert [line_of(source, name)[2] for name in "abc"] == [r"\textbf{0.90}", r"\textbf{0.90}", r"0.10$^\dagger$"]


def test_low_is_best_where_low_is_good(tmp_path: Path) -> None:
    data = run(tmp_path, {"a": [0.5] * 6, "b": [0.5] * 6})
    rows = tuple({**row, "merge_error_m": 0.02 if row["variant"] == "a" else 0.5} for row in data.results)
    source = latex_tables(RunData(data.folder, rows, (), (), {}, ()))["summary.tex"]
    assert (line_of(source, "a")[3], line_of(source, "b")[3]) == (r"\textbf{0.020}", "0.500")


def test_counts_and_intervals(tmp_path: Path) -> None:
    data = run(tmp_path, {"a": [0.0, 1.0, 1.0], "b": [0.5, 0.5, 0.5]})
    rows = [dict(row) for row in data.results]
    rows[0]["status"] = "failed"
    source = latex_tables(RunData(data.folder, tuple(rows), (), (), {}, ()))["summary.tex"]
    assert "1 of 6 cases" in source
    assert r"in distribution: 3 pairs" in source
    below = source.splitlines()[[" & a & 3" in line for line in source.splitlines()].index(True) + 1]
    assert r"{\scriptsize 0.00--1.00}" in below


def test_stored_tables_keep_their_numbers_and_name_what_is_not_tested(tmp_path: Path) -> None:
    names = (
        "region_auroc",
        "region_recall_at_k",
        "region_recall",
        "region_precision",
        "recall_at_0.1",
        "recall_at_0.5",
    )
    plain = {"region_auroc_pooled": NAN, "false_regions_per_100m": 0.1, "bytes_ratio": 10.0, "t_cd_per_region_s": NAN,
             "recall_at_0.1_proposed": NAN, "t_descriptor_per_keyframe_s": 0.01, "n_pairs": 6,
             "n_observable": 12}  # fmt: skip
    ends = {"": 0.0, "_low": -0.05, "_high": 0.05}
    stored = [
        {"domain": "in", "variant": variant, **plain,
         **{f"{name}{end}": value + more for name in names for end, more in ends.items()}}
        for variant, value in (("good_one", 0.9), ("bad", 0.2))
    ]  # fmt: skip
    pd.DataFrame(stored).to_csv(tmp_path / "regions_table.csv", index=False)
    found = latex_tables(run(tmp_path, {"good_one": [0.9] * 6, "bad": list(np.linspace(0.1, 0.3, 6))}))
    assert sorted(found) == ["regions_table.tex", "summary.tex"]
    source = found["regions_table.tex"]
    assert_whole(source.replace(r"\label{tab:regions_table}", ""))
    assert "in distribution: 6 pairs, 12 observable changes & good" in source
    assert "0.85--0.95" in source
    assert line_of(source, r"good\_one")[5] == r"\textbf{0.90}"
    assert line_of(source, "bad")[5] == "0.20"
    # region recall has a number for each pair here, the others have none
    untested = re.search(r"Not tested: ([^.]*0\.1 false, at 0\.5[^.]*)\.", source)
    assert untested is not None
    assert "recall at K" in untested[1]
    assert "precision" in untested[1]


def test_the_few_objects_that_one_matched_make_no_best_and_their_number_stands_below(tmp_path: Path) -> None:
    stored = [
        {"domain": "in", "variant": name, "n_pairs": 6, "n_changes": 12, "kind_accuracy": kind, "n_matched": n}
        for name, kind, n in (("good", 0.9, 9), ("lesser", 0.5, 9), ("surest", 1.0, 7))
    ]
    pd.DataFrame(stored).to_csv(tmp_path / "objects_table.csv", index=False)
    source = latex_tables(run(tmp_path, {name: [0.9] * 6 for name in ("good", "lesser", "surest")}))[
        "objects_table.tex"
    ]
    found = {name: line_of(source, name)[-1] for name in ("good", "lesser", "surest")}
    assert [name for name, cell in found.items() if "textbf" in cell] == []
    assert "n 7" in source and "n 9" in source


@pytest.mark.parametrize("word", ["regions_table", "objects_table"])
def test_a_run_without_a_table_has_no_source_for_it(tmp_path: Path, word: str) -> None:
    assert f"{word}.tex" not in latex_tables(run(tmp_path, {"a": [1.0]}))
