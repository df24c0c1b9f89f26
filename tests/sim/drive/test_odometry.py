from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Callable
from dataclasses import fields, replace
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.core.geometry import invert, make_pose, transform, travelled_m, yaw_rad
from cdpipe.core.geometry.voxel import cell_keys
from cdpipe.core.spooled import SpooledArray
from cdpipe.io.session import Session, read_session
from cdpipe.mapping.poses import odometry
from cdpipe.mapping.poses.odometry import deskew_at_constant_velocity
from cdpipe.sensor.ouster import SensorMetadata
from scenarios.schema import Odometry, Platform, Prop, Roughness, Scenario, SessionPlan, Tunnel
from sim.drive.odometry import register_scans, start_pose
from sim.geometry.mesh import Mesh, box_mesh
from sim.geometry.raycast import Caster
from sim.sensor.lidar import Scan
from sim.sensor.rays import Rays
from sim.session.labels import CELL_M
from sim.session.planning import plan_drives
from sim.session.revolution import Drive, cast_revolution, measured_points
from sim.session.simulate import simulate_in_memory, simulate_pair
from sim.session.truth import SESSIONS, read_labels, read_pair_truth, read_true_poses

needs_kiss_icp = pytest.mark.skipif(
    importlib.util.find_spec("kiss_icp") is None, reason="needs the extra `odometry`: KISS-ICP"
)


@pytest.fixture(scope="module")
def scenario(make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]) -> Scenario:
    """A rough drift of 20 m and a box that goes, one session estimated by KISS-ICP and one by drift."""
    rough = (Roughness(amplitude_m=0.15, length_m=1.5), Roughness(amplitude_m=0.05, length_m=0.6))
    tunnel: Tunnel = make_scenario().tunnel.model_copy(update={"roughness": rough})
    return make_scenario(
        tunnel=tunnel,
        props=(make_prop("box", 0.6, change="removed"), make_prop("new", 0.35, change="added")),
        platform=Platform(scan_spacing_m=0.5, speed_mps=1.5, tilt_deg=1.0),
        before=SessionPlan(route=("a", "b"), start_m=2.0, end_m=2.0, odometry=Odometry(source="kiss-icp")),
        after=SessionPlan(route=("b", "a"), start_m=2.0, end_m=16.0),
    )


