"""Axes of a plan: what they make harder, in which worlds and methods, and their mistakes."""

from __future__ import annotations

from pathlib import Path

import pytest

from cdpipe.core.errors import InputError
from eval.plans.axes import world_of_step
from eval.plans.cells import expand_cells
from eval.plans.changes import change_plan
from eval.plans.plan import Plan, load_plan

PLAN = """\
name: harder
scenarios: [{name: smoke/one_box, set: sensor.mode=512x10}, smoke/unchanged]
seeds: [7]
variants: [{preset: tunnelcd}, {preset: c2c}]
axes:
  - name: height
    unit: m
    steps:
      - {value: 1.2, set: before.height_m=1.2}
      - {value: 0.8}
      - {value: 0.5, set: [before.height_m=0.5, after.height_m=0.5]}
  - name: keyframes
    steps: [{value: 1}, {value: 4, method: map.keyframe_spacing_m=4}]
"""


def read(folder: Path, text: str = PLAN) -> Plan:
    (folder / "plan.yaml").write_text(text)
    return load_plan(str(folder / "plan.yaml"))


def test_every_step_is_a_world_or_a_setting_of_all_methods(tmp_path: Path) -> None:
    plan = read(tmp_path)
    base = "smoke/one_box[sensor.mode=512x10]"
    low, high = f"{base}[before.height_m=0.5,after.height_m=0.5]", f"{base}[before.height_m=1.2]"
    found = [(cell.scenario, cell.variant) for cell in expand_cells(plan)]
    plain = ["tunnelcd", "c2c"]
    spaced = [f"{name}[map.keyframe_spacing_m=4]" for name in plain]
    assert found == [
        *((base, name) for name in (*plain, *spaced)),
        *((high, name) for name in plain),
        *((low, name) for name in plain),
        *(("smoke/unchanged", name) for name in plain),
    ]
    assert [world_of_step(plan.base, step) for step in plan.axes[0].steps] == [high, base, low]
    assert Plan.model_validate(plan.model_dump(mode="json")) == plan
    # --preset keeps the axes, --seeds too
    assert len(expand_cells(change_plan(plan, presets=["paper"], seeds="3:5"))) == 2 * (2 + 1 + 1 + 1)


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("before.height_m=1.2", "before.heigt_m=1.2", 9, ["axes.0.steps.0.set", 'did you mean "before.height_m"?']),
        ("before.height_m=1.2", "extract.voxel_m=1", 9, ["belongs to the method"]),
        ("map.keyframe_spacing_m=4", "map.keyframe_spacing=4", 13, ["axes.1.steps.1.method"]),
        ("map.keyframe_spacing_m=4", "sensor.mode=512x10", 13, ["belongs to the world"]),
        ("{value: 4, method:", "{value: 1, method:", 12, ["expected every value once"]),
        ("{value: 4, method:", "{value: 4, set: before.height_m=2, method:", 13, ["not both"]),
        ("- name: keyframes", "- name: height", 12, ["axis 'height' stands twice"]),
        ("{value: 1}, {value: 4, method: map.keyframe_spacing_m=4}", "{value: 1}", 13, ["axes.1.steps"]),
    ],
)
def test_mistakes_have_a_line(tmp_path: Path, old: str, new: str, line: int, words: list[str]) -> None:
    assert old in PLAN
    with pytest.raises(InputError) as caught:
        read(tmp_path, PLAN.replace(old, new))
    told = str(caught.value)
    assert all(word in told for word in words), told
    assert f"plan.yaml:{line}: " in told, told


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("{value: 0.8}", "{value: 0.8}\n      - {value: 0.7}", "two steps set the same"),
        ("name: harder", "name: harder\nuntil: merge", "the plan ends at the merge"),
        ("name: harder", "name: harder\nodometry: [own, kiss-icp]", "one odometry"),
        ("{preset: c2c}]", "{preset: c2c, oracle_merge: {}}]", "merge.refine=none does nothing to a variant"),
    ],
)
def test_axes_that_tell_nothing_are_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    text = PLAN.replace("map.keyframe_spacing_m=4", "merge.refine=none")
    with pytest.raises(InputError, match=words):
        read(tmp_path, text.replace(old, new))


def test_a_step_replaces_a_setting_of_a_variant(tmp_path: Path) -> None:
    text = PLAN.replace("{preset: c2c}", "{preset: c2c, set: map.keyframe_spacing_m=2}")
    names = {cell.variant: cell.config.map.keyframe_spacing_m for cell in expand_cells(read(tmp_path, text))}
    assert names["c2c[map.keyframe_spacing_m=4]"] == 4
    assert names["c2c[map.keyframe_spacing_m=2]"] == 2
    assert not any(name.count("keyframe") > 1 for name in names)


def test_a_step_and_a_grid_point_go_over_the_settings_of_a_site(tmp_path: Path) -> None:
    own = "{preset: c2c, per_scenario: {smoke/one_box: [map.keyframe_spacing_m=2, query.n_regions=3]}}"
    grid = "grid:\n  - {variant: c2c, keys: {map.keyframe_spacing_m: [5], extract.min_points: [4, 5]}}\n"
    cells = expand_cells(read(tmp_path, PLAN.replace("{preset: c2c}", own) + grid))
    found = {cell.variant: cell.config for cell in cells if cell.scenario.startswith("smoke/one_box")}
    assert found["c2c"].map.keyframe_spacing_m == 2
    assert found["c2c[map.keyframe_spacing_m=4]"].map.keyframe_spacing_m == 4
    point = found["c2c[map.keyframe_spacing_m=5,extract.min_points=4]"]
    assert (point.map.keyframe_spacing_m, point.query.n_regions) == (5, 3)


def test_plan_hard_asks_for_twelve_axes_with_five_steps_but_one() -> None:
    plan = load_plan("hard")
    assert [len(axis.steps) for axis in plan.axes] == [5, 5, 5, 5, 5, 2, 5, 5, 5, 5, 5, 5]
    # each axis passes the scenario as it is, but for those that replace it: range (lateral), wandering drift
    plain = [axis.name for axis in plan.axes if any(not step.set and not step.method for step in axis.steps)]
    assert {axis.name for axis in plan.axes} - set(plain) == {"range", "wandering drift"}
    assert min(plan.seeds) >= 20000
