"""Scenarios whose world is a recording."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.core.files.yaml_file import parse_yaml_value
from eval.running.pair_run import Pair
from scenarios.grafted import GraftScenario
from scenarios.library import check_scenario, load_grafted, load_scenario
from scenarios.references import file_digests
from scenarios.schema import Place

BOX = "{name: box, kind: box, size_m: [{uniform: [0.6, 0.9]}, 0.6, 0.7], change: added}"


def write(folder: Path, text: str) -> str:
    (folder / "drive.osf").write_bytes(b"one")
    (folder / "real.yaml").write_text(text)
    return str(folder / "real.yaml")


def test_a_file_with_a_recording_is_drawn_like_any_other(tmp_path: Path) -> None:
    path = write(tmp_path, f"recording: {{sessions: [drive.osf]}}\nprops:\n  - {BOX}\n")
    drawn = load_scenario(path, 3)
    assert isinstance(drawn, GraftScenario)
    assert drawn.recording.sessions == (str(tmp_path / "drive.osf"),)
    assert drawn.props[0].size_m != load_scenario(path, 4).props[0].size_m
    assert drawn.props[0].size_m == load_scenario(path, 3).props[0].size_m
    dumped = drawn.model_dump(mode="json")
    assert set(dumped) == {"family", "description", "score_radius_m", "props", "recording"}
    assert GraftScenario.model_validate(dumped) == drawn
    assert isinstance(check_scenario(path), GraftScenario)


def test_a_task_of_a_plan_keeps_the_recording(tmp_path: Path) -> None:
    drawn = load_scenario(write(tmp_path, f"recording: {{sessions: [drive.osf]}}\nprops: [{BOX}]\n"), 3)
    adapter = TypeAdapter(Pair)
    for scenario in (drawn, load_scenario("smoke/one_box", 3)):
        pair = Pair("real", "real", "", 3, scenario, {}, "", ())
        assert adapter.validate_json(adapter.dump_json(pair)).scenario == scenario


def test_the_digest_of_a_recording_is_that_of_its_content(tmp_path: Path) -> None:
    drawn = load_scenario(write(tmp_path, "recording: {sessions: [drive.osf]}\n"), 3)
    first = file_digests(drawn)
    (tmp_path / "drive.osf").write_bytes(b"two")
    assert file_digests(drawn) != first
    (tmp_path / "drive.osf").unlink()
    (tmp_path / "drive.osf" / "truth").mkdir(parents=True)
    (tmp_path / "drive.osf" / "a").write_text("1")
    folder = file_digests(drawn)
    (tmp_path / "drive.osf" / "truth" / "b").write_text("the truth is no part of a recording")
    assert file_digests(drawn) == folder
    (tmp_path / "drive.osf" / "a").write_text("2")
    assert file_digests(drawn) != folder


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("recording: {sessions: [nowhere]}", r"recording.sessions.0 = 'nowhere': no such file: expected .*nowhere"),
        ("recording: {sessions: []}", "recording.sessions"),
        ("recording: {sessions: [drive.osf], splt: halves}", 'did you mean "split"'),
        ("recording: {sessions: [drive.osf], before_T_after: drive.osf}", "in one frame: leave it out"),
        ("recording: {sessions: [drive.osf, drive.osf], split: halves}", "two recordings are not split"),
        (
            "recording: {sessions: [drive.osf], trajectories: [drive.osf, drive.osf]}",
            "one for each of the 1 recordings",
        ),
        ("recording: {sessions: [drive.osf], odometry: kiss-icp, trajectories: [drive.osf]}", "both give the poses"),
        ("recording: {sessions: [drive.osf], reach_m: 0.5}", "expected more than clearance_m"),
        ("recording: {sessions: [drive.osf]}\nsensor: {mode: 512x10}", "the recording has its own: leave sensor out"),
        ("recording: {sessions: [drive.osf]}\nsim: {backend: warp}", "sim = .*: no ray of .*: leave sim out"),
        (
            "recording: {sessions: [drive.osf]}\n"
            "props: [{name: a, kind: box, size_m: [1, 1, 1], place: {posture: tipped}}]",
            "props are grafted upright",
        ),
        (
            "recording: {sessions: [drive.osf]}\nprops: [{name: a, kind: box, size_m: [1, 1, 1], place: {area: b}}]",
            "there are no areas",
        ),
    ],
)
def test_mistakes_are_told(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(ScenarioError, match=told):
        load_scenario(write(tmp_path, text), 3)


@pytest.mark.parametrize("key", ["place", "to"])
@pytest.mark.parametrize(
    ("said", "wrong", "told"),
    [
        ("between: [a, b], fraction: 0.5", "between", r"\['a', 'b'\]: a recording has no nodes: "),
        ("between: [a, b], fraction: 0.5", "fraction", "0.5: a recording has no nodes: "),
        ("lateral: 0.8", "lateral", "0.8: a recording has no walls to stand at: "),
        ("area: here", "area", "'here': in a recording there are no areas: "),
        ("posture: tipped", "posture", "'tipped': props are grafted upright: "),
    ],
)
def test_a_place_that_no_recording_has_is_refused_at_its_line(
    tmp_path: Path, key: str, said: str, wrong: str, told: str
) -> None:
    (tmp_path / "drive").mkdir()
    moved = "change: moved, to: {}" if key == "place" else "change: moved"
    prop = f"name: a, kind: box, size_m: [1, 1, 1], {moved},"
    path = write(tmp_path, f"score_radius_m: 4.5\nprops:\n  - {{{prop}\n     {key}: {{{said}}}}}\n")
    with pytest.raises(ScenarioError) as refused:
        load_grafted(path, {"sessions": [str(tmp_path / "drive")]}, 3)
    lines = str(refused.value).splitlines()
    assert len(lines) == (2 if "fraction" in said else 1)
    assert any(re.search(rf"^{re.escape(path)}:4: props\.0\.{key}\.{wrong} = {told}.*leave", line) for line in lines)
    placed: dict[str, Any] = {"name": "a", "kind": "box", "size_m": (1, 1, 1), "change": "moved", "to": {}}
    placed[key] = parse_yaml_value(f"{{{said}}}")
    with pytest.raises(ValidationError, match=rf"props\.0\.{key}\."):
        GraftScenario.model_validate({"family": "x", "props": [placed], "recording": {"sessions": ["drive"]}})


def test_a_world_of_its_own_is_refused_at_its_line(tmp_path: Path) -> None:
    text = "recording: {sessions: [drive.osf]}\nsensor: {mode: 512x10}\nmovers:\n  - {name: a, kind: person}\n"
    with pytest.raises(ScenarioError) as refused:
        load_scenario(write(tmp_path, text), 3)
    told = [line.removeprefix(f"{tmp_path}/real.yaml") for line in str(refused.value).splitlines()]
    assert told[0].startswith(":2: sensor = ") and told[0].endswith(": the recording has its own: leave sensor out")
    assert told[1].startswith(":3: movers = ") and told[1].endswith(": the recording has its own: leave movers out")
    assert not [line for line in told if line.startswith(":1:")]


def test_of_a_scenario_with_a_tunnel_the_props_count_alone(tmp_path: Path) -> None:
    (tmp_path / "drive").mkdir()
    recording = {"sessions": [str(tmp_path / "drive")]}
    drawn, whole = load_grafted("narrow", recording, 5), load_scenario("narrow", 5)
    assert [prop.name for prop in drawn.props] == [prop.name for prop in whole.props]
    assert [prop.size_m for prop in drawn.props] == [prop.size_m for prop in whole.props]
    assert all(prop.place == Place(yaw_deg=prop.place.yaw_deg) for prop in drawn.props)
    assert load_grafted("none", recording, 5).props == ()
    assert all(prop.change == "none" for prop in load_grafted("unchanged/narrow", recording, 5).props)


@pytest.mark.parametrize("form", ["{}", "one_of: [{{{}}}]"])
def test_a_point_of_a_tunnel_is_no_place_in_a_recording(tmp_path: Path, form: str) -> None:
    world = "tunnel: {nodes: {a: [0, 0, 0], b: [9, 0, 0]}, drifts: [{nodes: [a, b]}]}\nsim: {backend: warp}\n"
    places = form.format("place: {at: [2, 0, 0], yaw_deg: 30}, to: {at: [5, 0, 0]}")
    path = write(tmp_path, f"{world}props: [{{name: box, kind: box, size_m: [1, 1, 1], change: moved, {places}}}]\n")
    (box,) = load_grafted(path, {"sessions": [str(tmp_path / "drive.osf")]}, 3).props
    assert (box.place, box.to) == (Place(yaw_deg=30), Place())


@pytest.mark.parametrize("name", ["train/narrow", "train/network"])
def test_props_of_a_scenario_change_as_they_do_in_its_tunnel(tmp_path: Path, name: str) -> None:
    (tmp_path / "drive").mkdir()
    drawn, whole = load_grafted(name, {"sessions": [str(tmp_path / "drive")]}, 10001), load_scenario(name, 10001)
    changes = [(prop.name, prop.change) for prop in whole.props]
    assert [(prop.name, prop.change) for prop in drawn.props] == changes
    assert sum(change == "added" for _, change in changes) > 1


def test_a_file_with_a_recording_gives_no_props_to_another(tmp_path: Path) -> None:
    path = write(tmp_path, "recording: {sessions: [drive.osf]}\n")
    with pytest.raises(ScenarioError, match=r"real.yaml:1: recording: the file names its own"):
        load_grafted(path, {"sessions": [path]}, 3)


@pytest.mark.parametrize("name", ["pipe", "zeros", "circle", "x" * 300, f"drive.osf/{'x' * 300}"])
@pytest.mark.parametrize("key", ["sessions: [{}]", "sessions: [drive.osf, .], before_T_after: {}"])
def test_what_would_be_waited_for_is_no_file(tmp_path: Path, key: str, name: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zeros").symlink_to("/dev/zero")
    (tmp_path / "circle").symlink_to("circle")
    path = write(tmp_path, f"recording: {{{key.format(name)}}}\n")
    with pytest.raises(ScenarioError, match=r"real.yaml:1: recording\..*: no such file"):
        load_scenario(path, 3)


def test_a_file_that_becomes_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    drawn = load_scenario(write(tmp_path, "recording: {sessions: [drive.osf]}\n"), 3)
    (tmp_path / "drive.osf").unlink()
    os.mkfifo(tmp_path / "drive.osf")
    with pytest.raises(InputError, match=r"drive.osf: cannot be read \(it is a device or a pipe\)"):
        file_digests(drawn)


@pytest.mark.parametrize("props", ["5", "box", "{name: box}"])
def test_props_that_are_no_list_are_one_mistake(tmp_path: Path, props: str) -> None:
    nodes = "tunnel: {nodes: {a: [0, 0, 0], b: [9, 0, 0]}, drifts: [{nodes: [a, b]}]}"
    path = write(tmp_path, f"{nodes}\nprops: {props}\n")
    with pytest.raises(ScenarioError) as refused:
        load_grafted(path, {"sessions": [str(tmp_path / "drive.osf")]}, 0)
    assert len(str(refused.value).splitlines()) == 1
    assert f"{path}:2: props = " in str(refused.value)
