"""The plans of the merge: how many pairs of which kind, what they run, and that thresholds see no test pair."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import pytest

from cdpipe.core.errors import InputError
from eval.core.statistics import ENOUGH_PAIRS
from eval.plans.cells import expand_cells
from eval.plans.changes import change_plan
from eval.plans.plan import load_plan
from eval.plans.variants import Cell
from tests.eval.plans.shipped import cells_of, plan_of

VALIDATION, TEST = range(10000, 20000), range(20000, 30000)
HELD_OUT = ("cave", "site1", "site2")


def pairs_by_kind(name: str) -> Counter[str]:
    plan = plan_of(name)
    kinds = {world.label: world.pair_kind for world in plan.worlds}
    return Counter(kinds[label] for label, _ in {(cell.scenario, cell.seed) for cell in cells_of(name)})


def variants(found: Iterable[Cell]) -> list[str]:
    return list(dict.fromkeys(cell.variant for cell in found))


def test_merge_has_two_hundred_test_pairs_of_four_kinds_and_four_methods() -> None:
    found = cells_of("merge")
    counts = pairs_by_kind("merge")
    assert set(counts) == {"clean", "drift", "smooth", "disjoint"}
    assert counts.total() >= 200
    assert counts["clean"] >= 100  # 99 % of fewer would be all or none
    assert min(counts["drift"], 2 * counts["smooth"], counts["disjoint"]) >= 30
    assert variants(found) == ["tunnelcd", "frame", "kiss-matcher", "oracle-merge"]
    assert {cell.until for cell in found} == {"merge"}
    assert {cell.seed for cell in found} <= set(TEST)
    worlds = plan_of("merge").worlds
    # only true odometry asks for an exact merge; all other kinds are asked with both odometries
    assert {world.odometry for world in worlds if world.pair_kind == "clean"} == {"own"}
    assert sum(world.n_seeds for world in worlds if world.odometry == "kiss-icp" and world.n_seeds) >= 100
    for kind in ("drift", "smooth", "disjoint"):
        of_kind = [(world.name, world.odometry) for world in worlds if world.pair_kind == kind]
        names = {name for name, _ in of_kind}
        assert sorted(of_kind) == sorted((name, each) for name in names for each in ("own", "kiss-icp"))
    clean = {world.name for world in worlds if world.pair_kind == "clean"}
    assert clean == {f"merge/{name}" for name in ("narrow", "wide", "network", *HELD_OUT)}


def test_thresholds_are_chosen_on_validation_pairs_of_the_same_kinds() -> None:
    found = cells_of("merge-gates")
    counts = pairs_by_kind("merge-gates")
    assert set(counts) == set(pairs_by_kind("merge"))
    assert 60 <= counts.total() <= 100
    assert {cell.seed for cell in found} <= set(VALIDATION)
    assert not any(name in cell.scenario for cell in found for name in HELD_OUT)
    assert variants(found) == ["tunnelcd[merge.accept_all=true]"]
    of_merge = {world.name: world.pair_kind for world in plan_of("merge").worlds}
    for world in plan_of("merge-gates").worlds:
        assert of_merge[world.name] == world.pair_kind


def test_noise_has_each_error_alone_for_both_methods() -> None:
    found = cells_of("merge-noise")
    noises = {(cell.preset, cell.oracle and (cell.oracle.noise_m, cell.oracle.noise_deg)) for cell in found}
    ours, theirs = ({noise for name, noise in noises if name == each} for each in ("tunnelcd", "voxel-diff"))
    assert ours == theirs >= {None, (0, 0)}
    errors = ours - {None, (0, 0)}
    assert all(min(each) == 0 < max(each) for each in errors)  # never both
    assert {each.index(max(each)) for each in errors} == {0, 1}
    assert {cell.until for cell in found} == {None}
    assert len({cell.seed for cell in found}) >= ENOUGH_PAIRS
    assert {cell.config.query.radius_m for cell in found if cell.scenario == "wide"} == {10, "width"}


LIMITED = """\
name: limited
scenarios:
  - {name: smoke/one_box, n_seeds: 2, each: [sensor.range_noise=false]}
  - smoke/unchanged
seeds: [7, 5, 6]
variants: [{preset: tunnelcd}]
"""


def test_an_item_may_have_the_first_of_the_seeds_only(tmp_path: Path) -> None:
    (tmp_path / "plan.yaml").write_text(LIMITED)
    plan = load_plan(str(tmp_path / "plan.yaml"))
    noiseless = "smoke/one_box[sensor.range_noise=false]"
    expected = [("smoke/one_box", 7), ("smoke/one_box", 5), (noiseless, 7), (noiseless, 5)]
    assert [(cell.scenario, cell.seed) for cell in expand_cells(plan)] == [
        *expected, ("smoke/unchanged", 7), ("smoke/unchanged", 5), ("smoke/unchanged", 6),
    ]  # fmt: skip
    assert change_plan(plan) == plan
    # of the seeds of the command line too, and of one there is no more than one
    counts = Counter(cell.scenario for cell in expand_cells(change_plan(plan, seeds="10:14")))
    assert counts == {"smoke/one_box": 2, noiseless: 2, "smoke/unchanged": 4}
    assert len(expand_cells(change_plan(plan, seeds="10"))) == 3


@pytest.mark.parametrize("number", ["0", "-1", "1.5", "many"])
def test_what_is_no_number_of_seeds(tmp_path: Path, number: str) -> None:
    (tmp_path / "plan.yaml").write_text(LIMITED.replace("n_seeds: 2", f"n_seeds: {number}"))
    with pytest.raises(InputError, match=rf"plan.yaml:3: .*n_seeds = '?{number}"):
        load_plan(str(tmp_path / "plan.yaml"))
