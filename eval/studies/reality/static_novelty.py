"""False novelty of a static scene: the share of returns in voxels without returns of the session's other half.

Two ways to cut a session of N revolutions in halves, both with true poses, so that what is new comes from the sensor
and not from odometry: a sensor that stands still, its first N/2 revolutions against its last; and a sensor that drives,
every other revolution against the ones between. A third one places every revolution of the drive with a random error of
1 cm and 0.1 degrees, about what scan registration leaves (unverified).
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, invert, make_pose, stream
from eval.studies.reality.scenes import change_effects, find_world_points, stop_drive
from eval.studies.reality.sensor_measures import measure_novel_shares
from scenarios.schema import Sensor
from sim.session.revolution import Drive, cast_revolution

CELLS_M = (0.1, 0.2, 0.4)
# Of a real 32-beam recording of a static scene, half against half; stated to us, not measured here: how many
# revolutions a half has, whether the sensor moved and where its poses come from is not known.
REAL_SHARES = (0.061, 0.021, 0.008)
POSE_ERROR_M, POSE_ERROR_DEG = 0.01, 0.1
Shares = tuple[float, ...]
Way = Literal["standing", "driving", "driving, poses off"]
WAYS: tuple[Way, ...] = ("standing", "driving", "driving, poses off")
N_REVOLUTIONS = 40
STANDING_NUMBERS = (4, 10, 20, 40, 100, 200)
_THREADS = 2


@dataclass(frozen=True, slots=True)
class Case:
    """How the sensor moves, which effects are on and what they are called, and the revolutions of both halves."""

    way: Way
    variant: str
    settings: Sensor
    n_revolutions: int


def list_effect_variants(default: Sensor) -> dict[str, Sensor]:
    """Return the settings to compare: default, each effect off, both divergences, coarse steps, nothing."""
    switches = ("rolling_scan", "range_noise", "dropouts", "false_positives")
    variants = {"default": default}
    variants |= {f"{name} off": default.model_copy(update={name: False}) for name in switches}
    variants |= {f"sub_rays {number}": default.model_copy(update={"sub_rays": number}) for number in (7, 19)}
    variants["range_step_mm 8"] = default.model_copy(update={"range_step_mm": 8})
    variants["all off"] = default.model_copy(update=dict.fromkeys(switches, False) | {"sub_rays": 1})
    return variants


def list_novelty_cases(default: Sensor) -> list[Case]:
    """Return every case once: standing with default effects, by number of revolutions, then each way and variant.

    The rolling scan has no effect on a sensor that stands still, so that case is left out.
    """
    cases = [Case("standing", "default", default, number) for number in STANDING_NUMBERS]
    cases += [
        Case(way, variant, settings, N_REVOLUTIONS)
        for way in WAYS
        for variant, settings in list_effect_variants(default).items()
        if way != "standing" or variant not in ("default", "rolling_scan off")
    ]
    return cases


def measure_static_novelty(drive: Drive, case: Case, first: int) -> Shares:
    """Return the share of novel returns between two halves of some revolutions of a drive, for each of `CELLS_M`.

    Args:
        drive: World and way.
        case: Effects, number of revolutions, and whether all are taken from the first one's place.
        first: Number of the first revolution of the drive.
    """
    clouds = _cast_clouds(drive, case, range(first, first + case.n_revolutions))
    half = len(clouds) // 2
    if case.way == "standing":
        halves = np.concatenate(clouds[:half]), np.concatenate(clouds[half:])
    else:
        halves = np.concatenate(clouds[::2]), np.concatenate(clouds[1::2])
    return tuple(measure_novel_shares(halves, CELLS_M).tolist())


def _cast_clouds(drive: Drive, case: Case, numbers: Sequence[int]) -> list[Float64Array]:
    """Return the points (N, 3) of each revolution, world frame."""
    recorded = change_effects(drive, case.settings)
    if case.way == "standing":
        recorded, numbers = stop_drive(recorded, numbers[0], len(numbers)), range(len(numbers))

    def cloud(number: int) -> Float64Array:
        _, result = cast_revolution(recorded, number)
        poses = recorded.trajectory.world_T_column(slice(number, number + 1))[0]
        error = _draw_pose_error(number) if case.way == "driving, poses off" else np.eye(4)
        middle = poses[len(poses) // 2]
        return find_world_points(recorded.sensor, result, middle @ error @ invert(middle) @ poses)

    with ThreadPoolExecutor(_THREADS) as pool:
        return list(pool.map(cloud, numbers))


def _draw_pose_error(number: int) -> Float64Array:
    """Return a small error (4, 4) of a revolution's pose in its own frame."""
    draw = stream(0, "pose-error", str(number)).standard_normal(6)
    turn = Rotation.from_rotvec(np.deg2rad(POSE_ERROR_DEG) * draw[:3]).as_matrix()
    return make_pose(turn, POSE_ERROR_M * draw[3:])
