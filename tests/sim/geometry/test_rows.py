"""Distinct rows by one number each, against numpy's search for them."""

from __future__ import annotations

import numpy as np
import pytest

from sim.geometry.rows import number_rows, unique_rows


@pytest.mark.parametrize("n_columns", [1, 2, 4])
@pytest.mark.parametrize("n_rows", [1, 7, 3000])
def test_numbers_stand_for_the_rows(n_rows: int, n_columns: int) -> None:
    rows = np.random.default_rng(n_rows).integers(-9, 9, (n_rows, n_columns))
    expected, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    _, found, which = np.unique(number_rows(rows), return_index=True, return_inverse=True)
    np.testing.assert_array_equal(found, first)
    np.testing.assert_array_equal(which, inverse.reshape(-1))
    np.testing.assert_array_equal(unique_rows(rows), expected)


def test_no_rows_have_no_numbers() -> None:
    assert unique_rows(np.zeros((0, 3), np.int64)).shape == (0, 3)


def test_rows_that_span_too_much_are_refused() -> None:
    with pytest.raises(ValueError, match="66 bits"):
        number_rows(np.array([[0, 0, 0], [2**21, 2**21, 2**21]]))
