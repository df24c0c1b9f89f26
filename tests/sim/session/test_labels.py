from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.geometry import make_pose
from cdpipe.sensor.ouster import SensorMetadata
from scenarios.schema import Aged, Drift, Place, Platform, Prop, Scenario, Section, Sensor, SessionPlan, Shift, Tunnel
from sim.geometry.mesh import Mesh, box_mesh, move_mesh, point_triangle_distance
from sim.geometry.raycast import Caster
from sim.graft.plan import Compared, Surfaces
from sim.placement.contact import standing_surface
from sim.placement.placing import Standing
from sim.props.props import shape_of
from sim.scene import World, build_world
from sim.sensor.lidar import scan
from sim.sensor.rays import Rays, revolution_rays
from sim.session.labels import Ghost, Returns, list_changes, mark_belonging
from sim.session.simulate import simulate_pair
from sim.session.truth import Change, SessionName, read_pair_truth
from tests.sim.graft.conftest import make_graft


def box_at(x: float, y: float, z: float, half_m: float = 0.5) -> Mesh:
    return move_mesh(box_mesh((half_m,) * 3), make_pose(translation=(x, y, z)))


def fan(count: int) -> Rays:
    """Level rays from the origin towards +x, spread over 20 degrees."""
    angle = np.deg2rad(np.linspace(-10, 10, count))
    directions = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)[:, None]
    return Rays(np.zeros((count, 3)), directions.astype(np.float32))


def test_ghost_rays_by_hand() -> None:
    rays = fan(2001)
    ghost = Ghost(box_at(5.0, 0.0, 0.0))
    half_angle = np.arctan(0.5 / 4.5)  # its near face is 1 m wide at 4.5 m
    wanted = int((np.abs(np.deg2rad(np.linspace(-10, 10, 2001))) <= half_angle).sum())
    assert abs(ghost.count(rays, np.full((2001, 1), 9.0, np.float32)) - wanted) <= 2  # all pass through
    assert ghost.count(rays, np.full((2001, 1), 3.0, np.float32)) == 0  # all end before it
    assert ghost.count(rays, np.zeros((2001, 1), np.float32)) == 0  # none was recorded
    on_face = (4.5 / rays.directions[..., 0]).astype(np.float32)
    assert abs(ghost.count(rays, on_face) - wanted) <= 2  # all end on its very surface
    assert Ghost(box_at(70.0, 0.0, 0.0)).count(rays, np.full((2001, 1), 90.0, np.float32)) == 0  # out of reach


def test_no_ray_that_meets_a_ghost_is_left_out(sensor: SensorMetadata) -> None:
    generator = np.random.default_rng(4)
    for place in generator.uniform((-8.0, -8.0, -2.0), (8.0, 8.0, 2.0), size=(12, 3)):
        surface = box_at(*place, half_m=0.6)
        # A quick sensor: its origin moves by 2 m during the revolution, sometimes through the object's own ball.
        poses = np.tile(np.eye(4), (sensor.width, 1, 1))
        poses[:, 0, 3] = np.linspace(-1.0, 1.0, sensor.width)
        rays = revolution_rays(sensor, poses)
        ranges_m = generator.uniform(0.0, 14.0, size=rays.directions.shape[:2]).astype(np.float32)
        ranges_m[generator.random(ranges_m.shape) < 0.1] = 0.0
        every_m, _, _ = Caster([surface]).cast_columns(rays.origins, rays.directions)
        wanted = int(((every_m <= ranges_m + 1e-3) & (ranges_m > 0)).sum())
        assert wanted > 20
        assert Ghost(surface).count(rays, ranges_m) == wanted


def test_cells_by_hand() -> None:
    points = np.array([[0.01, 0.01, 0.01], [0.09, 0.05, 0.02], [0.11, 0.05, 0.02], [-0.01, 0.05, 0.02]])
    counted = Returns()
    counted.add(points[:2])
    counted.add(points)
    assert (counted.n, len(counted.cells)) == (6, 3)


