"""The short form of `make load`: memory grows with the map, by a bound per map point, and not with the returns."""

import tracemalloc
from functools import partial

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cdpipe.core.spooled import SpooledArray
from cdpipe.mapping import mapping
from cdpipe.model.config import MapConfig
from eval.bench.corridor import CorridorScans

MOST_BYTES_PER_POINT = 250
FEW_SCANS = 2


@pytest.fixture(autouse=True)
def _small_spools(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapping, "SpooledArray", partial(SpooledArray, held_bytes=1 << 16))


def peak_bytes(length_m: float, spacing_m: float) -> tuple[int, int]:
    """Peak of the memory that building a map allocates, and the number of its points."""
    source = CorridorScans(length_m, radius_m=4.0, spacing_m=spacing_m)
    tracemalloc.start()
    try:
        point_map = mapping.build_map(source, MapConfig(), batch_scans=FEW_SCANS)
        return tracemalloc.get_traced_memory()[1], len(point_map.points)
    finally:
        tracemalloc.stop()


def test_memory_of_a_map_grows_by_a_bound_per_map_point() -> None:
    (short, n_short), (long, n_long) = (peak_bytes(length_m, 10.0) for length_m in (100.0, 500.0))
    assert n_long - n_short > 250_000
    assert (long - short) / (n_long - n_short) < MOST_BYTES_PER_POINT


def test_memory_of_a_map_does_not_grow_with_the_returns() -> None:
    (sparse, n_sparse), (dense, n_dense) = (peak_bytes(60.0, spacing_m) for spacing_m in (5.0, 1.0))
    n_more_returns = 48 * 30_000
    grown = dense - sparse - MOST_BYTES_PER_POINT * max(n_dense - n_sparse, 0)
    assert grown < 2 * n_more_returns  # 22 bytes each where they are held


def test_the_tunnel_is_the_same_in_every_session_but_for_its_heaps() -> None:
    first, second, heaped = (
        CorridorScans(4.0, heaps_m=heaps_m, seed=seed).scan(2).points_sensor
        for seed, heaps_m in ((1, ()), (2, ()), (2, (14.0,)))
    )
    is_near = np.abs(first[:, 0]) < 12.0
    assert np.mean(cKDTree(second).query(first[is_near])[0] < 0.3) > 0.98
    moved_m = np.linalg.norm(heaped - second, axis=1)
    assert np.count_nonzero(moved_m > 0.3) > 20
    assert np.abs(second[moved_m > 0.0, 0] - 12.0).max() < 2.0
