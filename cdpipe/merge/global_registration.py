"""Global registration by KISS-Matcher (Lim et al., ICRA 2025, arXiv 2409.15615), an extra: no initial guess.

The library orients every normal towards the origin of its cloud, and its features are angles between normals. The
origins of two sessions of one tunnel differ, so the same wall gets opposite normals in the two maps. This module
therefore moves the origin 500 m below the cloud, where the orientation depends on the wall alone. Both maps must be
level (z up).
"""

# ruff: noqa: PLC0415 - KISS-Matcher is an extra, and everybody else must be able to import this

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import small_gicp
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, make_pose, require_shape
from cdpipe.core.geometry.voxel import max_coordinate_m
from cdpipe.core.plugins import has_extra, require_extra

# Far compared with any mine; the rounding of the library's float32 is 0.03 mm there.
_VIEWPOINT_M = np.array([0.0, 0.0, -500.0])
# The bound that the library recommends for large maps.
_MAX_NOISE_BOUND_M = 1.0
# The library reads invalid memory if no point has a normal. A point has a normal if three points lie within three
# voxels. Five points within 1.5 voxels guarantee that.
_NEIGHBOURS = 5
_NEIGHBOURHOOD_VOXELS = 1.5
_N_PROBED = 1000
_MIN_INLIERS = 3


def is_kiss_matcher_installed() -> bool:
    """Return whether the extra `kiss` is installed."""
    return has_extra("kiss")


def register_globally(before_points: Float64Array, after_points: Float64Array, voxel_m: float) -> Float64Array | None:
    """Register two level clouds without an initial guess; deterministic.

    Args:
        before_points: (N, 3) points, metres, z up.
        after_points: (M, 3) points, metres, z up.
        voxel_m: Voxel size of both clouds; normals use a radius of 3 voxels, features of 5.

    Returns:
        (4, 4) pose of the after cloud in the before cloud's frame, not verified. None if fewer than three
        correspondences agree, or if a cloud is too sparse for normals at this voxel size.

    Raises:
        InputError: The extra `kiss` is not installed.
        ValueError: A point is not finite, or a cloud is too wide for the voxel.
    """
    require_extra("kiss", "finding a merge by KISS-Matcher")
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
    pose = make_pose(np.asarray(found.rotation), np.asarray(found.translation))
    if not found.valid or matcher.get_num_final_inliers() < _MIN_INLIERS or not np.isfinite(pose).all():
        return None
    return np.asarray(make_pose(translation=centres[0]) @ pose @ make_pose(translation=-centres[1]))


def _prepare(name: str, points: Float64Array, voxel_m: float) -> tuple[Float64Array, Float64Array]:
    """Return a cloud, thinned and relative to its centre, and the (3,) viewpoint in the cloud's own frame."""
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
    """Import KISS-Matcher and start TBB with one thread: several threads race on shared bytes, and results differ."""
    with _one_processor():
        import kiss_matcher

        grid = np.stack(np.meshgrid(*[np.arange(6.0)] * 3), axis=-1).reshape(-1, 3)
        points: npt.NDArray[np.float32] = (grid + 10.0).astype(np.float32)
        with _one_openmp_thread():
            kiss_matcher.KISSMatcher(_settings(kiss_matcher, 1.0)).estimate(points, points)
    return kiss_matcher


@contextmanager
def _one_processor() -> Iterator[None]:
    """Restrict the main thread to one processor: TBB counts processors only at its first use."""
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
    """Limit KISS-Matcher's OpenMP, which small_gicp may share, to one thread if its library exports the setting."""
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
