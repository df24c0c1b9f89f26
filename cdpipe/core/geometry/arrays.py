"""Types of arrays, and checks of their shapes."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Float64Array = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
Int8Array = npt.NDArray[np.int8]
Int64Array = npt.NDArray[np.int64]
Int32Array = npt.NDArray[np.int32]
BoolArray = npt.NDArray[np.bool_]


def require_shape(name: str, array: npt.NDArray[Any], shape: tuple[int | None, ...]) -> None:
    """Raise `ValueError` unless `array` has `shape`; `None` allows any length."""
    if array.ndim == len(shape) and all(want in (None, got) for want, got in zip(shape, array.shape, strict=True)):
        return
    wanted = ", ".join("N" if want is None else str(want) for want in shape)
    raise ValueError(f"{name} must be ({wanted}), got {array.shape}")


def require_shapes(owner: object, **shapes: tuple[int | None, ...]) -> None:
    """Raise `ValueError` unless each named field of a dataclass has its shape, or is None where its type says so."""
    fields = owner.__dataclass_fields__  # type: ignore[attr-defined]
    for name, shape in shapes.items():
        array = getattr(owner, name)
        if array is not None or "None" not in str(fields[name].type):
            require_shape(name, np.asarray(array), shape)
