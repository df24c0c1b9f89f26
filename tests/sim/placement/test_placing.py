from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float32Array, Float64Array
from scenarios.schema import (
    Aged,
    Area,
    Drift,
    Furniture,
    Pipe,
    Place,
    Platform,
    Prop,
    Scenario,
    Section,
    SessionPlan,
    Shift,
    Tunnel,
)
from sim.placement import fitting, stations
from sim.placement.placing import (
    Standing,
    grow_rectangle,
    rectangles_overlap,
    standing_corners,
    standing_middle,
    standing_points,
)
from sim.placement.stations import draw_areas
from sim.rock.centreline import Centreline, build_centreline
from sim.scene import World, build_world
from sim.session.labels import list_changes

MakeScenario = Callable[..., Scenario]
MakeProp = Callable[..., Prop]


def drift(*nodes: tuple[float, float, float], width_m: float = 4.0, **settings: object) -> Tunnel:
    """A smooth drift of rectangular section through nodes a, b, c ..."""
    names = "abcdefgh"[: len(nodes)]
    return Tunnel.model_validate(
        {
            "nodes": dict(zip(names, nodes, strict=True)),
            "drifts": [{"nodes": list(names)}],
            "section": {"shape": "rectangle", "width_m": width_m, "height_m": 3.0},
            "resolution_m": 0.25,
        }
        | settings
    )


LEVEL = drift((0, 0, 0), (20, 0, 0))


def poses(world: World) -> dict[str, list[Float64Array]]:
    found: dict[str, list[Float64Array]] = {}
    for item in world.standing:
        found.setdefault(item.prop.name, []).append(item.world_T_object)
    return found


def test_a_prop_at_a_point_stands_on_the_floor_below_it(make_scenario: MakeScenario, make_prop: MakeProp) -> None:
    rising = drift((0, 0, 1), (20, 0, 3))
    place = Place(at=(10.0, 0.7, 3.0), yaw_deg=90.0)
    world = build_world(make_scenario(tunnel=rising, props=(make_prop("box", place=place),)), 0)
    pose = world.standing[0].world_T_object
    np.testing.assert_allclose(pose[:3, 3], [10.0, 0.7, 2.0], atol=0.03)  # 2 m rise over 20 m, from 1 m
    np.testing.assert_allclose(pose[:2, 0], [0.0, 1.0], atol=0.02)


def test_a_prop_at_a_point_in_rock_is_refused(make_scenario: MakeScenario, make_prop: MakeProp) -> None:
    for at, why in (((10.0, 1.9, 1.0), "would stand in rock"), ((10.0, 9.0, 1.0), "there is no floor")):
        with pytest.raises(ScenarioError, match=f"prop 'box'.*{why}"):
            build_world(make_scenario(tunnel=LEVEL, props=(make_prop("box", place=Place(at=at)),)), 0)


def test_a_shift_is_along_the_drift_whatever_the_yaw(make_scenario: MakeScenario, make_prop: MakeProp) -> None:
    shift = Shift(distance_m=0.5, heading_deg=90.0, turn_deg=30.0)
    box = make_prop("box", 0.4, 0.0, 20.0, change="moved", shift=shift)
    world = build_world(make_scenario(tunnel=LEVEL, props=(box,)), 0)
    start, end = poses(world)["box"]
    np.testing.assert_allclose(end[:3, 3] - start[:3, 3], [0.0, 0.5, 0.0], atol=2e-3)
    turn = np.rad2deg(np.arctan2(end[1, 0], end[0, 0]) - np.arctan2(start[1, 0], start[0, 0]))
    assert turn == pytest.approx(30.0, abs=0.1)
    assert [sorted(item.sessions) for item in world.standing] == [["before"], ["after"]]
    with pytest.raises(ScenarioError, match="prop 'box' "):
        build_world(make_scenario(tunnel=LEVEL, props=(make_prop("box", 0.4, 0.9, change="moved", shift=shift),)), 0)


