"""Where a network computes: on the processor, or on a GPU; its inputs and results stay in the processor's memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from cdpipe.core.errors import InputError


def find_device(name: str) -> torch.device:
    """Return the device `cpu` or `cuda`, the first GPU, which then convolves in float32 and not in TF32.

    Raises:
        InputError: torch finds no GPU.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError(f"device cuda: torch {torch.__version__} finds no GPU that it can use: take device cpu")
    if name == "cuda":
        torch.backends.cudnn.allow_tf32 = False
    return torch.device(name)


def compute(network: nn.Module, *inputs: Tensor, by: Callable[..., Any] | None = None) -> Any:
    """Return what a network makes of some tensors, computed where its weights lie.

    Args:
        network: The network.
        inputs: Tensors in the processor's memory, from which gradients may flow.
        by: A method of the network; its forward pass is the default.

    Returns:
        A tensor or a tuple of tensors in the processor's memory.
    """
    weights = next(network.parameters(), None)
    device = torch.device("cpu") if weights is None else weights.device
    found = (by or network)(*(each.to(device) for each in inputs))
    return found.cpu() if isinstance(found, Tensor) else tuple(each.cpu() for each in found)
