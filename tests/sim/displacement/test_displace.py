from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from pydantic import ValidationError

from cdpipe.core.errors import ScenarioError
from scenarios.schema import (
    Bolts,
    Drift,
    Furniture,
    MeshFile,
    Odometry,
    Pipe,
    Place,
    Platform,
    Prop,
    Scenario,
    Section,
    Sensor,
    SessionPlan,
    SurfaceChange,
    SurfacePlace,
    Tunnel,
)
from sim.displacement.displace import Displacement, displace
from sim.geometry.topology import closed_volume_m3, edges_of
from sim.rock.centreline import build_centreline
from sim.rock.tunnel import mesh_tunnel
from sim.scene import build_world
from sim.session.planning import plan_drives
from sim.session.simulate import HeldPair, simulate, simulate_in_memory, simulate_pair
from sim.session.truth import SESSIONS, SessionName, read_chunk_surface, read_pair_truth


def at(fraction: float) -> SurfacePlace:
    return SurfacePlace(between=("a", "b"), fraction=fraction)


def change(kind: str, fraction: float = 0.5, **sizes: Any) -> SurfaceChange:
    place = SurfacePlace(node="b") if kind == "face" else at(fraction)
    return SurfaceChange(**{"name": kind, "kind": kind, "place": place} | sizes)


ALL = (
    change("convergence"),
    change("heave"),
    change("shotcrete"),
    change("scar"),
    change("fill", height_m=0.3),
    change("face"),
)


def moved_walls(scenario: Scenario, seed: int = 3) -> Displacement:
    centreline = build_centreline(scenario.tunnel, seed)
    found = displace(scenario, centreline, mesh_tunnel(scenario.tunnel, centreline, seed), seed)
    assert found is not None
    return found


@pytest.mark.parametrize("one", ALL, ids=lambda one: one.kind)
def test_walls_stay_closed_and_volumes_are_what_the_void_lost(
    make_scenario: Callable[..., Scenario], one: SurfaceChange
) -> None:
    found = moved_walls(make_scenario(surface=(one,)))
    meshes = [found.walls.mesh(session) for session in SESSIONS]
    assert all(edges_of(mesh).is_closed for mesh in meshes)
    before_m3, after_m3 = (closed_volume_m3(mesh) for mesh in meshes)
    assert before_m3 is not None and after_m3 is not None and before_m3 < 0  # they face inwards
    total_m3 = sum(found.volume_m3(patch.number) for patch in found.patches)
    assert total_m3 == pytest.approx(after_m3 - before_m3, rel=1e-9)
    signs = {patch.kind: np.sign(found.volume_m3(patch.number)) for patch in found.patches}
    assert all(sign == (-1 if kind in ("scar", "face") else 1) for kind, sign in signs.items())
    assert (found.label[~found.is_moved] == 0).all()


def test_rubble_is_the_scar_times_its_swell(make_scenario: Callable[..., Scenario]) -> None:
    for swell in (1.3, 1.6):
        found = moved_walls(make_scenario(surface=(change("scar", swell=swell),)))
        scar, rubble = found.patches
        assert (scar.partner, rubble.partner, rubble.kind) == (2, 1, "rubble")
        assert found.volume_m3(2) == pytest.approx(-swell * found.volume_m3(1), rel=0.01)


def test_changes_on_one_place_are_refused_in_one_line(make_scenario: Callable[..., Scenario]) -> None:
    twice = (change("convergence"), change("convergence", 0.52, name="other"))
    with pytest.raises(ScenarioError, match=r"^surface 'other': it meets another surface change between 'a' and 'b'"):
        moved_walls(make_scenario(surface=twice))


def test_a_drawn_place_depends_on_no_other_change_but_in_its_way(make_scenario: Callable[..., Scenario]) -> None:
    drawn = SurfaceChange(name="drawn", kind="convergence", sector_deg=(40, 100), length_m=1.0)
    alone = moved_walls(make_scenario(surface=(drawn,)))
    both = moved_walls(make_scenario(surface=(drawn, change("heave", 0.15, length_m=1.0))))
    assert alone.patches[0].zone.sample == both.patches[0].zone.sample


