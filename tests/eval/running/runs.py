"""Runs of small plans on copies of two smoke pairs, which are simulated once."""

import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from eval.core.terminal.progress import Silent
from eval.plans.plan import Plan, load_plan
from eval.running.pair_run import Tools
from eval.running.runfolder import RunFolder, start_run_folder
from eval.running.runner import RunOutcome, run_plan
from scenarios.library import load_scenario
from scenarios.references import file_digests
from scenarios.schema import Scenario
from sim.session.truth import read_pair_truth, write_pair_truth

ONE_BOX, UNCHANGED = "smoke/one_box", "smoke/unchanged"
VARIANTS = ["paper", "tunnelcd", "voxel-diff", "random-regions"]
MAPLESS = "{preset: tunnelcd, set: [map.max_range_m=0.1]}"  # no return is so near
# a quarter of the returns: these tests are about what is run, not about how well
SMALL = ("sensor.mode=512x10", "platform.scan_spacing_m=1.0")


def load_small(name: str, seed: int, settings: Iterable[str] = ()) -> Scenario:
    return load_scenario(name, seed, [*SMALL, *settings])


class Runner:
    """Runs plans on copies of the pairs instead of simulating them.

    Attributes:
        asked: The scenarios that were to be simulated, in order.
        tools: What `run` gives to the run; other tools copy pairs too if they are made from these.
    """

    def __init__(self, pairs: dict[str, Path]) -> None:
        self._pairs = pairs
        self.asked: list[Scenario] = []
        self.tools = Tools(draw=load_small, simulate=self._copy)

    def run(self, folder: Path, plan: Plan, **options: Any) -> tuple[RunFolder, RunOutcome]:
        run = start_run_folder(folder)
        return run, run_plan(plan, run, **{"tools": self.tools, **options})

    def families(self) -> list[str]:
        return [scenario.family for scenario in self.asked]

    def _copy(self, scenario: Scenario, seed: int, out: Path, on_stage: object) -> None:
        """Copy a pair, and write down what was asked for, as the simulator does."""
        self.asked.append(scenario)
        assert seed == 20000
        shutil.copytree(self._pairs[scenario.family], out)
        drawn, files = scenario.model_dump(mode="json"), file_digests(scenario)
        write_pair_truth(out, replace(read_pair_truth(out), seed=seed, scenario=drawn, files=files))


def plan_of(folder: Path, *, scenarios: str = ONE_BOX, variants: str = "{preset: voxel-diff}", rest: str = "") -> Plan:
    path = folder / "plan.yaml"
    path.write_text(f"name: test\nscenarios: [{scenarios}]\nseeds: [20000]\nvariants: [{variants}]\n{rest}")
    return load_plan(str(path))


def table(run: RunFolder, name: str = "results") -> pd.DataFrame:
    return pd.read_csv(run.path / f"{name}.csv", keep_default_na=True)


class Told(Silent):
    """Remembers which stages were begun."""

    def __init__(self) -> None:
        self.stages: list[str] = []

    def stage(self, name: str, done: int, total: int) -> None:
        self.stages.append(name)
