"""The network of the sphere descriptor: what was there in 64 numbers, and what of it is no longer so.

`encode` reads the unrolled wall around a keyframe and keeps four numbers for each of 16 sectors round the tunnel axis:
these are stored while mapping. `compare` reads those and the image of the other session from the same place, and gives
each sector the log-odds that something in it changed. The image is at hand after the merge, so only one side has to fit
into 64 numbers. Trained on simulated change (`cdpipe.descriptor.sphere_training`).
"""

from __future__ import annotations

from importlib import resources

import torch
from safetensors.torch import load
from torch import Tensor, nn

from cdpipe.descriptor.network import digest
from cdpipe.descriptor.sphere_image import COLUMNS, ROWS

SECTORS = 16
PER_SECTOR = 4
_CHANNELS = (16, 32, 48)
# Rows end as ROWS / 4, columns as SECTORS.
_STRIDES = ((1, 2), (2, 3), (2, 1))
_RANGE_SCALE_M = 6.0
# Changes are rare: an untrained network says so.
_FIRST_LOGIT = -3.0


class _UnrolledConv(nn.Module):
    """3 x 5 convolution, group norm and ReLU; columns wrap round the tunnel, beyond the rows nothing is seen."""

    def __init__(self, inputs: int, outputs: int, stride: tuple[int, int]) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, (3, 5), stride=stride, padding=(1, 0))
        self.norm = nn.GroupNorm(8, outputs)

    def forward(self, image: Tensor) -> Tensor:
        wrapped = nn.functional.pad(image, (2, 2, 0, 0), mode="circular")
        activated: Tensor = torch.relu(self.norm(self.conv(wrapped)))
        return activated


class SphereNetwork(nn.Module):
    """Images (B, ROWS, COLUMNS) of two sessions at the same places -> log-odds of change (B, SECTORS)."""

    def __init__(self) -> None:
        super().__init__()
        inputs = (2, *_CHANNELS[:-1])
        self.trunk = nn.Sequential(
            *(_UnrolledConv(a, b, s) for a, b, s in zip(inputs, _CHANNELS, _STRIDES, strict=True))
        )
        self.kept = nn.Conv2d(_CHANNELS[-1], PER_SECTOR, (ROWS // 4, 1))
        self.seen = nn.Conv2d(_CHANNELS[-1], 64, (ROWS // 4, 1))
        self.head = nn.ModuleList([nn.Conv1d(3 * PER_SECTOR + 64, 96, 3), nn.Conv1d(96, 64, 3)])
        self.logit = nn.Conv1d(64, 1, 1)
        self.calibration: Tensor
        self.register_buffer("calibration", torch.tensor([1.0, 0.0], dtype=torch.float64))

    def encode(self, images_m: Tensor) -> Tensor:
        """Return (B, PER_SECTOR, SECTORS) numbers in (-1, 1): the descriptor."""
        return self._kept(self._features(images_m))

    def compare(self, spheres: Tensor, images_m: Tensor) -> Tensor:
        """Return (B, SECTORS) log-odds of change between (B, PER_SECTOR, SECTORS) descriptors and images."""
        features = self._features(images_m)
        other = self._kept(features)
        seen = torch.relu(self.seen(features)[:, :, 0])
        hidden = torch.cat([spheres, other, (spheres - other).abs(), seen], dim=1)
        for layer in self.head:
            hidden = torch.relu(layer(nn.functional.pad(hidden, (1, 1), mode="circular")))
        logits: Tensor = self.logit(hidden)[:, 0] + _FIRST_LOGIT
        return logits

    def calibrated(self, logits: Tensor) -> Tensor:
        """Return the log-odds that a place changed, of those of its most changed sector."""
        log_odds: Tensor = self.calibration[0] * logits.double() + self.calibration[1]
        return log_odds

    def forward(self, before_m: Tensor, after_m: Tensor) -> Tensor:
        """Return (B, SECTORS) log-odds of change between two images of the same places."""
        return self.compare(self.encode(before_m), after_m)

    def _features(self, images_m: Tensor) -> Tensor:
        seen = (images_m > 0).float()
        nearness = seen * _RANGE_SCALE_M / (_RANGE_SCALE_M + images_m)
        features: Tensor = self.trunk(torch.stack([nearness, seen], dim=1))
        return features

    def _kept(self, features: Tensor) -> Tensor:
        return torch.tanh(self.kept(features)[:, :, 0])


def initial_sphere_network(seed: int = 0) -> SphereNetwork:
    """Return the untrained network; the same seed gives the same weights, and the global generator is left alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return SphereNetwork().eval()


def trained_sphere_network() -> tuple[SphereNetwork, str]:
    """Return the shipped network and the digest of its checkpoint."""
    content = (resources.files("cdpipe") / "descriptor" / "sphere.safetensors").read_bytes()
    network = SphereNetwork()
    network.load_state_dict(load(content))
    return network.eval(), digest(content)


assert COLUMNS == SECTORS * 6 and ROWS % 4 == 0