@pytest.mark.parametrize(
    ("kind", "said", "why"),
    [
        ("convergence", {"swell": 1.4}, "a convergence has no swell: leave that out"),
        ("face", {"depth_m": 0.1}, "a face has no depth_m"),
        ("heave", {"sector_deg": (30, 20)}, "from first"),
        ("heave", {"sector_deg": (-40, 40)}, "the floor lies between 90 and 270 degrees"),
        ("scar", {"place": SurfacePlace(node="b")}, "only a face or fill has place.node"),
    ],
)
def test_a_size_that_a_kind_does_not_have_is_refused(kind: str, said: dict[str, Any], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        change(kind, **said)


def test_a_node_that_is_no_blind_end_is_refused(make_scenario: Callable[..., Scenario]) -> None:
    with pytest.raises(ValidationError, match="no node of the tunnel is called c"):
        make_scenario(surface=(change("face", place=SurfacePlace(node="c")),))


IDEAL = Sensor(mode="512x10", range_noise=False, dropouts=False, false_positives=False)


def smooth(**override: Any) -> dict[str, Any]:
    tunnel = Tunnel(
        nodes={"a": (0, 0, 0), "b": (20, 0, 0)},
        drifts=(Drift(nodes=("a", "b")),),
        section=Section(shape="rectangle", width_m=4.0, height_m=3.2),
        resolution_m=0.2,
    )
    return {"tunnel": tunnel, "sensor": IDEAL} | override


@pytest.fixture(name="heaved", scope="module")
def heaved_fixture(make_scenario: Callable[..., Scenario]) -> HeldPair:
    """A flat floor that heaves by 0.1 m over the middle half of 8 m."""
    lift = change("heave", depth_m=0.1, length_m=8.0, sector_deg=(140, 220))
    return simulate_in_memory(make_scenario(**smooth(surface=(lift,))), 0)


def true_points(pair: HeldPair, session: SessionName) -> tuple[np.ndarray, np.ndarray]:
    """Return true places (N, 3) of the returns of a session without noise, and their displacement (N,)."""
    labelled = pair.sessions[session]
    sensor = labelled.session.sensor
    points, moved = [], []
    for index in range(len(labelled.world_T_sensor)):
        scan = labelled.session.chunk(0)
        row, column = np.nonzero(scan.range_mm[index])
        reach = scan.range_mm[index][row, column][:, None] / 1000.0 - sensor.beam_origin_m
        local = sensor.origins[row, column] + reach * sensor.directions[row, column]
        pose = labelled.world_T_sensor[index]
        points.append(local @ pose[:3, :3].T + pose[:3, 3])
        moved.append(labelled.displacement[index][row, column])
    return np.concatenate(points), np.concatenate(moved)


@pytest.mark.parametrize("session", SESSIONS)
def test_a_floor_that_rose_says_so_in_both_sessions_to_a_tenth_of_a_millimetre(
    heaved: HeldPair, session: SessionName
) -> None:
    labelled = heaved.sessions[session]
    assert labelled.displacement is not None and labelled.surface_change is not None
    moved_m = labelled.displacement[labelled.surface_change == 1]
    assert np.nanmin(moved_m) >= -1e-6
    # the flat top of the window is 4 m long: of the returns on it the plane is exactly 0.1 m away
    assert np.nanmax(moved_m) == pytest.approx(0.1, abs=1e-4)
    points, displacement = true_points(heaved, session)
    is_top = (np.abs(points[:, 0] - 10.0) < 1.5) & (np.abs(points[:, 1]) < 0.3) & (points[:, 2] < 0.3)
    assert is_top.sum() > 30
    np.testing.assert_allclose(displacement[is_top], 0.1, atol=1e-4)
    is_far = np.abs(points[:, 0] - 10.0) > 5.0
    assert (displacement[is_far & np.isfinite(displacement)] == 0).all()


def test_the_list_of_surface_changes_by_hand(heaved: HeldPair) -> None:
    (rose,) = heaved.truth.surface_changes
    assert (rose.id, rose.name, rose.kind, rose.partner) == (1, "heave", "heave", None)
    assert rose.largest_m == pytest.approx(0.1, abs=1e-4)
    assert 0 < rose.mean_m < 0.1 and rose.volume_m3 == pytest.approx(rose.mean_m * rose.area_m2, rel=0.02)
    np.testing.assert_allclose(rose.centre_world, [10.0, 0.0, 0.0], atol=0.1)


def test_signs_of_what_came_and_what_went(make_scenario: Callable[..., Scenario]) -> None:
    surface = (change("convergence", 0.3, depth_m=0.05), change("scar", 0.7, depth_m=0.3))
    pair = simulate_in_memory(make_scenario(**smooth(surface=surface)), 0)
    kinds = {each.id: each.kind for each in pair.truth.surface_changes}
    assert kinds == {1: "convergence", 2: "scar", 3: "rubble"}
    for session in SESSIONS:
        labelled = pair.sessions[session]
        assert labelled.displacement is not None and labelled.surface_change is not None
        for number, sign in ((1, 1), (2, -1), (3, 1)):
            moved_m = labelled.displacement[labelled.surface_change == number]
            assert len(moved_m) > 20
            assert (sign * moved_m[np.isfinite(moved_m)] > -2e-3).all(), (session, number)
            assert sign * np.nanmean(moved_m) > 0.01


def test_props_on_a_floor_that_heaved_move_with_it_and_are_no_change(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]
) -> None:
    place = Place(between=("a", "b"), fraction=0.5, lateral=0.0)
    box = make_prop("box", place=place, size_m=(0.5, 0.5, 0.5))
    lift = change("heave", depth_m=0.1, length_m=8.0, sector_deg=(140, 220))
    routes = {"before": SessionPlan(route=("a", "b"), end_m=12.0), "after": SessionPlan(route=("a", "b"), end_m=12.0)}
    scenario = make_scenario(**smooth(surface=(lift,), props=(box,), **routes))
    world = build_world(scenario, 0)
    before, after = world.standing
    assert (before.sessions, after.sessions) == ({"before"}, {"after"})
    np.testing.assert_allclose(after.world_T_object[:3, 3] - before.world_T_object[:3, 3], [0, 0, 0.1], atol=1e-3)
    assert simulate_in_memory(scenario, 0).truth.changes == ()