@pytest.fixture(scope="module")
def pair(scenario: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("estimated") / "pair"
    simulate_pair(scenario, 5, out)
    return out


@needs_kiss_icp
def test_kiss_icp_stays_near_the_truth_on_a_rough_drift(pair: Path) -> None:
    session, true = read_session(pair / "before"), read_true_poses(pair / "before")
    estimated = session.odom_T_sensor
    # Gravity and the heading of the first revolution fix the frame.
    np.testing.assert_allclose(estimated[0, :3, 3], 0.0, atol=1e-12)
    assert yaw_rad(estimated[0]) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(estimated[0, 2, :3], true[0, 2, :3], atol=1e-12)
    error = invert(invert(true[0]) @ true) @ (invert(estimated[0]) @ estimated)
    assert travelled_m(true)[-1] > 15.0
    assert np.linalg.norm(error[:, :3, 3], axis=1).max() < 0.3
    assert max(np.rad2deg(Rotation.from_matrix(each[:3, :3]).magnitude()) for each in error) < 3.0
    # It is an estimate, not the truth.
    assert np.linalg.norm(error[-1, :3, 3]) > 1e-3


@needs_kiss_icp
def test_a_session_says_which_package_made_its_poses(pair: Path) -> None:
    told = f"kiss-icp {metadata.version('kiss-icp')}"
    assert read_session(pair / "before").provenance["odometry"] == told
    assert "odometry" not in read_session(pair / "after").provenance


@needs_kiss_icp
def test_column_poses_move_evenly_between_the_estimated_revolutions(pair: Path, scenario: Scenario) -> None:
    session = read_session(pair / "before")
    chunk = session.chunk(0)
    middle = session.sensor.width // 2
    np.testing.assert_allclose(
        chunk.column_poses[:, middle], np.tile([0, 0, 0, 0, 0, 0, 1.0], (session.n_scans, 1)), atol=1e-6
    )
    stamps_s = chunk.column_stamps_ns / 1e9
    for scan in range(1, session.n_scans - 1):
        step = invert(session.odom_T_sensor[scan]) @ session.odom_T_sensor[scan + 1]
        share = (stamps_s[scan, -1] - stamps_s[scan, middle]) / (stamps_s[scan + 1, middle] - stamps_s[scan, middle])
        np.testing.assert_allclose(chunk.column_poses[scan, -1, :3], share * step[:3, 3], atol=1e-5)
        turn = Rotation.from_quat(chunk.column_poses[scan, -1, 3:].astype(np.float64))
        expected = share * Rotation.from_matrix(step[:3, :3]).as_rotvec()
        np.testing.assert_allclose(turn.as_rotvec(), expected, atol=1e-5)


@needs_kiss_icp
def test_kiss_icp_gives_the_same_bytes_twice_and_leaves_scans_and_truth_alone(
    pair: Path, scenario: Scenario, tmp_path: Path
) -> None:
    simulate_pair(scenario, 5, tmp_path / "again")
    first, again = read_session(pair / "before"), read_session(tmp_path / "again" / "before")
    assert first.odom_T_sensor.tobytes() == again.odom_T_sensor.tobytes()
    plain = scenario.model_copy(update={"before": scenario.before.model_copy(update={"odometry": Odometry()})})
    simulate_pair(plain, 5, tmp_path / "plain")
    true = read_session(tmp_path / "plain" / "before")

    def scans(session: Session) -> bytes:
        return b"".join(c.range_mm.tobytes() + c.column_stamps_ns.tobytes() for c in session.chunks())

    assert scans(first) == scans(true)
    assert read_true_poses(pair / "before").tobytes() == read_true_poses(tmp_path / "plain" / "before").tobytes()
    assert np.abs(first.odom_T_sensor - true.odom_T_sensor).max() > 1e-3


@needs_kiss_icp
def test_scans_are_cast_once_and_everything_that_is_measured_stands_where_kiss_icp_puts_it(
    scenario: Scenario, sensor: SensorMetadata, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cast: list[tuple[str, int]] = []

    def watch(drive: Drive, number: int) -> tuple[Rays, Scan]:
        cast.append((drive.name, number))
        return cast_revolution(drive, number)

    monkeypatch.setattr("sim.session.revolution.cast_revolution", watch)
    monkeypatch.setattr("sim.session.simulate.CHUNK_SCANS", 7)  # the last chunk holds fewer
    simulate_pair(scenario, 5, tmp_path / "pair")
    session = read_session(tmp_path / "pair" / "before")
    drives = plan_drives(scenario, 5, session.sensor)
    assert session.n_scans > 20 and session.n_scans % 7
    assert sorted(cast) == sorted((each.name, number) for each in drives for number in range(each.trajectory.n_scans))
    # register the written scans, then measure with these poses
    drive = drives[0]
    images = [image for chunk in session.chunks() for image in zip(chunk.range_mm, chunk.signal, strict=True)]
    times = drive.trajectory.revolution_s, drive.trajectory.column_s
    start = start_pose(drive.trajectory.true, times[0][0])
    estimated = register_scans(images, session.sensor, *times, start, "before")
    drive = replace(drive, trajectory=replace(drive.trajectory, estimated=estimated))
    np.testing.assert_array_equal(session.odom_T_sensor, drive.trajectory.odom_T_sensor)
    column_poses = np.concatenate([chunk.column_poses for chunk in session.chunks()])
    np.testing.assert_array_equal(column_poses, drive.trajectory.sensor_T_column(slice(None)))
    instance, change = (np.concatenate(part) for part in zip(*read_labels(session.path, session.n_chunks), strict=True))
    for wanted in read_pair_truth(tmp_path / "pair").changes:
        is_own = wanted.session == "before"
        is_on_it = change == wanted.id if is_own else instance == wanted.instance
        assert is_own == is_on_it.any()
        points = [
            measured_points(drive, number, images[number][0], *np.nonzero(on)) for number, on in enumerate(is_on_it)
        ]
        n_cells = len(np.unique(cell_keys(np.concatenate(points), CELL_M)))
        assert (wanted.n_cells if is_own else wanted.n_cells_other) == n_cells


@needs_kiss_icp
def test_a_session_in_memory_has_the_poses_and_scans_of_the_one_on_disk(pair: Path, scenario: Scenario) -> None:
    held = simulate_in_memory(scenario, 5)
    assert held.truth.changes == read_pair_truth(pair).changes
    for name in SESSIONS:
        memory, disk = held.sessions[name].session, read_session(pair / name)
        assert memory.odom_T_sensor.tobytes() == disk.odom_T_sensor.tobytes()
        for one, other in zip(memory.chunks(), disk.chunks(), strict=True):
            for field in fields(one):
                np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))