@pytest.mark.parametrize("seed", range(3))
def test_the_middle_of_a_lying_prop_moves_by_the_shift(
    make_scenario: MakeScenario, make_prop: MakeProp, seed: int
) -> None:
    shift = Shift(distance_m=0.4, heading_deg=0.0, turn_deg=40.0)
    lying = Place(between=("a", "b"), fraction=0.4, lateral=0.0, posture="tipped")
    barrel = make_prop("barrel", kind="barrel", size_m=(0.58, 0.58, 0.9), place=lying, change="moved", shift=shift)
    scenario = make_scenario(tunnel=LEVEL, props=(barrel,))
    world = build_world(scenario, seed)
    start, end = (standing_middle(item) for item in world.standing)
    np.testing.assert_allclose((end - start)[:2], [0.4, 0.0], atol=0.02)
    # less than its 0.9 m, more than its 0.58 m: much of it covers where it lay
    assert {tally.change.group for tally in list_changes(scenario, world)} == {"partial"}


def test_a_lying_prop_that_aged_turns_on_the_floor(make_scenario: MakeScenario, make_prop: MakeProp) -> None:
    lying = Place(between=("a", "b"), fraction=0.4, lateral=0.0, posture="tipped")
    box = make_prop("box", size_m=(0.6, 0.5, 0.8), place=lying, aged=Aged(turn_deg=20.0))
    before, after = build_world(make_scenario(tunnel=LEVEL, props=(box,)), 1).standing
    assert standing_points(after)[:, 2].min() == pytest.approx(standing_points(before)[:, 2].min(), abs=1e-6)
    np.testing.assert_allclose(standing_middle(after)[:2], standing_middle(before)[:2], atol=0.03)


def test_a_prop_too_small_for_the_floor_is_refused(make_scenario: MakeScenario, make_prop: MakeProp) -> None:
    grain = make_prop("grain", kind="rock", size_m=(0.001, 0.001, 0.001))
    with pytest.raises(ScenarioError, match=r"props\.grain\.size_m = .*: too small to come to rest on the floor: make"):
        build_world(make_scenario(tunnel=LEVEL, props=(grain,)), 0)


def test_a_drawn_prop_is_tried_again_until_its_shift_fits(make_scenario: MakeScenario, make_prop: MakeProp) -> None:
    # 3.5 m to the end of the drift are never free beyond x = 15 or so; the draws of some seeds start there.
    shift = Shift(distance_m=5.0)
    for seed in range(4):
        box = make_prop("box", place=Place(lateral=0.9), change="moved", shift=shift)
        start, end = poses(build_world(make_scenario(tunnel=LEVEL, props=(box,)), seed))["box"]
        np.testing.assert_allclose(end[:2, 3] - start[:2, 3], [5.0, 0.0], atol=5e-3)


@pytest.fixture(scope="module")
def crowd(make_scenario: MakeScenario, make_prop: MakeProp) -> tuple[Scenario, World]:
    """Ten boxes drawn into 20 m of drift."""
    props = tuple(make_prop(f"p{n}", place=Place(lateral=0.9 * (-1) ** n, yaw_deg=33.0 * n)) for n in range(10))
    scenario = make_scenario(tunnel=LEVEL, props=props)
    return scenario, build_world(scenario, 1)


def test_drawn_props_keep_apart_and_leave_the_way_open(crowd: tuple[Scenario, World]) -> None:
    scenario, world = crowd
    corners = [standing_corners(item) for item in world.standing]
    share = np.linspace(0, 1, 50)[:, None]
    rims = [
        np.concatenate([a + share * (b - a) for a, b in zip(c, np.roll(c, 1, axis=0), strict=True)]) for c in corners
    ]
    for i, first in enumerate(rims):
        for j, second in enumerate(rims[:i]):
            gap_m = np.linalg.norm(first[:, None] - second[None], axis=2).min()
            assert gap_m > 0.14, (i, j)
    # Brute force: at every station some 1 m wide gap is left between the walls at y = -2 and y = 2.
    points = np.concatenate(rims)
    clearance_m = scenario.platform.clearance_m
    for x in np.arange(1.0, 19.0, 0.1):
        across = points[np.abs(points[:, 0] - x) < clearance_m, 1]
        edges = np.sort(np.concatenate([[-2.0, 2.0], across]))
        assert np.diff(edges).max() > 2 * clearance_m


