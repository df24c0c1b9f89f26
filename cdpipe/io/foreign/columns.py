"""What the columns of a CSV are, by the names in its header."""

from __future__ import annotations

import re
from collections.abc import Sequence

# What may end the name of a CSV's column, `yaw_deg` or `time [ms]`: units of angles, and of times but for seconds.
_ANGLE_UNITS = ("deg", "degrees", "rad", "radians")
TIME_UNITS_S = {"ms": 1e-3, "msec": 1e-3, "us": 1e-6, "usec": 1e-6, "ns": 1e-9, "nsec": 1e-9}
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_NAMES = {
    "time": ("t", "time", "stamp", "timestamp", "s"),
    "sec": ("sec", "secs", "seconds"), "nsec": ("nsec", "nsecs", "nanosec", "nanosecs", "nanoseconds", "ns"),
    "x": ("x", "tx", "px"), "y": ("y", "ty", "py"), "z": ("z", "tz", "pz"),
    "qx": ("qx",), "qy": ("qy",), "qz": ("qz",), "qw": ("qw",),
    "roll": ("roll",), "pitch": ("pitch",), "yaw": ("yaw", "heading"),
}  # fmt: skip
_TURNS = {"q", "quat", "quaternion", "orientation", "rotation", "rot"}
# Words of columns that are no pose: rates, errors and counters.
_NO_POSE = {
    "linear", "angular", "twist", "vel", "velocity", "acc", "accel", "acceleration", "omega", "gyro", "v", "std",
    "stddev", "sigma", "bias", "b", "cov", "covariance", "seq",
}  # fmt: skip
# Words of columns that hold where a sensor is, and of those that hold three numbers of something else.
_PLACES = {"position", "pos", "translation", "trans", "pose", "p", "t"}
_NO_PLACE = {"euler", "rpy", "imu", "mag", "magnetic", "gravity"}
_OF_SOMETHING = 2
MOST_COLUMNS = 1_000  # of a pose; with its covariances it has 100
_CLOCKS = ("time", "sec", "nsec")


def is_header(words: Sequence[str], n_fields: int, *, has_commas: bool) -> bool:
    """Tell whether words name columns; without commas only where they name another order than the usual one.

    Args:
        words: Words of a line that may be a comment.
        n_fields: Of the first line that is none.
        has_commas: Whether commas separate the words.
    """
    if len(words) > MOST_COLUMNS:
        return False
    columns = find_columns(words)
    if has_commas:
        return {"x", "y", "z"} <= set(columns)
    if len(words) != n_fields or not set(_POSE) <= set(columns):
        return False
    return [columns[name] for name in _POSE] != list(range(n_fields - len(_POSE), n_fields))


def find_columns(names: Sequence[str]) -> dict[str, int]:
    """Return the column of each quantity that a header names: the first of those that fit best.

    Quantities are time, or sec and nsec; x, y, z; qx, qy, qz, qw; roll, pitch, yaw.
    """
    best = {quantity: min(each) for quantity, each in _list_fits(names).items()}
    if "sec" in best and best["sec"][0] < best.get("time", (0,))[0]:
        del best["time"]  # when it was recorded
    return {quantity: index for quantity, (_, index, _) in best.items()}


def find_rivals(names: Sequence[str]) -> list[str]:
    """Return the names of groups of columns that hold positions equally well; empty where one fits best."""
    fits = _list_fits(names).get("x", [])
    least = min((misfit for misfit, *_ in fits), default=0)
    groups = list(dict.fromkeys(group for misfit, _, group in fits if misfit == least))
    return groups if len(groups) > 1 else []


def _list_fits(names: Sequence[str]) -> dict[str, list[tuple[int, int, str]]]:
    """Return how badly each column fits that may hold a quantity, its place and the words before its axis."""
    fits: dict[str, list[tuple[int, int, str]]] = {}
    for index, name in enumerate(names):
        text = re.sub(r"[\[(].*?[\])]", "", name).strip().lower()
        tokens = [token for token in re.split(r"[^a-z0-9]+", text) if token]
        is_unit = len(tokens) > 1 and tokens[-1] in (*_ANGLE_UNITS, *TIME_UNITS_S)
        tokens = tokens[:-1] if is_unit and tokens[-1] not in _NAMES["nsec"] else tokens
        if not tokens:
            continue
        # `pose.orientation.x`, `q_RS_x`: the last word is the axis, a word before says of what
        is_turn = bool(_TURNS & set(tokens[:-1])) and tokens[-1] in ("x", "y", "z", "w")
        last = f"q{tokens[-1]}" if is_turn else tokens[-1]
        quantity = next((quantity for quantity, usual in _NAMES.items() if last in usual), None)
        if quantity is None or _NO_POSE & set(tokens[:-1]):
            continue
        if quantity in ("x", "y", "z") and _NO_PLACE & set(tokens[:-1]):
            continue
        fits.setdefault(quantity, []).append((_misfit(quantity, tokens), index, " ".join(tokens[:-1])))
    return fits


def _misfit(quantity: str, tokens: Sequence[str]) -> int:
    """Return how badly a column fits: `x` comes before `position_x`, and that before `marker_x`."""
    words = set(tokens[:-1])
    if quantity in _CLOCKS:  # `header.stamp` is when it was measured, `Time` beside it when it was recorded
        return 0 if words & {"header", "stamp"} else 1
    if not words:
        return 0
    return 1 if words & (_PLACES | _TURNS) else _OF_SOMETHING
