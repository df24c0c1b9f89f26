"""Smoothing of a line sampled every 0.05 m, and bounds that still hold after the smoothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from cdpipe.core.geometry import Float64Array

STEP_M = 0.05  # between the samples of a line


def smooth_line(values: Float64Array, half_m: float) -> Float64Array:
    """Return (N,) or (N, D) samples 0.05 m apart averaged with a Hann window of this half width, ends kept."""
    half = round(half_m / STEP_M)
    if half < 1 or len(values) < 2:
        return values
    window = np.hanning(2 * half + 3)[1:-1]
    window /= window.sum()
    padded = np.pad(values, [(half, half)] + [(0, 0)] * (values.ndim - 1), mode="reflect", reflect_type="odd")
    if values.ndim == 1:
        return np.convolve(padded, window, mode="valid")
    return np.stack([np.convolve(column, window, mode="valid") for column in padded.T], axis=1)


def tighten_bound(bound: Float64Array, half_m: float, of: Callable[..., Any]) -> Float64Array:
    """Return the strictest bound within `half_m` of each sample: a Hann average over that window keeps the bound."""
    half = round(half_m / STEP_M)
    padded = np.pad(bound, half, mode="edge")
    return np.asarray(of(np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1), axis=1))


def smooth_between(wanted: Float64Array, low: Float64Array, high: Float64Array, half_m: float) -> Float64Array:
    """Return smooth values (N,) near the wanted ones, inside the bounds where these do not cross within `half_m`."""
    inner_low, inner_high = tighten_bound(low, half_m, np.max), tighten_bound(high, half_m, np.min)
    middle = (inner_low + inner_high) / 2
    is_crossed = inner_low > inner_high
    target = np.where(is_crossed, middle, np.clip(wanted, inner_low, np.maximum(inner_low, inner_high)))
    return smooth_line(target, half_m)
