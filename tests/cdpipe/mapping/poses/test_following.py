from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.errors import InputWarning
from cdpipe.core.geometry import Float64Array, invert, make_pose, transform, transform_each, travelled_m, yaw_pose
from cdpipe.core.geometry.motion import Motion
from cdpipe.mapping.mapping import build_map, choose_keyframes
from cdpipe.mapping.poses.consistency import make_consistent
from cdpipe.mapping.poses.following import follow
from cdpipe.mapping.poses.scan_registration import Registered, Samples, motion_through
from cdpipe.model.config import MapConfig
from cdpipe.model.types import PosedScan
from tests.cdpipe.conftest import CloudScans, scanned, tunnel_points

N_SCANS, LOST_AT, SCAN_S = 40, 28, 0.5
SPIN = yaw_pose(np.deg2rad(70.0), (1.5, 0.5, 0.1))


class SweptScans(CloudScans):
    """Scans of 0.2 s, deskewed by the recorded motion, that were seen from true poses."""

    def __init__(self, recorded: Float64Array, true: Float64Array, clouds: list[Float64Array]) -> None:
        super().__init__("swept", recorded, clouds)
        time_s = np.arange(1, len(true) + 1) * SCAN_S * 1.0
        self._recorded, self._true = motion_through(time_s, recorded), motion_through(time_s, true)

    def scan(self, index: int) -> PosedScan:
        scan = super().scan(index)
        turn = np.arctan2(scan.points_sensor[:, 1], scan.points_sensor[:, 0]) / (2 * np.pi)
        pose_ns = round(SCAN_S * (index + 1) * 1e9)
        stamps_ns = pose_ns + np.round(turn * 0.2e9).astype(np.int64)
        at_s, then_s = np.array([pose_ns / 1e9]), stamps_ns / 1e9
        then_T_sensor = invert(self._true.poses(then_s)) @ self._true.poses(at_s)
        deskewed_T_then = invert(self._recorded.poses(at_s)) @ self._recorded.poses(then_s)
        points = transform_each(deskewed_T_then @ then_T_sensor, scan.points_sensor)
        return replace(scan, points_sensor=points, stamps_ns=stamps_ns, pose_ns=pose_ns, airborne_sensor=points[:1])


@pytest.fixture(scope="module")
def tunnel() -> CloudScans:
    whole = scanned("drive", make_pose(), 0, 1, [])
    return with_poses(whole, whole.odom_T_sensor[:N_SCANS])


def with_poses(source: CloudScans, poses: Float64Array) -> CloudScans:
    return CloudScans(source.name, poses, [source.scan(index).points_sensor for index in range(len(poses))])


def lost(true: Float64Array, at: int) -> Float64Array:
    """The poses of an odometry that spins from a scan on to the end."""
    poses = true.copy()
    for index in range(at, len(true)):
        poses[index] = poses[index - 1] @ SPIN
    return poses


def steps_off_m(poses: Float64Array, true: Float64Array) -> Float64Array:
    errors = invert(invert(true[:-1]) @ true[1:]) @ invert(poses[:-1]) @ poses[1:]
    return np.asarray(np.linalg.norm(errors[:, :3, 3], axis=1))


def seen_from(true: Float64Array) -> list[Float64Array]:
    """Six thousand points of the test tunnel within 12 m of each pose, sensor frame."""
    points, rng, clouds = tunnel_points(0, 1), np.random.default_rng(0), []
    for pose in true:
        near = points[np.linalg.norm(points - pose[:3, 3], axis=1) < 12.0]
        clouds.append(transform(invert(pose), rng.choice(near, 6000, replace=False) + rng.normal(0, 0.005, (6000, 3))))
    return clouds


@pytest.mark.parametrize("at", [8, 16, 20, 28])  # before the middle, at it, and behind it
def test_an_odometry_that_spins_to_the_end_is_found_again(tunnel: CloudScans, at: int) -> None:
    true = tunnel.odom_T_sensor
    source = with_poses(tunnel, lost(true, at))
    assert np.count_nonzero(steps_off_m(source.odom_T_sensor, true) > 1.0) >= N_SCANS - at
    told = f"loses its way: {N_SCANS - at} of 39 steps, first from scan {at - 1} to {at}, beside the walls, found anew"
    with pytest.warns(InputWarning, match=told):
        consistent = make_consistent(source)
    assert steps_off_m(consistent.odom_T_sensor, true).max() < 0.06


