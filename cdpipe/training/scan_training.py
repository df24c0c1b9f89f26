"""Training of the scan descriptor: InfoNCE on the place vectors q, yaw classification on the orientation vectors w.

3DEG (arXiv 2210.07285, section III) uses triplets with the hardest negative. In tunnels that loss stays at its margin
for hundreds of steps, because the hardest of a hundred places resembles the correct one. The cross-entropy over all
negatives (InfoNCE, arXiv 1807.03748) learns from the first step. 3DEG regresses (cos, sin) of the yaw; ours is the
cross-entropy of the circular correlation of two w, which does not average the two directions of a tunnel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import BoolArray, Float32Array, Float64Array, Int64Array, require_shapes, stream
from cdpipe.descriptors.devices import compute
from cdpipe.descriptors.network import DIMENSIONS, PlaceNetwork, yaw_correlation
from cdpipe.descriptors.range_image import COLUMNS

_TEMPERATURE = 0.03
_YAW_WEIGHT = 0.3
_YAW_TEMPERATURE = 12.0
_YAW_SPREAD_RAD = np.deg2rad(5.0)
# Largest distance of two keyframes of the same place.
SAME_PLACE_M = 3.0
# Positives are the keyframes of the other session at most this much farther than the nearest one.
_BESIDE_NEAREST_M = 1.0
OTHER_PLACE_M = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class PlaceData:
    """Keyframes with true poses; both sessions of a tunnel share a world frame.

    Attributes:
        images_m: (N, ROWS, COLUMNS) float16 or float32 range images, metres.
        positions: (N, 3) float64 sensor positions, world frame, metres.
        headings_rad: (N,) float64 yaw of the sensor in the world frame.
        tunnels: (N,) int64 number of the tunnel.
        sessions: (N,) int64, 0 before, 1 after.
    """

    images_m: Float32Array
    positions: Float64Array
    headings_rad: Float64Array
    tunnels: Int64Array
    sessions: Int64Array

    def __post_init__(self) -> None:
        n = len(self.images_m)
        require_shapes(self, positions=(n, 3), headings_rad=(n,), tunnels=(n,), sessions=(n,))


TUNNELS_PER_BATCH = 8
ANCHORS_PER_TUNNEL = 8


class PlaceTask:
    """Trains a place network, `network`, on some tunnels and scores it on others.

    Raises:
        InputError: No place of the training tunnels, or of the validation tunnels, was visited by both sessions.
    """

    def __init__(self, network: PlaceNetwork, training: PlaceData, validation: PlaceData, seed: int) -> None:
        self.network, self._data, self._validation, self._seed = network, training, validation, seed
        self._partners = _partners(training)
        paired = np.array([len(partners) > 0 for partners in self._partners])
        by_tunnel = [np.flatnonzero(paired & (training.tunnels == tunnel)) for tunnel in np.unique(training.tunnels)]
        self._paired = [keyframes for keyframes in by_tunnel if len(keyframes)]
        if not self._paired:
            raise InputError(
                f"training tunnels: no keyframe within {SAME_PLACE_M:g} m of one of the other session; make tunnels "
                "that both sessions drive through"
            )
        if not any(map(len, _partners(validation))):
            raise InputError("validation needs places that both sessions visit: make more validation tunnels")

    def losses(self, step: int) -> dict[str, Tensor]:
        """Return the classification losses of q and w."""
        draw = stream(self._seed, "train-place", str(step))
        anchors = self._anchors(draw)
        positives = np.array([draw.choice(self._partners[anchor]) for anchor in anchors])
        chosen = np.concatenate([anchors, positives])
        images, headings = _turn(self._data, chosen, draw)
        # a mirrored tunnel counts as another tunnel, so all its keyframes are mirrored together
        tunnels, index = np.unique(self._data.tunnels[chosen], return_inverse=True)
        images, headings = _mirror(images, headings, (draw.random(len(tunnels)) < 0.5)[index])
        q, w = compute(self.network, images)
        positions, tunnel_of = self._data.positions, self._data.tunnels
        apart_m = np.linalg.norm(positions[anchors, None] - positions[None, chosen], axis=2)
        is_other = (tunnel_of[anchors, None] != tunnel_of[None, chosen]) | (apart_m > OTHER_PLACE_M)
        place_loss = _place_loss(q, torch.from_numpy(is_other))
        return {"place": place_loss, "yaw": _YAW_WEIGHT * _yaw_loss(w, headings)}

    def _anchors(self, draw: np.random.Generator) -> Int64Array:
        n_tunnels = min(TUNNELS_PER_BATCH, len(self._paired))
        tunnels = [self._paired[place] for place in draw.choice(len(self._paired), size=n_tunnels, replace=False)]
        return np.concatenate(
            [draw.choice(own, size=min(ANCHORS_PER_TUNNEL, len(own)), replace=False) for own in tunnels]
        )

    def scores(self) -> dict[str, float]:
        """Return the scores of `evaluate` on the validation tunnels."""
        return evaluate(self.network, self._validation)

    def finish(self) -> dict[str, float]:
        """Return no figures: nothing is calibrated."""
        return {}


def evaluate(network: PlaceNetwork, data: PlaceData) -> dict[str, float]:
    """Score a network on tunnels it has not seen; every tunnel needs both sessions.

    Returns:
        `recall_at_1`: share of after keyframes whose nearest before descriptor, within its tunnel, lies within 3 m.
        `yaw_error_deg`: median absolute yaw error between true neighbours. `yaw_flip_share`: share of these errors
        over 90 degrees.
    """
    draw = stream(0, "evaluate-descriptor")
    images, headings = _turn(data, np.arange(len(data.positions)), draw)
    with torch.inference_mode():
        parts = [compute(network, batch) for batch in torch.split(images, 64)]
    q = torch.cat([part[0] for part in parts]).numpy()
    w = torch.cat([part[1] for part in parts])
    hits: list[bool] = []
    errors: list[float] = []
    for tunnel in np.unique(data.tunnels):
        before = np.flatnonzero((data.tunnels == tunnel) & (data.sessions == 0))
        after = np.flatnonzero((data.tunnels == tunnel) & (data.sessions == 1))
        apart = np.linalg.norm(data.positions[after, None] - data.positions[None, before], axis=2)
        for row in np.flatnonzero(apart.min(axis=1) <= SAME_PLACE_M):
            found = int(np.argmax(q[before] @ q[after[row]]))
            hits.append(bool(apart[row, found] <= SAME_PLACE_M))
            near = int(np.argmin(apart[row]))
            peak = int(yaw_correlation(w[before[near]][None], w[after[row]][None]).argmax())
            error = peak * 2 * np.pi / DIMENSIONS - float(headings[after[row]] - headings[before[near]])
            errors.append(abs(float(np.rad2deg(np.angle(np.exp(1j * error))))))
    return {
        "recall_at_1": float(np.mean(hits)),
        "yaw_error_deg": float(np.median(errors)),
        "yaw_flip_share": float(np.mean(np.array(errors) > 90)),
    }


def _partners(data: PlaceData) -> list[Int64Array]:
    """Return for each keyframe its positives: the nearest keyframe of the other session and those near that one."""
    partners: list[Int64Array] = [np.zeros(0, dtype=np.int64)] * len(data.positions)
    for tunnel in np.unique(data.tunnels):
        members = np.flatnonzero(data.tunnels == tunnel)
        apart = np.linalg.norm(data.positions[members, None] - data.positions[None, members], axis=2)
        apart[data.sessions[members, None] == data.sessions[None, members]] = np.inf
        limits = np.minimum(apart.min(axis=1) + _BESIDE_NEAREST_M, SAME_PLACE_M)
        is_partner = apart <= limits[:, None]
        for row, member in enumerate(members):
            partners[member] = members[is_partner[row]]
    return partners


def _turn(data: PlaceData, chosen: Int64Array, draw: np.random.Generator) -> tuple[Tensor, Float64Array]:
    """Rotate every image by a random yaw; a shift to the right by k columns is a yaw of -k columns."""
    shifts = draw.integers(0, COLUMNS, size=len(chosen))
    columns = (np.arange(COLUMNS)[None, :] - shifts[:, None]) % COLUMNS
    images = np.take_along_axis(data.images_m[chosen].astype(np.float32), columns[:, None, :], axis=2)
    return torch.from_numpy(images), data.headings_rad[chosen] - shifts * 2 * np.pi / COLUMNS


def _mirror(images: Tensor, headings_rad: Float64Array, is_mirrored: BoolArray) -> tuple[Tensor, Float64Array]:
    """Mirror the marked images; a mirrored heading changes its sign."""
    flips = torch.from_numpy(is_mirrored)[:, None, None]
    return torch.where(flips, images.flip(2), images), np.where(is_mirrored, -headings_rad, headings_rad)


def _place_loss(q: Tensor, is_negative: Tensor) -> Tensor:
    """Return the InfoNCE loss: the cross-entropy of the positive among itself and all negatives.

    Args:
        q: (2 A, 64) place vectors: A anchors, then their positives in the same order.
        is_negative: (A, 2 A) whether a vector is of another place than an anchor.
    """
    n = len(is_negative)
    likeness = q[:n] @ q.T / _TEMPERATURE
    positive = likeness[torch.arange(n), n + torch.arange(n)]
    negatives = likeness.masked_fill(~is_negative, -torch.inf)
    return (torch.logsumexp(torch.cat([positive[:, None], negatives], dim=1), dim=1) - positive).mean()


def _yaw_loss(w: Tensor, headings_rad: Float64Array) -> Tensor:
    n = len(w) // 2
    scores = _YAW_TEMPERATURE * yaw_correlation(w[:n], w[n:])
    bins = np.arange(DIMENSIONS) * 2 * np.pi / DIMENSIONS
    off = np.angle(np.exp(1j * (bins[None, :] - (headings_rad[n:] - headings_rad[:n])[:, None])))
    target = np.exp(-0.5 * (off / _YAW_SPREAD_RAD) ** 2)
    target /= target.sum(axis=1, keepdims=True)
    return torch.nn.functional.cross_entropy(scores, torch.from_numpy(target.astype(np.float32)))
