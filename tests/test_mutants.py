"""The list of mutants that no test can kill: it names code that stands, and `make mutants` fails where it should."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests import mutants
from tests.mutants import LIST, ROOT, Equal, Mutant, changed_lines, read_list, report_results

EVERYWHERE, SINGLE = read_list()
FIRST, SECOND = Mutant("a.py", "f", "x > 0", "x >= 0"), Mutant("a.py", "g", "return 1", "return 2")


def source_of(mutant: Mutant) -> str:
    """Return the source of a mutant's function, its white space reduced to single spaces."""
    text = (ROOT / mutant.file).read_text()
    names = mutant.function.split(".")
    nodes: list[ast.stmt] = ast.parse(text).body
    for name in names:
        (found,) = [node for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name]
        nodes = found.body
    return re.sub(r"\s+", " ", ast.get_source_segment(text, found) or "")


def test_every_listed_mutant_changes_code_that_stands_and_has_a_reason() -> None:
    gone = [str(mutant) for mutant in SINGLE if mutant.was not in source_of(mutant)]
    assert not gone, f"remove these from {LIST.name}, or run `make mutants`"
    assert all(len(reason.split()) > 3 for reason in (*EVERYWHERE.values(), *SINGLE.values()))
    assert all(mutant.was != mutant.now for mutant in SINGLE)


def test_a_change_that_makes_no_difference_anywhere_explains_nothing_else() -> None:
    equal = Equal("strict=True", "strict=None")
    was = "zip(zip(a, b, strict=True), c, strict=True)"
    for now, is_explained in (
        ("zip(zip(a, b, strict=None), c, strict=True)", True),
        ("zip(zip(a, b, strict=True), c, strict=None)", True),
        ("zip(zip(a, b, strict=None), c, strict=None)", False),
        ("zip(zip(a, c, strict=None), c, strict=True)", False),
        (was, False),
    ):
        assert equal.explains(Mutant("a.py", "f", was, now)) is is_explained
    _, wrong = report_results(
        [(Mutant("a.py", "f", was, "zip(zip(a, b, strict=None), c, strict=True)"), 0)], [equal], []
    )
    assert len(wrong) == 1 and "at least 92%" in wrong[0]


def test_a_mutant_is_known_by_the_lines_that_differ() -> None:
    was, now = ["    a = 1", "    if a > 0:", "        return a"], ["    a = 1", "    if a >= 0:", "        return a"]
    assert changed_lines(was, now) == ("if a > 0:", "if a >= 0:")


def test_the_table_by_hand() -> None:
    # 2 of 30 alive, one of them listed
    results = [(Mutant("a.py", "f", str(number), ""), 1) for number in range(18)]
    results += [(Mutant("b.py", "f", str(number), ""), 1) for number in range(10)]
    table, wrong = report_results([*results, (FIRST, 0), (SECOND, 33)], [], [FIRST])
    assert table.splitlines()[2:] == [
        "| a.py | 20 | 0 | 18 | 1 | 1 | 90.0 |",
        "| b.py | 10 | 0 | 10 | 0 | 0 | 100.0 |",
        "| all | 30 | 0 | 28 | 1 | 1 | 93.3 |",
    ]
    assert len(wrong) == 1 and str(SECOND) in wrong[0] and "not listed" in wrong[0]
    assert report_results([*results, (FIRST, 0), (SECOND, 1)], [], [FIRST])[1] == []


def test_what_has_not_run_is_not_dead() -> None:
    results = [(Mutant("a.py", "f", str(number), ""), 1) for number in range(24)]
    idle = [(Mutant("b.py", "f", str(number), ""), None) for number in range(5)]
    table, wrong = report_results([*results, (FIRST, 0), *idle], [], [FIRST])
    assert table.splitlines()[2:] == [
        "| a.py | 25 | 0 | 24 | 1 | 0 | 96.0 |",
        "| b.py | 5 | 5 | 0 | 0 | 0 | - |",
        "| all | 30 | 5 | 24 | 1 | 0 | 96.0 |",
    ]
    assert len(wrong) == 5 and all("not run" in each for each in wrong)


@pytest.mark.parametrize(
    ("codes", "listed", "told"),
    [
        ((1, 0), [SECOND], "at least 92%"),
        ((1, None), [], "not run"),
    ],
)
def test_whatever_is_wrong_is_told(codes: tuple[int, int], listed: list[Mutant], told: str) -> None:
    _, wrong = report_results(list(zip((FIRST, SECOND), codes, strict=True)), [], listed)
    assert len(wrong) == 1 and told in wrong[0]


def test_the_files_whose_mutants_are_made_exist() -> None:
    text = Path(ROOT / "pyproject.toml").read_text().partition("[tool.mutmut]")[2]
    named = re.findall(r'"((?:eval|tests)/[\w/*.]+)"', text)
    assert len(named) > 5
    assert all(list(ROOT.glob(name)) for name in named)


def test_what_killed_a_mutant_goes_first_but_for_what_is_slow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def item(name: str, n_fixtures: int, scope: str = "function") -> Any:
        info = SimpleNamespace(name2fixturedefs={"pair": [SimpleNamespace(baseid="tests/test_a.py", scope=scope)]})
        return SimpleNamespace(nodeid=name, fixturenames=["tmp_path"] * n_fixtures, location=name, _fixtureinfo=info)

    monkeypatch.chdir(tmp_path)
    for function, name in (("x_f", "kills"), ("x_f", "shares"), ("x_g", "kills another"), ("x_g", "kills another")):
        monkeypatch.setenv("MUTANT_UNDER_TEST", f"a.b.{function}__mutmut_2")
        mutants.pytest_runtest_logreport(SimpleNamespace(failed=True, nodeid=name))  # type: ignore[arg-type]
    Path("mutmut-stats.json").write_text('{"duration_by_test": {"shares too": 0.1, "takes long": 0.6}}')
    items = [
        item("takes long", 0), item("shares", 0, "session"), item("shares too", 0, "module"), item("needs more", 2),
        item("kills", 3), item("kills another", 3), item("needs less", 1),
    ]  # fmt: skip
    for mutated, expected in (
        (
            "a.b.x_f__mutmut_1",
            ["kills", "kills another", "needs less", "needs more", "shares", "shares too", "takes long"],
        ),
        (
            "a.b.x_g__mutmut_1",
            ["kills another", "kills", "needs less", "needs more", "shares", "shares too", "takes long"],
        ),
        (
            "c.x_f__mutmut_1",
            ["needs less", "needs more", "kills", "kills another", "shares", "shares too", "takes long"],
        ),
        ("stats", ["needs less", "needs more", "kills", "kills another", "shares", "shares too", "takes long"]),
    ):
        monkeypatch.setenv("MUTANT_UNDER_TEST", mutated)
        mutants.pytest_collection_modifyitems(items)
        assert [each.nodeid for each in items] == expected