@needs_kiss_icp
def test_progress_tells_odometry_before_its_session(pair: Path, scenario: Scenario, tmp_path: Path) -> None:
    told: list[tuple[str, int, int]] = []
    simulate_pair(scenario, 5, tmp_path / "pair", lambda *step: told.append(step))
    n_before, n_after = (read_session(pair / name).n_scans for name in SESSIONS)
    stages = [("world", 1), ("odometry before", n_before), ("before", n_before), ("after", n_after)]
    assert told == [step for stage, total in stages for step in ((stage, 0, total), (stage, total, total))]


@needs_kiss_icp
def test_an_interrupted_estimate_leaves_nothing(
    scenario: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    n_registered = 0

    class Interrupted:
        last_pose = np.eye(4)

        def register_frame(self, *_: object) -> None:
            nonlocal n_registered
            n_registered += 1
            if n_registered == 9:
                raise KeyboardInterrupt

    monkeypatch.setattr(odometry, "_kiss_icp", Interrupted)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(KeyboardInterrupt):
        simulate_pair(scenario, 5, tmp_path / "pair")
    assert n_registered == 9
    assert list(tmp_path.iterdir()) == []


@needs_kiss_icp
def test_a_disk_too_full_to_keep_the_scans_is_told_in_one_line(
    scenario: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise InputError("TMPDIR: cannot write there: No space left on device")

    monkeypatch.setattr(SpooledArray, "append", fail)
    with pytest.raises(InputError, match="TMPDIR: cannot write there: No space left on device"):
        simulate_pair(scenario, 5, tmp_path / "pair")
    assert list(tmp_path.iterdir()) == []


@needs_kiss_icp
def test_deskewing_undoes_the_motion_within_a_revolution(sensor: SensorMetadata) -> None:
    box = box_mesh((6.0, 3.0, 2.0))
    room = Caster([Mesh(box.vertices, box.faces[:, ::-1])])
    velocity_mps, turn_rad_s = np.array([3.0, -0.5, 0.2]), np.array([0.1, 0.2, 0.9])
    column_s = (np.arange(sensor.width) - sensor.width // 2) / sensor.width / 10
    turns = Rotation.from_rotvec(column_s[:, None] * turn_rad_s).as_matrix()
    points = np.zeros((sensor.height, sensor.width, 3))
    for column in range(sensor.width):
        pose = make_pose(turns[column], column_s[column] * velocity_mps)
        rays = sensor.directions[:, column] @ turns[column].T
        ranges_m, _, _ = room.cast(transform(pose, sensor.origins[:, column]), rays)
        points[:, column] = sensor.origins[:, column] + ranges_m[:, None] * sensor.directions[:, column]
    straightened = deskew_at_constant_velocity(points, velocity_mps, turn_rad_s, column_s)
    off_wall_m = np.abs(np.abs(straightened) - (6.0, 3.0, 2.0)).min(axis=-1)
    assert off_wall_m.max() < 1e-4
    assert np.abs(np.abs(points) - (6.0, 3.0, 2.0)).min(axis=-1).max() > 0.05


@needs_kiss_icp
def test_one_revolution_has_the_first_pose_and_an_empty_one_gives_a_finite_pose(sensor: SensorMetadata) -> None:
    column_s = (np.arange(sensor.width) - sensor.width // 2) / sensor.width / 10
    start = make_pose(Rotation.from_euler("y", 0.1).as_matrix())
    empty = np.zeros((sensor.height, sensor.width), np.uint32)
    motion = register_scans([(empty, empty.astype(np.uint16))], sensor, np.array([0.05]), column_s, start, "before")
    np.testing.assert_allclose(motion.poses(np.array([0.0, 0.05, 0.1])), np.tile(start, (3, 1, 1)), atol=1e-12)


def test_a_pose_that_is_not_finite_is_an_error(sensor: SensorMetadata, monkeypatch: pytest.MonkeyPatch) -> None:
    class Lost:
        last_pose = np.full((4, 4), np.nan)

        def register_frame(self, *_: object) -> None:
            pass

    monkeypatch.setattr(odometry, "_kiss_icp", Lost)
    range_mm = np.full((sensor.height, sensor.width), 4000, np.uint32)
    scans = [(range_mm, range_mm.astype(np.uint16))] * 2
    with pytest.raises(ScenarioError, match=r"after: KISS-ICP .*revolution 0"):
        register_scans(scans, sensor, np.array([0.05, 0.15]), np.zeros(sensor.width), np.eye(4), "after")


def test_without_the_package_nothing_is_simulated(
    scenario: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cdpipe.core.plugins.find_spec", lambda name: None)
    told: list[str] = []
    with pytest.raises(InputError, match=r"pip install 'tunnelcd\[odometry\]'"):
        simulate_pair(scenario, 5, tmp_path / "pair", lambda stage, done, total: told.append(stage))
    assert told == []
    assert not (tmp_path / "pair").exists()
