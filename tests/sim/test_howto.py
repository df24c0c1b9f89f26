"""The guides of props and families: their files are written as shown, and do what the guides say."""

import re
from pathlib import Path

import numpy as np
import pytest

import scenarios
import sim
from cdpipe.core.errors import ScenarioError
from eval.plans.plan import load_plan
from scenarios.schema import PROP_KINDS, Prop
from sim.geometry.mesh import join_meshes
from sim.props import props, storage
from sim.props.shapes import solid_mesh

ROOT = Path(__file__).parents[2]
FAST = {"sensor.mode": "512x10", "platform.scan_spacing_m": 2.0}


def shown(page: str) -> dict[str, str]:
    """Return the blocks of a guide that are files, or go into files, by the name above each."""
    return dict(re.findall(r"^`([^`]+)`\n\n```\w+\n(.*?)^```", (ROOT / page).read_text(), re.M | re.S))


def put_on_path(page: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, content in shown(page).items():
        if name.startswith(("props/", "families/")):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(content)
    monkeypatch.setenv("TUNNELCD_PATH", str(folder))


def test_a_mesh_in_a_folder_is_a_prop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put_on_path("sim/props/HOWTO.md", tmp_path, monkeypatch)
    assert "chock" in scenarios.prop_names()
    pair = sim.simulate("chocks", 3, tmp_path / "pair", FAST)
    truth = sim.read_pair_truth(pair)
    assert {(change.name, change.prop_kind) for change in truth.changes} == {("new", "chock"), ("pushed", "chock")}
    # a wedge of 40 x 30 x 25 cm
    assert truth.changes[0].mesh_volume_m3 == pytest.approx(0.4 * 0.3 * 0.25 / 2, rel=1e-3)
    assert str(tmp_path / "props" / "chock.obj") in truth.files
    assert scenarios.Scenario.model_validate(truth.scenario).props[0].kind == "chock"


def test_a_builder_as_shown_fills_its_size(monkeypatch: pytest.MonkeyPatch) -> None:
    blocks, size = shown("sim/props/HOWTO.md"), (0.5, 0.8, 1.8)
    exec(blocks["sim/props/storage.py"], vars(storage))
    try:
        entry = eval("{" + blocks["sim/props/props.py"] + "}", {"storage": storage})
    finally:
        delattr(storage, "locker")
    assert not entry.keys() & set(PROP_KINDS)
    monkeypatch.setattr(props, "BUILDERS", props.BUILDERS | entry)
    shape = props.shape_of(Prop.model_construct(name="it", kind="locker", size_m=size, mesh=None), seed=0)
    corners = join_meshes([solid_mesh(solid) for solid in shape.solids]).vertices
    np.testing.assert_allclose(np.ptp(corners, axis=0), size, atol=1e-9)
    assert corners[:, 2].min() == pytest.approx(0.0, abs=1e-9)


def test_families_in_a_folder_are_listed_planned_and_simulated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put_on_path("scenarios/families/HOWTO.md", tmp_path, monkeypatch)
    assert {"mine/stub", "mine/stub_drifting", "narrow"} <= set(scenarios.scenario_names())
    plan = tmp_path / "plan.yaml"
    plan.write_text("name: own\nscenarios: [mine/stub]\nseeds: [0]\nvariants: [{preset: c2c}]\n")
    assert [item.name for item in load_plan(str(plan)).scenarios] == ["mine/stub"]
    plain, drifting = (scenarios.load_scenario(f"mine/{name}", 5) for name in ("stub", "stub_drifting"))
    assert (plain.family, drifting.family) == ("mine/stub", "mine/stub_drifting")
    assert (plain.tunnel, plain.props) == (drifting.tunnel, drifting.props)
    assert drifting.after.odometry.yaw_deg_per_100m == 0.3
    truth = sim.read_pair_truth(sim.simulate("mine/stub", 5, tmp_path / "pair", FAST))
    assert ("crate", "removed") in {(change.name, change.kind) for change in truth.changes}


def test_a_name_that_is_taken_is_refused_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TUNNELCD_PATH", str(tmp_path))
    for kind, name, names in (
        ("families", "narrow", scenarios.scenario_names),
        ("props", "box", scenarios.prop_names),
    ):
        (tmp_path / kind).mkdir()
        (tmp_path / kind / f"{name}.yaml").write_text("extends: wide\n")
        with pytest.raises(ScenarioError, match=rf"^TUNNELCD_PATH: .*{name}\.yaml: there is .* '{name}' already.*$"):
            names()
        (tmp_path / kind / f"{name}.yaml").unlink()


def test_a_mistake_in_a_prop_is_told_with_its_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put_on_path("sim/props/HOWTO.md", tmp_path, monkeypatch)
    (tmp_path / "props" / "chock.yaml").write_text("mesh: {path: chock.obj}\nreflectivty: 0.1\n")
    with pytest.raises(Exception, match=r'chock\.yaml:2: reflectivty = 0\.1: unknown key; did you mean "reflectivity"'):
        scenarios.load_scenario("chocks", 0)


def test_a_kind_that_is_nowhere_is_told_with_its_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put_on_path("sim/props/HOWTO.md", tmp_path, monkeypatch)
    path = tmp_path / "families" / "chocks.yaml"
    path.write_text(path.read_text().replace("kind: chock\n", "kind: chok\n"))
    with pytest.raises(
        ScenarioError, match=r'^.*:6: props\.1\.kind = .chok.: no prop is called chok; did you mean "chock"\?$'
    ):
        scenarios.load_scenario("chocks", 0)
