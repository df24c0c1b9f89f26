from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, make_pose, transform
from scenarios.schema import Drift, Floor, Place, Prop, Roughness, Scenario, Section, Tunnel
from sim.geometry.mesh import Mesh, box_mesh
from sim.geometry.raycast import Caster
from sim.placement.contact import interpenetration_m, surface_points
from sim.placement.placing import Standing, bounding_rectangle, rectangles_overlap
from sim.scene import World, build_world
from sim.view import gallery

MakeScenario = Callable[..., Scenario]
MakeProp = Callable[..., Prop]

SIZES = {"box": (0.8, 0.6, 0.7), "chair": (0.5, 0.5, 0.9), "trolley": (0.6, 0.5, 1.2), "barrel": (0.58, 0.58, 0.9)}


@pytest.fixture(scope="module")
def level_tunnel() -> Tunnel:
    return Tunnel.model_validate(
        {
            "nodes": {"a": (0, 0, 0), "b": (20, 0, 0)},
            "drifts": [{"nodes": ["a", "b"]}],
            "section": Section(shape="rectangle", width_m=4.0, height_m=3.0).model_dump(),
            "resolution_m": 0.25,
        }
    )


def tilt_deg(item: Standing) -> float:
    return float(np.rad2deg(np.arccos(np.clip(item.world_T_object[2, 2], -1.0, 1.0))))


def world_points(item: Standing) -> Float64Array:
    return transform(item.world_T_object, surface_points(item.shape))


@pytest.fixture(scope="module")
def a_box(level_tunnel: Tunnel, make_scenario: MakeScenario, make_prop: MakeProp) -> Standing:
    """0.8 x 0.6 x 0.7 m."""
    return build_world(make_scenario(tunnel=level_tunnel, props=(make_prop("box"),)), 0).standing[0]


def test_interpenetration_by_hand(a_box: Standing) -> None:
    room = box_mesh((5.0, 5.0, 5.0))
    walls = Caster([Mesh(room.vertices, room.faces[:, ::-1])])
    for place, wanted in (
        ((0.0, 0.0, -5.0), 0.0),  # on the floor, to the float32 of the caster
        ((0.0, 0.0, -5.03), 0.03),
        ((4.65, 0.0, 0.0), 0.05),  # half of it is 0.4 m long, the wall at 5 m
        ((0.0, -4.68, -5.02), np.hypot(0.0, 0.02)),  # 2 cm in the floor, short of the wall by 2 cm
        ((4.65, 0.0, -5.02), np.hypot(0.05, 0.02)),  # the corner, in both
    ):
        item = replace(a_box, world_T_object=make_pose(translation=place))
        assert interpenetration_m(item, walls) == pytest.approx(wanted, rel=0.04, abs=2e-5)
    here, beside, inside = (
        replace(a_box, world_T_object=make_pose(translation=(x, 0.0, 0.0))) for x in (0.0, 0.81, 0.77)
    )
    assert interpenetration_m(here, walls, [beside]) == 0.0
    assert interpenetration_m(here, walls, [inside]) == pytest.approx(0.03, rel=0.04)


@pytest.fixture(scope="module")
def rough_world(make_scenario: MakeScenario, make_prop: MakeProp) -> World:
    """Every kind in every posture on a rough, rising floor."""
    tunnel = Tunnel.model_validate(
        {
            "nodes": {"a": (0, 0, 0), "b": (24, 1, 1.2)},
            "drifts": [{"nodes": ["a", "b"]}],
            "section": Section(width_m=5.0, height_m=3.4).model_dump(),
            "roughness": [
                Roughness(amplitude_m=0.12, length_m=1.8).model_dump(),
                Roughness(amplitude_m=0.05, length_m=0.6).model_dump(),
            ],
        }
    )
    props = [
        make_prop(f"{kind}-{posture}", kind=kind, size_m=size, place=Place(lateral=side, yaw_deg=turn, posture=posture))
        for posture, side in (("upright", 0.5), ("tipped", -0.5), ("leaning", 0.9))
        for turn, (kind, size) in zip((0.0, 40.0, 80.0, 120.0), SIZES.items(), strict=True)
        if (kind, posture) != ("box", "leaning")
    ]
    props.append(make_prop("plank", size_m=(1.8, 0.9, 0.1), place=Place(lateral=-0.9, posture="leaning")))
    return build_world(make_scenario(tunnel=tunnel, props=tuple(props)), 3)


