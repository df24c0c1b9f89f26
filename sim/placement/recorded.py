"""A recorded trajectory from a TUM file: one line `timestamp x y z qx qy qz qw` for each pose, `#` starts a comment.

Poses are `world_T_sensor`: metres in the world frame, the sensor's x axis forward and its z axis up. Stamps in seconds.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.core.geometry import Float64Array
from cdpipe.core.motion import Motion, make_motion
from sim.geometry.raycast import Caster
from sim.geometry.room import room_about

_LINE = "timestamp x y z qx qy qz qw"
# Files carry four to six digits; what is farther off is another order of the columns.
_UNIT_TOLERANCE = 1e-2
_FASTEST_MPS = 20.0
_NEAREST_M = 0.2
# Between two poses the sensor is looked for on the way, this far apart.
_CHECK_STEP_M = 0.25


def read_tum(path: Path) -> tuple[Motion, tuple[int, ...]]:
    """Return the movement of a TUM file, and the number of each pose's line.

    Raises:
        InputError: The file cannot be read, holds fewer than two poses, or a line is not a pose, does not come later
            than the one before it, or is farther from it than 20 m/s allow.
    """
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as a trajectory: {error}") from error
    numbers = tuple(n for n, line in enumerate(lines, start=1) if line.strip() and not line.lstrip().startswith("#"))
    rows = np.array([_row(path, number, lines[number - 1]) for number in numbers]).reshape(-1, 8)
    if len(rows) < 2:
        raise InputError(f"{path}: {len(rows)} poses: a trajectory needs two lines `{_LINE}` or more")
    _check_steps(path, numbers, rows)
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(rows[:, 1:4], axis=0), axis=1))])
    return make_motion(rows[:, 0] - rows[0, 0], way_m, rows[:, 1:4], Rotation.from_quat(rows[:, 4:])), numbers


def check_inside(motion: Motion, surroundings: Caster, where: str, numbers: tuple[int, ...]) -> None:
    """Refuse a trajectory that leaves the void or comes within 0.2 m of what stands there.

    Args:
        motion: The trajectory, world frame.
        surroundings: Rock and whatever else there is; every surface faces the void.
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
    gap_m, is_outside = room_about(surroundings, points, _round_about())
    is_bad = is_outside | (gap_m < _NEAREST_M)
    if not is_bad.any():
        return
    bad = int(np.argmax(is_bad))
    x, y, z = points[bad]
    what = "lies outside the tunnel" if is_outside[bad] else f"is {gap_m[bad]:.2f} m from a surface"
    raise ScenarioError(
        f"{where}:{numbers[sample[bad]]}: the sensor at ({x:.2f}, {y:.2f}, {z:.2f}) {what}: "
        f"a trajectory is given in the world frame and keeps {_NEAREST_M:g} m off everything"
    )


def _round_about() -> Float64Array:
    """Return unit vectors (26, 3) to the corners, edges and faces of a cube."""
    grid = np.stack(np.meshgrid(*[np.arange(-1.0, 2.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = grid[np.abs(grid).sum(axis=1) > 0]
    return np.asarray(grid / np.linalg.norm(grid, axis=1, keepdims=True))


def _row(path: Path, number: int, line: str) -> Float64Array:
    words = line.split()
    if len(words) != 8:
        raise InputError(f"{path}:{number}: {len(words)} fields: expected eight, `{_LINE}`")
    values = np.zeros(8)
    for place, word in enumerate(words):
        try:
            values[place] = float(word)
        except ValueError as error:
            raise InputError(f"{path}:{number}: {word!r} is not a number: expected `{_LINE}`") from error
    if not np.isfinite(values).all():
        raise InputError(f"{path}:{number}: {words[int(np.argmin(np.isfinite(values)))]!r} is not a finite number")
    length = float(np.linalg.norm(values[4:]))
    if abs(length - 1.0) > _UNIT_TOLERANCE:
        raise InputError(f"{path}:{number}: the quaternion's length is {length:.4g}, expected 1: in `{_LINE}`")
    return values


def _check_steps(path: Path, numbers: tuple[int, ...], rows: Float64Array) -> None:
    seconds = np.diff(rows[:, 0])
    if (seconds <= 0).any():
        bad = int(np.argmax(seconds <= 0)) + 1
        raise InputError(
            f"{path}:{numbers[bad]}: stamp {rows[bad, 0]:.6f} s does not come after {rows[bad - 1, 0]:.6f} s: "
            "sort the lines by time and leave each stamp once"
        )
    steps_m = np.linalg.norm(np.diff(rows[:, 1:4], axis=0), axis=1)
    is_fast = steps_m > _FASTEST_MPS * seconds
    if is_fast.any():
        bad = int(np.argmax(is_fast))
        raise InputError(
            f"{path}:{numbers[bad + 1]}: {steps_m[bad]:.2f} m in {seconds[bad]:.3f} s, faster than {_FASTEST_MPS:g} m/s"
            ": stamps are in seconds and positions in metres"
        )
