"""What the arrays of a file must be: names, types and shapes, checked on the file's table of contents."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True)
class ArrayType:
    """Type and shape of an array, known before its values are read."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)


@dataclass(frozen=True, slots=True)
class ArraySpec:
    """What one array must be.

    Attributes:
        shape: Its axes, "s,H,W": a number is a length, equal letters are equal lengths, "" is a single value, and
            "..." at the end stands for one or more further axes.
        dtypes: numpy names of the types it may have, "float32" or "float32 float16"; "str" for text of any length.
        is_optional: Whether it may be absent.
        is_finite: Whether every value must be finite.
    """

    shape: str
    dtypes: str
    is_optional: bool = False
    is_finite: bool = True


Expected = Mapping[str, ArraySpec] | Callable[[Mapping[str, ArrayType]], None]
"""Every array that a file may hold; or a check that raises ValueError or InputError where it holds others."""


def check_types(found: Mapping[str, ArrayType], expected: Expected, lengths: Mapping[str, int]) -> None:
    """Check names, types and shapes, before any value is read.

    Args:
        found: The arrays of a file.
        expected: What they must be.
        lengths: The lengths of axes that are known already, by letter.

    Raises:
        ValueError: The first mistakes, in one line.
    """
    if not isinstance(expected, Mapping):
        expected(found)
        return
    specs, known = expected, dict(lengths)
    mistakes = [f"{name} is missing" for name, spec in specs.items() if name not in found and not spec.is_optional]
    mistakes += [f"{name[:40]!r} is unknown" for name in found if name not in specs]
    for name, spec in specs.items():
        if name not in found:
            continue
        array = found[name]
        if ("str" if array.dtype.kind == "U" else array.dtype.name) not in spec.dtypes.split():
            mistakes.append(f"{name} must be {spec.dtypes.replace(' ', ' or ')}, got {array.dtype}")
        if not _fits(array.shape, spec.shape, known):
            wanted = ", ".join(f"{axis}={known[axis]}" if axis in known else axis for axis in spec.shape.split(","))
            mistakes.append(f"{name} must be ({wanted}), got {array.shape}")
    if mistakes:
        more = f" and {len(mistakes) - 3} more" if len(mistakes) > 3 else ""
        raise ValueError(f"{'; '.join(mistakes[:3])}{more}")


def check_values(arrays: Mapping[str, npt.NDArray[Any]], expected: Expected) -> None:
    """Raise ValueError where an array that must be finite is not, or one of truth values holds another byte."""
    for name, array in arrays.items():
        if array.dtype == np.bool_ and array.view(np.uint8).max(initial=0) > 1:
            raise ValueError(f"{name} holds bytes that are neither true nor false")
        must_be_finite = isinstance(expected, Mapping) and name in expected and expected[name].is_finite
        if must_be_finite and array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{name} holds numbers that are not finite")


def _fits(shape: tuple[int, ...], wanted: str, known: dict[str, int]) -> bool:
    """Tell whether a shape is the wanted one; note the lengths of axes seen for the first time."""
    axes = wanted.split(",") if wanted else []
    if axes and axes[-1] == "...":
        axes = axes[:-1]
        if len(shape) <= len(axes):
            return False
        shape = shape[: len(axes)]
    if len(shape) != len(axes):
        return False
    return all(
        length == (int(axis) if axis.isdigit() else known.setdefault(axis, length))
        for axis, length in zip(axes, shape, strict=True)
    )
