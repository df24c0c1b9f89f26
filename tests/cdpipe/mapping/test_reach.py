from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import make_pose
from cdpipe.mapping.reach import require_cells_reach
from cdpipe.model.config import load_config
from cdpipe.model.types import PosedScan
from cdpipe.pipeline import Hooks, map_session, map_sources
from tests.cdpipe.conftest import CloudScans, scanned

# Cells of 0.01 m are numbered up to (2^20 - 1) * 0.01 m = 10,486 m, those of 0.05 m up to 52,429 m.
AT_M = 20_000.0


class FarScans(CloudScans):
    """Two scans that say where they are and must not be read."""

    def __init__(self, at_m: float) -> None:
        super().__init__("far", make_pose(translation=np.array([[at_m, 0.0, 0.0], [at_m + 1, 0.0, 0.0]])), [])

    def scan(self, index: int) -> PosedScan:
        raise AssertionError(index)

    def scans(self) -> Iterator[PosedScan]:
        raise AssertionError


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"map.voxel_m": 0.04}, "map.voxel_m / 4 = 0.01"),
        ({"merge.target_voxel_m": 0.01}, "merge.target_voxel_m = 0.01"),
        ({"merge.coarse_voxel_m": 0.01}, "merge.coarse_voxel_m = 0.01"),
        ({"surface.method": "planes", "surface.spacing_m": 0.01}, "surface.spacing_m = 0.01"),
        ({"surface.method": "c2m", "surface.mesh_m": 0.01}, "surface.mesh_m = 0.01"),
        (
            {"regions.source": "voxel-diff", "extract.method": "clusters", "voxel_diff.voxel_m": 0.01},
            "voxel_diff.voxel_m = 0.01",
        ),
        ({"regions.source": "scan", "extract.method": "voxel", "extract.voxel_m": 0.01}, "extract.voxel_m = 0.01"),
    ],
)
def test_the_smallest_cell_that_is_used_decides_how_far_out_a_session_may_lie(
    settings: dict[str, Any], told: str
) -> None:
    config = load_config("tunnelcd", settings)
    require_cells_reach(FarScans(10_000.0), config)
    with pytest.raises(InputError) as error:
        require_cells_reach(FarScans(AT_M), config)
    assert told in str(error.value) and "20061 m" in str(error.value) and "\n" not in str(error.value)


def test_cells_that_nobody_uses_decide_nothing() -> None:
    unused = {"surface.spacing_m": 0.01, "surface.mesh_m": 0.01, "voxel_diff.voxel_m": 0.01, "extract.voxel_m": 0.01}
    require_cells_reach(FarScans(AT_M), load_config("tunnelcd", unused))


def test_far_sessions_are_refused_before_they_are_mapped(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError

    monkeypatch.setattr("cdpipe.pipeline.mapping.build_map", refuse)
    near = scanned("drive", make_pose(), 0, 1, [])
    clouds = [near.scan(index).points_sensor for index in range(40)]
    far = CloudScans("far", make_pose(translation=(AT_M, 0.0, 0.0)) @ near.odom_T_sensor[:40], clouds)
    config = load_config("tunnelcd", {"map.voxel_m": 0.04})
    with pytest.raises(InputError, match=r"^far: .*map\.voxel_m / 4 = 0\.01 m"):
        map_sources((far, far), config, Hooks())
    with pytest.raises(InputError, match=r"^far: .*map\.voxel_m / 4 = 0\.01 m"):
        map_session(far, config)
