from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, Int64Array, make_pose
from scenarios.schema import Prop, Scenario
from sim.geometry.mesh import Mesh, box_mesh, cylinder_mesh, move_mesh
from sim.geometry.raycast import Caster, model_meshes
from sim.rock.centreline import build_centreline
from sim.rock.tunnel import mesh_tunnel
from sim.scene import World, build_world, compile_model


def unit_vectors(count: int, seed: int) -> Float64Array:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def inside_out(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces[:, ::-1])


def test_every_ray_in_a_cube_room_lands_on_the_nearest_wall() -> None:
    room = Caster([inside_out(box_mesh((3.0, 3.0, 3.0)))])
    directions = unit_vectors(5000, seed=0)
    ranges_m, ids, cosines = room.cast(np.zeros((5000, 3)), directions)
    np.testing.assert_allclose(ranges_m, 3.0 / np.abs(directions).max(axis=1), atol=1e-5)
    np.testing.assert_allclose(cosines, np.abs(directions).max(axis=1), atol=1e-5)
    assert (ids == 0).all()


def test_a_ray_that_meets_nothing() -> None:
    ranges_m, ids, cosines = Caster([box_mesh((1, 1, 1))]).cast(np.array([[5.0, 0, 0]]), np.array([[1.0, 0, 0]]))
    assert (ranges_m[0], ids[0], cosines[0]) == (np.inf, -1, 0.0)


def test_meshes_are_numbered_in_their_order() -> None:
    shift = np.eye(4)
    meshes = []
    for place in (0.0, 4.0, 8.0):
        shift[0, 3] = place
        meshes.append(move_mesh(box_mesh((1, 1, 1)), shift))
    ranges_m, ids, _ = Caster(meshes).cast(np.array([[0, 0, 9.0], [4, 0, 9], [8, 0, 9]]), np.tile([0, 0, -1.0], (3, 1)))
    assert ids.tolist() == [0, 1, 2]
    np.testing.assert_allclose(ranges_m, 8.0, atol=1e-5)


def test_far_from_the_origin_ranges_keep_their_precision() -> None:
    far = np.eye(4)
    far[:3, 3] = (40_000.0, -25_000.0, 300.0)
    ranges_m, _, _ = Caster([move_mesh(box_mesh((1, 1, 1)), far)]).cast(
        far[None, :3, 3] + [[0.0, 0.0, 3.3]], np.array([[0, 0, -1.0]])
    )
    assert ranges_m[0] == pytest.approx(2.3, abs=1e-5)


def crowded_room(n_boxes: int) -> list[Mesh]:
    """Return a room, and boxes in it that stand in one another and in its walls."""
    generator = np.random.default_rng(n_boxes)
    boxes = [
        move_mesh(box_mesh(generator.uniform(0.05, 0.4, 3)), make_pose(translation=generator.uniform(-3.2, 3.2, 3)))
        for _ in range(n_boxes)
    ]
    return [inside_out(box_mesh((3.0, 3.0, 3.0))), *boxes]


def test_trees_built_onto_one_another_answer_as_one_tree() -> None:
    meshes = crowded_room(12)
    origins = np.random.default_rng(1).uniform(-2.9, 2.9, (4000, 3))
    directions = unit_vectors(4000, seed=2)
    together = Caster(meshes)
    bare = Caster(meshes[:1])
    some = Caster(meshes[:5], onto=bare)
    every = Caster(meshes, onto=some)
    assert len({*together.hits(origins, directions)[1].tolist()}) > 10
    for name in ("cast", "hits", "faces"):
        for one, layered in zip(
            getattr(together, name)(origins, directions), getattr(every, name)(origins, directions), strict=True
        ):
            assert one.tobytes() == layered.tobytes()
    assert (bare.hits(origins, directions)[1] == 0).all()
    assert every.n_meshes == 13
    assert some.hits(origins, directions)[1].max() == 4


def test_meshes_that_move_the_centre_of_the_scene_are_cast_as_one_tree() -> None:
    room, far = crowded_room(0)[0], move_mesh(box_mesh((1, 1, 1)), make_pose(translation=(40.3, 0.0, 0.0)))
    bare, both = Caster([room]), Caster([room, far], onto=Caster([room]))
    origins, directions = np.tile([20.123, 0.1, 0.2], (3, 1)), np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 0, 1.0]])
    assert (both.centre_m != bare.centre_m).any()
    for one, other in zip(Caster([room, far]).hits(origins, directions), both.hits(origins, directions), strict=True):
        assert one.tobytes() == other.tobytes()


def slow_hits(
    meshes: list[Mesh], origins: Float64Array, directions: Float64Array
) -> tuple[Float64Array, Int64Array, Float64Array]:
    """First hits by the book: every ray against every triangle's plane and edges, in float64."""
    triangles = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
    owner = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    normals = np.cross(first, second)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ranges_m, ids, cosines = np.full(len(origins), np.inf), np.full(len(origins), -1), np.zeros(len(origins))
    for ray, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        with np.errstate(divide="ignore", invalid="ignore"):
            reach_m = ((triangles[:, 0] - origin) * normals).sum(axis=1) / (normals @ direction)
        local = origin + reach_m[:, None] * direction - triangles[:, 0]
        # Barycentric coordinates by the areas of the parts.
        area = (np.cross(first, second) * normals).sum(axis=1)
        u = (np.cross(local, second) * normals).sum(axis=1) / area
        v = (np.cross(first, local) * normals).sum(axis=1) / area
        is_hit = np.isfinite(reach_m) & (reach_m > 0) & (u >= 0) & (v >= 0) & (u + v <= 1)
        if is_hit.any():
            nearest = np.argmin(np.where(is_hit, reach_m, np.inf))
            ranges_m[ray], ids[ray] = reach_m[nearest], owner[nearest]
            cosines[ray] = abs(normals[nearest] @ direction)
    return ranges_m, ids, cosines


