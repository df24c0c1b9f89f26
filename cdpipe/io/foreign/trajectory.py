"""Trajectories of other people: TUM, KITTI (12 numbers a line) and CSV with a header, guessed from the first line."""

from __future__ import annotations

import re
from array import array
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import BoolArray, Float64Array, make_pose, travelled_m
from cdpipe.core.geometry.motion import Motion, make_motion
from cdpipe.io.foreign.angles import are_degrees, require_turns
from cdpipe.io.foreign.columns import MOST_COLUMNS, TIME_UNITS_S, find_columns, find_rivals, is_header
from cdpipe.io.tum import TUM_LINE, iterate_lines, read_tum, require_unit_poses

# A pose is rigid if no entry of R R^T is farther than this from the identity; KITTI files have six digits.
_RIGID = 1e-3
_FARTHEST_M = 1e8
_NOMINAL_S = 0.1  # between scans, where there is one scan only
# Poses farther apart than this say nothing about the scans between them, unless scans are as rare.
_LONGEST_GAP_S = 1.0
_SECONDS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))  # from this median on, stamps are ns, us, ms
_DATE = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d{1,9})?")
_MOST_COMMENTS = 100  # right before the first pose, that may be a header


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses of a sensor.

    Attributes:
        where: The file, or what else gave the poses, for messages.
        poses: (N, 4, 4) `odom_T_sensor`.
        time_s: (N,) times, seconds of the clock of the scans; None where the file has none.
        is_tum: Whether the file is a TUM file.
        holds_clouds: Whether the points of the scans are in the frame of the poses, registered already.
    """

    where: str
    poses: Float64Array
    time_s: Float64Array | None = None
    is_tum: bool = False
    holds_clouds: bool = False

    def less(self, origin_m: Sequence[float]) -> Trajectory:
        """Return the poses with the origin (3,) at these coordinates."""
        poses = self.poses.copy()
        poses[:, :3, 3] -= origin_m
        return replace(self, poses=poses)

    def motion(self) -> Motion | None:
        """Return the motion through the poses; None with one pose only, or without times that rise."""
        if self.time_s is None or len(self.time_s) < 2 or not (np.diff(self.time_s) > 0).all():
            return None
        rotations = Rotation.from_matrix(self.poses[:, :3, :3])
        return make_motion(self.time_s, travelled_m(self.poses), self.poses[:, :3, 3], rotations)


def read_poses(path: Path) -> Trajectory:
    """Read a trajectory in any of the formats.

    TUM lines `stamp tx ty tz qx qy qz qw`; KITTI lines of 12 numbers, the upper rows of a 4x4 matrix; `time` and 12
    numbers; lines `x y z qx qy qz qw`, one a scan; or a CSV whose header names its columns (x, y, z, and qx, qy, qz,
    qw or roll, pitch, yaw; time).

    Raises:
        InputError: The file is none of these, a number is not finite, a rotation is none, times other than TUM's do not
            rise, angles may be degrees or radians, or yaws turn as the path does in the other unit alone or clockwise.
            Radians without a unit in the header are an `InputWarning`.
    """
    lines = _lines(path)
    first = next(lines, None)
    if first is None:
        raise InputError(f"{path}: no poses in it: expected lines `{TUM_LINE}`, KITTI's 12 numbers, or a CSV")
    words = _split(first[1])
    columns = len(words)
    if columns > MOST_COLUMNS:
        raise InputError(f"{path}:{first[0]}: {columns} fields: expected at most {MOST_COLUMNS}")
    if not all(map(_is_number, words)):
        return _read_csv(path, words, lines)
    if columns == 8 and "," not in first[1] and ";" not in first[1]:
        rows, _ = read_tum(path)
        return Trajectory(str(path), _from_quaternions(rows[:, 1:]), rows[:, 0], is_tum=True)
    if columns not in (7, 8, 12, 13):
        raise InputError(
            f"{path}:{first[0]}: {columns} fields: expected eight numbers, {TUM_LINE}; or KITTI's 12 numbers; or a "
            "header that names the columns"
        )
    rows, numbers = _numbers(path, chain([first], lines), columns)
    has_time = columns in (8, 13)
    poses = _poses(path, rows[:, int(has_time) :], numbers)
    return Trajectory(str(path), poses, _rising(path, _seconds(rows[:, 0])) if has_time else None)


def read_times(path: Path) -> Float64Array:
    """Read one time a line, as KITTI's times.txt has them, or one date and time, in seconds.

    Raises:
        InputError: A line is not one finite number, or a time does not come after the one before it.
    """
    lines = list(_lines(path))
    if all(_DATE.fullmatch(line) for _, line in lines):
        dates = np.array([_date(f"{path}:{number}", line) for number, line in lines], "datetime64[ns]")
        return _rising(path, dates.astype(np.int64) / 1e9)
    return _rising(path, _seconds(_numbers(path, lines, 1)[0][:, 0]))


def _date(where: str, line: str) -> np.datetime64:
    try:
        return np.datetime64(line.replace(" ", "T"), "ns")
    except ValueError as error:
        raise InputError(f"{where}: {line}: no such date and time: expected YYYY-MM-DD HH:MM:SS.S") from error


def poses_at(trajectory: Trajectory, stamps_s: Float64Array, name: str) -> Float64Array:
    """Return the poses (S, 4, 4) of scans at (S,) rising times, interpolated; rotations by Slerp.

    Raises:
        InputError: The trajectory ends more than one period short of the scans at either end, belongs to another
            clock, or has a gap between two scans.
    """
    assert trajectory.time_s is not None
    time_s = trajectory.time_s
    _require_rising(trajectory.where, time_s)
    period_s = max(_period(stamps_s), _period(time_s))
    early_s, late_s = float(time_s[0] - stamps_s[0]), float(stamps_s[-1] - time_s[-1])
    spans = (
        f"covers {time_s[0]:.3f} to {time_s[-1]:.3f} s, the scans of {name} {stamps_s[0]:.3f} to {stamps_s[-1]:.3f} s"
    )
    if early_s > stamps_s[-1] - stamps_s[0] + period_s or late_s > stamps_s[-1] - stamps_s[0] + period_s:
        off_s = float(time_s[0] - stamps_s[0])
        raise InputError(f"{trajectory.where}: {spans}: the clocks differ by {off_s:.3f} s: shift the stamps")
    if max(early_s, late_s) > period_s + 1e-6:
        outside = int(np.count_nonzero((stamps_s < time_s[0] - period_s) | (stamps_s > time_s[-1] + period_s)))
        raise InputError(
            f"{trajectory.where}: {spans}: {outside} scans lie up to {max(early_s, late_s):.3f} s outside, more than "
            f"one period ({period_s:.3f} s): leave those scans out, or give poses for them"
        )
    motion = trajectory.motion()
    if motion is None:
        return np.broadcast_to(trajectory.poses[0], (len(stamps_s), 4, 4)).copy()
    _require_no_gap(trajectory, stamps_s)
    return motion.poses(stamps_s)


def require_times_of_scans(trajectory: Trajectory, stamps_s: Float64Array | None, name: str) -> None:
    """Raise `InputError` if the times of poses, one for each of (S,) scans, are off theirs by more than one period."""
    if trajectory.time_s is None or stamps_s is None:
        return
    period_s = max(_period(stamps_s), _period(trajectory.time_s)) or _NOMINAL_S
    off_s = trajectory.time_s - stamps_s
    scan = int(np.argmax(np.abs(off_s)))
    if abs(off_s[scan]) > period_s + 1e-6:
        raise InputError(
            f"{trajectory.where}: its times and those of the scans of {name} differ by {off_s[scan]:.3f} s (scan "
            f"{scan}), more than one period ({period_s:.3f} s): shift the stamps, or name the trajectory of these scans"
        )


def find_gaps(trajectory: Trajectory, stamps_s: Float64Array) -> tuple[Float64Array, float]:
    """Return the seconds (S,) between the poses about each scan, and the most that can be bridged.

    Args:
        trajectory: Poses with rising times.
        stamps_s: (S,) times of the scans, seconds.
    """
    assert trajectory.time_s is not None
    if len(trajectory.time_s) < 2:
        return np.zeros(len(stamps_s)), _LONGEST_GAP_S
    period_s = max(_period(stamps_s), _period(trajectory.time_s))
    at = np.clip(np.searchsorted(trajectory.time_s, stamps_s) - 1, 0, len(trajectory.time_s) - 2)
    return np.diff(trajectory.time_s)[at], max(_LONGEST_GAP_S, 2 * period_s)


def _require_no_gap(trajectory: Trajectory, stamps_s: Float64Array) -> None:
    gaps_s, longest_s = find_gaps(trajectory, stamps_s)
    if gaps_s.max() > longest_s:
        scan = int(np.argmax(gaps_s))
        raise InputError(
            f"{trajectory.where}: no pose for {gaps_s[scan]:.2f} s about scan {scan} ({stamps_s[scan]:.3f} s): at "
            f"most {longest_s:.2g} s can be bridged: leave those scans out"
        )


def _period(time_s: Float64Array) -> float:
    return float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the numbered lines of a text file that are neither empty nor, after the first, comments."""
    lines = iterate_lines(path)
    # a header may begin as a comment does; it stands near the poses
    begin: deque[tuple[int, str]] = deque(maxlen=_MOST_COMMENTS)
    first = None
    for each in lines:
        if not each[1].startswith("#"):
            first = each
            break
        begin.append(each)
    n_fields = 0 if first is None else len(_split(first[1]))
    may_be = begin if first is None else [*begin, first]
    header = next((each for each in may_be if is_header(_split(each[1]), n_fields, has_commas="," in each[1])), None)
    if header is not None:
        yield header
    if first is not None and first is not header:
        yield first
    yield from (each for each in lines if not each[1].startswith("#"))


