from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from cdpipe.core.errors import ScenarioError
from scenarios.schema import Drift, MeshFile, Scenario, Section, Tunnel
from sim import scene
from sim.drive.path import plan_path
from sim.drive.trajectory import load_sensor, plan_trajectory
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster
from sim.rock.centreline import build_centreline
from sim.rock.grounding import set_on_floor
from sim.scene import build_world

LENGTH_M, RISE_M = 30.0, 2.6


def arched(rise_m: float) -> trimesh.Trimesh:
    """A drift along x, 4 m wide and 3 m high, whose floor rises in the middle like a parabola."""
    solid = trimesh.creation.box(extents=(LENGTH_M + 8, 4.0, 3.0))
    for _ in range(6):  # edges of 0.6 m; subdivide_to_size leaves cracks in old versions
        solid = solid.subdivide()
    solid.apply_translation((LENGTH_M / 2, 0.0, 1.5))
    share = 2 * solid.vertices[:, 0] / LENGTH_M - 1
    solid.vertices[:, 2] += rise_m * (1 - share**2)
    solid.invert()
    return solid


def tunnel_of(path: str) -> Tunnel:
    return Tunnel(
        mesh=MeshFile(path=path),
        nodes={"a": (0, 0, 0), "b": (LENGTH_M, 0, 0)},
        drifts=(Drift(nodes=("a", "b")),),
        section=Section(width_m=4.0, height_m=3.0),
    )


def walls_of(solid: trimesh.Trimesh) -> Caster:
    return Caster([Mesh(np.asarray(solid.vertices, dtype=np.float64), np.asarray(solid.faces, dtype=np.int32))])


def test_the_line_lies_on_a_floor_that_is_higher_than_the_straight_line() -> None:
    line = set_on_floor(build_centreline(tunnel_of("mine.stl"), 0), walls_of(arched(RISE_M))).drifts[0].points
    share = 2 * line[:, 0] / LENGTH_M - 1
    inner = slice(20, -20)  # half a metre is smoothed, more at the ends
    np.testing.assert_allclose(line[inner, 2], RISE_M * (1 - share**2)[inner], atol=0.03)


def test_a_line_on_a_level_floor_keeps_its_bytes() -> None:
    centreline = build_centreline(tunnel_of("mine.stl"), 0)
    grounded = set_on_floor(centreline, walls_of(arched(0.0)))
    np.testing.assert_array_equal(grounded.drifts[0].points, centreline.drifts[0].points)


def test_a_floor_of_another_level_is_not_taken() -> None:
    low = arched(0.0)
    low.apply_translation((0.0, 0.0, -9.0))
    centreline = build_centreline(tunnel_of("mine.stl"), 0)
    grounded = set_on_floor(centreline, walls_of(low))
    np.testing.assert_array_equal(grounded.drifts[0].points, centreline.drifts[0].points)


def test_a_drive_follows_an_arched_floor_between_two_nodes(
    make_scenario: Callable[..., Scenario], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arched(RISE_M).export(tmp_path / "mine.stl")
    scenario: Any = make_scenario(tunnel=tunnel_of(str(tmp_path / "mine.stl")))
    path = plan_path(build_world(scenario, 1), scenario, 1, "before")
    share = 2 * path.points[:, 0] / LENGTH_M - 1
    assert np.abs(path.points[:, 2] - RISE_M * (1 - share**2)).max() < 0.1
    sensor = load_sensor(scenario, "before")
    driven = plan_trajectory(build_world(scenario, 1), scenario, sensor, 1, "before").world_T_sensor[:, :3, 3]
    floor_m = RISE_M * (1 - (2 * driven[:, 0] / LENGTH_M - 1) ** 2)
    np.testing.assert_allclose(driven[:, 2] - floor_m, scenario.platform.sensor_height_m, atol=0.1)
    # the straight line lies below the floor, where there is no room
    monkeypatch.setattr(scene, "set_on_floor", lambda centreline, _: centreline)
    with pytest.raises(ScenarioError, match=r"within 0\.00 m of rock"):
        plan_trajectory(build_world(scenario, 1), scenario, sensor, 1, "before")
