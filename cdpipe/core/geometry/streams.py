"""Seeded random generators, one for each purpose."""

from __future__ import annotations

import zlib

import numpy as np


def stream(seed: int, *purpose: str) -> np.random.Generator:
    """Return the generator for one purpose, e.g. `stream(7, "after", "lidar-noise")`."""
    return np.random.default_rng([seed, *(zlib.crc32(word.encode()) for word in purpose)])
