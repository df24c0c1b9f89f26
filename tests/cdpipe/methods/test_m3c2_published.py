"""M3C2 against published distances of two other programs, PDAL and CloudCompare, on a real site scanned twice.

PDAL's test of filters.m3c2 (`verifyPoints` of M3C2FilterTest) names the parameters: normals within 1.39 m, a cylinder
of radius 2.89 m and half length 5.5 m, no error of registration. Its stored result gives the number of points in each
cylinder, so every disagreement can be explained:

- A point on the rim of a cylinder is in or out by the last digit of the normal: three core points of 91.
- Where fewer than three points tell a normal, PDAL and we measure nothing: 12 core points of 103.
- PDAL divides variances by n, py4dgeo by n - 1.
- The stored numbers are rounded to millimetres.
"""

import importlib.util
import os
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array
from cdpipe.methods.m3c2 import Distances, compare_clouds
from cdpipe.model.config import M3C2Config

ROOT = Path(os.environ.get("TUNNELCD_REAL_DATA", "")) / "two_epochs"
pytestmark = [
    pytest.mark.skipif(
        "TUNNELCD_REAL_DATA" not in os.environ, reason="published M3C2 distances: TUNNELCD_REAL_DATA is not set"
    ),
    pytest.mark.skipif(importlib.util.find_spec("py4dgeo") is None, reason="needs the extra `m3c2`: py4dgeo"),
]
SETTINGS = M3C2Config(normal_m=1.39, cylinder_m=2.89, depth_m=5.5)
ROUNDED_M = 0.0005


def read_table(name: str) -> dict[str, Float64Array]:
    """Columns of a text file of PDAL."""
    file = ROOT / name
    names = [title.strip('"') for title in file.read_text().splitlines()[0].split(",")]
    return dict(zip(names, np.loadtxt(file, delimiter=",", skiprows=1).T, strict=True))


def measure(core: Float64Array, origin: Float64Array, settings: M3C2Config) -> Distances:
    """Distances of 2023 from 2010 at the core points, in a frame with another origin; the void is above."""
    laspy = pytest.importorskip("laspy")  # py4dgeo needs it, too
    clouds = [laspy.read(ROOT / f"autzen-bmx-{year}.las").xyz - origin for year in (2010, 2023)]
    return compare_clouds(core - origin, np.tile([0.0, 0.0, 1.0], (len(core), 1)), *clouds, settings)


@pytest.fixture(scope="module", name="pdal")
def pdal_fixture() -> dict[str, Float64Array]:
    return read_table("autzen-bmx-m3c2.txt")


@pytest.fixture(scope="module", name="found")
def found_fixture(pdal: dict[str, Float64Array]) -> Distances:
    """The 103 core points, by the function that the whole-map rivals and the rivals of displacement call."""
    return measure(np.column_stack([pdal[axis] for axis in "XYZ"]), np.zeros(3), SETTINGS)


def test_distances_of_pdal_to_one_per_cent(found: Distances, pdal: dict[str, Float64Array]) -> None:
    published_m, distance_m = pdal["m3c2_distance"], -found.behind_m
    is_measured = pdal["m3c2_count1"] > 0
    assert np.count_nonzero(is_measured) == 91
    np.testing.assert_array_equal(np.isfinite(distance_m), is_measured)
    is_close = np.abs(distance_m - published_m) <= np.fmax(0.01 * np.abs(published_m), ROUNDED_M)
    assert np.count_nonzero(is_close & is_measured) == 88
    has_same_points = (found.n_own == pdal["m3c2_count1"]) & (found.n_other == pdal["m3c2_count2"]) & is_measured
    assert np.count_nonzero(has_same_points) == 87
    np.testing.assert_allclose(distance_m[has_same_points], published_m[has_same_points], rtol=0, atol=ROUNDED_M)
    # the others differ by one point in one cylinder
    n_differing = np.abs(found.n_own - pdal["m3c2_count1"]) + np.abs(found.n_other - pdal["m3c2_count2"])
    assert (n_differing[is_measured & ~is_close] == 1).all()


def test_levels_of_detection_of_pdal(found: Distances, pdal: dict[str, Float64Array]) -> None:
    counts = pdal["m3c2_count1"], pdal["m3c2_count2"]
    is_same = (found.n_own == counts[0]) & (found.n_other == counts[1]) & (counts[0] > 1) & (counts[1] > 1)
    mean_m2 = sum(
        pdal[f"m3c2_std_dev{number}"][is_same] ** 2 / (count[is_same] - 1) for number, count in enumerate(counts, 1)
    )
    np.testing.assert_allclose(found.levels_m[is_same], 1.96 * np.sqrt(mean_m2), rtol=0.01)


def test_distances_and_normals_of_cloudcompare(found: Distances) -> None:
    cloudcompare = read_table("autzen-bmx-cc.txt")
    published_m, distance_m = cloudcompare["M3C2 distance"], -found.behind_m
    normals = np.column_stack([cloudcompare[f"Normal{axis}"] for axis in "XYZ"])
    is_same = (found.n_own == cloudcompare["Npoints_cloud1"]) & (found.n_other == cloudcompare["Npoints_cloud2"])
    is_same &= np.isfinite(published_m) & np.isfinite(distance_m)
    assert np.count_nonzero(is_same) == 84
    # CloudCompare's points have single precision: a distance of 90 mm is 1 mm off
    np.testing.assert_allclose(distance_m[is_same], published_m[is_same], rtol=0.01, atol=0.001)
    np.testing.assert_allclose(np.abs(np.einsum("ij,ij->i", found.normals, normals))[is_same], 1.0, atol=1e-3)


def test_clouds_far_from_their_origin_measure_the_same(pdal: dict[str, Float64Array]) -> None:
    """Coordinates of the site are a quarter of a million metres; py4dgeo alone would count other points there."""
    core = np.column_stack([pdal[axis] for axis in "XYZ"])
    # coordinates are whole centimetres: at these radii no point lies on a rim
    settings = SETTINGS.model_copy(update={"normal_m": 1.3907, "cylinder_m": 2.8907})
    far, near = (measure(core, origin, settings) for origin in (np.zeros(3), core.mean(axis=0).round()))
    assert np.count_nonzero(np.isfinite(far.behind_m)) > 90
    np.testing.assert_array_equal(near.n_own, far.n_own)
    np.testing.assert_allclose(near.behind_m, far.behind_m, atol=1e-6)
