"""Seeds as a plan and the option --seeds write them."""

from __future__ import annotations

import re
from typing import Any

from cdpipe.core.errors import InputError

_MOST_SEEDS = 100_000


def parse_seeds(value: Any) -> tuple[int, ...]:
    """Return the seeds of "A:B" (B excluded), of "A", or of a list of non-negative numbers.

    Raises:
        ValueError: It has another form, is empty, or names a seed twice.
    """
    rule = 'expected "A:B" in quotes (B excluded) or a list of seeds, all 0 or larger, of 15 digits at most'
    if isinstance(value, str):
        match = re.fullmatch(r"(\d{1,15})(?::(\d{1,15}))?", value.strip())
        if match is None:
            raise ValueError(rule)
        first, end = int(match[1]), int(match[2] or match[1]) + (match[2] is None)
        if end - first > _MOST_SEEDS:
            raise ValueError(f"{rule}; at most {_MOST_SEEDS} of them")
        value = list(range(first, end))
        if not value:
            raise ValueError(f"{rule}; this range is empty")
    # YAML 1.1 reads an unquoted 1:40 as the number 100, so a bare number is refused
    if not isinstance(value, list | tuple) or not value:
        raise ValueError(rule)
    if not all(type(seed) is int and seed >= 0 for seed in value) or len(set(value)) < len(value):
        raise ValueError(f"{rule}, none twice")
    return tuple(value)


def parse_seeds_option(text: str) -> tuple[int, ...]:
    """Return the seeds that the option --seeds names.

    Raises:
        InputError: It is no range of seeds.
    """
    try:
        return parse_seeds(text)
    except ValueError as error:
        raise InputError(f"--seeds {text}: {error}") from error
