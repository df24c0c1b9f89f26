"""`make mutants`: every small change of the code that computes scores must make a fast test fail.

mutmut (`[tool.mutmut]` in pyproject.toml) makes the mutants and runs the tests on them. This program compares the
mutants that survive with `tests/mutants.yaml`, which says of each why no test can tell it from the original, and prints
one row per file. It fails if a survivor is not listed, or if less than 92 % are dead.

    python tests/mutants.py               # everything anew
    python tests/mutants.py --keep        # read the results there are: after `mutmut run cdpipe.core.ranking*`, say
    python tests/mutants.py --out FILE    # write the table as Markdown, too
"""

from __future__ import annotations

import argparse
import ast
import difflib
import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
LIST = Path(__file__).with_suffix(".yaml")
MADE = ROOT / "mutants"
LEAST_DEAD = 0.92
_KILLERS, _STATS = Path("killers"), Path("mutmut-stats.json")
_SLOW_S = 0.5
# exit codes of mutmut: 0 all tests passed, 33 no test runs the function, null not run
_SURVIVED, _UNTESTED, _NOT_RUN = 0, 33, None


@dataclass(frozen=True, order=True)
class Mutant:
    """A mutant by its content, which stays when code elsewhere moves: the lines that it replaces, and by which."""

    file: str
    function: str
    was: str
    now: str

    def __str__(self) -> str:
        return f"{self.file}: {self.function}\n    was: {self.was}\n    now: {self.now}"


Results = list[tuple[Mutant, int | None]]
"""Every mutant and the exit code of its tests; two mutants of one function may have the same content."""


@dataclass(frozen=True)
class Equal:
    """A change that makes no difference wherever it is made: one text in a line, and what mutmut puts in its place."""

    text: str
    by: str

    def explains(self, mutant: Mutant) -> bool:
        """Tell whether a mutant is this change."""
        parts = mutant.was.split(self.text)
        joined = (self.text.join(parts[:n]) + self.by + self.text.join(parts[n:]) for n in range(1, len(parts)))
        return mutant.now in joined


def read_list() -> tuple[dict[Equal, str], dict[Mutant, str]]:
    """Return the reasons of the changes that make no difference anywhere, and those of single mutants."""
    document: dict[str, Any] = yaml.safe_load(LIST.read_text())
    everywhere = {Equal(each["text"], by): each["why"] for each in document["everywhere"] for by in each["by"]}
    single = {
        Mutant(each["file"], each["function"], each["was"], now): each["why"]
        for each in document["single"]
        for now in each["now"]
    }
    return everywhere, single


def read_results() -> Iterator[tuple[Mutant, int | None]]:
    """Yield every mutant that mutmut made, and the exit code of its tests."""
    for meta in sorted(MADE.rglob("*.py.meta")):
        codes: dict[str, int | None] = json.loads(meta.read_text())["exit_code_by_key"]
        file = meta.with_suffix("")
        functions = sources_by_name(file) if codes else {}
        for key, code in codes.items():
            name = key.rpartition(".")[2]
            function = name.rpartition("__mutmut_")[0]
            was, now = changed_lines(functions[f"{function}__mutmut_orig"], functions[name])
            place = str(file.relative_to(MADE))
            yield Mutant(place, function.removeprefix("x_").removeprefix("xǁ").replace("ǁ", "."), was, now), code


def sources_by_name(file: Path) -> dict[str, list[str]]:
    """Return the lines of the body of every function of a file, also of methods."""
    text = file.read_text()
    lines = text.splitlines()
    functions = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)]
    return {node.name: lines[node.lineno : node.end_lineno] for node in functions}


def changed_lines(was: list[str], now: list[str]) -> tuple[str, str]:
    """Return the lines that differ between two sources, without indentation."""
    differences = [line for line in difflib.ndiff(was, now) if line[:2] in ("- ", "+ ")]
    first, second = (" ".join(line[2:].strip() for line in differences if line[0] == sign) for sign in "-+")
    return first, second