def test_at_rest_nothing_is_a_centimetre_deep_in_rock_or_in_another(rough_world: World) -> None:
    for item in rough_world.standing:
        others = [other for other in rough_world.standing if other is not item]
        assert interpenetration_m(item, rough_world.fixed, others) < 0.01, item.prop.name


@pytest.mark.parametrize("kind", sorted(set(gallery.SIZES) - {"railing", "muck_pile"}))
def test_every_kind_that_is_not_set_into_the_floor_comes_to_rest_on_it(
    kind: str, level_tunnel: Tunnel, make_scenario: MakeScenario, make_prop: MakeProp
) -> None:
    prop = make_prop(kind, kind=kind, size_m=gallery.SIZES[kind])
    world = build_world(make_scenario(tunnel=level_tunnel, props=(prop,)), 3)
    (item,) = world.standing
    assert interpenetration_m(item, world.fixed, []) < 0.01
    assert abs(world_points(item)[:, 2].min()) < 0.01
    assert tilt_deg(item) < 30.0  # a rock lies on one of its faces


def test_everything_touches_the_floor_it_rests_on(rough_world: World) -> None:
    for item in rough_world.standing:
        points = world_points(item)
        low = points[points[:, 2] < points[:, 2].min() + 0.1]
        up, down = np.array([0.0, 0.0, 1.0]), np.tile([0.0, 0.0, -1.0], (len(low), 1))
        gap_m = rough_world.walls.cast(low + up, down)[0] - 1.0
        assert gap_m.min() < 0.01, item.prop.name


def test_postures_are_what_they_are_called(rough_world: World) -> None:
    for item in rough_world.standing:
        if item.posture == "upright":
            assert tilt_deg(item) < 15.0, item.prop.name
        elif item.posture == "tipped":
            assert 60.0 < tilt_deg(item) < 120.0, item.prop.name


def test_what_leans_touches_the_wall_above_its_foot(rough_world: World) -> None:
    leaning = [item for item in rough_world.standing if item.posture == "leaning"]
    assert len(leaning) == 4
    for item in leaning:
        assert item.wall is not None
        points = world_points(item)
        foot, top = points[:, 2].min(), points[:, 2].max()
        high = points[points[:, 2] > foot + 0.33 * (top - foot)]
        to_wall_m = rough_world.walls.cast(high, np.tile([*item.wall, 0.0], (len(high), 1)))[0]
        assert to_wall_m.min() < 0.03, item.prop.name
        # Its foot is farther from that wall than its top.
        low = points[points[:, 2] < foot + 0.1]
        assert (low @ [*item.wall, 0.0]).max() < (high @ [*item.wall, 0.0]).max() - 0.05


def test_what_is_too_squat_cannot_lean(make_scenario: MakeScenario, make_prop: MakeProp) -> None:
    place = Place(between=("a", "b"), fraction=0.4, lateral=0.9, posture="leaning")
    with pytest.raises(ScenarioError, match=r"prop 'cube' .*51 degrees"):
        build_world(make_scenario(props=(make_prop("cube", size_m=(0.6, 0.6, 0.6), place=place),)), 0)


def test_a_plank_stands_on_its_long_edge_to_lean(rough_world: World) -> None:
    plank = next(item for item in rough_world.standing if item.prop.name == "plank")
    # 1.8 x 0.9 x 0.1 m: level along its length, 0.9 m high less the lean.
    assert abs(plank.world_T_object[2, 0]) < 0.2
    assert 0.75 < np.ptp(world_points(plank)[:, 2]) < 1.2


def test_a_barrel_on_its_side_does_not_roll_down_a_slope(
    level_tunnel: Tunnel, make_scenario: MakeScenario, make_prop: MakeProp
) -> None:
    slope = level_tunnel.model_copy(update={"nodes": {"a": (0, 0, 0), "b": (20, 0, 2.0)}})
    place = Place(between=("a", "b"), fraction=0.5, posture="tipped")
    for name in ("one", "two", "three"):
        barrel = make_prop(name, kind="barrel", size_m=SIZES["barrel"], place=place)
        item = build_world(make_scenario(tunnel=slope, props=(barrel,)), 0).standing[0]
        assert 80.0 < tilt_deg(item) < 100.0
        assert abs(world_points(item)[:, 0].mean() - 10.0) < 0.3


