"""Scenarios with settings over them: what a plan makes of them, what it refuses, and what is held against what."""

from pathlib import Path

import pytest

from cdpipe.core.errors import InputError
from eval.plans import worlds
from eval.plans.cells import expand_cells
from eval.plans.changes import change_plan
from eval.plans.plan import Plan, load_plan
from eval.plans.worlds import (
    World,
    find_references,
    is_other_odometry,
    list_settings_over,
    list_worlds,
    world_slug,
)
from scenarios.library import load_scenario

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
      smoke/one_box[platform.scan_spacing_m=1][sensor.range_noise=false]: [query.radius_m=6]
grid:
  - variant: tunnelcd
    scenarios: [smoke/one_box]
    keys: {extract.voxel_m: [0.2]}
  - variant: voxel-diff
    scenarios: ["smoke/one_box[platform.scan_spacing_m=1]"]
    keys: {extract.voxel_m: [0.3]}
"""
PLAIN = "smoke/one_box[platform.scan_spacing_m=1]"
QUIET = "smoke/one_box[platform.scan_spacing_m=1][sensor.range_noise=false]"
COARSE = "smoke/one_box[platform.scan_spacing_m=1][sensor.mode=512x10,sensor.sub_rays=7]"


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
    found = list_worlds(read(tmp_path).scenarios)
    assert found == [
        World("smoke/unchanged"),
        World("smoke/one_box", (spacing,)),
        World("smoke/one_box", (spacing,), (noise,)),
        World("smoke/one_box", (spacing,), ("sensor.mode=512x10", "sensor.sub_rays=7")),
    ]
    assert found[2].settings == (spacing, noise)
    assert [world.label for world in found] == ["smoke/unchanged", PLAIN, QUIET, COARSE]


def test_a_plain_name_means_every_world_of_the_scenario_and_a_label_one(tmp_path: Path) -> None:
    found = expand_cells(read(tmp_path))
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
    assert change_plan(plan) == plan
    again = change_plan(plan, seeds="3:5", settings=["extract.voxel_m=0.1"])
    assert list_worlds(again.scenarios) == list_worlds(plan.scenarios)


BOTH = """\
name: both
odometry: [kiss-icp, own]
scenarios:
  - smoke/unchanged
  - {name: smoke/one_box, each: sensor.sub_rays=7, pair_kind: drift, n_seeds: 1}
  - {name: smoke/one_box, odometry: kiss-icp, set: sensor.profile=os1-32-u0}