def sweep(world: World, scenario: Scenario, sensor: SensorMetadata, session: str, change: int = 0) -> tuple[int, int]:
    """Ghost rays and returns of one change, seen from the drift's middle at three places."""
    scene = world.after if session == "after" else world.before
    tally = list_changes(scenario, world)[change]
    ghosts = returns = 0
    for number, x in enumerate((6.0, 10.0, 14.0)):
        rays = revolution_rays(sensor, np.tile(make_pose(translation=(x, 0.0, 0.8)), (sensor.width, 1, 1)))
        ideal = Sensor(range_noise=False, dropouts=False, false_positives=False)
        result = scan(scene, sensor, ideal, rays, 0, session, number)
        distance_m = np.where(result.geom >= 0, result.true_range_m - sensor.beam_origin_m, 0.0).T
        ghosts += tally.ghost.count(rays, distance_m)
        returns += int((scene.instance[result.geom] == tally.change.instance).sum())
    return ghosts, returns


def test_a_box_hidden_behind_a_box_is_out_of_reach(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], sensor: SensorMetadata
) -> None:
    # The small one stands at the wall; seen from the line, a large one covers it, and stays.
    small = make_prop("small", 0.5, 1.0, size_m=(0.3, 0.2, 0.3), change="added")
    screen = make_prop("screen", 0.5, 0.45, size_m=(6.5, 0.4, 1.9))
    hidden, open_to_view = make_scenario(props=(small, screen)), make_scenario(props=(small,))
    ghosts, returns = sweep(build_world(hidden, 0), hidden, sensor, "before")
    assert ghosts == 0
    ghosts, _ = sweep(build_world(open_to_view, 0), open_to_view, sensor, "before")
    _, returns = sweep(build_world(open_to_view, 0), open_to_view, sensor, "after")
    assert ghosts > 30
    # Rays of the other session that meet the ghost of an unhidden box are as many as its returns.
    assert abs(ghosts - returns) <= 0.02 * returns


def test_a_moved_prop_is_two_linked_changes_and_a_short_move_is_partial(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]
) -> None:
    def goal(fraction: float) -> Place:
        return Place(between=("a", "b"), fraction=fraction, lateral=0.9)

    props = (
        make_prop("far", 0.2, change="moved", to=goal(0.3)),
        make_prop("new", 0.45, change="added"),
        make_prop("near", 0.6, change="moved", to=goal(0.62)),  # 0.4 m of its 0.8 m
        make_prop("gone", 0.8, -0.9, change="removed"),
        make_prop("stays", 0.3, -0.9),
    )
    scenario = make_scenario(props=props)
    changes = [tally.change for tally in list_changes(scenario, build_world(scenario, 0))]
    told = [(c.id, c.name, c.kind, c.session, c.partner, c.group, c.instance) for c in changes]
    assert told == [
        (1, "far", "moved", "before", 2, "full", 1),
        (2, "far", "moved", "after", 1, "full", 1),
        (3, "new", "added", "after", None, "full", 2),
        (4, "near", "moved", "before", 5, "partial", 3),
        (5, "near", "moved", "after", 4, "partial", 3),
        (6, "gone", "removed", "before", None, "full", 4),
    ]


def test_a_prop_that_aged_stands_a_little_otherwise_and_has_not_changed(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]
) -> None:
    aged = Aged(shift_m=0.05, heading_deg=90.0, turn_deg=3.0, lean_deg=2.0, sag_m=0.01)
    old, gone = make_prop("old", 0.3, aged=aged), make_prop("gone", 0.7, change="removed")
    scenario = make_scenario(props=(old, gone))
    world = build_world(scenario, 0)
    assert [tally.change.name for tally in list_changes(scenario, world)] == ["gone"]
    before, after = (item for item in world.standing if item.prop.name == "old")
    assert (before.sessions, after.sessions) == ({"before"}, {"after"})
    np.testing.assert_allclose(after.world_T_object[:3, 3] - before.world_T_object[:3, 3], [0, 0.05, -0.01], atol=1e-9)
    turned = before.world_T_object[:3, :3].T @ after.world_T_object[:3, :3]
    np.testing.assert_allclose(np.rad2deg(np.arccos((np.trace(turned) - 1) / 2)), np.hypot(3.0, 2.0), atol=0.01)
    # in the before session it stands where it would stand for ever, and either scene holds it
    (still,) = (item for item in build_world(make_scenario(props=(make_prop("old", 0.3), gone)), 0).standing
                if item.prop.name == "old")  # fmt: skip
    np.testing.assert_array_equal(before.world_T_object, still.world_T_object)
    assert all((scene.instance == 1).any() for scene in (world.before, world.after))


