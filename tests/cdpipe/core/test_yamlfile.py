from pathlib import Path

import numpy as np
import pytest
from pydantic import Field

from cdpipe.core.errors import InputError
from cdpipe.core.yamlfile import Document, Settings, apply_settings, read_yaml, setting_lines, validate


class Ball(Settings):
    radius_m: float = Field(gt=0)
    colour: str = "red"


class Box(Settings):
    name: str
    balls: tuple[Ball, ...] = ()
    spare: Ball | None = None


def test_all_mistakes_are_told_at_once_by_line() -> None:
    text = (
        "name: 3\nballs:\n  - radius_m: 1\n  - radius: 2\n    colour: blue\n  - radius_m: -1\n  - color: blue\n"
        "spares: {}\n"
    )
    with pytest.raises(InputError) as caught:
        validate(Box, read_yaml(Path("box.yaml"), text))
    lines = str(caught.value).splitlines()
    heads = {
        "box.yaml:1: name = 3: ": "",
        "box.yaml:4: balls.1.radius = 2: ": '"radius_m"',  # and not that radius_m is missing
        "box.yaml:6: balls.2.radius_m = -1: ": "greater than 0",
        "box.yaml:7: balls.3.color = 'blue': ": '"colour"',
        "box.yaml:7: balls.3.radius_m: missing": "",
        "box.yaml:8: spares = {}: ": '"spare"',
    }
    assert len(lines) == len(heads)
    for head, hint in heads.items():
        assert any(line.startswith(head) and hint in line for line in lines), head


def test_a_list_and_keys_with_values_are_asked_for_in_the_words_of_a_file() -> None:
    text = "name: a\nballs: {radius_m: 1}\nspare: 3\n"
    with pytest.raises(InputError) as caught:
        validate(Box, read_yaml(Path("box.yaml"), text))
    balls, spare = str(caught.value).splitlines()
    assert "expected a list, such as [a, b]" in balls and "expected keys with values, such as {key: value}" in spare


def test_an_empty_file_is_called_so() -> None:
    with pytest.raises(InputError, match=r"^box\.yaml: expected keys and values, got nothing in it$"):
        validate(Box, read_yaml(Path("box.yaml"), ""))


def test_mistakes_without_end_are_counted() -> None:
    text = "name: x\n" + "".join(f"unknown{number}: 1\n" for number in range(1000))
    with pytest.raises(InputError) as caught:
        validate(Box, read_yaml(Path("a.yaml"), text))
    lines = str(caught.value).split("\n")
    assert len(lines) == 101 and lines[-1] == "a.yaml: and 900 more mistakes"
    with pytest.raises(InputError, match=r"^a\.json: 50003 mistakes: is it another kind of file\?$"):
        validate(Box, Document("a.json", {str(number): 1 for number in range(50_002)}))


def test_settings_are_written_over_the_file() -> None:
    document = read_yaml(Path("box.yaml"), "name: a\nspare: {radius_m: 1}\n")
    box = validate(Box, apply_settings(document, ["spare.radius_m=2.5", "name=b"]))
    assert box.spare is not None
    assert (box.name, box.spare.radius_m) == ("b", 2.5)
    assert document.value == {"name": "a", "spare": {"radius_m": 1}}


def test_an_item_of_a_list_goes_by_its_name() -> None:
    text = "props:\n  - {name: crate, size: {x: 1}}\n  - {name: barrel}\n"
    changed = apply_settings(read_yaml(Path("a.yaml"), text), ["props.barrel.size.x=2", "props.crate.size.x=3"])
    assert changed.value == {"props": [{"name": "crate", "size": {"x": 3}}, {"name": "barrel", "size": {"x": 2}}]}
    assert changed.where(("props", 0, "size", "x")) == changed.where(("props", 1, "size")) == "--set"
    assert changed.where(("props", 0, "name")) == "a.yaml:2"
    with pytest.raises(InputError, match=r"called 'barel'; did you mean \"barrel\"\?"):
        apply_settings(changed, ["props.barel.size.x=2"])
    with pytest.raises(InputError, match="props is a list: name an item and one of its keys"):
        apply_settings(changed, ["props.barrel=2"])


@pytest.mark.parametrize(
    ("setting", "message"),
    [("name", "expected key=value"), ("name.first=1", "name is a value"), ("name=[1", "not YAML")],
)
def test_bad_settings_are_named(setting: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        apply_settings(read_yaml(Path("box.yaml"), "name: a\n"), [setting])


@pytest.mark.parametrize(
    ("text", "message"),
    [("a: [1\n", "box.yaml:2: not YAML"), ("a: 1\na: 2\n", "box.yaml:2: a: ")],
)
def test_files_that_are_not_one_mapping(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_yaml(Path("box.yaml"), text)


@pytest.mark.parametrize("text", ["a: !foo b\n", "a: \x07\n", "{[1]: 2}\n", "a: 2020-13-45\n"])
def test_yaml_that_only_looks_like_yaml(text: str) -> None:
    with pytest.raises(InputError, match=r"box\.yaml.*: not YAML"):
        read_yaml(Path("box.yaml"), text)


def test_a_file_that_is_no_text(tmp_path: Path) -> None:
    (tmp_path / "box.yaml").write_bytes(b"name: \xff\xfe\n")
    with pytest.raises(InputError, match=r"box\.yaml: not YAML"):
        read_yaml(tmp_path / "box.yaml")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.yaml: "):
        read_yaml(tmp_path / "nowhere.yaml")


def test_a_list_is_not_a_file_of_settings() -> None:
    with pytest.raises(InputError, match="got list"):
        validate(Box, read_yaml(Path("box.yaml"), "- 1\n"))


@pytest.mark.parametrize(
    ("text", "told"), [("", "nothing in it"), ("# a comment\n", "nothing in it"), ("- a\n", "list")]
)
@pytest.mark.parametrize("setting", ["name=a", "spare.radius_m=6"])
def test_settings_need_a_file_with_keys(text: str, told: str, setting: str) -> None:
    with pytest.raises(InputError, match=rf"^box\.yaml: expected keys and values, got {told}$"):
        apply_settings(read_yaml(Path("box.yaml"), text), [setting])


def test_settings_may_be_paths_and_numbers_of_numpy() -> None:
    given = {
        "file": Path("a b/w.safetensors"), "n": np.int64(3), "on": np.bool_(True), "m": np.float32(0.5),
        "group": {"list": [np.int8(1), Path("x")]},
    }  # fmt: skip
    values = apply_settings(Document("a", {}), setting_lines(given)).value
    assert values == {"file": "a b/w.safetensors", "n": 3, "on": True, "m": 0.5, "group": {"list": [1, "x"]}}
    loop: list[object] = []
    loop.append(loop)
    for wrong in (object(), {1}, loop, 1j):
        with pytest.raises(InputError, match=r"^setting group\.n = .*: expected [^\n]*$"):
            setting_lines({"group": {"n": wrong}})