seeds: [7, 8]
variants: [{preset: tunnelcd, per_scenario: {smoke/one_box: [query.radius_m=5]}}]
"""
KISS = ("before.odometry.source=kiss-icp", "after.odometry.source=kiss-icp")


def test_a_plan_gives_every_item_its_odometries_unless_the_item_has_its_own(tmp_path: Path) -> None:
    plan = read(tmp_path, BOTH)
    assert [(world.label, world.settings) for world in plan.worlds] == [
        ("smoke/unchanged[odometry=kiss-icp]", KISS),
        ("smoke/unchanged", ()),
        ("smoke/one_box[odometry=kiss-icp]", KISS),
        ("smoke/one_box[odometry=kiss-icp][sensor.sub_rays=7]", (*KISS, "sensor.sub_rays=7")),
        ("smoke/one_box", ()),
        ("smoke/one_box[sensor.sub_rays=7]", ("sensor.sub_rays=7",)),
        ("smoke/one_box[odometry=kiss-icp][sensor.profile=os1-32-u0]", (*KISS, "sensor.profile=os1-32-u0")),
    ]
    assert [world.pair_kind for world in plan.worlds] == ["", "", *["drift"] * 4, ""]
    drawn = load_scenario("smoke/one_box", 7, plan.worlds[2].settings)
    assert drawn.before.odometry.source == drawn.after.odometry.source == "kiss-icp"
    assert {cell.config.query.radius_m for cell in expand_cells(plan) if "one_box" in cell.scenario} == {5}
    assert change_plan(plan, seeds="1:3").worlds == plan.worlds


def test_pairs_with_another_odometry_are_held_against_the_same_pairs_and_repeat_nothing() -> None:
    one, other = "n[odometry=kiss-icp]", "n[odometry=kiss-icp][sensor.sub_rays=7]"
    held = find_references((label, "v", 0) for label in ("n", one, other))
    assert held == {(one, "v"): "n", (other, "v"): one}
    assert (is_other_odometry(one, "n"), is_other_odometry(other, one)) == (True, False)
    assert not is_other_odometry(other, "n")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("odometry: [kiss-icp, own]", "odometry: kis-icp"),
        ("odometry: [kiss-icp, own]", "odometry: [own, own]"),
        ("odometry: [kiss-icp, own]", "odometry: []"),
        ("  - smoke/unchanged", "  - {name: smoke/unchanged, odometry: walk}"),
    ],
)
def test_mistakes_of_the_odometry(tmp_path: Path, text: str, words: str) -> None:
    assert text in BOTH
    (line,) = mistakes(tmp_path, BOTH.replace(text, words))
    assert "odometry" in line and line.startswith("plan.yaml:")


def test_a_world_that_two_odometries_make_twice_is_refused(tmp_path: Path) -> None:
    (line,) = mistakes(tmp_path, BOTH.replace("seeds: [", "  - {name: smoke/unchanged, odometry: own}\nseeds: ["))
    assert "smoke/unchanged is listed twice" in line


def test_the_kind_of_a_pair_is_of_all_worlds_of_its_item_and_in_no_name(tmp_path: Path) -> None:
    text = replaced(
        "    set: [platform.scan_spacing_m=1]\n", "    set: [platform.scan_spacing_m=1]\n    pair_kind: drift\n"
    )
    plan = read(tmp_path, text)
    found = list_worlds(plan.scenarios)
    assert [world.pair_kind for world in found] == ["", "drift", "drift", "drift"]
    assert [world.label for world in found] == [world.label for world in list_worlds(read(tmp_path).scenarios)]
    assert list_worlds(change_plan(plan, seeds="1").scenarios) == found
    named = read(tmp_path, replaced("  - smoke/unchanged\n", "  - {name: smoke/unchanged, pair_kind: disjoint}\n"))
    assert named.model_dump(mode="json")["scenarios"][0] == {"name": "smoke/unchanged", "pair_kind": "disjoint"}
    assert change_plan(named) == named


@pytest.mark.parametrize(
    ("item", "words"),
    [
        ("{name: smoke/unchanged, pair_kind: disjont}", ["plan.yaml:3:", "pair_kind = 'disjont'", 'mean "disjoint"?']),
        ("{name: smoke/unchanged, pairkind: clean}", ["plan.yaml:3:", "pairkind", 'did you mean "pair_kind"?']),
        # the kind tells no two worlds apart
        ("{name: smoke/unchanged, pair_kind: clean}\n  - smoke/unchanged", ["plan.yaml:4:", "is listed twice"]),
    ],
)
def test_mistakes_of_the_kind_of_a_pair(tmp_path: Path, item: str, words: list[str]) -> None:
    (line,) = mistakes(tmp_path, replaced("  - smoke/unchanged\n", f"  - {item}\n"))
    assert all(word in line for word in words), line


def test_every_mistake_of_a_world_is_told_at_once_with_its_line(tmp_path: Path) -> None:
    text = """\
name: bad
scenarios:
  - smoke/one_bx
  - 12
  - {name: smoke/one_box, set: [sensor.range_nois=false, sensor.mode=300x10, query.radius_m=3]}
  - name: smoke/one_box
    each:
      - [sensor.sub_rays=8]
      - sensor.profile=os1-32-q0
      - []
  - {name: smoke/one_box, sett: [sensor.sub_rays=7]}
  - {name: smoke/one_box, each: tunnel}
  - {name: smoke/one_box, set: sensor.dropout=false}