@pytest.mark.parametrize("jump_m", [3.0, 4.0])
def test_one_wrong_step_is_no_way_that_the_registration_lost(tunnel: CloudScans, jump_m: float) -> None:
    true = tunnel.odom_T_sensor
    jumped = true.copy()
    jumped[24:] = jumped[23] @ make_pose(translation=(jump_m, 0.0, 0.0)) @ invert(true[23]) @ true[24:]
    with pytest.warns(InputWarning, match="its way: the step from scan 23 to 24, beside the walls, found anew"):
        consistent = make_consistent(with_poses(tunnel, jumped))
    assert steps_off_m(consistent.odom_T_sensor, true).max() < 0.06


@pytest.mark.parametrize("turn_deg", [58.0, 90.0, 120.0])
def test_one_wrong_turn_is_found_though_the_scans_behind_it_agree(tunnel: CloudScans, turn_deg: float) -> None:
    true = tunnel.odom_T_sensor
    turned = true.copy()
    turned[24:] = turned[23] @ yaw_pose(np.deg2rad(turn_deg), (0.5, 0.0, 0.0)) @ invert(true[23]) @ true[24:]
    with pytest.warns(InputWarning, match="its way: the step from scan 23 to 24, beside the walls, found anew"):
        consistent = make_consistent(with_poses(tunnel, turned))
    assert steps_off_m(consistent.odom_T_sensor, true).max() < 0.06


def test_a_lost_last_scan_is_found(tunnel: CloudScans) -> None:
    true = tunnel.odom_T_sensor
    with pytest.warns(InputWarning, match="its way: the step from scan 38 to 39, beside the walls, found anew"):
        consistent = make_consistent(with_poses(tunnel, lost(true, N_SCANS - 1)))
    assert steps_off_m(consistent.odom_T_sensor, true).max() < 0.06


@pytest.mark.parametrize("n_wrong", [12, 1])
def test_an_odometry_is_lost_though_the_sensor_stands(tunnel: CloudScans, n_wrong: int) -> None:
    true = tunnel.odom_T_sensor[[*range(28), *[27] * 12]]
    recorded = lost(true, 28)
    if n_wrong == 1:  # a jump at the stand
        recorded = true.copy()
        recorded[34:, 0, 3] += 3.0
    with pytest.warns(InputWarning, match="12 of 39 steps" if n_wrong > 1 else "the step from scan 33 to 34"):
        consistent = make_consistent(CloudScans("standing", recorded, seen_from(true)))
    assert steps_off_m(consistent.odom_T_sensor, true).max() < 0.06


@pytest.mark.parametrize("missed_m", [0.0, 0.5])
def test_a_turn_on_the_spot_that_the_odometry_misses_is_found(tunnel: CloudScans, missed_m: float) -> None:
    ahead = tunnel.odom_T_sensor[:18]
    true = np.concatenate([ahead, ahead[::-1] @ yaw_pose(np.deg2rad(90.0), (0.0, 0.0, 0.0))])
    recorded = true.copy()
    recorded[18:] = ahead[-1] @ make_pose(translation=(missed_m, 0.0, 0.0)) @ invert(true[18]) @ true[18:]
    with pytest.warns(InputWarning, match="its way: the step from scan 17 to 18"):
        consistent = make_consistent(CloudScans("turning", recorded, seen_from(true)))
    assert steps_off_m(consistent.odom_T_sensor, true).max() < 0.06


@pytest.mark.parametrize("n_points", [0, 20])
def test_a_scan_of_few_points_is_no_jump(tunnel: CloudScans, n_points: int) -> None:
    clouds = [tunnel.scan(index).points_sensor for index in range(N_SCANS)]
    path_m = travelled_m(tunnel.odom_T_sensor)
    last = int(np.flatnonzero(np.diff(np.floor(path_m / 4.0)))[2])  # of the third block
    clouds[last] = clouds[last][:n_points]
    consistent = make_consistent(CloudScans("dropped", tunnel.odom_T_sensor, clouds))
    np.testing.assert_array_equal(consistent.odom_T_sensor, tunnel.odom_T_sensor)


