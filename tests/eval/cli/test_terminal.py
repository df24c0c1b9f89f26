"""What users and files call things is shown on a terminal, and never obeyed by it."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from eval.cli.printed_results import print_summary
from eval.core.terminal.exits import input_errors
from eval.core.terminal.printing import LINE, print_fitted, print_row, print_table, say
from eval.core.terminal.progress import Bars, Lines

Command = Callable[..., tuple[int, str, str]]
# clears the screen, sets the title, goes up a line, turns the text around, and is markup of rich
HOSTILE = "a\x1b[2J\x1b]0;t\x07\x9b1A\r\nb\u202ec[red]d[/red][link=http://x]:skull:\x7f"
SHOWN = r"a\x1b[2J\x1b]0;t\x07\x9b1A\r\nb\u202ec[red]d[/red][link=http://x]:skull:\x7f"


def is_harmless(text: str) -> bool:
    return all(letter == "\n" or unicodedata.category(letter) not in ("Cc", "Cf") for letter in text)


def test_tables_and_rows(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(HOSTILE, pd.DataFrame({HOSTILE: [HOSTILE, 1.5, None]}))
    print_row({HOSTILE: HOSTILE})
    say(False, HOSTILE)
    out = capsys.readouterr().out
    assert is_harmless(out) and out.count(SHOWN) == 6


def test_a_table_is_fitted_into_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    table = pd.DataFrame({name: ["0123456789"] * 40 for name in "abcdefgh"})
    # a column takes 10 letters and 2 blanks, and the frame 2: six columns fit into 80
    assert print_fitted("title", table, [("e", "x"), ("b", "c"), ("d",)], max_lines=20) == ["e", "b", "c"]
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= LINE and len(lines) == 20
    assert lines[2].split() == ["a", "d", "f", "g", "h"]
    assert lines[-1] == f"and {40 - sum('0123456789' in line for line in lines)} more rows"
    # what cannot be left out is folded, and nothing is cut
    assert print_fitted("title", pd.DataFrame({"a": ["x" * 100], "b": [1]}), [("b",)]) == ["b"]
    assert capsys.readouterr().out.count("x") == 100
    assert print_fitted("title", table[list("abc")], [("a",)]) == []


def test_progress(capsys: pytest.CaptureFixture[str]) -> None:
    lines = Lines()
    lines.cells(HOSTILE, 1, 2)
    lines.stage(HOSTILE, 1, 2)
    lines.note(HOSTILE)
    with Bars() as bars:
        bars.cells(HOSTILE, 1, 2)
        bars.stage(HOSTILE, 1, 2)
        bars.note(HOSTILE)
    err = capsys.readouterr().err
    assert is_harmless(err) and err.count(SHOWN) >= 5


def test_errors(capsys: pytest.CaptureFixture[str]) -> None:
    for error in (InputError(HOSTILE.replace("\n", "")), PermissionError(13, HOSTILE, HOSTILE)):
        with pytest.raises(SystemExit), input_errors():
            raise error
    err = capsys.readouterr().err
    assert is_harmless(err) and err.count("\n") == 2 and err.count(SHOWN.replace(r"\n", "")) == 1 and SHOWN in err


@pytest.mark.parametrize(
    "argv",
    [
        ("check", HOSTILE), ("check", f"{HOSTILE}.yaml"), ("run", HOSTILE, "--out", "x"), ("report", HOSTILE),
        ("simulate", "smoke/one_box", "--out", "x", "--world", HOSTILE), ("detect", HOSTILE, "b", "--out", "x"),
        ("score", HOSTILE), ("view", HOSTILE), ("convert", HOSTILE, "x"),
        ("dataset", HOSTILE, "--seeds", "0:1", "--out", "x"),
        ("train", HOSTILE, "--out", "x"), (HOSTILE,), ("run", "smoke", "--out", "x", "--limit", HOSTILE),
    ],
)  # fmt: skip
def test_arguments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command, argv: tuple[str, ...]) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = command(*argv)
    assert code == 2 and is_harmless(out + err) and "error: " in err


@pytest.mark.parametrize(
    "text",
    [
        r'{"k\n\e[2J\u202e": 1}', r'{method: "c2c\n\e[2J"}', r'{"query": {"\n\e[2J": 1}}',
        r'{"\n\e[2J": 1, "\n\e[2J": 2}', r'{tunnel: {"\n\e[2J": 1}, before: {}, after: {}}',
        r'{props: [{name: "\n\e[2J", kind: "\n\e[2J"}], before: {}}',
        r'{name: "\n\e[2J", scenarios: ["\n\e[2J"], seeds: [1], variants: [{preset: "\n\e[2J"}]}',
        r'{extends: "\n\e[2J", before: {}, after: {}}', "\x1b[2J", 'a: "\\e[2J',
    ],
)  # fmt: skip
def test_what_a_file_holds(tmp_path: Path, command: Command, text: str) -> None:
    path = tmp_path / "hostile.yaml"
    path.write_text(text)
    code, out, err = command("check", path)
    assert code == 2 and is_harmless(out + err)
    assert all(line.startswith(f"error: {path}") for line in err.splitlines()), err


def test_f1_stands_beside_iou_in_80_columns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    columns = [
        "region_recall", "region_precision", "region_recall_at_k", "n_regions", "object_iou_point", "object_f1_50",
        "merge_error_m", "t_total_s",
    ]  # fmt: skip
    row = {"scenario": "unchanged/narrow", "seed": 20001, "status": "ok", **dict.fromkeys(columns, 0.123456)}
    names = ("tunnelcd[extract.voxel_m=0.3]", "sphere-difference")
    pd.DataFrame([{**row, "variant": name} for name in names]).to_csv(tmp_path / "results.csv", index=False)
    print_summary(tmp_path)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= LINE
    heading = next(line for line in lines if "IoU" in line)
    assert "F1@50" in heading and "precision" not in heading
