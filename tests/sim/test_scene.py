from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from cdpipe.errors import ScenarioError
from scenarios.schema import Drift, Place, Prop, Scenario, Section, Tunnel
from sim.scene import build_world


@pytest.fixture(scope="module")
def level_tunnel() -> Tunnel:
    return Tunnel(
        nodes={"a": (0, 0, 0), "b": (20, 0, 0)},
        drifts=(Drift(nodes=("a", "b")),),
        section=Section(shape="rectangle", width_m=4.0, height_m=3.0),
        resolution_m=0.25,
    )


def test_on_a_level_floor_a_box_rests_where_it_was_placed(
    level_tunnel: Tunnel, make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]
) -> None:
    box = make_prop("box", fraction=0.4, lateral=1.0, yaw_deg=90.0)
    world = build_world(make_scenario(tunnel=level_tunnel, props=(box,)), 0)
    pose = world.standing[0].world_T_object
    # Turned, it is 0.8 m across; the wall at y = 2, a cell of 0.25 m and 5 cm are kept free.
    np.testing.assert_allclose(pose[:3, 3], [8.0, 2.0 - 0.25 - 0.05 - 0.4, 0.0], atol=5e-3)
    np.testing.assert_allclose(pose[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=5e-3)


def test_an_unchanged_prop_has_the_very_same_pose_in_both_models(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]
) -> None:
    props = (
        make_prop("gone", 0.2, change="removed"),
        make_prop("stays", 0.5, -0.8, 33.0, kind="chair", size_m=(0.5, 0.5, 0.9)),
        make_prop("new", 0.2, 0.7, change="added"),  # where "gone" stood
        make_prop("goes", 0.7, change="moved", to=Place(between=("a", "b"), fraction=0.8, lateral=0.5)),
    )
    world = build_world(make_scenario(props=props), 4)
    before, after = world.before.model, world.after.model
    for name in ("stays", "world"):
        np.testing.assert_array_equal(before.body(name).pos, after.body(name).pos)
        np.testing.assert_array_equal(before.body(name).quat, after.body(name).quat)
    assert sorted(before.body(i).name for i in range(before.nbody)) == ["goes", "gone", "stays", "world"]
    assert sorted(after.body(i).name for i in range(after.nbody)) == ["goes", "new", "stays", "world"]
    moved_m = after.body("goes").pos - before.body("goes").pos
    assert moved_m[0] == pytest.approx(2.0, abs=0.02)
    np.testing.assert_array_equal(np.unique(world.before.instance), [0, 1, 2, 4])
    np.testing.assert_array_equal(np.unique(world.after.instance), [0, 2, 3, 4])


def test_settled_props_touch_the_floor(make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]) -> None:
    sizes = {"box": (1.6, 1.2, 1.0), "chair": (0.5, 0.5, 0.9), "trolley": (0.6, 0.5, 1.2), "barrel": (0.6, 0.6, 0.9)}
    props = tuple(
        make_prop(kind, 0.2 + 0.2 * i, 0.8 * (-1) ** i, 40.0 * i, kind=kind, size_m=size)
        for i, (kind, size) in enumerate(sizes.items())
    )
    world = build_world(make_scenario(props=props), 6)
    for number in range(1, 5):
        own = [mesh for mesh, owner in zip(world.before.meshes, world.before.instance, strict=True) if owner == number]
        corners = np.concatenate([mesh.vertices for mesh in own])
        # From above every corner down to the wall mesh: how far is the corner from the floor?
        up, down = np.array([0.0, 0.0, 1.2]), np.tile([0.0, 0.0, -1.0], (len(corners), 1))
        gap_m = world.walls.cast(corners + up, down)[0] - up[2]
        assert -0.06 < gap_m.min() < 0.03


def test_worlds_that_contradict_themselves_are_refused(
    level_tunnel: Tunnel, make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]
) -> None:
    def build(*props: Prop) -> None:
        build_world(make_scenario(tunnel=level_tunnel, props=props), 0)

    with pytest.raises(ScenarioError, match="props 'one' and 'two' stand in one another in the before session"):
        build(make_prop("one", 0.40), make_prop("two", 0.42))
    with pytest.raises(
        ScenarioError, match=r"prop 'wide' is 5\.00 m across, but between 'a' and 'b' at 0\.40 only 3\.4"
    ):
        build(make_prop("wide", size_m=(1.0, 5.0, 1.0)))
    with pytest.raises(ScenarioError, match="prop 'pole' falls over"):
        slope = level_tunnel.model_copy(update={"nodes": {"a": (0, 0, 0), "b": (20, 0, 3.5)}})
        pole = make_prop("pole", 0.5, 0.0, size_m=(0.2, 0.2, 1.5))
        build_world(make_scenario(tunnel=slope, props=(pole,)), 0)