@pytest.mark.parametrize("depth_m", [0.04, 0.1])
def test_furniture_follows_rock_that_converges(make_scenario: Callable[..., Scenario], depth_m: float) -> None:
    squeezed = change("convergence", depth_m=depth_m, length_m=8.0, sector_deg=(45, 135))
    hung = Furniture(pipes=(Pipe(diameter_m=0.16, side="left", height_share=0.5),), bolts=Bolts(spacing_m=1.5))
    tunnel = smooth()["tunnel"].model_copy(update={"furniture": hung})
    world = build_world(make_scenario(**smooth(tunnel=tunnel, surface=(squeezed,))), 3)
    assert world.changed is not None and len(world.fixtures) > 1
    for old, new in zip(world.fixtures, world.changed[3], strict=True):
        places, moves = old.mesh.vertices, new.mesh.vertices - old.mesh.vertices
        # the left wall comes in by the full depth over the inner half of the 8 m, and not at all beside them
        is_middle = (np.abs(places[:, 0] - 10.0) < 1.0) & (places[:, 1] > 1.5) & (np.abs(places[:, 2] - 1.6) < 0.7)
        is_beside = (np.abs(places[:, 0] - 10.0) > 5.5) | (places[:, 1] < 0.5)
        assert is_middle.any() and is_beside.any(), old.name
        np.testing.assert_allclose(moves[is_middle], np.tile([0.0, -depth_m, 0.0], (is_middle.sum(), 1)), atol=2e-3)
        assert (moves[is_beside] == 0).all()