def test_all_ways_of_casting_agree_with_every_triangle_tried() -> None:
    meshes = [
        move_mesh(cylinder_mesh(0.7, 1.5, 9), make_pose(translation=place)) for place in ((300, 2, 0), (303, 0, 1))
    ]
    meshes.append(move_mesh(box_mesh((1.0, 0.4, 0.3)), make_pose(translation=(301, -2, 0.5))))
    caster = Caster(meshes)
    width, height = 40, 30
    origins = np.random.default_rng(5).uniform((300.5, -1.5, -1.0), (302.0, 1.0, 1.0), size=(width, 3))
    directions = unit_vectors(width * height, seed=6).reshape(width, height, 3).astype(np.float32)
    starts = np.repeat(origins, height, axis=0)
    flat = directions.reshape(-1, 3)
    wanted_m, wanted_ids, wanted_cosines = slow_hits(meshes, starts, flat.astype(np.float64))
    assert 0.1 < np.isfinite(wanted_m).mean() < 0.9
    columns = [array.reshape(-1) for array in caster.cast_columns(origins, directions)]
    local = caster.cast_local((starts - caster.centre_m).astype(np.float32), flat)
    for ranges_m, ids, cosines in (columns, local, caster.cast(starts, flat)):
        np.testing.assert_array_equal(ids, wanted_ids)
        np.testing.assert_allclose(ranges_m, wanted_m, atol=1e-4)
        np.testing.assert_allclose(cosines, wanted_cosines, atol=1e-5)
    # Unit normals give the same cosine.
    _, _, normals = caster.hits(starts, flat)
    np.testing.assert_allclose(np.abs((normals * flat).sum(axis=1)), columns[2], atol=1e-6)


def test_casting_leaves_the_rays_as_they_were() -> None:
    room = Caster([inside_out(box_mesh((3.0, 3.0, 3.0)))])
    origins, directions = np.zeros((4, 3)), unit_vectors(20, seed=2).reshape(4, 5, 3).astype(np.float32)
    before = directions.copy()
    room.cast_columns(origins, directions)
    room.cast(np.zeros((20, 3)), directions.reshape(-1, 3))
    np.testing.assert_array_equal(directions, before)
    np.testing.assert_array_equal(origins, 0.0)


def reference(
    scenario: Scenario, world: World, seed: int, origin: Float64Array, directions: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """mj_multiRay, the reference, in one model of all that stands in the before session."""
    wall = mesh_tunnel(scenario.tunnel, build_centreline(scenario.tunnel, seed), seed)
    model, data = compile_model([wall], [item for item in world.standing if "before" in item.sessions])
    count = len(directions)
    ids, ranges_m = np.zeros(count, np.int32), np.zeros(count)
    mujoco.mj_multiRay(model, data, origin, directions.ravel(), None, True, -1, ids, ranges_m, None, count, 1e3)
    return ranges_m, ids


@pytest.mark.parametrize("with_props", [False, True])
def test_embree_agrees_with_mujoco(
    with_props: bool, make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]
) -> None:
    kinds = {"box": 0.2, "chair": 0.35, "trolley": 0.5, "railing": 0.65, "barrel": 0.8}
    sizes = {"box": (0.8, 0.6, 0.7), "chair": (0.5, 0.5, 0.9), "trolley": (0.6, 0.5, 1.2), "railing": (1.5, 0.1, 1.1)}
    props = [
        make_prop(kind, place, 0.7, 20.0, kind=kind, size_m=sizes.get(kind, (0.6, 0.6, 0.9)))
        for kind, place in kinds.items()
    ]
    props.append(make_prop("heap", 0.5, -0.8, kind="muck_pile", size_m=(2.0, 1.2, 0.5)))
    scenario = make_scenario(props=tuple(props) if with_props else ())
    world = build_world(scenario, 2)
    scene = world.before
    directions = unit_vectors(8000, seed=1) * (1.0, 1.0, 0.4)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origin = np.array([10.3, 0.21, 0.83])
    ranges_m, ids, _ = scene.caster.cast(np.tile(origin, (8000, 1)), directions)
    expected_m, expected_ids = reference(scenario, world, 2, origin, directions)
    # Round geoms are prisms of 64 sides here: rays that pass their rims may differ.
    same = ids == expected_ids
    assert same.mean() > (0.9995 if with_props else 0.99999)
    np.testing.assert_array_equal(np.isfinite(ranges_m), expected_m >= 0)
    np.testing.assert_allclose(ranges_m[same], expected_m[same], atol=5e-3 if with_props else 1e-4)
    assert np.quantile(np.abs(ranges_m[same] - expected_m[same]), 0.999) < 1e-3
    if with_props:
        assert len(np.unique(scene.instance[ids])) == len(props) + 1


def test_unknown_geoms_are_refused() -> None:
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom type='sphere' size='1'/></worldbody></mujoco>")
    data = mujoco.MjData(model)
    with pytest.raises(ValueError, match="only meshes, boxes and cylinders"):
        model_meshes(model, data)
