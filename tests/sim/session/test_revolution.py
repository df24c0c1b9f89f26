from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, invert
from cdpipe.io.session import read_session
from cdpipe.sensor.ouster import SensorMetadata
from scenarios.schema import Odometry, Prop, Scenario, Sensor, SessionPlan, Shift
from sim.drive.trajectory import record
from sim.geometry.mesh import Mesh, join_meshes, point_triangle_distance
from sim.session.labels import Returns, mark_belonging
from sim.session.planning import plan_drives
from sim.session.revolution import (
    Drive,
    cast_revolution,
    measured_points,
    simulate_revolution,
    tally_revolution,
    true_reach_m,
)
from sim.session.simulate import simulate_pair
from sim.session.truth import MIXED, read_labels, read_pair_truth

IDEAL = Sensor(mode="512x10", range_noise=False, dropouts=False, false_positives=False)


@pytest.fixture(scope="module")
def partial_changes(make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]) -> Scenario:
    """A box moved by half its length, a pile partly loaded away, and a box that is new; odometry that turns."""
    pile = {"kind": "muck_pile", "size_m": (2.4, 1.6, 0.8), "loaded_share": 0.4}
    return make_scenario(
        props=(
            make_prop("near", 0.35, change="moved", shift=Shift(distance_m=0.4)),
            make_prop("pile", 0.6, -0.7, change="reshaped", **pile),
            make_prop("new", 0.85, change="added"),
        ),
        before=SessionPlan(route=("a", "b"), start_m=2.0, end_m=2.0, odometry=Odometry(yaw_deg_per_100m=9)),
    )


@pytest.fixture(scope="module")
def drives(partial_changes: Scenario, sensor: SensorMetadata) -> list[Drive]:
    return [with_sensor(drive, IDEAL) for drive in plan_drives(partial_changes, 3, sensor)]


def with_sensor(drive: Drive, settings: Sensor) -> Drive:
    scenario = drive.scenario.model_copy(update={"sensor": settings})
    trajectory = record(drive.trajectory.true, scenario, drive.sensor, drive.seed, drive.name)
    return replace(drive, scenario=scenario, trajectory=trajectory)


def surface_of(drive: Drive, instance: int) -> Mesh:
    owners = zip(drive.scene.meshes, drive.scene.instance, strict=True)
    return join_meshes([mesh for mesh, owner in owners if owner == instance])


def off_surface_m(points: Float64Array, mesh: Mesh) -> Float64Array:
    """Distance of each point to a surface, against every one of its triangles."""
    triangles = mesh.vertices[mesh.faces]
    place = np.repeat(np.arange(len(points)), len(triangles))
    distance_m = point_triangle_distance(points[place], np.tile(triangles, (len(points), 1, 1)))
    return np.asarray(distance_m.reshape(len(points), -1).min(axis=1))


