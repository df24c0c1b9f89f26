from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import pytest

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.sensor.ouster import load_profile, profile_names
from scenarios import check_scenario, load_scenario, scenario_names
from scenarios.catalogue import FAMILIES
from scenarios.references import file_digests, route_length_m
from scenarios.schema import Odometry, Scenario

WORLD = """\
tunnel:
  nodes:
    a: [0, 0, 0]
    b: [10, 0, 0]
    c: [20, 5, 0]
  drifts:
    - nodes: [a, b, c]
  section: {width_m: {uniform: [3, 4]}, height_m: 3}
props:
  - {name: came, kind: box, size_m: [1, 1, 1], place: {between: [a, b], fraction: {uniform: [0.2, 0.3]}}, change: added}
  - {name: went, kind: box, size_m: [1, 1, 1], place: {between: [a, b], fraction: 0.7}, change: removed}
  - name: moved
    kind: chair
    size_m: [1, 1, 1]
    place: {between: [b, c], fraction: 0.2}
    to: {between: [b, c], fraction: 0.7}
    change: moved
  - {name: stays, kind: barrel, size_m: [1, 1, 1], place: {between: [b, c], fraction: 0.4}}
before: {route: [a, b, c]}
after: {route: [a, b, c], start_m: 2}
"""


def written(folder: Path, text: str, name: str = "world.yaml") -> str:
    path = folder / name
    path.write_text(text)
    return str(path)


def mistakes_of(path: str) -> list[str]:
    with pytest.raises(ScenarioError) as error:
        check_scenario(path)
    return [line.removeprefix(path) for line in str(error.value).splitlines()]


def assert_each_begins(lines: list[str], heads: list[str]) -> None:
    """Every mistake names its line, its key and the value; how the sentence goes on is left open."""
    assert len(lines) == len(heads)
    for line, head in zip(lines, heads, strict=True):
        assert line.startswith(head)


def test_a_file_is_drawn_by_its_seed_and_named_after_itself(tmp_path: Path) -> None:
    path = written(tmp_path, WORLD)
    scenario = load_scenario(path, 3)
    assert scenario.family == "world"
    assert scenario == load_scenario(path, 3) != load_scenario(path, 4)
    assert load_scenario(written(tmp_path, f"family: mine\n{WORLD}"), 3).family == "mine"
    assert check_scenario(path).family == "mine"


def test_settings_are_written_over_the_file_before_drawing(tmp_path: Path) -> None:
    path = written(tmp_path, WORLD)
    plain = load_scenario(path, 3)
    changed = load_scenario(path, 3, ["tunnel.section.height_m={uniform: [5, 6]}", "platform.scan_spacing_m=0.4"])
    assert 5 <= changed.tunnel.section.height_m < 6
    assert changed.platform.scan_spacing_m == 0.4
    assert changed.tunnel.section.width_m == plain.tunnel.section.width_m
    assert changed.props == plain.props
    assert load_scenario(path, 3, ["tunnel.section.width_m=3.25"]).tunnel.section.width_m == 3.25


@pytest.mark.parametrize("name", scenario_names())
def test_a_setting_of_another_source_of_odometry_drops_the_keys_of_the_family_s(name: str) -> None:
    plain = load_scenario(name, 10001)
    changed = load_scenario(name, 10001, ["before.odometry.source=kiss-icp"])
    assert changed.before == plain.before.model_copy(update={"odometry": Odometry(source="kiss-icp")})
    assert changed.after == plain.after


def test_odometry_of_another_source_starts_anew_in_a_file_that_extends(tmp_path: Path) -> None:
    drifting = "{odometry: {translation_percent: 0.4, yaw_deg_per_100m: 0.2}}"
    written(tmp_path, f"extends: world.yaml\nafter: {drifting}\n", "drifting.yaml")
    path = written(tmp_path, "extends: drifting.yaml\nafter: {odometry: {source: kiss-icp}}\n", "kiss.yaml")
    written(tmp_path, WORLD)
    assert load_scenario(path, 1).after.odometry == Odometry(source="kiss-icp")
    back = written(
        tmp_path, "extends: kiss.yaml\nafter: {odometry: {source: drift, yaw_deg_per_100m: 1}}\n", "back.yaml"
    )
    assert load_scenario(back, 1).after.odometry == Odometry(yaw_deg_per_100m=1)
    same = written(
        tmp_path, "extends: drifting.yaml\nafter: {odometry: {source: drift, yaw_deg_per_100m: 1}}\n", "same.yaml"
    )
    assert load_scenario(same, 1).after.odometry == Odometry(translation_percent=0.4, yaw_deg_per_100m=1)


