"""Weights of one's own: `descriptor.weights`, `sphere.weights` and `range_net.weights` name files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from safetensors.torch import save
from torch import nn

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import make_pose
from cdpipe.descriptors import (
    checkpoint_digest,
    describe_map,
    describe_scan,
    list_checkpoints,
    range_net_digest,
    sphere_digest,
)
from cdpipe.descriptors.change_network import make_untrained_change_network
from cdpipe.descriptors.describe import require_weights_are_read
from cdpipe.descriptors.network import make_untrained_network
from cdpipe.descriptors.sphere_network import SphereSize, make_untrained_sphere_network
from cdpipe.descriptors.weights_file import digest, numbered_checkpoint_bytes
from cdpipe.model.config import DescriptorConfig, PipelineConfig, RangeNetConfig, RegionsConfig, SphereConfig
from cdpipe.model.types import PointMap, PosedScan
from cdpipe.pipeline import describe, detect

Digest = Callable[[str], str]


def digest_of_scans(path: str) -> str:
    return checkpoint_digest(DescriptorConfig(weights=path))


def digest_of_spheres(path: str) -> str:
    return sphere_digest(SphereConfig(weights=path))


def digest_of_range_net(path: str) -> str:
    return range_net_digest(RangeNetConfig(weights=path))


def write(path: Path, network: nn.Module) -> str:
    path.write_bytes(numbered_checkpoint_bytes(network))
    return str(path)


def make_scan() -> PosedScan:
    points = np.random.default_rng(0).normal(size=(500, 3)) * 5
    return PosedScan(0, points, np.eye(4), np.zeros(500, np.int64), np.arange(500, dtype=np.int32))


def make_map() -> PointMap:
    points = np.random.default_rng(1).uniform(-3, 3, (4000, 3))
    none = np.zeros(0, np.int32)
    poses = np.eye(4)[None]
    nearest_m = np.ones(len(points), np.float32)
    return PointMap(points, nearest_m, 0.2, poses, np.zeros(1, np.int64), none, none, np.zeros(2, np.int64))


def test_a_scan_is_described_with_the_weights_of_the_file(tmp_path: Path) -> None:
    network = make_untrained_network()
    config = DescriptorConfig(weights=write(tmp_path / "mine.safetensors", network))
    found = describe_scan(make_scan(), config)
    # the preset `untrained` has the same numbers under another name
    for mine, known in zip(found, describe_scan(make_scan(), DescriptorConfig(method="untrained")), strict=True):
        np.testing.assert_array_equal(mine, known)
    assert not np.allclose(found[0], describe_scan(make_scan(), DescriptorConfig())[0])
    assert checkpoint_digest(config) == digest(numbered_checkpoint_bytes(network))
    assert checkpoint_digest(config) != checkpoint_digest(DescriptorConfig())


@pytest.mark.parametrize("size", [SphereSize(), SphereSize(per_sector=2, width=0.5)])
def test_a_map_is_described_with_the_weights_of_the_file(tmp_path: Path, size: SphereSize) -> None:
    network = make_untrained_sphere_network(3, size)
    sphere = SphereConfig(weights=write(tmp_path / "mine.safetensors", network))
    anchor = make_pose(translation=(0.0, 0.0, 0.0))[None]
    found = describe_map(make_map(), anchor, DescriptorConfig(), sphere)
    assert found.shape == (1, size.numbers)
    others = [SphereConfig(weights=write(tmp_path / "other.safetensors", make_untrained_sphere_network(4, size)))]
    if size == SphereSize():  # that of the shipped weights
        others.append(SphereConfig())
    for other in others:
        assert not np.allclose(found, describe_map(make_map(), anchor, DescriptorConfig(), other))


def test_a_file_that_changes_is_read_anew(tmp_path: Path) -> None:
    path = write(tmp_path / "mine.safetensors", make_untrained_sphere_network(1))
    first = sphere_digest(SphereConfig(weights=path))
    write(tmp_path / "mine.safetensors", make_untrained_sphere_network(2))
    assert sphere_digest(SphereConfig(weights=path)) != first


def test_checkpoints_are_those_that_a_method_uses(tmp_path: Path) -> None:
    shipped = PipelineConfig(regions=RegionsConfig(source="sphere"))
    assert list_checkpoints(shipped) == {"3deg": checkpoint_digest(DescriptorConfig()), "sphere": sphere_digest()}
    mine = SphereConfig(weights=write(tmp_path / "mine.safetensors", make_untrained_sphere_network(1)))
    assert list_checkpoints(shipped.model_copy(update={"sphere": mine}))["sphere"] == sphere_digest(mine)
    network = make_untrained_change_network(1)
    rival = RangeNetConfig(weights=write(tmp_path / "rival.safetensors", network))
    found = list_checkpoints(PipelineConfig(regions=RegionsConfig(source="range-net"), range_net=rival))
    assert found["range-net"] == digest(numbered_checkpoint_bytes(network)) and "sphere" not in found
    # the paper compares scans; a hand-made descriptor has no file
    assert list(list_checkpoints(PipelineConfig(sphere=mine))) == ["3deg"]
    with pytest.raises(
        InputError,
        match=r"^sphere\.weights = .*: regions\.source = scan does not read .*, or set regions\.source=sphere$",
    ):
        detect("before", "after", "paper", {"sphere.weights": mine.weights})
    with pytest.raises(
        InputError,
        match=r"^range_net\.weights = a: .* = sphere does not read .*, or set regions\.source=range-net$",
    ):
        describe("before", settings={"range_net.weights": "a"})
    # a plugin's source may
    require_weights_are_read(PipelineConfig(regions=RegionsConfig.model_construct(source="own"), sphere=mine))
    by_hand = PipelineConfig(descriptor=DescriptorConfig(method="solid"))
    assert list_checkpoints(by_hand)["solid"].startswith("version")
    with pytest.raises(ValidationError, match=r"descriptor\.method = solid has no weights of its own: expected 3deg"):
        DescriptorConfig(method="solid", weights="none.safetensors")


@pytest.mark.parametrize("find", [digest_of_scans, digest_of_spheres, digest_of_range_net])
def test_files_that_hold_no_such_weights_are_one_line(tmp_path: Path, find: Digest) -> None:
    path = tmp_path / "mine.safetensors"
    networks = {
        digest_of_scans: make_untrained_network(),
        digest_of_spheres: make_untrained_sphere_network(),
        digest_of_range_net: make_untrained_change_network(),
    }
    own = networks.pop(find)
    other = next(iter(networks.values()))
    tensors = {name: tensor.clone() for name, tensor in own.state_dict().items()}
    first = next(name for name in tensors if name.endswith("conv.weight"))

    def changed(tensor: torch.Tensor) -> bytes:
        return save({**tensors, first: tensor.contiguous()})

    nowhere = tensors[first].clone()
    nowhere.view(-1)[0] = float("nan")
    contents = {
        "weights of another network": numbered_checkpoint_bytes(other),
        f"{first} must be": changed(tensors[first][:, :, :1]),
        f"{first} holds numbers that are not finite": changed(nowhere),
        "its table is said to be": b'{"descriptor": "a model card"}',
        f"{first} must be float32": changed(tensors[first].double()),
    }
    for told, content in contents.items():
        path.write_bytes(content)
        with pytest.raises(InputError, match=told) as caught:
            find(str(path))
        assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)
    path.unlink()
    with pytest.raises(InputError, match=r"mine\.safetensors: missing: expected weights as `tunnelcd train`"):
        find(str(path))
    with pytest.raises(InputError, match="it is a folder"):
        find(str(tmp_path))
