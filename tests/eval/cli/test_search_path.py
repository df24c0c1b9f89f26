"""Files on `TUNNELCD_PATH` that are no YAML files: one line each, nothing is waited for."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.plugins import SEARCH_PATH
from cdpipe.core.yamlfile import read_head_comment
from cdpipe.model.config import load_config, preset_files
from eval.cli.listing import list_entries
from eval.plans.files import read_plan
from scenarios.catalogue import clean_family

Spoil = Callable[[Path], object]


def _no_utf8(path: Path) -> None:
    path.write_bytes(b"# caf\xe9\n")


def _too_large(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 40)


SPOILED: list[Spoil] = [_no_utf8, _too_large, Path.mkdir]
if sys.platform != "win32":
    SPOILED.append(os.mkfifo)
READERS = {
    "presets": (lambda: load_config("my_own"), lambda: list_entries("presets"), lambda: read_head_comment(_preset())),
    "plans": (lambda: read_plan("my_own"), lambda: list_entries("plans")),
}


def _preset() -> Path:
    return Path(str(preset_files()["my_own"]))


@pytest.mark.parametrize("spoil", SPOILED)
@pytest.mark.parametrize("kind", READERS)
def test_what_is_no_yaml_is_one_line(kind: str, spoil: Spoil, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / kind).mkdir()
    spoil(tmp_path / kind / "my_own.yaml")
    monkeypatch.setenv(SEARCH_PATH, str(tmp_path))
    for read in READERS[kind]:
        with pytest.raises(InputError, match=r"^\S*my_own\.yaml: [^\n]+$"):
            read()


@pytest.mark.parametrize("content", ["", "[a, b]\n", "word\n"])
def test_a_file_without_keys_has_no_description(content: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in ("plans", "families", "families/dust"):
        (tmp_path / kind).mkdir()
        (tmp_path / kind / "my_own.yaml").write_text(content)
    monkeypatch.setenv(SEARCH_PATH, str(tmp_path))
    for kind in ("plans", "scenarios"):
        assert [entry.description for entry in list_entries(kind) if entry.name == "my_own"] == [""]
    assert clean_family("dust/my_own") is None
