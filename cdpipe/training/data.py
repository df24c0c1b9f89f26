"""Load the training data that `tunnelcd dataset` makes, by split; test seeds are refused.

>>> tunnels = open_dataset(folder, "train")
>>> pairs = ChangePairs(tunnels)
>>> pair = pairs[0]
>>> pair["before_image"].shape == pair["after_image"].shape, pair["label"] in (-1, 0, 1)
(True, True)
>>> tensors = stacked(tunnels, ("before_images", "after_images", "labels"))
>>> len(tensors["labels"]) == len(tensors["tunnel"]) == sum(tunnel.n_before for tunnel in tunnels)
True
"""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cdpipe.core.errors import InputError
from cdpipe.core.files import read_bytes
from cdpipe.core.geometry import yaw_rad
from cdpipe.training.scan_training import PlaceData
from cdpipe.training.shard import FIELDS, read_shard, split_of

_SPLITS = ("train", "validation")
_MOST_INDEX_BYTES = 50_000_000
_MOST_KEYFRAMES = 1_000_000  # of one session
_PER_PAIR = ("before_images", "after_images", "before_labels", "after_labels", "labels", "is_covered")


@dataclass(frozen=True, slots=True)
class TunnelShard:
    """One tunnel in the index of a dataset.

    Attributes:
        path: The shard.
        family: Scenario family.
        seed: Seed of the tunnel.
        n_before: Number of before keyframes, the anchors.
        n_after: Number of after keyframes.
    """

    path: Path
    family: str
    seed: int
    n_before: int
    n_after: int


def open_dataset(
    folder: str | Path,
    split: str,
    *,
    families: Collection[str] | None = None,
    seeds: Collection[int] | None = None,
) -> list[TunnelShard]:
    """List the tunnels of a folder that belong to a split, by family and seed.

    Args:
        folder: Made by `tunnelcd dataset`.
        split: "train" (seeds below 10000) or "validation" (10000 to 19999).
        families: Only these families.
        seeds: Only these seeds; all must be of the split.

    Raises:
        InputError: The folder has no index, the split is unknown, a seed is of another split, or no tunnel remains.
    """
    if split not in _SPLITS:
        raise InputError(f'split "{split}": expected "train" or "validation"; test seeds are for scoring, by plans')
    for seed in seeds or ():
        if split_of(seed) != split:
            raise InputError(f"seed {seed} is of the split {split_of(seed)}, not of {split}")
    chosen = [
        tunnel
        for tunnel in _read_index(Path(folder))
        if split_of(tunnel.seed) == split
        and (families is None or tunnel.family in families)
        and (seeds is None or tunnel.seed in seeds)
    ]
    if not chosen:
        raise InputError(f"{folder}: holds no such tunnel of the split {split}: make some with `tunnelcd dataset`")
    return chosen


class ChangePairs(torch.utils.data.Dataset[dict[str, Any]]):
    """Every anchor of the given tunnels with its after image, once per draw of the merge error.

    An item has `before_image`, `after_image`, `before_labels`, `after_labels` (tensors), `label`, `is_covered`,
    `family`, `seed`, `draw` and `anchor`. The tunnel read last is kept, so that a sampler that goes tunnel by tunnel
    reads each once; for batches across all of them `stacked` holds everything in memory.
    """

    def __init__(self, tunnels: Sequence[TunnelShard], *, draws: Sequence[int] | None = None) -> None:
        """Open the tunnels; `draws` defaults to all draws (draw 0 is the exact merge)."""
        if not tunnels:
            raise ValueError("tunnels is empty")
        self._tunnels = list(tunnels)
        n_draws = len(read_shard(tunnels[0].path, ("draw_shift_m",))[0]["draw_shift_m"])
        self._draws = list(range(n_draws)) if draws is None else list(draws)
        if not self._draws or min(self._draws) < 0 or max(self._draws) >= n_draws:
            raise ValueError(f"draws must be some of 0 to {n_draws - 1}, got {self._draws}")
        self._ends = np.cumsum([len(self._draws) * tunnel.n_before for tunnel in self._tunnels])
        self._held: tuple[int, dict[str, Any]] = (-1, {})

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __getitem__(self, index: int) -> dict[str, Any]:
        """Return one pair."""
        if not 0 <= index < len(self):
            raise IndexError(f"pair {index} of {len(self)}")
        place = int(np.searchsorted(self._ends, index, side="right"))
        tunnel = self._tunnels[place]
        before_it = int(self._ends[place - 1]) if place else 0
        nth_draw, anchor = divmod(index - before_it, tunnel.n_before)
        draw = self._draws[nth_draw]
        if self._held[0] != place:
            self._held = place, read_shard(tunnel.path, _PER_PAIR)[0]
        arrays = self._held[1]
        return {
            "before_image": torch.from_numpy(arrays["before_images"][anchor]),
            "after_image": torch.from_numpy(arrays["after_images"][draw, anchor]),
            "before_labels": torch.from_numpy(arrays["before_labels"][anchor]),
            "after_labels": torch.from_numpy(arrays["after_labels"][draw, anchor]),
            "label": int(arrays["labels"][anchor]),
            "is_covered": bool(arrays["is_covered"][anchor]),
            "family": tunnel.family,
            "seed": tunnel.seed,
            "draw": draw,
            "anchor": anchor,
        }


