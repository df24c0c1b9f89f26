from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, make_pose, transform
from cdpipe.core.geometry.motion import Motion
from cdpipe.sensor.ouster import SensorMetadata
from scenarios.schema import Mover, Prop, Scenario, Section, SessionPlan, Tunnel
from sim.drive.trajectory import plan_trajectory
from sim.geometry.mesh import box_mesh, move_mesh
from sim.geometry.raycast import Caster
from sim.movers.mover import MovingBody
from sim.movers.planning import plan_movers
from sim.placement.placing import Standing, floor_heights
from sim.props.props import shape_of
from sim.scene import World, build_world
from sim.session.truth import SESSIONS, SessionName

SEED = 5
Settings = dict[str, Any]
Plan = Callable[[Sequence[Settings], SessionName], tuple[MovingBody, ...]]
WALKER: Settings = {"name": "walker", "kind": "person", "path": {"between": ("a", "b"), "fractions": (0.3, 0.6)}}


@pytest.fixture(scope="module", name="scenario")
def scenario_fixture(make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]) -> Scenario:
    plain = make_scenario()
    tunnel = plain.tunnel.model_copy(update={"section": Section(width_m=5.0, height_m=3.2)})
    return make_scenario(tunnel=tunnel, props=(make_prop("box", 0.4, 0.9),))


@pytest.fixture(scope="module", name="world")
def world_fixture(scenario: Scenario) -> World:
    return build_world(scenario, SEED)


@pytest.fixture(scope="module")
def robots(scenario: Scenario, world: World, sensor: SensorMetadata) -> dict[SessionName, Motion]:
    return {name: plan_trajectory(world, scenario, sensor, SEED, name).true for name in SESSIONS}


@pytest.fixture(scope="module", name="plan")
def plan_fixture(scenario: Scenario, world: World, robots: dict[SessionName, Motion]) -> Plan:
    def plan(movers: Sequence[Settings], session: SessionName) -> tuple[MovingBody, ...]:
        drawn = scenario.model_copy(update={"movers": tuple(Mover.model_validate(each) for each in movers)})
        return plan_movers(world, drawn, robots, SEED)[session]

    return plan


KINDS = [
    WALKER,
    {"name": "stander", "kind": "person", "speed_mps": 0},
    {"name": "truck", "kind": "forklift", "path": {"length_m": 5}},
    {"name": "curtain", "kind": "curtain", "width_m": 0.9},
]


@pytest.mark.parametrize("session", ["before", "after"])
def test_no_corner_of_a_mover_comes_near_the_sensor_or_into_the_rock(
    plan: Plan, scenario: Scenario, world: World, robots: dict[SessionName, Motion], session: SessionName
) -> None:
    robot = robots[session]
    time_s = np.linspace(robot.time_s[0], robot.time_s[-1], 150)
    sensor_m = robot.sample(time_s)[0]
    movers = plan(KINDS, session)
    assert [mover.instance for mover in movers] == [2, 3, 4, 5]
    for mover in movers:
        lowest_m = np.inf
        for limb, poses in zip(mover.figure.limbs, mover.world_T_links(time_s), strict=True):
            corners = np.concatenate([mesh.vertices for mesh in limb.meshes])
            for pose, place in zip(poses, sensor_m, strict=True):
                moved = transform(pose, corners)
                level_m = np.linalg.norm(moved[:, :2] - place[:2], axis=1).min()
                assert level_m > scenario.platform.clearance_m - 0.01, mover.mover.name
                floor_m = floor_heights(world.fixed, moved + np.array([0.0, 0.0, 0.1]))
                assert np.isfinite(floor_m).all()
                lowest_m = min(lowest_m, float((moved[:, 2] - floor_m).min()))
        if mover.mover.kind != "curtain":
            assert -0.08 < lowest_m < 0.03, mover.mover.name  # feet and wheels are on the floor
        else:
            assert 0.1 < lowest_m < 0.5


def test_a_walker_keeps_to_its_stretch(plan: Plan) -> None:
    (walker,) = plan([WALKER], "before")
    x = walker.world_T_root(np.linspace(0, 100, 500))[:, 0, 3]
    assert x.min() == pytest.approx(6.0, abs=0.3)
    assert x.max() == pytest.approx(12.0, abs=0.3)


