"""M3C2 (Lague, Brodu, Leroux 2013) by py4dgeo, extra `m3c2`: how far a surface moved along its own normal.

At each map point of one session the normal is that of the plane through its own map around it; the distance is that
between the mean places of both maps within a cylinder along that normal. It counts where it is larger than its own 95 %
level of detection and than `extract.distance_m`, and where the other map's surface lies behind, seen from the session's
own path: a crate stands in front of the floor, and the floor under it is hidden, not gone.
"""

# ruff: noqa: PLC0415 - py4dgeo is an extra, and everybody else must be able to import this

from __future__ import annotations

import logging
import os
from typing import Any

import numpy as np

from cdpipe.core.geometry import BoolArray
from cdpipe.core.threads import THREADS
from cdpipe.methods.registry import require_extra
from cdpipe.methods.whole_map import PlacedMaps, nearest_of, whole_map
from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangeReport
from cdpipe.model.types import DescriptorSet, MergedMaps, SessionName


def m3c2(merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig) -> ChangeReport:
    """Compare the maps by `whole_map`: new is what moved along its normal (`m3c2_mask`).

    Raises:
        InputError: The extra `m3c2` is not installed.
    """
    require_extra("m3c2")
    return whole_map(merged, before, after, config, m3c2_mask)


def m3c2_mask(maps: PlacedMaps, session: SessionName, other: SessionName, config: PipelineConfig) -> BoolArray:
    """Mark the map points of `session` that stand in front of the surface of `other`.

    Where the cylinder holds nothing of the other map there is no distance, and the point is not new.

    Args:
        maps: Both maps.
        session: Whose points are asked about.
        other: What they are compared to.
        config: `m3c2`, `extract.distance_m` and `query.radius_m` are used; points farther than that from the other
            path, which nobody will ask for, are not measured.

    Returns:
        (N,) mask of the points of `session`.
    """
    py4dgeo = loaded_py4dgeo()
    points = maps.points[session]
    core = np.flatnonzero(maps.is_comparable(points, other, config.query.radius_m))
    is_new = np.zeros(len(points), dtype=np.bool_)
    if len(core) == 0:
        return is_new
    algorithm = py4dgeo.M3C2(
        epochs=(py4dgeo.Epoch(points), py4dgeo.Epoch(maps.points[other])),
        corepoints=points[core],
        normal_radii=[config.m3c2.normal_m],
        cyl_radius=config.m3c2.cylinder_m,
        max_distance=config.m3c2.depth_m,
    )
    distances_m, uncertainties = algorithm.run()
    seen_from = maps.path[session][nearest_of(points[core], maps.path[session])[1]]
    is_towards_path = np.einsum("ij,ij->i", algorithm.directions(), seen_from - points[core]) > 0
    behind_m = np.where(is_towards_path, -distances_m, distances_m)
    # NaN where there is no distance, and where the points are too few to tell its error
    limits_m = np.fmax(uncertainties["lodetection"], config.extract.distance_m)
    is_new[core] = behind_m > limits_m
    return is_new


def loaded_py4dgeo() -> Any:
    """Return the module py4dgeo, silent and held to one thread."""
    import py4dgeo

    # it logs to standard output and into a file in the working folder
    logging.getLogger("py4dgeo").setLevel(logging.CRITICAL)
    if "OMP_NUM_THREADS" not in os.environ:
        py4dgeo.set_num_threads(THREADS)
    return py4dgeo