def test_odometry_keys_of_two_sources_at_one_place_are_one_mistake(tmp_path: Path) -> None:
    path = written(tmp_path, WORLD)
    both = ["after.odometry.source=kiss-icp", "after.odometry.translation_percent=0.5"]
    for settings in (both, both[::-1], ["after.odometry={source: kiss-icp, translation_percent: 0.5}"]):
        with pytest.raises(ScenarioError, match=r"^--set: after\.odometry = .*kiss-icp") as error:
            load_scenario(path, 1, settings)
        assert len(str(error.value).splitlines()) == 1


def test_a_file_of_odometry_is_a_source_and_is_looked_for_beside_its_scenario(tmp_path: Path) -> None:
    (tmp_path / "own.tum").write_text("")
    written(tmp_path, WORLD)
    over = "extends: world.yaml\nbefore: {odometry: {translation_percent: 1}}\n"
    written(tmp_path, over, "drifting.yaml")
    path = written(tmp_path, "extends: drifting.yaml\nbefore: {odometry: {file: own.tum}}\n", "filed.yaml")
    scenario = load_scenario(path, 1)
    assert scenario.before.odometry == Odometry(source="file", file=str(tmp_path / "own.tum"))
    assert list(file_digests(scenario)) == [str(tmp_path / "own.tum")]
    assert load_scenario(path, 1, ["before.odometry.source=drift"]).before.odometry == Odometry()
    missing = written(tmp_path, "extends: drifting.yaml\nbefore: {odometry: {file: not.tum}}\n", "missing.yaml")
    assert_each_begins(mistakes_of(missing), [":2: before.odometry.file = 'not.tum': no such file"])


def test_mistakes_in_settings_are_told_as_such(tmp_path: Path) -> None:
    path = written(tmp_path, WORLD)
    with pytest.raises(ScenarioError, match=r"^--set: platform.speed_mps = -1: "):
        load_scenario(path, 0, ["platform.speed_mps=-1"])
    with pytest.raises(ScenarioError, match=r'platform.speed = 1: unknown key; did you mean "platform.speed_mps"\?$'):
        load_scenario(path, 0, ["platform.speed=1"])
    with pytest.raises(InputError, match="expected key=value"):
        load_scenario(path, 0, ["platform"])


@pytest.mark.parametrize("name", ["tunnel:", "  nodes:"])
def test_a_misspelt_section_is_one_mistake_and_its_consequences_are_none(tmp_path: Path, name: str) -> None:
    assert WORLD.count(name) == 1
    path = written(tmp_path, WORLD.replace(name, f"{name.rstrip(':')}s:"))
    (line,) = mistakes_of(path)
    assert f'unknown key; did you mean "{name.strip(" :")}"?' in line


@pytest.mark.parametrize(
    ("value", "typo", "told"),
    [
        ("0.7}\n", "{unifrom: [0.4, 0.6]}}\n", ".to.fraction"),
        ("{between: [b, c], fraction: 0.7}", "{choise: [{between: [b, c], fraction: 0.7}]}", ".to"),
    ],
)
def test_a_value_that_cannot_be_drawn_is_one_mistake_where_another_rule_asks_for_it(
    tmp_path: Path, value: str, typo: str, told: str
) -> None:
    assert WORLD.count(value) == 1
    (line,) = mistakes_of(written(tmp_path, WORLD.replace(value, typo)))
    assert f": props.2{told} = " in line and "did you mean" in line


