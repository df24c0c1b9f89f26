from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cdpipe.core.errors import InputError
from eval.bench import bench
from eval.bench.bench import choose, list_contests, list_reasons, make_row, measure, summarise, write_table
from eval.bench.merge import FailedContest
from eval.cli.commands.tools import _print_growth, _print_speed
from eval.cli.main import main
from eval.core.terminal.printing import LINE
from sim.studies.bench import BenchSite
from sim.studies.timing import Contest, SkippedContest

REPORT = Path(__file__).parents[3] / "reports" / "bench"
KEYS = ["name", "value", "unit", "rival", "rival_value", "ratio", "target", "met", "n", "spread", "reason"]
FAST = Contest("Mray/s", (0.5, 0.25, 0.4, 0.2, 1.0), 2.0, "a rival", (2.0, 1.0, 4.0), 4.5)
SLOW = Contest("Mray/s", (1.0,), 2.0, "a rival", (1.0,), 1.7)
ALONE = Contest("s", (3.0,))


def run(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    capsys.readouterr()
    with pytest.raises(SystemExit) as caught:
        main(["bench", *argv])
    out, err = capsys.readouterr()
    return int(caught.value.code or 0), out, err


@pytest.fixture
def three_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        bench, "list_contests", lambda: {"fast": lambda: FAST, "slow": lambda: SLOW, "alone": lambda: ALONE}
    )


def test_a_row_by_hand() -> None:
    row = make_row("fast", FAST)
    # Figures 4, 8, 5, 10, 2: median 5, quartiles 4 and 8. The rival's 1, 2, 0.5: median 1.
    assert row == {
        "name": "fast", "value": 5.0, "unit": "Mray/s", "rival": "a rival", "rival_value": 1.0, "ratio": 5.0,
        "target": 4.5, "met": True, "n": 5, "spread": 4.0, "reason": "",
    }  # fmt: skip
    assert list(row) == KEYS


def test_of_times_the_shorter_one_is_the_faster() -> None:
    row = make_row("merge", Contest("s", (0.2, 0.2), None, "whole map", (1.0, 1.0), 6.0))
    assert (row["value"], row["rival_value"], row["ratio"], row["met"]) == (0.2, 1.0, 5.0, False)


def test_what_has_no_rival_is_not_judged() -> None:
    row = make_row("alone", ALONE)
    assert [row[key] for key in ("value", "rival", "rival_value", "ratio", "target", "met")] == [3.0] + [None] * 5
    assert summarise([row]) == "0 of 0 targets met"


def test_what_the_machine_cannot_do_is_not_judged_and_says_why() -> None:
    row = make_row("gpu", SkippedContest("revolutions/s", (), target=10.0, reason="no GPU"))
    assert (row["value"], row["met"], row["n"], row["reason"]) == (None, None, 0, "no GPU")
    assert summarise([row]) == "0 of 0 targets met; 1 not judged: gpu"
    assert list_reasons([row]) == ["gpu: no GPU"]


def test_a_target_just_reached_is_met() -> None:
    assert make_row("even", Contest("Mray/s", (1.0,), 3.0, "a rival", (2.0,), 2.0))["met"] is True


@pytest.mark.parametrize(("name", "show"), [("bench-3.json", _print_speed), ("growth.json", _print_growth)])
def test_a_terminal_has_room_for_the_tables(
    name: str, show: Callable[[dict[str, Any], list[Path]], None], capsys: pytest.CaptureFixture[str]
) -> None:
    table = json.loads((REPORT / name).read_text())
    show(table, [])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= LINE
    # no name or number is folded: a row is one line
    assert sum(len(line.split()) > 3 and line.startswith("  ") for line in lines) >= len(table["rows"])
    assert any(line.startswith("left out: ") for line in lines)


@pytest.mark.usefixtures("three_rows")
def test_the_table_and_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "new" / "speed.json"
    code, out, err = run(capsys, "--out", str(file))
    assert code == 0  # though a target is missed
    lines = [line.split() for line in out.splitlines()]
    # the unit stands in the cell of the value; the last column, reason, has lines of its own
    assert [key for key in KEYS[:-1] if key != "unit"] in lines
    assert ["fast", "5", "Mray/s", "a", "rival", "1", "5", "4.5", "met", "5", "4"] in lines
    assert ["slow", "2", "Mray/s", "a", "rival", "2", "1", "1.7", "missed", "1", "0"] in lines
    assert ["alone", "3", "s", "-", "-", "-", "-", "-", "1", "0"] in lines
    assert out.splitlines()[-2:] == ["1 of 2 targets met; missed: slow", f"written: {file}"]
    assert [line for line in err.splitlines() if line] == ["[0/3] fast", "[1/3] slow", "[2/3] alone"]
    table = json.loads(file.read_text())
    assert list(table) == ["machine", "rows"]
    assert {"cpu", "cores", "threads"} <= set(table["machine"])
    assert [list(row) for row in table["rows"]] == [KEYS] * 3
    assert [row["met"] for row in table["rows"]] == [True, False, None]
    assert [entry.name for entry in file.parent.iterdir()] == ["speed.json"]


