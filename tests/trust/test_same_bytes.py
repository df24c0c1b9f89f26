"""The same input gives the same bytes: in another folder, locale, time zone, with other threads, for another user.

Workers and clusters are compared in `tests/eval/running/test_distributed.py`, `tests/eval/training/test_dataset.py` and
`tests/soak`, the threads of the simulator in `tests/sim/session/test_simulate.py`.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from cdpipe.core.threads import THREAD_VARIABLES
from tests.trust.contents import contents

ROOT = Path(__file__).parents[2]
SCENARIO = """\
# Ein Stollen, grob abgetastet: ein Viertel der Strahlen, die Hälfte der Umdrehungen
extends: smoke/one_box
description: Stollen mit Kiste, für ΔT und 日本
sensor: {mode: 512x10}
platform: {scan_spacing_m: 1.0}
"""
# What a place changes of the environment; PYTHONUTF8=0 lets the locale decide how text is read and written.
PLACES: dict[str, Mapping[str, str]] = {
    "again": {},
    "threads": dict.fromkeys(THREAD_VARIABLES, "2"),
    "hash seed": {"PYTHONHASHSEED": "7"},
    "time zone": {"TZ": "Pacific/Kiritimati"},
    "home": {"HOME": "/nowhere"},
    "ascii": {"LC_ALL": "C", "PYTHONUTF8": "0"},
    "german": {"LC_ALL": "de_DE", "PYTHONUTF8": "0"},
    "turkish": {"LC_ALL": "tr_TR", "PYTHONUTF8": "0"},
}
EVERYTHING = {name: value for place in PLACES.values() for name, value in place.items()}


@dataclass(frozen=True)
class Chain:
    """A process that runs `chain.py`, and its working folder."""

    folder: Path
    process: subprocess.Popen[str]

    def files(self) -> dict[str, Any]:
        """Wait for its end; return the content of every file that it wrote, by its name."""
        _, told = self.process.communicate(timeout=300)
        assert self.process.returncode == 0, told
        return contents(self.folder)


@pytest.fixture(scope="module", name="locales")
def locales_fixture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two locales with character sets of one byte, for `LOCPATH`; none where the system cannot make them."""
    folder = tmp_path_factory.mktemp("locales")
    for name, charset in (("de_DE", "ISO-8859-1"), ("tr_TR", "ISO-8859-9")):
        if shutil.which("localedef"):
            subprocess.run(["localedef", "-i", name, "-f", charset, folder / name], check=False, capture_output=True)
    return folder


@pytest.fixture(scope="module", name="start_chain")
def start_chain_fixture(tmp_path_factory: pytest.TempPathFactory, locales: Path) -> Callable[..., Chain]:
    """Return a function that starts the chain in a new folder."""
    scenario = tmp_path_factory.mktemp("scenario") / "stollen.yaml"
    scenario.write_text(SCENARIO, encoding="utf-8")

    def start(place: Mapping[str, str], umask: int = 0o022) -> Chain:
        folder = tmp_path_factory.mktemp("somewhere")
        usual = {**dict.fromkeys(THREAD_VARIABLES, "1"), "PYTHONPATH": str(ROOT), "LOCPATH": str(locales)}
        argv = [sys.executable, ROOT / "tests" / "trust" / "chain.py", scenario]
        environment = {**os.environ, **usual, **place}
        streams = {"stderr": subprocess.PIPE, "text": True, "errors": "replace"}
        return Chain(folder, subprocess.Popen(argv, cwd=folder, env=environment, umask=umask, **streams))

    return start


@pytest.fixture(scope="module", name="usual")
def usual_fixture(start_chain: Callable[..., Chain]) -> Chain:
    return start_chain({})


@pytest.mark.parametrize(
    "place",
    [
        pytest.param(EVERYTHING, id="all at once"),
        # which of them it was
        *(pytest.param(place, id=name, marks=pytest.mark.soak) for name, place in PLACES.items()),
    ],
)
def test_the_place_does_not_matter(start_chain: Callable[..., Chain], usual: Chain, place: Mapping[str, str]) -> None:
    other = start_chain(place, 0o077)
    ours, theirs = usual.files(), other.files()
    assert sorted(ours) == sorted(theirs)
    assert {"pair/truth/changes.json", "answer/answer.npz", "row.txt"} < set(ours)
    assert {"sphere/sphere.safetensors", "place/3deg.safetensors", "net/range-net.safetensors"} < set(ours)
    assert [name for name in ours if ours[name] != theirs[name]] == []
