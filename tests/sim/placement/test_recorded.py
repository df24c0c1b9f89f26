from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.core.geometry import Float64Array, yaw_rad
from cdpipe.io.session import read_session
from cdpipe.io.tum import motion_through
from cdpipe.sensor.ouster import SensorMetadata
from scenarios.schema import MeshFile, Platform, Scenario, SessionPlan, Tunnel
from sim.drive.trajectory import plan_trajectory
from sim.geometry.mesh import Mesh, box_mesh
from sim.geometry.raycast import Caster
from sim.placement import recorded
from sim.placement.recorded import check_inside, read_drive
from sim.scene import build_world
from sim.session.simulate import simulate_pair
from sim.session.truth import read_true_poses

GOOD = ["# stamp x y z qx qy qz qw", "10.0 0 0 1 0 0 0 1", "", "10.5 0.4 0 1 0 0 0 1", "11.5 1.2 0.1 1 0 0 0 1"]


def written(path: Path, lines: list[str]) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def table(stamps_s: Float64Array, points: Float64Array, turns: Rotation) -> list[str]:
    rows = np.column_stack([stamps_s, points, turns.as_quat()])
    return [" ".join(f"{value:.9f}" for value in row) for row in rows]


def test_a_trajectory_is_read_back_with_its_lines(tmp_path: Path) -> None:
    generator = np.random.default_rng(3)
    stamps_s = 1.7e9 + np.cumsum(generator.uniform(0.5, 1.0, 20))
    points = np.cumsum(generator.normal(0.0, 0.3, (20, 3)), axis=0)
    turns = Rotation.random(20, random_state=generator)
    motion, lines = read_drive(written(tmp_path / "t.tum", ["# comment", *table(stamps_s, points, turns)]))
    assert lines == tuple(range(2, 22))
    poses = motion.poses(stamps_s - stamps_s[0])
    np.testing.assert_allclose(poses[:, :3, 3], points, atol=1e-6)
    np.testing.assert_allclose(poses[:, :3, :3], turns.as_matrix(), atol=1e-6)
    np.testing.assert_allclose(motion.way_m[-1], np.linalg.norm(np.diff(points, axis=0), axis=1).sum(), atol=1e-6)


@pytest.mark.parametrize(
    ("line", "text", "message"),
    [
        (4, "10.5 0.4 0 1 0 0 0", ":4: 7 fields"),
        (2, "10.0 0 zero 1 0 0 0 1", ":2: "),
        (4, "10.5 0.4 nan 1 0 0 0 1", ":4: the pose "),
        (5, "10.5 1.2 0.1 1 0 0 0 1", ":5: the stamp "),
        (5, "11.5 1.2 0.1 1 0 0 0 0.9", ":5: the quaternion's length is 0.9"),
        (5, "11.5 21.4 0.1 1 0 0 0 1", ":5: 21.00 m in 1.000 s, faster than 20 m/s"),
    ],
)
def test_a_wrong_line_is_named(tmp_path: Path, line: int, text: str, message: str) -> None:
    lines = list(GOOD)
    lines[line - 1] = text
    path = written(tmp_path / "wrong.tum", lines)
    with pytest.raises(InputError, match=re.escape(f"{path}{message}")):
        read_drive(path)


def test_a_file_that_is_no_trajectory_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"short\.tum: 1 poses"):
        read_drive(written(tmp_path / "short.tum", GOOD[:2]))
    with pytest.raises(InputError, match=r"none\.tum: "):
        read_drive(tmp_path / "none.tum")
    (tmp_path / "binary.tum").write_bytes(b"\xff\xfe\x00\x80" * 9)
    with pytest.raises(InputError, match=r"binary\.tum: "):
        read_drive(tmp_path / "binary.tum")


def test_a_trajectory_stays_in_the_void(tmp_path: Path) -> None:
    box = box_mesh((5.0, 2.0, 1.5))
    room = Caster([Mesh(box.vertices, box.faces[:, ::-1])])

    def check(*places: tuple[float, float, float]) -> None:
        points = np.array(places)
        lines = table(np.arange(len(places), dtype=np.float64), points, Rotation.identity(len(places)))
        check_inside(*_in_order(read_drive(written(tmp_path / "t.tum", ["#", *lines])), room))

    check((-4, 0, 0), (0, 1.5, 0), (4, -1.5, 1.0))
    with pytest.raises(ScenarioError, match=r"before: t\.tum:2: .* \(0\.00, 3\.00, 0\.00\)"):
        check((0, 3, 0), (0, 0, 0))
    with pytest.raises(ScenarioError, match=r"t\.tum:3: the sensor at \(0\.00, 1\.85, 0\.00\) .*0\.15 m"):
        check((-4, 0, 0), (0, 1.85, 0), (4, 0, 0))
    # Between two good poses, through the wall and back.
    with pytest.raises(ScenarioError, match=r"t\.tum:2: the sensor at \(5\.00, 0\.00, 0\.00\) is 0\.00 m"):
        check((-4, 0, 0), (14, 0, 0))


def _in_order(read: tuple, room: Caster) -> tuple:  # type: ignore[type-arg] # handed straight on
    return read[0], room, "before: t.tum", read[1]