def _split(line: str) -> list[str]:
    line = line.strip().lstrip("#").strip()
    for separator in (",", ";", "\t"):
        if separator in line:
            return [word.strip() for word in line.rstrip(separator).split(separator)]
    return line.split()


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _read_csv(path: Path, names: list[str], lines: Iterable[tuple[int, str]]) -> Trajectory:
    columns = find_columns(names)
    if rivals := find_rivals(names):
        raise InputError(f"{path}: positions may be those of {' or '.join(rivals)}: leave the other columns out")
    turns = [name for name in ("qx", "qy", "qz", "qw") if name in columns]
    angles = [name for name in ("roll", "pitch", "yaw") if name in columns]
    if not {"x", "y", "z"} <= set(columns) or (len(turns) < 4 and len(angles) < 3):
        named = ", ".join(names)[:120]
        raise InputError(
            f"{path}: its header names {named}: expected x, y, z, and qx, qy, qz, qw or roll, pitch, yaw, and time for "
            "scans at other times"
        )
    used = [columns[name] for name in ("x", "y", "z", *(turns if len(turns) == 4 else angles))]
    clocks = _clocks(columns)
    rows, numbers = _numbers(path, lines, len(names), used + clocks)
    if len(turns) == 4:
        poses = _poses(path, rows[:, :7], numbers)
    else:
        is_degrees = are_degrees(path, rows[:, 3:6], [names[columns[name]].lower() for name in angles])
        rotations = Rotation.from_euler("xyz", rows[:, 3:6], degrees=is_degrees)
        _poses(path, np.column_stack([rows[:, :3], rotations.as_quat()]), numbers)  # which refuses what is no pose
        poses = make_pose(rotations.as_matrix(), rows[:, :3])
        require_turns(path, rows[:, 5], poses, is_degrees=is_degrees)
    time_s = _add_clocks(rows[:, len(used) :], [names[index] for index in clocks]) if clocks else None
    return Trajectory(str(path), poses, None if time_s is None else _rising(path, time_s))


