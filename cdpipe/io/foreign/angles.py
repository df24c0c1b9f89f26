"""Roll, pitch and yaw of a foreign trajectory: degrees or radians, and held against the way that the path turns."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.geometry import Float64Array, travelled_m

_RADIANS = np.pi + 1e-3  # rounded to three digits; angles up to here are taken for radians without a unit
_DEGREES = 7.0  # from here on they are degrees
# A direction of the path is that of a step of this length; fewer directions than this tell nothing.
_STEP_M = 1.0
_FEWEST_STEPS = 8
# Yaws are refused if they miss the directions of the path by this, and by no more than a fourth of it otherwise read.
_FAR_RAD = np.radians(15.0)
_CLOSER = 0.25


def are_degrees(path: Path, angles: Float64Array, names: Sequence[str]) -> bool:
    """Return whether angles (N, 3) are degrees: by the unit in the header, else by their size.

    Raises:
        InputError: They could be either.
    """
    if any("deg" in name or "rad" in name for name in names):
        return any("deg" in name for name in names)
    largest = float(np.abs(angles).max(initial=0.0))
    if _RADIANS < largest <= _DEGREES:
        raise InputError(
            f"{path}: the largest of roll, pitch and yaw is {largest:.3f}, which may be degrees or radians: say which "
            "in the header, as roll_deg,pitch_deg,yaw_deg or roll_rad,pitch_rad,yaw_rad"
        )
    if 0.0 < largest <= _RADIANS:
        told = "roll, pitch and yaw are taken for radians: say so in the header (yaw_rad, or yaw_deg for degrees)"
        warnings.warn(f"{path}: {told}", InputWarning, stacklevel=2)
    return largest > _DEGREES


def require_turns(path: Path, yaws: Float64Array, poses: Float64Array, *, is_degrees: bool) -> None:
    """Refuse yaws that turn as the path does with another meaning alone. A straight path tells nothing.

    Args:
        path: The file, for messages.
        yaws: (N,) as the file has them.
        poses: (N, 4, 4) of the sensor, at any yaw to the way it moves.
        is_degrees: What the yaws were taken for.

    Raises:
        InputError: They are radians taken for degrees, degrees taken for radians, or grow clockwise.
    """
    steps = np.unique((travelled_m(poses) / _STEP_M).astype(np.int64), return_index=True)[1]
    if len(steps) <= _FEWEST_STEPS:
        return
    moves = np.diff(poses[steps, :2, 3], axis=0)
    directions_rad = np.arctan2(moves[:, 1], moves[:, 0])
    degree = np.pi / 180.0
    yaws_rad = yaws[steps[:-1]] * (degree if is_degrees else 1.0)
    miss_rad = _miss_rad(directions_rad, yaws_rad)
    taken, other = ("degrees", "radians") if is_degrees else ("radians", "degrees")
    for scale, likely in (
        (1.0 / degree if is_degrees else degree, f"they are {other}, taken for {taken}: name the unit in the header"),
        (-1.0, "they grow clockwise, as those of a compass: change their sign"),
    ):
        if miss_rad > _FAR_RAD and _miss_rad(directions_rad, scale * yaws_rad) < _CLOSER * miss_rad:
            raise InputError(
                f"{path}: the yaws do not turn as the path does, by {np.degrees(miss_rad):.0f} degrees: likely {likely}"
            )


def _miss_rad(directions_rad: Float64Array, yaws_rad: Float64Array) -> float:
    """Return by how much yaws (M,) miss directions (M,), median; for any mount of the sensor, forwards or backwards."""
    doubled = np.exp(2j * (directions_rad - yaws_rad))
    return float(np.median(np.abs(np.angle(doubled / (doubled.sum() or 1.0)))) / 2.0)
