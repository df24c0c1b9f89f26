import shutil
from pathlib import Path

import pytest
import trimesh

from cdpipe.core.errors import InputError
from eval.cli.commands.tools import check_file


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("tunel: {}\nbefore: {route: [a, b]}\nafter: {route: [a, b]}\n", 'did you mean "tunnel"'),
        ("name: x\nscenario: [smoke/one_box]\nseeds: '0:1'\nvariants: [{preset: paper}]\n", 'did you mean "scenarios"'),
        ("qery: {radius_m: 4}\n", 'did you mean "query"'),
    ],
)
def test_a_misspelt_key_does_not_change_what_a_file_is(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        check_file(str(path))
    assert said in str(caught.value)


def test_the_meshes_that_a_scenario_names_are_opened(tmp_path: Path) -> None:
    prop = "{name: sign, kind: mesh, change: none, mesh: {path: %s}, place: {between: [start, bend], fraction: 0.5}}"
    text = "extends: smoke/one_box\nprops:\n" + "".join(f"  - {prop % name}\n" for name in ("good.stl", "bad.stl"))
    path = tmp_path / "mine.yaml"
    path.write_text(text.replace("name: sign", "name: other", 1))
    trimesh.creation.box(extents=(0.6, 0.5, 0.4)).export(tmp_path / "good.stl")
    (tmp_path / "bad.stl").write_text("no mesh")
    with pytest.raises(InputError) as caught:
        check_file(str(path))
    (line,) = str(caught.value).splitlines()
    assert line.startswith(f"{path}: props.sign.mesh: ") and "bad.stl: no triangles in it" in line
    trimesh.creation.box(extents=(600, 500, 400)).export(tmp_path / "bad.stl")
    with pytest.raises(InputError, match="units: "):
        check_file(str(path))
    shutil.copy(tmp_path / "good.stl", tmp_path / "bad.stl")
    assert check_file(str(path)) == "a scenario"


def test_files_of_props_and_scenarios_in_a_recording_are_checked(tmp_path: Path) -> None:
    props = "props:\n  - {name: box, kind: box, size_m: [0.9, 0.7, 0.8], change: added}\n"
    (tmp_path / "props.yaml").write_text(props)
    assert check_file(str(tmp_path / "props.yaml")) == "a file of props and rock for `graft --objects`"
    (tmp_path / "drive.osf").write_bytes(b"x")
    (tmp_path / "scenario.yaml").write_text("recording: {sessions: [drive.osf]}\n" + props)
    assert check_file(str(tmp_path / "scenario.yaml")) == "a scenario"
    (tmp_path / "props.yaml").write_text(props.replace("kind: box", "kind: bx"))
    with pytest.raises(InputError, match=r"props\.yaml:2: props\.0\.kind = 'bx': .* did you mean \"box\"\?$"):
        check_file(str(tmp_path / "props.yaml"))


@pytest.mark.parametrize(("name", "kind"), [("smoke", "plan"), ("narrow", "scenario"), ("paper-topn", "preset")])
def test_shipped_names_are_known(name: str, kind: str) -> None:
    assert f"a {kind}" in check_file(name)


def test_a_file_that_is_not_there_says_what_was_expected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.yaml: no such file: expected a plan, a scenario or a preset"):
        check_file(str(tmp_path / "none.yaml"))
