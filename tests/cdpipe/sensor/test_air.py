from __future__ import annotations

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array
from cdpipe.mapping.poses import odometry
from cdpipe.sensor.air import find_clear_pixels
from cdpipe.sensor.ouster import load_profile

ROWS, COLUMNS = 32, 512


def wall(range_mm: int = 5000) -> tuple[np.ndarray, np.ndarray]:
    return np.full((ROWS, COLUMNS), range_mm, np.uint32), np.full((ROWS, COLUMNS), 60, np.uint16)


def misty(n_layers: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A wall with a handful of photons from the air before it in every tenth beam: ranges, signal, and where."""
    range_mm, signal = (np.tile(each, (n_layers, 1)) for each in wall())
    draw = np.random.default_rng(3)
    is_air = draw.random(range_mm.shape) < 0.1
    range_mm[is_air] = draw.integers(400, 3000, np.count_nonzero(is_air))
    signal[is_air] = 5
    return range_mm, signal, is_air


@pytest.mark.parametrize("n_layers", [1, 2])
def test_air_is_told_in_images_of_one_and_two_returns(n_layers: int) -> None:
    range_mm, signal, is_air = misty(n_layers)
    is_clear = find_clear_pixels(range_mm, signal, range_mm.size // 2 if n_layers == 2 else None)
    np.testing.assert_array_equal(is_clear, ~is_air)


def test_clear_air_misses_and_recordings_without_a_signal_stay_as_they_are() -> None:
    range_mm, signal = wall()
    range_mm[3, 5:9] = 0
    np.testing.assert_array_equal(find_clear_pixels(range_mm, signal), range_mm > 0)
    range_mm, signal, _ = misty()
    assert find_clear_pixels(range_mm, np.zeros_like(signal)).all()
    assert not find_clear_pixels(np.zeros_like(range_mm), signal).any()


def test_an_odometry_is_given_no_returns_of_the_air(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Float64Array] = []

    class Watching:
        last_pose = np.eye(4)

        def register_frame(self, points: Float64Array, _: Float64Array) -> None:
            given.append(points)

    monkeypatch.setattr(odometry, "_kiss_icp", Watching)
    sensor = load_profile("os1-32-nominal", "512x10")
    range_mm, signal, is_air = misty()
    times = np.array([0.05, 0.15]), np.zeros(COLUMNS)
    odometry.estimate_motion([(range_mm, signal), wall()], sensor, *times, np.eye(4))
    assert [len(points) for points in given] == [np.count_nonzero(~is_air), ROWS * COLUMNS]
    assert np.linalg.norm(given[0], axis=1).min() > 4.9