@pytest.mark.usefixtures("three_rows")
def test_only_some_rows_and_nothing_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "speed.json"
    assert run(capsys, "--only", "alone", "--only", "fast", "--quiet", "--out", str(file)) == (0, "", "")
    assert [row["name"] for row in json.loads(file.read_text())["rows"]] == ["fast", "alone"]


def test_a_rival_that_cannot_be_compared_leaves_its_target_open() -> None:
    row = make_row("raced", Contest("s", (0.2,), None, "a rival: not judged, 7.0 m off", (), 6.0))
    assert [row[key] for key in ("value", "rival_value", "ratio", "target", "met")] == [0.2, None, None, 6.0, None]
    told = summarise([make_row("fast", FAST), row, make_row("alone", ALONE)])
    assert told == "1 of 1 targets met; 1 not judged: raced"


def test_what_failed_is_a_row_and_the_rows_before_it_stay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    failed = FailedContest("s", (), target=10.0, reason="it is 3.0 m off")
    monkeypatch.setattr(bench, "list_contests", lambda: {"fast": lambda: FAST, "merge": lambda: failed})
    code, out, _ = run(capsys, "--out", str(tmp_path / "speed.json"))
    assert code == 0
    assert out.splitlines()[-3:] == [
        "merge: it is 3.0 m off",
        "1 of 2 targets met; missed: merge",
        f"written: {tmp_path / 'speed.json'}",
    ]
    first, last = json.loads((tmp_path / "speed.json").read_text())["rows"]
    assert first["met"] is True
    assert [last[key] for key in KEYS] == [
        "merge",
        None,
        "s",
        None,
        None,
        None,
        10.0,
        False,
        0,
        None,
        "it is 3.0 m off",
    ]


@pytest.mark.usefixtures("three_rows")
def test_an_unknown_row_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(capsys, "--only", "quick")
    assert (code, out) == (2, "")
    assert err == "error: --only: 'quick' is no row of the table (known: fast, slow, alone)\n"


def test_where_the_table_cannot_go_is_told_before_anything_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def never() -> Contest:
        raise AssertionError("measured")

    monkeypatch.setattr(bench, "list_contests", lambda: {"never": never})
    code, _, err = run(capsys, "--out", str(tmp_path))
    assert (code, err) == (2, f"error: {tmp_path}: is a folder: name a file for the table\n")
    (tmp_path / "file").touch()
    code, _, err = run(capsys, "--out", str(tmp_path / "file" / "speed.json"))
    assert code == 2
    assert "cannot write there" in err


def test_only_tables_of_earlier_measurements_are_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "list_contests", lambda: {"fast": lambda: FAST})
    table = tmp_path / "speed.json"
    for _ in range(2):
        assert run(capsys, "--out", str(table))[0] == 0
    table.write_text("[]")
    told = f"error: {table}: exists, and is no table of `tunnelcd bench`: name a new file, or remove it\n"
    assert run(capsys, "--out", str(table)) == (2, "", told)
    notes = tmp_path / "notes.md"
    notes.write_text("mine")
    code, _, err = run(capsys, "--profile", "--out", str(tmp_path / "notes.json"))
    assert (code, err.count("\n")) == (2, 1) and err.startswith(f"error: {notes}: exists")
    assert (table.read_text(), notes.read_text()) == ("[]", "mine")


def test_a_table_that_cannot_be_written_leaves_no_half_file(tmp_path: Path) -> None:
    taken = tmp_path / "speed.json"
    taken.mkdir()
    (taken / "inside").touch()
    with pytest.raises(InputError, match="cannot write there"):
        write_table({"machine": {}, "rows": []}, taken)
    assert [entry.name for entry in tmp_path.iterdir()] == ["speed.json"]


def test_a_real_row_of_a_small_world() -> None:
    told: list[Any] = []
    rows = choose(list_contests(BenchSite("smoke/one_box", 0, n_props=3, repeats=2)), ["casting-bare"])
    table = measure(rows, lambda *args: told.append(args))
    (row,) = table["rows"]
    assert told == [("casting-bare", 0, 1)]
    assert row["ratio"] == pytest.approx(row["value"] / row["rival_value"])
    assert row["met"] == (row["ratio"] >= row["target"])
    assert (row["unit"], row["n"]) == ("Mray/s", 2)
    json.dumps(table)


@pytest.mark.parametrize(("option", "name"), [("--growth", "g.csv"), ("--growth", "g.png"), ("--profile", "p.md")])
def test_a_table_takes_no_name_of_a_file_beside_it(
    option: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = run(capsys, option, "--out", str(tmp_path / name))
    assert code == 2 and "is written beside the table: name one that ends in .json" in err
