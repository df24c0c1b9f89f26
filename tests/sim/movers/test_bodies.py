from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from cdpipe.core.geometry import Float64Array, transform
from scenarios.schema import Mover
from sim.movers.body import Moment, measure_extent, sample_moments
from sim.movers.curtain import Curtain
from sim.movers.mover import MovingBody
from sim.movers.person import Person, step_length_m

MakeBody = Callable[..., MovingBody]
SPEED_MPS, HEIGHT_M = 1.3, 1.75


@pytest.fixture(name="walker")
def walker_fixture() -> Person:
    return Person(HEIGHT_M, SPEED_MPS)


def walk(person: Person, n: int = 400, activity: float = 1.0, slope: float = 0.0) -> tuple[Moment, Float64Array]:
    """Two strides at full speed: the moments, and root_T_link by the name of the link."""
    way_m = np.linspace(0.0, 4 * person.step_m, n)
    zero = np.zeros(n)
    moment = Moment(way_m / SPEED_MPS, way_m, zero + activity, zero, zero + slope, zero)
    return moment, person.place_links(moment)


def find_link(person: Person, name: str) -> int:
    return [link.name for link in person.links].index(name)


def pitch_deg(poses: Float64Array) -> Float64Array:
    return np.rad2deg(np.arctan2(poses[:, 0, 2], poses[:, 0, 0]))


def test_the_cadence_at_a_usual_speed_is_that_of_people() -> None:
    step_m = step_length_m(SPEED_MPS)
    assert step_m == pytest.approx(0.71, abs=0.01)
    assert SPEED_MPS / step_m == pytest.approx(1.83, abs=0.02)
    assert step_length_m(62 / 60) == pytest.approx(62 / 98, abs=1e-9)  # the published pair
    assert step_length_m(0.0) == 0.0


