from __future__ import annotations

import warnings
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.geometry import Float64Array, make_pose, stream
from cdpipe.mapping.mapping import build_map
from cdpipe.mapping.session_check import UNITS, are_swapped, check_session, is_same_session, unit_hint
from cdpipe.model.config import MapConfig
from cdpipe.model.types import PosedScan
from cdpipe.pipeline import detection

CAMERA_R_ROBOT = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # x right, y down, z forward


class Drive:
    """Scans of a spinning sensor in a tunnel 4 m wide, 0.5 m apart; lengths in any unit."""

    def __init__(self, n_scans: int = 12, points: float = 1.0, trajectory: float = 1.0) -> None:
        self.name = "drive"
        along = 0.5 * np.arange(n_scans)
        self.odom_T_sensor = np.array([make_pose(translation=(x * trajectory, 0, 0)) for x in along]).reshape(-1, 4, 4)
        rng = stream(0, "drive")
        azimuth, elevation = rng.uniform(0, 2 * np.pi, 4000), rng.uniform(-0.37, 0.37, 4000)
        rays = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
        reach = np.minimum(2.0 / np.abs(rays[:, 1]), 15.0)
        self.clouds = [points * (rays * reach[:, None] + rng.normal(0, 0.01, rays.shape)) for _ in along]
        self.stamp_s = np.zeros(n_scans)

    def scan(self, index: int) -> PosedScan:
        rows = np.arange(len(self.clouds[index]))
        stamps_ns = rows + round(1e9 * self.stamp_s[index])
        return PosedScan(index, self.clouds[index], self.odom_T_sensor[index], stamps_ns, rows.astype(np.int32))

    def scans(self) -> Iterator[PosedScan]:
        return (self.scan(index) for index in range(len(self.clouds)))

    def turned(self, points: Float64Array | None = None, odom: Float64Array | None = None) -> Drive:
        """Express points (and with them the poses' right side), or the odom frame, in another frame."""
        if points is not None:
            self.clouds = [cloud @ points.T for cloud in self.clouds]
            self.odom_T_sensor = self.odom_T_sensor @ make_pose(points.T)
        if odom is not None:
            self.odom_T_sensor = make_pose(odom) @ self.odom_T_sensor
        return self


def said(source: Drive, other: Drive | None = None) -> str:
    with pytest.raises(InputError) as caught:
        check_session(source, MapConfig(), other)
    text = str(caught.value)
    assert text.startswith("drive: ")
    assert "\n" not in text
    return text


def test_a_drive_in_metres_passes() -> None:
    check_session(Drive(), MapConfig())
    check_session(Drive(), MapConfig(), Drive(points=1000.0))
    check_session(Drive(n_scans=3), MapConfig())


def test_a_sensor_upside_down_passes() -> None:
    check_session(Drive().turned(points=np.diag([1.0, -1, -1])), MapConfig())


def test_one_scan_a_short_path_and_a_standing_sensor_pass() -> None:
    for source in (Drive(n_scans=1), Drive(n_scans=2), Drive(trajectory=0.0)):
        check_session(source, MapConfig())
    assert "holds no scan" in said(Drive(n_scans=0))


def test_a_pose_that_is_no_pose() -> None:
    bad = Drive()
    bad.odom_T_sensor[3, 0, 3] = np.inf
    assert "scan[3]" in said(bad)
    bad = Drive()
    bad.odom_T_sensor[4, :3, :3] *= 2
    assert "scan[4]" in said(bad)


@pytest.mark.parametrize("unit", ["millimetres", "centimetres", "inches", "kilometres"])
@pytest.mark.parametrize("trajectory_too", [True, False])
def test_points_in_another_unit_beside_a_session_in_metres(unit: str, trajectory_too: bool) -> None:
    per_metre = 1 / UNITS[unit]
    text = said(Drive(points=per_metre, trajectory=per_metre if trajectory_too else 1.0), Drive())
    assert f"expected metres; the points look like {unit}: scale by {UNITS[unit]:g}, and the trajectory" in text


def test_points_in_another_unit_alone() -> None:
    assert "millimetres: scale by 0.001," in said(Drive(points=1000.0))
    # 2.5 m are 250 cm, and so are 6.4 m in inches: both are tunnels
    assert "scale by 0.01 or 0.0254," in said(Drive(points=100.0))
    assert "find out the unit of the points and scale to metres" in said(Drive(points=1e9))


def test_a_trajectory_in_another_unit_than_the_points() -> None:
    text = said(Drive(trajectory=1000.0))
    assert "500 m" in text
    assert "millimetres: scale by 0.001" in text
    # steps of 50: of 5 cm, half a metre, or 1.3 m
    text = said(Drive(trajectory=100.0))
    assert "scale by 0.001 or 0.01 or 0.0254" in text