def test_draws_of_a_prop_do_not_depend_on_another(crowd: tuple[Scenario, World], make_scenario: MakeScenario) -> None:
    scenario, world = crowd
    full = poses(world)
    alone = 0
    for prop in scenario.props:
        own = poses(build_world(make_scenario(tunnel=LEVEL, props=(prop,)), 1))[prop.name][0]
        alone += np.array_equal(own, full[prop.name][0])
    # All those whose first free place no other had taken; a shared generator would leave one.
    assert alone >= 5
    fewer = poses(build_world(make_scenario(tunnel=LEVEL, props=scenario.props[:-1]), 1))
    for name, each in fewer.items():
        np.testing.assert_array_equal(each[0], full[name][0])


def test_a_drawn_prop_that_bars_the_way_finds_no_place_but_is_flown_over(
    make_scenario: MakeScenario, make_prop: MakeProp
) -> None:
    # 2.2 m of 4 m, in the middle: 0.9 m on either side, and a robot needs 1 m.
    bar = make_prop("bar", size_m=(0.5, 2.2, 0.5), place=Place())
    with pytest.raises(ScenarioError, match=r"prop 'bar' "):
        build_world(make_scenario(tunnel=LEVEL, props=(bar,)), 0)
    high = Platform(kind="quadrotor", sensor_height_m=1.5, scan_spacing_m=2.0)
    assert len(build_world(make_scenario(tunnel=LEVEL, props=(bar,), platform=high), 0).standing) == 1


def test_a_prop_keeps_clear_of_a_pipe(make_scenario: MakeScenario, make_prop: MakeProp) -> None:
    pipe = Furniture(pipes=(Pipe(diameter_m=0.3, side="left", height_share=0.3),))
    piped = LEVEL.model_copy(update={"furniture": pipe})
    low, high = (make_prop("box", lateral=1.0, size_m=(0.6, 0.6, height)) for height in (0.4, 1.4))
    y = [poses(build_world(make_scenario(tunnel=piped, props=(box,)), 0))["box"][0][1, 3] for box in (low, high)]
    # The wall at y = 2, a cell of 0.25 m and 5 cm kept free; the pipe hangs at 0.9 m and is 0.3 m thick.
    assert y[0] == pytest.approx(2.0 - 0.3 - 0.3, abs=0.06)
    assert y[1] < y[0] - 0.2


def test_rectangles_grow_and_overlap_by_hand() -> None:
    square = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    np.testing.assert_allclose(grow_rectangle(square, 0.5), 1.5 * square)
    turned = square @ np.array([[0.6, 0.8], [-0.8, 0.6]])
    np.testing.assert_allclose(np.linalg.norm(grow_rectangle(turned, 0.5), axis=1), 1.5 * np.sqrt(2))
    assert rectangles_overlap(square, square + np.array([1.9, 0.0]))
    assert not rectangles_overlap(square, square + np.array([2.1, 0.0]))
    assert not rectangles_overlap(square, grow_rectangle(square, 0.5) + np.array([2.6, 0.0]))


def area_scenario(make_scenario: MakeScenario, tunnel: Tunnel, count: int, **plans: SessionPlan) -> Scenario:
    areas = tuple(Area(name=f"area{n}", length_m=6.0) for n in range(count))
    return make_scenario(tunnel=tunnel, areas=areas, score_radius_m=4.5, **plans)


