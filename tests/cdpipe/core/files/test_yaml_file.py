import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import yaml

from cdpipe.core.errors import InputError
from cdpipe.core.files import YamlError, dump_yaml, parse_yaml, parse_yaml_value, yaml_file
from cdpipe.core.yamlfile import read_yaml

_LETTERS = "abcdefghi"
_BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n" for before, name in pairwise(_LETTERS)
)


@pytest.mark.parametrize("text", ["", "a: 1", "[1, 2.5, off, ~, 0x10, 2020-01-01, '1']", "a: &x {b: 1}\nc: *x\n", "a"])
def test_what_yaml_reads_is_read(text: str) -> None:
    assert parse_yaml_value(text) == yaml.safe_load(text)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e5", 1e5), ("1e-3", 1e-3), ("-2E+3", -2e3), ("1.5e3", 1.5e3), (".5e1", 5.0), ("1.e2", 100.0),
        ("[1e5, '1e5', \"1e5\"]", [1e5, "1e5", "1e5"]), ("!!str 1e5", "1e5"), ("1e", "1e"), ("e5", "e5"),
        ("1e5m", "1e5m"), ("0x1e5", 0x1E5), ("1_0e5", "1_0e5"), ("a: |\n  1e5", {"a": "1e5"}), ("1e999", math.inf),
    ],
)  # fmt: skip
def test_a_number_with_an_exponent_is_a_number(text: str, value: object) -> None:
    assert parse_yaml_value(text) == value and type(parse_yaml_value(text)) is type(value)
    assert parse_yaml_value(dump_yaml(value)) == value


def test_aliases_are_copies(tmp_path: Path) -> None:
    value = parse_yaml_value("a: &x [1]\nb: *x\n")
    assert value["a"] == value["b"] and value["a"] is not value["b"]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("&a [*a]", "nested deeper than 64 levels"),
        ("a: &a {b: *a}", "nested deeper than 64 levels"),
        ("&a [*a, *a]", "nested deeper than 64 levels"),
        (_BOMB, "more than 40000 values"),
        ("[" * 100_000, "nested deeper than 64 levels"),
        ("- " * 5_000 + "1", "nested deeper than 64 levels"),
        ("a: " + "x" * 500_000, "0.5 MB, more than the 0.5 MB it may have"),
        ("a: " + "9" * 5000, "too long for a number"),
        ("a: 1" + ":1" * 50_000, "too long for a number"),
        ("a: 99999999999999999999", "beyond 64 bits"),
        (r'a: "\ud800"', "half of a surrogate pair"),
        (r'"\ud800": 1', "half of a surrogate pair"),
        ('!!int ""', "string index out of range"),
        ("!!timestamp x", "groupdict"),
        ("!!bool x", "'x'"),
        ("a: !!python/name:os.system", "could not determine a constructor"),
        ("? [a]\n: 1", "a key must be a word or a number"),
        ("a: *b", "undefined alias"),
        ("a: 1\nb: 2\na: 3", "a: the key is here a second time"),
        ("'\0'", "special characters are not allowed"),
    ],
)
def test_what_no_reader_can_use_is_refused_at_once(text: str, told: str) -> None:
    with pytest.raises(YamlError, match=told) as caught:
        parse_yaml_value(text)
    assert "\n" not in str(caught.value)


def test_no_more_nodes_are_composed_than_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(yaml_file, "MAX_VALUES", 100)
    assert len(parse_yaml_value("- 1\n" * 99)) == 99
    for n_items in (100, 300):
        with pytest.raises(YamlError, match="more than"):
            parse_yaml_value("- 1\n" * n_items)


def test_a_file_says_the_line(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("b: 1\na: &a\n  - *a\n")
    with pytest.raises(InputError, match=r"a\.yaml:2: not YAML: nested deeper than 64 levels"):
        read_yaml(tmp_path / "a.yaml")
    (tmp_path / "a.yaml").write_bytes(b"a: \xff")
    with pytest.raises(InputError, match=r"a\.yaml: not YAML: .*codec"):
        read_yaml(tmp_path / "a.yaml")
    with (tmp_path / "a.yaml").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(InputError, match=r"a\.yaml: .* MB, more than"):
        read_yaml(tmp_path / "a.yaml")


def test_messages_are_short() -> None:
    name = "a" * 10_000
    for text in (f"!<{name}> 1", f"*{name}", f"{name[:900]}: 1\n{name[:900]}: 1"):
        with pytest.raises(YamlError) as caught:
            parse_yaml_value(text)
        assert len(str(caught.value)) < 300


def test_each_key_has_its_line() -> None:
    parsed: Any = parse_yaml("a:\n  b: [1,\n   2]\n")
    assert parsed.lines[("a", "b")] == 2 and parsed.lines[("a", "b", 1)] == 3