def test_a_drawn_prop_that_falls_over_is_set_elsewhere(
    level_tunnel: Tunnel, make_scenario: MakeScenario, make_prop: MakeProp
) -> None:
    # Steep for the first half; only the second is fit for a pole.
    bent = level_tunnel.model_copy(
        update={
            "nodes": {"a": (0, 0, 0), "b": (12, 0, 2.1), "c": (24, 0, 2.1)},
            "drifts": (level_tunnel.drifts[0].model_copy(update={"nodes": ("a", "b", "c")}),),
        }
    )
    route = make_scenario().before.model_copy(update={"route": ("a", "b", "c")})
    x = []
    for name in ("one", "two", "three"):
        pole = make_prop(name, size_m=(0.2, 0.2, 1.5), place=Place(lateral=0.8))
        scenario = make_scenario(tunnel=bent, props=(pole,), before=route, after=route)
        x.append(build_world(scenario, 0).standing[0].world_T_object[0, 3])
    assert min(x) > 10.5
    place = Place(between=("a", "b"), fraction=0.5, lateral=0.8)
    with pytest.raises(ScenarioError, match="prop 'one' falls over"):
        scenario = make_scenario(tunnel=bent, props=(pole.model_copy(update={"name": "one", "place": place}),))
        build_world(scenario.model_copy(update={"before": route, "after": route}), 0)


def test_a_drawn_rock_without_a_face_to_stand_on_lies_as_it_comes_to_rest(
    level_tunnel: Tunnel, make_scenario: MakeScenario, make_prop: MakeProp
) -> None:
    def rest(place: Place, seed: int) -> Standing:
        rock = make_prop("rock", kind="rock", size_m=(0.87, 0.77, 0.63), place=place)
        return build_world(make_scenario(tunnel=level_tunnel, props=(rock,)), seed).standing[0]

    with pytest.raises(ScenarioError, match="prop 'rock' falls over"):
        rest(Place(between=("a", "b"), fraction=0.5), 38)
    lying = rest(Place(lateral=0.5), 38)
    assert tilt_deg(lying) > 20.0
    assert abs(world_points(lying)[:, 2].min()) < 0.01
    assert tilt_deg(rest(Place(lateral=0.5), 37)) < 20.0


def test_a_prop_settles_the_same_whoever_else_is_there(make_scenario: MakeScenario, make_prop: MakeProp) -> None:
    chair = make_prop("chair", 0.5, -0.7, 25.0, kind="chair", size_m=SIZES["chair"])
    barrel = make_prop("barrel", 0.7, 0.7, kind="barrel", size_m=SIZES["barrel"])
    alone, both = (build_world(make_scenario(props=props), 2) for props in ((chair,), (barrel, chair)))
    np.testing.assert_array_equal(alone.standing[0].world_T_object, both.standing[1].world_T_object)


def test_props_that_tilt_into_one_another_at_rest_are_refused(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]
) -> None:
    # 1 cm between two tall boxes on a floor that rolls: side by side on the level, into each other as they tilt.
    tunnel = Tunnel(
        nodes={"a": (0, 0, 0), "b": (20, 0, 0)},
        drifts=(Drift(nodes=("a", "b")),),
        section=Section(width_m=4.0, height_m=3.2),
        roughness=(Roughness(amplitude_m=0.16, length_m=1.5),),
        floor=Floor(roughness=0.5),
        resolution_m=0.2,
    )
    size_m = (0.5, 0.5, 0.9)
    refused = 0
    for seed in range(6):
        pair = [make_prop(f"box{n}", size_m=size_m, place=Place(at=(8.0 + 0.51 * n, 0.3, 0.5))) for n in range(2)]
        try:
            a, b = (
                bounding_rectangle(item)
                for item in build_world(make_scenario(tunnel=tunnel, props=pair), seed).standing
            )
            assert not rectangles_overlap(a, b)
        except ScenarioError as error:
            assert "'box" in str(error)  # which of the two is named depends on how they came to rest
            refused += 1
    assert refused >= 1
