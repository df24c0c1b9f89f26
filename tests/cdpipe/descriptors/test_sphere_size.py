"""Networks of other sizes than the shipped one, and that the shipped one stays what it is."""

from __future__ import annotations

import json
from importlib import resources

import pytest
import torch

from cdpipe.descriptors.sphere_image import COLUMNS, ROWS
from cdpipe.descriptors.sphere_network import (
    SECTORS,
    SphereSize,
    load_sphere_network,
    load_trained_sphere_network,
    make_untrained_sphere_network,
)
from cdpipe.descriptors.weights_file import checkpoint_bytes

SIZES = (SphereSize(), SphereSize(per_sector=1, width=0.5), SphereSize(per_sector=8, width=2.0, reads_after=False))


def _walls(seed: int) -> torch.Tensor:
    return 2 + 3 * torch.rand(3, ROWS, COLUMNS, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("size", SIZES)
def test_a_checkpoint_tells_how_large_its_network_is(size: SphereSize) -> None:
    network = make_untrained_sphere_network(4, size)
    loaded = load_sphere_network(checkpoint_bytes(network))
    assert loaded.size == size
    with torch.inference_mode():
        assert loaded.encode(_walls(0)).shape == (3, size.per_sector, SECTORS)
        assert loaded.encode(_walls(0)).numel() == 3 * size.numbers
        torch.testing.assert_close(loaded(_walls(0), _walls(1)), network(_walls(0), _walls(1)), rtol=0, atol=0)


def test_layers_are_as_wide_as_asked() -> None:
    half, shipped, twice = (make_untrained_sphere_network(0, SphereSize(width=width)) for width in (0.5, 1.0, 2.0))
    channels = [[conv.conv.out_channels for conv in network.trunk] for network in (half, shipped, twice)]
    assert channels == [[8, 16, 24], [16, 32, 48], [32, 64, 96]]
    # 3 x 4 of the stored numbers, which do not grow, and 64 seen, which do
    assert [network.head[0].in_channels for network in (half, shipped, twice)] == [12 + 32, 12 + 64, 12 + 128]


def test_the_shipped_network_has_the_default_size_and_the_weights_of_its_card() -> None:
    network, digest = load_trained_sphere_network()
    card = json.loads((resources.files("cdpipe") / "descriptors" / "weights" / "sphere.json").read_text())
    assert network.size == SphereSize() and digest == card["checkpoint"]
    assert sum(weight.numel() for weight in network.parameters()) == 85_157


@pytest.mark.parametrize("reads_after", [True, False])
def test_numbers_alone_say_nothing_of_what_they_do_not_hold(reads_after: bool) -> None:
    network = make_untrained_sphere_network(0, SphereSize(reads_after=reads_after))
    with torch.inference_mode():
        network.kept.weight.zero_()  # whatever stands there, the numbers are the same
        first, second = (network(_walls(0), _walls(after)) for after in (1, 2))
    assert torch.equal(first, second) != reads_after


@pytest.mark.parametrize("size", [{"per_sector": 0}, {"width": 0.0}, {"width": 0.7}])
def test_a_size_that_no_network_has(size: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="halves of the shipped width"):
        SphereSize(**size)
