"""The network of the rival `range-net`: which pixels of a range image hold what the other session's image lacks.

Two sphere images of one place, one of each session, pass through a small U-Net with two heads (the idea of Chamelion,
arXiv 2602.08189, with images instead of sparse voxels). One head gives the log-odds that a pixel of the first image has
changed, the other that the second session could see its surface. Each session takes the place of the first in turn, so
one network serves both directions. It is trained on simulated changes (`cdpipe.training.change_training`).
"""

from __future__ import annotations

from importlib import resources

import torch
from torch import Tensor, nn

from cdpipe.core.errors import InputError
from cdpipe.descriptors.network import CircularConv
from cdpipe.descriptors.sphere_image import COLUMNS, ROWS
from cdpipe.descriptors.weights_file import digest, list_weights, parse_weights

# Of the image, of its half and of its quarter in rows and columns.
_CHANNELS = (16, 16, 32)
_RANGE_SCALE_M = 6.0
# Scale of differences of range: that of the objects, well above the noise of a map.
_DIFFERENCE_SCALE_M = 0.3
_INPUTS = 5


class ChangeNetwork(nn.Module):
    """Maps two images of the same places to log-odds of each pixel of the first one."""

    def __init__(self) -> None:
        super().__init__()
        fine, half, quarter = _CHANNELS
        self.down = nn.ModuleList(
            [
                CircularConv(_INPUTS, fine, (1, 1), row_padding=1),
                CircularConv(fine, half, (2, 2), row_padding=1),
                CircularConv(half, quarter, (2, 2), row_padding=1),
            ]
        )
        self.bottom = CircularConv(quarter, quarter, (1, 1), row_padding=1)
        self.up = nn.ModuleList(
            [
                CircularConv(quarter + half, half, (1, 1), row_padding=1),
                CircularConv(half + fine, fine, (1, 1), row_padding=1),
            ]
        )
        self.heads = nn.Conv2d(fine, 2, 1)

    def forward(self, own_m: Tensor, other_m: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log-odds of change and of visibility, both (B, ROWS, COLUMNS), of the pixels of `own_m`.

        Args:
            own_m: (B, ROWS, COLUMNS) float32 images of one session, metres, 0 without a point.
            other_m: The images of the other session at the same poses.
        """
        seen = [(image > 0).float() for image in (own_m, other_m)]
        nearness = [
            is_seen * _RANGE_SCALE_M / (_RANGE_SCALE_M + image)
            for is_seen, image in zip(seen, (own_m, other_m), strict=True)
        ]
        behind = seen[0] * seen[1] * torch.tanh((other_m - own_m) / _DIFFERENCE_SCALE_M)
        features = torch.stack([*nearness, *seen, behind], dim=1)
        levels = []
        for layer in self.down:
            features = layer(features)
            levels.append(features)
        features = self.bottom(features)
        for layer, finer in zip(self.up, levels[-2::-1], strict=True):
            doubled = features.repeat_interleave(2, dim=2).repeat_interleave(2, dim=3)
            features = layer(torch.cat([doubled, finer], dim=1))
        change, visible = self.heads(features).unbind(dim=1)
        return change, visible


def make_untrained_change_network(seed: int = 0) -> ChangeNetwork:
    """Return a network with random weights from a seed; the global generator is not changed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return ChangeNetwork().eval()


def load_change_network(content: bytes, source: str = "range-net.safetensors") -> ChangeNetwork:
    """Return the network of a checkpoint.

    Raises:
        InputError: The checkpoint is damaged, of another format, or of another network.
    """
    network = ChangeNetwork()
    network.load_state_dict(parse_weights(content, source, list_weights(network)))
    return network.eval()


def load_trained_change_network() -> tuple[ChangeNetwork, str]:
    """Return the shipped network and the digest of its checkpoint.

    Raises:
        InputError: The installation lacks the weights.
    """
    path = resources.files("cdpipe") / "descriptors" / "weights" / "range-net.safetensors"
    if not path.is_file():
        raise InputError(f"{path.name}: the shipped weights are missing: install again, or set range_net.weights")
    content = path.read_bytes()
    return load_change_network(content), digest(content)


assert ROWS % 4 == 0 and COLUMNS % 4 == 0
