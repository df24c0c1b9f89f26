"""Checks of a session before it is mapped: scans, unit, up axis.

Five scans are read. Lengths that no tunnel has in metres are refused. A session in feet passes; if the merge then
fails, `unit_hint` compares the sizes of the two sessions.
"""

from __future__ import annotations

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, Int64Array, require_poses
from cdpipe.mapping.mapping import choose_keyframes
from cdpipe.model.config import MapConfig
from cdpipe.model.types import PointMap, ScanSource

UNITS = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "feet": 0.3048, "kilometres": 1000.0}
_SAMPLED_SCANS = 5
# Possible and usual median range of a scan, metres.
_NEAREST_M, _FARTHEST_M = 0.25, 60.0
_USUAL_M = (0.5, 20.0)
# Usual distance between neighbouring scans, metres. Stations of a tripod lie farther apart, but the way between them
# takes its time: nobody maps a tunnel faster than this.
_USUAL_STEP_M = (0.005, 2.0)
_FASTEST_M_PER_S = 20.0
# Eigenvalues of the mean outer product of ray directions: one below _FLAT and two above _ROUND give the spin axis.
_FLAT, _ROUND = 0.12, 0.25
_MIN_RETURNS = 100
_MAX_TILT_DEG = 45.0
_STANDING_M = 1.0
# Clocks beyond this count from 1970; sensors without such a clock count from when they were switched on. Seconds.
_CALENDAR_S = 1e9
# Largest ratio of the median ranges of two sessions of one tunnel.
_SAME_TUNNEL = 1.4
# Tolerance factor of a ratio of lengths against a ratio of units.
_SAME_SIZE = 1.2


def check_session(source: ScanSource, config: MapConfig, other: ScanSource | None = None) -> None:
    """Refuse a session that the pipeline cannot use as it is.

    Args:
        source: The session; five of its scans are read.
        config: Keyframe spacing.
        other: Another session of the same tunnel, which narrows down the unit.

    Raises:
        InputError: A pose is not finite; there is no scan; points or trajectory are not in metres; z is not up.
    """
    poses = source.odom_T_sensor
    try:
        require_poses("the pose of scan", poses)
    except ValueError as error:
        raise InputError(f"{source.name}: {error}: correct it, or remove the scan") from error
    if len(poses) == 0:
        raise InputError(f"{source.name}: holds no scan: record it again")
    points = _sampled_points(source)
    if len(points) == 0:
        raise InputError(f"{source.name}: none of the scans that were looked at holds a return")
    ranges_m = np.linalg.norm(points, axis=1)
    _require_ranges_in_metres(source, ranges_m, other)
    _require_path_in_metres(source, ranges_m, source.name)
    if not getattr(source, "is_whole_map", False):  # stations cast no beams
        _require_up(source, points[ranges_m > 0] / ranges_m[ranges_m > 0, None], config.keyframe_spacing_m)


def require_path_in_metres(source: ScanSource, where: str) -> None:
    """Refuse a trajectory that cannot be in metres; five scans are read.

    Args:
        source: The scans with their poses.
        where: The recording or the trajectory, for the message.

    Raises:
        InputError: Neighbouring scans lie too far apart for any robot; the unit that explains it is named.
    """
    if len(points := _sampled_points(source)):
        _require_path_in_metres(source, np.linalg.norm(points, axis=1), where)


def is_same_session(before: ScanSource, after: ScanSource) -> bool:
    """Return whether both sessions have the same poses and the same first scan."""
    return np.array_equal(before.odom_T_sensor, after.odom_T_sensor) and np.array_equal(
        before.scan(0).points_sensor, after.scan(0).points_sensor
    )


def are_swapped(before: ScanSource, after: ScanSource) -> bool:
    """Return whether the later session was recorded first; False where a clock is not that of the calendar."""
    start_s, after_start_s = map(_start_s, (before, after))
    return min(start_s, after_start_s) > _CALENDAR_S and after_start_s < start_s


def _start_s(source: ScanSource) -> float:
    """Return when a session began, by its own clock, seconds; 0 where it does not tell."""
    stamps_s = getattr(source, "stamps_s", None)
    if stamps_s is not None and len(stamps_s):
        return float(stamps_s[0])
    session = getattr(source, "session", None)
    return float(1e-9 * getattr(session, "provenance", {}).get("sensor_clock_start_ns", 0))


def unit_hint(before: PointMap, after: PointMap) -> str:
    """Return advice if the sizes of two maps differ by the ratio of a unit to the metre, else ""."""
    before_m, after_m = _median_return_m(before), _median_return_m(after)
    for name, small_m, large_m in (("after", before_m, after_m), ("before", after_m, before_m)):
        for unit, factor in UNITS.items():
            if small_m > 0 and factor < 1 and 1 / _SAME_SIZE < factor * large_m / small_m < _SAME_SIZE:
                return (
                    f"the {name} session's returns lie {large_m / small_m:.1f} times as far as the other's: if it is "
                    f"in {unit}, scale its points and its trajectory by {factor:g}"
                )
    return ""


def _sampled(n_scans: int) -> list[int]:
    chosen = np.linspace(0, n_scans - 1, min(n_scans, _SAMPLED_SCANS)).round().astype(np.int64)
    return [int(index) for index in chosen]


