"""The sphere descriptor: what the map around a keyframe looks like, and how surely that has changed since.

The before session's descriptors are made of its map alone, while mapping. After the merge the after map is looked at
from the same places; each keyframe's log-odds of change are those of its most changed sector.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float32Array, Float64Array, invert
from cdpipe.core.grid_index import GridIndex
from cdpipe.descriptors.sphere_image import render
from cdpipe.descriptors.sphere_network import PER_SECTOR, SECTORS, SphereNetwork, load_trained_sphere_network
from cdpipe.model.config import DescriptorConfig
from cdpipe.model.types import DescriptorSet, MergedMaps, PointMap, Spheres

_BATCH = 64
_INT8_SCALE = 127.0
# Keyframes farther apart than this along the path look at different stretches.
_NEIGHBOUR_M = 2.5


def describe_map(thin_map: PointMap, map_T_anchor: Float64Array, config: DescriptorConfig) -> Spheres:
    """Return (K, 64) what a map looks like from each of (K, 4, 4) poses: float32 in (-1, 1), or int8 of 127ths.

    Args:
        thin_map: The map.
        map_T_anchor: Sensor poses in the map's frame.
        config: `precision` is used.
    """
    network, _ = _network()
    images = render(GridIndex(thin_map.points), map_T_anchor)
    with torch.inference_mode():
        parts = [network.encode(batch).flatten(1).numpy() for batch in torch.split(torch.from_numpy(images), _BATCH)]
    spheres = np.concatenate([np.zeros((0, PER_SECTOR * SECTORS), np.float32), *parts])
    if config.precision == "int8":
        return np.rint(spheres * _INT8_SCALE).astype(np.int8)
    return spheres


def change_logits(merged: MergedMaps, before: DescriptorSet, is_covered: BoolArray) -> Float64Array:
    """Return the (K, SECTORS) log-odds that the surroundings of each before keyframe changed, sector by sector.

    The after map is not moved: each keyframe's pose is carried into its odom frame by the alignment that holds there.

    Args:
        merged: Both maps.
        before: Its `spheres` are compared.
        is_covered: (K,) which keyframes the after session came near; the others get NaN.
    """
    if before.spheres is None:
        raise ValueError("the before session has no sphere descriptors: describe its map")
    network, _ = _network()
    logits = np.full((len(is_covered), SECTORS), np.nan)
    map_T_anchor = merged.before.odom_T_sensor[before.keyframe_scans[is_covered]]
    positions_odom = merged.alignment.to_odom(map_T_anchor[:, :3, 3])
    after_T_anchor = np.asarray(invert(merged.alignment.at(positions_odom)) @ map_T_anchor)
    images = render(GridIndex(merged.after.points), after_T_anchor)
    spheres = dequantise(before.spheres[is_covered])
    with torch.inference_mode():
        batches = (torch.split(torch.from_numpy(array), _BATCH) for array in (spheres, images))
        parts = [
            network.compare(stored.reshape(-1, PER_SECTOR, SECTORS), image).numpy()
            for stored, image in zip(*batches, strict=True)
        ]
    logits[is_covered] = np.concatenate([np.zeros((0, SECTORS)), *parts])
    return logits


def change_log_odds(merged: MergedMaps, before: DescriptorSet, is_covered: BoolArray) -> Float64Array:
    """Return the (K,) calibrated log-odds that the surroundings of each before keyframe changed, NaN if not covered.

    Their sigmoid is a probability, as the validation tunnels have it; log-odds rank alike and do not saturate.

    Args:
        merged: Both maps.
        before: Its `spheres` are compared.
        is_covered: (K,) which keyframes the after session came near.
    """
    log_odds = np.full(len(is_covered), np.nan)
    logits = change_logits(merged, before, is_covered)[is_covered]
    positions = merged.before.odom_T_sensor[before.keyframe_scans[is_covered], :3, 3]
    most_changed = torch.from_numpy(average_neighbours(logits, positions).max(axis=1))
    log_odds[is_covered] = _network()[0].calibrated(most_changed).numpy()
    return log_odds


def average_neighbours(logits: Float64Array, positions: Float64Array) -> Float64Array:
    """Return (K, S) log-odds, each averaged with the same sector of the keyframes before and after, which weigh half.

    Neighbours a metre apart see most of the same wall: what only one of them calls changed is noise. A neighbour that
    is missing (the end of the path, a gap in it) is replaced by the keyframe itself.

    Args:
        logits: (K, S), in the order of the path.
        positions: (K, 3) of the keyframes, metres.
    """
    is_apart = np.linalg.norm(np.diff(positions, axis=0), axis=1) > _NEIGHBOUR_M
    here = np.arange(len(logits))
    before = np.where(np.concatenate([[True], is_apart]), here, here - 1) if len(here) else here
    after = np.where(np.concatenate([is_apart, [True]]), here, here + 1) if len(here) else here
    return np.asarray((logits[before] + 2 * logits + logits[after]) / 4)


def max_within_reach(scores: Float64Array, positions: Float64Array, reach_m: float) -> Float64Array:
    """Return the (K,) highest of the scores of the keyframes within `reach_m` of each, the border included."""
    if len(scores) == 0:
        return scores
    near = cKDTree(positions).query_ball_point(positions, reach_m)
    return np.array([scores[found].max() for found in near])


def dequantise(spheres: Spheres) -> Float32Array:
    """Return (K, 64) stored descriptors as float32 numbers in (-1, 1)."""
    if spheres.dtype == np.int8:
        return (spheres / np.float32(_INT8_SCALE)).astype(np.float32)
    return spheres.astype(np.float32)


def sphere_digest() -> str:
    """Return the digest of the weights."""
    return _network()[1]


@cache
def _network() -> tuple[SphereNetwork, str]:
    return load_trained_sphere_network()
