from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from cdpipe.geometry import Float64Array
from scenarios.schema import Prop, Scenario
from sim.mesh import Mesh, box_mesh, moved
from sim.raycast import Caster, model_meshes
from sim.scene import Scene, build_world


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
        meshes.append(moved(box_mesh((1, 1, 1)), shift))
    ranges_m, ids, _ = Caster(meshes).cast(np.array([[0, 0, 9.0], [4, 0, 9], [8, 0, 9]]), np.tile([0, 0, -1.0], (3, 1)))
    assert ids.tolist() == [0, 1, 2]
    np.testing.assert_allclose(ranges_m, 8.0, atol=1e-5)


def test_far_from_the_origin_ranges_keep_their_precision() -> None:
    far = np.eye(4)
    far[:3, 3] = (40_000.0, -25_000.0, 300.0)
    ranges_m, _, _ = Caster([moved(box_mesh((1, 1, 1)), far)]).cast(
        far[None, :3, 3] + [[0.0, 0.0, 3.3]], np.array([[0, 0, -1.0]])
    )
    assert ranges_m[0] == pytest.approx(2.3, abs=1e-5)


def reference(scene: Scene, origin: Float64Array, directions: Float64Array) -> tuple[Float64Array, Float64Array]:
    """mj_multiRay, the reference."""
    count = len(directions)
    ids, ranges_m = np.zeros(count, np.int32), np.zeros(count)
    mujoco.mj_multiRay(
        scene.model, scene.data, origin, directions.ravel(), None, True, -1, ids, ranges_m, None, count, 1e3
    )
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
    scene = build_world(make_scenario(props=tuple(props) if with_props else ()), 2).before
    directions = unit_vectors(8000, seed=1) * (1.0, 1.0, 0.4)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origin = np.array([10.3, 0.21, 0.83])
    ranges_m, ids, _ = scene.caster.cast(np.tile(origin, (8000, 1)), directions)
    expected_m, expected_ids = reference(scene, origin, directions)
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
