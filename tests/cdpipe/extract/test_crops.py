from __future__ import annotations

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, invert, make_pose, stream, transform, yaw_pose
from cdpipe.extract.crops import Crops
from cdpipe.model.alignment import PathAlignment
from cdpipe.model.types import MergedMaps, PointMap

BEFORE_T_AFTER = yaw_pose(0.7, (3.0, -2.0, 0.5))


def cloud_map(points: Float64Array) -> PointMap:
    n = len(points)
    numbers = np.arange(n, dtype=np.int32)
    return PointMap(points, np.ones(n, np.float32), 0.2, np.eye(4)[None], np.zeros(1, np.int64), numbers, numbers,
                    np.array([0, n]))  # fmt: skip


def merged(strain: float) -> MergedMaps:
    """Two maps; the after odometry's error grows along x, and anchors a metre apart say so."""
    rng = stream(0, "crops")
    before, after = rng.uniform((-15, -4, 0), (15, 4, 3), (8000, 3)), rng.uniform((-15, -4, 0), (15, 4, 3), (9000, 3))
    along = np.arange(-20.0, 20.5)
    anchors = np.column_stack([along, 0 * along, 0 * along])
    bends = np.array([make_pose(translation=(-strain * x, 0.5 * strain * x, 0)) for x in along]) @ BEFORE_T_AFTER
    local = PathAlignment(transform(invert(BEFORE_T_AFTER), anchors), bends) if strain else None
    maps = cloud_map(before), cloud_map(transform(invert(BEFORE_T_AFTER), after))
    return MergedMaps(*maps, BEFORE_T_AFTER, {}, True, local=local)


@pytest.mark.parametrize("strain", [0.0, 0.03])
@pytest.mark.parametrize("margin_m", [0.0, 1.5])
def test_spheres_equal_brute_force(strain: float, margin_m: float) -> None:
    pair = merged(strain)
    crops = Crops(pair, margin_m)
    clouds = {"before": pair.before.points, "after": pair.alignment.to_map(pair.after.points)}
    for centre in (np.array([0.0, 0.0, 1.0]), np.array([9.0, -1.0, 2.0]), np.array([80.0, 0.0, 0.0])):
        spheres = crops.around(centre, 3.0)
        assert list(spheres) == ["before", "after"]
        for name, cloud in clouds.items():
            gaps_m = np.linalg.norm(cloud - centre, axis=1)
            sphere = spheres[name]
            assert set(sphere.indices.tolist()) == set(np.flatnonzero(gaps_m <= 3.0 + margin_m).tolist())
            # a point that moves by interpolation moves a little differently among others
            np.testing.assert_allclose(sphere.points, cloud[sphere.indices], atol=2e-3)
            indices, points = sphere.inside
            assert set(indices.tolist()) == set(np.flatnonzero(gaps_m <= 3.0).tolist())
            np.testing.assert_array_equal(points, sphere.points[sphere.is_inside])


@pytest.mark.parametrize("strain", [0.0, 0.03])
def test_what_is_near_to_some_points_equals_brute_force(strain: float) -> None:
    pair = merged(strain)
    crops = Crops(pair, 1.0)
    clouds = {"before": pair.before.points, "after": pair.alignment.to_map(pair.after.points)}
    some = stream(1, "some").uniform((4, -3, 0), (7, 0, 2), (40, 3))
    for name, cloud in clouds.items():
        gaps_m = np.linalg.norm(cloud[:, None] - some, axis=2).min(axis=1)
        found = crops.near(name, some, 0.5)
        assert 50 < len(found) < len(cloud) / 4
        assert set(found.tolist()) == set(np.flatnonzero(gaps_m < 0.5).tolist())
        np.testing.assert_allclose(pair.to_map(name, pair.map_of(name).points[found]), cloud[found], atol=2e-3)
        assert len(crops.near(name, some[:1] + 50.0, 0.5)) == 0