def stacked(tunnels: Sequence[TunnelShard], names: Sequence[str]) -> dict[str, Tensor]:
    """Concatenate arrays of all tunnels in memory.

    Args:
        tunnels: The shards.
        names: Arrays of a shard, all per before keyframe or all per after keyframe. Arrays with draws become
            (N, D, ...).

    Returns:
        A tensor for each name, and `tunnel` (N,) int64: the index into `tunnels` of each row.

    Raises:
        InputError: A name is no array of a shard or is per change, or the names mix both sessions.
    """
    axes = {name: _keyframe_axis(name) for name in names}
    if len({letter for letter, _ in axes.values()}) != 1:
        raise InputError(
            f"{', '.join(names)}: name arrays of the before keyframes or of the after keyframes, not of both"
        )
    parts: dict[str, list[Tensor]] = {name: [] for name in ("tunnel", *names)}
    for place, tunnel in enumerate(tunnels):
        arrays, _ = read_shard(tunnel.path, tuple(names))
        for name, (_, axis) in axes.items():
            parts[name].append(torch.from_numpy(np.ascontiguousarray(np.moveaxis(arrays[name], axis, 0))))
        parts["tunnel"].append(torch.full((len(parts[names[0]][-1]),), place, dtype=torch.int64))
    return {name: torch.cat(tensors) for name, tensors in parts.items()}


def read_place_data(tunnels: Sequence[TunnelShard]) -> PlaceData:
    """Read the scans of both sessions for the training of the scan descriptor.

    Of a tunnel with several after sessions only the first shard is read: its places must not count as other ones.
    """
    columns: dict[str, list[Any]] = {name: [] for name in PlaceData.__dataclass_fields__}
    first = {(tunnel.family, tunnel.seed): tunnel for tunnel in reversed(tunnels)}
    kept = [tunnel for tunnel in tunnels if first[tunnel.family, tunnel.seed] is tunnel]
    for place, tunnel in enumerate(kept):
        for number, session in enumerate(("before", "after")):
            names = f"{session}_ranges_m", f"{session}_world_T_keyframe"
            arrays, _ = read_shard(tunnel.path, names)
            images, poses = (arrays[name] for name in names)
            columns["images_m"].append(images)
            columns["positions"].append(poses[:, :3, 3])
            columns["headings_rad"].append(np.array([yaw_rad(pose) for pose in poses]))
            columns["tunnels"].append(np.full(len(poses), place))
            columns["sessions"].append(np.full(len(poses), number))
    return PlaceData(**{name: np.concatenate(parts) for name, parts in columns.items()})


def _keyframe_axis(name: str) -> tuple[str, int]:
    """Return the kind of keyframes of an array, K (before) or J (after), and their axis."""
    shapes = {field.name: field.shape.split(",") for field in FIELDS}
    if name not in shapes:
        raise InputError(f"{name}: no array of a shard: expected some of {', '.join(shapes)}")
    axes = shapes[name]
    found = next(((letter, axes.index(letter)) for letter in ("K", "J") if letter in axes and "C" not in axes), None)
    if found is None:
        raise InputError(f"{name} is ({', '.join(axes)}): tunnels differ in their changes; read it shard by shard")
    return found


def _tunnel(folder: Path, row: Mapping[str, str]) -> TunnelShard:
    shard, n_before, n_after = row["shard"], int(row["n_before"]), int(row["n_after"])
    if Path(shard).name != shard:
        raise ValueError(f"shard = {shard[:40]!r} is no name of a file in the folder")
    if not 0 < n_before <= _MOST_KEYFRAMES or not 0 < n_after <= _MOST_KEYFRAMES:
        raise ValueError(f"{row['n_before'][:20]} and {row['n_after'][:20]} keyframes in {shard}")
    return TunnelShard(folder / shard, row["family"], int(row["seed"]), n_before, n_after)


def _read_index(folder: Path) -> list[TunnelShard]:
    path = folder / "index.csv"
    content = read_bytes(path, _MOST_INDEX_BYTES, "expected a folder made by `tunnelcd dataset`")
    try:
        rows = csv.DictReader(io.StringIO(content.decode(), newline=""))
        return [_tunnel(folder, row) for row in rows if row.get("status") == "ok"]
    except (AttributeError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise InputError(f"{path}: damaged ({error}): run the command that made the folder again") from error
