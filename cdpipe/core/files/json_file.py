"""JSON: bounded in size and depth; a key that stands twice and numbers beyond 64 bits are refused."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.core.files.plain_file import read_bytes

MAX_BYTES = 24_000_000
"""The largest JSON of ours, the cell of a tunnel of 10 km, takes a tenth of it; parsed, a byte takes up to 35."""
MAX_DEPTH = 64
MAX_VALUES = 1_000_000
"""A mistake about each of so many takes 400 MB; the cell of a tunnel of 10 km holds less than a fifth."""
_MAX_INTEGER = 2**64
_OUTER = (dict, list)
_LONG_NUMBER = re.compile(rb"\d{20}")  # a number beyond 64 bits has as many digits
_EXPONENT = re.compile(rb"\d[eE]\+?\d{3}")  # what may be read as infinite


def parse_json(text: str | bytes, *, is_finite: bool = False) -> Any:
    """Parse JSON.

    Args:
        text: UTF-8.
        is_finite: Whether NaN and infinite numbers are mistakes; Python writes and reads both.

    Raises:
        ValueError: It is no JSON, is nested deeper than `MAX_DEPTH`, names a key twice, or holds more than `MAX_VALUES`
            values, a whole number beyond 64 bits, one that is not finite, or half a surrogate pair, which no file can
            hold.
    """
    if len(text) > MAX_BYTES:
        raise ValueError(f"{len(text) / 1e6:.0f} MB, more than the {MAX_BYTES / 1e6:.0f} MB it may have")
    try:
        document = json.loads(text, object_pairs_hook=_unique)
    except RecursionError as error:
        raise ValueError(f"nested deeper than {MAX_DEPTH} levels") from error
    level: list[Any] = [document]
    n_values, is_plain = 0, _is_plain(text, is_finite=is_finite)
    for _ in range(MAX_DEPTH):
        n_values += sum(len(outer) for outer in level if isinstance(outer, dict | list))
        if n_values > MAX_VALUES:
            raise ValueError(f"more than {MAX_VALUES} values")
        if is_plain:
            level = [inner for outer in level for inner in _values(outer) if type(inner) in _OUTER]
        else:
            level = [inner for outer in level for inner in _check_values(outer, is_finite)]
        if not level:
            return document
    raise ValueError(f"nested deeper than {MAX_DEPTH} levels")


def read_json(path: Path, expected: str, *, is_finite: bool = False) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        InputError: The file is missing, cannot be read, or holds no JSON object by the rules of `parse_json`; the
            message ends with `expected`.
    """
    content = read_bytes(path, MAX_BYTES, expected)
    try:
        document = parse_json(content, is_finite=is_finite)
    except ValueError as error:  # not UTF-8 is one as well
        raise InputError(f"{path}: damaged, not JSON ({error}): {expected}") from error
    if not isinstance(document, dict):
        raise InputError(f"{path}: damaged, holds a JSON {type(document).__name__}: {expected}")
    return document


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        ((twice, _),) = Counter(name for name, _ in pairs).most_common(1)
        raise ValueError(f"the key {twice[:40]!r} stands there twice")
    return found


def _is_plain(text: str | bytes, *, is_finite: bool) -> bool:
    """Tell whether the text alone shows that no value of it is to be refused; most files are so."""
    content = text.encode(errors="surrogatepass") if isinstance(text, str) else text
    is_odd = not content.isascii() or b"\\u" in content or _LONG_NUMBER.search(content) is not None
    return not is_odd and not (is_finite and (b"N" in content or b"I" in content or _EXPONENT.search(content)))


def _values(outer: Any) -> Iterable[Any]:
    return outer.values() if type(outer) is dict else outer if type(outer) is list else ()


def _check_values(outer: Any, is_finite: bool) -> list[Any]:
    """Return the lists and objects within a value; refuse numbers that do not fit."""
    values: Iterable[Any] = (
        outer.values() if isinstance(outer, dict) else outer if isinstance(outer, list) else (outer,)
    )
    within = []
    if type(outer) is dict:
        for name in outer:
            _check_text(name)
    for value in values:
        kind = type(value)
        if kind is dict or kind is list:
            within.append(value)
        elif kind is str:
            _check_text(value)
        elif kind is int and abs(value) >= _MAX_INTEGER:
            raise ValueError(f"{_name(outer, value)} is beyond 64 bits")
        elif is_finite and kind is float and not math.isfinite(value):
            raise ValueError(f"{_name(outer, value)} is {value}, no finite number")
    return within


def _name(outer: Any, value: Any) -> str:
    names = [name for name, each in outer.items() if each is value] if isinstance(outer, dict) else []
    return f"{names[0]:.40}" if names else "a number"


def _check_text(text: str) -> None:
    if not text.isascii() and any("\ud800" <= letter <= "\udfff" for letter in text):
        raise ValueError(f"{text[:40]!r} holds half a surrogate pair")
