from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from cdpipe.core.geometry import Float32Array, stream
from sim.sensor.optics import (
    FALSE_PHOTONS,
    FALSE_RETURN_RATE,
    apparent_reflectivity,
    detection_probability,
    false_returns,
    range_channel,
    range_sigma_m,
    received_photons,
    reflectivity_channel,
    signal_channel,
)


def floats(*values: float) -> Float32Array:
    return np.array(values, dtype=np.float32)


def test_far_off_light_falls_with_the_square_of_the_range() -> None:
    # Overlap beyond 100 m: 1 / (1 + 0.1^3.4) = 0.9996.
    light = received_photons(floats(0.5, 0.5), floats(100.0, 200.0))
    assert light[0] / light[1] == pytest.approx(4.0, rel=1e-3)
    assert light[0] == pytest.approx(139_800 * 0.5 / 100.0**2 / (1 + 0.1**3.4), rel=1e-6)


def test_near_by_the_receiver_sees_part_of_the_light() -> None:
    ranges_m = floats(0.5, 2.0, 3.0, 5.0, 10.0, 20.0)
    percent = received_photons(np.full(6, 0.01, np.float32), ranges_m)
    reach_m = np.array([3.0, 3.0, 3.0, 5.0, 10.0, 20.0])
    np.testing.assert_allclose(percent, 1398.0 / reach_m**2 / (1 + (10 / reach_m) ** 3.4), rtol=1e-6)
    # What the real unit gave per percent, median of its beams: 2.5, 5.7 and 7.7 photons at 2.9, 5.25 and 10.5 m.
    measured = received_photons(np.full(3, 0.01, np.float32), floats(2.9, 5.25, 10.5))
    np.testing.assert_allclose(measured, [2.5, 5.2, 7.0], rtol=0.1)


def test_light_follows_lamberts_cosine_and_a_miss_gives_none() -> None:
    cosine = np.cos(np.deg2rad(np.arange(0.0, 90.0, 5.0))).astype(np.float32)
    light = received_photons(np.float32(0.3) * cosine, np.full(18, 12.0, np.float32))
    np.testing.assert_allclose(light / light[0], cosine, rtol=1e-6)
    assert received_photons(floats(0.3), floats(np.inf))[0] == 0.0
    assert light.dtype == np.float32


def test_detection_goes_through_both_anchors_of_the_data_sheet() -> None:
    seen = detection_probability(received_photons(floats(0.1, 0.1), floats(45.0, 55.0)))
    np.testing.assert_allclose(seen, [0.9, 0.5], atol=1e-6)
    # The real unit saw nine in ten at 7 to 8 photons; the sheet's 45 m are 6.9 photons.
    assert received_photons(floats(0.1), floats(45.0))[0] == pytest.approx(6.9, abs=0.1)


def test_bright_targets_are_seen_at_100_to_120_m() -> None:
    seen = detection_probability(received_photons(floats(0.8, 0.8, 1.0, 1.0), floats(100.0, 120.0, 100.0, 120.0)))
    assert (seen > 0.9).all()


def test_detection_falls_with_range_incidence_and_darkness() -> None:
    ranges_m = np.linspace(10.0, 120.0, 200, dtype=np.float32)
    power = np.geomspace(1e-3, 1.0, 200, dtype=np.float32)
    by_range = detection_probability(received_photons(np.full(200, 0.1, np.float32), ranges_m))
    by_power = detection_probability(received_photons(power, np.full(200, 15.0, np.float32)))
    assert (np.diff(by_range) <= 0).all()
    assert (np.diff(by_power) >= 0).all()
    assert by_range[0] > 0.999
    assert by_range[-1] < 0.01
    assert detection_probability(floats(0.0))[0] < 1e-20


def test_range_noise_by_hand() -> None:
    # 20 m, 25 photons: floor 2 mm, range 8 mm, photons 13/5 = 2.6 mm.
    sigma = range_sigma_m(floats(20.0), floats(25.0), floats(1.0))
    assert sigma[0] == pytest.approx(np.sqrt(0.002**2 + 0.008**2 + 0.0026**2), rel=1e-5)
    # The same at 60 degrees: half as bright, the beam is 9.5 mm + 20 m x tan 0.18 deg = 72.3 mm wide, which is 2.3548
    # standard deviations of a normal curve; what comes back is 30.7 mm x tan 60 = 53.2 mm long, over 5 photons' root.
    slanted = range_sigma_m(floats(20.0), floats(25.0), floats(0.5))
    assert slanted[0] == pytest.approx(np.sqrt(sigma[0] ** 2 + (0.0532 / 5.0) ** 2), rel=1e-3)


