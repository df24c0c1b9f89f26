"""The loader of training data, on a folder written here."""

import csv
import doctest
from pathlib import Path

import numpy as np
import pytest
import torch

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import yaw_pose
from cdpipe.training import data
from cdpipe.training.data import ChangePairs, open_dataset, read_place_data, stacked
from cdpipe.training.shard import FIELDS, encode_shard, read_about, read_shard, split_of

SEEDS = (0, 9999, 10000, 19999, 20000, 29999, 900000)
SIZES = {"K": 3, "J": 2, "C": 2, "D": 2, "R": 4, "W": 8, "V": 5, "U": 6, "I": 7}


def write_shard(path: Path, seed: int) -> None:
    """Write a shard of random content; of a size of its own for each tunnel."""
    rng = np.random.default_rng(seed)
    sizes = {**SIZES, "K": 3 + seed % 2}
    arrays = {}
    for field in FIELDS:
        shape = [sizes.get(axis) or int(axis) for axis in field.shape.split(",")]
        arrays[field.name] = rng.integers(0, 2, shape).astype(field.dtype)
    poses = [yaw_pose(0.1 * k, (k, 2.0, 0.0)) for k in range(sizes["K"])]
    arrays["before_world_T_keyframe"] = np.array(poses)
    arrays["after_world_T_keyframe"] = np.array(poses[: SIZES["J"]])
    path.write_bytes(encode_shard(arrays, {"family": "made", "seed": seed}))


@pytest.fixture(name="folder")
def folder_fixture(tmp_path: Path) -> Path:
    rows = []
    for seed in SEEDS:
        write_shard(tmp_path / f"made-{seed}.safetensors", seed)
        rows.append(
            {
                "family": "made",
                "seed": seed,
                "status": "ok",
                "shard": f"made-{seed}.safetensors",
                "n_before": 3 + seed % 2,
                "n_after": SIZES["J"],
            }
        )
    rows.append({"family": "made", "seed": 7, "status": "refused"})
    with (tmp_path / "index.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return tmp_path


def test_no_seed_crosses_splits(folder: Path) -> None:
    listed = {split: {tunnel.seed for tunnel in open_dataset(folder, split)} for split in ("train", "validation")}
    assert listed == {"train": {0, 9999}, "validation": {10000, 19999}}
    borders = {0: "train", 9999: "train", 10000: "validation", 19999: "validation", 20000: "test", 29999: "test"}
    assert {seed: split_of(seed) for seed in borders} == borders
    assert split_of(30000) == split_of(899999) == "test" and split_of(900000) == "unused"


@pytest.mark.parametrize("split", ["test", "unused", "all", ""])
def test_what_is_no_training_split_is_refused(folder: Path, split: str) -> None:
    with pytest.raises(InputError, match='expected "train" or "validation"'):
        open_dataset(folder, split)


@pytest.mark.parametrize(
    ("split", "seed"), [("train", 10000), ("validation", 9999), ("train", 20000), ("train", 900000)]
)
def test_a_seed_of_another_split_cannot_be_asked_for(folder: Path, split: str, seed: int) -> None:
    with pytest.raises(InputError, match=f"seed {seed} is of the split"):
        open_dataset(folder, split, seeds=[seed])


def test_families_and_seeds_choose(folder: Path) -> None:
    assert [tunnel.seed for tunnel in open_dataset(folder, "train", seeds=[9999], families=["made"])] == [9999]
    for chosen in ({"families": ["cave"]}, {"seeds": [1]}):
        with pytest.raises(InputError, match="holds no such tunnel of the split train"):
            open_dataset(folder, "train", **chosen)
    with pytest.raises(InputError, match=r"index\.csv: missing"):
        open_dataset(folder / "elsewhere", "train")


@pytest.mark.parametrize("draws", [None, [1]])
def test_every_pair_comes_once_and_is_that_of_its_shard(folder: Path, draws: list[int] | None) -> None:
    tunnels = open_dataset(folder, "train")
    pairs = ChangePairs(tunnels, draws=draws)
    assert len(pairs) == (3 + 4) * (2 if draws is None else 1)
    found = set()
    for index in range(len(pairs)):
        pair = pairs[index]
        arrays, _ = read_shard(folder / f"made-{pair['seed']}.safetensors")
        draw, anchor = pair["draw"], pair["anchor"]
        np.testing.assert_array_equal(pair["before_image"], arrays["before_images"][anchor])
        np.testing.assert_array_equal(pair["after_image"], arrays["after_images"][draw, anchor])
        np.testing.assert_array_equal(pair["after_labels"], arrays["after_labels"][draw, anchor])
        assert pair["label"] == arrays["labels"][anchor] and pair["is_covered"] == arrays["is_covered"][anchor]
        found.add((pair["seed"], draw, anchor))
    assert len(found) == len(pairs)
    with pytest.raises(IndexError):
        pairs[len(pairs)]


def test_a_torch_loader_takes_the_pairs(folder: Path) -> None:
    pairs = ChangePairs(open_dataset(folder, "train"))
    batches = list(torch.utils.data.DataLoader(pairs, batch_size=4))
    assert sum(len(batch["label"]) for batch in batches) == len(pairs)
    assert batches[0]["after_image"].shape == (4, SIZES["I"])


def test_stacked_rows_are_those_of_the_shards(folder: Path) -> None:
    tunnels = open_dataset(folder, "train")
    tensors = stacked(tunnels, ("before_images", "after_images", "labels"))
    assert tensors["tunnel"].tolist() == [0] * 3 + [1] * 4
    assert tensors["after_images"].shape == (7, SIZES["D"], SIZES["I"])
    last, _ = read_shard(tunnels[1].path)
    np.testing.assert_array_equal(tensors["after_images"][-1, 1], last["after_images"][1, -1])
    np.testing.assert_array_equal(tensors["labels"][3:], last["labels"])
    assert stacked(tunnels, ("after_ranges_m",))["after_ranges_m"].dtype == torch.float16


@pytest.mark.parametrize(
    ("names", "told"),
    [
        (("labels", "after_ranges_m"), "not of both"),
        (("before_visible",), "tunnels differ in their changes"),
        (("draw_shift_m",), "read it shard by shard"),
        (("label",), "label: no array of a shard"),
    ],
)
def test_what_cannot_be_stacked_is_refused(folder: Path, names: tuple[str, ...], told: str) -> None:
    with pytest.raises(InputError, match=told):
        stacked(open_dataset(folder, "train"), names)


def test_places_are_the_scans_of_both_sessions(folder: Path) -> None:
    places = read_place_data(open_dataset(folder, "train"))
    assert places.sessions.tolist() == [0, 0, 0, 1, 1, 0, 0, 0, 0, 1, 1]
    assert places.tunnels.tolist() == [0] * 5 + [1] * 6
    np.testing.assert_allclose(places.headings_rad[:3], [0.0, 0.1, 0.2])
    np.testing.assert_allclose(places.positions[2], [2.0, 2.0, 0.0])


def test_a_damaged_shard_is_told(folder: Path) -> None:
    path = folder / "made-0.safetensors"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match="damaged"):
        read_about(path)
    path.unlink()
    with pytest.raises(InputError, match=r"missing: .*run the command that made the folder"):
        ChangePairs(open_dataset(folder, "train"))


def test_the_examples_of_the_docstring_run(folder: Path) -> None:
    result = doctest.testmod(data, extraglobs={"folder": folder})
    assert result.attempted >= 5 and result.failed == 0