def test_frozen_leaves_the_world_as_the_before_session_saw_it(tmp_path: Path) -> None:
    path = written(tmp_path, WORLD)
    plain, frozen = load_scenario(path, 1), load_scenario(path, 1, ["frozen=true"])
    assert [prop.name for prop in frozen.props] == ["went", "moved", "stays"]
    assert [prop.place for prop in frozen.props] == [prop.place for prop in plain.props[1:]]
    assert all(prop.change == "none" and prop.to is None for prop in frozen.props)
    assert frozen.model_copy(update={"props": plain.props}) == plain
    assert load_scenario(path, 1, ["frozen=false"]) == plain
    Scenario.model_validate(frozen.model_dump())


def test_frozen_keeps_a_pile_whole_and_a_shifted_prop_in_its_place(tmp_path: Path) -> None:
    text = WORLD.replace(
        "before:",
        """\
  - {name: pile, kind: muck_pile, size_m: [2, 2, 1], place: {at: [5, 0, 0]}, change: reshaped, loaded_share: 0.4}
  - {name: pushed, kind: box, size_m: [1, 1, 1], place: {at: [8, 0, 0]}, change: moved, shift: {distance_m: 0.5}}
before:""",
        1,
    )
    path = written(tmp_path, text)
    plain, frozen = load_scenario(path, 1), load_scenario(path, 1, ["frozen=true"])
    assert [(prop.change, prop.loaded_share, prop.shift) for prop in frozen.props[-2:]] == [("none", None, None)] * 2
    assert [prop.place for prop in frozen.props[-2:]] == [prop.place for prop in plain.props[-2:]]
    Scenario.model_validate(frozen.model_dump())


def test_extends_merges_mappings_replaces_lists_and_keeps_the_draws(tmp_path: Path) -> None:
    base = written(tmp_path, WORLD)
    middle = written(tmp_path, "extends: world.yaml\ntunnel: {section: {height_m: {uniform: [4, 5]}}}\n", "middle.yaml")
    last = written(tmp_path, "extends: middle.yaml\nprops: []\nafter: {lateral: 0.5}\n", "last.yaml")
    plain, scenario = load_scenario(base, 2), load_scenario(last, 2)
    assert scenario.family == "last"
    assert scenario.props == ()
    assert scenario.after == plain.after.model_copy(update={"lateral": 0.5})
    assert scenario.tunnel.section.width_m == plain.tunnel.section.width_m
    assert scenario.tunnel.section == load_scenario(middle, 2).tunnel.section
    assert 4 <= scenario.tunnel.section.height_m < 5


def test_what_a_child_draws_from_options_replaces_what_the_base_gives(tmp_path: Path) -> None:
    written(tmp_path, WORLD)
    child = "extends: world.yaml\nplatform: {one_of: [{kind: quadrotor, sensor_height_m: 1.5}], clearance_m: 0.4}\n"
    platform = load_scenario(written(tmp_path, child, "child.yaml"), 0).platform
    assert (platform.kind, platform.sensor_height_m, platform.clearance_m) == ("quadrotor", 1.5, 0.4)


@pytest.mark.parametrize("nodes", ["tunnel.nodes={}", "tunnel.nods={a: [0, 0, 0]}", "tunnel.nodes=3"])
def test_a_tunnel_without_nodes_has_a_line_for_each_mistake(tmp_path: Path, nodes: str) -> None:
    text = "family: x\ntunnel: {drifts: [{nodes: [a, b]}]}\nbefore: {route: [a, b]}\nafter: {route: [a, b]}\n"
    with pytest.raises(ScenarioError) as caught:
        load_scenario(written(tmp_path, text), 0, [nodes])
    assert ("no node of the tunnel is called a" in str(caught.value)) == (nodes == "tunnel.nodes={}")


def test_a_child_may_replace_a_distribution_by_another(tmp_path: Path) -> None:
    written(tmp_path, WORLD)
    child = "extends: world.yaml\ntunnel: {section: {width_m: {choice: [7]}, height_m: {integers: [4, 5]}}}\n"
    section = load_scenario(written(tmp_path, child, "child.yaml"), 0).tunnel.section
    assert (section.width_m, section.height_m) == (7, 4)


