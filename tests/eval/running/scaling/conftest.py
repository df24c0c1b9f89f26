"""Runs of a plan of six pairs on copies of two tiny ones, merged by the truth: nothing is simulated."""

import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cdpipe.core.names import path_part
from cdpipe.core.threads import fix_threads
from eval.plans.plan import Plan, load_plan
from eval.running.pair_run import Tools
from eval.running.runfolder import RunFolder, start_run_folder
from eval.running.runner import RunOutcome, run_plan
from eval.running.scaling.shards import Shard
from scenarios.library import load_scenario
from scenarios.references import file_digests
from scenarios.schema import Scenario
from sim.session.truth import read_pair_truth, write_pair_truth
from tests.eval.conftest import write_pair

WORLDS = ("smoke/one_box", "smoke/unchanged")
VARIANT = "oracle-merge[preset=voxel-diff]"
SEEDS = (20000, 20001, 20002)
SMALL = ("sensor.mode=512x10", "platform.scan_spacing_m=1.0")
PLAN = """\
name: six
scenarios: [smoke/one_box, smoke/unchanged]
seeds: "20000:20003"
report: [regions]
variants: [{preset: voxel-diff, oracle_merge: {}}, {preset: random-regions, oracle_merge: {}}]
"""


def load_small(name: str, seed: int, settings: Iterable[str] = ()) -> Scenario:
    return load_scenario(name, seed, [*SMALL, *settings])


class Runner:
    """Runs plans on copies of the pairs instead of simulating them.

    Attributes:
        asked: World and seed of every pair that was to be simulated.
    """

    def __init__(self, pairs: dict[str, Path]) -> None:
        self._pairs = pairs
        self.asked: list[tuple[str, int]] = []
        self.tools = Tools(draw=load_small, simulate=self.copy, commit=lambda: "c0ffee", now=lambda: "2026-11-26")

    def run(self, folder: Path, plan: Plan, **options: Any) -> tuple[RunFolder, RunOutcome]:
        run = start_run_folder(folder)
        return run, run_plan(plan, run, **{"tools": self.tools, **options})

    def copy(self, scenario: Scenario, seed: int, out: Path, on_stage: object) -> None:
        self.asked.append((scenario.family, seed))
        shutil.copytree(self._pairs[scenario.family], out)
        drawn, files = scenario.model_dump(mode="json"), file_digests(scenario)
        write_pair_truth(out, replace(read_pair_truth(out), seed=seed, scenario=drawn, files=files))


@pytest.fixture(scope="session", name="pairs")
def pairs_fixture(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    fix_threads()  # as the command line does: provenance tells of them
    folder = tmp_path_factory.mktemp("tiny")
    changed = {name: name == WORLDS[0] for name in WORLDS}
    return {name: write_pair(folder / path_part(name), has_changes=has) for name, has in changed.items()}


@pytest.fixture(name="runner")
def runner_fixture(pairs: dict[str, Path]) -> Runner:
    return Runner(pairs)


@pytest.fixture(scope="session", name="plan")
def plan_fixture(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    path = tmp_path_factory.mktemp("plan") / "six.yaml"
    path.write_text(PLAN)
    return load_plan(str(path))


@pytest.fixture(scope="session", name="whole")
def whole_fixture(pairs: dict[str, Path], plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The plan, run undivided."""
    return Runner(pairs).run(tmp_path_factory.mktemp("whole") / "run", plan)[0].path


@pytest.fixture(scope="session", name="shards")
def shards_fixture(pairs: dict[str, Path], plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The plan, run in three shards."""
    folder, runner = tmp_path_factory.mktemp("shards"), Runner(pairs)
    shards = [runner.run(folder / str(k), plan, shard=Shard(k, 3))[0].path for k in (1, 2, 3)]
    assert sorted(runner.asked) == sorted((world, seed) for world in WORLDS for seed in SEEDS)  # none twice
    return shards
