"""What all tests share: pairs and training data that one test run makes once; runs that call a stage once."""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from filelock import FileLock

from scenarios.schema import Scenario
from sim.session.simulate import simulate_pair

if TYPE_CHECKING:
    from eval.training.dataset import Recipe

# Seconds of long files: with `--no-loadscope-reorder` of pytest-xdist they begin first, and none is left for the end.
LONG_S = {
    "tests/test_readme.py": 136,
    "tests/eval/running/test_distributed.py": 125,
    "tests/eval/report/test_page.py": 120,
    "tests/eval/running/test_runner.py": 102,
    "tests/eval/cli/test_cli.py": 83,
    "tests/eval/running/test_worlds_of_a_run.py": 72,
    "tests/eval/training/test_dataset.py": 58,
    "tests/eval/plans/test_sensor_plan.py": 46,
    "tests/eval/running/stages/test_stage_cache.py": 46,
    "tests/eval/running/test_predictions.py": 45,
    "tests/eval/training/test_training_run.py": 45,
    "tests/eval/plans/test_targets.py": 37,
}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests of long files first, the longest before the others; else the order stays."""
    items.sort(key=lambda item: -LONG_S.get(item.nodeid.partition("::")[0], 0))


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], None]], Path]:
    """Return a function that gives the folder of a key, and lets `make` write it if nobody did yet.

    The processes of one test run (pytest-xdist) share the folder, so a test must copy what it changes.
    """
    base = tmp_path_factory.getbasetemp()
    shared = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "made"
    shared.mkdir(exist_ok=True)

    def get(key: str, make: Callable[[Path], None]) -> Path:
        folder = shared / hashlib.sha256(key.encode()).hexdigest()[:16]
        with FileLock(f"{folder}.lock"):
            if not folder.exists():
                partial = folder.with_suffix(".partial")
                shutil.rmtree(partial, ignore_errors=True)
                make(partial)
                partial.rename(folder)
        return folder

    return get


@pytest.fixture(scope="session")
def simulated_once(made_once: Callable[[str, Callable[[Path], None]], Path]) -> Callable[[Scenario, int], Path]:
    """Return a function that gives the folder of a pair, by its scenario as drawn and its seed: see `made_once`."""

    def get(scenario: Scenario, seed: int) -> Path:
        drawn = json.dumps([scenario.model_dump(mode="json"), seed], sort_keys=True)
        return made_once(drawn, lambda out: simulate_pair(scenario, seed, out))

    return get


@pytest.fixture(scope="session")
def shards_once(made_once: Callable[[str, Callable[[Path], None]], Path]) -> Callable[..., list[bytes]]:
    """Return a function that gives what `make_shards` gives, and calls it if nobody did yet: see `made_once`."""
    dataset = importlib.import_module("eval.training.dataset")  # few tests need it

    def get(family: str, seed: int, recipe: Recipe) -> list[bytes]:
        def make(out: Path) -> None:
            out.mkdir()
            for number, content in enumerate(dataset.make_shards(family, seed, recipe)):
                (out / f"{number:03d}").write_bytes(content)

        folder = made_once(json.dumps(["shards", family, seed, recipe.document()]), make)
        return [path.read_bytes() for path in sorted(folder.iterdir())]

    return get


@pytest.fixture(scope="session")
def usual_repeat_below_s() -> Iterator[float]:
    """Let every run of this process call a stage once, because further calls are for the clock alone.

    Yields the time below which users' runs repeat a stage, for the tests of these times. Processes that a test starts
    repeat as usual.
    """
    stages = importlib.import_module("eval.running.stages.pair_stages")  # needs torch
    with pytest.MonkeyPatch.context() as patch:
        usual: float = stages.REPEAT_BELOW_S
        patch.setattr(stages, "REPEAT_BELOW_S", 0.0)
        yield usual
