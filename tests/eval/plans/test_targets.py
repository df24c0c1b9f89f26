"""Targets of a plan: its own, another plan's, or those of the shipped plan of an older run."""

from pathlib import Path

import pytest
import yaml

from cdpipe.core.errors import InputError
from eval.plans.changes import change_plan
from eval.plans.files import plan_names
from eval.plans.plan import load_plan
from eval.plans.targets import Target, Targets, read_targets
from tests.eval.plans.shipped import plan_of

PLAN = {"name": "tiny", "scenarios": ["smoke/one_box"], "seeds": [1], "variants": [{"preset": "paper"}]}


def written(folder: Path, **more: object) -> str:
    path = folder / "tiny.yaml"
    path.write_text(yaml.safe_dump({**PLAN, **more}))
    return str(path)


def test_a_plan_takes_those_of_another_by_its_name(tmp_path: Path) -> None:
    assert load_plan(written(tmp_path, targets="main")).targets == plan_of("main").targets
    assert load_plan(written(tmp_path)).targets == Targets()


@pytest.mark.parametrize("name", plan_names())
def test_a_run_finds_its_targets_whether_its_plan_was_stored_with_them_or_before_there_were_any(name: str) -> None:
    plan = change_plan(plan_of(name), seeds="1:3")
    document = plan.model_dump(mode="json")
    assert read_targets({"plan": document}) == plan.targets
    assert read_targets({"plan": {key: value for key, value in document.items() if key != "targets"}}) == plan.targets


def test_a_plan_that_takes_its_own_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "tiny.yaml"
    with pytest.raises(InputError, match="are those of"):
        load_plan(written(tmp_path, targets=str(path)))


def test_mistakes_of_the_plan_whose_targets_are_taken_are_told_at_its_lines(tmp_path: Path) -> None:
    other = tmp_path / "other.yaml"
    for text, told in (
        ("name: other\ntargts: {}\n", "other.yaml: expected a plan with targets"),
        ("[1]\n", "other.yaml: expected a plan with targets"),
        ("targets:\n  regions:\n  - {column: a, nam: x, at_least: 1}\n", 'other.yaml:3: .*did you mean "name"'),
    ):
        other.write_text(text)
        with pytest.raises(InputError, match=told):
            load_plan(written(tmp_path, targets=str(other)))
    other.write_text("targets: main\n")
    assert load_plan(written(tmp_path, targets=str(other))).targets == plan_of("main").targets


def test_a_run_of_an_unknown_plan_has_none() -> None:
    assert read_targets({"plan": {"name": "of my own"}}) == read_targets({}) == Targets()


@pytest.mark.parametrize(
    ("targets", "rule"),
    [
        ("mian", "unknown"),
        ({"regions": [{"column": "region_auroc", "name": "a"}]}, "at_least and at_most"),
        ({"regions": [{"column": "region_auroc", "name": "a", "at_least": 1, "at_most": 1}]}, "at_least and at_most"),
        ({"regions": [{"column": "region_auroc", "name": "a", "at_least": 1, "less": "c2c"}]}, "less"),
        ({"objects": [{"column": "a", "name": "a", "at_least": 1, "sensor": "b", "domain": "in"}]}, "domain, site and"),
        ({"objects": [{"column": "a", "name": "a", "at_least": 1, "sensor": "b", "odometry": "c"}]}, "odometry: for a"),
        ({"objects": [{"column": "a", "name": "a", "at_least": 1, "odometry": "drift"}]}, "odometry of a: the targets"),
        ({"objects": [{"column": "a", "name": "a", "at_least": 1, "less_sensor": "b"}]}, "less_sensor: for a target"),
        ({"merge": {"clean": 1.1}}, "less than or equal to 1"),
    ],
)
def test_mistakes_are_told(tmp_path: Path, targets: object, rule: str) -> None:
    with pytest.raises(InputError, match=rule):
        load_plan(written(tmp_path, targets=targets))


def test_bounds_hold_at_their_value() -> None:
    low, high = Target(column="a", name="a", at_least=0.5), Target(column="a", name="a", at_most=0.0)
    assert [low.is_met_by(value) for value in (0.5, 0.4999)] == [True, False]
    assert [high.is_met_by(value) for value in (0.0, 0.0001)] == [True, False]


def test_the_shown_method_is_the_plans_or_the_first_that_merges_by_itself() -> None:
    targets = Targets(method="ours")
    assert targets.shown_method(["a", "ours"]) == "ours"
    assert targets.shown_method(["oracle-merge", "a"]) == "a"
    assert targets.shown_method(["oracle-merge"]) == "oracle-merge"
