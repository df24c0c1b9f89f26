from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, invert, make_pose, stream
from cdpipe.core.geometry.poses import require_poses
from cdpipe.mapping.mapping import build_map
from cdpipe.mapping.poses import consistency
from cdpipe.mapping.poses.consistency import make_consistent
from cdpipe.mapping.poses.scan_registration import spread
from cdpipe.model.config import MapConfig, load_config
from cdpipe.model.types import PosedScan
from tests.cdpipe.conftest import CloudScans, scanned

JITTER_M, JITTER_RAD = 0.05, 0.005


def jittered(source: CloudScans, seed: int, along_only: bool = False) -> CloudScans:
    """The session with poses that err from scan to scan."""
    rng = stream(seed, "jitter")
    n = len(source.odom_T_sensor)
    shifts = rng.normal(0, JITTER_M, (n, 3)) * ([1, 0, 0] if along_only else [1, 1, 1])
    turns = Rotation.from_rotvec(rng.normal(0, 0.0 if along_only else JITTER_RAD, (n, 3))).as_matrix()
    return replaced(source, source.odom_T_sensor @ make_pose(turns, shifts))


def replaced(source: CloudScans, poses: Float64Array) -> CloudScans:
    return CloudScans(source.name, poses, [source.scan(index).points_sensor for index in range(len(poses))])


def steps_off_m(poses: Float64Array, true: Float64Array) -> Float64Array:
    """(S - 1,) how far the step to each scan is off: local errors, not the slow drift."""
    errors = invert(invert(true[:-1]) @ true[1:]) @ invert(poses[:-1]) @ poses[1:]
    return np.asarray(np.linalg.norm(errors[:, :3, 3], axis=1))


@pytest.fixture(scope="module")
def tunnel() -> CloudScans:
    whole = scanned("drive", make_pose(), 0, 1, [])
    return replaced(whole, whole.odom_T_sensor[:40])


def test_jitter_from_scan_to_scan_goes(tunnel: CloudScans) -> None:
    noisy = jittered(tunnel, 0)
    consistent = make_consistent(noisy)
    before = np.median(steps_off_m(noisy.odom_T_sensor, tunnel.odom_T_sensor))
    after = np.median(steps_off_m(consistent.odom_T_sensor, tunnel.odom_T_sensor))
    assert before > 0.08 and after < 0.02
    # scans keep their points, and the path stays near the recorded one
    np.testing.assert_array_equal(consistent.scan(7).points_sensor, noisy.scan(7).points_sensor)
    np.testing.assert_array_equal(consistent.scan(7).odom_T_sensor, consistent.odom_T_sensor[7])
    scans = list(consistent.scans())
    assert [scan.index for scan in scans] == list(range(len(noisy.odom_T_sensor)))
    np.testing.assert_array_equal(scans[7].odom_T_sensor, consistent.odom_T_sensor[7])
    assert np.abs(consistent.odom_T_sensor[:, :3, 3] - noisy.odom_T_sensor[:, :3, 3]).max() < 6 * JITTER_M


def test_scans_that_agree_keep_their_recorded_poses(tunnel: CloudScans) -> None:
    np.testing.assert_array_equal(make_consistent(tunnel).odom_T_sensor, tunnel.odom_T_sensor)


def test_poses_that_went_through_float32_are_made_consistent(tunnel: CloudScans) -> None:
    # rotations that are rigid to 6e-7, as float32 leaves them: chained as they are, 20 of them are off by 1e-5
    noisy, rounded = jittered(tunnel, 0), jittered(tunnel, 0).odom_T_sensor
    rounded[:, :3, :3] *= 1 + 3e-7
    found = make_consistent(replaced(noisy, rounded)).odom_T_sensor
    require_poses("found", found)
    np.testing.assert_allclose(found, make_consistent(noisy).odom_T_sensor, atol=1e-4)
    agreeing = replaced(tunnel, tunnel.odom_T_sensor.astype(np.float32).astype(np.float64))
    np.testing.assert_array_equal(make_consistent(agreeing).odom_T_sensor, agreeing.odom_T_sensor)


def test_roll_from_scan_to_scan_goes_though_no_position_is_off(tunnel: CloudScans) -> None:
    rolls = Rotation.from_rotvec(stream(0, "roll").normal(0, np.deg2rad(1.0), (40, 1)) * [1, 0, 0])
    noisy = replaced(tunnel, tunnel.odom_T_sensor @ make_pose(rolls.as_matrix(), np.zeros((40, 3))))
    found = make_consistent(noisy).odom_T_sensor
    off = invert(invert(tunnel.odom_T_sensor[:-1]) @ tunnel.odom_T_sensor[1:]) @ invert(found[:-1]) @ found[1:]
    assert np.rad2deg(np.median(Rotation.from_matrix(off[:, :3, :3]).magnitude())) < 0.3


