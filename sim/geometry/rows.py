"""Distinct rows of whole numbers, as `np.unique(rows, axis=0)` finds them, by one number for each row."""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry import Int64Array


def number_rows(rows: Int64Array) -> Int64Array:
    """Return numbers (N,) that are equal where rows (N, K) are, and sort as the rows do.

    Raises:
        ValueError: The rows span more than 63 bits.
    """
    numbers = np.zeros(len(rows), np.int64)
    n_bits = 0
    for column in rows.T if len(rows) else ():
        low, high = int(column.min()), int(column.max())
        width = (high - low).bit_length()
        n_bits += width
        if n_bits > 63:
            raise ValueError(f"rows of whole numbers span {n_bits} bits, at most 63")
        numbers <<= width
        numbers += column - low
    return numbers


def unique_rows(rows: Int64Array) -> Int64Array:
    """Return the distinct rows (M, K), sorted."""
    return np.asarray(rows[np.unique(number_rows(rows), return_index=True)[1]])