seeds: [1]
variants: [{preset: papr, set: query.n_region=3}]
"""
    told = mistakes(tmp_path, text)
    expected = {
        3: ["smoke/one_bx", 'did you mean "smoke/one_box"?'],
        4: ["12", "expected a scenario's name, or {name"],
        5: ['did you mean "sensor.range_noise"?', "300x10", "query.radius_m=3 belongs to the method", "under variants"],
        8: [": sensor.sub_rays = 8: input should be 1, 7 or 19"],
        9: ["'os1-32-q0' is unknown: name one of os0-128-nominal"],
        10: ["an empty list sets nothing"],
        11: ["sett", 'did you mean "set"?'],
        12: [": tunnel: expected key=value"],
        13: [": sensor.dropout = False", 'did you mean "sensor.dropouts"?'],
        15: ["'papr'"],
    }
    for line, words in expected.items():
        assert [
            text for text in told if text.startswith(f"plan.yaml:{line}:") and all(word in text for word in words)
        ], (
            line,
            told,
        )
    assert told[-1].startswith("plan.yaml:15: variants.0.set.0 = 'query.n_region=3': query.n_region = 3")
    assert len(told) == len(expected) + 1
    assert not any("--set" in line for line in told)


def test_one_setting_needs_no_list_and_a_value_has_one_spelling(tmp_path: Path) -> None:
    text = """\
name: short
scenarios: [{name: smoke/one_box, set: sensor.mode=512x10, each: "sensor.range_noise=off "}]
seeds: [1]
variants: [{preset: paper, set: query.n_regions=3, per_scenario: {smoke/one_box: query.radius_m=5}}]
"""
    plan = read(tmp_path, text)
    mode, noise = "sensor.mode=512x10", "sensor.range_noise=false"
    assert list_worlds(plan.scenarios) == [World("smoke/one_box", (mode,)), World("smoke/one_box", (mode,), (noise,))]
    assert plan.variants[0].set == ("query.n_regions=3",)
    assert plan.variants[0].per_scenario == {"smoke/one_box": ("query.radius_m=5",)}


def test_every_repeated_world_is_told_by_its_name_at_its_line(tmp_path: Path) -> None:
    text = """\
name: twice
scenarios:
  - smoke/one_box
  - name: smoke/one_box
    set: sensor.mode=512x10
    each:
      - sensor.range_noise=false
      - sensor.range_noise=Off
  - {name: smoke/one_box, set: [sensor.mode=512x10, sensor.range_noise=no]}
  - smoke/one_box