def report_results(
    results: Results, everywhere: Collection[Equal], single: Collection[Mutant]
) -> tuple[str, list[str]]:
    """Return a Markdown table with one row per file, and what is wrong."""
    alive = {mutant for mutant, code in results if code in (_SURVIVED, _UNTESTED)}
    listed = {mutant for mutant in alive if mutant in single or any(equal.explains(mutant) for equal in everywhere)}
    wrong = [f"survives and is not listed in {LIST.name}:\n  {mutant}" for mutant in sorted(alive - listed)]
    wrong += [f"not run:\n  {mutant}" for mutant, code in results if code is _NOT_RUN]
    rows = ["| file | mutants | not run | dead | alive, listed | alive, not listed | dead of those run [%] |"]
    rows.append("|---|---|---|---|---|---|---|")
    for file in [*sorted({mutant.file for mutant, _ in results}), "all"]:
        own = [mutant for mutant, _ in results if file in ("all", mutant.file)]
        living = [mutant for mutant in own if mutant in alive]
        n_idle = sum(code is _NOT_RUN for mutant, code in results if file in ("all", mutant.file))
        n_dead, n_listed = len(own) - len(living) - n_idle, sum(mutant in listed for mutant in living)
        share = f"{100 * n_dead / (len(own) - n_idle):.1f}" if len(own) > n_idle else "-"
        cells = [file, len(own), n_idle, n_dead, n_listed, len(living) - n_listed, share]
        rows.append(f"| {' | '.join(map(str, cells))} |")
    if n_dead < LEAST_DEAD * (len(results) - n_idle):
        wrong.append(f"{n_dead} of {len(results)} mutants are dead: at least {LEAST_DEAD:.0%} must be")
    return "\n".join(rows), wrong


def pytest_collection_modifyitems(items: list[pytest.Function]) -> None:
    """Order the tests of a mutant, which is dead with the first failure.

    First those that take less than half a second and share no fixture of their file, as a simulated pair, which every
    mutant makes anew; among them and the rest those that killed other mutants of the function, then of its module, then
    those that need the least, each file from its start. mutmut runs this in `mutants`, each mutant in a process of its
    own.
    """
    module, function = _mutated()
    kills: dict[str, Counter[str]] = {"": Counter(), function: Counter()}
    if (killers := _KILLERS / module).is_file():
        for line in killers.read_text().splitlines():
            killed, test = line.split("\t", 1)
            kills[function if killed == function else ""][test] += 1

    lasted_s = json.loads(_STATS.read_text())["duration_by_test"] if _STATS.is_file() else {}

    def order(item: pytest.Function) -> tuple[Any, ...]:
        name, fixtures = item.nodeid, [each[-1] for each in item._fixtureinfo.name2fixturedefs.values()]
        is_slow = any(each.baseid.endswith(".py") and each.scope != "function" for each in fixtures)
        is_slow |= lasted_s.get(name, 0.0) > _SLOW_S
        return is_slow, -kills[function][name], -kills[""][name], len(item.fixturenames), item.location

    items.sort(key=order)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Remember the test that killed a mutant."""
    module, function = _mutated()
    if report.failed and function:
        _KILLERS.mkdir(exist_ok=True)
        with (_KILLERS / module).open("a") as file:
            file.write(f"{function}\t{report.nodeid}\n")


def _mutated() -> tuple[str, str]:
    """Return the module and the function of the mutant that is tested; without one both are empty."""
    name, is_one, _ = os.environ.get("MUTANT_UNDER_TEST", "").rpartition("__mutmut_")
    module, _, function = name.rpartition(".")
    return (module, function) if is_one else ("", "")


def main() -> int:
    """Run mutmut and compare; 1 if something is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep", action="store_true", help="run nothing, read the results that are there")
    parser.add_argument("--out", type=Path, help="write the table to this file, too")
    parser.add_argument("--processes", type=int, default=2)
    asked = parser.parse_args()
    if not asked.keep:
        shutil.rmtree(MADE, ignore_errors=True)
        mutmut = [sys.executable, "-m", "mutmut", "run", "--max-children", str(asked.processes)]
        progress = None if sys.stdout.isatty() else subprocess.DEVNULL  # a bar that is drawn ten times a second
        subprocess.run(mutmut, cwd=ROOT, check=True, stdout=progress)
    results, (everywhere, single) = list(read_results()), read_list()
    table, wrong = report_results(results, everywhere, single)
    dead = sorted(set(single) & {mutant for mutant, code in results if code not in (_SURVIVED, _UNTESTED, _NOT_RUN)})
    print("\n".join([*wrong, *(f"listed, but dead: remove\n  {mutant}" for mutant in dead), "", table]))
    if asked.out is not None:
        asked.out.write_text(table + "\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
