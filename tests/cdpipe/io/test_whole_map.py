"""Whole maps without their scans: where stations stand, what can be compared, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cdpipe import describe, detect
from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.geometry import Float64Array, stream, transform
from cdpipe.io.foreign import HowToRead
from cdpipe.io.foreign.whole_map import find_stations
from cdpipe.io.out import Outgoing, gather_map
from cdpipe.io.ply import write_ply_points
from cdpipe.io.readers import open_session

WIDTH_M, HEIGHT_M, LENGTH_M = 4.0, 3.0, 24.0
BOX_M = np.array([12.0, 0.8, 0.0])
SETTINGS = ("query.threshold=20", "regions.min_points=8")


def drift(sample: int, *, has_roof: bool = True, has_box: bool = False) -> Float64Array:
    """(N, 3) points of a drift along x, floor at z = 0, with false returns in the rock around it."""
    rng = stream(sample, "drift")
    n = 60_000
    along = rng.uniform(0, LENGTH_M, n)
    sides = rng.integers(0, 4 if has_roof else 3, n)
    across, up = rng.uniform(-WIDTH_M / 2, WIDTH_M / 2, n), rng.uniform(0, HEIGHT_M, n)
    y = np.select([sides == 1, sides == 2], [np.full(n, -WIDTH_M / 2), np.full(n, WIDTH_M / 2)], across)
    z = np.select([sides == 0, sides == 3], [np.zeros(n), np.full(n, HEIGHT_M)], up)
    points = np.column_stack([along, y, z]) + rng.normal(0, 0.005, (n, 3))
    strays = rng.uniform((-10, -20, -20), (LENGTH_M + 10, 20, 20), (60, 3))
    box = BOX_M + rng.uniform((-0.5, -0.5, 0), (0.5, 0.5, 1.0), (4000, 3)) if has_box else np.zeros((0, 3))
    return np.concatenate([points, strays, box])


def write(path: Path, points: Float64Array) -> Path:
    write_ply_points(path, points)
    return path


@pytest.mark.parametrize("has_roof", [True, False])
def test_stations_stand_on_the_middle_line(has_roof: bool) -> None:
    stations = find_stations(drift(1, has_roof=has_roof))
    assert np.all(np.abs(stations[:, 1]) < 0.8)
    assert np.all(np.abs(stations[:, 2] - 1.0) < 0.35)
    assert stations[:, 0].min() < 2 and stations[:, 0].max() > LENGTH_M - 2
    steps_m = np.linalg.norm(np.diff(stations, axis=0), axis=1)
    assert steps_m.max() < 3.5


def test_the_stations_of_the_same_map_are_the_same() -> None:
    assert np.array_equal(find_stations(drift(1)), find_stations(drift(1)))


def test_a_map_is_opened_as_stations_that_hold_every_point(tmp_path: Path) -> None:
    points = drift(1)
    source = open_session(write(tmp_path / "map.ply", points))
    read = np.concatenate([scan.points_sensor + scan.odom_T_sensor[:3, 3] for scan in source.scans()])
    assert len(read) == len(points)
    assert np.allclose(np.sort(read[:, 0]), np.sort(points[:, 0]), atol=1e-4)


def test_a_map_keeps_its_intensities_and_leaves_without_times(tmp_path: Path) -> None:
    points = drift(1)
    points[7] = np.nan  # is left out, and its intensity with it
    shone = np.round(10 * points[:, 0]).astype(np.float32)
    write_ply_points(tmp_path / "map.ply", points, {"intensity": shone})
    source = open_session(tmp_path / "map.ply")
    for scan in source.scans():
        assert scan.intensity is not None
        along_m = scan.points_sensor[:, 0] + scan.odom_T_sensor[0, 3]
        np.testing.assert_allclose(scan.intensity, 10 * along_m, atol=0.501)
    cloud = gather_map(Outgoing(source), 0.2, lambda *_: None)
    assert list(cloud.scalars) == ["intensity"]
    np.testing.assert_allclose(cloud.scalars["intensity"], 10 * cloud.points[:, 0], atol=0.501)


def test_a_map_on_a_regular_grid_repeats_nothing(tmp_path: Path) -> None:
    along, across = np.arange(0, 24, 0.125), np.arange(-2, 2.01, 0.125)
    floor = np.stack(np.meshgrid(along, across, [0.0], indexing="ij"), -1).reshape(-1, 3)
    grid = np.concatenate([floor, floor + np.array([0, 0, 3.0])])
    source = open_session(write(tmp_path / "map.ply", grid))
    assert len(source.odom_T_sensor) > 3
    assert sum(len(scan.points_sensor) for scan in source.scans()) == len(grid)


def test_a_box_that_was_added_is_found(tmp_path: Path) -> None:
    before = write(tmp_path / "before.ply", drift(1))
    after = write(tmp_path / "after.ply", drift(2, has_box=True))
    report = detect(before, after, "c2c", SETTINGS, before_T_after=np.eye(4))
    (found,) = report.objects
    assert found.kind == "added"
    assert np.allclose(found.points_map.mean(axis=0)[:2], BOX_M[:2], atol=0.4)
    assert report.coverage is not None


def test_unchanged_maps_have_no_object(tmp_path: Path) -> None:
    maps = [write(tmp_path / f"{sample}.ply", drift(sample)) for sample in (1, 2)]
    assert detect(*maps, "c2c", SETTINGS, before_T_after=np.eye(4)).objects == ()


def test_what_asks_for_free_space_is_refused(tmp_path: Path) -> None:
    maps = [write(tmp_path / f"{sample}.ply", drift(sample)) for sample in (1, 2)]
    with pytest.raises(InputError, match=r"without its scans.*use --preset m3c2, c2c or voxel-diff"):
        detect(*maps, before_T_after=np.eye(4))


def test_a_merge_that_is_not_known_is_refused(tmp_path: Path) -> None:
    maps = [write(tmp_path / f"{sample}.ply", drift(sample)) for sample in (1, 2)]
    with pytest.raises(InputError, match="say --assume-aligned"):
        detect(*maps, "c2c")


def test_descriptors_of_a_map_are_warned_of(tmp_path: Path) -> None:
    path = write(tmp_path / "map.ply", drift(1))
    with pytest.warns(InputWarning, match=r"map\.ply: one cloud, .* no place is recognised by these descriptors"):
        _, stored = describe(path, "scan-context")
    assert stored.is_file()


@pytest.mark.parametrize("points", [np.zeros((0, 3)), stream(1, "dust").uniform(0, 30, (500, 3))])
def test_a_map_without_a_floor_is_refused(tmp_path: Path, points: Float64Array) -> None:
    with pytest.raises(InputError, match=r"no floor with 1\.2 m of free height"):
        open_session(write(tmp_path / "map.ply", points))


def test_a_map_of_few_points_is_refused_with_their_spacing(tmp_path: Path) -> None:
    points = drift(1)
    thin = points[stream(1, "thin").permutation(len(points))[: len(points) // 200]]
    with pytest.raises(InputError, match=r"its points lie [0-9.]+ m apart, and a surface needs one every 0\.4 m"):
        open_session(write(tmp_path / "map.ply", thin))


def test_a_map_in_the_coordinates_of_a_country_is_refused_with_the_offset_to_subtract(tmp_path: Path) -> None:
    points = drift(1)[:2_000] + np.array([432_010.0, 5_411_020.0, 320.0])
    path = write(tmp_path / "utm.ply", points)
    with pytest.raises(InputError, match=r"map grid \(UTM\)\? Subtract an origin.*: --origin 432000,5411000,0"):
        open_session(path)
    near = list(open_session(path, HowToRead(origin_m=(432_000.0, 5_411_000.0, 0.0))).scans())
    found = np.concatenate([transform(scan.odom_T_sensor, scan.points_sensor) for scan in near])
    stored = points.astype(np.float32).astype(np.float64) - (432_000.0, 5_411_000.0, 0.0)
    np.testing.assert_allclose(found[np.lexsort(found.T)], stored[np.lexsort(stored.T)], atol=1e-6)


def test_a_map_of_another_unit_or_with_lost_points_is_refused_on_one_line(tmp_path: Path) -> None:
    near, apart = drift(1)[:20_000], np.array([60_000.0, 60_000.0, 0.0])
    for name, points, told in (
        ("far.ply", np.concatenate([near, [[1e7, 0.0, 0.0]]]), "points must be finite and within 209715 m"),
        # two floors far apart: a grid over both would fill the memory
        ("wide.ply", np.concatenate([near, near + apart]), "its floors reach over 60"),
    ):
        with pytest.raises(InputError, match=told) as caught:
            open_session(write(tmp_path / name, points))
        assert name in str(caught.value) and "\n" not in str(caught.value)
