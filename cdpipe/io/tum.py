"""Trajectories as TUM files: one line `stamp tx ty tz qx qy qz qw` for each pose, `#` starts a comment."""

from __future__ import annotations

import io
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError
from cdpipe.core.files import read_bytes
from cdpipe.core.geometry import BoolArray, Float64Array
from cdpipe.core.geometry.motion import Motion, make_motion

TUM_LINE = "stamp tx ty tz qx qy qz qw"
_UNIT_TOLERANCE = 1e-3
_FARTHEST_M = 1e8  # around the Earth twice; UTM coordinates are below 1e7
_MOST_BYTES = 100_000_000
_MOST_LINES = 1_500_000  # two hours at 200 Hz
_LONGEST_LINE = 50_000  # letters; a pose with its covariances has 1,500
_MOST_STAMP_S = 9e9  # of Unix time until the year 2255; as nanoseconds it fits into 64 bits
# Poses farther apart than this say nothing about the columns between them.
_LONGEST_GAP_S = 1.0
# Poses this share of a revolution apart count as one a revolution: their stamps jitter.
_NEARLY = 0.9


def read_tum(path: Path) -> tuple[Float64Array, tuple[int, ...]]:
    """Return the rows (N, 8) of a TUM file, and the line number of each row.

    Raises:
        InputError: The file cannot be read, or a line is not eight finite numbers with a unit quaternion.
    """
    values, numbers = array("d"), array("q")
    for number, line in iterate_lines(path):
        if not line.startswith("#"):
            values.extend(_row(path, number, line))
            numbers.append(number)
    rows = np.array(values, np.float64).reshape(-1, 8)
    require_unit_poses(rows[:, 1:], lambda index: f"{path}:{numbers[index]}")
    is_stamp = np.abs(rows[:, 0]) < _MOST_STAMP_S  # NaN is none, either
    if not is_stamp.all():
        bad = int(np.argmin(is_stamp))
        raise InputError(
            f"{path}:{numbers[bad]}: the stamp is {rows[bad, 0]:g}: expected seconds below {_MOST_STAMP_S:g}"
        )
    return rows, tuple(numbers)