def test_a_slant_counts_beside_the_sensor_where_the_beam_has_its_waist_alone() -> None:
    facing = range_sigma_m(floats(0.1), floats(4.0), floats(1.0))
    slanted = range_sigma_m(floats(0.1), floats(4.0), floats(0.5))
    waist_m = 0.0095 / 2.3548 + 0.00133 * 0.1
    assert slanted[0] == pytest.approx(np.hypot(facing[0], waist_m * np.sqrt(3.0) / 2.0), rel=1e-3)


def test_range_noise_rises_with_range_and_incidence_and_falls_with_light() -> None:
    many = 300
    ranges_m = np.linspace(0.3, 120.0, many, dtype=np.float32)
    light = np.geomspace(1.0, 1e4, many, dtype=np.float32)
    cosine = np.linspace(0.05, 1.0, many, dtype=np.float32)
    fixed = [np.full(many, value, np.float32) for value in (15.0, 20.0, 0.7)]
    assert (np.diff(range_sigma_m(ranges_m, fixed[1], fixed[2])) > 0).all()
    assert (np.diff(range_sigma_m(fixed[0], light, fixed[2])) < 0).all()
    assert (np.diff(range_sigma_m(fixed[0], fixed[1], cosine)) < 0).all()


@pytest.mark.parametrize(("range_m", "quoted_m"), [(20.0, 0.01), (50.0, 0.02), (120.0, 0.05)])
def test_range_noise_meets_the_quoted_table_at_the_end_of_its_bands(range_m: float, quoted_m: float) -> None:
    light = received_photons(floats(0.2), floats(range_m))
    assert range_sigma_m(floats(range_m), light, floats(1.0))[0] == pytest.approx(quoted_m, rel=0.2)


def test_reflectivity_channel_is_linear_to_100_and_logarithmic_above() -> None:
    share = floats(0.0, 0.004, 0.006, 0.25, 1.0, 2.0, 4.0, 1e6)
    # 100 % doubled is 1/0.06 = 16.7 counts more, twice doubled 33.3.
    np.testing.assert_array_equal(reflectivity_channel(share), [0, 0, 1, 25, 100, 117, 133, 255])
    back = apparent_reflectivity(received_photons(floats(0.37, 0.37), floats(4.0, 70.0)), floats(4.0, 70.0))
    np.testing.assert_allclose(back, 0.37, rtol=1e-6)


def test_signal_channel_counts_whole_photons() -> None:
    np.testing.assert_array_equal(signal_channel(floats(0.0, 4.4, 4.6, 1e6)), [0, 4, 5, 65535])


def test_range_channel_steps() -> None:
    ranges_m = floats(0.0, 0.3004, 0.3006, 1.0071, 1.0079)
    np.testing.assert_array_equal(range_channel(ranges_m, 1), [0, 300, 301, 1007, 1008])
    np.testing.assert_array_equal(range_channel(ranges_m, 8), [0, 296, 296, 1000, 1008])


def test_false_returns_are_one_in_ten_thousand_anywhere_and_at_any_range() -> None:
    n_pixels, n_draws = 32_768, 3_000
    drawn = [false_returns(stream(3, str(number)), n_pixels, 0.3, 120.0) for number in range(n_draws)]
    assert all(len(np.unique(pixels)) == len(pixels) for pixels, _ in drawn)
    pixels, ranges_m = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
    expected = n_pixels * n_draws * FALSE_RETURN_RATE
    assert abs(len(pixels) - expected) < 5 * np.sqrt(expected)
    assert stats.kstest(ranges_m, stats.uniform(0.3, 119.7).cdf).pvalue > 0.01
    assert stats.kstest(pixels, stats.uniform(0, n_pixels).cdf).pvalue > 0.01
    assert detection_probability(floats(FALSE_PHOTONS))[0] == pytest.approx(0.5, abs=1e-6)
