"""The scan descriptor network: a re-implementation of 3DEG (arXiv 2210.07285), after OREOS (arXiv 1903.07918).

A range image passes through convolutions with circular padding in azimuth and gives two 64-d vectors. The place vector
q is made of maxima and amplitudes of low azimuth frequencies, so it is invariant to yaw. The orientation vector w has
one value per 5.6 degrees of azimuth, so yaw shifts it circularly. No weights or code of 3DEG are public; layer sizes
are ours.
"""

from __future__ import annotations

from importlib import resources

import numpy as np
import torch
from torch import Tensor, nn

from cdpipe.descriptors.range_image import COLUMNS
from cdpipe.descriptors.weights_file import digest, list_weights, parse_weights

DIMENSIONS = 64
_CHANNELS = (24, 48, 64, 64)
# (row, azimuth); the azimuth strides multiply to COLUMNS / DIMENSIONS, so w has one value per remaining column.
_STRIDES = ((2, 2), (2, 2), (2, 1), (1, 1))
# Number of azimuth frequencies in q, the mean included: structures 26 degrees wide and wider.
_FREQUENCIES = 8
_RANGE_SCALE_M = 10.0


class CircularConv(nn.Module):
    """3 x 5 convolution, group norm and ReLU; columns wrap round, rows are padded.

    Args:
        inputs: Channels in.
        outputs: Channels out.
        stride: Of rows and columns.
        row_padding: Rows of zeros beyond either edge; 0 repeats the edge instead.
    """

    def __init__(self, inputs: int, outputs: int, stride: tuple[int, int], row_padding: int = 0) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, (3, 5), stride=stride, padding=(row_padding, 0))
        self.norm = nn.GroupNorm(8, outputs)

    def forward(self, image: Tensor) -> Tensor:
        """Return (B, outputs, rows, columns) features of (B, inputs, rows, columns)."""
        padded = nn.functional.pad(image, (2, 2, 0, 0), mode="circular")
        if not self.conv.padding[0]:
            padded = nn.functional.pad(padded, (0, 0, 1, 1), mode="replicate")
        activated: Tensor = torch.relu(self.norm(self.conv(padded)))
        return activated


class PlaceNetwork(nn.Module):
    """Maps (B, ROWS, COLUMNS) ranges, metres, to q (B, 64), unit length, and w (B, 64), zero mean, unit length."""

    def __init__(self) -> None:
        super().__init__()
        inputs = (2, *_CHANNELS[:-1])
        self.layers = nn.Sequential(
            *(CircularConv(a, b, s) for a, b, s in zip(inputs, _CHANNELS, _STRIDES, strict=True))
        )
        self.place = nn.Linear((_FREQUENCIES + 1) * _CHANNELS[-1] * 4, DIMENSIONS)
        self.heading = nn.Conv1d(4 * _CHANNELS[-1], 1, 1)

    def forward(self, ranges_m: Tensor) -> tuple[Tensor, Tensor]:
        """Return q (B, 64) and w (B, 64)."""
        seen = (ranges_m > 0).float()
        nearness = seen * _RANGE_SCALE_M / (_RANGE_SCALE_M + ranges_m)
        features = self.layers(torch.stack([nearness, seen], dim=1)).flatten(1, 2)
        pooled = torch.cat([_amplitudes(features), features.amax(dim=2, keepdim=True)], dim=2)
        q = nn.functional.normalize(self.place(pooled.flatten(1)), dim=1)
        heading = self.heading(features)[:, 0]
        w = nn.functional.normalize(heading - heading.mean(dim=1, keepdim=True), dim=1)
        return q, w


def _amplitudes(features: Tensor) -> Tensor:
    """Return the (B, F, _FREQUENCIES) amplitudes of the lowest column frequencies of (B, F, columns) features."""
    spectrum = torch.fft.rfft(features, norm="forward")[..., :_FREQUENCIES]
    # abs() has no gradient at 0
    magnitudes = (spectrum.real.square() + spectrum.imag.square() + 1e-6).sqrt()
    return torch.cat([magnitudes[..., :1], 2 * magnitudes[..., 1:]], dim=-1)


def yaw_correlation(w_a: Tensor, w_b: Tensor) -> Tensor:
    """Return the (B, 64) circular correlation; a peak at s means that b has yaw s * 2 pi / 64 relative to a."""
    spectrum = torch.fft.rfft(w_a) * torch.fft.rfft(w_b).conj()
    correlation: Tensor = torch.fft.irfft(spectrum, n=w_a.shape[-1])
    return correlation


def make_untrained_network(seed: int = 0) -> PlaceNetwork:
    """Return a network with random weights from a seed; the global generator is not changed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return PlaceNetwork().eval()


def load_network(content: bytes, source: str = "3deg.safetensors") -> PlaceNetwork:
    """Return the network of a checkpoint.

    Raises:
        InputError: The checkpoint is damaged, of another format, or of another network.
    """
    network = PlaceNetwork()
    network.load_state_dict(parse_weights(content, source, list_weights(network)))
    return network.eval()


def load_trained_network() -> tuple[PlaceNetwork, str]:
    """Return the shipped network and the digest of its checkpoint."""
    content = (resources.files("cdpipe") / "descriptors" / "weights" / "3deg.safetensors").read_bytes()
    return load_network(content), digest(content)


assert np.prod([stride[1] for stride in _STRIDES]) * DIMENSIONS == COLUMNS