def iterate_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the numbered lines of a text file that are not empty, without the blanks around them.

    Raises:
        InputError: The file cannot be read, is no text, or is larger, has more lines or longer ones than poses need.
    """
    content = read_bytes(path, _MOST_BYTES)
    try:
        content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: cannot be read as text: {error}") from error
    text = io.TextIOWrapper(io.BytesIO(content), encoding="utf-8-sig")
    # a list of all lines would take twenty times the file
    for number, line in enumerate(iter(lambda: text.readline(_LONGEST_LINE + 1), ""), start=1):
        if len(line.rstrip("\n")) > _LONGEST_LINE:
            raise InputError(f"{path}:{number}: more than {_LONGEST_LINE} letters: expected one pose a line")
        if number > _MOST_LINES:
            raise InputError(f"{path}: more than {_MOST_LINES} lines: leave out poses between the scans")
        if stripped := line.strip():
            yield number, stripped


def read_trajectory(path: Path) -> tuple[Float64Array, tuple[int, ...]]:
    """Return the rows (N, 8) and line numbers of a TUM file that holds two poses or more, in the order of time.

    Raises:
        InputError: As `read_tum`, or there are fewer poses, or a stamp does not come after the one before it.
    """
    rows, numbers = read_tum(path)
    if len(rows) < 2:
        raise InputError(f"{path}: {len(rows)} poses: a trajectory needs two lines `{TUM_LINE}` or more")
    is_late = np.diff(rows[:, 0]) > 0
    if not is_late.all():
        bad = int(np.argmin(is_late)) + 1
        raise InputError(
            f"{path}:{numbers[bad]}: the stamp does not come after the last: {rows[bad, 0]:.6f} s after "
            f"{rows[bad - 1, 0]:.6f} s: sort the lines by time and leave each stamp once"
        )
    return rows, numbers


def motion_through(rows: Float64Array, first_s: float) -> Motion:
    """Return the movement through TUM rows (N, 8), its time counted from the stamp `first_s`."""
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(rows[:, 1:4], axis=0), axis=1))])
    return make_motion(rows[:, 0] - first_s, way_m, rows[:, 1:4], Rotation.from_quat(rows[:, 4:]))


def motion_beyond(rows: Float64Array, first_s: float, revolution_s: float) -> Motion:
    """Return the movement through TUM rows (N, 8), its time counted from the stamp `first_s`.

    Beyond either end it goes on as it was, on average, between the end pose and the next one inside that is 0.9
    `revolution_s` or more away: over the few milliseconds between the poses of a dense file, their noise is a wrong
    speed.
    """
    ends = _row_beyond(rows, revolution_s), _row_beyond(rows[::-1], revolution_s)
    return motion_through(np.concatenate([ends[0], rows, ends[1]]), first_s)


def _row_beyond(rows: Float64Array, revolution_s: float) -> Float64Array:
    """Return the row (1, 8) that continues rows (N, 8) before the first: the one a revolution inside, mirrored at it.

    Where that is the second row, or there is no third, return no row, (0, 8): the first two rows say the same.
    """
    inside = min(int(np.searchsorted(np.abs(rows[:, 0] - rows[0, 0]), _NEARLY * revolution_s)), len(rows) - 1)
    if inside < 2:
        return rows[:0]
    end, inner = rows[0], rows[inside]
    turn, inner_turn = Rotation.from_quat(end[4:]), Rotation.from_quat(inner[4:])
    return np.concatenate([2 * end[:4] - inner[:4], (turn * inner_turn.inv() * turn).as_quat()])[None]


def motion_along(path: Path, first_ns: int, last_ns: int, slack_s: float, rows: Float64Array | None = None) -> Motion:
    """Return the movement of a trajectory, its time counted from `first_ns`.

    Args:
        path: The file, TUM unless its poses are given; stamps in seconds of the same clock as `first_ns`.
        first_ns: Time of the first column that needs a pose.
        last_ns: Time of the last one.
        slack_s: How far the poses may end short of either, 1.5 revolutions; there the movement goes on as it was over
            the nearest revolution.
        rows: (N, 8) its rising stamps and poses, as a TUM file has them, where it is none.

    Raises:
        InputError: The file is not a trajectory, its stamps do not rise, or leave part of the time without poses.
    """
    rows, numbers = read_trajectory(path) if rows is None else (rows, tuple(range(1, len(rows) + 1)))
    steps_s = np.diff(rows[:, 0])
    time_s = rows[:, 0] - first_ns / 1e9
    length_s = (last_ns - first_ns) / 1e9
    if time_s[0] > slack_s or time_s[-1] < length_s - slack_s:
        raise InputError(
            f"{path}: covers {rows[0, 0]:.3f} to {rows[-1, 0]:.3f} s, the recording {first_ns / 1e9:.3f} to "
            f"{last_ns / 1e9:.3f} s of the sensor's clock: the stamps must be of that clock and span the recording"
        )
    is_gap = (steps_s > _LONGEST_GAP_S) & (time_s[:-1] < length_s) & (time_s[1:] > 0)
    if is_gap.any():
        gap = int(np.argmax(is_gap))
        raise InputError(
            f"{path}:{numbers[gap + 1]}: no pose for {steps_s[gap]:.2f} s before it, in the middle of the recording: "
            f"at most {_LONGEST_GAP_S:g} s can be bridged"
        )
    return motion_beyond(rows, first_ns / 1e9, slack_s / 1.5)


def write_tum(path: Path, stamps_s: Float64Array, poses: Float64Array) -> None:
    """Write poses (N, 4, 4) at (N,) times as a TUM file."""
    rows = np.column_stack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])
    lines = [
        f"{stamp:.9f} {' '.join(f'{number:.12g}' for number in row)}\n"
        for stamp, row in zip(stamps_s, rows, strict=True)
    ]
    path.write_text(f"# {TUM_LINE}\n{''.join(lines)}", encoding="utf-8")


def require_unit_poses(poses: Float64Array, where: Callable[[int], str]) -> None:
    """Raise `InputError` unless (N, 7) poses x, y, z, qx, qy, qz, qw are finite with unit quaternions."""
    is_near = (np.abs(poses) < _FARTHEST_M).all(axis=1)  # NaN is not
    if not is_near.all():
        index = int(np.argmin(is_near))
        fault = "is not finite" if not np.isfinite(poses[index]).all() else f"lies beyond {_FARTHEST_M:g} m"
        raise InputError(f"{where(index)}: the pose {fault}: correct it or remove the scan")
    norms = np.linalg.norm(poses[:, 3:], axis=1)
    is_unit = np.abs(norms - 1.0) < _UNIT_TOLERANCE
    if not is_unit.all():
        index = int(np.argmin(is_unit))
        raise InputError(
            f"{where(index)}: the quaternion's length is {norms[index]:.6g}, expected 1: the order is qx qy qz qw"
        )


def are_poses(poses: Float64Array) -> BoolArray:
    """Tell which of (N, 7) poses x, y, z, qx, qy, qz, qw are finite with unit quaternions, as (N,)."""
    is_near: BoolArray = np.all(np.abs(poses) < _FARTHEST_M, axis=1)  # NaN is not
    with np.errstate(over="ignore", invalid="ignore"):
        is_unit: BoolArray = np.abs(np.linalg.norm(poses[:, 3:], axis=1) - 1.0) < _UNIT_TOLERANCE
    return is_near & is_unit


def _row(path: Path, number: int, line: str) -> list[float]:
    words = line.split()
    if len(words) != 8:
        got = f"{len(words)} fields: expected eight numbers, {TUM_LINE}; got {line[:60]!r}"
        raise InputError(f"{path}:{number}: {got}")
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise InputError(f"{path}:{number}: expected eight numbers, {TUM_LINE}: {error}") from error
