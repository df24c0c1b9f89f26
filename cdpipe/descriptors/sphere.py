"""The sphere descriptor: 64 numbers for the map around a keyframe, and the log-odds that it has changed.

The descriptors are computed while mapping, from the map of one session alone. After the merge the map of the other is
rendered at its keyframes. The log-odds of a keyframe are the maximum over its sectors.
"""

from __future__ import annotations

from functools import cache, lru_cache

import numpy as np
import torch
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float32Array, Float64Array, Int64Array
from cdpipe.core.geometry.grid_index import GridIndex
from cdpipe.core.geometry.path_frames import path_frames
from cdpipe.descriptors.sphere_image import render
from cdpipe.descriptors.sphere_network import (
    SECTORS,
    SphereNetwork,
    load_sphere_network,
    load_trained_sphere_network,
)
from cdpipe.descriptors.weights_file import digest, read_weights
from cdpipe.model.config import DescriptorConfig, SphereConfig
from cdpipe.model.types import DescriptorSet, MergedMaps, PointMap, SessionName, Spheres

_BATCH = 64
_INT8_SCALE = 127.0
# Consecutive keyframes farther apart than this are no neighbours.
_NEIGHBOUR_M = 2.5
_SHIPPED = SphereConfig()


def anchor_frames(point_map: PointMap, scans: Int64Array, sphere: SphereConfig = _SHIPPED) -> Float64Array:
    """Return the (K, 4, 4) frames at K scans of a map in which its images are rendered, odom_T_anchor."""
    if sphere.frames == "path":
        return path_frames(point_map.odom_T_sensor, scans)
    return point_map.odom_T_sensor[scans]


def describe_map(
    thin_map: PointMap, map_T_anchor: Float64Array, config: DescriptorConfig, sphere: SphereConfig = _SHIPPED
) -> Spheres:
    """Return the (K, E) sphere descriptors of a map at K poses: float32 in (-1, 1), or int8 in units of 1/127.

    Args:
        thin_map: The map.
        map_T_anchor: (K, 4, 4) frames in the map's frame (`anchor_frames`).
        config: `precision` is used.
        sphere: The weights; E is 64 with the shipped ones.

    Raises:
        InputError: The file of weights cannot be used.
    """
    network, _ = _network(sphere)
    images = render(GridIndex(thin_map.points), map_T_anchor)
    with torch.inference_mode():
        parts = [network.encode(batch).flatten(1).numpy() for batch in torch.split(torch.from_numpy(images), _BATCH)]
    spheres = np.concatenate([np.zeros((0, network.size.numbers), np.float32), *parts])
    if config.precision == "int8":
        return np.rint(spheres * _INT8_SCALE).astype(np.int8)
    return spheres


def change_logits(
    merged: MergedMaps,
    described: DescriptorSet,
    is_covered: BoolArray,
    sphere: SphereConfig = _SHIPPED,
    session: SessionName = "before",
) -> Float64Array:
    """Return the (K, SECTORS) log-odds of change of each sector of each keyframe of a session.

    Keyframe poses are transformed into the odom frame of the other session by the local alignment; its map stays in
    place.

    Args:
        merged: Both maps.
        described: The session; its `spheres` are compared.
        is_covered: (K,) whether the other session came near a keyframe; the others get NaN.
        sphere: The frames and the weights with which the map was described.
        session: Which session it is.

    Raises:
        ValueError: The session has no sphere descriptors.
        InputError: The file of weights cannot be used.
    """
    if described.spheres is None:
        raise ValueError(f"the {session} session has no sphere descriptors: describe its map")
    network, _ = _network(sphere)
    other: SessionName = "after" if session == "before" else "before"
    logits = np.full((len(is_covered), SECTORS), np.nan)
    odom_T_anchor = anchor_frames(merged.map_of(session), described.keyframe_scans[is_covered], sphere)
    images = render(GridIndex(merged.map_of(other).points), merged.move_poses(session, other, odom_T_anchor))
    spheres = dequantise(described.spheres[is_covered])
    with torch.inference_mode():
        batches = (torch.split(torch.from_numpy(array), _BATCH) for array in (spheres, images))
        parts = [
            network.compare(stored.reshape(-1, network.size.per_sector, SECTORS), image).numpy()
            for stored, image in zip(*batches, strict=True)
        ]
    logits[is_covered] = np.concatenate([np.zeros((0, SECTORS)), *parts])
    return logits


def change_log_odds(
    merged: MergedMaps,
    described: DescriptorSet,
    is_covered: BoolArray,
    sphere: SphereConfig = _SHIPPED,
    session: SessionName = "before",
) -> Float64Array:
    """Return the (K,) calibrated log-odds of change around each keyframe of a session; NaN if not covered.

    Their sigmoid is a probability, calibrated on validation tunnels. Arguments as of `change_logits`.
    """
    log_odds = np.full(len(is_covered), np.nan)
    logits = change_logits(merged, described, is_covered, sphere, session)[is_covered]
    positions = merged.map_of(session).odom_T_sensor[described.keyframe_scans[is_covered], :3, 3]
    most_changed = torch.from_numpy(average_neighbours(logits, positions).max(axis=1))
    log_odds[is_covered] = _network(sphere)[0].calibrate(most_changed).numpy()
    return log_odds


def average_neighbours(logits: Float64Array, positions: Float64Array) -> Float64Array:
    """Return (K, S) log-odds averaged with those of both neighbouring keyframes, weights 1/4, 1/2, 1/4.

    Neighbours a metre apart see mostly the same wall. At a path end or gap the keyframe replaces its neighbour.

    Args:
        logits: (K, S) log-odds of each sector, in path order.
        positions: (K, 3) keyframe positions, metres.
    """
    is_apart = np.linalg.norm(np.diff(positions, axis=0), axis=1) > _NEIGHBOUR_M
    here = np.arange(len(logits))
    before = np.where(np.concatenate([[True], is_apart]), here, here - 1) if len(here) else here
    after = np.where(np.concatenate([is_apart, [True]]), here, here + 1) if len(here) else here
    return np.asarray((logits[before] + 2 * logits + logits[after]) / 4)


def max_within_reach(scores: Float64Array, positions: Float64Array, reach_m: float) -> Float64Array:
    """Return for each keyframe the maximum of the (K,) scores within `reach_m`, border included."""
    if len(scores) == 0:
        return scores
    near = cKDTree(positions).query_ball_point(positions, reach_m)
    return np.array([scores[found].max() for found in near])


def dequantise(spheres: Spheres) -> Float32Array:
    """Return (K, 64) stored descriptors as float32 in (-1, 1)."""
    if spheres.dtype == np.int8:
        return (spheres / np.float32(_INT8_SCALE)).astype(np.float32)
    return spheres.astype(np.float32)


def sphere_digest(sphere: SphereConfig = _SHIPPED) -> str:
    """Return the digest of the weights.

    Raises:
        InputError: The file of weights cannot be used.
    """
    return _network(sphere)[1]


def _network(sphere: SphereConfig) -> tuple[SphereNetwork, str]:
    return _parse(read_weights(sphere.weights), sphere.weights) if sphere.weights else _shipped()


@cache
def _shipped() -> tuple[SphereNetwork, str]:
    return load_trained_sphere_network()


@lru_cache(maxsize=4)
def _parse(content: bytes, source: str) -> tuple[SphereNetwork, str]:
    return load_sphere_network(content, source), digest(content)