def test_another_mover_changes_no_draw_and_sessions_differ(plan: Plan) -> None:
    alone = plan([KINDS[2]], "before")[0]
    among = plan(KINDS, "before")[2]
    np.testing.assert_array_equal(alone.course.points, among.course.points)
    assert alone.course.offset_s == among.course.offset_s
    later = plan([KINDS[2]], "after")[0]
    assert alone.course.offset_s != later.course.offset_s
    only = plan([WALKER | {"sessions": "after"}], "before")
    assert only == ()


def test_a_curtain_hangs_at_one_place_in_both_sessions_and_swings_on(plan: Plan) -> None:
    before, after = (plan(KINDS, session)[3] for session in SESSIONS)
    np.testing.assert_array_equal(before.course.points, after.course.points)
    assert len(before.figure.limbs) == len(after.figure.limbs)
    assert before.course.offset_s != after.course.offset_s
    walkers = [plan(KINDS, session)[1] for session in SESSIONS]
    assert np.linalg.norm(walkers[0].course.points - walkers[1].course.points) > 0.5  # people go where they like


def test_a_curtain_has_another_phase_in_every_session_of_a_story(
    scenario: Scenario, world: World, robots: dict[SessionName, Motion]
) -> None:
    drawn = scenario.model_copy(update={"movers": (Mover.model_validate(KINDS[3]),)})
    names = ("before", "after", "session-01", "session-02")
    bodies = [plan_movers(world, drawn, {name: robots["after"]}, SEED)[name][0] for name in names]
    for body in bodies[1:]:
        np.testing.assert_array_equal(body.course.points, bodies[0].course.points)
    assert len({body.course.offset_s for body in bodies}) == 4


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        (
            {"path": {"between": ("a", "b"), "fractions": (0.2, 0.8), "lateral": 0.0}},
            r"before: mover 'walker' finds no way: it comes within 0.\d\d m of the sensor at .*and 0.5 m are needed",
        ),
        (
            {"path": {"between": ("a", "b"), "fractions": (0.3, 0.6), "lateral": 0.95}},
            "prop 'box' stands in its way",
        ),
        ({"kind": "forklift", "size_m": (3.0, 4.9, 2.0)}, r"the walls leave it \d.\d\d m, and it needs 4.9\d m"),
    ],
)
def test_a_mover_without_a_way_is_refused_on_one_line(plan: Plan, settings: Settings, reason: str) -> None:
    with pytest.raises(ScenarioError, match=reason) as refused:
        plan([WALKER | settings], "before")
    assert "\n" not in str(refused.value)


def test_a_mover_may_be_where_the_robot_is_not(make_scenario: Callable[..., Scenario], sensor: SensorMetadata) -> None:
    """A loader fills the drift beyond the end of the drive."""
    tunnel = Tunnel.model_validate(make_scenario().tunnel.model_dump() | {"nodes": {"a": (0, 0, 0), "b": (40, 0, 0)}})
    short = SessionPlan(route=("a", "b"), start_m=2.0, end_m=22.0)
    path = {"between": ("a", "b"), "fractions": (0.65, 0.8), "lateral": 0.0}
    loader = Mover.model_validate({"name": "loader", "kind": "loader", "path": path, "size_m": (7.0, 1.9, 2.0)})
    scenario = make_scenario(tunnel=tunnel, before=short, after=short, movers=(loader,))
    world = build_world(scenario, SEED)
    robot = plan_trajectory(world, scenario, sensor, SEED, "before").true
    (placed,) = plan_movers(world, scenario, {"before": robot}, SEED)["before"]
    assert placed.world_T_root(np.linspace(0, 60, 100))[:, 0, 3].min() > 25
    closer = scenario.model_copy(update={"before": SessionPlan(route=("a", "b"), start_m=2.0, end_m=12.0)})
    robot = plan_trajectory(world, closer, sensor, SEED, "before").true
    with pytest.raises(ScenarioError, match="mover 'loader' finds no way: it comes within"):
        plan_movers(world, closer, {"before": robot}, SEED)


@pytest.fixture(scope="module", name="high")
def high_fixture(make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]) -> tuple[Scenario, World]:
    """A drift 7 m high, with a box at x = 15, and a drive that ends before it."""
    tunnel = make_scenario().tunnel.model_copy(update={"section": Section(width_m=5.0, height_m=7.0)})
    drive = SessionPlan(route=("a", "b"), start_m=2.0, end_m=10.0)
    scenario = make_scenario(tunnel=tunnel, props=(make_prop("box", 0.75, 0.0),), before=drive)
    return scenario, build_world(scenario, SEED)


