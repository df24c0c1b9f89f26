"""What a sphere network says of tunnels it was not trained on, keyframe by keyframe and change by change.

Poses are exact but for the merge error of one draw. Everything is counted at log-odds 0 as the network calibrates
itself: which unchanged keyframes lie above it (within the score radius of one that does), and which changes have a
keyframe above it within that radius. Stored numbers may be coarser than the network made them; the calibration stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.descriptors.sphere_network import SphereNetwork
from cdpipe.training.data import TunnelShard
from cdpipe.training.shard import read_shard
from cdpipe.training.sphere_training import SphereData, local_scores, pool_within_reach, read_sphere_data
from eval.core.ranking import auroc

FLOAT_BITS = 32
# The first draw is merged exactly.
DRAW = 1


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Tunnels to measure on.

    Attributes:
        data: Their keyframes.
        families: (T,) family of each tunnel.
        centroids: (C, 3) of their observable changes, world frame, metres.
        change_tunnels: (C,) tunnel of each.
    """

    data: SphereData
    families: npt.NDArray[np.str_]
    centroids: Float64Array
    change_tunnels: Int64Array


def held_out(tunnels: Sequence[TunnelShard]) -> HeldOut:
    """Read tunnels into memory.

    Raises:
        InputError: A shard is missing or damaged.
    """
    centroids = []
    for tunnel in tunnels:
        arrays, _ = read_shard(tunnel.path, ("change_centroid_world", "change_is_observable"))
        centroids.append(arrays["change_centroid_world"][arrays["change_is_observable"]])
    return HeldOut(
        read_sphere_data(tunnels),
        np.array([tunnel.family for tunnel in tunnels]),
        np.concatenate(centroids),
        np.repeat(np.arange(len(tunnels)), [len(own) for own in centroids]),
    )


def rounded(spheres: Tensor, bits: int) -> Tensor:
    """Return descriptors in (-1, 1) as that many bits keep them.

    32 as they are, 8 as 127ths (`descriptor.precision: int8`), fewer as the middle of one of 2^bits equal cells.
    """
    if bits == FLOAT_BITS:
        return spheres
    if bits == 8:
        return torch.round(spheres * 127.0).div(127.0)
    n_cells = 2**bits
    cell = torch.floor((spheres + 1.0) * (n_cells / 2)).clamp(max=n_cells - 1)
    middle: Tensor = (cell + 0.5) * (2 / n_cells) - 1.0
    return middle


def measures(network: SphereNetwork, held: HeldOut, bits: int = FLOAT_BITS) -> dict[str, float]:
    """Return what a calibrated network reaches on all tunnels, and `NAME_FAMILY` the same on each family.

    Args:
        network: Its calibration is used as it is.
        held: Where.
        bits: Of each stored number.

    Returns:
        `log_likelihood` of a keyframe's label; `auroc` of the keyframes, the mean over tunnels; `unchanged_above_0`
        and `changes_found`, shares; `n_unchanged` and `n_changes`, which they are shares of.
    """
    data = held.data
    local = network.calibrated(torch.from_numpy(local_scores(network, data, DRAW, partial(rounded, bits=bits)))).numpy()
    log_odds = pool_within_reach(local, data)
    is_found = _found(local, held)
    found = _of_group(log_odds, data, is_found, np.ones(len(log_odds), np.bool_))
    for family in np.unique(held.families):
        of_family = held.families == family
        own = _of_group(log_odds, data, is_found[of_family[held.change_tunnels]], of_family[data.tunnels])
        found |= {f"{name}_{family}": value for name, value in own.items()}
    return found


def _found(local: Float64Array, held: HeldOut) -> BoolArray:
    """Return (C,) which changes have a keyframe above 0 within the score radius of their centroid."""
    data, found = held.data, np.zeros(len(held.centroids), np.bool_)
    for index, (centroid, tunnel) in enumerate(zip(held.centroids, held.change_tunnels, strict=True)):
        distances_m = np.linalg.norm(data.positions - centroid, axis=1)
        found[index] = (local[(data.tunnels == tunnel) & (distances_m <= data.score_radius_m)] >= 0).any()
    return found


def _of_group(log_odds: Float64Array, data: SphereData, is_found: BoolArray, is_member: BoolArray) -> dict[str, float]:
    is_used = is_member & (data.labels >= 0)
    is_positive = data.labels == 1
    surprise = np.logaddexp(0.0, np.where(is_positive, -log_odds, log_odds))
    by_tunnel = [
        auroc(log_odds[mask], is_positive[mask])
        for mask in (is_used & (data.tunnels == tunnel) for tunnel in np.unique(data.tunnels[is_used]))
    ]
    defined = [value for value in by_tunnel if not np.isnan(value)]
    is_unchanged = is_used & ~is_positive
    return {
        "log_likelihood": -_mean(surprise[is_used]),
        "auroc": _mean(np.array(defined)),
        "unchanged_above_0": _mean(log_odds[is_unchanged] >= 0),
        "changes_found": _mean(is_found),
        "n_unchanged": int(is_unchanged.sum()),
        "n_changes": len(is_found),
    }


def _mean(values: npt.NDArray[np.float64] | BoolArray) -> float:
    return float(values.mean()) if len(values) else float("nan")
