"""The network of the sphere descriptor: encode the before map in 64 numbers, compare them with the after map.

`encode` maps the unrolled wall around a keyframe to four numbers for each of 16 sectors around the tunnel axis; these
are stored while mapping. `compare` reads them and the after image of the same place, and returns the log-odds of change
of each sector. It is trained on simulated changes (`cdpipe.training.sphere_training`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources

import torch
from torch import Tensor, nn

from cdpipe.core.files import ArrayType, check_types
from cdpipe.descriptors.network import CircularConv
from cdpipe.descriptors.sphere_image import COLUMNS, ROWS
from cdpipe.descriptors.weights_file import digest, list_weights, parse_weights

SECTORS = 16
PER_SECTOR = 4
_CHANNELS = (16, 32, 48)
_SEEN = 64
_HIDDEN = (96, 64)
# Largest network that is loaded: 64 times as wide as the shipped one.
_MOST_PER_SECTOR, _MOST_CHANNELS = 1024, 64 * 48
# (row, column); rows end as ROWS / 4, columns as SECTORS.
_STRIDES = ((1, 2), (2, 3), (2, 1))
_RANGE_SCALE_M = 6.0
# Offset of the logits: changes are rare.
_FIRST_LOGIT = -3.0


@dataclass(frozen=True, slots=True)
class SphereSize:
    """The size of a sphere network; the defaults are the shipped one's.

    Attributes:
        per_sector: Numbers stored for each of the 16 sectors.
        width: Channels of all layers but the stored one, as a multiple of the shipped network's; a multiple of 1/2.
        reads_after: Whether the comparison reads features of the after image, or only its encoded numbers.
    """

    per_sector: int = PER_SECTOR
    width: float = 1.0
    reads_after: bool = True

    def __post_init__(self) -> None:
        if self.per_sector < 1 or self.width <= 0 or self.width % 0.5:
            raise ValueError(f"a network needs a number for each sector and halves of the shipped width, got {self}")

    @property
    def numbers(self) -> int:
        """Numbers stored for each keyframe."""
        return self.per_sector * SECTORS


class SphereNetwork(nn.Module):
    """Maps two images (B, ROWS, COLUMNS) of the same places to the log-odds of change (B, SECTORS)."""

    def __init__(self, size: SphereSize | None = None) -> None:
        """Build a network of a size, the shipped one's by default."""
        super().__init__()
        self.size = size or SphereSize()
        channels, hidden = (tuple(int(n * self.size.width) for n in shipped) for shipped in (_CHANNELS, _HIDDEN))
        n_seen = int(_SEEN * self.size.width) if self.size.reads_after else 0
        inputs = (2, *channels[:-1])
        self.trunk = nn.Sequential(
            *(CircularConv(a, b, s, row_padding=1) for a, b, s in zip(inputs, channels, _STRIDES, strict=True))
        )
        self.kept = nn.Conv2d(channels[-1], self.size.per_sector, (ROWS // 4, 1))
        if n_seen:
            self.seen = nn.Conv2d(channels[-1], n_seen, (ROWS // 4, 1))
        n_compared = 3 * self.size.per_sector + n_seen
        self.head = nn.ModuleList([nn.Conv1d(n_compared, hidden[0], 3), nn.Conv1d(hidden[0], hidden[1], 3)])
        self.logit = nn.Conv1d(hidden[1], 1, 1)
        self.calibration: Tensor
        self.register_buffer("calibration", torch.tensor([1.0, 0.0], dtype=torch.float64))

    def encode(self, images_m: Tensor) -> Tensor:
        """Return the (B, PER_SECTOR, SECTORS) descriptors, in (-1, 1), of (B, ROWS, COLUMNS) images, metres."""
        return self._kept(self._features(images_m))

    def compare(self, spheres: Tensor, images_m: Tensor) -> Tensor:
        """Return (B, SECTORS) log-odds of change between (B, PER_SECTOR, SECTORS) descriptors and images."""
        features = self._features(images_m)
        other = self._kept(features)
        parts = [spheres, other, (spheres - other).abs()]
        if self.size.reads_after:
            parts.append(torch.relu(self.seen(features)[:, :, 0]))
        hidden = torch.cat(parts, dim=1)
        for layer in self.head:
            hidden = torch.relu(layer(nn.functional.pad(hidden, (1, 1), mode="circular")))
        logits: Tensor = self.logit(hidden)[:, 0] + _FIRST_LOGIT
        return logits

    def calibrate(self, logits: Tensor) -> Tensor:
        """Return the calibrated log-odds of a place from the log-odds of its most changed sector."""
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


def make_untrained_sphere_network(seed: int = 0, size: SphereSize | None = None) -> SphereNetwork:
    """Return a network with random weights from a seed; the global generator is not changed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return SphereNetwork(size).eval()


def load_sphere_network(content: bytes, source: str = "sphere.safetensors") -> SphereNetwork:
    """Return the network of a checkpoint; its size follows from the shapes of the weights.

    Raises:
        InputError: The checkpoint is damaged, of another format, or of another network.
    """
    sizes: list[SphereSize] = []

    def check(types: Mapping[str, ArrayType]) -> None:
        sizes.append(_size_of(types))
        with torch.device("meta"):  # a network without values: those of the file may be of any size
            check_types(types, list_weights(SphereNetwork(sizes[0])), {})

    tensors = parse_weights(content, source, check)
    network = SphereNetwork(sizes[0])
    network.load_state_dict(tensors)
    return network.eval()


def _size_of(types: Mapping[str, ArrayType]) -> SphereSize:
    """Return the size of the network that a checkpoint is of.

    Raises:
        ValueError: It is of none.
    """
    shape = types["kept.weight"].shape if "kept.weight" in types else ()
    if len(shape) != 4 or not 0 < shape[0] <= _MOST_PER_SECTOR or not 0 < shape[1] <= _MOST_CHANNELS:
        raise ValueError(f"kept.weight is {shape or 'missing'}: no sphere network has it")
    return SphereSize(shape[0], shape[1] / _CHANNELS[-1], "seen.weight" in types)


def load_trained_sphere_network() -> tuple[SphereNetwork, str]:
    """Return the shipped network and the digest of its checkpoint."""
    content = (resources.files("cdpipe") / "descriptors" / "weights" / "sphere.safetensors").read_bytes()
    return load_sphere_network(content), digest(content)


assert COLUMNS == SECTORS * 6 and ROWS % 4 == 0
