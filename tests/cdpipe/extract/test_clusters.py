"""The clusters of a source as objects, on three clusters of loose points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array
from cdpipe.extract.clusters import take_clusters
from cdpipe.extract.extract import withdraw_empty_regions
from cdpipe.model.config import QueryConfig, load_config
from cdpipe.model.report import ChangeRegions, Clusters
from cdpipe.model.types import MergedMaps, PointMap
from cdpipe.query.query import rank_regions

SIZES, X_M = (100, 60, 40), (0.0, 12.0, 7.0)


def some_map(points: Float64Array) -> PointMap:
    none = np.zeros(0, np.int32)
    nearest_m = np.ones(len(points), np.float32)
    return PointMap(points, nearest_m, 0.2, np.eye(4)[None], np.zeros(1, np.int64), none, none, np.zeros(2, np.int64))


def proposed(config: QueryConfig, radii_m: tuple[float, ...]) -> tuple[MergedMaps, ChangeRegions]:
    """Clusters of 100, 60 and 40 points at 0, 12 and 7 m, the second of the before map."""
    before, after = (
        some_map(np.tile((12.0, 0, 0), (60, 1))),
        some_map(np.repeat([(0.0, 0, 0), (7, 0, 0)], (100, 40), 0)),
    )
    clusters = Clusters(
        is_after=np.array([True, False, True]),
        points=np.concatenate([np.arange(100), np.arange(60), np.arange(100, 140)]),
        starts=np.array([0, 100, 160, 200]),
    )
    centres = np.column_stack([X_M, np.zeros((3, 2))])
    regions = rank_regions(
        centres, np.array(SIZES, np.float64), np.zeros((3, 2), np.int64), np.zeros(0), config, radii_m=np.array(radii_m)
    )
    return MergedMaps(before, after, np.eye(4), {}, True), replace(regions, clusters=clusters)


def taken(config: QueryConfig, radii_m: tuple[float, ...]) -> list[tuple[str, int, int]]:
    merged, regions = proposed(config, radii_m)
    return [(group.session, len(group.indices), group.region) for group in take_clusters(merged, regions, config)]


@pytest.mark.parametrize(
    ("radii_m", "region"),
    [
        ((10.0, 4.5, 4.5), 0),  # the second is nearer to the third, but does not reach it
        ((10.0, 6.0, 6.0), 1),  # both reach it
        ((4.5, 6.0, 4.5), 1),
    ],
)
def test_a_suppressed_cluster_goes_to_the_nearest_region_that_suppresses_it(
    radii_m: tuple[float, ...], region: int
) -> None:
    config = QueryConfig(radius_m="width", threshold=40.0)
    assert taken(config, radii_m) == [("after", 100, 0), ("before", 60, 1), ("after", 40, region)]


def test_what_is_below_the_threshold_or_belongs_to_no_reported_region_is_no_object() -> None:
    both = [("after", 100, 0), ("before", 60, 1)]
    assert taken(QueryConfig(radius_m="width", threshold=41.0), (10.0, 4.5, 4.5)) == both
    assert taken(QueryConfig(radius_m="width", threshold=40.0), (4.5, 4.5, 4.5))[2] == ("after", 40, 2)
    assert taken(QueryConfig(radius_m="width", n_regions=1), (10.0, 4.5, 4.5)) == [both[0], ("after", 40, 0)]
    assert taken(QueryConfig(radius_m="width", threshold=101.0), (10.0, 4.5, 4.5)) == []


def test_a_region_stays_where_its_cluster_lies_around_its_sphere() -> None:
    config = load_config("c2c", ["query.threshold=0"])
    merged, regions = proposed(config.query, (4.5, 4.5, 4.5))
    groups = [
        replace(group, points_map=group.points_map + 20.0) for group in take_clusters(merged, regions, config.query)
    ]
    assert withdraw_empty_regions(regions, groups, config) is regions
    found = withdraw_empty_regions(regions, groups, load_config("c2c", ["query.threshold=0", "extract.method=voxel"]))
    assert not found.is_reported.any()


def test_regions_without_clusters_say_so() -> None:
    config = QueryConfig(radius_m=4.5)
    merged, regions = proposed(config, (4.5, 4.5, 4.5))
    with pytest.raises(InputError, match=r"extract\.method = clusters: .* cut out nothing itself"):
        take_clusters(merged, replace(regions, clusters=None), config)
