import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from eval.plans.plan import load_plan
from eval.running.runfolder import RunFolder
from scenarios.schema import Scenario
from tests.eval.running.runs import ONE_BOX, UNCHANGED, Runner, load_small


@pytest.fixture(scope="module")
def pairs(simulated_once: Callable[[Scenario, int], Path]) -> dict[str, Path]:
    """Both smoke scenarios, thinned out and simulated once; every test works on copies."""
    return {name: simulated_once(load_small(name, 20000), 20000) for name in (ONE_BOX, UNCHANGED)}


@pytest.fixture
def runner(pairs: dict[str, Path]) -> Runner:
    return Runner(pairs)


@pytest.fixture(scope="module")
def smoke(pairs: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """The smoke plan, run once end to end."""
    folder = tmp_path_factory.mktemp("smoke") / "run"
    return Runner(pairs).run(folder, load_plan("smoke"), command=["tunnelcd", "run", "a b"])[0]


@pytest.fixture
def smoke_copy(smoke: RunFolder, tmp_path: Path) -> RunFolder:
    shutil.copytree(smoke.path, tmp_path / "run")
    return RunFolder(tmp_path / "run")