def test_jitter_of_few_scans_goes_though_each_finds_itself_in_the_map_of_all() -> None:
    # 16 scans of 2000 points, 3 m apart: registered with all, they move by 0.7 cm at 2.5 cm of jitter
    whole = scanned("drive", make_pose(), 0, 1, [])
    chosen = np.arange(0, 96, 6)
    true = CloudScans("sparse", whole.odom_T_sensor[chosen], [whole.scan(int(k)).points_sensor[::3] for k in chosen])
    np.testing.assert_array_equal(make_consistent(true).odom_T_sensor, true.odom_T_sensor)
    shifts = stream(0, "sparse").normal(0, 0.025, (len(chosen), 3))
    noisy = replaced(true, true.odom_T_sensor @ make_pose(translation=shifts))
    before = np.median(steps_off_m(noisy.odom_T_sensor, true.odom_T_sensor))
    after = np.median(steps_off_m(make_consistent(noisy).odom_T_sensor, true.odom_T_sensor))
    assert before > 0.04 and after < 0.025


def test_one_jump_is_found_and_mended(tunnel: CloudScans) -> None:
    slipped, at = tunnel.odom_T_sensor.copy(), 19
    slipped[at:, 0, 3] += 0.5  # the wheels turn on the spot
    found = make_consistent(replaced(tunnel, slipped)).odom_T_sensor
    assert steps_off_m(slipped, tunnel.odom_T_sensor)[at - 1] > 0.49
    assert steps_off_m(found, tunnel.odom_T_sensor).max() < 0.05


@pytest.mark.parametrize(("share", "is_kept"), [(0.5, True), (0.9, False)])
def test_a_registration_that_loses_the_way_is_not_believed(
    tunnel: CloudScans, monkeypatch: pytest.MonkeyPatch, share: float, is_kept: bool
) -> None:
    noisy = jittered(tunnel, 3)
    shrunk = noisy.odom_T_sensor.copy()
    shrunk[:, :3, 3] *= share  # as where rings on the ground match rings
    monkeypatch.setattr(consistency, "follow", lambda *_: (shrunk, np.zeros(len(shrunk) - 1, dtype=np.bool_)))
    monkeypatch.setattr(consistency, "_sweep_all", lambda _, poses, *__, **___: (poses, np.zeros(len(poses))))
    expected = noisy.odom_T_sensor if is_kept else shrunk
    np.testing.assert_array_equal(make_consistent(noisy).odom_T_sensor, expected)
    standing = replaced(noisy, noisy.odom_T_sensor * 1.0)
    standing.odom_T_sensor[:, :3, 3] = stream(4, "jitter").normal(0, 0.02, (len(shrunk), 3))
    shrunk[:, :3, 3] = 0.0
    np.testing.assert_array_equal(make_consistent(standing).odom_T_sensor, shrunk)  # its way is jitter


def test_scans_of_one_stop_are_judged_together(monkeypatch: pytest.MonkeyPatch) -> None:
    path_m = np.concatenate([np.arange(0, 20, 0.5), np.full(3000, 20.0), np.arange(20.5, 40, 0.5)])
    off_share = stream(0, "bent").uniform(0, 0.03, len(path_m))
    off_share[[10, 1000, 3060]] = 0.2
    n_medians = 0

    def median(values: Float64Array) -> float:
        nonlocal n_medians
        n_medians += 1
        return float(np.percentile(values, 50))

    monkeypatch.setattr(np, "median", median)
    assert np.flatnonzero(consistency._find_bent(path_m, off_share)).tolist() == [10, 1000, 3060]
    assert n_medians == 80


