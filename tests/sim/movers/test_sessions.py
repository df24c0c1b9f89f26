from __future__ import annotations

import hashlib
import json
import time
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import transform
from cdpipe.sensor.ouster import SensorMetadata
from scenarios import load_scenario
from scenarios.schema import Odometry, Platform, Scenario, Sensor, SessionPlan
from sim.session import simulate
from sim.session.planning import plan_drives
from sim.session.revolution import simulate_revolution
from sim.session.simulate import simulate_in_memory, simulate_pair
from sim.session.truth import read_labels, read_mover_track, read_pair_truth, read_true_poses, write_mover_track

SEED = 11


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture(scope="module", name="pair")
def pair_fixture(moving_scenario: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("moving") / "pair"
    simulate_pair(moving_scenario, SEED, out)
    return out


def test_the_same_seed_gives_the_same_bytes_in_any_number_of_threads(
    moving_scenario: Scenario, pair: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = time.time
    monkeypatch.setattr(time, "time", lambda: clock() + 3600.0)  # by which an archive stamps what it holds
    monkeypatch.setattr(simulate, "THREADS", 1)
    simulate_pair(moving_scenario, SEED, tmp_path / "again")
    assert digests(tmp_path / "again") == digests(pair)


def test_truth_lists_every_mover_and_where_it_was_seen(pair: Path) -> None:
    truth = read_pair_truth(pair)
    assert [(each.name, each.kind, each.session, each.instance) for each in truth.movers] == [
        ("walker", "person", "before", 3),
        ("curtain", "curtain", "before", 5),
        ("walker", "person", "after", 3),
        ("truck", "forklift", "after", 4),
    ]
    for name in ("before", "after"):
        movers = [each for each in truth.movers if each.session == name]
        track = read_mover_track(pair / name)
        assert track is not None and track.world_T_mover.shape == (2, len(read_true_poses(pair / name)), 4, 4)
        (labels,) = read_labels(pair / name, 1)
        for mover, n_returns, seen in zip(movers, track.n_returns, track.seen_world, strict=True):
            on_it = labels[0] == mover.instance
            assert mover.n_returns == on_it.sum() == n_returns.sum() > 100
            np.testing.assert_array_equal(n_returns, on_it.sum(axis=(1, 2)))
            np.testing.assert_array_equal(np.isnan(seen).all(axis=1), n_returns == 0)
            assert (labels[1][on_it] == 0).all()
            root = track.world_T_mover[movers.index(mover)][n_returns > 0, :3, 3]
            assert np.linalg.norm(seen[n_returns > 0, :2] - root[:, :2], axis=1).max() < 2.0
    assert 0.5 < truth.movers[0].moving_share < 1 and truth.movers[1].moving_share == 0
    assert truth.movers[0].stretch_m == pytest.approx(8.0, abs=0.6)
    assert {change.name for change in truth.changes} == {"box"}


def test_returns_on_a_mover_lie_on_it_at_their_own_time(moving_scenario: Scenario, sensor: SensorMetadata) -> None:
    ideal = Sensor(mode="512x10", range_noise=False, dropouts=False, false_positives=False)
    after = plan_drives(moving_scenario.model_copy(update={"sensor": ideal}), SEED, sensor)[1]
    trajectory, truck = after.trajectory, after.moving.movers[1]
    n_seen = 0
    for number in range(trajectory.n_scans):
        revolution = simulate_revolution(after, number)
        row, column = np.nonzero(revolution.instance == truck.instance)
        time_s = trajectory.revolution_s[number] + trajectory.column_s[column]
        reach_m = revolution.range_mm[row, column][:, None] / 1000 - sensor.beam_origin_m
        in_sensor = sensor.origins[row, column] + reach_m * sensor.directions[row, column]
        in_world = [
            transform(pose, point[None])[0]
            for pose, point in zip(trajectory.true.poses(time_s), in_sensor, strict=True)
        ]
        for point, root in zip(in_world, truck.world_T_root(time_s), strict=True):
            local = transform(np.linalg.inv(root), point[None])[0]
            assert (local > truck.figure.extent.low).all() and (local < truck.figure.extent.high).all()
        n_seen += len(row)
    assert n_seen > 500


@pytest.mark.parametrize("place_m", [np.nan, np.inf, -1e8])
def test_a_mover_that_was_seen_nowhere_or_too_far_away_is_one_line(place_m: float, pair: Path, tmp_path: Path) -> None:
    track = read_mover_track(pair / "after")
    assert track is not None
    mover, scan = np.argwhere(track.n_returns > 0)[0]
    track.seen_world[mover, scan, 1] = place_m
    write_mover_track(tmp_path, track)
    with pytest.raises(InputError, match=r"movers\.npz: damaged: a mover was seen nowhere, or farther than 1e\+07 m"):
        read_mover_track(tmp_path)


def test_a_scenario_without_movers_knows_nothing_of_them(tmp_path: Path) -> None:
    scenario = load_scenario("smoke/one_box", 10000, ["sensor.mode=512x10", "platform.scan_spacing_m=2"])
    assert "movers" not in scenario.model_dump() and "movers" not in scenario.model_dump(mode="json")
    simulate_pair(scenario, 10000, tmp_path / "pair")
    document = json.loads((tmp_path / "pair" / "truth" / "changes.json").read_text())
    assert "movers" not in document and "movers" not in document["scenario"]
    assert not list((tmp_path / "pair").rglob("movers.npz"))
    assert read_mover_track(tmp_path / "pair" / "before") is None
    assert read_pair_truth(tmp_path / "pair").movers == ()


def test_a_scenario_with_movers_survives_being_written_down(moving_scenario: Scenario) -> None:
    assert Scenario.model_validate(moving_scenario.model_dump(mode="json")) == moving_scenario


def test_kiss_icp_registers_scans_with_movers_in_them(moving_scenario: Scenario) -> None:
    pytest.importorskip("kiss_icp")
    plan = SessionPlan(route=("a", "b"), start_m=2.0, end_m=2.0, odometry=Odometry(source="kiss-icp"))
    dense = {"before": plan, "platform": Platform(scan_spacing_m=0.5)}
    held = simulate_in_memory(moving_scenario.model_copy(update=dense), SEED)
    assert [mover.n_returns > 100 for mover in held.truth.movers] == [True] * 4
    poses, true = (held.sessions["before"].session.odom_T_sensor, held.sessions["before"].world_T_sensor)
    lengths = [np.linalg.norm(each[-1, :3, 3] - each[0, :3, 3]) for each in (poses, true)]
    assert lengths[0] == pytest.approx(lengths[1], rel=0.15)
