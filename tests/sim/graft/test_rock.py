"""Moving the rock of a simulated session taken for a recording, where everything is known."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial import cKDTree

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, invert, transform
from cdpipe.core.progress import report_nothing
from cdpipe.io.session import Session, read_session
from scenarios.grafted import RockChange
from sim.graft import Recorded, graft_in_memory, graft_pair
from sim.graft.part import Part
from sim.graft.plan import Graft, plan_graft
from sim.graft.rock.finding import find_rock
from sim.graft.rock.heights import fit_heights
from sim.graft.rock.moving import FLATTEST_DEG, RockCounts, move_rock
from sim.graft.surroundings import Surroundings
from sim.sensor.rays import revolution_rays
from sim.session.simulate import HeldPair
from sim.session.truth import SESSIONS, read_chunk_labels, read_chunk_surface, read_pair_truth
from sim.view.view import view_pair
from tests.sim.graft.conftest import PROPS, SEED, make_graft

SQUEEZED: dict[str, Any] = {"name": "squeezed", "kind": "convergence", "depth_m": 0.04, "length_m": 3, "width_m": 1.6}
BACK: dict[str, Any] = {"name": "back", "kind": "convergence", "depth_m": -0.03, "area_m2": 2.25}
SPRAYED: dict[str, Any] = {"name": "sprayed", "kind": "shotcrete", "thickness_m": 0.06, "area_m2": 2}


def graft_rock(recording: Session, *rock: dict[str, Any], props: tuple[dict[str, Any], ...] = ()) -> HeldPair:
    scenario = make_graft(*props, surface=tuple(RockChange(**each) for each in rock))
    return graft_in_memory(scenario, SEED, Recorded((recording,)), {})


@pytest.fixture(scope="module")
def planned(recording: Session) -> Graft:
    scenario = make_graft(surface=tuple(RockChange(**each) for each in (SQUEEZED, BACK, SPRAYED)))
    return plan_graft(scenario, SEED, Recorded((recording,)), report_nothing)


@pytest.fixture(scope="module")
def pair(recording: Session) -> HeldPair:
    return graft_rock(recording, SQUEEZED, BACK, SPRAYED)


@pytest.fixture(scope="module")
def null(recording: Session) -> HeldPair:
    return graft_rock(recording)


def world_returns(held: HeldPair, name: Any) -> tuple[Float64Array, Float64Array, np.ndarray]:
    """Places and directions (N, 3) of all pixels of a session, world frame, and which have a return."""
    session = held.sessions[name].session
    part = Part(name, session, np.arange(session.n_scans), np.eye(4))
    points, ways = [], []
    for each in part.revolutions():
        rays = revolution_rays(session.sensor, part.world_T_sensor[each.number] @ each.sensor_T_column)
        reach_m = each.range_mm / 1000.0 - session.sensor.beam_origin_m
        directions = rays.directions.transpose(1, 0, 2).astype(np.float64)
        points.append(rays.origins + reach_m[..., None] * directions)
        ways.append(directions)
    ranges_mm = np.concatenate([chunk.range_mm for chunk in session.chunks()])
    return np.concatenate(points).reshape(-1, 3), np.concatenate(ways).reshape(-1, 3), ranges_mm.ravel() > 0


def test_every_return_goes_along_its_ray_by_its_displacement(pair: HeldPair, null: HeldPair, planned: Graft) -> None:
    was, ways, _ = world_returns(null, "after")
    now, _, is_return = world_returns(pair, "after")
    held = pair.sessions["after"]
    assert held.displacement is not None and held.surface_change is not None
    moved_m, change = held.displacement.ravel(), held.surface_change.ravel()
    shift_m = ((now - was) * ways).sum(axis=1)
    assert (shift_m[(moved_m == 0) | ~np.isfinite(moved_m)] == 0).all()
    assert np.isnan(moved_m[~is_return]).all()
    for patch, sign in zip(planned.rock, (-1, 1, -1), strict=True):
        its = np.flatnonzero(change == patch.number)
        assert len(its) > 100
        local, way = transform(invert(patch.world_T_patch), was[its]), ways[its] @ patch.world_T_patch[:3, :3]
        normals = patch.heights.normals(local[:, :2])
        expected_m = shift_m[its] * (way * normals).sum(axis=1)  # off the plane through its old place
        inner = np.abs(expected_m - moved_m[its])
        assert np.median(inner) < 1e-3  # ranges are whole millimetres
        assert np.percentile(inner, 90) < 3e-3  # the surface is not flat, and shotcrete has an edge
        assert (np.sign(shift_m[its][np.abs(moved_m[its]) > 5e-3]) == sign).all()  # into the void is towards the sensor
        off_m, spread_m = patch.heights.off_m(local)[0], []
        for points, displacement in ((was[its], 0.0), (now[its], moved_m[its])):
            there = transform(invert(patch.world_T_patch), points)
            spread_m.append((patch.heights.off_m(there)[0] - displacement).std())
        assert spread_m[0] == pytest.approx(off_m.std())
        assert spread_m[1] == pytest.approx(spread_m[0], rel=0.05)  # roughness and noise stay


def test_what_is_measured_along_the_normal_is_the_truth(pair: HeldPair, null: HeldPair, planned: Graft) -> None:
    """Mean height of the returns of both sessions about places of the before session, as M3C2 compares them."""
    before, _, is_return = world_returns(pair, "before")
    after, _, is_after = world_returns(pair, "after")
    held = pair.sessions["before"]
    assert held.displacement is not None and held.surface_change is not None
    np.testing.assert_array_equal(before, world_returns(null, "before")[0])
    moved_m, change = held.displacement.ravel(), held.surface_change.ravel()
    trees = cKDTree(before[is_return]), cKDTree(after[is_after])
    for patch in planned.rock[:2]:
        error_m = []
        for row in np.flatnonzero(change == patch.number)[::5]:
            near = [tree.data[tree.query_ball_point(before[row], 0.25)] for tree in trees]
            if min(map(len, near)) < 10:
                continue
            off = near[0] - near[0].mean(axis=0)
            normal = np.linalg.eigh(off.T @ off)[1][:, 0]
            normal *= np.sign(normal @ patch.world_T_patch[:3, 2])
            error_m.append((near[1].mean(axis=0) - near[0].mean(axis=0)) @ normal - moved_m[row])
        assert len(error_m) > 20
        assert abs(np.mean(error_m)) < 3e-3
        assert np.median(np.abs(error_m)) < 5e-3


def test_the_truth_tells_every_rock_change(pair: HeldPair) -> None:
    truth = pair.truth
    assert truth.changes == ()
    told = truth.surface_changes
    kinds = [(1, "squeezed", "convergence"), (2, "back", "convergence"), (3, "sprayed", "shotcrete")]
    assert [(each.id, each.name, each.kind) for each in told] == kinds
    np.testing.assert_allclose([each.largest_m for each in told], [0.04, -0.03, 0.06], atol=1e-4)
    # the mean of Tukey's window over either side is 3/4
    np.testing.assert_allclose(told[0].volume_m3, 0.04 * 3 * 1.6 * 0.75**2, rtol=0.1)
    np.testing.assert_allclose(told[1].volume_m3, -0.03 * 2.25 * 0.75**2, rtol=0.1)
    np.testing.assert_allclose(told[2].volume_m3, 0.06 * (2**0.5 - 0.06) ** 2, rtol=0.15)
    for each in told:
        assert each.volume_m3 == pytest.approx(each.mean_m * each.area_m2, rel=0.05)
    assert truth.graft is not None
    for number, rock in enumerate(truth.graft["rock"], start=1):
        for held, n in zip(pair.sessions.values(), rock["moved"], strict=True):
            assert held.surface_change is not None
            assert (held.surface_change == number).sum() == n > 100
        assert sum(rock["left"]) < 0.1 * sum(rock["moved"])


def test_rays_that_meet_the_rock_flat_stay_and_have_no_truth(
    pair: HeldPair, null: HeldPair, planned: Graft, recording: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the walls of a drift are seen at any angle: with a tighter limit more returns stay
    monkeypatch.setattr("sim.graft.rock.moving.FLATTEST_DEG", 60.0)
    again = graft_rock(recording, SQUEEZED, BACK, SPRAYED)
    was, ways, _ = world_returns(null, "after")
    own, tight = pair.sessions["after"], again.sessions["after"]
    assert own.surface_change is not None and tight.displacement is not None
    for patch in planned.rock:
        its = np.flatnonzero(own.surface_change.ravel() == patch.number)
        normals = patch.heights.normals(transform(invert(patch.world_T_patch), was[its])[:, :2])
        cosine = -(ways[its] @ patch.world_T_patch[:3, :3] * normals).sum(axis=1)
        assert cosine.min() >= np.cos(np.deg2rad(FLATTEST_DEG))
        np.testing.assert_array_equal(np.isnan(tight.displacement.ravel()[its]), cosine < 0.5)
    left = np.isnan(tight.displacement) & np.isfinite(own.displacement)
    assert left.any()
    ranges_mm = [held.sessions["after"].session.chunk(0).range_mm for held in (again, null)]
    np.testing.assert_array_equal(ranges_mm[0][left], ranges_mm[1][left])


def test_on_disk_it_is_the_same_twice_and_without_rock_nothing_is_added(
    pair: HeldPair, recording: Session, tmp_path: Path
) -> None:
    rock = tuple(RockChange(**each) for each in (SQUEEZED, BACK, SPRAYED))
    digests = []
    for name, surface in (("one", rock), ("two", rock), ("none", ())):
        (tmp_path / name).mkdir()
        graft_pair(make_graft(surface=surface), SEED, Recorded((recording,)), {}, tmp_path / name)
        files = sorted(each for each in (tmp_path / name).rglob("*") if each.is_file())
        told = {each.relative_to(tmp_path / name).as_posix(): each.read_bytes() for each in files}
        digests.append({path: hashlib.sha256(content).hexdigest() for path, content in told.items()})
    assert digests[0] == digests[1]
    assert digests[0].keys() - digests[2].keys() == {f"{name}/truth/surface/00000.npz" for name in SESSIONS}
    assert {path for path in digests[2] if digests[0][path] != digests[2][path]} == {
        "after/chunks/00000.npz", "truth/changes.json"
    }  # fmt: skip
    for key in ("surface", "rock"):
        assert f'"{key}"' not in (tmp_path / "none" / "truth" / "changes.json").read_text()
    for name, held in pair.sessions.items():
        on_disk = read_chunk_surface(tmp_path / "one" / name, 0)
        assert on_disk is not None
        np.testing.assert_array_equal(on_disk[0], held.displacement)
        np.testing.assert_array_equal(on_disk[1], held.surface_change)
    assert read_pair_truth(tmp_path / "one").surface_changes == pair.truth.surface_changes
    view = view_pair(tmp_path / "one")
    assert [line.name for line in view.lines if line.name.startswith("rock/")] == [
        "rock/squeezed", "rock/back", "rock/sprayed"
    ]  # fmt: skip
    assert "squeezed, convergence +40 mm" in {label.text for label in view.labels}


def test_rock_beside_props_keeps_clear_of_them_and_changes_nothing_of_them(recording: Session, tmp_path: Path) -> None:
    scenario = make_graft(*PROPS, surface=(RockChange(**SQUEEZED),))
    graft_pair(scenario, SEED, Recorded((recording,)), {}, tmp_path)
    held = graft_in_memory(make_graft(*PROPS), SEED, Recorded((recording,)), {})
    truth = read_pair_truth(tmp_path)
    assert truth.changes == held.truth.changes
    for name in SESSIONS:
        instance, change = read_chunk_labels(tmp_path / name, 0)
        np.testing.assert_array_equal(instance, held.sessions[name].instance)
        np.testing.assert_array_equal(change, held.sessions[name].change)
        surface = read_chunk_surface(tmp_path / name, 0)
        assert surface is not None
        assert np.isnan(surface[0][instance > 0]).all()
        is_still = (surface[0] == 0) | np.isnan(surface[0]) | (name == "before")
        now, was = (each.chunk(0).range_mm for each in (read_session(tmp_path / name), held.sessions[name].session))
        np.testing.assert_array_equal(now[is_still], was[is_still])
    assert truth.graft is not None
    middle = np.array(truth.graft["rock"][0]["world_T_patch"])[:3, 3]
    assert min(np.linalg.norm(np.array(each["world_T_object"])[:3, 3] - middle) for each in truth.graft["props"]) > 0.6


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"kind": "scar"}, "'convergence', 'heave' or 'shotcrete'"),
        ({"kind": "convergence", "area_m2": -1}, "greater than or equal to 0.25"),
        ({"kind": "convergence", "depth_m": 0}, "without 0"),
        ({"kind": "convergence", "depth_m": 0.1, "area_m2": 1}, "-0.05 to 0.05 without 0, a twentieth"),
        ({"kind": "convergence", "sector_deg": (40, 120)}, "a convergence has no sector_deg"),
        ({"kind": "shotcrete", "depth_m": 0.05}, "a shotcrete has no depth_m"),
        ({"kind": "heave", "depth_m": -0.001}, "depth_m = -0.001: rock that moves by 0.001 m or less"),
        ({"kind": "shotcrete", "thickness_m": 0.0005}, "thickness_m = 0.0005: rock that moves by 0.001 m or less"),
        ({"kind": "heave", "area_m2": 4, "length_m": 2}, "give area_m2, or length_m and width_m"),
        ({"kind": "heave", "place": {"node": "a"}}, "a recording has no nodes"),
    ],
)
def test_what_rock_cannot_do_is_told(told: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        RockChange(name="rock", **told)


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"length_m": 12, "width_m": 12}, r"'rock' finds no place in \d+ tries \(\d+ times .*: make it smaller"),
        ({"place": {"at": (500, 0, 0)}}, r"'rock' cannot be at place.at = \[500.0, 0.0, 0.0\]: nothing was recorded"),
        ({"kind": "heave", "place": {"at": (5, 0, 2.2)}}, "nothing was recorded|it is no floor"),
    ],
)
def test_rock_without_a_place_is_refused(
    recording: Session, told: dict[str, Any], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sim.graft.rock.finding.TRIES", 20)
    with pytest.raises(ScenarioError, match=message):
        graft_rock(recording, {"name": "rock", "kind": "convergence", **told})


def test_rock_that_hardly_moves_has_a_truth_that_can_be_read(recording: Session, tmp_path: Path) -> None:
    rock = RockChange(name="thin", kind="shotcrete", thickness_m=0.00101, area_m2=2)
    graft_pair(make_graft(surface=(rock,)), SEED, Recorded((recording,)), {}, tmp_path)
    (thin,) = read_pair_truth(tmp_path).surface_changes
    assert thin.largest_m == pytest.approx(0.00101, rel=1e-3)


def test_a_recording_without_returns_within_reach_has_no_place_for_rock(recording: Session) -> None:
    empty = make_graft(surface=(RockChange(name="rock", kind="convergence"),))
    scene = Surroundings([Part("before", recording, np.arange(recording.n_scans), np.eye(4))], 4.0)
    scene.n_points = 0
    with pytest.raises(ScenarioError, match=r"^surface 'rock' finds no place in 0 tries \(nothing was recorded"):
        find_rock(empty, scene, (), SEED)


def test_a_given_place_is_the_middle(recording: Session, planned: Graft) -> None:
    middle = planned.rock[0].world_T_patch[:3, 3]
    held = graft_rock(recording, {**SQUEEZED, "place": {"at": tuple(middle + 0.01)}})
    centre = np.array(held.truth.surface_changes[0].centre_world)
    assert np.linalg.norm(centre - middle) < 0.15


def test_a_surface_through_noisy_returns_and_past_a_cable() -> None:
    generator = np.random.default_rng(5)
    places = generator.uniform(-1.5, 1.5, (6000, 2))
    height = 0.1 * places[:, 0] + 0.08 * places[:, 1] ** 2
    points = np.column_stack([places, height + generator.normal(0, 0.01, 6000)])
    points[::40, 2] += 0.3  # 2.5 % of them
    fitted = fit_heights(points, (1.2, 1.0))
    assert fitted is not None
    asked = generator.uniform(-1, 1, (200, 2)) * (1.0, 0.8)
    assert np.abs(fitted.at(asked) - 0.1 * asked[:, 0] - 0.08 * asked[:, 1] ** 2).max() < 0.012
    off_m, normals = fitted.off_m(np.array([[0.0, 0.0, 0.05]]))
    np.testing.assert_allclose(normals[0], np.array([-0.1, 0, 1]) / np.hypot(0.1, 1), atol=0.03)
    assert off_m[0] == pytest.approx(0.05, abs=0.01)
    assert fit_heights(points[:5], (1.2, 1.0)) is None


def test_a_coarse_step_of_ranges_keeps_the_mean_of_a_displacement(planned: Graft) -> None:
    part = planned.parts[1]
    fine, coarse = [], []
    for recorded in part.revolutions():
        counts = RockCounts(*np.zeros((2, len(planned.rock)), np.int64))
        for step_mm, found in ((1, fine), (8, coarse)):
            moved, _ = move_rock(part, recorded, planned.rock, step_mm, counts, planned.seed)
            found.append((moved.range_mm.astype(np.int64) - recorded.range_mm)[recorded.range_mm > 0])
    exact, rounded = np.concatenate(fine), np.concatenate(coarse)
    assert (rounded % 8 == 0).all()
    plateau = np.abs(exact) > 3
    assert plateau.sum() > 1000
    assert rounded[plateau].mean() == pytest.approx(exact[plateau].mean(), abs=0.4)
