"""What the tests let happen to the cells that workers run.

Pairs are copied instead of simulated. What befalls a cell stands in the folder that the environment names, as a file
`<what>-<seed>-<variant>`: kill, full (a disk), hold (until the file is gone).
"""

import errno
import os
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

from scenarios.references import file_digests
from scenarios.schema import Scenario
from sim.session.truth import read_pair_truth, write_pair_truth


def copied(scenario: Scenario, seed: int, out: Path, on_progress: object = None) -> None:
    """Copy the pair that is given, as if it had been simulated."""
    hook = Path(os.environ["TUNNELCD_TEST_HOOK"])
    if (hook / "kill-simulation").exists():
        os.kill(os.getpid(), signal.SIGKILL)
    partial = out.with_name(f".{out.name}.copy")
    shutil.rmtree(partial, ignore_errors=True)
    shutil.copytree(hook / "pair", partial)
    drawn, files = scenario.model_dump(mode="json"), file_digests(scenario)
    write_pair_truth(partial, replace(read_pair_truth(partial), seed=seed, scenario=drawn, files=files))
    partial.replace(out)


def befall(pair_run: ModuleType) -> None:
    """Let pairs be copied, and cells answer after what befalls them; every process writes down what it begins."""
    usual = pair_run._answer

    def answered(stages: object, cell: Any, truth: object, folder: Path) -> None:
        hook, name = Path(os.environ["TUNNELCD_TEST_HOOK"]), f"{cell.seed}-{cell.variant}"
        with (hook / "begun").open("a") as file:
            file.write(f"{cell.seed} {cell.variant} {os.getpid()}\n")
        while (hook / f"hold-{name}").exists():
            time.sleep(0.02)
        if (hook / f"kill-{name}").exists():
            os.kill(os.getpid(), signal.SIGKILL)
        usual(stages, cell, truth, folder)
        if (hook / f"full-{name}").exists():
            (folder / "answer.json").unlink()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder / "answer.npz"))

    pair_run.TOOLS = pair_run.Tools(simulate=copied)
    pair_run._answer = answered
