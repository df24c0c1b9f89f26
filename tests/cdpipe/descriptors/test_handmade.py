from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, transform, yaw_pose
from cdpipe.descriptors import (
    checkpoint_digest,
    describe_scan,
    describe_scans,
    load_descriptors,
    relative_yaws_rad,
    save_descriptors,
)
from cdpipe.descriptors.handmade import (
    CONTEXT_RINGS,
    HANDMADE,
    LIFT_M,
    MAX_RANGE_M,
    SECTORS,
    SOLID_ELEVATION_RAD,
    SOLID_RINGS,
    SOLID_ROWS,
    SOLID_VOXEL_M,
    VERSION,
    scan_context,
    solid,
)
from cdpipe.model.config import DescriptorConfig, MapConfig
from cdpipe.model.types import PosedScan

METHODS = sorted(HANDMADE)
SECTOR_RAD = 2 * np.pi / SECTORS


def cloud(seed: int, n: int = 800) -> Float64Array:
    """Returns all round, near and beyond the last ring, in and out of the field of view; denser to one side."""
    rng = np.random.default_rng(seed)
    range_m = rng.uniform(1.0, 1.2 * MAX_RANGE_M, n)
    azimuth = rng.vonmises(1.0, 0.8, n)
    elevation = rng.uniform(-1.2, 1.2, n) * SOLID_ELEVATION_RAD
    across = range_m * np.cos(elevation)
    return np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), range_m * np.sin(elevation)])


def at(ring_m: float, sector: int, z: float) -> tuple[float, float, float]:
    """A point in the middle of an azimuth sector."""
    angle = (sector + 0.5) * SECTOR_RAD
    return (ring_m * np.cos(angle), ring_m * np.sin(angle), z)


def unit(values: list[float] | Float64Array) -> Float64Array:
    return np.asarray(values) / np.linalg.norm(values)


def test_scan_context_by_hand() -> None:
    ring_m = MAX_RANGE_M / CONTEXT_RINGS
    low, high = 1.0, 2.5
    near = [at(0.5 * ring_m, 0, low), at(0.5 * ring_m, 0, high), at(0.5 * ring_m, 1, low)]
    q, w = scan_context(np.array([*near, at(1.5 * ring_m, 1, -0.5), at(MAX_RANGE_M + 1.0, 5, 9.0)]))
    # two bins of the first ring are occupied, one of the second; what is beyond the last ring counts nowhere
    np.testing.assert_allclose(q, unit([2, 1] + [0] * (CONTEXT_RINGS - 2)), atol=1e-6)
    sectors = np.zeros(SECTORS)
    sectors[0] = high + LIFT_M
    sectors[1] = (low + LIFT_M) + (-0.5 + LIFT_M)
    np.testing.assert_allclose(w, unit(sectors - sectors.mean()), atol=1e-6)


def test_solid_by_hand() -> None:
    def row_z(row: int, across_m: float) -> float:
        return across_m * np.tan(((row + 0.5) / SOLID_ROWS * 2 - 1) * SOLID_ELEVATION_RAD)

    ring_m = MAX_RANGE_M / SOLID_RINGS
    near, far, beyond = 4.5 * ring_m, 9.5 * ring_m, MAX_RANGE_M + 10.0
    points = [
        *(at(near, sector, row_z(20, near)) for sector in (3, 13, 23, 33)),  # row 20: six points
        at(far, 3, row_z(20, far)),
        at(beyond, 40, row_z(20, beyond)),
        *(at(near, sector, row_z(10, near)) for sector in (3, 13)),  # row 10: three
        at(far, 50, row_z(10, far)),
        at(far, 9, far),  # 45 degrees up: seen by no beam
    ]
    q, w = solid(np.array(points))
    # the emptiest row has none: row 20 weighs 1, row 10 weighs 3 / 6
    rings = np.zeros(SOLID_RINGS)
    rings[4], rings[9], rings[-1] = 4 + 2 * 0.5, 1 + 0.5, 1
    np.testing.assert_allclose(q, unit(rings), atol=1e-6)
    sectors = np.zeros(SECTORS)
    sectors[[3, 13, 23, 33, 40, 50]] = 2.5, 1.5, 1, 1, 1, 0.5
    np.testing.assert_allclose(w, unit(sectors - sectors.mean()), atol=1e-6)


def test_solid_counts_the_means_of_cells() -> None:
    # five returns of one half-metre cell count as one at their mean, which is the middle of the cell
    middle, other = np.array([10.25, 0.25, 0.25]), np.array([-30.25, -7.25, 1.25])
    crowd = [middle + step for step in (-0.2, -0.1, 0.0, 0.1, 0.2)]
    np.testing.assert_array_equal(solid(np.array([*crowd, other]))[0], solid(np.array([middle, other]))[0])


