from __future__ import annotations

import numpy as np

from sim.geometry.noise import lattice_values, noise_at, smooth_noise


def test_lattice_values_have_mean_0_and_variance_1() -> None:
    values = lattice_values([np.arange(200_000)], key=5)
    assert abs(values.mean()) < 4 / np.sqrt(200_000)
    assert abs(values.var() - 1.0) < 0.01
    assert abs(np.corrcoef(values[:-1], values[1:])[0, 1]) < 0.01


def test_noise_has_unit_variance_and_its_correlation_falls_to_1_over_e_at_its_length() -> None:
    axis = np.arange(0.0, 3000.0, 0.25)
    along = smooth_noise((axis,), length_m=2.0, key=3)
    assert abs(along.std() - 1.0) < 0.04
    correlation = np.corrcoef(along[:-8], along[8:])[0, 1]  # 8 samples of 0.25 m are one length
    assert abs(correlation - np.exp(-1.0)) < 0.06
    plane = smooth_noise((axis[:600], axis[:600]), length_m=1.5, key=4)
    assert abs(plane.std() - 1.0) < 0.05


def test_noise_depends_on_the_place_alone() -> None:
    x, y, z = np.arange(-3.0, 3.0, 0.3), np.arange(-2.0, 5.0, 0.3), np.arange(0.0, 2.0, 0.3)
    whole = smooth_noise((x, y, z), 1.0, key=9)
    part = smooth_noise((x[7:9], y[11:], z[2:5]), 1.0, key=9)
    np.testing.assert_array_equal(whole[7:9, 11:, 2:5], part)
    assert np.abs(whole - smooth_noise((x, y, z), 1.0, key=10)).max() > 1.0


def test_scattered_points_have_the_values_of_the_grid() -> None:
    axes = np.arange(-3.0, 3.0, 0.7), np.arange(-2.0, 5.0, 0.9), np.arange(0.0, 2.0, 0.6)
    for count in (1, 2, 3):
        points = np.stack(np.meshgrid(*axes[:count], indexing="ij"), axis=-1)
        np.testing.assert_allclose(
            noise_at(points.reshape(-1, count), 1.3, key=9), smooth_noise(axes[:count], 1.3, key=9).ravel(), atol=1e-12
        )
