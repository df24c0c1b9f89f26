from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.core.geometry import Float64Array, transform
from cdpipe.io.session import Session, read_session
from scenarios.schema import Odometry, Place, Platform, Prop, Scenario, Sensor, SessionPlan
from sim.scene import build_world
from sim.session import simulate
from sim.session.simulate import simulate_pair
from sim.session.truth import read_labels, read_pair_truth, read_true_poses

SEED = 11


@pytest.fixture(scope="module")
def scenario(make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]) -> Scenario:
    goal = Place(between=("a", "b"), fraction=0.75, lateral=-0.8, yaw_deg=60)
    return make_scenario(
        props=(
            make_prop("box", 0.35, change="added"),
            make_prop("chair", 0.5, -0.8, 200.0, kind="chair", size_m=(0.5, 0.5, 0.9), change="moved", to=goal),
            make_prop("barrel", 0.6, 0.8, kind="barrel", size_m=(0.6, 0.6, 0.9)),
            make_prop("heap", 0.85, 0.7, kind="muck_pile", size_m=(1.8, 1.2, 0.5), change="removed"),
        ),
        before=SessionPlan(
            route=("a", "b"), lateral=-0.2, start_m=2.0, end_m=2.0, odometry=Odometry(yaw_deg_per_100m=9)
        ),
    )


