"""Scenarios with settings over them: what a plan makes of them, what it refuses, and what is held against what."""

from pathlib import Path

import pytest

from cdpipe.errors import InputError
from eval import worlds
from eval.plan import Plan, cells, changed_plan, load_plan
from eval.worlds import World, references, settings_over, world_slug, worlds_of

PLAN = """\
name: worlds
scenarios:
  - smoke/unchanged
  - name: smoke/one_box
    set: [platform.scan_spacing_m=1]
    each:
      - sensor.range_noise=false
      - [sensor.mode=512x10, sensor.sub_rays=7]
seeds: [7]
variants:
  - preset: paper
    per_scenario:
      smoke/one_box: [query.radius_m=5, query.threshold=0.1]
      smoke/one_box[platform.scan_spacing_m=1,sensor.range_noise=false]: [query.radius_m=6]
grid:
  - variant: tunnelcd
    scenarios: [smoke/one_box]
    keys: {extract.voxel_m: [0.2]}
  - variant: voxel-diff
    scenarios: ["smoke/one_box[platform.scan_spacing_m=1]"]
    keys: {extract.voxel_m: [0.3]}
"""
PLAIN = "smoke/one_box[platform.scan_spacing_m=1]"
QUIET = "smoke/one_box[platform.scan_spacing_m=1,sensor.range_noise=false]"
COARSE = "smoke/one_box[platform.scan_spacing_m=1,sensor.mode=512x10,sensor.sub_rays=7]"


def read(folder: Path, text: str = PLAN) -> Plan:
    (folder / "plan.yaml").write_text(text)
    return load_plan(str(folder / "plan.yaml"))


def mistakes(folder: Path, text: str) -> list[str]:
    with pytest.raises(InputError) as caught:
        read(folder, text)
    return str(caught.value).replace(f"{folder}/", "").splitlines()


def replaced(old: str, new: str) -> str:
    assert old in PLAN
    return PLAN.replace(old, new)


def test_worlds_by_hand(tmp_path: Path) -> None:
    spacing, noise = "platform.scan_spacing_m=1", "sensor.range_noise=false"
    found = worlds_of(read(tmp_path).scenarios)
    assert found == [
        World("smoke/unchanged"),
        World("smoke/one_box", (spacing,)),
        World("smoke/one_box", (spacing, noise)),
        World("smoke/one_box", (spacing, "sensor.mode=512x10", "sensor.sub_rays=7")),
    ]
    assert [world.label for world in found] == ["smoke/unchanged", PLAIN, QUIET, COARSE]


def test_a_plain_name_means_every_world_of_the_scenario_and_a_label_one(tmp_path: Path) -> None:
    found = cells(read(tmp_path))
    assert [(c.scenario, c.variant) for c in found] == [
        ("smoke/unchanged", "paper"),
        (PLAIN, "paper"),
        (PLAIN, "tunnelcd[extract.voxel_m=0.2]"),
        (PLAIN, "voxel-diff[extract.voxel_m=0.3]"),
        (QUIET, "paper"),
        (QUIET, "tunnelcd[extract.voxel_m=0.2]"),
        (COARSE, "paper"),
        (COARSE, "tunnelcd[extract.voxel_m=0.2]"),
    ]
    paper = {c.scenario: c.config.query for c in found if c.preset == "paper"}
    # what is asked for one world goes over what is asked for all of them
    assert {name: query.radius_m for name, query in paper.items()} == {
        "smoke/unchanged": 4.5,
        PLAIN: 5,
        QUIET: 6,
        COARSE: 5,
    }
    assert paper[QUIET].threshold == paper[PLAIN].threshold == 0.1


def test_a_plan_is_dumped_as_it_is_written_and_read_back_the_same(tmp_path: Path) -> None:
    plan = read(tmp_path)
    assert plan.model_dump(mode="json")["scenarios"] == [
        "smoke/unchanged",
        {
            "name": "smoke/one_box",
            "set": ["platform.scan_spacing_m=1"],
            "each": [["sensor.range_noise=false"], ["sensor.mode=512x10", "sensor.sub_rays=7"]],
        },
    ]
    assert changed_plan(plan) == plan
    again = changed_plan(plan, seeds="3:5", settings=["extract.voxel_m=0.1"])
    assert worlds_of(again.scenarios) == worlds_of(plan.scenarios)


