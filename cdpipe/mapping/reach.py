"""How far from the origin a session may lie: the cells of every stage must be numbered there."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cdpipe.core.geometry.voxel import FINEST_CELL_M, require_reachable
from cdpipe.model.config import PipelineConfig
from cdpipe.model.types import ScanSource

# Shapes of objects use cells of 1/4 voxel (`cdpipe.extract.objects`).
FINE_SHARE = 4


def require_cells_reach(source: ScanSource, config: PipelineConfig) -> None:
    """Refuse a session that lies too far out for the smallest cells that any stage will use.

    Args:
        source: The session.
        config: All settings.

    Raises:
        InputError: Its positions are too large for a setting.
    """
    cell_m, setting = min(_cells(config))
    farthest_m = float(np.abs(source.odom_T_sensor[:, :3, 3]).max(initial=0.0)) + config.map.max_range_m
    require_reachable(source.name, farthest_m, cell_m, setting)


def _cells(config: PipelineConfig) -> Iterator[tuple[float, str]]:
    """Yield the edges of the cells of all stages, metres, and what sets each."""
    yield FINEST_CELL_M, ""
    yield config.map.voxel_m / FINE_SHARE, f"map.voxel_m / {FINE_SHARE} = "
    yield config.merge.target_voxel_m, "merge.target_voxel_m = "
    yield config.merge.coarse_voxel_m, "merge.coarse_voxel_m = "
    if config.regions.source == "voxel-diff":
        yield config.voxel_diff.voxel_m, "voxel_diff.voxel_m = "
    if config.extract.method == "voxel":
        yield config.extract.voxel_m, "extract.voxel_m = "
    if config.surface.method != "none":
        yield config.surface.spacing_m, "surface.spacing_m = "
    if config.surface.method == "c2m":
        yield config.surface.mesh_m, "surface.mesh_m = "
