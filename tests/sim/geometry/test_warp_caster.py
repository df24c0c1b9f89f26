"""Warp's casts on the CPU against those of Embree; on a GPU the same kernels run."""

from __future__ import annotations

import importlib.util
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from cdpipe.core.geometry import Float32Array, Float64Array, Int32Array, yaw_pose
from cdpipe.sensor.ouster import SensorMetadata
from sim.geometry.bundles import make_bundle_rays
from sim.geometry.mesh import Mesh, box_mesh, cylinder_mesh, move_mesh
from sim.geometry.raycast import Caster, RayCaster
from sim.sensor.footprint import beam_bundle, sub_ray_pattern
from sim.sensor.rays import Rays, revolution_rays

if importlib.util.find_spec("warp") is None:
    pytest.skip("needs the extra `gpu`: warp-lang", allow_module_level=True)

from sim.geometry.warp_caster import WarpCaster

STEP = 3  # 171 columns: no multiple of the columns that Embree's caster takes at a time
FAR_M = np.array([210.0, -35.0, 4.0])  # the scene lies far from the origin


def stand(yaw_rad: float, shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Float64Array:
    return yaw_pose(yaw_rad, np.add(FAR_M, shift_m))


@pytest.fixture(scope="module")
def meshes() -> list[Mesh]:
    """A room that lacks its roof, far from the origin, with a box and a drum that stand apart."""
    room = box_mesh((6.0, 4.0, 2.0))
    open_room = Mesh(room.vertices, room.faces[np.cross(*_edges(room)).astype(np.float64)[:, 2] <= 0])
    drum, box = cylinder_mesh(0.4, 0.5, 64), box_mesh((0.5, 0.3, 0.4))
    places = stand(0.0), stand(0.4, (2.0, 1.0, -1.0)), stand(0.7, (-2.5, -1.0, -1.3))
    return [move_mesh(mesh, place) for mesh, place in zip((open_room, drum, box), places, strict=True)]


def _edges(mesh: Mesh) -> tuple[Float64Array, Float64Array]:
    corners = mesh.vertices[mesh.faces]
    return corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]


@pytest.fixture(scope="module")
def embree(meshes: list[Mesh]) -> Caster:
    return Caster(meshes)


@pytest.fixture(scope="module")
def warp(meshes: list[Mesh], embree: Caster) -> WarpCaster:
    return WarpCaster(meshes, embree.centre_m, "cpu")


@pytest.fixture(scope="module")
def rays(sensor: SensorMetadata) -> Rays:
    """Every third column of a revolution of a sensor that moves and turns."""
    poses = np.stack([stand(0.001 * t, (0.001 * t, 0.2, 0.1)) for t in range(sensor.width)])
    whole = revolution_rays(sensor, poses)
    return Rays(whole.origins[::STEP].copy(), whole.directions[::STEP].copy())


def require_same(
    got: tuple[Float32Array, Int32Array, Float32Array], want: tuple[Float32Array, Int32Array, Float32Array]
) -> None:
    is_same = got[1] == want[1]
    assert is_same.mean() > 0.9999  # on an edge either of two meshes may be met
    for mine, theirs in zip(got[::2], want[::2], strict=True):
        np.testing.assert_allclose(mine[is_same], theirs[is_same], atol=1e-5)


def test_rays_meet_what_embree_meets_at_the_same_range(embree: Caster, warp: WarpCaster, rays: Rays) -> None:
    got, want = (each.cast_columns(rays.origins, rays.directions) for each in (warp, embree))
    assert set(np.unique(want[1])) == {-1, 0, 1, 2}  # all of it is seen, and the sky
    require_same(got, want)
    assert np.isinf(got[0][got[1] < 0]).all()
    assert not got[2][got[1] < 0].any()


@pytest.mark.parametrize("sub_rays", [7, 19])
def test_the_kernel_makes_the_rays_of_a_beam_to_the_bit(
    embree: Caster, warp: WarpCaster, rays: Rays, sub_rays: int
) -> None:
    bundle = beam_bundle(sub_ray_pattern(sub_rays)[0])
    got = warp.cast_bundles(rays.origins, rays.directions, bundle)
    for mine, theirs in zip(got, RayCaster.cast_bundles(warp, rays.origins, rays.directions, bundle), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    require_same(got, embree.cast_bundles(rays.origins, rays.directions, bundle))


def test_embree_casts_some_columns_at_a_time_with_the_same_bytes(embree: Caster, rays: Rays) -> None:
    bundle = beam_bundle(sub_ray_pattern(7)[0])
    local = make_bundle_rays(rays.origins, rays.directions, bundle, embree.centre_m)
    got = embree.cast_bundles(rays.origins, rays.directions, bundle)
    for mine, theirs in zip(got, embree.cast_local(*local), strict=True):
        np.testing.assert_array_equal(mine, theirs.reshape(-1, 7).T)


def test_threads_get_the_bytes_of_one(warp: WarpCaster, rays: Rays) -> None:
    bundle = beam_bundle(sub_ray_pattern(7)[0])
    alone = warp.cast_bundles(rays.origins, rays.directions, bundle)
    with ThreadPoolExecutor(4) as pool:
        every = list(pool.map(lambda _: warp.cast_bundles(rays.origins, rays.directions, bundle), range(8)))
    for hits in every:
        assert all(mine.tobytes() == theirs.tobytes() for mine, theirs in zip(hits, alone, strict=True))


def test_a_face_without_area_is_no_obstacle(embree: Caster) -> None:
    corners = np.array([[1.0, 0, 0], [1, 1, 0], [1, 2, 0], [2, -1, -1], [2, 1, -1], [2, 0, 1]])
    sliver = Mesh(corners, np.array([[0, 1, 2], [3, 4, 5]], np.int32))
    way = np.array([[1.0, 0.0, 0.0]], np.float32)
    ranges_m, ids, cosines = WarpCaster([sliver], np.zeros(3), "cpu").cast_local(np.zeros((1, 3), np.float32), way)
    assert (ranges_m[0], ids[0], cosines[0]) == (2.0, 0, 1.0)
