"""The floor of drifts: level of the centreline, crossfall and ruts, and one common floor where drifts meet."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cdpipe.core.geometry import Float64Array
from scenarios.schema import Floor
from sim.rock.frame import Frame

# Floors less than the first share of a drift's height apart are one floor; beyond the second share, two levels.
_SAME_LEVEL = 0.3
_OTHER_LEVEL = 0.8
_OWN_WEIGHT = 1e-6  # gives a drift far from all others its own floor
_RUTS_END_M = 1.5  # ruts fade over this distance before the face of a blind drift


def floor_heights(
    frames: Sequence[Frame], shares: Sequence[Sequence[Float64Array]], floor: Floor
) -> list[Float64Array]:
    """Return the height (M,) of every drift's floor, roughness left out.

    Where drifts meet, each of their floors is the mean of all, weighted by how near each centreline is: drifts of
    different slope, crossfall and rut share one floor without a step.

    Args:
        frames: Where the same columns lie in each of the drifts.
        shares: `level_share` of every drift with every other.
        floor: Crossfall and ruts.
    """
    own = [_own_floor(index, frames, shares[index], floor) for index in range(len(frames))]
    if len(own) == 1:
        return own
    heights = []
    for index, mine in enumerate(own):
        weights = [share * other.mouth for share, other in zip(shares[index], frames, strict=True)]
        total = _OWN_WEIGHT * mine + sum(weight * height for weight, height in zip(weights, own, strict=True))
        heights.append(np.asarray(total / (_OWN_WEIGHT + sum(weights))))
    return heights


def smooth_step(value: Float64Array) -> Float64Array:
    """Return 0 below 0, 1 above 1, and a cubic in between."""
    share = np.clip(value, 0.0, 1.0)
    return np.asarray(share**2 * (3.0 - 2.0 * share))


def level_share(mine: Frame, other: Frame) -> Float64Array:
    """Return how far two drifts share one level (M,): 1 on the same level, 0 on another one or far away."""
    height_m = np.minimum(mine.height_m, other.height_m)
    apart = np.abs(mine.level_m - other.level_m) / np.maximum(height_m, 1e-9)
    share = 1.0 - smooth_step((apart - _SAME_LEVEL) / (_OTHER_LEVEL - _SAME_LEVEL))
    return np.where(other.is_near, share, 0.0)


def _own_floor(index: int, frames: Sequence[Frame], shares: Sequence[Float64Array], floor: Floor) -> Float64Array:
    frame = frames[index]
    fall_m = floor.crossfall_percent / 100 * np.clip(frame.lateral_m, -frame.half_m, frame.half_m)
    ruts = floor.ruts
    if ruts is None:
        return frame.level_m + fall_m
    fade = smooth_step(-frame.beyond_m / _RUTS_END_M)
    for number, (other, share) in enumerate(zip(frames, shares, strict=True)):
        if number != index:
            fade = fade * (1.0 - share * smooth_step(3.0 * other.mouth))
    # The two wheel tracks are raised cosines.
    from_track = np.clip(np.abs(np.abs(frame.lateral_m) - ruts.gauge_m / 2) / ruts.width_m, 0.0, 0.5)
    depth_m = ruts.depth_m * 0.5 * (1.0 + np.cos(2 * np.pi * from_track))
    return np.asarray(frame.level_m + fall_m - fade * depth_m)
