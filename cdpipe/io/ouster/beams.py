"""Check that a capture's packets come from the beams of its metadata: old packets do not say which sensor sent them.

The beams of an Ouster look in azimuths of their own, so the rows of a revolution are shifted against each other. A wall
shows the shift: neighbouring rows agree best where they look in the same direction.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array
from cdpipe.sensor.ouster import SensorMetadata

# Largest shift that is tried; above the shift of 8.5 degrees between the outer beams.
_WIDEST_DEG = 12.0
# A pair of rows tells if the logarithm of its ranges differs this much less at the best shift than at most others.
_CLEAR = 0.4
_MOST_DIFFERENCE = 0.3
_LEAST_PAIRS, _LEAST_COLUMNS = 8, 100
# Shifts that differ by more than this contradict the metadata; so do more pairs than this share.
_TOLERANCE_DEG, _SHARE = 1.2, 0.5


def check_beams(range_mm: npt.NDArray[np.uint32], sensor: SensorMetadata, metadata: Path, where: Path) -> None:
    """Refuse metadata whose azimuths of the beams do not fit a revolution.

    Args:
        range_mm: (H, W) staggered ranges, 0 where nothing returned.
        sensor: What the metadata says.
        metadata: Its file, for the message.
        where: The capture, for the message.

    Raises:
        InputError: More than half of the pairs of neighbouring rows that tell are shifted by something else.
    """
    width = range_mm.shape[1]
    shifts, is_clear = _measure_shifts(range_mm, round(_WIDEST_DEG / 360.0 * width))
    told_deg = np.diff(sensor.azimuth_deg)
    off_deg = np.abs(shifts * (360.0 / width) - told_deg)[is_clear]
    wrong_deg = off_deg[off_deg > _TOLERANCE_DEG]
    if len(off_deg) < _LEAST_PAIRS or len(wrong_deg) <= _SHARE * len(off_deg):
        return
    raise InputError(
        f"{metadata}: not the metadata of the sensor that made {where}: {len(wrong_deg)} of {len(off_deg)} "
        f"neighbouring beams look {np.median(wrong_deg):.1f} degrees elsewhere than those of {sensor.product}: give "
        "that sensor's own .json with --metadata"
    )


def _measure_shifts(range_mm: npt.NDArray[np.uint32], widest: int) -> tuple[Float64Array, npt.NDArray[np.bool_]]:
    """Return for each pair of neighbouring rows the shift, columns, at which they agree best, and if it is clear."""
    is_hit = range_mm > 0
    far = np.log(np.where(is_hit, range_mm, 1).astype(np.float64))
    lags = np.arange(-widest, widest + 1)
    misfit = np.full((len(range_mm) - 1, len(lags)), np.nan)
    for column, lag in enumerate(lags.tolist()):
        both = is_hit[:-1] & np.roll(is_hit[1:], lag, axis=1)
        apart = np.minimum(np.abs(far[:-1] - np.roll(far[1:], lag, axis=1)), _MOST_DIFFERENCE)
        n_both = both.sum(axis=1)
        mean = (apart * both).sum(axis=1) / np.maximum(n_both, 1)
        misfit[:, column] = np.where(n_both >= _LEAST_COLUMNS, mean, np.inf)
    usual = np.median(misfit, axis=1)
    is_clear = np.isfinite(usual) & (misfit.min(axis=1) < _CLEAR * usual)
    return lags[np.argmin(misfit, axis=1)].astype(np.float64), is_clear
