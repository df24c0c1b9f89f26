"""KISS-Matcher (Lim et al., ICRA 2025, arXiv 2409.15615), an extra: two clouds into one frame without a first guess.

The library turns every normal towards the origin of its cloud before it describes the neighbourhood by angles between
normals. In a tunnel two sessions that share a part of the way have their origins elsewhere, so the same wall gets
opposite normals, and of two maps of a narrow drift that share 45 % no voxel size found the pose. Seen from far below,
normals depend on the wall alone: with that origin every such pair was found. It asks that both maps be levelled.
"""

# ruff: noqa: PLC0415 - KISS-Matcher is an extra, and everybody else must be able to import this

from __future__ import annotations

import ctypes
import importlib.util
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import small_gicp
from scipy.spatial import cKDTree

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, make_pose, require_shape
from cdpipe.core.voxel import max_coordinate_m

# Far against any mine, near enough for the library's float32: 0.03 mm.
_VIEWPOINT_M = np.array([0.0, 0.0, -500.0])
# The library's own advice for large maps, which it otherwise prints.
_MAX_NOISE_BOUND_M = 1.0
# It reads memory that is not its own where no point has a normal. A point has one if three lie within three voxels;
# these neighbours of one point are neighbours of each other, and two more than needed.
_NEIGHBOURS = 5
_NEIGHBOURHOOD_VOXELS = 1.5
_N_PROBED = 1000
_MIN_INLIERS = 3


@dataclass(frozen=True, slots=True, eq=False)
class CoarsePose:
    """What KISS-Matcher found, right or wrong.

    Attributes:
        before_T_after: (4, 4) pose of the after cloud in the before cloud's frame.
        n_inliers: Correspondences that agree with the pose: on validation pairs at voxels that found them all, 21 and
            more; wrong poses had up to 10.
        n_correspondences: Pairs of points with like surroundings that it was found among.
    """

    before_T_after: Float64Array
    n_inliers: int
    n_correspondences: int


def is_kiss_matcher_installed() -> bool:
    """Return whether the extra `kiss` is there."""
    return importlib.util.find_spec("kiss_matcher") is not None


def require_kiss_matcher(asked_by: str) -> None:
    """Raise `InputError` with the way out where KISS-Matcher is missing; `asked_by` is the setting that wants it."""
    if not is_kiss_matcher_installed():
        raise InputError(f"{asked_by} needs a package more: pip install 'tunnelcd[kiss]'")


def register_globally(before_points: Float64Array, after_points: Float64Array, voxel_m: float) -> CoarsePose | None:
    """Find how two clouds fit together, wherever they lie and however they are turned about the vertical.

    The same clouds give the same bits.

    Args:
        before_points: (N, 3) points, metres, z up.
        after_points: (M, 3) points, metres, z up.
        voxel_m: Thinning of both clouds; normals are taken over 3, features over 5 voxels.

    Returns:
        None where there is no pose: fewer than three correspondences agree, or a cloud has no surfaces at the scale of
        the voxel (it is empty, has a few points, or scattered ones).

    Raises:
        InputError: The extra `kiss` is not installed.
        ValueError: A point is not finite, or a cloud is too wide for the voxel.
    """
    require_kiss_matcher("finding a merge by KISS-Matcher")
    clouds, centres = [], []
    for name, points in (("before_points", before_points), ("after_points", after_points)):
        cloud, centre = _prepare(name, points, voxel_m)
        if not _has_surfaces(cloud, voxel_m):
            return None
        clouds.append(cloud)
        centres.append(centre)
    library = _library()
    matcher = library.KISSMatcher(_settings(library, voxel_m))
    before_seen, after_seen = ((cloud - _VIEWPOINT_M).astype(np.float32) for cloud in clouds)
    with _one_openmp_thread():
        found = matcher.estimate(after_seen, before_seen)
    n_inliers = matcher.get_num_final_inliers()
    pose = make_pose(np.asarray(found.rotation), np.asarray(found.translation))
    if not found.valid or n_inliers < _MIN_INLIERS or not np.isfinite(pose).all():
        return None
    before_T_seen, seen_T_after = make_pose(translation=centres[0]), make_pose(translation=-centres[1])
    n_correspondences = len(matcher.get_initial_correspondences())
    return CoarsePose(before_T_seen @ pose @ seen_T_after, n_inliers, n_correspondences)


def _prepare(name: str, points: Float64Array, voxel_m: float) -> tuple[Float64Array, Float64Array]:
    """Return a cloud thinned and about its centre, and where the viewpoint stands in the cloud's own frame."""
    require_shape(name, points, (None, 3))
    if len(points) == 0:
        return points, np.zeros(3)
    if not np.isfinite(points).all():
        raise ValueError(f"{name} must be finite")
    centre = points.mean(axis=0)
    local = points - centre
    if np.abs(local).max() >= max_coordinate_m(voxel_m):
        raise ValueError(f"{name} must lie within {max_coordinate_m(voxel_m):.0f} m of their mean for this voxel")
    thin = small_gicp.voxelgrid_sampling(local, voxel_m, num_threads=1).points()[:, :3]
    return np.asarray(thin), centre + _VIEWPOINT_M


def _has_surfaces(cloud: Float64Array, voxel_m: float) -> bool:
    if len(cloud) < _NEIGHBOURS:
        return False
    probed = cloud[:: max(1, len(cloud) // _N_PROBED)]
    distances_m, _ = cKDTree(cloud).query(probed, k=[_NEIGHBOURS])
    return bool(np.any(np.asarray(distances_m) < _NEIGHBOURHOOD_VOXELS * voxel_m))


def _settings(library: Any, voxel_m: float) -> Any:
    settings = library.KISSMatcherConfig(voxel_m, use_voxel_sampling=False, enable_noise_bound_clamping=False)
    settings.robin_noise_bound = min(settings.robin_noise_bound, _MAX_NOISE_BOUND_M)
    settings.solver_noise_bound = min(settings.solver_noise_bound, _MAX_NOISE_BOUND_M)
    return settings


@cache
def _library() -> Any:
    """Import KISS-Matcher and let TBB start with one thread: several write bits of one byte, and every run differs."""
    with _one_processor():
        import kiss_matcher

        grid = np.stack(np.meshgrid(*[np.arange(6.0)] * 3), axis=-1).reshape(-1, 3)
        points: npt.NDArray[np.float32] = (grid + 10.0).astype(np.float32)
        with _one_openmp_thread():
            kiss_matcher.KISSMatcher(_settings(kiss_matcher, 1.0)).estimate(points, points)
    return kiss_matcher


@contextmanager
def _one_processor() -> Iterator[None]:
    """Leave the main thread one processor: TBB counts its processors at the first use and never again."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    main_thread = os.getpid()
    processors = os.sched_getaffinity(main_thread)
    os.sched_setaffinity(main_thread, {min(processors)})
    try:
        yield
    finally:
        os.sched_setaffinity(main_thread, processors)


@contextmanager
def _one_openmp_thread() -> Iterator[None]:
    """Hold OpenMP, which may be shared with small_gicp, to one thread where KISS-Matcher's is within reach."""
    openmp = ctypes.CDLL(sys.modules["_kiss_matcher"].__file__)
    if not hasattr(openmp, "omp_set_num_threads"):
        yield
        return
    n_threads = openmp.omp_get_max_threads()
    openmp.omp_set_num_threads(1)
    try:
        yield
    finally:
        openmp.omp_set_num_threads(n_threads)
