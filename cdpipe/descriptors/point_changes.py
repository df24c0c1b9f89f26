"""The probability that each map point has changed, by the network of `range-net` on images of both maps.

Both maps are rendered at the keyframes of both sessions. A point takes the probabilities of its pixel in every image
that shows it, that is where it lies no farther than `range_net.depth_m` behind the nearest point of the pixel.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, lru_cache

import numpy as np
import torch

from cdpipe.core.geometry import Float32Array, Float64Array, Int64Array, invert, transform
from cdpipe.core.geometry.grid_index import GridIndex
from cdpipe.core.geometry.path_frames import path_frames
from cdpipe.descriptors.change_network import ChangeNetwork, load_change_network, load_trained_change_network
from cdpipe.descriptors.sphere_image import CROP_M, pixels, render, sphere_image
from cdpipe.descriptors.weights_file import digest, read_weights
from cdpipe.model.config import RangeNetConfig
from cdpipe.model.types import MergedMaps, SessionName

_BATCH = 32
_VISIBLE = 0.5
_SHIPPED = RangeNetConfig()


def change_probabilities(
    merged: MergedMaps,
    session: SessionName,
    other: SessionName,
    scans: Mapping[SessionName, Int64Array],
    config: RangeNetConfig = _SHIPPED,
) -> Float64Array:
    """Return the (N,) mean probability that each map point of `session` is not in the map of `other`.

    The mean is over the images that show the point and in which `other` could see it, with a probability of at least
    0.5. It is 0 where there is no such image.

    Args:
        merged: Both maps.
        session: The session whose points are judged.
        other: The session with which they are compared.
        scans: (K,) scans of each session at which both maps are rendered, in frames by path and gravity.
        config: `depth_m` and `weights` are used.

    Raises:
        InputError: The file of weights cannot be used.
    """
    network, _ = _network(config)
    points = merged.map_of(session).points
    index, other_index = GridIndex(points), GridIndex(merged.map_of(other).points)
    anchors = {name: path_frames(merged.map_of(name).odom_T_sensor, chosen) for name, chosen in scans.items()}
    own_T_anchor, other_T_anchor = (
        np.concatenate([merged.move_poses(name, target, poses) for name, poses in anchors.items()])
        for target in (session, other)
    )
    sums, counts = np.zeros(len(points)), np.zeros(len(points))
    for start in range(0, len(own_T_anchor), _BATCH):
        batch = slice(start, start + _BATCH)
        views = [_view(points, index, pose, config.depth_m) for pose in own_T_anchor[batch]]
        images = np.stack([image for image, _, _ in views]), render(other_index, other_T_anchor[batch])
        with torch.inference_mode():
            change, visible = (
                torch.sigmoid(logits).flatten(1).numpy().astype(np.float64)
                for logits in network(*(torch.from_numpy(image) for image in images))
            )
        for (_, shown, pixel), changes, visibility in zip(views, change, visible, strict=True):
            is_visible = visibility[pixel] >= _VISIBLE
            sums[shown[is_visible]] += changes[pixel[is_visible]]
            counts[shown[is_visible]] += 1
    return np.asarray(sums / np.maximum(counts, 1))


def range_net_digest(config: RangeNetConfig = _SHIPPED) -> str:
    """Return the digest of the weights.

    Raises:
        InputError: The file of weights cannot be used.
    """
    return _network(config)[1]


def _view(
    points: Float64Array, index: GridIndex, odom_T_anchor: Float64Array, depth_m: float
) -> tuple[Float32Array, Int64Array, Int64Array]:
    """Return the image at a (4, 4) pose, the (V,) points that it shows and the pixel of each."""
    near = index.crop(odom_T_anchor[:3, 3], CROP_M)
    points_anchor = transform(invert(odom_T_anchor), points[near])
    image, pixel = sphere_image(points_anchor), pixels(points_anchor)
    distances_m = np.hypot(points_anchor[:, 1], points_anchor[:, 2])
    is_shown = (pixel >= 0) & (distances_m - image.ravel()[pixel] <= depth_m)
    return image, near[is_shown], pixel[is_shown]


def _network(config: RangeNetConfig) -> tuple[ChangeNetwork, str]:
    return _parse(read_weights(config.weights), config.weights) if config.weights else _shipped()


@cache
def _shipped() -> tuple[ChangeNetwork, str]:
    return load_trained_change_network()


@lru_cache(maxsize=4)
def _parse(content: bytes, source: str) -> tuple[ChangeNetwork, str]:
    return load_change_network(content, source), digest(content)