@pytest.mark.parametrize(("spacing_m", "n_scans"), [(2.0, 20), (4.0, 12)])
def test_an_odometry_is_not_lost_because_rings_lie_on_rings(spacing_m: float, n_scans: int) -> None:
    """Eight beams, as an OS0-8 has: the rings of two scans lie on one another best where the sensor stands."""
    rng = np.random.default_rng(0)
    waves = rng.uniform((0.3, 1.0, 0.0), (3.0, 6.0, 2 * np.pi), (12, 3))
    true = make_pose(translation=np.column_stack([np.arange(n_scans) * spacing_m, np.zeros((n_scans, 2))]))
    turn, rise = np.meshgrid(np.arange(512) / 512 * 2 * np.pi, np.deg2rad(np.linspace(-45, 45, 8)))
    ray = np.stack([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)], axis=-1).reshape(-1, 3)
    around = np.arctan2(ray[:, 2], ray[:, 1])

    def seen(along_m: float) -> Float64Array:
        range_m = np.full(len(ray), 5.0)
        for _ in range(8):  # walls at 5 m, a floor 1.5 m below, 0.15 m rough
            at_m = along_m + range_m * ray[:, 0]
            rough_m = sum(0.15 * np.sin(k * at_m + np.round(m) * around + p) for k, m, p in waves) / np.sqrt(12)
            with np.errstate(divide="ignore"):
                floor_m = (1.5 + 0.3 * rough_m) / np.abs(ray[:, 2])
                across_m, roof_m = ((5.0 + rough_m) / np.abs(ray[:, axis]) for axis in (1, 2))
            range_m = np.minimum(np.minimum(across_m, np.where(ray[:, 2] < 0, floor_m, roof_m)), 70.0)
        is_near = range_m < 60.0
        return ray[is_near] * (range_m[is_near] + rng.normal(0, 0.01, np.count_nonzero(is_near)))[:, None]

    recorded = true @ make_pose(translation=rng.normal(0, 0.03, (n_scans, 3)))
    consistent = make_consistent(CloudScans("rings", recorded, [seen(x) for x in true[:, 0, 3]]))
    assert steps_off_m(consistent.odom_T_sensor, true).max() < 0.2