def test_of_a_short_move_only_what_is_off_the_old_surface_counts(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]
) -> None:
    goal = Place(between=("a", "b"), fraction=0.42, lateral=0.9)
    scenario = make_scenario(props=(make_prop("near", 0.4, change="moved", to=goal),))
    world = build_world(scenario, 0)
    removed, added = list_changes(scenario, world)
    start, end = (item.world_T_object for item in world.standing)
    # Points in the frame of the box where it stands after; it has come from -0.4 m along x.
    local = np.array(
        [
            [0.4, 0.0, 0.45],  # front face, 0.4 m before the old front: new
            [0.4, 0.0, 0.04],  # the same, but 4 cm over the floor, which was there before
            [0.25, 0.1, 0.7],  # top, 0.25 m before the old front
            [0.06, 0.1, 0.7],  # top, 6 cm before the old front
            [-0.2, 0.1, 0.7],  # top, where the old top was
            [-0.4, 0.0, 0.3],  # rear face, deep inside the old box: 0.4 m from its front, 0.3 m from its sides
        ]
    )
    points = local @ end[:3, :3].T + end[:3, 3]
    belongs = mark_belonging(added, points)
    np.testing.assert_array_equal(belongs, [True, False, True, False, False, True])
    added.own.add(points[belongs])
    assert (added.own.n, len(added.own.cells)) == (3, 3)
    assert np.linalg.norm(end[:3, 3] - start[:3, 3]) < 0.8
    assert mark_belonging(removed, np.empty((0, 3))).shape == (0,)
    removed.own.add(np.empty((0, 3)))
    assert (removed.own.n, removed.own.cells) == (0, set())


def test_a_change_nobody_could_notice_says_why(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]
) -> None:
    scenario = make_scenario(props=(make_prop("new", change="added"),))
    tally = list_changes(scenario, build_world(scenario, 0))[0]
    change = tally.finished()
    assert not change.is_observable
    assert change.why_not == "0 cells of 0.1 m filled, 10 needed; 0 rays of the other session reach it, 10 needed"
    tally.own.cells.update(range(10))
    tally.n_ghost_rays = 9
    assert tally.finished().why_not == "9 rays of the other session reach it, 10 needed"
    tally.n_ghost_rays = 10
    assert (tally.finished().is_observable, tally.finished().why_not) == (True, "")


def changes_of(scenario: Scenario, out: Path, seed: int = 0) -> dict[tuple[str, str], Change]:
    """Simulate a pair and return its changes by name and session."""
    simulate_pair(scenario, seed, out / "pair")
    return {(change.name, change.session): change for change in read_pair_truth(out / "pair").changes}


def test_a_box_behind_a_box_is_unobservable_and_the_truth_says_why(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], tmp_path: Path
) -> None:
    hidden = make_prop("hidden", 0.5, 1.0, size_m=(0.3, 0.2, 0.3), change="added")
    screen = make_prop("screen", 0.5, 0.45, size_m=(12.0, 0.3, 2.1))
    changes = changes_of(make_scenario(props=(hidden, screen)), tmp_path)
    change = changes["hidden", "after"]
    assert (change.n_ghost_rays, change.n_cells, change.is_observable) == (0, 0, False)
    assert change.why_not == "0 cells of 0.1 m filled, 10 needed; 0 rays of the other session reach it, 10 needed"
    # Hidden in one session only: the screen goes with the change, so that one session sees it and the other cannot.
    leaves = screen.model_copy(update={"change": "removed"})
    after = changes_of(make_scenario(props=(hidden, leaves)), tmp_path / "leaves")
    change = after["hidden", "after"]
    assert change.n_cells >= 10
    assert change.why_not == "0 rays of the other session reach it, 10 needed"
    assert after["screen", "before"].is_observable