def middles(scenario: Scenario, seed: int) -> Float64Array:
    centreline: Centreline = build_centreline(scenario.tunnel, seed)
    return np.array([area.points[len(area) // 2] for area, _ in draw_areas(scenario, centreline, seed).values()])


def test_areas_keep_four_score_radii_apart_where_there_is_room(make_scenario: MakeScenario) -> None:
    route = SessionPlan(route=("a", "b"), start_m=5.0, end_m=3.0)
    long = area_scenario(make_scenario, drift((0, 0, 0), (300, 0, 0)), 4, before=route, after=route)
    for seed in range(10):
        x = np.sort(middles(long, seed)[:, 0])
        # 4 radii of 4.5 m between their ends, 6 m long; 4.5 m from where the drives start and end.
        assert np.diff(x).min() >= 4 * 4.5 + 6.0 - 1e-6
        assert x[0] >= 5.0 + 4.5 + 3.0 - 0.2
        assert x[-1] <= 300 - 3.0 - 4.5 - 3.0 + 0.2
    short = area_scenario(make_scenario, drift((0, 0, 0), (40, 0, 0)), 2, before=route, after=route)
    apart_m = [np.ptp(middles(short, seed)[:, 0]) for seed in range(10)]
    # 17 m of room for the middles: as far apart as 64 candidates allow is near an end of it.
    assert min(apart_m) > 8.0


def test_areas_lie_where_both_sessions_drive(make_scenario: MakeScenario) -> None:
    tunnel = Tunnel(
        nodes={"a": (0, 0, 0), "b": (30, 0, 0), "c": (60, 0, 0), "d": (30, 30, 0)},
        drifts=(Drift(nodes=("a", "b", "c")), Drift(nodes=("b", "d"))),
        section=Section(width_m=4.0, height_m=3.0),
    )
    plans = {"before": SessionPlan(route=("a", "b", "c")), "after": SessionPlan(route=("d", "b", "a"), end_m=8.0)}
    scenario = area_scenario(make_scenario, tunnel, 1, **plans)
    for seed in range(12):
        x, y, _ = middles(scenario, seed)[0]
        assert 8.0 + 4.5 + 3.0 - 0.2 <= x <= 30.0
        assert y == pytest.approx(0.0, abs=0.01)
    none = {"before": SessionPlan(route=("b", "c")), "after": SessionPlan(route=("b", "d"))}
    with pytest.raises(ScenarioError, match=r"area 'area0': .*6 m"):
        middles(area_scenario(make_scenario, tunnel, 1, **none), 0)


def test_props_of_an_area_stand_in_it_and_not_in_a_junctions_mouth(
    make_scenario: MakeScenario, make_prop: MakeProp
) -> None:
    tunnel = Tunnel(
        nodes={"a": (0, 0, 0), "b": (20, 0, 0), "c": (40, 0, 0), "d": (20, 15, 0)},
        drifts=(Drift(nodes=("a", "b", "c")), Drift(nodes=("b", "d"))),
        section=Section(shape="rectangle", width_m=4.0, height_m=3.0),
        resolution_m=0.25,
    )
    route = SessionPlan(route=("a", "b", "c"))
    scenario = area_scenario(make_scenario, tunnel, 1, before=route, after=route)
    lain = tuple(make_prop(f"p{n}", place=Place(area="area0", lateral=0.9 * (-1) ** n)) for n in range(4))
    for seed in (2, 3):
        standing: tuple[Standing, ...] = build_world(scenario.model_copy(update={"props": lain}), seed).standing
        middle = middles(scenario, seed)[0]
        for item in standing:
            assert abs(item.world_T_object[0, 3] - middle[0]) <= 3.0 + 0.1
            assert abs(item.world_T_object[0, 3] - 20.0) >= 0.75 * 4.0 - 0.1


def test_a_crowded_area_takes_the_other_wall_then_the_tunnel_beside_it(
    make_scenario: MakeScenario, make_prop: MakeProp
) -> None:
    # An area of 2 m holds one box of 1.6 m at either wall; the third goes beside it, within as much again.
    tunnel = drift((0, 0, 0), (40, 0, 0))
    boxes = tuple(
        make_prop(f"box{n}", size_m=(1.6, 0.6, 0.5), place=Place(area="small", lateral=0.9)) for n in range(3)
    )
    for seed in range(3):
        scenario = make_scenario(tunnel=tunnel, areas=(Area(name="small", length_m=2.0),), props=boxes)
        middle_m = middles(scenario, seed)[0, 0]
        x, y = np.array([each[0][:2, 3] for each in poses(build_world(scenario, seed)).values()]).T
        assert abs(x[0] - middle_m) < 1.1
        assert y[0] > 0.5 > -0.5 > y.min()
        assert np.abs(x - middle_m).max() < 3.1


# The floor rises by 0.35 m to the left wall: rays 0.1 m above its middle meet it 3.6 m before the wall at y = 5.
SLOPING = drift((0, 0, 0), (30, 0, 0), width_m=10.0, floor={"roughness": 0.0, "crossfall_percent": 7.0})
BANK = {"kind": "muck_pile", "size_m": (5.0, 2.5, 1.2), "change": "none"}


def back_y(world: World) -> float:
    """Where the flat back of the one pile is."""
    (item,) = world.standing
    assert item.wall is not None
    return float(item.world_T_object[1, 3] + item.wall[1] * item.shape.size_m[1] / 2)


def test_a_pile_at_a_given_place_is_banked_up_though_the_floor_rises_before_the_wall(
    make_scenario: MakeScenario, make_prop: MakeProp
) -> None:
    place = Place(between=("a", "b"), fraction=0.5, lateral=0.9, posture="leaning")
    world = build_world(make_scenario(tunnel=SLOPING, props=(make_prop("bank", **BANK, place=place),)), 0)
    # Less a little for the rounded foot of the wall; with the rays that meet the floor the mean would be 4.3.
    assert back_y(world) == pytest.approx(5.0, abs=0.1)
    # A stretch of wall that is 2 m farther away is not hidden by the floor, it is not there.
    niche = {"between": ("a", "b"), "fraction": 0.5, "side": "left", "width_m": 3.0, "depth_m": 2.0, "height_m": 2.5}
    open_wall = SLOPING.model_validate(SLOPING.model_dump() | {"niches": [niche]})
    with pytest.raises(ScenarioError, match="prop 'bank': "):
        build_world(make_scenario(tunnel=open_wall, props=(make_prop("bank", **BANK, place=place),)), 0)


def test_a_drawn_pile_looks_over_humps_only_where_all_else_failed(
    make_scenario: MakeScenario, make_prop: MakeProp, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries: list[bool] = []
    even = fitting._is_even

    def counted(reach_m: Float32Array, is_pile: bool, spot: fitting.Spot) -> bool:
        tries.append(spot.over_humps)
        return even(reach_m, is_pile, spot)

    monkeypatch.setattr(fitting, "_is_even", counted)
    bank = make_prop("bank", **BANK, place=Place(lateral=0.9, posture="leaning"))
    # Down to the right the floor hides nothing; the pile that finds no even wall on the left goes there, as ever.
    assert back_y(build_world(make_scenario(tunnel=SLOPING, props=(bank,)), 0)) == pytest.approx(-5.0, abs=0.03)
    assert tries[: stations.PLACE_TRIES] == [False] * stations.PLACE_TRIES
    assert not any(tries)
    ridge = SLOPING.model_copy(update={"floor": SLOPING.floor.model_copy(update={"crossfall_percent": 0.0})})
    monkeypatch.setattr(fitting, "_floor_under", lambda *_: -0.3)  # as if it stood lower than the floor about it
    tries.clear()
    (item,) = build_world(make_scenario(tunnel=ridge, props=(bank,)), 0).standing
    assert abs(item.world_T_object[1, 3]) + 1.25 == pytest.approx(5.0, abs=0.03)
    assert tries[: 2 * stations.PLACE_TRIES] == [False] * 2 * stations.PLACE_TRIES
    assert tries[-1]