def test_every_mistake_of_a_world_is_told_at_once_with_its_line(tmp_path: Path) -> None:
    text = """\
name: bad
scenarios:
  - smoke/one_bx
  - 12
  - {name: smoke/one_box, set: [sensor.range_nois=false, sensor.mode=300x10, query.radius_m=3]}
  - name: smoke/one_box
    each: [[sensor.sub_rays=8], sensor.profile=os1-32-q0, []]
  - {name: smoke/one_box, sett: [sensor.sub_rays=7]}
  - {name: smoke/one_box, each: [sensor.sub_rays=20, sensor.dropout=false, tunnel]}
seeds: [1]
variants: [{preset: papr}]
"""
    told = mistakes(tmp_path, text)
    expected = {
        3: ["smoke/one_bx", 'did you mean "smoke/one_box"?'],
        4: ["12", "expected a scenario's name, or {name"],
        5: ['did you mean "range_noise"?', "300x10", "query.radius_m=3 belongs to the method", "under variants"],
        7: ["an empty list sets nothing"],
        8: ["sett", 'did you mean "set"?'],
        9: ["sensor.sub_rays = 20", 'did you mean "dropouts"?', "--set tunnel: expected key=value"],
        11: ["'papr'"],
    }
    for line, words in expected.items():
        assert [
            text for text in told if text.startswith(f"plan.yaml:{line}:") and all(word in text for word in words)
        ], (
            line,
            told,
        )
    assert len(told) == len(expected)


def test_a_profile_that_is_not_there_is_told_before_anything_runs(tmp_path: Path) -> None:
    (line,) = mistakes(tmp_path, replaced("sensor.range_noise=false\n", "sensor.profile=os1-32-q0\n"))
    assert "sensor profile 'os1-32-q0' is unknown: name one of os1-32-g" in line


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("  - smoke/unchanged\n", f'  - {{name: smoke/one_box, set: ["{PLAIN[14:-1]}"]}}\n', "is listed twice"),
        ("sensor.range_noise=false]: [", "sensor.range_nose=false]: [", "did you mean"),
        ("scenarios: [smoke/one_box]", "scenarios: [paper/site1]", "not in scenarios"),
        ("[0.3]", "[0.3, 0.3]", f"stands twice in the plan for {PLAIN}"),
        (
            "      - sensor.range_noise=false\n",
            f"      - tunnel.nodes.{'n' * 200}=[0, 0, 0]\n",
            "too long for a folder",
        ),
    ],
)
def test_worlds_that_do_not_fit(tmp_path: Path, old: str, new: str, words: str) -> None:
    (line,) = mistakes(tmp_path, replaced(old, new))
    assert words in line


@pytest.mark.parametrize("option", ["settings", "grid"])
def test_a_setting_of_the_world_on_the_command_line_is_shown_its_place(tmp_path: Path, option: str) -> None:
    with pytest.raises(InputError) as caught:
        changed_plan(read(tmp_path), **{option: ["sensor.range_noise=false"]})
    words = (
        "--set sensor.range_noise=false: belongs to the world, not to the method: set it in the plan, under scenarios"
    )
    assert str(caught.value).startswith(words)


def test_folder_names() -> None:
    assert world_slug("paper/site1") == "paper__site1"
    assert world_slug("narrow[sensor.profile=my/own.json]") == "narrow_sensor.profile=my__own.json_"


def test_settings_over_by_hand() -> None:
    assert settings_over("narrow[a=1,b=2]", "narrow") == "a=1,b=2"
    assert settings_over("narrow[a=1,b=2]", "narrow[a=1]") == "b=2"
    # a list among the values, and a file whose own name ends in a bracket
    assert settings_over("narrow[a=[1, 2],b=2]", "narrow[a=[1, 2]]") == "b=2"
    for world, other in [
        ("narrow[a=1]", "narrow[a=1]"),
        ("narrow[a=12]", "narrow[a=1]"),
        ("narrow", "narrow[a=1]"),
        ("narrow[a=1]", "nar"),
        ("narrow2", "narrow"),
        ("wide[a=1]", "narrow"),
    ]:
        assert settings_over(world, other) == ""


def test_a_world_is_held_against_the_one_with_the_fewest_settings_that_it_adds_to() -> None:
    assert references(["n[a=1,b=2]", "n[a=1]", "n", "w[a=1]", "n[c=3]"]) == {
        "n[a=1,b=2]": "n",
        "n[a=1]": "n",
        "n[c=3]": "n",
    }
    assert references(["w[a=1]", "w[a=1,b=2]", "w[a=1,b=2,c=3]", "w[b=2]"]) == {
        "w[a=1,b=2]": "w[a=1]",
        "w[a=1,b=2,c=3]": "w[a=1]",
    }
    assert references(["n[a=1]", "n[a=2]", "m"]) == {}


def test_the_example_of_the_documentation_is_as_it_says(tmp_path: Path) -> None:
    documentation = worlds.__doc__ or ""
    example = documentation.partition("\n\n")[2].partition("\n\nThese are")[0]
    plan = read(tmp_path, f"name: x\nseeds: [0]\nvariants: [{{preset: paper}}]\n{example}\n")
    labels = [world.label for world in worlds_of(plan.scenarios)]
    assert len(labels) == 4
    assert all(label in documentation for label in labels[:3])