def test_rubble_that_leaves_no_lane_is_refused_in_one_line(make_scenario: Callable[..., Scenario]) -> None:
    fallen = change("scar", depth_m=0.3, length_m=2.0, sector_deg=(20, 60))
    narrow = smooth()["tunnel"].model_copy(update={"section": Section(shape="rectangle", width_m=2.2, height_m=3.2)})
    scenario = make_scenario(**smooth(tunnel=narrow, surface=(fallen,)))
    with pytest.raises(ScenarioError, match=r"^after: the rubble of surface 'scar' bars the way") as refused:
        plan_drives(scenario, 0)
    assert "\n" not in str(refused.value)
    # the session before the fall has its lane
    still = scenario.model_copy(update={"surface": ()})
    assert [drive.name for drive in plan_drives(still, 0)] == list(SESSIONS)


def test_kiss_icp_registers_a_session_in_which_rock_moved(make_scenario: Callable[..., Scenario]) -> None:
    pytest.importorskip("kiss_icp")
    dense = {
        "platform": Platform(scan_spacing_m=0.5),
        "before": SessionPlan(route=("a", "b"), start_m=2.0, end_m=10.0, odometry=Odometry(source="kiss-icp")),
        "surface": (change("convergence", 0.35),),
    }
    scenario = make_scenario(**dense)
    held = simulate_in_memory(scenario, 5)
    plain = scenario.model_copy(update={"before": SessionPlan(route=("a", "b"), start_m=2.0, end_m=10.0)})
    known = simulate_in_memory(plain, 5)
    estimated, drifting = held.sessions["before"], known.sessions["before"]
    assert np.abs(estimated.session.odom_T_sensor - drifting.session.odom_T_sensor).max() > 1e-3
    # the truth does not depend on who estimates the poses
    for name in ("displacement", "surface_change", "instance", "world_T_sensor"):
        np.testing.assert_array_equal(getattr(estimated, name), getattr(drifting, name))
    assert (np.asarray(estimated.surface_change) == 1).sum() > 100
    assert held.truth.surface_changes == known.truth.surface_changes


def test_two_threads_write_the_same_bytes(make_scenario: Callable[..., Scenario], tmp_path: Path) -> None:
    surface = (change("convergence", 0.3), change("scar", 0.7))
    scenario = make_scenario(surface=surface)
    simulate_pair(scenario, 5, tmp_path / "pair")
    held = simulate_in_memory(scenario, 5, n_threads=1)
    for session in SESSIONS:
        stored = read_chunk_surface(tmp_path / "pair" / session, 0)
        labelled = held.sessions[session]
        assert stored is not None and labelled.displacement is not None and labelled.surface_change is not None
        np.testing.assert_array_equal(stored[0], labelled.displacement)
        np.testing.assert_array_equal(stored[1], labelled.surface_change)
    assert read_pair_truth(tmp_path / "pair").surface_changes == held.truth.surface_changes


def test_without_surface_changes_nothing_is_written(make_scenario: Callable[..., Scenario], tmp_path: Path) -> None:
    scenario = make_scenario()
    assert "surface" not in scenario.model_dump(mode="json")
    simulate_pair(scenario, 5, tmp_path / "pair")
    assert read_chunk_surface(tmp_path / "pair" / "before", 0) is None
    assert "surface_changes" not in (tmp_path / "pair" / "truth" / "changes.json").read_text()


def test_an_empty_list_of_surface_changes_gives_the_bytes_of_none(tmp_path: Path) -> None:
    short = ["before.start_m=2", "before.end_m=22", "after.start_m=2", "after.end_m=22", "sensor.mode=512x10"]
    folders = []
    for name, more in (("none", []), ("empty", ["surface=[]"])):
        simulate("smoke/one_box", 10001, tmp_path / name, short + more)
        files = sorted(path for path in (tmp_path / name).rglob("*") if path.is_file())
        folders.append({path.relative_to(tmp_path / name).as_posix(): path.read_bytes() for path in files})
    assert folders[0] == folders[1]
    assert not [name for name in folders[0] if "surface" in name]
    document = json.loads(folders[0]["truth/changes.json"])
    assert set(document) == {"family", "seed", "score_radius_m", "changes", "scenario", "files"}
    assert "surface" not in document["scenario"]


