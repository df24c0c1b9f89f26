"""What all tests share: pairs that are simulated once per test run, whichever test and process asks first."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock

from scenarios.schema import Scenario
from sim.session.simulate import simulate_pair


@pytest.fixture(scope="session")
def simulated_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Scenario, int], Path]:
    """Return a function that gives the folder of a simulated pair, and simulates it if nobody did yet.

    The processes of one test run (pytest-xdist) share the folder, so a test must copy what it changes. The key is the
    scenario as drawn and the seed.
    """
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "simulated"
    folder.mkdir(exist_ok=True)

    def get(scenario: Scenario, seed: int) -> Path:
        drawn = json.dumps([scenario.model_dump(mode="json"), seed], sort_keys=True)
        pair = folder / hashlib.sha256(drawn.encode()).hexdigest()[:16]
        with FileLock(f"{pair}.lock"):
            if not pair.exists():
                partial = pair.with_suffix(".partial")
                shutil.rmtree(partial, ignore_errors=True)
                simulate_pair(scenario, seed, partial)
                partial.rename(pair)
        return pair

    return get
