from __future__ import annotations

import gc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array
from scenarios.schema import (
    Drift,
    Duct,
    Floor,
    Furniture,
    Pipe,
    Place,
    Prop,
    Scenario,
    Section,
    Shift,
    Stones,
    Tunnel,
)
from sim.geometry.raycast import model_meshes
from sim.materials import REFLECTIVITY
from sim.placement.placing import Standing
from sim.rock.centreline import build_centreline
from sim.rock.tunnel import mesh_tunnel
from sim.scene import Scene, World, build_world, compile_model
from sim.session.labels import list_changes
from sim.session.simulate import simulate_pair


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
    box = make_prop("box", fraction=0.4, lateral=0.0, yaw_deg=90.0)
    side = make_prop("side", fraction=0.7, lateral=1.0, yaw_deg=90.0)
    middle, at_wall = build_world(make_scenario(tunnel=level_tunnel, props=(box, side)), 0).standing
    np.testing.assert_allclose(middle.world_T_object[:3, 3], [8.0, 0.0, 0.0], atol=5e-3)
    np.testing.assert_allclose(middle.world_T_object[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=5e-3)
    # Turned, it is 0.8 m across; the wall at y = 2, a cell of 0.25 m and 5 cm are kept free, and its rounded foot.
    np.testing.assert_allclose(at_wall.world_T_object[:2, 3], [14.0, 2.0 - 0.25 - 0.05 - 0.4], atol=0.06)


def standing_in(world: World, session: str) -> list[Standing]:
    return [item for item in world.standing if session in item.sessions]


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
    before, after = (compile_model([], standing_in(world, session))[0] for session in ("before", "after"))
    for name in ("prop/stays", "world"):
        np.testing.assert_array_equal(before.body(name).pos, after.body(name).pos)
        np.testing.assert_array_equal(before.body(name).quat, after.body(name).quat)
    assert sorted(before.body(i).name for i in range(before.nbody)) == ["prop/goes", "prop/gone", "prop/stays", "world"]
    assert sorted(after.body(i).name for i in range(after.nbody)) == ["prop/goes", "prop/new", "prop/stays", "world"]
    moved_m = after.body("prop/goes").pos - before.body("prop/goes").pos
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

    with pytest.raises(ScenarioError, match="props 'one' and 'two' "):
        build(make_prop("one", 0.40), make_prop("two", 0.42))
    with pytest.raises(ScenarioError, match=r"prop 'wide' .*5\.00 m .*'a' and 'b' .*3\.[2-4]"):
        build(make_prop("wide", size_m=(1.0, 5.0, 1.0)))
    with pytest.raises(ScenarioError, match="prop 'pole' falls over"):
        slope = level_tunnel.model_copy(update={"nodes": {"a": (0, 0, 0), "b": (20, 0, 3.5)}})
        pole = make_prop("pole", 0.5, 0.0, size_m=(0.2, 0.2, 1.5))
        build_world(make_scenario(tunnel=slope, props=(pole,)), 0)


def everything(make_prop: Callable[..., Prop]) -> tuple[Prop, ...]:
    return (
        make_prop("gone", 0.15, change="removed"),
        make_prop("stays", 0.3, -0.8, 33.0, kind="chair", size_m=(0.5, 0.5, 0.9)),
        make_prop("new", 0.15, 0.7, change="added"),
        make_prop("goes", 0.5, change="moved", to=Place(between=("a", "b"), fraction=0.6, lateral=0.5)),
        make_prop("slides", 0.7, change="moved", shift=Shift(distance_m=0.4)),
        make_prop("returns", 0.8, change="moved", to=Place(between=("a", "b"), fraction=0.8, lateral=0.9)),
        make_prop("turns", 0.4, -0.6, change="moved", shift=Shift(distance_m=1e-4, turn_deg=2.0)),
        make_prop("lies", 0.5, -0.8, place=Place(between=("a", "b"), fraction=0.5, lateral=-0.8, posture="tipped")),
        make_prop("heap", 0.65, -0.8, kind="muck_pile", size_m=(2.0, 1.4, 0.6), change="reshaped", loaded_share=0.4),
        make_prop("mound", 0.85, -0.8, kind="muck_pile", size_m=(1.6, 1.2, 0.5)),
    )


def part_vertices(scene: Scene) -> dict[str, list[Float64Array]]:
    found: dict[str, list[Float64Array]] = {}
    for part, mesh in zip(scene.parts, scene.meshes, strict=True):
        found.setdefault(part, []).append(mesh.vertices)
    return found


def test_the_listed_changes_are_the_parts_that_differ_and_no_others(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], furnished: Tunnel
) -> None:
    scenario = make_scenario(tunnel=furnished, props=everything(make_prop))
    world = build_world(scenario, 4)
    before, after = part_vertices(world.before), part_vertices(world.after)
    differ = set()
    for name in before.keys() | after.keys():
        a, b = before.get(name, []), after.get(name, [])
        same = len(a) == len(b) and all(x.shape == y.shape for x, y in zip(a, b, strict=True))
        if not same or any(np.linalg.norm(x - y, axis=1).max() > 1e-3 for x, y in zip(a, b, strict=True)):
            differ.add(name)
        else:
            for x, y in zip(a, b, strict=True):
                np.testing.assert_array_equal(x, y)
    changes = [tally.change for tally in list_changes(scenario, world)]
    assert {change.name for change in changes} == differ == {"gone", "new", "goes", "slides", "turns", "heap"}
    kinds = {change.name: change.kind for change in changes}
    assert kinds == {
        "gone": "removed",
        "new": "added",
        "goes": "moved",
        "slides": "moved",
        "turns": "moved",
        "heap": "reshaped",
    }