def test_extends_finds_shipped_scenarios_and_refuses_circles_and_unknown_names(tmp_path: Path) -> None:
    path = written(tmp_path, "extends: smoke/one_box\nscore_radius_m: 3\n")
    shipped = load_scenario("smoke/one_box", 0)
    assert load_scenario(path, 0) == shipped.model_copy(update={"family": "world", "score_radius_m": 3.0})
    written(tmp_path, "extends: b.yaml\n", "a.yaml")
    circle = written(tmp_path, "# first line\nextends: a.yaml\n", "b.yaml")
    with pytest.raises(ScenarioError, match=r"a.yaml:1: extends = 'b.yaml': "):
        load_scenario(circle, 0)
    unknown = written(tmp_path, "extends: smoke/onebox\n", "c.yaml")
    with pytest.raises(ScenarioError, match=r'c.yaml:1: extends = .* did you mean "smoke/one_box"\?'):
        load_scenario(unknown, 0)


def test_all_mistakes_of_a_file_come_at_once_with_their_lines(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        """\
score_radius: 4.5
tunnel:
  nodes:
    portal: [0, 0, 0]
    face: [10, 0, 0]
  drifts:
    - nodes: [portal, fase]
  section:
    width_m: {unifrom: [3, 4]}
    height_m: {uniform: [4, 3]}
    shape: horse
props:
  - name: box
    kind: boks
    size_m: [1, 1, -1]
    place: {between: [portal, faces], fraction: 0.5}
  - name: box
    kind: barrel
    repeat: {uniform: [1, 2]}
    size_m: [1, 1, 1]
    place: {between: [portal, face], fraction: {uniform: [2, 3]}}
platform: {speed_mps: {normal: [-5, 0.1]}}
before: {route: [portal, face]}
after: {rout: [portal, face]}
""",
    )
    lines = mistakes_of(path)
    assert_each_begins(
        lines,
        [
            ":1: score_radius = 4.5: ",
            ":7: tunnel.drifts.0.nodes.1 = 'fase': ",
            ":9: tunnel.section.width_m = {'unifrom': [3, 4]}: ",
            ":10: tunnel.section.height_m = {'uniform': [4, 3]}: ",
            ":11: tunnel.section.shape = 'horse': ",
            ":14: props.0.kind = 'boks': ",
            ":15: props.0.size_m.2 = -1: ",
            ":16: props.0.place.between = ['portal', 'faces']: ",
            ":19: props.1.repeat = {'uniform': [1, 2]}: ",
            ":21: props.1.place.fraction = 2.",
            ":22: platform.speed_mps = -",
            ":24: after.rout = ['portal', 'face']: ",
        ],
    )
    meant = {0: "score_radius_m", 1: "face", 2: "uniform", 4: "horseshoe", 5: "box", 11: "route"}
    for number, name in meant.items():
        assert f'did you mean "{name}"?' in lines[number]


def test_mistakes_of_one_seed_in_a_few_are_found_by_check_and_told_once(tmp_path: Path) -> None:
    path = written(tmp_path, WORLD.replace("height_m: 3}", "height_m: {choice: [3, 3, 3, -1]}}"))
    assert_each_begins(mistakes_of(path), [":8: tunnel.section.height_m = -1: "])


def test_references_between_drifts_props_and_routes_are_checked(tmp_path: Path) -> None:
    text = (
        WORLD.replace("route: [a, b, c], start_m: 2", "route: [a, c]")
        .replace("to: {between: [b, c]", "to: {between: [c, a]")
        .replace("name: stays", "name: went")
    )
    assert_each_begins(
        mistakes_of(written(tmp_path, text)),
        [
            ":16: props.2.to.between = ['c', 'a']: ",
            ":18: props.3.name = 'went': ",
            ":20: after.route.1 = 'c': ",
        ],
    )


@pytest.mark.parametrize(
    ("route", "told"),
    [
        ("[a, bb, c]", [":20: after.route.1 = 'bb': no node of the tunnel is called bb"]),
        ("[aa, b, cc]", [":20: after.route.0 = 'aa': ", ":20: after.route.2 = 'cc': "]),
        ("[a, [b], cc]", [":20: after.route.2 = 'cc': ", ":20: after.route.1 = ['b']: "]),
        ("[a, bb, cc]", [":20: after.route.1 = 'bb': ", ":20: after.route.2 = 'cc': "]),
    ],
)
def test_an_unknown_node_of_a_route_is_told_once_with_its_own_name(tmp_path: Path, route: str, told: list[str]) -> None:
    text = WORLD.replace("route: [a, b, c], start_m: 2", f"route: {route}")
    assert_each_begins(mistakes_of(written(tmp_path, text)), told)


