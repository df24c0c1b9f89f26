from __future__ import annotations

from pathlib import Path

import pytest
import torch

from cdpipe.core.errors import InputError
from cdpipe.descriptors import change_network
from cdpipe.descriptors.change_network import (
    load_change_network,
    load_trained_change_network,
    make_untrained_change_network,
)
from cdpipe.descriptors.sphere_image import COLUMNS, ROWS
from cdpipe.descriptors.weights_file import numbered_checkpoint_bytes


def draw_images(n: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    draw = torch.Generator().manual_seed(seed)
    own, other = (2.0 + 3.0 * torch.rand(n, ROWS, COLUMNS, generator=draw) for _ in range(2))
    other[:, :, ::7] = 0.0
    return own, other


def test_what_is_written_is_what_is_loaded() -> None:
    network = make_untrained_change_network(3)
    own, other = draw_images(2)
    with torch.inference_mode():
        expected = network(own, other)
        found = load_change_network(numbered_checkpoint_bytes(network))(own, other)
        of_another = make_untrained_change_network(4)(own, other)
    for head, loaded, different in zip(expected, found, of_another, strict=True):
        assert head.shape == (2, ROWS, COLUMNS)
        torch.testing.assert_close(head, loaded, rtol=0, atol=0)
        assert not torch.allclose(head, different)


def test_the_wall_has_no_seam() -> None:
    # turned by the width of a pixel of the coarsest level, the tunnel gives the same numbers, turned
    network = make_untrained_change_network(1)
    own, other = draw_images(1)
    with torch.inference_mode():
        straight, turned = network(own, other), network(own.roll(4, 2), other.roll(4, 2))
    for before, after in zip(straight, turned, strict=True):
        torch.testing.assert_close(before.roll(4, 2), after, rtol=0, atol=1e-5)
        assert not torch.allclose(before, after, atol=1e-3)


def test_the_images_are_told_apart_and_a_pixel_without_a_point_is_not_a_near_one() -> None:
    network = make_untrained_change_network(2)
    own, other = draw_images(1)
    with torch.inference_mode():
        change, _ = network(own, other)
        swapped, _ = network(other, own)
        near, _ = network(own, torch.where(other == 0, 0.01, other))
    assert not torch.allclose(change, swapped, atol=1e-3)
    assert not torch.allclose(change, near, atol=1e-3)


@pytest.mark.parametrize("n", [1, 32])
def test_one_number_of_threads_gives_the_same_bits_and_another_nearly(n: int) -> None:
    network = make_untrained_change_network(5)
    own, other = draw_images(n)
    usual = torch.get_num_threads()
    found = []
    try:
        for threads in (1, 2, 1):
            torch.set_num_threads(threads)
            with torch.inference_mode():
                found.append(torch.stack(network(own, other)))
    finally:
        torch.set_num_threads(usual)
    assert found[0].numpy().tobytes() == found[2].numpy().tobytes()
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=1e-5)


def test_an_installation_without_the_weights_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(change_network.resources, "files", lambda package: tmp_path)
    with pytest.raises(
        InputError, match=r"^range-net\.safetensors: the shipped weights are missing: .*range_net.weights$"
    ):
        load_trained_change_network()
