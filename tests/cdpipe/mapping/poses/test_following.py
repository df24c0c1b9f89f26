from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.errors import InputWarning
from cdpipe.core.geometry import BoolArray, Float64Array, invert, make_pose, yaw_pose
from cdpipe.core.geometry.motion import Motion
from cdpipe.mapping.deskew import deskew_anew
from cdpipe.mapping.poses import consistency
from cdpipe.mapping.poses.consistency import make_consistent
from cdpipe.mapping.poses.following import follow
from cdpipe.mapping.poses.scan_registration import Registered, Samples, motion_through
from cdpipe.model.types import PosedScan
from tests.cdpipe.conftest import CloudScans, scanned

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
        true = replace(scan, stamps_ns=pose_ns + np.round(turn * 0.2e9).astype(np.int64), pose_ns=pose_ns)
        return deskew_anew(true, self._true, self._recorded)


@pytest.fixture(scope="module")
def tunnel() -> CloudScans:
    whole = scanned("drive", make_pose(), 0, 1, [])
    return with_poses(whole, whole.odom_T_sensor[:N_SCANS])


def with_poses(source: CloudScans, poses: Float64Array) -> CloudScans:
    return CloudScans(source.name, poses, [source.scan(index).points_sensor for index in range(len(poses))])


def lost(true: Float64Array, at: int) -> Float64Array:
    """The poses of an odometry that spins from a scan on: to the end, or back to the start."""
    poses, is_late = true.copy(), at > len(true) // 2
    for index in range(at, len(true)) if is_late else range(at, -1, -1):
        poses[index] = poses[index - 1] @ SPIN if is_late else poses[index + 1] @ invert(SPIN)
    return poses


def steps_off_m(poses: Float64Array, true: Float64Array) -> Float64Array:
    errors = invert(invert(true[:-1]) @ true[1:]) @ invert(poses[:-1]) @ poses[1:]
    return np.asarray(np.linalg.norm(errors[:, :3, 3], axis=1))


@pytest.mark.parametrize("at", [LOST_AT, 12])
def test_an_odometry_that_spins_to_an_end_is_found_again(tunnel: CloudScans, at: int) -> None:
    true = tunnel.odom_T_sensor
    source = with_poses(tunnel, lost(true, at))
    assert np.count_nonzero(steps_off_m(source.odom_T_sensor, true) > 1.0) >= N_SCANS - LOST_AT
    with pytest.warns(InputWarning, match=rf"loses its way at scan {at if at > 20 else 0} of 40: 1[23] scans beside"):
        consistent = make_consistent(source)
    assert steps_off_m(consistent.odom_T_sensor, true).max() < 0.06


def test_its_scans_are_deskewed_anew(tunnel: CloudScans) -> None:
    true, clouds = tunnel.odom_T_sensor, [tunnel.scan(index).points_sensor for index in range(N_SCANS)]
    source = SweptScans(lost(true, LOST_AT), true, clouds)

    def off_m(scan: PosedScan) -> float:
        return float(np.percentile(np.linalg.norm(scan.points_sensor - clouds[scan.index], axis=1), 90))

    assert off_m(source.scan(34)) > 0.5
    with pytest.warns(InputWarning, match="loses its way"):
        consistent = make_consistent(source)
    assert steps_off_m(consistent.odom_T_sensor, true).max() < 0.06
    scans = list(consistent.scans())
    assert max(map(off_m, scans)) < 0.05
    np.testing.assert_array_equal(scans[34].points_sensor, consistent.scan(34).points_sensor)
    np.testing.assert_array_equal(scans[34].points_sensor, consistent.over(source).scan(34).points_sensor)
    # the others stay as they are recorded
    np.testing.assert_array_equal(scans[5].points_sensor, source.scan(5).points_sensor)


def test_scans_that_lie_on_the_walls_are_not_looked_for(tunnel: CloudScans, monkeypatch: pytest.MonkeyPatch) -> None:
    off = make_pose(translation=np.random.default_rng(0).normal(0, 0.05, (N_SCANS, 3)))
    scans = Samples(with_poses(tunnel, tunnel.odom_T_sensor @ off))
    n_told: list[int] = []
    monkeypatch.setattr("cdpipe.mapping.poses.following._find_again", None)
    _, is_lost = follow(scans, lambda: n_told.append(1))
    assert not is_lost.any() and len(n_told) == N_SCANS - 1


def test_where_most_scans_are_lost_the_recorded_poses_stay(tunnel: CloudScans, monkeypatch: pytest.MonkeyPatch) -> None:
    noisy = with_poses(tunnel, lost(tunnel.odom_T_sensor, LOST_AT))
    shrunk = noisy.odom_T_sensor * 1.0

    def lose_most(scans: Samples, _: object) -> tuple[Float64Array, BoolArray]:
        scans.replace(3, np.zeros((1, 3)))
        return shrunk, np.arange(N_SCANS) < 0.6 * N_SCANS

    monkeypatch.setattr(consistency, "follow", lose_most)
    consistent = make_consistent(noisy)
    np.testing.assert_array_equal(consistent.odom_T_sensor, noisy.odom_T_sensor)


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
    _, is_lost = follow(Samples(CloudScans("noise", tunnel.odom_T_sensor, clouds)), lambda: None)
    assert len(n_sought) == 10 and not is_lost.any()