@pytest.mark.parametrize("mode", ["512", "512x", "[512, 10]"])
def test_a_mode_of_another_form_is_told_an_example(tmp_path: Path, mode: str) -> None:
    with pytest.raises(ScenarioError, match=r"^--set: sensor.mode = .*: expected a form such as 512x10"):
        load_scenario("smoke/one_box", 0, [f"sensor.mode={mode}"])


def test_areas_and_niches_are_checked_with_lines(tmp_path: Path) -> None:
    text = WORLD.replace(
        "before:",
        """\
  - {name: late, kind: box, size_m: [1, 1, 1], place: {area: blast}, change: added}
  - {name: late2, kind: box, size_m: [1, 1, 1], place: {area: blats}, change: moved, to: {area: store}}
areas:
  - {name: blast}
  - {name: blast, length_m: 9}
before:""",
        1,
    )
    text = text.replace(
        "props:",
        """\
  niches:
    - {between: [a, b], fraction: 0.5, side: left, width_m: 2, depth_m: 1, height_m: 2}
    - {between: [a, c], fraction: 0.5, side: left, width_m: 2, depth_m: 1, height_m: 2}
props:""",
    )
    assert_each_begins(
        mistakes_of(written(tmp_path, text)),
        [
            ":11: tunnel.niches.1.between = ['a', 'c']: ",
            ":23: props.5.place.area = 'blats': ",
            ":23: props.5.to.area = 'store': ",
            ":26: areas.1.name = 'blast': ",
        ],
    )


def foreign_world(folder: Path) -> str:
    """A mesh without drifts, driven on two trajectories; every file lies beside the scenario."""
    for name in ("mine.stl", "chair.obj", "before.tum", "after.tum"):
        (folder / name).write_text("x")
    return """\
tunnel:
  mesh: {path: mine.stl, units: mm}
props:
  - {name: chair, kind: mesh, mesh: {path: {choice: [chair.obj]}}, place: {at: [1, 2, 3]}, change: added}
before: {trajectory: before.tum}
after: {trajectory: after.tum}
platform: {sensor_height_m: 9, clearance_m: 9}
"""


def test_files_are_looked_for_beside_the_file_that_names_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "base").mkdir()
    (tmp_path / "child").mkdir()
    written(tmp_path / "base", foreign_world(tmp_path / "base"))
    (tmp_path / "child" / "after.tum").write_text("x")
    child = written(
        tmp_path / "child", "extends: ../base/world.yaml\nafter: {trajectory: after.tum}\ntunnel: {mesh: {up: y}}\n"
    )
    scenario = check_scenario(child)
    assert scenario.tunnel.mesh is not None
    assert (scenario.tunnel.mesh.up, scenario.tunnel.mesh.units) == ("y", "mm")
    chair = scenario.props[0].mesh
    assert chair is not None
    for name, expected in (
        (scenario.tunnel.mesh.path, "base/mine.stl"),
        (chair.path, "base/chair.obj"),
        (scenario.before.trajectory, "base/before.tum"),
        (scenario.after.trajectory, "child/after.tum"),
    ):
        assert name is not None
        assert Path(name).resolve() == (tmp_path / expected).resolve()
    monkeypatch.chdir(tmp_path / "base")
    assert load_scenario(child, 0, ["after.trajectory=before.tum"]).after.trajectory == "before.tum"
    assert load_scenario("world.yaml", 0).before.trajectory == "before.tum"


def test_missing_files_are_told_by_line_with_the_other_mistakes(tmp_path: Path) -> None:
    text = foreign_world(tmp_path)
    for name in ("mine.stl", "chair.obj", "after.tum"):
        (tmp_path / name).unlink()
    lines = mistakes_of(written(tmp_path, text + "score_radius_m: -1\n"))
    assert [line.split(":")[1] for line in lines] == ["2", "4", "6", "8"]
    assert lines[0] == f":2: tunnel.mesh.path = 'mine.stl': no such file: expected {tmp_path / 'mine.stl'}"
    assert "chair.obj" in lines[1] and "after.trajectory" in lines[2] and "score_radius_m" in lines[3]


