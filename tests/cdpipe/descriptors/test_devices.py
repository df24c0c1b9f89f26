"""A network computes where its weights lie; what it takes and gives lies in the processor's memory."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array
from cdpipe.descriptors import describe_scan
from cdpipe.descriptors.devices import compute, find_device
from cdpipe.descriptors.network import make_untrained_network
from cdpipe.model.config import DescriptorConfig
from cdpipe.model.types import PosedScan


def make_scan(points: Float64Array) -> PosedScan:
    n = len(points)
    return PosedScan(0, points, np.eye(4), np.zeros(n, np.int64), np.arange(n, dtype=np.int32))


def test_results_and_gradients_are_those_of_the_network() -> None:
    network = make_untrained_network()
    images = torch.rand(2, 32, 256, generator=torch.Generator().manual_seed(1)) * 20
    own, computed = network(images), compute(network, images)
    assert all(torch.equal(one, other) for one, other in zip(own, computed, strict=True))
    computed[0].sum().backward()
    assert all(weights.grad is not None for weights in network.layers.parameters())


def test_a_method_of_the_network_is_computed_as_well() -> None:
    network = torch.nn.Linear(3, 2)
    assert compute(network, torch.ones(3), by=lambda x: x + network.bias.sum()).shape == (3,)


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is there")
def test_a_gpu_that_is_not_there_is_refused() -> None:
    assert find_device("cpu") == torch.device("cpu")
    with pytest.raises(InputError, match="finds no GPU that it can use: take device cpu"):
        find_device("cuda")
    with pytest.raises(InputError, match="device cuda"):
        describe_scan(make_scan(np.ones((40, 3))), DescriptorConfig(device="cuda"))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_gpu_describes_nearly_the_same() -> None:
    points = np.random.default_rng(0).normal(size=(5000, 3)) * (8.0, 4.0, 1.5)
    scan = make_scan(points)
    for own, other in zip(
        describe_scan(scan, DescriptorConfig()), describe_scan(scan, DescriptorConfig(device="cuda")), strict=True
    ):
        np.testing.assert_allclose(own, other, atol=1e-4)