@pytest.mark.parametrize(("apart_s", "passes"), [(60.0, True), (3.0, True), (0.1, False), (0.0, False)])
def test_stations_of_a_tripod_pass_if_the_way_between_them_took_its_time(apart_s: float, passes: bool) -> None:
    survey = Drive(trajectory=40.0)  # 20 m apart; scans reach 15 m
    survey.stamp_s = apart_s * np.arange(12)
    if passes:
        check_session(survey, MapConfig())
    else:
        assert "neighbouring scans lie 20 m apart" in said(survey)


def test_z_is_up() -> None:
    both = Drive().turned(points=CAMERA_R_ROBOT, odom=CAMERA_R_ROBOT)
    assert "90 degrees off z of the sensor's frame" in said(both)
    odom = Drive().turned(odom=CAMERA_R_ROBOT)
    assert "90 degrees off z of the trajectory's frame" in said(odom)
    # poses whose positions alone are a camera's
    climbing = Drive()
    climbing.odom_T_sensor[:, :3, 3] = climbing.odom_T_sensor[:, :3, 3] @ CAMERA_R_ROBOT.T
    assert "90 degrees" in said(climbing)


def test_a_standing_sensor_with_odometry_that_jitters_up_and_down_passes() -> None:
    standing = Drive(60, trajectory=0.0)
    standing.odom_T_sensor[:, :3, 3] += stream(0, "jitter").normal(0, (0.02, 0.02, 0.06), (60, 3))
    check_session(standing, MapConfig())


def test_a_steep_ramp_passes() -> None:
    ramp = Drive()
    ramp.odom_T_sensor[:, 2, 3] = 0.4 * ramp.odom_T_sensor[:, 0, 3]
    check_session(ramp, MapConfig())


def test_feet_are_no_error_but_a_hint() -> None:
    per_metre = 1 / 0.3048
    feet = Drive(points=per_metre, trajectory=per_metre)
    check_session(feet, MapConfig())
    metres_map, feet_map = build_map(Drive(), MapConfig()), build_map(feet, MapConfig())
    expected = "session's returns lie 3.3 times as far as the other's: if it is in feet, scale its points"
    assert f"the after {expected}" in unit_hint(metres_map, feet_map)
    assert f"the before {expected}" in unit_hint(feet_map, metres_map)
    assert unit_hint(metres_map, metres_map) == ""
    assert unit_hint(metres_map, build_map(Drive(points=2.0), MapConfig())) == ""


def test_one_recording_twice() -> None:
    assert is_same_session(Drive(), Drive())
    other = Drive()
    other.clouds[0] = other.clouds[0] + 1e-9
    assert not is_same_session(Drive(), other)
    assert not is_same_session(Drive(), Drive(n_scans=11))


def test_the_later_session_is_noticed_where_both_clocks_are_of_the_calendar() -> None:
    def began(start_s: float | None) -> Drive:
        drive = Drive(n_scans=2)
        if start_s is not None:
            drive.stamps_s = start_s + np.arange(2)
        return drive

    early, late = began(1.7e9), began(1.7e9 + 86_400)
    assert are_swapped(late, early)
    assert not are_swapped(early, late) and not are_swapped(early, early)
    # a sensor without such a clock counts from when it was switched on, and a simulated session from its start
    for other in (began(900.0), began(0.0), began(None)):
        assert not are_swapped(early, other) and not are_swapped(other, early)
    stored = Drive(n_scans=2)
    stored.session = SimpleNamespace(provenance={"sensor_clock_start_ns": 1_600_000_000 * 10**9})
    assert are_swapped(early, stored) and not are_swapped(stored, early)


def test_detect_asks_whether_the_sessions_are_swapped(monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*_: object) -> None:
        raise InputError("mapped")

    early, late = Drive(n_scans=2), Drive(n_scans=2)
    for drive, name, start_s in ((early, "monday", 1.7e9), (late, "tuesday", 1.7e9 + 86_400)):
        drive.name, drive.stamps_s = name, start_s + np.arange(2)
    monkeypatch.setattr(detection, "map_pair", stop)
    asked = "monday was recorded before tuesday, by the clocks of both: is the earlier session the first"
    with pytest.warns(InputWarning, match=asked), pytest.raises(InputError, match="mapped"):
        detection.detect(late, early)
    with warnings.catch_warnings(), pytest.raises(InputError, match="mapped"):
        warnings.simplefilter("error")
        detection.detect(early, late)