def test_a_recorded_trajectory_replaces_the_route(
    make_scenario: Callable[..., Scenario], sensor: SensorMetadata, tmp_path: Path
) -> None:
    share = np.linspace(0.0, 1.0, 30)
    points = np.column_stack([2.0 + 16.0 * share, 0.4 * np.sin(6 * share), 1.2 + 0.2 * np.cos(9 * share)])
    turns = Rotation.from_euler("ZYX", np.column_stack([0.3 * np.sin(5 * share), 0.1 * share, -0.1 * share]))
    path = written(tmp_path / "drive.tum", table(20.0 * share, points, turns))
    plan = SessionPlan(trajectory=str(path))
    scenario = make_scenario(before=plan, platform=Platform(scan_spacing_m=1.0))
    drive = plan_trajectory(build_world(scenario, 0), scenario, sensor, 0, "before")
    assert drive.n_scans == pytest.approx(drive.true.way_m[-1] / 1.0, abs=1.0)
    expected = np.column_stack([np.interp(drive.revolution_s, 20.0 * share, points[:, k]) for k in range(3)])
    np.testing.assert_allclose(drive.world_T_sensor[:, :3, 3], expected, atol=1e-6)
    middle = drive.world_T_sensor[drive.n_scans // 2]
    assert yaw_rad(middle) == pytest.approx(0.3 * np.sin(5 * drive.revolution_s[drive.n_scans // 2] / 20), abs=0.01)
    simulate_pair(scenario, 0, tmp_path / "pair")
    np.testing.assert_allclose(read_true_poses(tmp_path / "pair" / "before"), drive.world_T_sensor, atol=1e-12)
    assert read_session(tmp_path / "pair" / "before").n_scans == drive.n_scans
    written(path, table(20.0 * share, points + np.array([0.0, 9.0, 0.0]), turns))
    with pytest.raises(ScenarioError, match=r"before: .*drive\.tum:1: .* lies outside the tunnel"):
        simulate_pair(scenario, 0, tmp_path / "lost")


def test_a_foreign_mesh_needs_no_drifts_to_be_driven_through(
    make_scenario: Callable[..., Scenario], tmp_path: Path
) -> None:
    box = box_mesh((8.0, 2.5, 1.5))
    rows = [*(f"v {x} {y} {z}" for x, y, z in box.vertices), *(f"f {c} {b} {a}" for a, b, c in box.faces + 1)]
    mesh = written(tmp_path / "hall.obj", rows)
    points = np.array([[-6.0, 0.0, 0.0], [6.0, 0.5, 0.2]])
    there = written(tmp_path / "there.tum", table(np.array([0.0, 9.0]), points, Rotation.identity(2)))
    back = written(
        tmp_path / "back.tum", table(np.array([3.0, 12.0]), points[::-1], Rotation.from_euler("z", [[np.pi]] * 2))
    )
    scenario = make_scenario(
        tunnel=Tunnel(mesh=MeshFile(path=str(mesh))),
        before=SessionPlan(trajectory=str(there)),
        after=SessionPlan(trajectory=str(back)),
    )
    simulate_pair(scenario, 0, tmp_path / "pair")
    for name in ("before", "after"):
        session, true = read_session(tmp_path / "pair" / name), read_true_poses(tmp_path / "pair" / name)
        assert session.n_scans == 6  # 12 m, one every 2 m, less than a revolution short of the seventh
        scan = session.chunk(0).range_mm[3]
        # Noise of 1 cm: every return lies on the hall's six sides.
        inside = true[3][:3, :3] @ session.sensor.project(scan / 1000.0)[scan > 0].T + true[3][:3, 3:]
        assert np.quantile(np.abs(np.abs(inside.T) - (8.0, 2.5, 1.5)).min(axis=1), 0.99) < 0.08


def test_a_way_is_looked_at_every_quarter_of_a_metre_however_many_poses_it_has(monkeypatch: pytest.MonkeyPatch) -> None:
    looked_at: list[Float64Array] = []

    def measure(_: Caster, points: Float64Array, directions: Float64Array) -> tuple[Float64Array, np.ndarray]:
        looked_at.append(points)
        return np.where(points[:, 0] > 7.6, 0.1, 1.0), np.zeros(len(points), dtype=bool)

    monkeypatch.setattr(recorded, "measure_room", measure)
    monkeypatch.setattr(recorded, "_CHECKED_AT_ONCE", 7)
    # 1 m in steps of 1 mm, 5000 poses of standing, 1 m in steps of 1 mm, and 5 m at once
    x = np.concatenate([np.arange(1000) / 1000, np.ones(5000), 1 + np.arange(1, 1001) / 1000, [7.0]])
    points = np.column_stack([x, 0 * x, 0 * x])
    rows = np.column_stack([np.arange(len(x)) / 100.0, points, Rotation.identity(len(x)).as_quat()])
    numbers = tuple(range(1, len(x) + 1))
    check_inside(motion_through(rows, 0.0), Caster([box_mesh((1, 1, 1))]), "here", numbers)
    np.testing.assert_allclose(np.concatenate(looked_at)[:, 0], np.arange(0.0, 7.1, 0.25), atol=2e-3)
    assert max(map(len, looked_at)) == 7
    rows[:, 1] += 1.0
    with pytest.raises(ScenarioError, match=rf"^here:{len(x) - 1}: the sensor at \(7\.75, "):
        check_inside(motion_through(rows, 0.0), Caster([box_mesh((1, 1, 1))]), "here", numbers)