def _clocks(columns: dict[str, int]) -> list[int]:
    """Return the columns that hold the time: one, or seconds and nanoseconds, or none."""
    if "time" in columns:
        return [columns["time"]]
    return [columns[name] for name in ("sec", "nsec") if name in columns]


def _add_clocks(stamps: Float64Array, names: Sequence[str]) -> Float64Array:
    """Return the times (N,), seconds, of columns (N, 1), or (N, 2) of seconds and the nanoseconds beyond them."""
    last = stamps[:, -1]
    unit = re.findall(r"[a-z]+", names[0].lower())[-1]
    if len(names) == 1 and unit in TIME_UNITS_S:
        return last * TIME_UNITS_S[unit]
    is_rest = stamps.shape[1] == 2 and bool((np.abs(last) < 1e9).all())
    return stamps[:, 0] + 1e-9 * last if is_rest else _seconds(last)  # nanoseconds from 1e9 on are whole stamps


def _numbers(
    path: Path, lines: Iterable[tuple[int, str]], columns: int, used: Sequence[int] | None = None
) -> tuple[Float64Array, Sequence[int]]:
    """Return the finite numbers (N, U) in the used columns of lines, all without `used`, and their line numbers."""
    indices = range(columns) if used is None else used
    values, numbers = array("d"), array("q")
    for number, line in lines:
        words = _split(line)
        if len(words) != columns:
            raise InputError(
                f"{path}:{number}: {len(words)} fields, {columns} in the first line: expected as many in each"
            )
        try:
            values.extend([float(words[index] or "nan") for index in indices])
        except ValueError as error:
            raise InputError(f"{path}:{number}: expected numbers: {error}") from error
        numbers.append(number)
    if not numbers:
        raise InputError(f"{path}: no line of numbers in it")
    rows = np.array(values, np.float64).reshape(len(numbers), -1)
    is_finite = np.isfinite(rows).all(axis=1)
    if not is_finite.all():
        bad = numbers[int(np.argmin(is_finite))]
        raise InputError(f"{path}:{bad}: a number is missing or not finite: correct it or remove the line")
    return rows, numbers


