"""The probabilities of map points against a slow reference, and against what two heads made by hand say."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from cdpipe.core.geometry import Float64Array, stream, transform, yaw_pose
from cdpipe.descriptors import change_probabilities, point_changes
from cdpipe.descriptors.change_network import ChangeNetwork, make_untrained_change_network
from cdpipe.descriptors.sphere_image import COLUMNS, HALF_LENGTH_M, REACH_M, ROWS
from cdpipe.descriptors.weights_file import numbered_checkpoint_bytes
from cdpipe.model.config import RangeNetConfig
from cdpipe.model.types import MergedMaps, PointMap, SessionName

BEFORE_T_AFTER = yaw_pose(0.7, (3.0, -2.0, 0.5))
LENGTH_M = 8
SCANS = np.array([2, 4])
SESSIONS: tuple[SessionName, ...] = ("before", "after")


def straight_map(points: Float64Array, odom_T_map: Float64Array, y_m: float) -> PointMap:
    """The map of a drive along x at a side of the tunnel, a scan a metre, in an odom frame of its own."""
    poses = np.array([odom_T_map @ yaw_pose(0.0, (float(x), y_m, 0.0)) for x in range(LENGTH_M)])
    none = np.zeros(0, np.int32)
    offsets = np.zeros(LENGTH_M + 1, np.int64)
    nearest_m = np.ones(len(points), np.float32)
    return PointMap(transform(odom_T_map, points), nearest_m, 0.2, poses, SCANS, none, none, offsets)


def merge(before: Float64Array, after: Float64Array) -> MergedMaps:
    """Both maps of points in the map frame; the drives are 0.6 m apart."""
    there = straight_map(after, np.linalg.inv(BEFORE_T_AFTER), 0.6)
    return MergedMaps(straight_map(before, np.eye(4), 0.0), there, BEFORE_T_AFTER, {}, True)


def look(points_anchor: Float64Array) -> tuple[dict[tuple[int, int], float], list[tuple[int, int] | None]]:
    """The nearest distance of each pixel, and the pixel of each point, point by point."""
    nearest: dict[tuple[int, int], float] = {}
    found: list[tuple[int, int] | None] = []
    for x, y, z in points_anchor.tolist():
        distance_m = math.hypot(y, z)
        if not -HALF_LENGTH_M <= x < HALF_LENGTH_M or distance_m > REACH_M:
            found.append(None)
            continue
        turn = math.atan2(z, y) % (2 * math.pi)
        pixel = math.floor((x + HALF_LENGTH_M) * ROWS / (2 * HALF_LENGTH_M)), math.floor(turn * COLUMNS / (2 * math.pi))
        found.append(pixel)
        nearest[pixel] = min(nearest.get(pixel, math.inf), distance_m)
    return nearest, found


def as_image(nearest: dict[tuple[int, int], float]) -> Tensor:
    image = torch.zeros(1, ROWS, COLUMNS)
    for pixel, distance_m in nearest.items():
        image[0][pixel] = distance_m
    return image


def test_a_slow_reference_agrees(tmp_path: Path) -> None:
    draw = stream(0, "range-net")
    before, after = (draw.uniform((-1, -3, -2), (LENGTH_M, 3, 2), (500, 3)) for _ in range(2))
    network = make_untrained_change_network(7)
    with torch.no_grad():
        network.heads.weight *= 4  # probabilities from one end to the other
    path = tmp_path / "weights.safetensors"
    path.write_bytes(numbered_checkpoint_bytes(network))
    config = RangeNetConfig(weights=str(path), depth_m=0.4)
    found = change_probabilities(merge(before, after), "after", "before", dict.fromkeys(SESSIONS, SCANS), config)
    said: list[list[float]] = [[] for _ in after]
    for origin in [(float(x), y, 0.0) for y in (0.0, 0.6) for x in SCANS]:
        own, pixels = look(after - origin)
        other, _ = look(before - origin)
        with torch.inference_mode():
            change, visible = (head[0].sigmoid() for head in network(as_image(own), as_image(other)))
        for point, pixel in enumerate(pixels):
            if pixel is None or visible[pixel] < 0.5:
                continue
            if math.hypot(*(after[point] - origin)[1:]) - own[pixel] <= 0.4:
                said[point].append(change[pixel].item())
    expected = [sum(each) / len(each) if each else 0.0 for each in said]
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert {len(each) for each in said} >= {0, 1, 2} and np.ptp(expected) > 0.5


class Heads(ChangeNetwork):
    """Changed where the other image is farther by 0.5 m, visible where it is not nearer by as much."""

    def forward(self, own_m: Tensor, other_m: Tensor) -> tuple[Tensor, Tensor]:
        change = torch.where(other_m - own_m > 0.5, 9.0, -9.0)
        return change, torch.where((other_m > 0) & (other_m - own_m > -0.5), 9.0, -9.0)


def ring(x_m: float, distance_m: float) -> Float64Array:
    """A ring of points around the path, one to every pixel of a row."""
    angle = (np.arange(COLUMNS) + 0.5) * 2 * np.pi / COLUMNS
    around = distance_m * np.cos(angle), distance_m * np.sin(angle)
    return np.column_stack([np.full(COLUMNS, x_m), *around])


@pytest.mark.parametrize(("depth_m", "is_shown"), [(0.25, False), (0.35, True)])
def test_what_stands_out_has_changed_and_what_hides_or_is_hidden_has_not(
    monkeypatch: pytest.MonkeyPatch, depth_m: float, is_shown: bool
) -> None:
    monkeypatch.setattr(point_changes, "_network", lambda config: (Heads(), ""))
    wall = ring(3.1, 3.0)
    # the box of the after map has two sides, 0.3 m apart; the wall behind it is seen by the before session alone
    box = np.concatenate([ring(3.1, 1.5)[:6], ring(3.1, 1.8)[:6]])
    merged = merge(wall, np.concatenate([wall, box, ring(30.0, 1.5)]))
    scans = {"before": np.array([3]), "after": np.zeros(0, np.int64)}
    config = RangeNetConfig(depth_m=depth_m)
    found = change_probabilities(merged, "after", "before", scans, config)
    front, side = found[COLUMNS : COLUMNS + 6], found[COLUMNS + 6 : COLUMNS + 12]
    assert (front > 0.99).all() and (side > 0.99).tolist() == [is_shown] * 6
    assert (found[:COLUMNS] < 0.01).all()
    assert (found[COLUMNS + 12 :] == 0).all()  # no image shows them
    # seen from the before map, the wall has not changed; six pixels of it were hidden from the after session
    wall_now = change_probabilities(merged, "before", "after", scans, config)
    assert (wall_now[:6] == 0).all() and (wall_now[6:] > 0).all() and (wall_now < 0.01).all()
