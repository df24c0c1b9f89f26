"""Sessions whose rays Warp casts, here on the CPU, against those of Embree."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core import plugins
from cdpipe.core.errors import InputError, InputWarning
from cdpipe.io.session import read_session
from scenarios.schema import Platform, Prop, Scenario, Sensor, Simulation
from sim.session import simulate
from sim.session.simulate import simulate_in_memory, simulate_pair

SEED = 11
needs_warp = pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="needs the extra `gpu`: warp-lang")
quiet = pytest.mark.filterwarnings("ignore:sim.backend = warp. no GPU:cdpipe.core.errors.InputWarning")


@pytest.fixture(scope="module")
def scenario(make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]) -> Scenario:
    boxes = make_prop("box", 0.35, change="added"), make_prop("other", 0.6, 0.8)
    return make_scenario(props=boxes, sensor=Sensor(mode="512x10", sub_rays=7))


def on_warp(scenario: Scenario) -> Scenario:
    return scenario.model_copy(update={"sim": Simulation(backend="warp")})


@needs_warp
@quiet
def test_the_sessions_of_both_backends_differ_by_rounding_alone(scenario: Scenario) -> None:
    theirs, ours = (simulate_in_memory(each, SEED, 2) for each in (scenario, on_warp(scenario)))
    for name in ("before", "after"):
        mine, other = ours.sessions[name], theirs.sessions[name]
        np.testing.assert_array_equal(mine.world_T_sensor, other.world_T_sensor)
        assert (mine.instance != other.instance).mean() < 1e-4
        assert (mine.change != other.change).mean() < 1e-4
        got, want = mine.session.chunk(0), other.session.chunk(0)
        off_mm = np.abs(got.range_mm.astype(np.int64) - want.range_mm.astype(np.int64))
        assert (off_mm > 0).mean() < 2e-3
        assert (off_mm > 1).mean() < 1e-4
        assert (want.range_mm > 0).mean() > 0.5


@needs_warp
@quiet
def test_a_session_names_what_cast_it_and_keeps_its_bytes(scenario: Scenario, tmp_path: Path) -> None:
    lean = on_warp(scenario).model_copy(update={"platform": Platform(scan_spacing_m=6.0)})
    for name in ("one", "two"):
        simulate_pair(lean, SEED, tmp_path / name)
    told = read_session(tmp_path / "one" / "before").provenance["casting"]
    assert told.startswith(f"warp-lang {plugins.extra_version('warp-lang')} on ")
    files = [path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*") if path.is_file()]
    assert all((tmp_path / "one" / path).read_bytes() == (tmp_path / "two" / path).read_bytes() for path in files)


def test_a_session_of_embree_names_nothing_and_its_scenario_says_no_backend(scenario: Scenario, tmp_path: Path) -> None:
    simulate_pair(scenario.model_copy(update={"sensor": Sensor(mode="512x10")}), SEED, tmp_path / "pair")
    assert "casting" not in read_session(tmp_path / "pair" / "before").provenance
    assert "sim" not in scenario.model_dump(mode="json")
    assert on_warp(scenario).model_dump(mode="json")["sim"] == {"backend": "warp"}


@needs_warp
@quiet
def test_movers_are_met_before_what_warp_casts(moving_scenario: Scenario) -> None:
    theirs, ours = (simulate_in_memory(each, SEED) for each in (moving_scenario, on_warp(moving_scenario)))
    for name in ("before", "after"):
        assert (ours.sessions[name].instance != theirs.sessions[name].instance).mean() < 1e-4
    seen = [mover.n_returns for mover in theirs.truth.movers]
    assert len(seen) == 4 and min(seen) > 100
    assert [mover.n_returns for mover in ours.truth.movers] == pytest.approx(seen, rel=0.01)


@needs_warp
def test_a_machine_without_gpu_says_so(scenario: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    from sim.geometry import backends, warp_caster  # noqa: PLC0415 - an extra
    from sim.geometry.mesh import box_mesh  # noqa: PLC0415
    from sim.geometry.raycast import Caster  # noqa: PLC0415

    monkeypatch.setattr(warp_caster, "start_device", lambda: "cpu")
    box = box_mesh((1, 1, 1))
    with pytest.warns(InputWarning, match="no GPU was found: the CPU casts the rays"):
        caster = backends.make_sensor_caster("warp", [box], Caster([box]))
    assert backends.name_backend(caster).endswith(" on cpu")
    assert backends.name_backend(Caster([box])).startswith("embreex ")


def test_without_the_extra_one_line_says_what_to_install(
    scenario: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plugins, "find_spec", lambda name: None)
    monkeypatch.setattr(simulate, "plan_drives", lambda *told: pytest.fail("a world was built"))
    with pytest.raises(InputError) as caught:
        simulate_pair(on_warp(scenario), SEED, tmp_path / "pair")
    assert str(caught.value) == "sim.backend = warp needs a package more: pip install 'tunnelcd[gpu]'"
    assert not (tmp_path / "pair").exists()