@pytest.mark.parametrize("slope", [0.0, 0.08, -0.08])
def test_a_foot_on_the_floor_neither_slides_nor_sinks_nor_hovers(walker: Person, slope: float) -> None:
    moment, poses = walk(walker, slope=slope)
    for side, ahead in (("left", 0.0), ("right", 0.5)):
        ankle = poses[find_link(walker, f"{side} foot")][:, :3, 3]
        stride = (moment.way_m / (2 * walker.step_m) + ahead) % 1
        floor_m = slope * ankle[:, 0]
        sole_m = ankle[:, 2] - 0.039 * HEIGHT_M - floor_m
        for number in np.unique((moment.way_m / (2 * walker.step_m) + ahead) // 1):
            is_down = (stride < 0.499) & ((moment.way_m / (2 * walker.step_m) + ahead) // 1 == number)
            if is_down.sum() < 10:
                continue
            planted_m = (moment.way_m + ankle[:, 0])[is_down]
            assert np.ptp(planted_m) < 2e-3
            assert np.abs(sole_m[is_down]).max() < 2e-3
        assert sole_m.min() > -1e-3
        assert sole_m.max() == pytest.approx(0.09, abs=5e-3)


def test_the_gait_is_periodic_and_the_right_leg_does_what_the_left_did_half_a_stride_ago(walker: Person) -> None:
    _, poses = walk(walker, 401)
    np.testing.assert_allclose(poses[:, :200], poses[:, 200:400], atol=1e-9)
    for part in ("thigh", "shank", "foot", "upper arm", "forearm"):
        left, right = (poses[find_link(walker, f"{side} {part}")] for side in ("left", "right"))
        np.testing.assert_allclose(pitch_deg(left[100:200]), pitch_deg(right[:100]), atol=1e-6)
    assert np.abs(np.diff(poses[:, :, :3, 3], axis=1)).max() < 0.03  # nothing jumps


def test_joints_stay_within_what_people_can_do_and_links_stay_joined(walker: Person) -> None:
    _, poses = walk(walker)
    for side in ("left", "right"):
        thigh, shank = (poses[find_link(walker, f"{side} {part}")] for part in ("thigh", "shank"))
        knee_deg = pitch_deg(shank) - pitch_deg(thigh)
        assert knee_deg.min() > -1e-6 and 40 < knee_deg.max() < 80  # flexes in the swing, never backwards
        assert -50 < pitch_deg(thigh).min() < -20 and 5 < pitch_deg(thigh).max() < 30
        knee = thigh[:, :3, 3] - 0.245 * HEIGHT_M * thigh[:, :3, 2]
        np.testing.assert_allclose(knee, shank[:, :3, 3], atol=1e-9)
        upper, fore = (poses[find_link(walker, f"{side} {part}")] for part in ("upper arm", "forearm"))
        np.testing.assert_allclose(upper[:, :3, 3] - 0.186 * HEIGHT_M * upper[:, :3, 2], fore[:, :3, 3], atol=1e-9)
        assert (pitch_deg(fore) - pitch_deg(upper)).max() < 0  # an elbow bends forwards


def test_who_stands_is_upright_on_both_feet_and_as_tall_as_asked(walker: Person) -> None:
    _, poses = walk(walker, activity=0.0)
    for side in ("left", "right"):
        ankle = poses[find_link(walker, f"{side} foot")][:, :3, 3]
        np.testing.assert_allclose(ankle[:, [0, 2]], [[0.0, 0.039 * HEIGHT_M]] * len(ankle), atol=1e-9)
    crown_m = poses[0][:, 2, 3] + (1 - 0.53) * HEIGHT_M
    np.testing.assert_allclose(crown_m, HEIGHT_M, atol=0.02)


def test_a_curtain_hangs_together_and_swings_with_the_period_of_a_rod() -> None:
    curtain = Curtain(1.6, 2.4, 10.0)
    assert curtain.period[1] == pytest.approx(2 * np.pi * np.sqrt(2 * 2.4 / (3 * 9.81)))
    poses = curtain.place_links(sample_moments(curtain))
    lower_edges = poses[:-1, :, :3, 3] - curtain.strip_m * poses[:-1, :, :3, 2]
    np.testing.assert_allclose(lower_edges, poses[1:, :, :3, 3], atol=1e-12)
    assert pitch_deg(poses[-1]).max() == pytest.approx(10.0, abs=0.1)
    assert np.abs(poses[0, :, :3, 3]).max() == 0.0


@pytest.mark.parametrize(("kind", "rise_m"), [("forklift", 0.0), ("loader", 0.4)])
def test_a_machine_fills_its_size_and_stands_on_the_floor(kind: str, rise_m: float, make_body: MakeBody) -> None:
    body = make_body(kind)
    assert body.mover.size_m is not None
    zero = np.zeros(1)
    rest = body.figure.body.place_links(Moment(zero, zero, zero, zero, zero, zero))[:, 0]
    corners = np.concatenate(
        [
            transform(pose, np.concatenate([mesh.vertices for mesh in limb.meshes]))
            for limb, pose in zip(body.figure.limbs, rest, strict=True)
        ]
    )
    np.testing.assert_allclose(np.ptp(corners, axis=0), body.mover.size_m, rtol=0.03)
    assert abs(corners[:, 2].min()) < 1e-3
    assert body.figure.extent.high[2] < body.mover.size_m[2] + 0.05 + rise_m


@pytest.mark.parametrize("kind", ["person", "forklift", "loader", "curtain"])
def test_the_extent_holds_every_moment(kind: str, make_body: MakeBody) -> None:
    body = make_body(kind)
    extent = measure_extent(body.figure.body, [limb.meshes for limb in body.figure.limbs])
    generator = np.random.default_rng(3)
    time_s = generator.uniform(0, 200, 400)
    moment = body.course.moment(time_s)
    straight = Moment(moment.time_s, moment.way_m, moment.activity, moment.turned, moment.slope, 0 * moment.way_m)
    for limb, poses in zip(body.figure.limbs, body.figure.body.place_links(straight), strict=True):
        corners = np.concatenate([mesh.vertices for mesh in limb.meshes])
        for pose in poses:
            moved = transform(pose, corners)
            assert (moved > extent.low).all() and (moved < extent.high).all()


@pytest.mark.parametrize("bend_per_m", [-0.15, 0.15])
@pytest.mark.parametrize("kind", ["person", "forklift", "loader"])
def test_the_reach_of_a_mover_holds_every_moment_on_a_bend(kind: str, bend_per_m: float, make_body: MakeBody) -> None:
    body = make_body(kind)
    way = body.course.distance_m / body.course.length_m
    bent = replace(body, course=replace(body.course, bend_per_m=bend_per_m * way))
    extent, reach = body.figure.extent, bent.figure.reach
    moment = bent.course.moment(np.random.default_rng(3).uniform(0, 200, 400))
    boxes = list(zip(*reach.at(moment.bend_per_m), strict=True))
    for limb, poses in zip(bent.figure.limbs, bent.figure.body.place_links(moment), strict=True):
        corners = np.concatenate([mesh.vertices for mesh in limb.meshes])
        for pose, (low, high) in zip(poses, boxes, strict=True):
            moved = transform(pose, corners)
            assert (moved > low).all() and (moved < high).all()
    for bend, is_wider in ((0.0, False), (bend_per_m, kind == "loader")):
        low, high = (corner[0] for corner in reach.at(np.array([bend])))
        assert (low <= extent.low).all() and (high >= extent.high).all()
        assert bool((high - low)[1] > (extent.high - extent.low)[1] + 0.5) == is_wider


@pytest.mark.parametrize("height_m", [1.2, 1.75, 2.2])
def test_a_person_walks_as_fast_as_half_a_step_reaches_and_no_faster(height_m: float) -> None:
    # half of a step, the root of speed times 0.3873 m s, over 0.985 of the leg, 0.491 of the height
    fastest_mps = (2 * 0.985 * 0.491 * height_m) ** 2 / (60 * 62 / 98**2)
    told = {"name": "runner", "kind": "person", "height_m": height_m}
    assert Mover(**told, speed_mps=0.999 * fastest_mps).height_m == height_m
    _, poses = walk(Person(height_m, 0.999 * fastest_mps))
    assert np.isfinite(poses).all()
    with pytest.raises(ValidationError, match=rf"speed_mps = .*height_m = {height_m:g}"):
        Mover(**told, speed_mps=1.001 * fastest_mps)
