"""GenZ-ICP odometry (Lee, Lim, Han 2024) of the scans of a session, for smooth drifts in which KISS-ICP slides.

It weighs planes and points by how many of either a scan holds. The package keeps a state for its whole process, so that
a second recording would get other poses than in a process of its own. Therefore each recording has a process of its
own, which reads the scans from a temporary folder.
"""

# ruff: noqa: PLC0415 - GenZ-ICP is an extra, and everybody else must be able to import this

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

# The package's own settings for indoor spaces, but for the range.
_MAX_RANGE_M, _VOXEL_M, _N_POINTS = 50.0, 0.3, 2000
_PLANARITY, _POINTS_PER_VOXEL = 0.2, 1
_FIRST_THRESHOLD_M, _LEAST_MOTION_M = 2.0, 0.1
_MAX_ITERATIONS, _CONVERGED = 100, 1e-4


def register_stored(document: dict[str, Any]) -> list[Any]:
    """Return the poses (S, 4, 4) of stored scans as lists; called in a process of its own.

    Args:
        document: `folder` of the scans, their `stamps_s`, and `what` one is called.

    Raises:
        InputError: A pose is not finite.
    """
    from cdpipe.mapping.poses.odometry import cloud_frame, register_frames

    _keep_to_one_core()

    def frames() -> Iterator[Any]:
        for number in range(len(document["stamps_s"])):
            with np.load(stored_scan(Path(document["folder"]), number), allow_pickle=False) as scan:
                yield cloud_frame(scan["points"], scan["time_s"] if len(scan["time_s"]) else None)

    stamps_s = np.asarray(document["stamps_s"], dtype=np.float64)
    poses: list[Any] = register_frames(_genz_icp(), "GenZ-ICP", frames(), stamps_s, document["what"]).tolist()
    return poses


def stored_scan(folder: Path, number: int) -> Path:
    """Return the file of a scan: `points` (N, 3) and `time_s` (N,), or (0,) where they have no times."""
    return folder / f"{number:06d}.npz"


def _keep_to_one_core() -> None:
    """Let this process run on one core: the package adds up in the order of its threads, whose number is not ours."""
    if sys.platform == "linux":
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[os.getpid() % len(cores)]})


def _genz_icp() -> Any:
    """Return GenZ-ICP with every setting explicit, so that its environment variables have no effect."""
    from genz_icp.config import GenZConfig
    from genz_icp.config.config import AdaptiveThresholdConfig, DataConfig, MappingConfig, RegistrationConfig
    from genz_icp.genz_icp import GenZICP

    return GenZICP(
        GenZConfig(
            data=DataConfig(max_range=_MAX_RANGE_M, min_range=0.0, deskew=False),
            mapping=MappingConfig(
                voxel_size=_VOXEL_M, map_cleanup_radius=_MAX_RANGE_M, desired_num_voxelized_points=_N_POINTS,
                planarity_threshold=_PLANARITY, max_points_per_voxel=_POINTS_PER_VOXEL,
            ),
            registration=RegistrationConfig(
                max_num_iterations=_MAX_ITERATIONS, convergence_criterion=_CONVERGED, max_num_threads=1
            ),
            adaptive_threshold=AdaptiveThresholdConfig(
                fixed_threshold=None, initial_threshold=_FIRST_THRESHOLD_M, min_motion_th=_LEAST_MOTION_M
            ),
        )
    )  # fmt: skip