@pytest.fixture(scope="module")
def pair(scenario: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("simulated") / "pair"
    simulate_pair(scenario, SEED, out)
    return out


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def returns_in_world(session: Session) -> tuple[Float64Array, Float64Array]:
    """All returns (N, 3) by their odometry, carried into the world by the true pose of their revolution; and labels."""
    points, labels = [], []
    true_poses = read_true_poses(session.path)
    label_chunks = list(read_labels(session.path, session.n_chunks))
    for index in range(session.n_chunks):
        chunk, (instance, change) = session.chunk(index), label_chunks[index]
        for place in range(len(chunk.range_mm)):
            row, column = np.nonzero(chunk.range_mm[place])
            in_column = session.sensor.project(chunk.range_mm[place] / 1000.0)[row, column]
            pose = chunk.column_poses[place, column].astype(np.float64)
            in_sensor = Rotation.from_quat(pose[:, 3:]).apply(in_column) + pose[:, :3]
            points.append(transform(true_poses[index * session.chunk_scans + place], in_sensor))
            labels.append(np.stack([instance[place, row, column], change[place, row, column]], axis=1))
    return np.concatenate(points), np.concatenate(labels)


def test_the_same_seed_gives_the_same_bytes_in_any_number_of_threads(
    scenario: Scenario, pair: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = time.time
    monkeypatch.setattr(time, "time", lambda: clock() + 3600.0)  # by which an archive stamps what it holds
    monkeypatch.setattr(simulate, "THREADS", 1)
    simulate_pair(scenario, SEED, tmp_path / "again")
    assert digests(tmp_path / "again") == digests(pair)
    simulate_pair(scenario, SEED + 1, tmp_path / "other")
    other = digests(tmp_path / "other")
    assert all(other[name] != digest for name, digest in digests(pair).items() if name.endswith("00000.npz"))


def test_short_chunks_hold_the_same_session(
    scenario: Scenario, pair: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulate, "CHUNK_SCANS", 3)  # the last one holds fewer
    simulate_pair(scenario, SEED, tmp_path / "short")
    assert read_pair_truth(tmp_path / "short").changes == read_pair_truth(pair).changes
    for name in ("before", "after"):
        whole, short = read_session(pair / name), read_session(tmp_path / "short" / name)
        assert (whole.n_chunks, short.n_chunks) == (1, -(-whole.n_scans // 3))
        assert whole.n_scans % 3
        for field in ("range_mm", "reflectivity", "signal", "column_stamps_ns", "column_poses"):
            joined = np.concatenate([getattr(chunk, field) for chunk in short.chunks()])
            np.testing.assert_array_equal(joined, getattr(whole.chunk(0), field))
        labels = [np.concatenate(parts) for parts in zip(*read_labels(short.path, short.n_chunks), strict=True)]
        np.testing.assert_array_equal(labels, next(read_labels(whole.path, 1)))


def test_labels_match_what_is_where(scenario: Scenario, tmp_path: Path) -> None:
    exact = scenario.model_copy(update={"sensor": Sensor(range_noise=False)})
    simulate_pair(exact, SEED, tmp_path / "pair")
    world = build_world(exact, SEED)
    for name in ("before", "after"):
        points, labels = returns_in_world(read_session(tmp_path / "pair" / name))
        standing = [item for item in world.standing if name in item.sessions]
        assert set(np.unique(labels[:, 0])) - {-2} == {0} | {scenario.props.index(item.prop) + 1 for item in standing}
        for item in standing:
            instance = scenario.props.index(item.prop) + 1
            local = transform(np.linalg.inv(item.world_T_object), points)
            half = np.array(item.prop.size_m) / (2, 2, 1)
            slack = 0.002 if item.prop.kind != "muck_pile" else 0.35  # whole millimetres; a heap's outline wanders
            is_inside = (np.abs(local[:, :2]) < half[:2] + slack).all(axis=1) & (local[:, 2] < half[2] + slack)
            own = labels[:, 0] == instance
            assert own.sum() > 100
            assert is_inside[own].all()
            # Well inside its box and above the floor there is nothing but the prop.
            core = (np.abs(local[:, :2]) < half[:2] - 0.05).all(axis=1) & (local[:, 2] > 0.15) & is_inside
            if item.prop.kind != "muck_pile":
                assert np.isin(labels[core, 0], (instance, -2)).all()  # a false return may lie anywhere


def test_changes_count_what_is_labelled(scenario: Scenario, pair: Path) -> None:
    truth = read_pair_truth(pair)
    assert (truth.family, truth.seed, truth.score_radius_m) == ("test", SEED, scenario.score_radius_m)
    assert truth.scenario == scenario.model_dump(mode="json")
    assert [(c.name, c.kind, c.session) for c in truth.changes] == [
        ("box", "added", "after"),
        ("chair", "moved", "before"),
        ("chair", "moved", "after"),
        ("heap", "removed", "before"),
    ]
    for name in ("before", "after"):
        session = read_session(pair / name)
        instance, change = (
            np.concatenate(part) for part in zip(*read_labels(session.path, session.n_chunks), strict=True)
        )
        range_mm = np.concatenate([chunk.range_mm for chunk in session.chunks()])
        np.testing.assert_array_equal(instance != -1, range_mm > 0)
        for item in truth.changes:
            is_here = item.session == name
            assert (change == item.id).sum() == (item.n_returns if is_here else 0)
            if is_here:
                np.testing.assert_array_equal(change == item.id, instance == item.instance)  # all are "full"
                assert item.is_observable
                assert item.n_cells <= item.n_returns
        assert (change[instance <= 0] == 0).all()


def test_poses_and_stamps_of_a_session(scenario: Scenario, pair: Path) -> None:
    session = read_session(pair / "before")
    true_poses = read_true_poses(session.path)
    assert session.n_scans == len(true_poses) == 1 + int((16.0 - 0.1) / 2.0)
    assert session.odom_T_sensor[0, :3, 3] == pytest.approx([0, 0, 0], abs=1e-9)
    # The odometry turns by 9 deg in 100 m, so the two paths part, but step for step they agree.
    steps = [np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) for poses in (session.odom_T_sensor, true_poses)]
    np.testing.assert_allclose(*steps, atol=1e-3)
    stamps = np.concatenate([chunk.column_stamps_ns for chunk in session.chunks()])
    assert (np.diff(stamps.ravel()) > 0).all()


def test_progress_is_told_in_order(make_scenario: Callable[..., Scenario], tmp_path: Path) -> None:
    told: list[tuple[str, int, int]] = []
    simulate_pair(make_scenario(), 0, tmp_path / "pair", lambda *step: told.append(step))
    stages = [stage for stage, _, _ in told]
    assert sorted(set(stages), key=stages.index) == ["world", "before", "after"]
    assert all(done == total for stage, done, total in told if (stage, done, total) == told[-1])
    assert read_pair_truth(tmp_path / "pair").changes == ()


def test_a_taken_or_unwritable_target_is_refused_and_nothing_is_left(
    make_scenario: Callable[..., Scenario],
    make_prop: Callable[..., Prop],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "note").write_text("mine")
    with pytest.raises(InputError, match="exists and is not an empty folder"):
        simulate_pair(make_scenario(), 0, tmp_path / "full")
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="cannot write there"):
        simulate_pair(make_scenario(), 0, tmp_path / "file" / "pair")
    with pytest.raises(ScenarioError, match="bars the way"):
        simulate_pair(make_scenario(props=(make_prop("x", 0.5, 0, size_m=(0.5, 2.8, 1)),)), 0, tmp_path / "barred")

    def fail(*_: object) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(simulate, "write_pair_truth", fail)
    with pytest.raises(InputError, match="No space left on device"):
        simulate_pair(make_scenario(), 0, tmp_path / "late")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "full"]


def test_an_empty_folder_is_a_fine_target(make_scenario: Callable[..., Scenario], tmp_path: Path) -> None:
    (tmp_path / "pair").mkdir()
    simulate_pair(make_scenario(), 0, tmp_path / "pair")
    assert sorted(path.name for path in (tmp_path / "pair").iterdir()) == ["after", "before", "truth"]


def test_a_link_to_an_empty_folder_is_a_target_that_stays_a_link(
    make_scenario: Callable[..., Scenario], tmp_path: Path
) -> None:
    home = tmp_path / "disk" / "pair"
    home.mkdir(parents=True)
    link = tmp_path / "out"
    link.symlink_to(home)
    simulate_pair(make_scenario(platform=Platform(scan_spacing_m=8.0)), 0, link)
    assert link.is_symlink()
    assert {path.name for path in home.iterdir()} == {"before", "after", "truth"}
    assert [path.name for path in (tmp_path / "disk").iterdir()] == ["pair"]
