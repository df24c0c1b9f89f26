"""The drift of KISS-ICP on our drives and of published rollouts, and the random walk that fits each.

    python -m sim.studies.drift kiss narrow:10001 narrow:10002 wide:10001    # a row and a fit over these pairs
    python -m sim.studies.drift rollouts FOLDER                              # CSV files, as ethz-asl/dynablox has them
    python -m sim.studies.drift walk FOLDER                                  # the gait of the true poses among them

An error of the relative pose over a distance is measured as KITTI does, in gravity-aligned axes along the true
displacement.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, invert, make_pose, travelled_m
from cdpipe.io.session import read_session
from scenarios.library import load_scenario
from sim.drive.odometry import walk_sigma
from sim.session.simulate import simulate_pair
from sim.session.truth import SESSIONS, read_true_poses

DISTANCES_M = (0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)  # 0: from one revolution to the next
AXES = ("along_m", "left_m", "up_m", "yaw_deg", "roll_deg", "pitch_deg")
ROLLOUTS = ("light", "moderate", "strong", "severe")
_SETTINGS = ("before.odometry.source=kiss-icp", "after.odometry.source=kiss-icp", "sensor.sub_rays=1")
_SLACK_M = 1e-6  # rounding drops no revolution
_SCAN_HZ = 10.0
_WALK_STEP_M = 0.22  # a faster step of a hand is a gap in the recording
_WINDOW = 64
_STEP_HZ = (1.2, 2.6)
_STRIDE_HZ = (0.5, 1.2)

Poses = tuple[Float64Array, Float64Array]  # true and estimated, (S, 4, 4) each


def estimate_poses(name: str, seed: int, settings: Sequence[str] = ()) -> list[Poses]:
    """Return true and KISS-ICP's poses of both sessions of a pair.

    Raises:
        InputError, ScenarioError: As `sim.session.simulate.simulate_pair`.
    """
    scenario = load_scenario(name, seed, [*_SETTINGS, *settings])
    with TemporaryDirectory() as folder:
        simulate_pair(scenario, seed, Path(folder) / "pair")
        sessions = [Path(folder) / "pair" / name for name in SESSIONS]
        return [(read_true_poses(each), read_session(each).odom_T_sensor) for each in sessions]


def relative_errors(true: Float64Array, estimated: Float64Array, distance_m: float) -> Float64Array:
    """Return the errors (N, 6) of the relative poses over a distance; columns are `AXES`.

    Roll is about the direction of travel at the end of the distance, pitch about the axis to its left.
    """
    way_m = travelled_m(true)
    start = np.arange(len(true))
    end = np.searchsorted(way_m, way_m + distance_m - _SLACK_M) if distance_m else start + 1
    start, end = start[end < len(true)], end[end < len(true)]
    if len(end) == 0:
        return np.zeros((0, len(AXES)))  # scipy 1.14 makes no rotations of no matrices
    wanted, found = (invert(poses[start]) @ poses[end] for poses in (true, estimated))
    shift = np.einsum("nij,nj->ni", true[start, :3, :3], found[:, :3, 3] - wanted[:, :3, 3])
    along, left = _along_and_left(shift, true[end, :2, 3] - true[start, :2, 3])
    turn = true[start, :3, :3] @ found[:, :3, :3] @ invert(wanted)[:, :3, :3] @ true[start, :3, :3].swapaxes(1, 2)
    about = Rotation.from_matrix(turn).as_rotvec(degrees=True)
    roll, pitch = _along_and_left(about, np.gradient(true[:, :2, 3], axis=0)[end])
    return np.column_stack([along, left, shift[:, 2], about[:, 2], roll, pitch])


def _along_and_left(vectors: Float64Array, ahead: Float64Array) -> Poses:
    """Return the parts (N,) of vectors (N, 3) along and to the left of level directions (N, 2)."""
    ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    return (vectors[:, :2] * ahead).sum(axis=1), vectors[:, 1] * ahead[:, 0] - vectors[:, 0] * ahead[:, 1]


def tabulate_errors(sessions: Sequence[Poses]) -> Float64Array:
    """Return the root mean squares (len(DISTANCES_M), 6) over all sessions, NaN where none is that long."""
    rows = []
    for distance_m in DISTANCES_M:
        errors = np.concatenate([relative_errors(true, found, distance_m) for true, found in sessions])
        rows.append(np.sqrt((errors**2).mean(axis=0)) if len(errors) else np.full(len(AXES), np.nan))
    return np.array(rows)


def fit_walk(table: Float64Array, step_m: float) -> dict[str, float]:
    """Return the figures of `source: random-walk` whose errors come nearest to a table of `tabulate_errors`.

    Args:
        table: Root mean squares.
        step_m: Distance between revolutions, which the row of distance 0 stands for.
    """
    way_m = np.array([step_m, *DISTANCES_M[1:]])

    found: dict[str, float] = {}
    for columns, model, names in (
        ([0], _integrated, ("scale_percent", "scale_length_m", "jitter_along_m")),
        ([3], _integrated, ("yaw_deg_per_m", "yaw_length_m", "jitter_yaw_deg")),
        ([4, 5], _bounded, ("tilt_deg", "tilt_length_m", "jitter_roll_deg", "jitter_pitch_deg")),
    ):
        found |= dict(zip(names, _fit_process(way_m, table[:, columns], model).tolist(), strict=True))
    found["scale_percent"] *= 100.0
    return found | {"jitter_across_m": float(np.sqrt((table[0, 1:3] ** 2).mean() / 2))}


def _integrated(sigma: float, length_m: float, way_m: Float64Array) -> Float64Array:
    return np.array([walk_sigma(sigma, length_m, way) for way in way_m])


def _bounded(sigma: float, length_m: float, way_m: Float64Array) -> Float64Array:
    return np.asarray(sigma * np.sqrt(2.0 * (1.0 - np.exp(-way_m / length_m))))


def _fit_process(
    way_m: Float64Array, errors: Float64Array, model: Callable[[float, float, Float64Array], Float64Array]
) -> Float64Array:
    """Return the process whose errors are nearest in ratio to measured ones.

    Args:
        way_m: (D,) distances.
        errors: (D, A) root mean squares of one or two axes that share the process.
        model: Standard deviation of its errors over distances.

    Returns:
        Its standard deviation, its correlation length, and the jitter (A,) of each axis.
    """
    is_known = (errors > 0).all(axis=1)
    if not is_known.any():
        return np.array([0.0, 1.0, *np.zeros(errors.shape[1])])
    way_m, errors = way_m[is_known], errors[is_known]

    def misfit(logs: Float64Array) -> Float64Array:
        sigma, length_m, *jitter = np.exp(logs)
        drift = model(sigma, length_m, way_m)[:, None]
        return np.log(np.sqrt(2.0 * np.square(jitter) + drift**2) / errors).ravel()

    first = errors[0]
    low = np.log([first.min() / 1e4, 1.0, *(first / 1e3)])
    high = np.log([first.max() * 1e2, 200.0, *first])
    return np.asarray(
        np.exp(least_squares(misfit, np.log([first.min() / 10, 20.0, *(first / 1.5)]), bounds=(low, high)).x)
    )


def read_rollouts(folder: Path) -> dict[str, list[Poses]]:
    """Return the drifting poses of every level, with the true ones, of the sequences below a folder."""
    found: dict[str, list[Poses]] = {level: [] for level in ROLLOUTS}
    for truth in sorted(folder.rglob("none.csv")):
        for level in ROLLOUTS:
            found[level] += [
                (_read_csv(truth), _read_csv(path)) for path in sorted(truth.parent.glob(f"{level}_*.csv"))
            ]
    return found


def measure_gait(poses: Float64Array) -> dict[str, float]:
    """Return the gait and the slow tilt of a walk of 10 poses a second, (N, 4, 4).

    An amplitude is that of the sine with the power found between 1.2 and 2.6 Hz (steps) or 0.5 and 1.2 Hz (strides), in
    windows of 6.4 s without a gap, each freed from its cubic trend.
    """
    points = poses[:, :3, 3]
    is_step = np.linalg.norm(np.diff(points, axis=0), axis=1) < _WALK_STEP_M
    starts = [first for first in range(0, len(poses) - _WINDOW, _WINDOW // 2) if is_step[first : first + _WINDOW].all()]
    hertz = np.fft.rfftfreq(_WINDOW, 1 / _SCAN_HZ)
    hann = np.hanning(_WINDOW)
    spectra = []
    for first in starts:
        window = poses[first : first + _WINDOW]
        ahead = window[-1, :2, 3] - window[0, :2, 3]
        ahead /= np.linalg.norm(ahead)
        pitch, roll = _tilt_deg(window, np.arctan2(ahead[1], ahead[0]))
        yaw = np.rad2deg(np.unwrap(np.arctan2(window[:, 1, 0], window[:, 0, 0])))
        left = window[:, 1, 3] * ahead[0] - window[:, 0, 3] * ahead[1]
        series = np.stack([window[:, 2, 3], left, pitch, roll, yaw])
        times = np.linspace(-1.0, 1.0, _WINDOW)
        series -= np.stack([np.polyval(np.polyfit(times, one, 3), times) for one in series])
        spectra.append(np.abs(np.fft.rfft(series * hann, axis=1)) ** 2 * 2.0 / ((hann**2).sum() * _WINDOW))
    power = np.mean(spectra, axis=0)

    def amplitude(row: int, band: tuple[float, float]) -> float:
        is_in = (hertz >= band[0]) & (hertz < band[1])
        return float(np.sqrt(2.0 * power[row, is_in].sum()))

    is_step_hz = (hertz >= _STEP_HZ[0]) & (hertz < _STEP_HZ[1])
    step_hz = [hertz[is_step_hz][np.argmax(one[0, is_step_hz])] for one in spectra]
    headings = np.gradient(
        np.stack([np.convolve(points[:, axis], np.ones(21) / 21, "same") for axis in (0, 1)]), axis=1
    )
    pitch, roll = _tilt_deg(poses, np.arctan2(headings[1], headings[0]))
    return {
        "n_windows": len(starts),
        "step_hz": float(np.median(step_hz)),
        "bob_m": amplitude(0, _STEP_HZ),
        "sway_m": amplitude(1, _STRIDE_HZ),
        "pitch_deg": amplitude(2, _STEP_HZ),
        "roll_deg": amplitude(3, _STRIDE_HZ),
        "yaw_deg": amplitude(4, _STRIDE_HZ),
        "tilt_deg": float(np.sqrt((pitch.var() + roll.var()) / 2)),
    }


def _tilt_deg(poses: Float64Array, heading_rad: Float64Array | float) -> Poses:
    """Return pitch and roll (N,) of the sensor's z axis against a heading, degrees."""
    x, y = poses[:, 0, 2], poses[:, 1, 2]
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    return np.rad2deg(np.arcsin(x * cos + y * sin)), np.rad2deg(np.arcsin(x * sin - y * cos))