def test_a_change_in_a_branch_that_one_session_drives_is_unobservable(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], tmp_path: Path
) -> None:
    # The branch turns: nothing behind b-d is seen from the main drift.
    tunnel = Tunnel(
        nodes={"a": (0, 0, 0), "b": (12, 0, 0), "c": (24, 0, 0), "d": (12, 11, 0), "e": (24, 13, 0)},
        drifts=(Drift(nodes=("a", "b", "c")), Drift(nodes=("b", "d", "e"))),
        section=Section(width_m=3.5, height_m=3.0),
        resolution_m=0.25,
    )
    place = Place(between=("d", "e"), fraction=0.7, lateral=0.8)
    props = (make_prop("far", place=place, change="added"), make_prop("near", 0.5, 0.8, change="removed"))
    routes = {"before": SessionPlan(route=("a", "b", "c")), "after": SessionPlan(route=("a", "b", "d", "e"))}
    changes = changes_of(make_scenario(tunnel=tunnel, props=props, **routes), tmp_path)
    far = changes["far", "after"]
    assert far.n_cells >= 10
    assert (far.n_ghost_rays, far.is_observable) == (0, False)
    assert far.why_not == "0 rays of the other session reach it, 10 needed"
    assert changes["near", "before"].is_observable


def test_a_small_object_fills_too_few_cells(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], tmp_path: Path
) -> None:
    can = make_prop("can", 0.5, 0.9, size_m=(0.08, 0.08, 0.1), change="removed")
    change = changes_of(make_scenario(props=(can,), platform=Platform(scan_spacing_m=0.5)), tmp_path)["can", "before"]
    assert change.n_returns > 0
    assert 0 < change.n_cells < 10 <= change.n_ghost_rays
    assert change.why_not == f"{change.n_cells} cells of 0.1 m filled, 10 needed"


def test_both_halves_of_a_short_move_are_counted_and_know_the_other_session(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], tmp_path: Path
) -> None:
    near = make_prop("near", 0.5, change="moved", shift=Shift(distance_m=0.4))
    far = make_prop("far", 0.2, -0.9, change="moved", to=Place(between=("a", "b"), fraction=0.7, lateral=-0.9))
    changes = changes_of(make_scenario(props=(near, far)), tmp_path)
    for name, group in (("near", "partial"), ("far", "full")):
        start, end = changes[name, "before"], changes[name, "after"]
        assert (start.partner, end.partner) == (end.id, start.id)
        assert (start.kind, end.kind, start.group, end.group) == ("moved", "moved", group, group)
        assert start.is_observable and end.is_observable
    # A full move counts all returns of either session; of a short one only a part, but all of the other's.
    start, end = changes["far", "before"], changes["far", "after"]
    assert (start.n_returns_other, start.n_cells_other) == (end.n_returns, end.n_cells)
    assert (end.n_returns_other, end.n_cells_other) == (start.n_returns, start.n_cells)
    start, end = changes["near", "before"], changes["near", "after"]
    assert 0.1 * start.n_returns_other < end.n_returns < 0.9 * start.n_returns_other
    assert 0.1 * end.n_returns_other < start.n_returns < 0.9 * end.n_returns_other


