from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from scenarios.schema import Prop
from sim.props import REPOSE_DEG, shape_of, solid_mesh

SIZES = {
    "box": (0.8, 0.6, 0.5),
    "chair": (0.5, 0.45, 0.9),
    "trolley": (0.6, 0.55, 1.2),
    "railing": (3.6, 0.1, 1.1),
    "barrel": (0.58, 0.58, 0.88),
}


@pytest.mark.parametrize("kind", SIZES)
def test_a_prop_fills_its_bounding_box_above_the_floor(kind: str, make_prop: Callable[..., Prop]) -> None:
    shape = shape_of(make_prop("it", kind=kind, size_m=SIZES[kind]), seed=0)
    corners = np.concatenate([solid_mesh(solid).vertices for solid in shape.solids])
    corners[:, 2] = np.maximum(corners[:, 2], 0.0)  # a railing's posts go into the floor
    half = np.array(SIZES[kind]) / (2, 2, 1)
    np.testing.assert_allclose(corners.max(axis=0), half, atol=2e-3)
    np.testing.assert_allclose(corners.min(axis=0), [-half[0], -half[1], 0.0], atol=2e-3)
    assert shape.is_settled == (kind != "railing")


def test_hull_volume_of_a_box(make_prop: Callable[..., Prop]) -> None:
    assert shape_of(make_prop("it", size_m=(0.8, 0.6, 0.5)), 0).hull_volume_m3 == pytest.approx(0.24)


def test_a_heap_lies_at_the_angle_of_repose(make_prop: Callable[..., Prop]) -> None:
    size: Any = (7.0, 5.0, 1.5)
    mesh = solid_mesh(shape_of(make_prop("heap", kind="muck_pile", size_m=size), 1).solids[0])
    x, y, z = mesh.vertices.T
    assert z.max() == pytest.approx(1.5, abs=1e-6)
    assert z.min() < -0.3
    at_floor = np.abs(z) < 0.1
    assert np.abs(x[at_floor]).max() == pytest.approx(3.5, rel=0.2)
    assert np.abs(y[at_floor]).max() == pytest.approx(2.5, rel=0.2)
    # Flanks: height lost over the way from one third of the footprint's short half to its edge.
    ring = np.hypot(x / 3.5, y / 2.5)
    short = np.abs(x) < 0.6
    upper, lower = short & (np.abs(ring - 0.5) < 0.08), short & (np.abs(ring - 0.95) < 0.08)
    drop = (z[upper].mean() - z[lower].mean()) / (np.abs(y[lower]).mean() - np.abs(y[upper]).mean())
    assert np.rad2deg(np.arctan(drop)) == pytest.approx(REPOSE_DEG, abs=9.0)


def test_a_heap_is_closed_and_drawn_by_seed_and_name(make_prop: Callable[..., Prop]) -> None:
    heaps = [
        solid_mesh(shape_of(make_prop(name, kind="muck_pile", size_m=(3.0, 2.0, 0.8)), seed).solids[0])
        for name, seed in (("p", 1), ("p", 1), ("p", 2), ("q", 1))
    ]
    np.testing.assert_array_equal(heaps[0].vertices, heaps[1].vertices)
    assert np.abs(heaps[0].vertices - heaps[2].vertices).max() > 0.02
    assert np.abs(heaps[0].vertices - heaps[3].vertices).max() > 0.02
    start = heaps[0].faces.astype(np.int64)
    end = np.roll(start, -1, axis=1)
    n = len(heaps[0].vertices)
    np.testing.assert_array_equal(np.sort((start * n + end).ravel()), np.sort((end * n + start).ravel()))
