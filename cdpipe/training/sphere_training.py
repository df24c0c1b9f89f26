"""Training of the sphere descriptor: classify the changed sectors of keyframes, on simulated changes.

A batch holds as many changed as unchanged keyframes. Into half of the unchanged images an object of another tunnel is
pasted in front of the surface. Augmentation swaps the sessions, reverses the heading, mirrors the tunnel, scales it,
and draws a merge error for every image.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.optimize import minimize
from torch import Tensor
from torch.nn import functional

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, stream
from cdpipe.core.ranking import auroc
from cdpipe.descriptors.devices import compute
from cdpipe.descriptors.sphere import average_neighbours, max_within_reach
from cdpipe.descriptors.sphere_image import COLUMNS, REACH_M, ROWS
from cdpipe.descriptors.sphere_network import SECTORS, SphereNetwork
from cdpipe.training.data import TunnelShard
from cdpipe.training.shard import read_shard

BATCH = 64
# Rows that decide a keyframe's targets: 1 m before and behind it, so neighbours overlap.
_OWN_ROWS = slice(ROWS // 4, ROWS - ROWS // 4)
_MIN_PIXELS = 3
_POSITIVE_WEIGHT = 3.0
_PLACE_WEIGHT = 0.5
_PASTED_SHARE = 0.25
PASTED_SHIFT_ROWS = 3
# A pasted pixel counts as changed if it is this much in front of the surface; it is pasted from _IN_FRONT_M on.
_STANDS_OUT_M = 0.15
_IN_FRONT_M = 0.05
# Largest logarithm of the scale factor, and largest share of missing pixels.
_LOG_SCALE = float(np.log(1.6))
_MAX_MISSING = 0.3
CHANGED, UNCOUNTED = 1, 2


@dataclass(frozen=True, slots=True, eq=False)
class SphereData:
    """N before keyframes that the after session came near, with D merge errors each.

    Attributes:
        before_m: (N, ROWS, COLUMNS) float32 images of the before maps, metres.
        after_m: (N, D, ROWS, COLUMNS) float32 images of the after maps, metres.
        before_marks: (N, ROWS, COLUMNS) uint8: 0 unchanged, 1 observable change, 2 unobservable change.
        after_marks: (N, D, ROWS, COLUMNS) uint8, as `before_marks`.
        positions: (N, 3) float64 keyframe positions, world frame, metres.
        labels: (N,) int64: 1 near an observable change, 0 far from all changes, -1 left out.
        tunnels: (N,) int64 number of the tunnel.
        score_radius_m: (N,) float64 score radius of the family, metres.
    """

    before_m: Tensor
    after_m: Tensor
    before_marks: Tensor
    after_marks: Tensor
    positions: Float64Array
    labels: Int64Array
    tunnels: Int64Array
    score_radius_m: Float64Array

    @property
    def n_draws(self) -> int:
        """Number of merge errors of each keyframe."""
        return int(self.after_m.shape[1])


def read_sphere_data(tunnels: Sequence[TunnelShard]) -> SphereData:
    """Read the images and labels of some tunnels into memory.

    Raises:
        InputError: A shard is missing or damaged, or no keyframe of any tunnel is covered.
    """
    names = (
        "before_images", "after_images", "before_labels", "after_labels", "is_covered", "labels",
        "before_world_T_keyframe", "change_ids", "change_is_observable",
    )  # fmt: skip
    parts: dict[str, list[npt.NDArray[Any]]] = {name: [] for name in SphereData.__dataclass_fields__}
    for place, tunnel in enumerate(tunnels):
        arrays, about = read_shard(tunnel.path, names)
        covered = arrays["is_covered"]
        if not ((ids := arrays["change_ids"]) > 0).all() or (ids > 255).any():
            raise InputError(f"{tunnel.path}: damaged: change_ids are 1 to 255: make the dataset again")
        radius_m = about.get("score_radius_m")
        if not isinstance(radius_m, int | float) or not 0 < radius_m < np.inf:
            raise InputError(f"{tunnel.path}: damaged: score_radius_m = {radius_m!r:.40}: make the dataset again")
        marks = np.zeros(256, np.uint8)
        marks[arrays["change_ids"]] = np.where(arrays["change_is_observable"], CHANGED, UNCOUNTED)
        parts["before_m"].append(arrays["before_images"][covered])
        parts["after_m"].append(np.moveaxis(arrays["after_images"], 0, 1)[covered])
        parts["before_marks"].append(marks[arrays["before_labels"][covered]])
        parts["after_marks"].append(marks[np.moveaxis(arrays["after_labels"], 0, 1)[covered]])
        parts["positions"].append(arrays["before_world_T_keyframe"][covered, :3, 3])
        parts["labels"].append(arrays["labels"][covered])
        parts["tunnels"].append(np.full(covered.sum(), place))
        parts["score_radius_m"].append(np.full(covered.sum(), radius_m))
    joined = {name: np.concatenate(arrays) for name, arrays in parts.items()}
    if len(joined["labels"]) == 0:
        raise InputError("no keyframe of these tunnels was seen by both sessions: make a larger dataset")
    return SphereData(
        before_m=torch.from_numpy(joined["before_m"]),
        after_m=torch.from_numpy(joined["after_m"]),
        before_marks=torch.from_numpy(joined["before_marks"]),
        after_marks=torch.from_numpy(joined["after_marks"]),
        positions=joined["positions"],
        labels=joined["labels"].astype(np.int64),
        tunnels=joined["tunnels"],
        score_radius_m=joined["score_radius_m"],
    )


def sector_targets(before_marks: Tensor, after_marks: Tensor) -> Tensor:
    """Return (..., SECTORS) float32 targets of (..., ROWS, COLUMNS) marks: 1 changed, 0 unchanged, -1 ignored.

    A sector is changed if at least three pixels of the keyframe's own rows, both images together, have an observable
    change. It is ignored if it has fewer, or only unobservable changes.
    """
    changed = _per_sector((before_marks == CHANGED).float() + (after_marks == CHANGED).float())
    uncounted = _per_sector((before_marks == UNCOUNTED).float() + (after_marks == UNCOUNTED).float())
    is_changed, is_untouched = changed >= _MIN_PIXELS, changed + uncounted == 0
    return torch.where(is_changed, 1.0, torch.where(is_untouched, 0.0, -1.0))


class SphereTask:
    """Trains a sphere network, `network`, on some tunnels and scores it on others."""

    def __init__(self, network: SphereNetwork, training: SphereData, validation: SphereData, seed: int) -> None:
        self.network, self._data, self._validation, self._seed = network, training, validation, seed
        targets = sector_targets(training.before_marks, training.after_marks[:, 0])
        self._changed = torch.nonzero((targets == 1).any(dim=1))[:, 0].numpy()
        self._unchanged = torch.nonzero((targets == 0).all(dim=1))[:, 0].numpy()
        self._donors = find_donors(training)
        if not len(self._donors) or not len(self._changed) or not len(self._unchanged):
            raise InputError("training needs keyframes with an object added and keyframes without: make more tunnels")
        if not {0, 1} <= set(validation.labels.tolist()):
            raise InputError(
                "validation needs keyframes near a change and keyframes far from all: make more validation tunnels"
            )

    def losses(self, step: int) -> dict[str, Tensor]:
        """Return the classification loss of the sectors and that of the keyframes.

        A keyframe of which some sectors are ignored and no sector is changed is ignored, too: it is not unchanged.
        """
        before, after, targets = self.batch(step)
        logits = compute(self.network, before, after)
        is_known = targets >= 0
        weight = torch.tensor(_POSITIVE_WEIGHT)
        each = functional.binary_cross_entropy_with_logits(
            logits, targets.clamp(min=0), reduction="none", pos_weight=weight
        )
        has_changed = (targets == 1).any(dim=1)
        is_told = has_changed | is_known.all(dim=1)
        of_place = functional.binary_cross_entropy_with_logits(
            logits.logsumexp(dim=1)[is_told], has_changed[is_told].float()
        )
        return {"sector": (each * is_known).sum() / is_known.sum(), "keyframe": _PLACE_WEIGHT * of_place}

    def batch(self, step: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return the images (B, ROWS, COLUMNS) of both sessions and the targets (B, SECTORS) of a step."""
        data, draw = self._data, stream(self._seed, "train-sphere", str(step))
        half = BATCH // 2
        chosen = np.concatenate([draw.choice(self._changed, half), draw.choice(self._unchanged, half)])
        errors = draw.integers(data.n_draws, size=BATCH)
        before, after = data.before_m[chosen].clone(), data.after_m[chosen, errors].clone()
        targets = sector_targets(data.before_marks[chosen], data.after_marks[chosen, errors])
        pasted = slice(half, half + int(_PASTED_SHARE * BATCH))
        donors = draw.choice(self._donors, pasted.stop - pasted.start)
        shifts = draw.integers(-PASTED_SHIFT_ROWS, PASTED_SHIFT_ROWS, len(donors), endpoint=True)
        after[pasted], marks = paste_objects(after[pasted], data, donors, shifts)
        targets[pasted] = sector_targets(torch.zeros_like(marks), marks)
        before, after = augment(before, after, draw)
        if draw.random() < 0.5:
            before, after = after, before
        if draw.random() < 0.5:  # reversed heading
            before, after = before.flip(1), after.flip(1)
        if draw.random() < 0.5:  # mirrored tunnel: column c moves to COLUMNS / 2 - 1 - c
            before, after = (image.flip(2).roll(COLUMNS // 2, 2) for image in (before, after))
            targets = targets.flip(1).roll(SECTORS // 2, 1)
        return before, after, targets

    def scores(self) -> dict[str, float]:
        """Return the calibrated log-likelihood of the keyframe labels and their AUROC, both with a merge error.

        The log-likelihood selects the weights, because the AUROC saturates at 1.
        """
        data = self._validation
        pooled = pooled_scores(self.network, data, draw=min(1, data.n_draws - 1))
        used = data.labels >= 0
        is_changed = data.labels == 1
        of_tunnels = [used & (data.tunnels == tunnel) for tunnel in np.unique(data.tunnels)]
        return {
            "log_likelihood": fit_platt(pooled[used], is_changed[used])[2],
            "auroc": float(np.nanmean([auroc(pooled[mask], is_changed[mask]) for mask in of_tunnels])),
            "auroc_pooled": auroc(pooled[used], is_changed[used]),
        }

    def finish(self) -> dict[str, float]:
        """Calibrate the log-odds on the validation tunnels (Platt); return slope, offset and Brier score.

        The slope is 0 where the network ranks no better than chance.
        """
        data = self._validation
        used = data.labels >= 0
        pooled = pooled_scores(self.network, data, draw=min(1, data.n_draws - 1))[used]
        slope, offset, _ = fit_platt(pooled, data.labels[used] == 1)
        self.network.calibration.copy_(torch.tensor([slope, offset], dtype=torch.float64))
        found = torch.sigmoid(self.network.calibrate(torch.from_numpy(pooled))).numpy()
        return {"slope": slope, "offset": offset, "brier": float(np.mean((found - data.labels[used]) ** 2))}


def fit_platt(scores: Float64Array, is_positive: BoolArray) -> tuple[float, float, float]:
    """Return slope, offset and mean log-likelihood of the logistic curve that fits (N,) scores best.

    The curve never falls: scores that rank the wrong way round get slope 0. The targets are those of Platt (1999),
    (n + 1) / (n + 2) and 1 / (n + 2), so separable classes have a finite slope.
    """
    n_positive = int(np.count_nonzero(is_positive))
    n_negative = len(is_positive) - n_positive
    target = np.where(is_positive, (n_positive + 1) / (n_positive + 2), 1 / (n_negative + 2))

    def loss(parameters: Float64Array) -> float:
        logits = parameters[0] * scores + parameters[1]
        return float(np.mean(target * np.logaddexp(0.0, -logits) + (1 - target) * np.logaddexp(0.0, logits)))

    found = minimize(loss, np.array([1.0, 0.0]), method="Nelder-Mead", bounds=((0.0, None), (None, None)))
    return float(found.x[0]), float(found.x[1]), -float(found.fun)


def pooled_scores(network: SphereNetwork, data: SphereData, draw: int) -> Float64Array:
    """Return the (N,) maximum log-odds within the score radius of each keyframe, as the query pools them."""
    return pool_within_reach(local_scores(network, data, draw), data)


def local_scores(
    network: SphereNetwork, data: SphereData, draw: int, stored: Callable[[Tensor], Tensor] | None = None
) -> Float64Array:
    """Return the (N,) maximum log-odds over the sectors of each keyframe, averaged with its neighbours.

    Args:
        network: Encodes and compares.
        data: Keyframes, tunnel by tunnel in path order.
        draw: Index of the merge error.
        stored: Function that simulates storage of the descriptors (B, PER_SECTOR, SECTORS); default: identity.
    """
    logits = []
    with torch.inference_mode():
        for before, after in zip(torch.split(data.before_m, 256), torch.split(data.after_m[:, draw], 256), strict=True):
            spheres = compute(network, before, by=network.encode)
            spheres = stored(spheres) if stored else spheres
            logits.append(compute(network, spheres, after, by=network.compare))
    sectors = torch.cat(logits).numpy().astype(np.float64)
    local = np.empty(len(sectors))
    for tunnel in np.unique(data.tunnels):
        members = np.flatnonzero(data.tunnels == tunnel)
        local[members] = average_neighbours(sectors[members], data.positions[members]).max(axis=1)
    return local


def pool_within_reach(scores: Float64Array, data: SphereData) -> Float64Array:
    """Return the (N,) maximum of the scores within the score radius of each keyframe, tunnel by tunnel."""
    best = np.empty(len(scores))
    for tunnel in np.unique(data.tunnels):
        members = np.flatnonzero(data.tunnels == tunnel)
        best[members] = max_within_reach(scores[members], data.positions[members], data.score_radius_m[members[0]])
    return best


def find_donors(data: SphereData) -> Int64Array:
    """Return the keyframes in whose own rows an object was added, for `paste_objects`."""
    stands_there = (data.after_marks[:, 0, _OWN_ROWS] == CHANGED).flatten(1).sum(dim=1)
    return np.asarray(torch.nonzero(stands_there >= _MIN_PIXELS)[:, 0].numpy())


def augment(before: Tensor, after: Tensor, draw: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Return the images with a random scale for both and random missing pixels for each.

    A scaled pixel beyond the renderer's reach becomes empty.
    """
    factors = np.exp(draw.uniform(-_LOG_SCALE, _LOG_SCALE, size=(len(before), 1, 1)))
    seen = []
    for image in (before, after):
        missing = draw.uniform(0.0, _MAX_MISSING, size=(len(before), 1, 1))
        is_seen = draw.random(image.shape) >= missing
        scaled = image * torch.from_numpy((factors * is_seen).astype(np.float32))
        seen.append(torch.where(scaled <= REACH_M, scaled, 0.0))
    return seen[0], seen[1]


def paste_objects(after: Tensor, data: SphereData, donors: Int64Array, shifts: Int64Array) -> tuple[Tensor, Tensor]:
    """Paste the added objects of the donors, shifted by rows, into images.

    Args:
        after: (B, ROWS, COLUMNS) images, metres.
        data: Holds the donors.
        donors: (B,) keyframes whose objects are pasted (`find_donors`).
        shifts: (B,) rows by which they are shifted.

    Returns:
        The images and (B, ROWS, COLUMNS) uint8 marks of what was pasted: 0 nothing, 1 an object that stands out from
        the surface, 2 one that hardly does.
    """
    images = torch.stack([torch.roll(data.after_m[k, 0], int(s), 0) for k, s in zip(donors, shifts, strict=True)])
    marks = torch.stack([torch.roll(data.after_marks[k, 0], int(s), 0) for k, s in zip(donors, shifts, strict=True)])
    is_object = marks == CHANGED
    is_put = is_object & ((after == 0) | (images < after - _IN_FRONT_M))
    stands_out = is_object & (after > 0) & (images < after - _STANDS_OUT_M)
    marks = torch.zeros_like(marks).masked_fill(is_put, UNCOUNTED).masked_fill(stands_out, CHANGED)
    return torch.where(is_put, images, after), marks


def _per_sector(pixels: Tensor) -> Tensor:
    own = pixels[..., _OWN_ROWS, :].sum(dim=-2)
    return own.reshape(*own.shape[:-1], SECTORS, COLUMNS // SECTORS).sum(dim=-1)