def _read_csv(path: Path) -> Float64Array:
    try:
        rows = np.loadtxt(path, delimiter=",", ndmin=2)
        return make_pose(Rotation.from_quat(rows[:, 3:7]).as_matrix(), rows[:, :3])
    except (OSError, ValueError, IndexError) as error:
        raise InputError(f"{path}: {error}: expected lines of x, y, z and a quaternion, separated by commas") from error


def _report(name: str, sessions: Sequence[Poses]) -> str:
    table = tabulate_errors(sessions)
    step_m = float(np.mean([travelled_m(true)[-1] / (len(true) - 1) for true, _ in sessions]))
    lines = [f"{name}: {len(sessions)} sessions, {step_m:.2f} m a revolution", "distance_m " + " ".join(AXES)]
    lines += [f"{way:10g} " + " ".join(f"{v:.4f}" for v in row) for way, row in zip(DISTANCES_M, table, strict=True)]
    fitted = ", ".join(f"{key}: {value:.3g}" for key, value in fit_walk(table, step_m).items())
    return "\n".join([*lines, f"  {{source: random-walk, {fitted}}}"])


def main(words: Sequence[str]) -> None:
    """Run one of the three commands of this module."""
    match words:
        case ["kiss", *pairs] if pairs:
            sessions: list[Poses] = []
            for pair in pairs:
                name, _, seed = pair.partition(":")
                sessions += estimate_poses(name, int(seed))
            sys.stdout.write(_report(" ".join(pairs), sessions) + os.linesep)
        case ["rollouts", folder]:
            for level, found in read_rollouts(Path(folder)).items():
                sys.stdout.write(_report(level, found) + os.linesep)
        case ["walk", folder]:
            for path in sorted(Path(folder).rglob("none.csv")):
                sys.stdout.write(f"{path}: {measure_gait(_read_csv(path))}{os.linesep}")
        case _:
            sys.exit(f"usage:{(__doc__ or '').split(os.linesep * 2)[1]}")


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except InputError as mistake:
        sys.stderr.write(f"error: {mistake}{os.linesep}")
        sys.exit(2)
