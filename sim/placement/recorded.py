"""A recorded trajectory as a session's drive: read from a TUM file, and checked to run inside the tunnel.

Poses are `world_T_sensor`: metres in the world frame, the sensor's x axis forward and its z axis up. Stamps in seconds.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.core.geometry import Float64Array, Int64Array
from cdpipe.core.geometry.motion import Motion
from cdpipe.io.tum import motion_through, read_trajectory
from sim.geometry.raycast import Caster, measure_room

_FASTEST_MPS = 20.0
_NEAREST_M = 0.2
_CHECK_STEP_M = 0.25  # between the places checked along the way
_SLACK_M = 1e-9  # of sums of such steps
_CHECKED_AT_ONCE = 20_000


def read_drive(path: Path) -> tuple[Motion, tuple[int, ...]]:
    """Return the movement of a TUM file, its time counted from the first pose, and the line number of each pose.

    Raises:
        InputError: The file is no trajectory, or two poses are farther apart than 20 m/s allow.
    """
    rows, numbers = read_trajectory(path)
    seconds, steps_m = np.diff(rows[:, 0]), np.linalg.norm(np.diff(rows[:, 1:4], axis=0), axis=1)
    is_fast = steps_m > _FASTEST_MPS * seconds
    if is_fast.any():
        bad = int(np.argmax(is_fast))
        raise InputError(
            f"{path}:{numbers[bad + 1]}: {steps_m[bad]:.2f} m in {seconds[bad]:.3f} s, faster than {_FASTEST_MPS:g} m/s"
            ": stamps are in seconds and positions in metres"
        )
    return motion_through(rows, rows[0, 0]), numbers


def check_inside(motion: Motion, surroundings: Caster, where: str, numbers: tuple[int, ...]) -> None:
    """Refuse a trajectory that leaves the void or comes within 0.2 m of a surface.

    Args:
        motion: The trajectory, world frame.
        surroundings: Rock, furniture and props; every surface faces the void.
        where: Session and file, for the message.
        numbers: Line of each sample of `motion`.

    Raises:
        ScenarioError: With the line at or before the first bad place, and the place.
    """
    steps = np.diff(motion.points, axis=0)
    counts = np.maximum(np.ceil(np.linalg.norm(steps, axis=1) / _CHECK_STEP_M).astype(np.int64), 1)
    sample = np.repeat(np.arange(len(steps)), counts)
    share = (np.arange(len(sample)) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[sample]
    points = np.concatenate([motion.points[sample] + share[:, None] * steps[sample], motion.points[-1:]])
    sample = np.append(sample, len(steps))
    chosen = _thin(points)
    for rows in np.split(chosen, range(_CHECKED_AT_ONCE, len(chosen), _CHECKED_AT_ONCE)):
        gap_m, is_outside = measure_room(surroundings, points[rows], _round_about())
        is_bad = is_outside | (gap_m < _NEAREST_M)
        if not is_bad.any():
            continue
        bad = int(np.argmax(is_bad))
        x, y, z = points[rows[bad]]
        what = "lies outside the tunnel" if is_outside[bad] else f"is {gap_m[bad]:.2f} m from a surface"
        raise ScenarioError(
            f"{where}:{numbers[sample[rows[bad]]]}: the sensor at ({x:.2f}, {y:.2f}, {z:.2f}) {what}: "
            f"a trajectory is given in the world frame and keeps {_NEAREST_M:g} m off everything"
        )


def _thin(points: Float64Array) -> Int64Array:
    """Return the rows (K,) of points (N, 3) of a way: the first, the last, and one at least every 0.25 m between."""
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    rows = [0]
    while rows[-1] < len(points) - 1:
        # a standing sensor is passed over, and a jump ends at the last point within reach
        within = int(np.searchsorted(way_m, way_m[rows[-1]] + _CHECK_STEP_M + _SLACK_M, side="right")) - 1
        rows.append(max(within, rows[-1] + 1))
    return np.array(rows, np.int64)


def _round_about() -> Float64Array:
    """Return unit vectors (26, 3) to the corners, edges and faces of a cube."""
    grid = np.stack(np.meshgrid(*[np.arange(-1.0, 2.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = grid[np.abs(grid).sum(axis=1) > 0]
    return np.asarray(grid / np.linalg.norm(grid, axis=1, keepdims=True))
