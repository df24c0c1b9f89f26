"""Wrong poses of a drive through a drift are told from right ones, by the scans."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.geometry import Float64Array, invert, make_pose, transform
from cdpipe.io.readers import open_session
from cdpipe.mapping.poses.pose_check import check_poses, swap_quaternions
from scenarios import load_scenario


@dataclass
class Posed:
    """Scans of a session with other poses, their points moved by one transform each."""

    session: Any
    odom_T_sensor: Float64Array
    points: Callable[[int, Float64Array], Float64Array] = lambda _, points: points

    def scan(self, index: int) -> Any:
        scan = self.session.scan(index)
        return replace(scan, points_sensor=self.points(index, scan.points_sensor))


@pytest.fixture(scope="module", name="sessions")
def sessions_fixture(simulated_once: Callable[..., Path]) -> list[Any]:
    pair = simulated_once(load_scenario("smoke/one_box", 5, ("sensor.mode=512x10", "platform.scan_spacing_m=0.9")), 5)
    return [open_session(pair / name) for name in ("before", "after")]


def with_w_first(poses: Float64Array) -> Float64Array:
    """Poses as they are read if a file has w first: the inverse of what `swap_quaternions` does."""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return make_pose(Rotation.from_quat(np.roll(quaternions, 1, axis=1)).as_matrix(), poses[:, :3, 3])


def in_other_unit(poses: Float64Array) -> Float64Array:
    """Angles in degrees that are taken for radians."""
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX", degrees=True)
    return make_pose(Rotation.from_euler("ZYX", angles).as_matrix(), poses[:, :3, 3])


def test_right_poses_are_taken(sessions: list[Any]) -> None:
    for session in sessions:
        check_poses(session, "t.tum")
        check_poses(Posed(session, swap_quaternions(with_w_first(session.odom_T_sensor))), "t.tum")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (with_w_first, "they look like qw first: move that column to the end"),
        (invert, "with the inverse ones: give those of the sensor in the frame of the map"),
    ],
)
def test_wrong_poses_are_refused_in_either_session(
    sessions: list[Any], change: Callable[[Float64Array], Float64Array], told: str
) -> None:
    for session in sessions:
        with pytest.raises(InputError, match=rf"^t\.tum: the scans lie .*{re.escape(told)}"):
            check_poses(Posed(session, change(session.odom_T_sensor)), "t.tum")


def test_registered_scans_are_refused(sessions: list[Any]) -> None:
    for session in sessions:
        poses = session.odom_T_sensor
        registered = Posed(session, poses, lambda index, points, poses=poses: transform(poses[index], points))
        with pytest.raises(InputError, match="they look registered already"):
            check_poses(registered, "t.tum")


def test_poses_in_another_unit_are_told(sessions: list[Any]) -> None:
    for session in sessions:
        poses = session.odom_T_sensor
        in_millimetres = make_pose(poses[:, :3, :3], 1000.0 * poses[:, :3, 3])
        with pytest.warns(InputWarning, match=r"m apart with these poses, .* m without any: are they of these scans"):
            check_poses(Posed(session, in_millimetres), "t.csv")
        # neighbours that hardly turn fit unmoved, so this may be an error or a warning
        with pytest.raises((InputError, InputWarning), match="unit"):
            check_poses(Posed(session, in_other_unit(poses)), "t.csv")