def test_a_foreign_mesh_is_deformed_the_same_way(make_scenario: Callable[..., Scenario], tmp_path: Path) -> None:
    # twelve triangles: none of their corners lies where the rock changes
    room = trimesh.creation.box(extents=(24.0, 4.0, 3.2))
    room.apply_translation([10.0, 0.0, 1.6])
    room.invert()
    room.export(tmp_path / "hall.glb")
    tunnel = Tunnel(
        mesh=MeshFile(path=str(tmp_path / "hall.glb")),
        nodes={"a": (0, 0, 0), "b": (20, 0, 0)},
        drifts=(Drift(nodes=("a", "b")),),
        section=Section(shape="rectangle", width_m=4.0, height_m=3.2),
    )
    surface = (change("convergence", 0.3, depth_m=0.06, sector_deg=(60, 110)), change("scar", 0.65))
    pair = simulate_in_memory(make_scenario(tunnel=tunnel, sensor=IDEAL, surface=surface), 0)
    squeezed, scar, rubble = pair.truth.surface_changes
    assert squeezed.largest_m == pytest.approx(0.06, abs=1e-3)
    assert rubble.volume_m3 == pytest.approx(-1.45 * scar.volume_m3, rel=0.01)
    for session in SESSIONS:
        labelled = pair.sessions[session]
        assert labelled.displacement is not None and labelled.surface_change is not None
        assert np.nanmax(labelled.displacement[labelled.surface_change == 1]) == pytest.approx(0.06, abs=1e-3)


def test_a_scar_that_breaks_into_another_drift_is_refused(make_scenario: Callable[..., Scenario]) -> None:
    def beside(gap_m: float) -> Scenario:
        nodes = {"a": (0.0, 0.0, 0.0), "b": (20.0, 0.0, 0.0), "c": (20.0, gap_m, 0.0), "d": (0.0, gap_m, 0.0)}
        drifts = tuple(Drift(nodes=pair) for pair in (("a", "b"), ("b", "c"), ("c", "d")))
        tunnel = Tunnel(nodes=nodes, drifts=drifts, section=Section(width_m=3.2, height_m=3.0), resolution_m=0.25)
        return make_scenario(tunnel=tunnel, surface=(change("scar", sector_deg=(60, 100), depth_m=0.9),))

    with pytest.raises(ScenarioError, match=r"^surface 'scar': another drift lies behind the rock that falls out"):
        moved_walls(beside(4.0))
    assert moved_walls(beside(9.0)).patches[0].kind == "scar"


def test_the_face_of_a_stub_shorter_than_its_drift_is_wide_moves_away_from_the_junction(
    make_scenario: Callable[..., Scenario],
) -> None:
    tunnel = Tunnel(
        nodes={"a": (0, 0, 0), "j": (10, 0, 0), "c": (20, 0, 0), "b": (10, 2.2, 0)},
        drifts=(Drift(nodes=("a", "j", "c")), Drift(nodes=("j", "b"))),
        section=Section(shape="rectangle", width_m=5.0, height_m=3.2),
        resolution_m=0.2,
    )
    route = SessionPlan(route=("a", "j", "c"))
    found = moved_walls(
        make_scenario(tunnel=tunnel, surface=(change("face", advance_m=2.0),), before=route, after=route)
    )
    # the stub ends 2.2 m + half its width from the axis of the other drift, and 2 m of it are new
    far_m = [found.walls.mesh(session).vertices[:, 1].max() for session in SESSIONS]
    assert far_m[0] == pytest.approx(4.7, abs=0.3)
    assert far_m[1] - far_m[0] == pytest.approx(2.0, abs=0.3)
    assert found.volume_m3(1) < -0.8 * 2.0 * 5.0 * 3.2
