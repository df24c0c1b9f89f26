"""Weights of the networks as safetensors, with the number of their format in the metadata."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from safetensors.torch import save
from torch import Tensor, nn

from cdpipe.core.errors import InputError
from cdpipe.core.files import ArraySpec, Expected, parse_json, parse_tensors, read_bytes, require_format

FORMAT = "tunnelcd-weights"
FORMAT_VERSION = 1
_MOST_BYTES = 256 << 20
_METADATA = "tunnelcd"  # a single entry, because safetensors writes several in no fixed order


def read_weights(path: str) -> bytes:
    """Return the content of a file of weights that a setting names.

    Raises:
        InputError: The file is missing, too large, or cannot be read.
    """
    return read_bytes(Path(path), _MOST_BYTES, "expected weights as `tunnelcd train` writes them")


def checkpoint_bytes(network: nn.Module) -> bytes:
    """Return the weights as safetensors."""
    return _encode(network, None)


def numbered_checkpoint_bytes(network: nn.Module) -> bytes:
    """Return the weights as safetensors that name their format, as files of trained weights do."""
    return _encode(network, {_METADATA: json.dumps({"format": FORMAT, "format_version": FORMAT_VERSION})})


def digest(content: bytes) -> str:
    """Return the first 16 hex digits of the SHA-256 of a checkpoint, its name."""
    return hashlib.sha256(content).hexdigest()[:16]


def parse_weights(content: bytes, source: str, expected: Expected) -> dict[str, Tensor]:
    """Return the weights of a checkpoint.

    The first checkpoints carry no metadata; they hold the same tensors as those of format 1.

    Raises:
        InputError: The checkpoint is damaged, of another format or network, or holds numbers that are not finite; the
            text names `source`.
    """
    try:
        arrays, metadata = parse_tensors(content, expected)
        _require_finite(arrays)
        about = parse_json(metadata[_METADATA]) if _METADATA in metadata else None
    except ValueError as error:
        raise InputError(f"{source}: damaged, or weights of another network ({error})") from error
    if about is not None:
        found = (about.get("format"), about.get("format_version")) if isinstance(about, dict) else (None, None)
        require_format(Path(source), found, FORMAT, FORMAT_VERSION, "train it again with `tunnelcd train`")
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


def list_weights(network: nn.Module) -> dict[str, ArraySpec]:
    """Return what the tensors of a network are; the network may be one without values, on the device `meta`."""
    return list_tensors(network.state_dict())


def list_tensors(tensors: Mapping[str, Tensor]) -> dict[str, ArraySpec]:
    """Return names, types and shapes of tensors."""
    return {
        name: ArraySpec(",".join(map(str, tensor.shape)), str(tensor.dtype).removeprefix("torch."))
        for name, tensor in tensors.items()
    }


def _require_finite(arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{name} holds numbers that are not finite")


def _encode(network: nn.Module, metadata: dict[str, str] | None) -> bytes:
    tensors: dict[str, Any] = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    return save(tensors, metadata)