def slow_scan_context(points: Float64Array) -> tuple[Float64Array, Float64Array]:
    bins: dict[tuple[int, int], float] = {}
    for x, y, z in points.tolist():
        ring = int(np.hypot(x, y) // (MAX_RANGE_M / CONTEXT_RINGS))
        sector = int((np.arctan2(y, x) % (2 * np.pi)) // SECTOR_RAD)
        if ring < CONTEXT_RINGS:
            bins[ring, sector] = max(bins.get((ring, sector), -np.inf), z + LIFT_M)
    rings = [sum((ring, sector) in bins for sector in range(SECTORS)) for ring in range(CONTEXT_RINGS)]
    sectors = np.array([sum(bins.get((ring, s), 0.0) for ring in range(CONTEXT_RINGS)) for s in range(SECTORS)])
    return unit(rings), unit(sectors - sectors.mean())


def slow_solid(points: Float64Array) -> tuple[Float64Array, Float64Array]:
    cells: dict[tuple[int, ...], list[Float64Array]] = {}
    for point in points:
        cells.setdefault(tuple((point // SOLID_VOXEL_M).astype(int).tolist()), []).append(point)
    rings, sectors = np.zeros((SOLID_RINGS, SOLID_ROWS)), np.zeros((SECTORS, SOLID_ROWS))
    for members in cells.values():
        x, y, z = np.mean(members, axis=0)
        across = np.hypot(x, y)
        row = int((np.arctan2(z, across) + SOLID_ELEVATION_RAD) // (2 * SOLID_ELEVATION_RAD / SOLID_ROWS))
        if 0 <= row < SOLID_ROWS:
            rings[min(int(across // (MAX_RANGE_M / SOLID_RINGS)), SOLID_RINGS - 1), row] += 1
            sectors[int((np.arctan2(y, x) % (2 * np.pi)) // SECTOR_RAD), row] += 1
    counts = [sum(rings[:, row]) for row in range(SOLID_ROWS)]
    weights = [(count - min(counts)) / (max(counts) - min(counts)) for count in counts]
    by_ring = [sum(ring[row] * weights[row] for row in range(SOLID_ROWS)) for ring in rings]
    by_sector = np.array([sum(sector[row] * weights[row] for row in range(SOLID_ROWS)) for sector in sectors])
    return unit(by_ring), unit(by_sector - by_sector.mean())


@pytest.mark.parametrize("seed", range(3))
def test_both_equal_their_slow_twins(seed: int) -> None:
    points = cloud(seed)
    for fast, slow in ((scan_context, slow_scan_context), (solid, slow_solid)):
        for made, expected in zip(fast(points), slow(points), strict=True):
            np.testing.assert_allclose(made, expected, atol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_a_turned_sensor_keeps_q_and_shifts_w(method: str) -> None:
    # a quarter turn maps SOLiD's half-metre cells onto one another, a sector's turn only Scan Context's bins
    n_sectors = SECTORS // 4 if method == "solid" else 5
    points = cloud(7)
    q, w = HANDMADE[method](points)
    turn_rad = n_sectors * SECTOR_RAD
    q_turned, w_turned = HANDMADE[method](transform(yaw_pose(turn_rad), points))
    np.testing.assert_allclose(q_turned, q, atol=1e-6)
    np.testing.assert_allclose(w_turned, np.roll(w, n_sectors), atol=1e-6)
    # the scene moved counter-clockwise, so the sensor turned clockwise
    assert relative_yaws_rad(w, w_turned, n=1)[0] == pytest.approx(-turn_rad, abs=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_scans_with_nothing_to_tell_give_zeros(method: str) -> None:
    everywhere = np.array([at(6.5, sector, 0.3) for sector in range(SECTORS)])
    for points in (np.zeros((0, 3)), everywhere):
        q, w = HANDMADE[method](points)
        assert (q.dtype, w.dtype, w.shape) == (np.float32, np.float32, (SECTORS,))
        assert np.isfinite(q).all()
        if len(points) == 0:
            assert not q.any()
    assert not scan_context(everywhere)[1].any()
    with pytest.raises(ValueError, match="points_sensor must be"):
        HANDMADE[method](np.zeros((4, 2)))


@pytest.mark.parametrize("method", METHODS)
def test_a_return_that_no_cell_can_number_is_none(method: str) -> None:
    points = cloud(5)
    for sentinel in ((1e6, 0.0, 0.0), (0.0, 0.0, -1e9), (1e12, 1e12, 1e12)):
        for found, expected in zip(
            HANDMADE[method](np.vstack([points, sentinel])), HANDMADE[method](points), strict=True
        ):
            np.testing.assert_array_equal(found, expected)
    if method == "solid":  # what lies beyond the last ring, and can be numbered, counts as ever
        farther, ring = (solid(np.vstack([points, (x_m, 0.0, 0.0)]))[0] for x_m in (5e5, 1.3 * MAX_RANGE_M))
        np.testing.assert_array_equal(farther, ring)
        assert (farther != solid(points)[0]).any()


class _Source:
    name = "test"
    odom_T_sensor = np.stack([np.eye(4)] * 3)

    def scan(self, index: int) -> PosedScan:
        points = cloud(index)
        n = len(points)
        return PosedScan(index, points, np.eye(4), np.zeros(n, dtype=np.int64), np.arange(n, dtype=np.int32))


@pytest.mark.parametrize("method", METHODS)
def test_stored_vectors_of_another_version_are_stale(
    tmp_path: Path, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = DescriptorConfig(method=method)
    made = describe_scans(_Source(), np.array([0, 2]), config)
    assert (made.name, made.checkpoint) == (method, checkpoint_digest(config))
    q, w = describe_scan(_Source().scan(2), config)
    np.testing.assert_array_equal(made.q[1], q)
    np.testing.assert_array_equal(made.w[1], w)
    save_descriptors(tmp_path, made, _Source.odom_T_sensor, MapConfig())
    read = load_descriptors(tmp_path, config, _Source.odom_T_sensor, MapConfig())
    assert read is not None
    np.testing.assert_array_equal(read.q, made.q)
    monkeypatch.setattr("cdpipe.descriptors.describe.VERSION", VERSION + 1)
    assert load_descriptors(tmp_path, config, _Source.odom_T_sensor, MapConfig()) is None


def test_whoever_changes_the_vectors_raises_the_version() -> None:
    """Golden numbers: where this fails, raise VERSION and write down the new ones, which the message shows."""
    points = cloud(11)
    found = [float(vector @ np.arange(len(vector))) for method in METHODS for vector in HANDMADE[method](points)]
    assert VERSION == 1
    np.testing.assert_allclose(found, [40.762, -50.212, 104.796, -82.451], atol=0.001)