def _sampled_points(source: ScanSource) -> Float64Array:
    return np.concatenate([source.scan(index).points_sensor for index in _sampled(len(source.odom_T_sensor))])


def _require_ranges_in_metres(source: ScanSource, ranges_m: Float64Array, other: ScanSource | None) -> None:
    median_m = float(np.median(ranges_m))
    if not _NEAREST_M <= median_m <= _FARTHEST_M:
        usual_m = _USUAL_M
        if other is not None:
            other_m = float(np.median(np.linalg.norm(_sampled_points(other), axis=1)))
            if _NEAREST_M <= other_m <= _FARTHEST_M:
                usual_m = other_m / _SAME_TUNNEL, other_m * _SAME_TUNNEL
        side = "beyond" if median_m > _FARTHEST_M else "within"
        raise InputError(
            f"{source.name}: half of the returns lie {side} {median_m:.4g} m: expected metres; "
            f"{_likely('the points', median_m, usual_m)}, and the trajectory too where it is in the same unit"
        )


def _require_path_in_metres(source: ScanSource, ranges_m: Float64Array, where: str) -> None:
    steps_m = np.linalg.norm(np.diff(source.odom_T_sensor[:, :3, 3], axis=0), axis=1)
    step_m = float(np.median(steps_m)) if len(steps_m) else 0.0
    reach_m = float(np.quantile(ranges_m, 0.95))
    if step_m > reach_m and _speed_m_per_s(source) > _FASTEST_M_PER_S:
        raise InputError(
            f"{where}: neighbouring scans lie {step_m:.4g} m apart and see {reach_m:.3g} m far: expected a "
            f"trajectory in metres; {_likely('the trajectory', step_m, _USUAL_STEP_M)}"
        )


def _speed_m_per_s(source: ScanSource) -> float:
    """Return the mean speed from the first to the last scan; infinite where their times tell none."""
    scans = [source.scan(index) for index in _sampled(len(source.odom_T_sensor))]
    stamps_ns = [int(scan.stamps_ns.min()) for scan in scans if len(scan.stamps_ns)]
    way_m = np.linalg.norm(np.diff(source.odom_T_sensor[:, :3, 3], axis=0), axis=1).sum()
    lasted_s = 1e-9 * (stamps_ns[-1] - stamps_ns[0])
    return float(way_m / lasted_s) if lasted_s > 0 else np.inf


def _likely(what: str, length: float, usual_m: tuple[float, float]) -> str:
    """Return text that names the units that make a length usual, and their scale factors."""
    units = [unit for unit, factor in UNITS.items() if usual_m[0] <= factor * length <= usual_m[1]]
    verb = "look" if what.endswith("s") else "looks"
    if not units:
        return f"find out the unit of {what} and scale to metres"
    named = " or ".join(units)
    factors = " or ".join(f"{UNITS[unit]:g}" for unit in units)
    return f"{what} {verb} like {named}: scale by {factors}"


def _require_up(source: ScanSource, directions: Float64Array, spacing_m: float) -> None:
    poses = source.odom_T_sensor
    spread, axes = np.linalg.eigh(directions.T @ directions / max(1, len(directions)))
    if len(directions) >= _MIN_RETURNS and spread[0] < _FLAT and spread[1] > _ROUND:
        axis = axes[:, 0]
        tilts_deg = np.degrees(np.arccos(np.clip(np.abs(poses[:, 2, :3] @ axis), 0.0, 1.0)))
        for frame, tilt_deg in (
            ("the sensor's frame", float(np.degrees(np.arccos(min(1.0, abs(axis[2])))))),
            ("the trajectory's frame", float(np.median(tilts_deg))),
        ):
            if tilt_deg > _MAX_TILT_DEG:
                raise InputError(
                    f"{source.name}: the sensor spins about an axis {tilt_deg:.0f} degrees off z of {frame}: expected "
                    "x forward and z up (a camera's frame has z forward): turn the points and the poses"
                )
    positions = poses[choose_keyframes(poses, spacing_m), :3, 3]
    if np.ptp(positions, axis=0).max() < _STANDING_M:  # the way of a sensor that stands is the noise of its odometry
        return
    steps = np.diff(positions, axis=0)
    slope_deg = float(np.degrees(np.arctan2(np.abs(steps[:, 2]).sum(), np.linalg.norm(steps[:, :2], axis=1).sum())))
    if slope_deg > _MAX_TILT_DEG:
        raise InputError(
            f"{source.name}: the path climbs or falls by {slope_deg:.0f} degrees: expected a trajectory with z up (a "
            "camera's frame has z forward): turn the poses; shafts are beyond this pipeline"
        )


def _median_return_m(point_map: PointMap) -> float:
    """Return the median range of mapped returns over five scans, metres."""
    found = [np.zeros(0)]
    for scan in _sampled(len(point_map.odom_T_sensor)):
        returns: Int64Array = np.arange(point_map.scan_offsets[scan], point_map.scan_offsets[scan + 1])
        offsets = point_map.points[point_map.return_points[returns]] - point_map.odom_T_sensor[scan, :3, 3]
        found.append(np.linalg.norm(offsets, axis=1))
    ranges_m = np.concatenate(found)
    return float(np.median(ranges_m)) if len(ranges_m) else 0.0