def some_of(indices: np.ndarray) -> np.ndarray:
    return indices[:: max(1, len(indices) // 40)]


def test_of_a_partial_change_only_a_part_of_the_returns_is_labelled(partial_changes: Scenario, tmp_path: Path) -> None:
    simulate_pair(partial_changes, 3, tmp_path / "pair")
    changes = read_pair_truth(tmp_path / "pair").changes
    assert [(item.name, item.session, item.group) for item in changes] == [
        ("near", "before", "partial"),
        ("near", "after", "partial"),
        ("pile", "before", "partial"),
        ("new", "after", "full"),
    ]
    for name in ("before", "after"):
        session = read_session(tmp_path / "pair" / name)
        instance, change = (
            np.concatenate(part) for part in zip(*read_labels(session.path, session.n_chunks), strict=True)
        )
        for item in changes:
            is_labelled, is_on_it = change == item.id, instance == item.instance
            assert not (is_labelled & ~is_on_it).any()
            if item.session != name:
                assert not is_labelled.any()
                assert item.n_returns_other == is_on_it.sum()
            elif item.group == "partial":
                assert 100 < is_labelled.sum() == item.n_returns < 0.95 * is_on_it.sum()
            else:
                assert 100 < is_labelled.sum() == item.n_returns == is_on_it.sum()


def test_labelled_returns_of_a_partial_change_lie_off_what_the_other_session_holds(drives: list[Drive]) -> None:
    for drive, other in (drives, drives[::-1]):
        number = drive.trajectory.n_scans // 2
        revolution = simulate_revolution(drive, number)
        labels = revolution.change
        rays, result = cast_revolution(drive, number)
        reach_m = true_reach_m(drive.sensor, result)
        for tally in drive.tallies:
            change = tally.change
            if change.session != drive.name or change.group != "partial":
                continue
            row, column = np.nonzero(revolution.instance == change.instance)
            assert len(row) > 20
            some = some_of(np.arange(len(row)))
            row, column = row[some], column[some]
            points = rays.points(row, column, reach_m[row, column])
            # What stands there in the other session is the same prop, the floor under it or the wall behind it.
            everything = join_meshes([near_to(mesh, points) for mesh in other.scene.meshes])
            is_off = off_surface_m(points, everything) > 0.1
            np.testing.assert_array_equal(labels[row, column] == change.id, is_off)
            np.testing.assert_array_equal(mark_belonging(tally, points), is_off)


def near_to(mesh: Mesh, points: Float64Array) -> Mesh:
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    return Mesh(mesh.vertices, mesh.faces[np.linalg.norm(middles - points.mean(axis=0), axis=1) < 2.5])


@pytest.mark.parametrize("sub_rays", [1, 7])
def test_true_and_measured_places_of_returns_lie_on_what_they_hit(drives: list[Drive], sub_rays: int) -> None:
    for drive in (with_sensor(each, IDEAL.model_copy(update={"sub_rays": sub_rays})) for each in drives):
        number = drive.trajectory.n_scans // 2
        rays, result = cast_revolution(drive, number)
        reach_m = true_reach_m(drive.sensor, result)
        np.testing.assert_array_equal(reach_m > 0, result.geom >= 0)
        for tally in drive.tallies:
            is_own = tally.change.session == drive.name
            row, column = np.nonzero(
                (result.owner == tally.change.instance) & ~result.is_mixed
                if is_own
                else drive.labels.take(result.geom, mode="wrap") == tally.change.instance
            )
            if not is_own and not len(row):
                continue
            surface = surface_of(drive, tally.change.instance)
            assert len(row) > 20
            some = some_of(np.arange(len(row)))
            row, column = row[some], column[some]
            true_world = rays.points(row, column, reach_m[row, column])
            poses = zip(
                drive.trajectory.world_T_column(slice(number, number + 1))[0, column],
                drive.trajectory.odom_T_column(number, column),
                measured_points(drive, number, result.range_mm, row, column),
                strict=True,
            )
            measured = np.array([(true @ invert(odom) @ np.append(point, 1.0))[:3] for true, odom, point in poses])
            if sub_rays == 1:
                assert off_surface_m(true_world, surface).max() < 1e-4
                assert off_surface_m(measured, surface).max() < 0.6e-3  # whole millimetres
            elif is_own:  # half a beam's width aside, and a tenth of a metre along it
                assert off_surface_m(measured, surface).max() < 0.11


def test_a_ray_that_brought_nothing_back_is_no_ghost_ray(drives: list[Drive]) -> None:
    for drive in drives:
        number = drive.trajectory.n_scans // 2
        seen = simulate_revolution(drive, number).ghost_rays
        # Reach so short that every return is dropped: the rays go where they went and nothing is recorded.
        blind = simulate_revolution(with_sensor(drive, IDEAL.model_copy(update={"max_range_m": 0.31})), number)
        assert not blind.range_mm.any()
        assert (blind.instance == -1).all()
        assert (
            seen.keys()
            == blind.ghost_rays.keys()
            == {t.change.id for t in drive.tallies if t.change.session != drive.name}
        )
        assert max(seen.values()) > 20
        assert set(blind.ghost_rays.values()) == {0}
        assert not blind.change.any()


def test_a_mixed_return_keeps_its_instance_and_belongs_to_no_change_and_not_to_the_rest(drives: list[Drive]) -> None:
    n_mixed, n_of_rest = 0, 0
    for drive in (with_sensor(each, IDEAL.model_copy(update={"sub_rays": 7})) for each in drives):
        own = [tally.change for tally in drive.tallies if tally.change.session == drive.name]
        assert set(drive.owners.tolist()) == {0, *(change.instance for change in own)}
        for number in range(drive.trajectory.n_scans):
            _, result = cast_revolution(drive, number)
            revolution = simulate_revolution(drive, number)
            labels = revolution.change
            np.testing.assert_array_equal(labels == MIXED, result.is_mixed)
            n_mixed += int(result.is_mixed.sum())
            # what blends walls, floor and props that stay is theirs, however far it lies off either
            off_m = np.abs(result.range_mm / 1000.0 - result.true_range_m)
            n_of_rest += int(((labels == 0) & (result.geom >= 0) & (off_m > 0.1)).sum())
            for change in own:
                is_its = (result.owner == change.instance) & ~result.is_mixed
                if change.group == "full":
                    np.testing.assert_array_equal(labels == change.id, is_its)
                else:
                    assert not (labels == change.id)[~is_its].any()
            np.testing.assert_array_equal(revolution.instance, drive.labels.take(result.geom, mode="wrap"))
            tallies = tuple(replace(tally, own=Returns(), other=Returns()) for tally in drive.tallies)
            tally_revolution(replace(drive, tallies=tallies), number, revolution)
            for tally in tallies:
                is_own = tally.change.session == drive.name
                assert tally.own.n == (labels == tally.change.id).sum() * is_own
                assert tally.other.n == (revolution.instance == tally.change.instance).sum() * (not is_own)
    assert n_mixed > 30 and n_of_rest > 10