@pytest.mark.parametrize(
    ("share", "reason"), [(0.75, "prop 'box' stands in its way"), (0.25, r"it comes within 0.00 m of the sensor at")]
)
def test_a_curtain_hangs_through_no_prop_and_across_no_drive_below_a_high_roof(
    high: tuple[Scenario, World], sensor: SensorMetadata, share: float, reason: str
) -> None:
    scenario, world = high
    path = {"between": ("a", "b"), "fractions": (share, share), "lateral": 0.0}
    curtain = Mover.model_validate({"name": "curtain", "kind": "curtain", "width_m": 1.6, "path": path})
    robot = plan_trajectory(world, scenario, sensor, SEED, "before").true
    with pytest.raises(ScenarioError, match=f"before: mover 'curtain' finds no way: {reason}"):
        plan_movers(world, scenario.model_copy(update={"movers": (curtain,)}), {"before": robot}, SEED)


@pytest.mark.parametrize("pause_s", [0.0, 2000.0])
def test_rock_on_the_way_of_a_mover_is_met_however_long_it_pauses(
    scenario: Scenario, world: World, robots: dict[SessionName, Motion], pause_s: float
) -> None:
    path = {"between": ("a", "b"), "fractions": (0.3, 0.6), "lateral": -0.95}
    walker = Mover.model_validate({**WALKER, "pause_s": pause_s, "path": path})
    drawn = scenario.model_copy(update={"movers": (walker,)})
    (placed,) = plan_movers(world, drawn, {"before": robots["before"]}, SEED)["before"]
    x_m, y_m, floor_m = placed.course.points[len(placed.course.points) // 2]
    hanging = move_mesh(box_mesh((0.6, 0.4, 0.15)), make_pose(translation=(x_m, y_m, floor_m + 1.5)))
    rock = [mesh for mesh, owner in zip(world.before.meshes, world.before.instance, strict=True) if owner == 0]
    lower = replace(world, fixed=Caster([*rock, hanging]))
    with pytest.raises(ScenarioError, match=r"finds no way: it would reach 0\.\d\d m into rock"):
        plan_movers(lower, drawn, {"before": robots["before"]}, SEED)


def test_a_loader_swings_into_no_prop_on_a_bend(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], robots: dict[SessionName, Motion]
) -> None:
    """The box is where the loader's frames swing out, and none of it straight on would be."""
    wide = {"section": Section(width_m=8.0, height_m=3.2), "meander_m": 2.0}
    tunnel = make_scenario().tunnel.model_copy(update={"nodes": {"a": (0, 0, 0), "b": (60, 0, 0)}, **wide})
    path = {"between": ("a", "b"), "fractions": (0.6, 0.9), "lateral": 0.0}
    loader = Mover.model_validate({"name": "loader", "kind": "loader", "path": path})
    scenario = make_scenario(tunnel=tunnel, movers=(loader,))
    world, robot = build_world(scenario, SEED), {"before": robots["before"]}
    (placed,) = plan_movers(world, scenario, robot, SEED)["before"]
    swung = _find_swung(placed)
    box = make_prop("box", size_m=(0.1, 0.1, 0.4))
    pose = make_pose(translation=(*swung, placed.course.points[:, 2].mean()))
    standing = Standing(box, shape_of(box, SEED), frozenset({"before"}), pose)
    with pytest.raises(ScenarioError, match="mover 'loader' finds no way: prop 'box' stands in its way"):
        plan_movers(replace(world, standing=(standing,)), scenario, robot, SEED)


def _find_swung(mover: MovingBody) -> Float64Array:
    """Return the place (2,) that a corner of a mover reaches, and that is farthest from its outline straight on."""
    time_s = mover.course.pass_times(0.5)
    corners = []
    for limb, poses in zip(mover.figure.limbs, mover.world_T_links(time_s), strict=True):
        of_limb = np.concatenate([mesh.vertices for mesh in limb.meshes])
        corners += [transform(pose, of_limb)[:, :2] for pose in poses]
    places = np.unique(np.concatenate(corners).round(2), axis=0)
    off_m = np.full(len(places), np.inf)
    low, high = mover.figure.extent.low[:2], mover.figure.extent.high[:2]
    for pose in mover.world_T_root(time_s):
        local = (places - pose[:2, 3]) @ pose[:2, :2]
        off_m = np.minimum(off_m, np.hypot(*np.maximum(np.maximum(low - local, local - high), 0.0).T))
    assert off_m.max() > 0.3
    return np.asarray(places[off_m.argmax()])
