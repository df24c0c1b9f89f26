from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float32Array, Float64Array, Int32Array, make_pose
from cdpipe.sensor.ouster import SensorMetadata
from sim.geometry.bundles import make_bundle_rays
from sim.geometry.mesh import Mesh, move_mesh
from sim.geometry.raycast import Caster
from sim.movers.casting import MovingCaster
from sim.movers.mover import MovingBody
from sim.sensor.footprint import beam_bundle, central_echo, spread_echo, sub_ray_pattern
from sim.sensor.rays import Rays, revolution_rays

Hits = tuple[Float32Array, Int32Array, Float32Array]
MakeBody = Callable[..., MovingBody]
PLACES = {"one ray": np.zeros((1, 2)), "seven rays": sub_ray_pattern(7)[0]}
KINDS = ("person", "forklift", "loader", "curtain")


def columns_of(sensor: SensorMetadata, start_s: float) -> tuple[Rays, Float64Array]:
    """A revolution of a sensor that drives past at 2 m/s and tilts; and the time of each column."""
    time_s = start_s + np.arange(sensor.width) / (sensor.rate_hz * sensor.width)
    turns = Rotation.from_euler("ZYX", np.column_stack([0.3 * time_s, 0.1 * time_s, 0.2 * time_s]))
    place = np.column_stack([1.0 + 2.0 * time_s, 5.0 + 0.0 * time_s, 1.0 + 0.0 * time_s])
    return revolution_rays(sensor, make_pose(turns.as_matrix(), place)), time_s


def brute_force(fixed: Sequence[Mesh], movers: Sequence[MovingBody], column_s: float, rays: list[Float32Array]) -> Hits:
    """Cast rays, given from the origin, at one static scene of everything where it is at one time."""
    meshes = list(fixed)
    for mover in movers:
        poses = mover.world_T_links(np.array([column_s]))[:, 0]
        meshes += [
            move_mesh(mesh, pose) for limb, pose in zip(mover.figure.limbs, poses, strict=True) for mesh in limb.meshes
        ]
    return Caster(meshes).cast(*rays)


@pytest.mark.parametrize("places", PLACES.values(), ids=PLACES)
@pytest.mark.parametrize("kinds", [*((kind,) for kind in KINDS), ("person", "forklift", "curtain", "person")])
def test_a_posed_cast_equals_a_static_scene_for_every_column(
    kinds: tuple[str, ...], places: Float64Array, sensor: SensorMetadata, make_body: MakeBody, floor: Mesh
) -> None:
    movers = [make_body(kind, number + 1, 1.7 * number) for number, kind in enumerate(kinds)]
    rays, time_s = columns_of(sensor, 1.0)
    fixed = Caster([floor])
    caster = MovingCaster(fixed, 1, movers, time_s)
    local = make_bundle_rays(rays.origins, rays.directions, beam_bundle(places), fixed.centre_m)
    got_m, got, got_cosine = (each.reshape(sensor.width, -1) for each in caster.cast_local(*local))
    assert (got > 0).sum() > 50  # the movers are met
    per_column = len(local[0]) // sensor.width
    columns = range(0, sensor.width, 11)
    want_m, want, want_cosine = np.empty((3, len(columns), per_column), np.float32)
    for number, column in enumerate(columns):
        rows = slice(column * per_column, (column + 1) * per_column)
        own = [local[0][rows] + fixed.centre_m, local[1][rows]]
        want_m[number], want[number], want_cosine[number] = brute_force([floor], movers, time_s[column], own)
    got_m, got, got_cosine = got_m[columns], got[columns], got_cosine[columns]
    np.testing.assert_allclose(got_m, want_m, atol=1e-5)
    is_same = want == got
    assert is_same.mean() > 0.999  # where two solids share a face either may be met
    np.testing.assert_allclose(got_cosine[is_same], want_cosine[is_same], atol=1e-3)


