"""Sealed seeds: drawn from the name of a version, one for each seed of dev."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from eval.plans.cells import expand_cells
from eval.plans.changes import change_plan
from eval.plans.plan import load_plan
from eval.plans.splits import load_splits, seal_seeds, version_name

SEALED_PLANS = ("main", "regions", "objects", "null", "merge")
Command = Callable[..., tuple[int, str, str]]


def test_sealed_seeds_by_hand() -> None:
    def drawn(number: int) -> int:
        return 30000 + int(hashlib.sha256(f"tunnelcd 9.3 {number}".encode()).hexdigest(), 16) % 870000

    every = seal_seeds(range(20000, 21000), "tunnelcd 9.3")
    assert every[:3] == (drawn(0), drawn(1), drawn(2))
    # two of the first thousand draws are equal; each seed has a number of its own all the same
    assert len(set(every)) == 1000
    numbers = dict.fromkeys(drawn(number) for number in range(1100))
    assert len({drawn(number) for number in range(1000)}) < 1000
    assert every == tuple(numbers)[:1000]
    assert seal_seeds([20002, 20000], "tunnelcd 9.3") == (every[2], every[0])
    assert not set(every) & set(seal_seeds(range(20000, 20010), "tunnelcd 9.8"))


def test_no_split_reaches_another_or_the_seeds_that_nothing_uses() -> None:
    splits = load_splits()
    assert (splits.dev.first, splits.dev.end) == (20000, 21000)
    assert splits.dev.end <= splits.sealed.first < splits.sealed.end <= 900000
    assert splits.dev.looks


@pytest.mark.parametrize("name", SEALED_PLANS)
def test_a_sealed_plan_is_the_plan_on_other_seeds(name: str) -> None:
    plan = load_plan(name)
    sealed = change_plan(plan, split="sealed")
    new = dict(zip(plan.seeds, sealed.seeds, strict=True))
    assert sealed.seeds == seal_seeds(plan.seeds, version_name())
    assert [(cell.scenario, cell.seed, cell.variant) for cell in expand_cells(sealed)] == [
        (cell.scenario, new[cell.seed], cell.variant) for cell in expand_cells(plan)
    ]
    assert sealed.split == f"sealed by tunnelcd {metadata.version('tunnelcd')}"
    # an earlier run goes on: its plan is what it was
    assert "split" not in change_plan(plan).model_dump(mode="json")
    assert change_plan(plan).model_dump() == change_plan(plan, split="dev").model_dump()


def test_the_seeds_of_an_earlier_version_can_be_had_and_those_of_a_later_one_not() -> None:
    plan = load_plan("main")
    sealed = change_plan(plan, split="sealed:0.1.0")
    assert sealed.split == "sealed by tunnelcd 0.1.0"
    assert sealed.seeds == seal_seeds(plan.seeds, "tunnelcd 0.1.0") != change_plan(plan, split="sealed").seeds
    wrong = ("seald", "sealed:x", "sealed:0.1", "sealed:0.1.00", "sealed:0.1.0.0", "sealed:")
    for split, told in (("sealed:99.0.0", "it or an earlier one"), *((each, "dev, sealed or") for each in wrong)):
        with pytest.raises(InputError, match=f"^--split {split}: .*{told}"):
            change_plan(plan, split=split)


def test_pairs_that_plans_share_stay_shared() -> None:
    def pairs(name: str) -> set[tuple[str, int]]:
        return {(cell.scenario, cell.seed) for cell in expand_cells(change_plan(load_plan(name), split="sealed"))}

    assert pairs("main") <= pairs("regions")
    assert not {seed for _, seed in pairs("null")} & {seed for _, seed in pairs("regions")}


def test_no_plan_file_calls_its_seeds_sealed(tmp_path: Path) -> None:
    file = tmp_path / "tiny.yaml"
    file.write_text("name: tiny\nscenarios: [smoke/one_box]\nseeds: [1]\nvariants: [{preset: paper}]\nsplit: sealed\n")
    with pytest.raises(InputError, match=r"tiny\.yaml:5: split: .*--split sealed"):
        load_plan(str(file))


def test_validation_seeds_have_no_sealed_ones() -> None:
    with pytest.raises(
        InputError, match=r"^--split sealed: plan calibrate: seed 10100 has no sealed one: expected .*20999"
    ):
        change_plan(load_plan("calibrate"), split="sealed")


def test_the_run_records_its_split(tmp_path: Path, command: Command) -> None:
    file = tmp_path / "tiny.yaml"
    file.write_text("name: tiny\nscenarios: [smoke/one_box]\nseeds: [20000]\nvariants: [{preset: paper-topn}]\n")
    code, _, err = command("run", file, "--split", "sealed", "--out", tmp_path / "run", "--quiet")
    assert code == 0, err
    (seed,) = seal_seeds([20000], version_name())
    written = json.loads((tmp_path / "run" / "provenance.json").read_text())
    assert (written["seeds"], written["plan"]["split"]) == ([seed], f"sealed by {version_name()}")
    assert command("report", tmp_path / "run", "--quiet")[0] == 0
    page = (tmp_path / "run" / "index.html").read_text()
    assert "<h1>tiny: " in page and f"seeds sealed by {version_name()};" in page
    # one folder, one split: a table may not mix them
    for options in ((), ("--dry-run",)):
        code, _, err = command("run", file, "--out", tmp_path / "run", *options)
        (line,) = err.splitlines()
        assert code == 2
        assert (
            f"its seeds are sealed by {version_name()}, these are as plans name them: give --split sealed, or" in line
        )
    assert pd.read_csv(tmp_path / "run" / "results.csv")["seed"].tolist() == [seed]