def _poses(path: Path, rows: Float64Array, numbers: Sequence[int]) -> Float64Array:
    """Return the poses of rows (N, 7), position and quaternion, or (N, 12), the upper rows of a matrix."""
    if rows.shape[1] == 7:
        require_unit_poses(rows, lambda index: f"{path}:{numbers[index]}")
        return _from_quaternions(rows)
    matrices = rows.reshape(-1, 3, 4)
    is_near = (np.abs(matrices) < _FARTHEST_M).all(axis=(1, 2))  # NaN is not
    with np.errstate(over="ignore", invalid="ignore"):
        turned = matrices[:, :, :3] @ matrices[:, :, :3].swapaxes(1, 2)
        is_rigid = is_near & (np.abs(turned - np.eye(3)).max(axis=(1, 2)) < _RIGID)
        is_rigid &= np.linalg.det(np.where(np.abs(matrices[:, :, :3]) < 2.0, matrices[:, :, :3], 0.0)) > 0
    if not is_rigid.all():
        bad = int(np.argmin(is_rigid))
        raise InputError(
            f"{path}:{numbers[bad]}: the first three columns of its 3x4 matrix are no rotation: expected KITTI's 12 "
            "numbers r11 r12 r13 tx r21 ... tz"
        )
    return make_pose(Rotation.from_matrix(matrices[:, :, :3]).as_matrix(), matrices[:, :, 3])


def _from_quaternions(rows: Float64Array) -> Float64Array:
    return make_pose(Rotation.from_quat(rows[:, 3:]).as_matrix(), rows[:, :3])


def _seconds(stamps: Float64Array) -> Float64Array:
    """Return stamps in seconds: from their size ns, us, ms or s."""
    middle = float(np.median(np.abs(stamps))) if len(stamps) else 0.0
    return stamps * next((scale for least, scale in _SECONDS if middle > least), 1.0)


def _rising(path: Path, time_s: Float64Array) -> Float64Array:
    _require_rising(str(path), time_s)
    return time_s


def _require_rising(where: str, time_s: Float64Array) -> None:
    if not (np.abs(time_s) < 9e9).all():
        raise InputError(f"{where}: a time is not finite, or beyond 9e9 s: expected seconds")
    is_late: BoolArray = np.less_equal(np.diff(time_s), 0)
    if is_late.any():
        bad = int(np.argmax(is_late)) + 1
        raise InputError(
            f"{where}: time {bad + 1} does not come after the last: {time_s[bad]:.6f} s after {time_s[bad - 1]:.6f} s: "
            "sort the lines by time and leave each stamp once"
        )