@pytest.mark.parametrize(("spacing_m", "loose"), [(2.5, 0.2), (3.0, 0.15), (3.0, 0.3)])
def test_loose_points_make_no_scan_lost(spacing_m: float, loose: float) -> None:
    """In a smooth drift with posts more points of a scan overlap with those of a scan nearby, wrong as the place is."""
    rng = np.random.default_rng(0)
    angle, along = rng.uniform(0, 2 * np.pi, 200_000), rng.uniform(-15, 85, 200_000)
    wall = np.column_stack([along, 2.5 * np.cos(angle), 2.5 * np.sin(angle)])
    posts = [
        np.column_stack([x + 0.15 * np.cos(turn), side + 0.15 * np.sin(turn), rng.uniform(-2, 2, 300)])
        for x, side in zip(rng.uniform(-10, 80, 40), rng.choice([-2.0, 2.0], 40), strict=True)
        for turn in [rng.uniform(0, 2 * np.pi, 300)]
    ]
    rock = np.concatenate([wall, *posts])
    true = make_pose(
        translation=np.column_stack([np.arange(0, 68, spacing_m), *np.zeros((2, len(np.arange(0, 68, spacing_m))))])
    )
    clouds = []
    for pose in true:
        seen = rock[np.abs(rock[:, 0] - pose[0, 3]) < 12.0] - pose[:3, 3]
        seen = seen[rng.random(len(seen)) < 0.25] + rng.normal(0, 0.01, 3)
        is_loose = rng.random(len(seen)) < loose
        seen[is_loose] *= rng.uniform(0.3, 0.95, (np.count_nonzero(is_loose), 1))
        clouds.append(seen)
    recorded = true @ make_pose(translation=rng.uniform(-0.1, 0.1, (len(true), 3)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # nothing is told of the odometry
        consistent = make_consistent(CloudScans("loose", recorded, clouds))
    assert steps_off_m(consistent.odom_T_sensor, true).max() < 0.3


@pytest.mark.parametrize("at", [12, 28])
def test_its_scans_are_deskewed_anew(tunnel: CloudScans, at: int) -> None:
    true, clouds = tunnel.odom_T_sensor, [tunnel.scan(index).points_sensor for index in range(N_SCANS)]
    source = SweptScans(lost(true, at), true, clouds)

    def off_m(scan: PosedScan) -> float:
        return float(np.percentile(np.linalg.norm(scan.points_sensor - clouds[scan.index], axis=1), 90))

    assert off_m(source.scan(34)) > 0.5
    with pytest.warns(InputWarning, match="loses its way"):
        consistent = make_consistent(source)
    assert steps_off_m(consistent.odom_T_sensor, true).max() < 0.15
    scans = list(consistent.scans())
    bent = [
        scan.index for scan in scans if not len(scan.points_sensor)
    ]  # beside the scan that the others are found from
    assert len(bent) <= 2
    assert max(off_m(scan) for scan in scans if scan.index not in bent) < 0.1
    assert scans[34].airborne_sensor is None and scans[5].airborne_sensor is not None
    for again in (consistent.scan(34), consistent.over(source).scan(34)):
        np.testing.assert_array_equal(scans[34].points_sensor, again.points_sensor)
    # the others stay as they are recorded
    np.testing.assert_array_equal(scans[5].points_sensor, source.scan(5).points_sensor)


def test_keyframes_stay_those_of_the_recorded_path(tunnel: CloudScans) -> None:
    """Whoever reads an answer has the recorded poses, and tells by the keyframes whether it is one to the session."""
    source = with_poses(tunnel, lost(tunnel.odom_T_sensor, LOST_AT))
    with pytest.warns(InputWarning, match="loses its way"):
        point_map = build_map(source, MapConfig(consistency="scan-to-map"))
    np.testing.assert_array_equal(point_map.keyframe_scans, choose_keyframes(source.odom_T_sensor, 1.0))
    assert point_map.recorded_T_sensor is not None
    np.testing.assert_array_equal(point_map.recorded_T_sensor, source.odom_T_sensor)


def test_scans_with_loose_points_do_not_keep_a_lost_one_from_being_found(tunnel: CloudScans) -> None:
    rng, clouds = np.random.default_rng(1), [tunnel.scan(index).points_sensor.copy() for index in range(N_SCANS)]
    for cloud in clouds[21:33]:
        is_loose = rng.random(len(cloud)) < 0.5
        cloud[is_loose] *= rng.uniform(0.5, 0.9, (np.count_nonzero(is_loose), 1))
    _, is_wrong = follow(Samples(CloudScans("loose", lost(tunnel.odom_T_sensor, 34), clouds)), lambda: None)
    assert np.flatnonzero(is_wrong).tolist() == [33, 34, 35, 36, 37, 38]


def test_headings_are_tried_where_no_guess_meets_a_wall(tunnel: CloudScans, monkeypatch: pytest.MonkeyPatch) -> None:
    n_registered: list[int] = []

    def meet_nothing(points: Float64Array, guess: Float64Array, *_: object) -> Registered:
        n_registered.append(len(points))
        return Registered(guess, 0.0, 0.0)

    scans = Samples(with_poses(tunnel, tunnel.odom_T_sensor[:3]))
    monkeypatch.setattr("cdpipe.mapping.poses.following.register_scan", meet_nothing)
    follow(scans, lambda: None)
    # 7 scans to start from; two scans, each followed once, then sought with two settings
    assert len(n_registered) == 7 + 2 * (1 + 2 * (3 + 17))


def test_scans_that_lie_on_the_walls_are_not_looked_for(tunnel: CloudScans, monkeypatch: pytest.MonkeyPatch) -> None:
    off = make_pose(translation=np.random.default_rng(0).normal(0, 0.05, (N_SCANS, 3)))
    scans = Samples(with_poses(tunnel, tunnel.odom_T_sensor @ off))
    n_told: list[int] = []
    monkeypatch.setattr("cdpipe.mapping.poses.following._find_again", None)
    _, is_wrong = follow(scans, lambda: n_told.append(1))
    assert not is_wrong.any() and len(n_told) == N_SCANS - 1


def test_times_that_do_not_rise_make_no_motion(tunnel: CloudScans) -> None:
    class Timed(CloudScans):
        def scan(self, index: int) -> PosedScan:
            return replace(super().scan(index), pose_ns=self.times_ns[index])

        times_ns: list[int | None]

    cases: list[tuple[list[int | None], bool]] = [([0, 1, 2], True), ([0, 2, 2], False), ([0, None, 2], False)]
    for times_ns, is_motion in cases:
        timed = Timed("timed", tunnel.odom_T_sensor[:3], [tunnel.scan(index).points_sensor for index in range(3)])
        timed.times_ns = times_ns
        assert isinstance(Samples(timed).motion, Motion) == is_motion


def test_scans_that_agree_nowhere_are_not_looked_for_to_the_end(
    tunnel: CloudScans, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    clouds = [rng.uniform(-5, 5, (2000, 3)) for _ in range(N_SCANS)]
    n_sought: list[int] = []

    def find_nothing(*_: object) -> Registered:
        n_sought.append(1)
        return Registered(np.eye(4), 0.0, 0.0)

    monkeypatch.setattr("cdpipe.mapping.poses.following._find_again", find_nothing)
    _, is_wrong = follow(Samples(CloudScans("noise", tunnel.odom_T_sensor, clouds)), lambda: None)
    assert 0 < len(n_sought) < 10 and not is_wrong.any()