@pytest.fixture(scope="module")
def furnished(level_tunnel: Tunnel) -> Tunnel:
    furniture = Furniture(pipes=(Pipe(diameter_m=0.15, side="right"),), ducts=(Duct(diameter_m=0.5),))
    floor = Floor(stones=Stones(per_m2=1.0))
    return level_tunnel.model_copy(update={"furniture": furniture, "floor": floor, "reflectivity": 0.17})


def test_what_is_fixed_stands_in_both_sessions_and_is_no_prop(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], furnished: Tunnel
) -> None:
    props = (make_prop("box", change="added"), make_prop("crate", 0.7, reflectivity=0.66))
    world = build_world(make_scenario(tunnel=furnished, props=props), 0)
    names = [fixture.name for fixture in world.fixtures]
    assert "stones" in names and len(names) >= 3
    for scene, own in ((world.before, ["crate"]), (world.after, ["box", "crate"])):
        assert scene.parts[0] == "wall"
        assert list(scene.parts[1 : 1 + len(names)]) == names
        assert list(dict.fromkeys(scene.parts[1 + len(names) :])) == own
        assert (scene.instance[: 1 + len(names)] == 0).all()
        assert (scene.instance[1 + len(names) :] > 0).all()
        shares = dict(zip(scene.parts, scene.reflectivity, strict=True))
        assert (shares["wall"], shares["stones"], shares["crate"]) == pytest.approx((0.17, 0.17, 0.66))
        for fixture, share in zip(world.fixtures, scene.reflectivity[1:], strict=False):
            if fixture.material != "rock":
                assert share == pytest.approx(REFLECTIVITY[fixture.material])
    # The fixed caster meets the duct, the walls' one does not.
    up = np.array([[0.0, 0.0, 1.0]])
    y = np.linspace(-1.9, 1.9, 39)
    origins = np.column_stack([np.full(39, 10.0), y, np.full(39, 0.5)])
    bare, hung = (caster.cast(origins, np.repeat(up, 39, axis=0))[0] for caster in (world.walls, world.fixed))
    assert (hung < bare - 0.1).any()


def test_no_stone_lies_under_a_prop_of_either_session(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], furnished: Tunnel
) -> None:
    strewn = furnished.model_copy(update={"floor": Floor(stones=Stones(per_m2=6.0))})
    goal = Place(between=("a", "b"), fraction=0.7, lateral=0.0)
    props = (make_prop("box", 0.4, 0.0, size_m=(2.0, 1.5, 0.5), change="moved", to=goal),)
    world = build_world(make_scenario(tunnel=strewn, props=props), 0)
    stones = next(fixture for fixture in world.fixtures if fixture.name == "stones").mesh.vertices
    for x in (8.0, 14.0):
        assert not ((np.abs(stones[:, 0] - x) < 1.0) & (np.abs(stones[:, 1]) < 0.75)).any()
    assert ((np.abs(stones[:, 0] - 11.0) < 1.0) & (np.abs(stones[:, 1]) < 0.75)).any()


def test_scenes_hold_the_geoms_of_one_whole_model_to_the_bit_and_in_its_order(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], furnished: Tunnel
) -> None:
    scenario = make_scenario(tunnel=furnished, props=everything(make_prop))
    world = build_world(scenario, 4)
    wall = mesh_tunnel(furnished, build_centreline(furnished, 4), 4)
    fixed = [wall, *(fixture.mesh for fixture in world.fixtures)]
    assert len(fixed) >= 4
    for session, scene in (("before", world.before), ("after", world.after)):
        model, data = compile_model(fixed, standing_in(world, session))
        whole = model_meshes(model, data)
        assert len(whole) == model.ngeom == len(scene.meshes) == len(scene.instance)
        for expected, mesh in zip(whole, scene.meshes, strict=True):
            np.testing.assert_array_equal(mesh.vertices, expected.vertices)
            np.testing.assert_array_equal(mesh.faces, expected.faces)
        owners = [model.body(body).name.removeprefix("prop/") for body in model.geom_bodyid[len(fixed) :]]
        assert owners == list(scene.parts[len(fixed) :])


def test_what_is_fixed_is_kept_once_and_no_view_of_a_compiled_model(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], furnished: Tunnel
) -> None:
    world = build_world(make_scenario(tunnel=furnished, props=(make_prop("box", change="added"),)), 0)
    n_fixed = 1 + len(world.fixtures)
    assert len(world.before.meshes) == n_fixed
    for one, other in zip(world.before.meshes[:n_fixed], world.after.meshes[:n_fixed], strict=True):
        assert one is other
    for mesh in world.after.meshes:
        for array in (mesh.vertices, mesh.faces):
            owner: object = array
            while isinstance(owner, np.ndarray) and owner.base is not None:
                owner = owner.base
            assert isinstance(owner, np.ndarray), f"a view into {type(owner)}"


def test_while_sessions_are_written_only_their_scenes_are_left_of_the_world(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], tmp_path: Path
) -> None:
    def worlds() -> int:
        gc.collect()
        return sum(type(item) is World for item in gc.get_objects())  # isinstance would ask lazy modules

    seen = {}
    already = worlds()  # fixtures of other modules
    simulate_pair(
        make_scenario(props=(make_prop("box", change="added"),)),
        0,
        tmp_path / "pair",
        lambda stage, done, total: seen.__setitem__(stage, worlds() - already),
    )
    assert seen["before"] == seen["after"] == 0
