import json
import os
import time
from pathlib import Path
from typing import Any

import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.files import json_file, parse_json, read_json


@pytest.mark.parametrize("value", [{}, [], 1, -1.5, "a", None, {"a": [1, {"b": None}], "c": 2**64 - 1}])
def test_what_json_writes_is_read(value: Any) -> None:
    assert parse_json(json.dumps(value)) == parse_json(json.dumps(value).encode()) == value


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[" * 65 + "]" * 65, "nested deeper than 64 levels"),
        ('{"a":' * 65 + "1" + "}" * 65, "nested deeper than 64 levels"),
        ("[" * 100_000, "nested deeper than 64 levels|Expecting"),
        ('{"a": 1, "b": 2, "a": 3}', "the key 'a' stands there twice"),
        ('[{"a": {"x": 1, "x": 1}}]', "the key 'x' stands there twice"),
        ("[18446744073709551616]", "beyond 64 bits"),
        ("-18446744073709551616", "beyond 64 bits"),
        ("9" * 5000, "Exceeds the limit"),
        (b"\xff\xfe\x00", "decode|codec"),
        ("", "Expecting value"),
    ],
)
def test_what_no_reader_can_use_is_refused(text: str | bytes, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        parse_json(text)


def test_a_key_that_stands_twice_is_found_at_once_among_many() -> None:
    names = [*map(str, range(100_000)), "last", "last"]
    start_s = time.process_time()
    with pytest.raises(ValueError, match="the key 'last' stands there twice"):
        parse_json("{" + ",".join(f'"{name}":0' for name in names) + "}")
    assert time.process_time() - start_s < 10.0  # 0.1 s; 130 s where each name is counted among all


def test_values_are_counted_at_all_levels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(json_file, "MAX_VALUES", 6)
    assert parse_json('{"a": [1, 2], "b": [{"c": 3}]}')["b"] == [{"c": 3}]
    with pytest.raises(ValueError, match="more than 6 values"):
        parse_json('{"a": [1, 2, 4], "b": [{"c": 3}]}')


def test_64_levels_are_read() -> None:
    assert parse_json("[" * 64 + "]" * 64)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_undefined_numbers_are_refused_where_none_may_be(number: str) -> None:
    assert isinstance(parse_json(f'{{"a": [{number}]}}')["a"][0], float)
    with pytest.raises(ValueError, match=r"a number is .*, no finite number"):
        parse_json(f'{{"a": [{number}]}}', is_finite=True)


def test_a_file_is_bounded_in_size_before_it_is_read(tmp_path: Path) -> None:
    with (tmp_path / "a.json").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(InputError, match=r"a\.json: 1099512 MB, more than the 24 MB it may have: expected a plan"):
        read_json(tmp_path / "a.json", "expected a plan")


def test_a_pipe_and_a_folder_are_no_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="it is a device or a pipe"):
        read_json(tmp_path / "pipe", "expected a plan")
    with pytest.raises(InputError, match="it is a folder"):
        read_json(tmp_path, "expected a plan")
    with pytest.raises(InputError, match="missing: expected a plan"):
        read_json(tmp_path / "none", "expected a plan")
    with pytest.raises(InputError, match="cannot be read"):
        read_json(tmp_path / "a\0b", "expected a plan")
