"""Exponents of known power laws, the meter by a stage of known work, and the command on its smallest sizes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.isolation import ProcessDiedError
from eval.bench import growth, growth_axes
from eval.bench.exponents import fit_growth
from eval.bench.growth import LIMIT, choose_axes, judge, measure_growth, summarise_growth
from eval.bench.growth_axes import Axis, list_axes, measure_size
from eval.bench.meter import StageMeter
from eval.cli.main import main

SIZES = (1.0, 2.0, 4.0, 8.0, 16.0)


def run(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    capsys.readouterr()
    with pytest.raises(SystemExit) as caught:
        main(["bench", *argv])
    out, err = capsys.readouterr()
    return int(caught.value.code or 0), out, err


@pytest.mark.parametrize("exponent", [0.0, 0.5, 1.0, 2.0])
def test_the_exponent_of_a_power_law(exponent: float) -> None:
    found = fit_growth(SIZES, [3.0 * size**exponent for size in SIZES])
    assert [found.exponent, found.low, found.high, found.last] == pytest.approx([exponent] * 4, abs=1e-9)


def test_the_interval_holds_the_exponent_in_95_of_100_noisy_series() -> None:
    rng = np.random.default_rng(5)
    n_held, n = 0, 2000
    for _ in range(n):
        found = fit_growth(SIZES, [size**1.3 * float(np.exp(0.1 * rng.standard_normal())) for size in SIZES])
        n_held += found.low <= 1.3 <= found.high
    assert n_held / n == pytest.approx(0.95, abs=0.02)


def test_a_quadratic_part_shows_in_the_last_step_first() -> None:
    found = fit_growth(SIZES, [size + size**2 / 16 for size in SIZES])
    assert 1.0 < found.exponent < found.last
    # 16 + 16 over 8 + 4
    assert found.last == pytest.approx(np.log2(32 / 12))


def test_what_cannot_be_fitted_is_undefined() -> None:
    assert np.isnan(fit_growth([4.0], [1.0]).exponent)
    assert np.isnan(fit_growth([4.0, 4.0], [1.0, 2.0]).exponent)
    two = fit_growth([4.0, 8.0, 16.0], [1.0, 4.0, 0.0])  # the zero is left out
    assert [two.exponent, two.last] == pytest.approx([2.0, 2.0])
    assert np.isnan(two.low)


def test_verdicts() -> None:
    assert judge(LIMIT + 0.01, 1.0, 5.0) == "above"
    assert judge(1.0, LIMIT + 0.01, 5.0) == "rising"
    assert judge(LIMIT, LIMIT, 5.0) == ""
    assert judge(3.0, 3.0, 0.01) == "short"


def test_a_meter_books_stages_and_what_is_read_within_them(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr("eval.bench.meter.time.perf_counter", lambda: clock[0])
    monkeypatch.setattr("eval.bench.meter.time.process_time", lambda: 2 * clock[0])
    meter = StageMeter()
    meter.on_stage("map before", 0, 1)
    clock[0] += 0.25
    meter.on_stage("map before: pass 1", 0, 5)
    clock[0] += 1.0
    with meter.aside("reading"):
        clock[0] += 4.0
    clock[0] += 1.0
    meter.on_stage("map before: registration 1", 0, 5)
    clock[0] += 8.0
    meter.on_stage("map before: pass 2", 0, 5)
    clock[0] += 0.5
    meter.on_stage("map after: pass 1", 0, 5)  # of a session whose poses stay
    clock[0] += 16.0
    meter.start("")
    clock[0] += 100.0
    wall_s = {"mapping": 16.75, "reading": 4.0, "consistency": 10.0}
    assert {name: cost.wall_s for name, cost in meter.costs.items()} == wall_s
    assert {name: cost.cpu_s for name, cost in meter.costs.items()} == {name: 2 * s for name, s in wall_s.items()}


def _work(size: float, meter: StageMeter) -> float:
    meter.start("held")
    held = np.ones(int(size) << 17)  # MB
    meter.start("")
    return float(len(held) >> 17)


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="the peak of a stage needs Linux")
def test_the_peak_of_a_stage_is_its_own() -> None:
    meter = StageMeter()
    _work(200.0, meter)
    meter.start("after")
    meter.start("")
    assert meter.costs["held"].peak_mb - meter.costs["after"].peak_mb > 150.0


def test_the_table_of_a_known_growth(monkeypatch: pytest.MonkeyPatch) -> None:
    axis = Axis("synthetic", "boxes", _work, ("square", "line"), SIZES, SIZES[:2], (32.0,))
    told: list[tuple[str, int, int]] = []

    def measured(call: Any, document: dict[str, Any]) -> dict[str, Any]:
        assert call is measure_size
        size = document["size"]
        stages = {
            name: {"wall_s": 9.0, "cpu_s": s, "peak_mb": 7.0} for name, s in (("square", size**2), ("line", size))
        }
        return {"size": 10 * size, "base_mb": 100.0, "peak_mb": 100.0 + 3 * size, "stages": stages}

    table = measure_growth([axis], on_progress=lambda *args: told.append(args), run=measured)
    found = {row["stage"]: row for row in table["rows"]}
    assert {name: round(row["exponent"], 6) for name, row in found.items()} == {
        "square": 2.0,
        "line": 1.0,
        "memory": 1.0,
    }
    assert (found["square"]["smallest"], found["square"]["largest"], found["square"]["value"]) == (10.0, 160.0, 256.0)
    assert (found["memory"]["value"], found["memory"]["peak_mb"]) == (48.0, 148.0)
    assert told[1] == ("synthetic 2", 1, 5)
    assert summarise_growth(table) == "2 of 3 exponents are at most 1.1; above 1.1: synthetic: square"
    assert len(measure_growth([axis], large=True, run=measured)["measured"]) == 6 * 3


def test_a_size_whose_process_dies_is_named_and_the_others_stay() -> None:
    axis = Axis("synthetic", "boxes", _work, ("line",), SIZES, SIZES)

    def killed(call: Any, document: dict[str, Any]) -> dict[str, Any]:
        if document["size"] > 8:
            raise ProcessDiedError("signal 9")
        stages = {"line": {"wall_s": 1.0, "cpu_s": document["size"], "peak_mb": 7.0}}
        return {"size": document["size"], "base_mb": 1.0, "peak_mb": 1.0 + document["size"], "stages": stages}

    table = measure_growth([axis], run=killed)
    assert [row["n"] for row in table["rows"]] == [4, 4]
    told = "2 of 2 exponents are at most 1.1; not measured, the process died: synthetic 16 (signal 9)"
    assert summarise_growth(table) == told


@pytest.mark.parametrize(("name", "size"), [("length", 10), ("objects", 2), ("pairs", 3)])
def test_an_axis_measures_the_stages_that_it_names(name: str, size: float) -> None:
    found = measure_size({"axis": name, "size": size})
    assert set(found["stages"]) == set(list_axes()[name].stages)
    assert found["size"] >= size
    assert all(cost["cpu_s"] > 0 for cost in found["stages"].values())
    assert found["peak_mb"] >= found["base_mb"]


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    axis = Axis("synthetic", "boxes", _work, ("held",), (1.0,), (16.0, 32.0, 64.0))
    for module in (growth, growth_axes):
        monkeypatch.setattr(module, "list_axes", lambda: {"synthetic": axis})
    monkeypatch.setattr(growth, "run_isolated", lambda call, document: call(document))
    monkeypatch.setitem(measure_growth.__kwdefaults__, "run", lambda call, document: call(document))
    file = tmp_path / "growth.json"
    code, out, err = run(capsys, "--growth", "--quick", "--out", str(file))
    assert code == 0
    assert [line for line in err.splitlines() if line] == [f"[{k}/3] synthetic {16 * 2**k}" for k in range(3)]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["growth.csv", "growth.json", "growth.png"]
    table = json.loads(file.read_text(), parse_constant=pytest.fail)
    assert [row["stage"] for row in table["rows"]] == ["held", "memory"]
    assert list(pd.read_csv(tmp_path / "growth.csv")["size"]) == [16, 16, 32, 32, 64, 64]
    code, out, _ = run(capsys, "--growth", "--quick", "--json", "--quiet")
    assert code == 0
    assert list(json.loads(out)) == ["machine", "commit", "rows", "measured", "failed"]


@pytest.mark.parametrize(
    ("argv", "told"),
    [
        (["--growth", "--profile"], "--growth and --profile: two tables: ask for one at a time"),
        (["--quick"], "--quick: belongs to --growth: add it, or leave --quick out"),
        (["--growth", "--surface"], "--surface: belongs to --profile: add it, or leave --surface out"),
        (["--growth", "--quick", "--large"], "--quick and --large: name one of both"),
        (["--growth", "--only", "lenght"], "--only: 'lenght' is no axis of growth (did you mean 'length'?)"),
    ],
)
def test_what_does_not_go_together_is_refused(capsys: pytest.CaptureFixture[str], argv: list[str], told: str) -> None:
    code, out, err = run(capsys, *argv)
    assert (code, out) == (2, "")
    assert told.partition(" (")[0] in err


def test_axes_are_chosen_by_name() -> None:
    assert [axis.name for axis in choose_axes(["pairs", "points"])] == ["points", "pairs"]
    with pytest.raises(InputError, match="no axis of growth"):
        choose_axes(["point"])