def test_a_scan_that_rolls_does_not_see_the_mover_as_it_is_at_one_time(
    sensor: SensorMetadata, make_body: MakeBody, floor: Mesh
) -> None:
    mover = make_body("forklift")
    rays, time_s = columns_of(sensor, 1.0)
    rolling = MovingCaster(Caster([floor]), 1, [mover], time_s).cast_columns(rays.origins, rays.directions)
    at_once = MovingCaster(Caster([floor]), 1, [mover], np.full_like(time_s, 1.0)).cast_columns(
        rays.origins, rays.directions
    )
    both = (rolling[1] > 0) & (at_once[1] > 0)
    assert np.abs(rolling[0][both] - at_once[0][both]).max() > 0.05  # 0.1 s at 2 m/s


@pytest.mark.parametrize("kind", ["person", "forklift", "loader"])
def test_a_mover_that_stands_still_equals_a_prop_that_stands_there(
    kind: str, sensor: SensorMetadata, make_body: MakeBody, floor: Mesh
) -> None:
    mover = make_body(kind)
    rays, time_s = columns_of(sensor, 1.0)
    poses = mover.world_T_links(np.zeros(1))[:, 0]
    # all columns are those of one time
    moving = MovingCaster(Caster([floor]), 1, [mover], np.zeros_like(time_s))
    meshes = [
        move_mesh(mesh, pose) for limb, pose in zip(mover.figure.limbs, poses, strict=True) for mesh in limb.meshes
    ]
    shares = np.concatenate([[0.25], mover.figure.reflectivity]).astype(np.float32)
    owners = np.zeros(len(shares), np.int32)
    for echo_of, more in ((central_echo, ()), (spread_echo, (7,))):
        got = echo_of(moving, shares, rays, sensor.beam_origin_m, owners, *more)
        want = echo_of(Caster([floor, *meshes]), shares, rays, sensor.beam_origin_m, owners, *more)
        assert (want.geom > 0).sum() > 100
        # where two solids share a face either may be met, and their light differs
        assert (got.geom == want.geom).mean() > 0.997
        gap_m = np.abs(got.range_m - want.range_m)
        assert (gap_m < 2e-5).all() if not more else (gap_m < 1e-5).mean() > 0.98


def test_the_nearer_of_a_mover_and_a_wall_is_met(sensor: SensorMetadata, make_body: MakeBody, floor: Mesh) -> None:
    mover = make_body("person", speed_mps=0)
    rays, time_s = columns_of(sensor, 0.0)
    screen = Mesh(np.array([[-9.0, 4, -1], [20, 4, -1], [20, 4, 9], [-9, 4, 9]]), np.array([[0, 1, 2], [0, 2, 3]]))
    behind = MovingCaster(Caster([floor, screen]), 2, [mover], time_s).cast_columns(rays.origins, rays.directions)
    assert not (behind[1] >= 2).any()  # the screen stands between sensor and person
    free = MovingCaster(Caster([floor]), 1, [mover], time_s).cast_columns(rays.origins, rays.directions)
    assert (free[1] >= 1).any()


@pytest.mark.parametrize(("keeps_hits", "n_calls"), [(False, 4), (True, 1)])
def test_bundles_at_movers_are_cast_a_block_of_columns_at_a_time_but_at_once_on_a_device(
    keeps_hits: bool,
    n_calls: int,
    sensor: SensorMetadata,
    make_body: MakeBody,
    floor: Mesh,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rays, time_s = columns_of(sensor, 1.0)
    bundle, fixed = beam_bundle(sub_ray_pattern(7)[0]), Caster([floor])
    fixed.keeps_hits = keeps_hits
    movers = [make_body("person", 1), make_body("forklift", 2, 1.7)]
    local = make_bundle_rays(rays.origins, rays.directions, bundle, fixed.centre_m)
    want = MovingCaster(fixed, 1, movers, time_s).cast_local(*local)
    n_rays, cast = [], fixed.cast_local

    def counted(origins: Float32Array, directions: Float32Array) -> Hits:
        n_rays.append(len(origins))
        return cast(origins, directions)

    monkeypatch.setattr(fixed, "cast_local", counted)
    got = MovingCaster(fixed, 1, movers, time_s).cast_bundles(rays.origins, rays.directions, bundle)
    assert n_rays == [7 * sensor.height * sensor.width // n_calls] * n_calls
    assert (got[1] > 0).sum() > 50  # the movers are met
    for mine, whole in zip(got, want, strict=True):
        np.testing.assert_array_equal(mine, whole.reshape(-1, 7).T)
