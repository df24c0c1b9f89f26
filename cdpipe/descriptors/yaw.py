"""Yaw between two keyframes from their orientation vectors w (3DEG, arXiv 2210.07285); needs no torch."""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry import Float32Array, Float64Array


def relative_yaws_rad(w_before: Float32Array, w_after: Float32Array, n: int = 2) -> Float64Array:
    """Return the (..., n) likeliest yaws of before_sensor_T_after_sensor, best first, in (-pi, pi].

    They are the peaks of the circular correlation, refined by a parabola; NaN if there are fewer peaks.

    Args:
        w_before: (..., 64) orientation vectors of before keyframes.
        w_after: (..., 64) orientation vectors of after keyframes.
        n: Number of peaks.
    """
    size = w_before.shape[-1]
    correlation = np.fft.irfft(np.fft.rfft(w_before) * np.conj(np.fft.rfft(w_after)), n=size)
    left, right = np.roll(correlation, 1, axis=-1), np.roll(correlation, -1, axis=-1)
    height = np.where((correlation >= left) & (correlation > right), correlation, -np.inf)
    peaks = np.argsort(-height, axis=-1, kind="stable")[..., :n]
    at_left, at_peak, at_right = (np.take_along_axis(part, peaks, axis=-1) for part in (left, correlation, right))
    curvature = at_left - 2 * at_peak + at_right
    shift = 0.5 * (at_left - at_right) / np.where(curvature == 0, 1.0, curvature)
    yaws_rad = np.angle(np.exp(1j * (peaks + shift) * 2 * np.pi / size))
    return np.where(np.isinf(np.take_along_axis(height, peaks, axis=-1)), np.nan, yaws_rad)
