"""Echoes that are blended by Warp's kernels, on the CPU, against those that numpy blends."""

from __future__ import annotations

import importlib.util
from dataclasses import fields
from typing import Literal

import numpy as np
import pytest

from cdpipe.core.geometry import Float32Array, Int32Array
from sim.geometry.mesh import Mesh
from sim.sensor.footprint import EVERYWHERE, Echo, Limits, blend_beams, cast_beams, spread_echo
from sim.sensor.optics import RETRO_FROM
from sim.sensor.rays import Rays

if importlib.util.find_spec("warp") is None:
    pytest.skip("needs the extra `gpu`: warp-lang", allow_module_level=True)

from sim.geometry.warp_caster import WarpCaster

ORIGIN_M = 0.015
SUB_RAYS: tuple[Literal[7, 19], ...] = (7, 19)


def plate(x_m: float, y_m: tuple[float, float], lean_m: float = 0.0) -> Mesh:
    (low, high), z_m = y_m, 0.35
    corners = [(x_m, low, -z_m), (x_m, high, -z_m), (x_m + lean_m, high, z_m), (x_m + lean_m, low, z_m)]
    return Mesh(np.array(corners), np.array([[0, 1, 2], [0, 2, 3]], np.int32))


@pytest.fixture(scope="module")
def meshes() -> list[Mesh]:
    """Strips one behind the other: steps of less than a pulse and of more, up to four depths in a beam, and gaps."""
    generator = np.random.default_rng(3)
    depths_m = [8.0, 8.4, 9.1, 10.3, 12.0, 12.6, 15.0]
    return [
        plate(depth_m, (low, low + 0.02), 0.3 * generator.random())
        for depth_m in depths_m
        for low in np.sort(generator.uniform(-1.0, 1.0, 24))
    ]


@pytest.fixture(scope="module")
def warp(meshes: list[Mesh]) -> WarpCaster:
    return WarpCaster(meshes, np.zeros(3), "cpu")


@pytest.fixture(scope="module")
def surfaces(meshes: list[Mesh]) -> tuple[Float32Array, Int32Array]:
    generator = np.random.default_rng(4)
    return generator.uniform(0.05, 0.9, len(meshes)).astype(np.float32), generator.integers(0, 3, len(meshes), np.int32)


def fan() -> Rays:
    azimuth, elevation = np.meshgrid(np.linspace(-0.15, 0.15, 400), np.linspace(-0.04, 0.04, 7), indexing="ij")
    way = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return Rays(np.zeros((400, 3)), np.stack(way, axis=-1).astype(np.float32))


def blend_by_numpy(
    warp: WarpCaster,
    reflectivity: Float32Array,
    owners: Int32Array,
    sub_rays: Literal[7, 19],
    limits: Limits = EVERYWHERE,
) -> tuple[Echo, Int32Array]:
    """Return the echo, and how many groups of rays each beam has."""
    hits = cast_beams(warp, reflectivity, fan(), ORIGIN_M, sub_rays, limits)
    reach_m = np.sort(np.where(np.isinf(hits.ranges_m), np.nan, hits.ranges_m), axis=0)
    n_groups = (np.diff(reach_m, axis=0) >= 1.0).sum(axis=0) + np.isfinite(reach_m).any(axis=0)
    return blend_beams(hits, owners, (400, 7)), n_groups.astype(np.int32)


@pytest.mark.parametrize(
    ("limits", "counts"), [(EVERYWHERE, {0, 1, 2, 3}), (Limits(0.3, 11.0), {0, 1, 2}), (Limits(9.0, 14.0), {0, 1, 2})]
)
@pytest.mark.parametrize("sub_rays", SUB_RAYS)
def test_a_beam_blends_as_with_numpy(
    warp: WarpCaster,
    surfaces: tuple[Float32Array, Int32Array],
    sub_rays: Literal[7, 19],
    limits: Limits,
    counts: set[int],
) -> None:
    reflectivity, owners = surfaces
    want, n_groups = blend_by_numpy(warp, reflectivity, owners, sub_rays, limits)
    got = spread_echo(warp, reflectivity, fan(), ORIGIN_M, owners, sub_rays, limits)
    assert set(np.unique(n_groups)) >= counts
    if limits != EVERYWHERE:
        free = spread_echo(warp, reflectivity, fan(), ORIGIN_M, owners, sub_rays)
        assert (free.geom != got.geom).sum() > 20
    assert (want.owner_share[want.geom >= 0] < 0.95).any()
    is_hit = want.geom >= 0
    np.testing.assert_array_equal(got.geom, want.geom)
    np.testing.assert_array_equal(got.owner[is_hit], want.owner[is_hit])
    for name in ("range_m", "photons", "cosine", "true_range_m", "owner_share"):
        mine, theirs = getattr(got, name), getattr(want, name)
        assert mine.dtype == theirs.dtype
        np.testing.assert_allclose(mine[is_hit], theirs[is_hit], rtol=2e-6, err_msg=name)
        np.testing.assert_array_equal(mine[~is_hit], theirs[~is_hit], err_msg=name)


def test_retroreflectors_are_left_to_numpy(warp: WarpCaster, surfaces: tuple[Float32Array, Int32Array]) -> None:
    reflectivity, owners = surfaces[0].copy(), surfaces[1]
    reflectivity[::9] = 2 * RETRO_FROM
    want, _ = blend_by_numpy(warp, reflectivity, owners, 7)
    got = spread_echo(warp, reflectivity, fan(), ORIGIN_M, owners, 7)
    for each in fields(Echo):
        np.testing.assert_array_equal(getattr(got, each.name), getattr(want, each.name))
    assert want.photons.max() > 1000 * surfaces[0].max()
