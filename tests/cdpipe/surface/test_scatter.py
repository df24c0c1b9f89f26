"""The factor by which displacements scatter more than their levels say."""

from __future__ import annotations

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, stream
from cdpipe.surface.scatter import excess_scatter

SIGMA_M = 0.002
LEVEL_M = 1.96 * SIGMA_M


def wall() -> Float64Array:
    """(1600, 3) places 0.25 m apart."""
    x_m, z_m = np.meshgrid(np.arange(80) * 0.25, np.arange(20) * 0.25)
    return np.column_stack([x_m.ravel(), np.zeros(x_m.size), z_m.ravel()])


def noise(times: float = 1.0) -> Float64Array:
    return stream(3, "scatter").normal(0, times * SIGMA_M, 1600)


def levels() -> Float64Array:
    return np.full(1600, LEVEL_M)


def test_noise_as_the_levels_say_is_no_excess() -> None:
    assert np.median(excess_scatter(wall(), noise(), levels())) == pytest.approx(1.0, abs=0.1)


def test_noise_of_three_times_the_levels_is_told_where_it_is() -> None:
    left = wall()[:, 0] < 10
    factor = excess_scatter(wall(), np.where(left, noise(3), noise(0.5)), levels())
    far = np.abs(wall()[:, 0] - 10) > 2
    assert np.median(factor[left & far]) == pytest.approx(3.0, rel=0.15)
    assert np.all(factor[~left & far] == 1.0)


def test_rock_that_moved_alike_does_not_scatter() -> None:
    bulge_m = 0.08 * np.exp(-(((wall()[:, 0] - 10) / 2) ** 2))
    assert np.median(excess_scatter(wall(), bulge_m + noise(0.5), levels())) == 1.0
    assert excess_scatter(wall(), bulge_m, levels()).max() < 2.5  # the slope of the bulge


def test_places_without_a_displacement_are_left_out() -> None:
    along_m = noise(3)
    along_m[::2] = np.nan
    factor = excess_scatter(wall(), along_m, levels())
    assert np.all(factor[::2] == 1.0)
    assert np.median(factor[1::2]) == pytest.approx(3.0, rel=0.2)


def test_too_few_places_tell_nothing() -> None:
    assert np.array_equal(excess_scatter(wall()[:10], noise(9)[:10], levels()[:10]), np.ones(10))
    assert len(excess_scatter(wall()[:0], noise()[:0], levels()[:0])) == 0
