"""How a figure grows with a size: the exponent of a power law, fitted on logarithms, and its interval."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

_SHARE = 0.975


@dataclass(frozen=True, slots=True)
class Growth:
    """The exponent of figure = c * size ** exponent.

    Attributes:
        exponent: Least squares of log(figure) over log(size); NaN with fewer than two sizes.
        low: Lower end of the 95 % interval of the regression (Student's t, n - 2 degrees of freedom); NaN below three
            sizes.
        high: Its upper end.
        last: Exponent between the two largest sizes: what grows faster shows there first.
    """

    exponent: float
    low: float
    high: float
    last: float


def fit_growth(sizes: Sequence[float], figures: Sequence[float]) -> Growth:
    """Fit the exponent of (N,) figures over (N,) sizes; what is not positive, in either, is left out."""
    pairs = sorted((size, figure) for size, figure in zip(sizes, figures, strict=True) if size > 0 and figure > 0)
    if len({size for size, _ in pairs}) < 2:
        return Growth(*(float("nan"),) * 4)
    x, y = np.log(np.array(pairs)).T
    centred = x - x.mean()
    spread = float(centred @ centred)
    exponent = float(centred @ y) / spread
    last = float((y[-1] - y[-2]) / (x[-1] - x[-2])) if x[-1] > x[-2] else float("nan")
    if len(pairs) < 3:
        return Growth(exponent, float("nan"), float("nan"), last)
    residuals = y - y.mean() - exponent * centred
    deviation = np.sqrt(float(residuals @ residuals) / (len(pairs) - 2) / spread)
    half = float(student.ppf(_SHARE, len(pairs) - 2) * deviation)
    return Growth(exponent, exponent - half, exponent + half, last)