def test_a_mesh_without_drifts_has_no_way_to_draw_places_along(tmp_path: Path) -> None:
    text = foreign_world(tmp_path).replace("{at: [1, 2, 3]}", "{yaw_deg: 4}")
    text += """\
areas: [{name: blast}]
"""
    text = text.replace(
        "props:",
        """\
  furniture: {bolts: {}}
  meander_m: 1
  floor:
    stones: {per_m2: 1}
    ruts: {depth_m: 0.1}
  roughness: [{amplitude_m: 0.1, length_m: 1}]
props:""",
    )
    no_route = "needs a route in both sessions, and before has a trajectory"
    assert [line.split(": ", 2)[0] + " " + line.split(": ")[-1] for line in mistakes_of(written(tmp_path, text))] == [
        ":3 give tunnel.drifts that run through tunnel.mesh",
        ":4 leave it out",
        ":6 give tunnel.drifts that run through tunnel.mesh",
        ":7 leave it out",
        ":8 leave it out",
        ":10 give at, or between and fraction",
        f":14 an area {no_route}",
    ]


def test_a_session_needs_a_route_or_a_trajectory(tmp_path: Path) -> None:
    lines = mistakes_of(written(tmp_path, WORLD.replace("after: {route: [a, b, c], start_m: 2}", "after: {}")))
    assert len(lines) == 1
    assert lines[0].startswith(":20: after = ") and "give a route of two nodes or more, or a trajectory" in lines[0]


def test_worlds_that_cannot_be_driven_are_refused(tmp_path: Path) -> None:
    # the route is 10 + sqrt(125) = 21.18 m
    text = WORLD.replace("{uniform: [3, 4]}", "3.2").replace("start_m: 2", "start_m: 22, height_m: 3.5")
    text += "platform: {clearance_m: 2}\n"
    assert_each_begins(
        mistakes_of(written(tmp_path, text)),
        [
            ":20: after.start_m = 22: ",
            ":20: after.height_m = 3.5: ",
            ":21: platform.clearance_m = 2: ",
        ],
    )


def test_scans_farther_apart_than_the_route_is_long_are_a_mistake_of_their_spacing(tmp_path: Path) -> None:
    # the route is 21.18 m, and after leaves 2 m out
    text = WORLD + "platform: {scan_spacing_m: 20}\n"
    (line,) = mistakes_of(written(tmp_path, text))
    assert line.startswith(":21: platform.scan_spacing_m = 20: ") and "after's route, 19.2 m" in line
    own = WORLD.replace("start_m: 2", "platform: {scan_spacing_m: 30}")
    (line,) = mistakes_of(written(tmp_path, own))
    assert line.startswith(":20: after.platform.scan_spacing_m = 30: ") and "after's route, 21.2 m" in line


def test_route_length_by_hand(tmp_path: Path) -> None:
    scenario = load_scenario(written(tmp_path, WORLD.replace("start_m: 2", "start_m: 2, end_m: 3")), 0)
    assert route_length_m(scenario.tunnel, scenario.before) == 10 + 125**0.5
    assert route_length_m(scenario.tunnel, scenario.after) == 10 + 125**0.5 - 5


def test_a_mistake_inherited_from_a_base_points_into_the_base(tmp_path: Path) -> None:
    base = written(tmp_path, WORLD.replace("kind: chair", "kind: stool"))
    child = written(tmp_path, "extends: world.yaml\nscore_radius_m: -1\n", "child.yaml")
    with pytest.raises(ScenarioError) as error:
        check_scenario(child)
    lines = str(error.value).splitlines()
    assert len(lines) == 2
    assert lines[0].startswith(f"{child}:2: score_radius_m = -1: ")
    assert lines[1].startswith(f"{base}:13: props.2.kind = 'stool': ")


