"""Worlds that are too large are refused by an estimate, before anything is built; the estimates are near the truth."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from cdpipe.core.errors import InputError, ScenarioError
from scenarios.library import load_scenario
from scenarios.schema import Scenario
from sim import scene, size
from sim.rock.centreline import build_centreline
from sim.rock.tunnel import count_wall_faces
from sim.scene import lay_ground
from sim.size import require_memory, require_size

LONG = """
score_radius_m: 4.5
tunnel:
  nodes: {a: [0, 0, 0], b: [LENGTH, 0, 0]}
  drifts: [{nodes: [a, b]}]
  section: {width_m: 5, height_m: 4}
platform: {kind: ground_robot}
before: {route: [a, b]}
after: {route: [a, b]}
"""
TOO_LARGE = [
    (
        "tunnel.furniture.bolts.spacing_m=0.1",
        r"tunnel\.furniture\.bolts: about 1\.8e\+08 triangles .* spacing_m of at least 0\.24\d$",
    ),
    (
        "tunnel.furniture.screen.opening_m=0.01",
        r"furniture\.screen: about .*e\+08 triangles .* opening_m of at least 0\.0[67]\d?$",
    ),
    ("tunnel.furniture.pipes=[" + "{diameter_m: 0.1, side: left}," * 80 + "]", r"furniture\.pipes: .* fewer of them"),
    (
        "platform.scan_spacing_m=0.01",
        r"^before: platform\.scan_spacing_m = 0\.01: 1e\+06 revolutions .* at least 0\.101$",
    ),
    ("props=[{name: p, kind: box, size_m: [1, 1, 1], place: {}, repeat: 3001}]", r"props: 3001 of them: at most 3000"),
]


def world(folder: Path, length_m: float, *settings: str) -> Scenario:
    (folder / "long.yaml").write_text(LONG.replace("LENGTH", str(length_m)))
    return load_scenario(str(folder / "long.yaml"), 0, settings)


@pytest.mark.parametrize(("setting", "told"), TOO_LARGE)
def test_a_world_that_is_too_large_is_refused_before_it_is_built(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, setting: str, told: str
) -> None:
    monkeypatch.setattr(scene, "mesh_tunnel", lambda *_: pytest.fail("meshed"))
    with pytest.raises(ScenarioError, match=told) as caught:
        lay_ground(world(tmp_path, 10_000, setting), 0)
    assert "\n" not in str(caught.value)


def test_ten_kilometres_with_usual_furniture_are_not_too_large(tmp_path: Path) -> None:
    furniture = (
        "{bolts: {}, screen: {}, pipes: [{diameter_m: 0.1, side: left}], cable_trays: [{}], ducts: [{diameter_m: 1}]}"
    )
    scenario = world(tmp_path, 10_000, f"tunnel.furniture={furniture}")
    require_size(scenario, build_centreline(scenario.tunnel, 0))


def test_what_memory_cannot_hold_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = world(tmp_path, 1000, "tunnel.furniture.screen.opening_m=0.1")
    line = build_centreline(scenario.tunnel, 0)
    require_memory(scenario.tunnel, line)
    monkeypatch.setattr(os, "sysconf", lambda name: {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 500_000}[name])
    with pytest.raises(InputError, match=r"^tunnel: about 3\..e\+06 triangles, which take 2 GB .* this machine has 2"):
        require_memory(scenario.tunnel, line)


def test_the_estimates_are_those_of_a_world_that_is_built(tmp_path: Path) -> None:
    scenario = world(tmp_path, 40, "tunnel.furniture={bolts: {}, screen: {}}")
    line = build_centreline(scenario.tunnel, 0)
    ground = lay_ground(scenario, 0)
    found = {each.name: len(each.mesh.faces) for each in ground.fixtures}
    for name, faces in size._count_furniture(scenario.tunnel, line):
        if name in found:
            assert faces == pytest.approx(found[name], rel=0.35)
    assert count_wall_faces(scenario.tunnel, line) == pytest.approx(len(ground.rock[0].faces), rel=0.2)
