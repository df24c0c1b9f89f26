import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from eval.plans.plan import load_plan
from eval.running.runfolder import RunFolder
from eval.running.stages import pair_stages
from scenarios.schema import Scenario
from tests.eval.running.runs import ONE_BOX, UNCHANGED, Runner, load_small


@pytest.fixture(scope="module")
def pairs(simulated_once: Callable[[Scenario, int], Path]) -> dict[str, Path]:
    """Both smoke scenarios, thinned out and simulated once; every test works on copies."""
    return {name: simulated_once(load_small(name, 20000), 20000) for name in (ONE_BOX, UNCHANGED)}


@pytest.fixture
def runner(pairs: dict[str, Path]) -> Runner:
    return Runner(pairs)


@pytest.fixture
def timed_as_usual(usual_repeat_below_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Repeat short stages for the clock, as users' runs do."""
    monkeypatch.setattr(pair_stages, "REPEAT_BELOW_S", usual_repeat_below_s)


@pytest.fixture(scope="module")
def smoke(pairs: dict[str, Path], tmp_path_factory: pytest.TempPathFactory, usual_repeat_below_s: float) -> RunFolder:
    """The smoke plan, run once end to end and timed as users' runs are."""
    folder = tmp_path_factory.mktemp("smoke") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pair_stages, "REPEAT_BELOW_S", usual_repeat_below_s)
        return Runner(pairs).run(folder, load_plan("smoke"), command=["tunnelcd", "run", "a b"])[0]


@pytest.fixture
def smoke_copy(smoke: RunFolder, tmp_path: Path) -> RunFolder:
    shutil.copytree(smoke.path, tmp_path / "run")
    return RunFolder(tmp_path / "run")
