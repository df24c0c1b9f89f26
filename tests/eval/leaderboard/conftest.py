"""Evaluations of small scripts on tiny pairs that stand for those of plan `smoke`: nothing is simulated."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from eval.leaderboard.command import parse_command
from eval.leaderboard.evaluation import EvaluationOutcome, Method, evaluate_command
from eval.plans.plan import Plan, load_plan
from eval.running.pair_run import Tools
from eval.running.runfolder import RunFolder, start_run_folder
from scenarios.library import load_scenario
from scenarios.schema import Scenario
from sim.session.truth import read_pair_truth, write_pair_truth
from tests.eval.conftest import write_pair

# answers with the merge that it is given, and one region where nothing is
GOOD = """
import json, sys
import numpy as np
from pathlib import Path
before, after, out, merge = map(Path, sys.argv[1:5])
answer = {"format": "tunnelcd-answer", "format_version": 1, "status": "ok", "method": "x", "radius_m": 2.0}
answer |= {"before_T_after": json.loads(merge.read_text())["before_T_after"], "seconds": {"t_cd_s": 0.5}}
(out / "answer.json").write_text(json.dumps(answer))
np.savez(out / "answer.npz", region_centres_map=[[90.0, 0, 0]], region_scores=[1.0])
"""


def simulate(scenario: Scenario, seed: int, out: Path, on_stage: object) -> None:
    write_pair(out)
    drawn = scenario.model_dump(mode="json")
    write_pair_truth(out, replace(read_pair_truth(out), seed=seed, scenario=drawn))


TOOLS = Tools(draw=load_scenario, simulate=simulate)


class Evaluator:
    """Evaluates a script in a folder of its own.

    Attributes:
        run: The run folder.
        script: The file of the script.
        plan: Two pairs, one for each scenario of `smoke`.
    """

    def __init__(self, folder: Path) -> None:
        self.run = start_run_folder(folder / "run")
        self.script = folder / "script.py"
        self.plan: Plan = load_plan("smoke")

    def evaluate(self, text: str = GOOD, name: str = "mine", **options: Any) -> EvaluationOutcome:
        self.script.write_text(text)
        limit_s = options.pop("limit_s", 60.0)
        command = parse_command(
            f"{sys.executable} {self.script} {{before}} {{after}} {{out}} {{merge}}", gets_merge=True
        )
        method = Method(name, command, "given", limit_s)
        return evaluate_command(self.plan, self.run, method, **{"tools": TOOLS, **options})


@pytest.fixture
def evaluator(tmp_path: Path) -> Evaluator:
    return Evaluator(tmp_path)


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run in which the good script is the method `mine`; tests that change it copy it."""
    evaluator = Evaluator(tmp_path_factory.mktemp("evaluated"))
    evaluator.evaluate()
    return evaluator.run