def test_lines_survive_repeat_and_one_of(tmp_path: Path) -> None:
    text = WORLD.replace(
        "before:",
        """\
  - name: drum
    repeat: 2
    one_of:
      - kind: barrel
        size_m: [0, 1, 1]
    place: {between: [a, b], fraction: 0.5, lateral: 3}
before:""",
    )
    assert_each_begins(
        mistakes_of(written(tmp_path, text)),
        [
            ":23: props.4.size_m.0 = 0: ",
            ":24: props.4.place.lateral = 3: ",
        ],
    )


@pytest.mark.parametrize(("text", "told"), [("", "nothing in it"), ("- 1\n- 2\n", "list"), ("just words\n", "str")])
def test_a_file_without_keys_is_refused(tmp_path: Path, text: str, told: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ScenarioError, match=f"expected keys and values, got {told}$"):
        load_scenario(path, 0)


def test_parts_of_the_wrong_type_are_mistakes_not_crashes(tmp_path: Path) -> None:
    path = written(tmp_path, "tunnel: 3\nprops: {a: 1}\nbefore: {route: [1, 2]}\nafter: []\nfrozen: 2\nplatform:\n")
    text = "\n".join(mistakes_of(path))
    for key in (":1: tunnel = 3", ":2: props = ", ":3: before.route.0 = 1", ":4: after = []", ":5: frozen = 2"):
        assert key in text


def test_unknown_names_suggest_the_nearest() -> None:
    with pytest.raises(ScenarioError, match=r'^scenario "paper/sit1": unknown; did you mean "paper/site1"\?$'):
        load_scenario("paper/sit1", 0)
    with pytest.raises(ScenarioError, match=r'did you mean "paper/site2"\?$'):
        load_scenario("site2", 0)
    with pytest.raises(ScenarioError, match=r'"qqq": unknown; `tunnelcd list scenarios` names all'):
        load_scenario("qqq", 0)
    with pytest.raises(ScenarioError, match=r"nowhere.yaml: no such file"):
        load_scenario("nowhere.yaml", 0)


def test_negative_seeds_are_refused() -> None:
    with pytest.raises(InputError, match="seed = -1: expected a whole number >= 0"):
        load_scenario(scenario_names()[0], -1)


def test_the_readme_s_first_file_is_valid_and_its_families_exist(tmp_path: Path) -> None:
    text = (FAMILIES.parent / "README.md").read_text()
    example = text.split("```yaml\n")[1].split("```")[0]
    assert check_scenario(written(tmp_path, example)).props[0].change == "added"
    table = (FAMILIES / "FAMILIES.md").read_text().split("## Pairs for the merge")[0]
    named = {word for line in table.splitlines() for cell in line.split("|")[1:2] for word in cell.split("`")[1::2]}
    assert named == set(scenario_names())


def test_a_sensor_that_is_not_there_is_told_with_its_line(tmp_path: Path) -> None:
    (line,) = mistakes_of(written(tmp_path, WORLD + "sensor: {profile: os1-33}\n"))
    assert line.startswith(":21: sensor.profile = 'os1-33': ")
    assert ", ".join(profile_names()) in line
    (line,) = mistakes_of(written(tmp_path, WORLD + "sensor:\n  mode: 333x10\n"))
    assert line.startswith(":22: sensor.mode = '333x10': ")
    (line,) = mistakes_of(written(tmp_path, WORLD + "sensor: {profile: own.json}\n"))
    assert line.startswith(":21: sensor.profile = 'own.json': ")
    assert str(tmp_path / "own.json") in line


def test_a_profile_is_looked_for_beside_the_file_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "own.json").write_text(json.dumps(load_profile("os1-32-u0").to_json()))
    profile = check_scenario(written(tmp_path, WORLD + "sensor: {profile: own.json}\n")).sensor.profile
    assert Path(profile).resolve() == (tmp_path / "own.json").resolve()
    (tmp_path / "own.json").write_text("{}")
    (line,) = mistakes_of(str(tmp_path / "world.yaml"))
    assert line.startswith(":21: sensor.profile") and "own.json" in line