def test_of_a_reshaped_pile_the_removed_part_is_the_change(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], tmp_path: Path
) -> None:
    size_m = (2.4, 1.6, 0.8)
    pile = make_prop("pile", 0.5, 0.7, kind="muck_pile", size_m=size_m, change="reshaped", loaded_share=0.4)
    scenario = make_scenario(props=(pile, make_prop("box", 0.2)))
    world = build_world(scenario, 0)
    whole, rest = (item for item in world.standing if item.prop.name == "pile")
    np.testing.assert_array_equal(whole.world_T_object, rest.world_T_object)
    change = changes_of(scenario, tmp_path)["pile", "before"]
    assert (change.kind, change.group, change.partner, change.session) == ("reshaped", "partial", None, "before")
    assert change.is_observable
    assert whole.shape.mesh_volume_m3 is not None and change.mesh_volume_m3 is not None
    assert change.mesh_volume_m3 == pytest.approx(0.4 * whole.shape.mesh_volume_m3, rel=0.15)
    assert change.mesh_volume_m3 <= change.hull_volume_m3 < whole.shape.hull_volume_m3
    assert change.n_returns_other > 100  # what is left is seen after


def test_returns_on_what_is_left_of_a_pile_are_no_change(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], sensor: SensorMetadata
) -> None:
    size_m = (2.4, 1.6, 0.8)
    pile = make_prop("pile", 0.5, 0.7, kind="muck_pile", size_m=size_m, change="reshaped", loaded_share=0.4)
    scenario = make_scenario(props=(pile,))
    world = build_world(scenario, 0)
    (tally,) = list_changes(scenario, world)
    rays = revolution_rays(sensor, np.tile(make_pose(translation=(10.0, -0.8, 0.9)), (sensor.width, 1, 1)))
    result = scan(
        world.before, sensor, Sensor(range_noise=False, dropouts=False, false_positives=False), rays, 0, "before", 0
    )
    is_pile = ((world.before.instance[result.geom] == 1) & (result.geom >= 0)).T
    column, row = np.nonzero(is_pile)
    points = rays.points(row, column, (result.true_range_m - sensor.beam_origin_m)[row, column])
    belongs = mark_belonging(tally, points)
    # By brute force: every return against every triangle of the after session near it.
    triangles = np.concatenate([mesh.vertices[mesh.faces] for mesh in world.after.meshes])
    triangles = triangles[np.linalg.norm(triangles.mean(axis=1) - points.mean(axis=0), axis=1) < 4.0]
    some = np.linspace(0, len(points) - 1, 60).astype(int)
    for number in some:
        distance_m = point_triangle_distance(np.tile(points[number], (len(triangles), 1)), triangles)
        assert belongs[number] == (distance_m.min() > 0.1)
    assert 5 < belongs[some].sum() < 55


def test_a_ghost_needs_no_closed_surface() -> None:
    rays = fan(501)
    box = box_at(5.0, 0.0, 0.0)
    middles = box.vertices[box.faces].mean(axis=1)
    skin = Mesh(box.vertices, box.faces[middles[:, 0] < 4.6])  # its near face alone
    ranges_m = np.full((501, 1), 9.0, np.float32)
    assert len(skin.faces) == 2
    assert Ghost(skin).count(rays, ranges_m) == Ghost(box).count(rays, ranges_m) > 100


def test_with_nothing_around_a_short_move_every_return_belongs_to_it() -> None:
    told = {"name": "rail", "kind": "railing", "size_m": (3.0, 0.05, 1.0), "change": "moved"}
    prop = Prop(**told, shift=Shift(distance_m=0.5, heading_deg=90.0))
    sides: tuple[tuple[SessionName, float], ...] = (("before", 0.0), ("after", 0.5))
    standing = [
        Standing(prop, shape_of(prop, 0), frozenset({session}), make_pose(translation=(0.0, across_m, 0.0)))
        for session, across_m in sides
    ]
    before, after = (Surfaces((standing_surface(item),), np.array([1], np.int32)) for item in standing)
    tallies = list_changes(make_graft(prop.model_dump()), Compared(standing, before, after))
    assert [tally.change.group for tally in tallies] == ["partial", "partial"]
    points = standing_surface(standing[0]).vertices
    assert all(mark_belonging(tally, points).all() for tally in tallies)