def test_the_first_sweep_ends_once_it_is_certain_and_decides_as_a_whole_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng, n_blocks_seen = np.random.default_rng(0), []
    for n in (2, 3, 10, 11, 12, 21, 40):
        for share in (0.0, 0.05, 0.1, 0.15, 0.5):
            moved_m = np.where(rng.random(n) < share, 0.02, 0.01)
            moved = make_pose(translation=np.column_stack([moved_m, np.zeros((n, 2))]))
            given: list[int] = []

            def blocks(*_: object, moved: Float64Array = moved, given: list[int] = given, **__: object) -> object:
                for own in np.array_split(np.arange(len(moved)), max(1, len(moved) // 3)):
                    given.append(len(own))
                    yield own, moved[own], np.zeros(len(own))

            monkeypatch.setattr(consistency, "_sweep", blocks)
            monkeypatch.setattr(consistency, "_has_jump", lambda *_: False)
            told = consistency._Told(lambda step, done, total: None, n)
            decided = consistency._agree(None, np.repeat(np.eye(4)[None], n, axis=0), told)  # type: ignore[arg-type]
            assert decided == (np.percentile(moved_m, 90) <= 0.015)
            n_blocks_seen.append((sum(given), n))
    assert any(seen < n / 2 for seen, n in n_blocks_seen)


def test_a_scan_that_was_shaken_within_its_revolution_adds_no_points(tunnel: CloudScans) -> None:
    noisy = jittered(tunnel, 0)
    clouds = [noisy.scan(index).points_sensor for index in range(len(noisy.odom_T_sensor))]
    of_turn = np.arctan2(clouds[20][:, 1], clouds[20][:, 0]) / np.pi
    shaken = Rotation.from_rotvec(np.deg2rad(6.0) * np.outer(of_turn, [0, 1, 0])).apply(clouds[20])
    clouds[20] = shaken
    consistent = make_consistent(CloudScans(noisy.name, noisy.odom_T_sensor, clouds))
    sizes = [len(scan.points_sensor) for scan in consistent.scans()]
    assert sizes == [0 if index == 20 else len(cloud) for index, cloud in enumerate(clouds)]
    assert len(consistent.scan(20).points_sensor) == len(consistent.scan(20).pixels) == 0
    point_map = build_map(CloudScans(noisy.name, noisy.odom_T_sensor, clouds), MapConfig(consistency="scan-to-map"))
    assert 20 not in point_map.scans_of(np.arange(len(point_map.return_points)))


def test_scans_of_a_place_with_loose_walls_are_kept(tunnel: CloudScans) -> None:
    noisy, rng = jittered(tunnel, 0), stream(0, "loose")
    clouds = [noisy.scan(index).points_sensor.copy() for index in range(len(noisy.odom_T_sensor))]
    for cloud in clouds:  # a tenth of all returns is of something that moves
        loose = rng.random(len(cloud)) < 0.1
        cloud[loose] *= rng.uniform(0.8, 0.95, (np.count_nonzero(loose), 1))
    scans = make_consistent(CloudScans(noisy.name, noisy.odom_T_sensor, clouds)).scans()
    assert all(len(scan.points_sensor) for scan in scans)


def test_a_slow_drift_stays(tunnel: CloudScans) -> None:
    # 2 % too long and 1 degree off over the tunnel: nothing within one session contradicts it
    poses = tunnel.odom_T_sensor.copy()
    poses[:, :3, 3] *= 1.02
    n = len(poses)
    turns = Rotation.from_rotvec(np.linspace(0, np.deg2rad(1.0), n)[:, None] * [0, 0, 1]).as_matrix()
    drifting = replaced(tunnel, make_pose(turns, np.zeros((n, 3))) @ poses)
    found = make_consistent(jittered(drifting, 1)).odom_T_sensor
    assert np.linalg.norm((found - drifting.odom_T_sensor)[:, :3, 3], axis=1).max() < 6 * JITTER_M


def test_a_tunnel_that_tells_no_place_along_keeps_the_odometry_along_it() -> None:
    rng = stream(0, "smooth")
    clouds, poses = [], []
    for x_m in np.arange(0, 20, 0.5):
        along, angle = rng.uniform(-10, 10, 4000), rng.uniform(0, 2 * np.pi, 4000)
        walls = np.column_stack([along, 2.5 * np.cos(angle), 2.5 * np.sin(angle)])
        clouds.append(walls + rng.normal(0, 0.01, walls.shape))
        poses.append(make_pose(translation=(x_m, 0, 0)))
    smooth = CloudScans("smooth", np.array(poses), clouds)
    noisy = jittered(smooth, 2)
    found = make_consistent(noisy).odom_T_sensor
    across = np.linalg.norm(found[:, 1:3, 3] - found[:, 1:3, 3].mean(axis=0), axis=1)
    assert np.median(across) < 0.015 < np.median(np.linalg.norm(noisy.odom_T_sensor[:, 1:3, 3], axis=1))
    assert np.abs(found[:, 0, 3] - noisy.odom_T_sensor[:, 0, 3]).max() < 4 * JITTER_M


def test_one_scan_of_a_smooth_drift_keeps_its_pose() -> None:
    rng = stream(1, "alone")
    angle, along, radius_m = (
        rng.uniform(0, 2 * np.pi, 20_000),
        rng.uniform(-12, 12, 20_000),
        rng.normal(3, 0.02, 20_000),
    )
    walls = np.column_stack([along, radius_m * np.cos(angle), radius_m * np.sin(angle)])
    alone = CloudScans("alone", make_pose(np.eye(3)[None], np.ones((1, 3))), [walls])
    np.testing.assert_array_equal(make_consistent(alone).odom_T_sensor, alone.odom_T_sensor)


def test_the_map_of_a_sensor_that_stands_has_no_more_than_200_scans() -> None:
    assert spread(np.arange(7, 207)).tolist() == list(range(7, 207))
    chosen = spread(np.arange(0, 10_000, 2))
    assert len(np.unique(chosen)) == 200 and (chosen[0], chosen[-1]) == (0, 9998)
    assert np.isin(chosen % 2, 0).all()  # halves stay apart


def test_a_scan_with_nothing_near_keeps_its_pose(tunnel: CloudScans) -> None:
    clouds = [tunnel.scan(index).points_sensor for index in range(12)]
    clouds[6] = np.array([[25.0, 0.0, 0.0], [25.0, 1.0, 0.0]])
    noisy = jittered(CloudScans("gap", tunnel.odom_T_sensor[:12], clouds), 0)
    found = make_consistent(noisy).odom_T_sensor
    assert np.abs(found[:, :3, 3] - noisy.odom_T_sensor[:, :3, 3]).max() < 6 * JITTER_M


@pytest.mark.parametrize("n_scans", [1, 2])
def test_a_session_of_a_scan_or_two_is_mapped(tunnel: CloudScans, n_scans: int) -> None:
    few = replaced(tunnel, tunnel.odom_T_sensor[:n_scans])
    assert make_consistent(few).odom_T_sensor.shape == (n_scans, 4, 4)


def test_a_map_knows_its_recorded_poses_and_keyframes(tunnel: CloudScans) -> None:
    noisy = jittered(tunnel, 0)
    plain, consistent = (build_map(noisy, MapConfig(consistency=each)) for each in ("none", "scan-to-map"))
    assert plain.recorded_T_sensor is None and consistent.recorded_T_sensor is not None
    np.testing.assert_array_equal(consistent.recorded_T_sensor, noisy.odom_T_sensor)
    np.testing.assert_array_equal(consistent.keyframe_scans, plain.keyframe_scans)
    assert len(consistent.points) < 0.9 * len(plain.points)  # walls are thinner
    with pytest.raises(ValueError, match="recorded_T_sensor"):
        replace(plain, recorded_T_sensor=noisy.odom_T_sensor[:-1])


def test_presets_of_the_paper_map_with_the_recorded_poses() -> None:
    assert load_config("tunnelcd").map.consistency == "graph"
    for preset in ("paper", "paper-topn", "paper-paired", "scan-context", "solid", "frame"):
        assert "consistency" not in load_config(preset).model_dump()["map"], preset
    assert load_config("tunnelcd").model_dump()["map"]["consistency"] == "graph"


def test_a_bent_scan_does_not_tell_of_its_mist_either(tunnel: CloudScans) -> None:
    class Misty(CloudScans):
        def scan(self, index: int) -> PosedScan:
            return replace(super().scan(index), airborne_sensor=np.array([[2.0, 0.0, 0.0]]))

    clouds = [tunnel.scan(index).points_sensor for index in range(2)]
    source = Misty("misty", tunnel.odom_T_sensor[:2], clouds)
    scans = consistency.ConsistentScans(source, source.odom_T_sensor, np.array([True, False]))
    for bent, kept in (list(scans.scans()), [scans.scan(0), scans.scan(1)]):
        assert len(bent.points_sensor) == 0 and bent.airborne_sensor is None
        assert len(kept.points_sensor) == len(clouds[1])
        np.testing.assert_array_equal(kept.airborne_sensor, [[2.0, 0.0, 0.0]])


@pytest.mark.parametrize("seed", [0, 1])
def test_a_path_is_tipped_by_its_first_scan_alone(tunnel: CloudScans, seed: int) -> None:
    # jitter tips single scans by up to a degree; the frame is that of the first scan, and over the way nothing is added
    true, noisy = tunnel.odom_T_sensor, jittered(tunnel, seed)

    def tilts_deg(poses: Float64Array) -> Float64Array:
        poses = true[0] @ invert(poses[0]) @ poses
        up = np.einsum("sk,sk->s", poses[:, 2, :3], true[:, 2, :3])
        return np.asarray(np.rad2deg(np.arccos(np.clip(up, -1.0, 1.0))))

    recorded, found = tilts_deg(noisy.odom_T_sensor), tilts_deg(make_consistent(noisy).odom_T_sensor)
    assert recorded.max() > 0.8 > 8 * found.max()