def test_settings_are_checked_as_if_they_stood_in_the_file(tmp_path: Path) -> None:
    path = written(tmp_path, WORLD)
    assert check_scenario(path, ["sensor.sub_rays=7"]).sensor.sub_rays == 7
    with pytest.raises(ScenarioError) as caught:
        check_scenario(path, ["sensor.sub_ray=7", "platform.speed_mps=-1"])
    lines = str(caught.value).splitlines()
    assert any("--set: sensor.sub_ray = 7: unknown key; did you mean" in line for line in lines)
    assert any("--set: platform.speed_mps = -1" in line for line in lines)


def test_every_file_of_a_scenario_has_a_digest(tmp_path: Path) -> None:
    path = written(tmp_path, foreign_world(tmp_path) + "sensor: {profile: own.json}\n")
    (tmp_path / "own.json").write_text(json.dumps(load_profile("os1-32-u0").to_json()))
    for name in ("mine.stl", "chair.obj", "before.tum", "after.tum"):
        (tmp_path / name).write_text(name)
    scenario = check_scenario(path)
    digests = {Path(name).name: digest for name, digest in file_digests(scenario).items()}
    assert digests == {
        name: hashlib.sha256((tmp_path / name).read_bytes()).hexdigest()
        for name in ("mine.stl", "chair.obj", "before.tum", "after.tum", "own.json")
    }
    assert file_digests(load_scenario("smoke/one_box", 0)) == {}
    (tmp_path / "mine.stl").unlink()
    with pytest.raises(InputError, match=r"mine\.stl: missing"):
        file_digests(scenario)


def test_a_mistake_of_a_repeated_item_is_told_once() -> None:
    with pytest.raises(ScenarioError) as caught:
        load_scenario("hard/drift", 20500, ["props.change.size=3", "props.clutter.aged={shift_m: 9}"])
    lines = str(caught.value).splitlines()
    assert len(lines) == 2
    assert lines[0] == '--set: props.0.size = 3: unknown key; did you mean "props.0.size_m"?'
    assert re.match(r"--set: props\.8\.aged\.shift_m = 9: ", lines[1])


@pytest.mark.parametrize("text", ["uniform: [3, 4]", "choice: [1]"])
def test_a_distribution_is_no_key_of_a_scenario(tmp_path: Path, text: str) -> None:
    word = text.partition(":")[0]
    path = written(tmp_path, f"{WORLD}{text}\n")
    assert_each_begins(mistakes_of(path), [f":{len(WORLD.splitlines()) + 1}: {word} = ["])
    with pytest.raises(ScenarioError, match=rf"^--set: {word} = "):
        load_scenario(written(tmp_path, WORLD, "other.yaml"), 0, [text.replace(": ", "=")])


def test_room_is_needed_in_the_drifts_that_are_driven(tmp_path: Path) -> None:
    narrow = "    - {nodes: [c, d], section: {width_m: 0.9, height_m: 0.7}}\n"
    text = WORLD.replace("    c: [20, 5, 0]\n", "    c: [20, 5, 0]\n    d: [30, 5, 0]\n")
    text = text.replace("  section:", f"{narrow}  section:")
    check_scenario(written(tmp_path, text))
    driven = text.replace("after: {route: [a, b, c]", "after: {route: [a, b, c, d]")
    told = mistakes_of(written(tmp_path, driven))
    assert_each_begins(told, [":1: platform.clearance_m: ", ":1: platform.sensor_height_m: "])
    (tmp_path / "drive.tum").write_text("0 1 0 1 0 0 0 1\n9 9 0 1 0 0 0 1\n")
    recorded = "".join(f"{name}: {{trajectory: drive.tum}}\n" for name in ("before", "after"))
    check_scenario(written(tmp_path, text.split("props:")[0].replace("{uniform: [3, 4]}", "0.9") + recorded))


@pytest.mark.parametrize("name", ["9" * 5000, f"{'9' * 5000}.yaml"])
def test_a_base_with_a_name_that_no_file_can_have_is_told_on_one_short_line(name: str, tmp_path: Path) -> None:
    path = written(tmp_path, f'extends: "{name}"\n')
    with pytest.raises(ScenarioError, match=r"extends = ['\"]9+\.\.\.: .*9+\.\.\.") as error:
        load_scenario(path, 1)
    assert len(str(error.value)) < 600 + len(path) and "\n" not in str(error.value)
