"""The profile of a small pair: its stages, its sums, and the table for a page."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.errors import ScenarioError
from cdpipe.io.session import read_session
from eval.bench import profile
from eval.bench.profile import as_markdown, measure_profile
from sim.session.simulate import simulate_pair
from tests.eval.running.runs import load_small

pytestmark = pytest.mark.usefixtures("thinned")


def test_the_profile_of_a_small_pair() -> None:
    told: list[tuple[str, int, int]] = []
    table = measure_profile(
        ["smoke/one_box"], 20000, has_surface=True, on_progress=lambda *args: told.append(args),
        run=lambda call, document: call(document),
    )  # fmt: skip
    assert told == [("smoke/one_box", 0, 1)]
    rows = {(row["command"], row["stage"]): row for row in table["rows"]}
    of_simulate = [stage for command, stage in rows if command == "simulate"]
    assert of_simulate == ["world", "drives", "scans", "writing"]
    for command in ("simulate", "detect"):
        shares = [row["share"] for key, row in rows.items() if key[0] == command and row["share"] is not None]
        assert sum(shares) == pytest.approx(1.0)
    assert {"reading", "mapping", "descriptors", "merge", "query", "extraction", "surface"} <= {s for _, s in rows}
    parts = sum(rows["detect", f"merge: {part}"]["wall_s"] for part in ("index", "search", "refinement"))
    assert parts <= rows["detect", "merge"]["wall_s"]
    json.dumps(table, allow_nan=False)
    page = as_markdown(table).splitlines()
    assert page[2].startswith("| command | stage | smoke/one_box: CPU s | share | wall s | peak MB |")
    assert all(line.count("|") == 7 for line in page[2:])
    assert [line.split(" | ")[1] for line in page[-2:]] == ["all", "all"]


def test_what_is_profiled_writes_what_simulate_writes(tmp_path: Path) -> None:
    scenario = load_small("smoke/one_box", 20000)
    simulate_pair(scenario, 20000, tmp_path / "pair")
    profile._simulate("smoke/one_box", 20000, tmp_path)
    for name in ("before", "after"):
        own, reference = tmp_path / name, tmp_path / "pair" / name
        assert np.array_equal(read_session(own).odom_T_sensor, read_session(reference).odom_T_sensor)
        files = sorted(path.relative_to(reference) for path in reference.rglob("*.npz"))
        assert files == sorted(path.relative_to(own) for path in own.rglob("*.npz"))
        for file in files:
            assert (own / file).read_bytes() == (reference / file).read_bytes()


def test_an_unknown_scenario_is_told_before_anything_is_measured() -> None:
    with pytest.raises(ScenarioError, match="nowhere"):
        measure_profile(["smoke/one_box", "nowhere"], run=lambda call, document: pytest.fail("measured"))