seeds: [1]
variants: [{preset: paper}]
"""
    told = [line.partition(": ")[::2] for line in mistakes(tmp_path, text)]
    label = "smoke/one_box[sensor.mode=512x10]"
    assert [(line, rule.rpartition(": ")[2]) for line, rule in told] == [
        ("plan.yaml:8", f"scenario {label}[sensor.range_noise=false] is listed twice"),
        ("plan.yaml:9", f"scenario {label[:-1]},sensor.range_noise=false] is listed twice"),
        ("plan.yaml:10", "scenario smoke/one_box is listed twice"),
    ]


def test_a_profile_that_is_not_there_is_told_before_anything_runs(tmp_path: Path) -> None:
    (line,) = mistakes(tmp_path, replaced("sensor.range_noise=false\n", "sensor.profile=os1-32-q0\n"))
    assert "'os1-32-q0'" in line and "os1-32-g" in line


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("  - smoke/unchanged\n", f'  - {{name: smoke/one_box, set: ["{PLAIN[14:-1]}"]}}\n', "is listed twice"),
        ("sensor.range_noise=false]: [", "sensor.range_nose=false]: [", "did you mean"),
        ("scenarios: [smoke/one_box]", "scenarios: [paper/site1]", "not in scenarios"),
        ("[0.3]", "[0.3, 0.3]", f"stands twice in the plan for {PLAIN}"),
    ],
)
def test_worlds_that_do_not_fit(tmp_path: Path, old: str, new: str, words: str) -> None:
    (line,) = mistakes(tmp_path, replaced(old, new))
    assert words in line


@pytest.mark.parametrize(("option", "name"), [("settings", "--set"), ("grid", "--grid")])
def test_a_setting_of_the_world_on_the_command_line_is_shown_its_place(tmp_path: Path, option: str, name: str) -> None:
    with pytest.raises(InputError) as caught:
        change_plan(read(tmp_path), **{option: ["sensor.range_noise=false"]})
    words = (
        f"{name} sensor.range_noise=false: belongs to the world, not to the method: set it in the plan, under scenarios"
    )
    assert str(caught.value).startswith(words)


def test_folder_names() -> None:
    assert world_slug("paper/site1") == "paper__site1"
    assert world_slug("narrow[sensor.profile=my/own.json]") == "narrow_sensor.profile=my__own.json_"


def test_settings_over_by_hand() -> None:
    assert list_settings_over("narrow[a=1,b=2]", "narrow") == "a=1,b=2"
    assert list_settings_over("narrow[a=1][b=2,c=3]", "narrow[a=1]") == "b=2,c=3"
    assert list_settings_over("narrow[a=1][b=2]", "narrow") == "a=1,b=2"
    assert list_settings_over("narrow[a=[[1, 2], [3]]][b=2]", "narrow[a=[[1, 2], [3]]]") == "b=2"


def held(*worlds: str) -> dict[str, str]:
    return {world: other for (world, _), other in find_references((world, "v", 7) for world in worlds).items()}


def test_a_world_is_held_against_what_its_item_sets_in_all_of_its_worlds() -> None:
    # another plan's plain scenario in the same folder, and a combination that begins as another row does
    assert held("n[a=1][b=2,c=3]", "n", "n[a=1][b=2]", "n[a=1]") == {
        "n[a=1]": "n",
        "n[a=1][b=2]": "n[a=1]",
        "n[a=1][b=2,c=3]": "n[a=1]",
    }
    assert held("n", "n[a=1][b=2]") == {"n[a=1][b=2]": "n"}
    assert held("n[a=[1, [2]]]", "n[a=[1, [2]]][b=2]") == {"n[a=[1, [2]]][b=2]": "n[a=[1, [2]]]"}
    assert held("n[a=1]", "n[a=1,b=2]", "n[a=12]", "m", "na[b=1]", "x[1].yaml", "x") == {}


def test_worlds_are_held_against_each_other_only_where_seed_and_variant_are_the_same() -> None:
    cases = [
        ("n", "ours", 10000),
        ("n", "theirs", 7),
        ("n[a=1]", "ours", 8),
        ("n[a=1][b=2]", "ours", 7),
        ("n[a=1][b=2]", "ours", 8),
        ("n[a=1][b=2]", "theirs", 7),
        ("n[a=1][b=2]", "foreign", 7),
    ]
    assert find_references(cases) == {("n[a=1][b=2]", "ours"): "n[a=1]", ("n[a=1][b=2]", "theirs"): "n"}


def test_the_example_of_the_documentation_is_as_it_says(tmp_path: Path) -> None:
    documentation = worlds.__doc__ or ""
    example = documentation.partition("\n\n")[2].partition("\n\nThese are")[0]
    plan = read(tmp_path, f"name: x\nseeds: [0]\nvariants: [{{preset: paper}}]\n{example}\n")
    labels = [world.label for world in list_worlds(plan.scenarios)]
    assert len(labels) == 4
    assert all(label in documentation for label in labels[:3])


def test_a_family_with_an_effect_is_held_against_the_clean_one_only_where_asked() -> None:
    cases = [
        *((world, "v", 7) for world in ("narrow", "unchanged/narrow", "dust/narrow", "water/null", "regions/narrow")),
        ("dust/wide", "v", 7),
        ("cross/narrow[odometry=kiss-icp]", "v", 7),
        ("narrow[odometry=kiss-icp]", "v", 7),
        ("dust/narrow[a=1]", "v", 7),
    ]
    assert find_references(cases, has_families=True) == {
        ("dust/narrow", "v"): "narrow",
        ("water/null", "v"): "unchanged/narrow",
        ("cross/narrow[odometry=kiss-icp]", "v"): "narrow[odometry=kiss-icp]",
        ("narrow[odometry=kiss-icp]", "v"): "narrow",
        ("dust/narrow[a=1]", "v"): "dust/narrow",
    }
    assert find_references(cases) == {
        ("narrow[odometry=kiss-icp]", "v"): "narrow",
        ("dust/narrow[a=1]", "v"): "dust/narrow",
    }
    assert list_settings_over("dust/narrow", "narrow") == "dust/narrow"
    assert list_settings_over("cross/narrow[b=1]", "narrow[b=1]") == "cross/narrow"
