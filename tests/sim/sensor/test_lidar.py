from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float32Array, Float64Array, Int64Array, make_pose, stream, transform
from cdpipe.io.session import read_session
from cdpipe.sensor.ouster import SensorMetadata, load_profile
from scenarios.schema import Prop, Scenario, Sensor
from sim.drive.trajectory import plan_trajectory
from sim.geometry.mesh import Mesh, box_mesh, move_mesh
from sim.geometry.raycast import Caster
from sim.scene import Scene, build_world
from sim.sensor import lidar, optics
from sim.sensor.footprint import Echo, spread_echo
from sim.sensor.lidar import FALSE_RETURN, MISS, Scan, scan
from sim.sensor.optics import detection_probability, range_sigma_m, received_photons
from sim.sensor.rays import Rays, revolution_rays
from sim.session.simulate import simulate_pair
from sim.session.truth import read_labels, read_pair_truth

IDEAL = Sensor(range_noise=False, dropouts=False, false_positives=False)
EVERYTHING = Sensor(sub_rays=19, range_step_mm=8)


def room(half_m: tuple[float, float, float], reflectivity: float) -> Scene:
    mesh = Mesh(box_mesh(half_m).vertices, box_mesh(half_m).faces[:, ::-1])
    share = np.array([reflectivity], np.float32)
    return Scene((mesh,), Caster([mesh]), np.zeros(1, np.int32), share, ("wall",), ("rock",))


def still(sensor: SensorMetadata, place: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Rays:
    return revolution_rays(sensor, np.tile(make_pose(translation=place), (sensor.width, 1, 1)))


def reach_in_room(sensor: SensorMetadata, half_m: tuple[float, float, float]) -> tuple[Float64Array, Float64Array]:
    """By hand: distance (H, W) from the beam's origin to the nearest wall, and the cosine of incidence there."""
    reach = (np.sign(sensor.directions) * half_m - sensor.origins) / sensor.directions
    wall = reach.argmin(axis=-1)[..., None]
    cosine = np.take_along_axis(np.abs(sensor.directions), wall, axis=-1)
    return reach.min(axis=-1), cosine[..., 0]


def channels(result: Scan) -> list[npt.NDArray[np.integer]]:
    return [result.range_mm, result.reflectivity, result.signal, result.geom]


def test_a_turning_and_moving_sensor_in_a_room_gives_planes_once_deskewed(
    sensor: SensorMetadata,
) -> None:
    half_m = (5.0, 3.0, 2.0)
    share = np.arange(sensor.width) / sensor.width
    turns = Rotation.from_euler("zyx", np.stack([1.2 * share, 0.1 * share, 0.05 * share], axis=1)).as_matrix()
    world_T_column = np.stack([make_pose(r, (0.8 * s, -0.3 * s, 0.1)) for r, s in zip(turns, share, strict=True)])
    rays = revolution_rays(sensor, world_T_column)
    result = scan(room(half_m, 0.5), sensor, IDEAL, rays, 0, "before", 0)
    assert (result.range_mm > 0).all()
    points = sensor.project(result.range_mm / 1000.0)
    world = np.stack([transform(world_T_column[c], points[:, c]) for c in range(sensor.width)], axis=1)
    off_wall_m = np.abs(np.abs(world) - half_m).min(axis=-1)
    assert off_wall_m.max() < 0.6e-3  # half a range step, and the float32 of the caster
    # Without the columns' own poses the walls are bent.
    skewed = transform(world_T_column[0], points.reshape(-1, 3))
    assert np.abs(np.abs(skewed) - half_m).min(axis=-1).max() > 0.3


def test_with_every_switch_off_the_scan_is_the_exact_geometry(sensor: SensorMetadata) -> None:
    half_m = (4.0, 4.0, 4.0)
    result = scan(room(half_m, 0.5), sensor, IDEAL, still(sensor), 0, "before", 0)
    reach, cosine = reach_in_room(sensor, half_m)
    # The reported range counts from the spin axis: the beam-origin offset is in it.
    expected = reach + sensor.beam_origin_m
    np.testing.assert_allclose(result.true_range_m, expected, atol=2e-5)
    np.testing.assert_array_equal(result.range_mm, np.rint(result.true_range_m * np.float32(1000.0)))
    np.testing.assert_allclose(result.range_mm / 1000.0, expected, atol=0.55e-3)
    assert np.abs(result.reflectivity - 50.0 * cosine).max() < 0.51
    light = received_photons((0.5 * cosine).astype(np.float32), expected.astype(np.float32))
    assert np.abs(result.signal - light).max() < 0.55


@pytest.mark.parametrize("profile", ["os1-32-nominal", "os1-32-u0"])
def test_the_head_spins_clockwise_and_beams_are_staggered_as_their_shift_says(profile: str) -> None:
    sensor = load_profile(profile, "1024x10")
    result = scan(room((6.0, 6.0, 6.0), 0.5), sensor, IDEAL, still(sensor), 0, "before", 0)
    points = sensor.project(result.range_mm / 1000.0)
    azimuth = np.arctan2(points[..., 1], points[..., 0])
    steps = np.diff(np.unwrap(azimuth, axis=1), axis=1)
    assert (steps < 0).all()  # seen from above
    np.testing.assert_allclose(np.rad2deg(steps.mean()), -360.0 / 1024, rtol=0.02)
    # Column 0 of a beam without azimuth offset points to -x, the middle column to +x.
    straight = np.argmin(np.abs(sensor.azimuth_deg))
    assert abs(azimuth[straight, sensor.width // 2]) < np.deg2rad(abs(sensor.azimuth_deg[straight]) + 0.2)
    rolled = np.stack([np.roll(row, shift) for row, shift in zip(azimuth, sensor.pixel_shift, strict=True)])
    apart = np.angle(np.exp(1j * (rolled - rolled[0])))
    staggered = np.angle(np.exp(1j * (azimuth - azimuth[0])))
    expected = -np.deg2rad(sensor.azimuth_deg - sensor.azimuth_deg[0])
    np.testing.assert_allclose(staggered, np.broadcast_to(expected[:, None], staggered.shape), atol=2e-3)
    assert np.ptp(apart, axis=0).max() < np.deg2rad(1.1 * 360.0 / 1024)


def test_simulated_ranges_scatter_by_the_sigma_of_their_return(sensor: SensorMetadata) -> None:
    half_m = (30.0, 10.0, 8.0)
    scene, settings = room(half_m, 0.2), Sensor(dropouts=False, false_positives=False)
    results = [scan(scene, sensor, settings, still(sensor), 7, "before", number) for number in range(6)]
    error = np.stack([result.range_mm / 1000.0 - result.true_range_m for result in results])
    reach, cosine = reach_in_room(sensor, half_m)
    range_m = (reach + sensor.beam_origin_m).astype(np.float32)
    light = received_photons((0.2 * cosine).astype(np.float32), range_m)
    sigma = range_sigma_m(range_m, light, cosine.astype(np.float32))
    score = error / np.hypot(sigma, 1e-3 / np.sqrt(12.0))  # whole millimetres
    edges = np.quantile(sigma, [0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
    assert edges[-1] > 3 * edges[0]
    for low, high in pairwise(edges):
        part = score[:, (sigma >= low) & (sigma <= high)].ravel()
        assert abs(part.mean()) < 5 / np.sqrt(len(part))
        assert part.std() == pytest.approx(1.0, abs=5 / np.sqrt(2 * len(part)))


def test_dropouts_follow_the_detection_probability(sensor: SensorMetadata) -> None:
    half_m = (44.0, 44.0, 20.0)
    scene, settings = room(half_m, 0.1), Sensor(range_noise=False, false_positives=False)
    seen = np.mean([scan(scene, sensor, settings, still(sensor), 1, "after", n).range_mm > 0 for n in range(6)], axis=0)
    reach, cosine = reach_in_room(sensor, half_m)
    range_m = (reach + sensor.beam_origin_m).astype(np.float32)
    expected = detection_probability(received_photons((0.1 * cosine).astype(np.float32), range_m))
    assert abs(seen.mean() - expected.mean()) < 0.005
    for low, high in ((0.1, 0.4), (0.4, 0.7), (0.7, 0.95)):
        band = (expected > low) & (expected < high)
        assert band.sum() > 100
        assert abs(seen[band].mean() - expected[band].mean()) < 5 * 0.5 / np.sqrt(6 * band.sum())


def test_range_limits(sensor: SensorMetadata) -> None:
    limits = IDEAL.model_copy(update={"min_range_m": 3.0, "max_range_m": 5.0})
    result = scan(room((6.0, 2.5, 2.0), 0.5), sensor, limits, still(sensor), 0, "before", 0)
    is_kept = (result.true_range_m >= 3.0) & (result.true_range_m <= 5.0)
    assert 0.1 < is_kept.mean() < 0.9
    np.testing.assert_array_equal(result.range_mm > 0, is_kept)
    np.testing.assert_array_equal(result.geom >= 0, is_kept)
    np.testing.assert_array_equal(result.reflectivity > 0, is_kept)
    np.testing.assert_array_equal(result.signal > 0, is_kept)


def test_steps_of_8_mm_are_the_millimetres_without_their_last_three_bits(sensor: SensorMetadata) -> None:
    scene, noisy = room((6.0, 2.5, 2.0), 0.5), Sensor()
    fine, coarse = (
        scan(scene, sensor, noisy.model_copy(update={"range_step_mm": step}), still(sensor), 2, "before", 1)
        for step in (1, 8)
    )
    np.testing.assert_array_equal(coarse.range_mm, fine.range_mm & ~np.uint32(7))
    assert len(np.unique(fine.range_mm % 8)) == 8
    np.testing.assert_array_equal(coarse.signal, fine.signal)


def test_false_returns_take_one_pixel_in_ten_thousand_and_nothing_else_changes(sensor: SensorMetadata) -> None:
    scene = room((6.0, 3.0, 2.0), 0.5)
    n_false = 0
    for number in range(40):
        clean, dirty = (
            scan(scene, sensor, settings, still(sensor), 5, "before", number)
            for settings in (Sensor(false_positives=False), Sensor())
        )
        is_false = dirty.geom == FALSE_RETURN
        n_false += int(is_false.sum())
        for before, after in zip(channels(clean), channels(dirty), strict=True):
            np.testing.assert_array_equal(before[~is_false], after[~is_false])
        np.testing.assert_array_equal(dirty.range_mm[is_false] >= 300, True)
        np.testing.assert_array_equal(dirty.signal[is_false], np.rint(optics.FALSE_PHOTONS))
        assert (clean.geom != FALSE_RETURN).all()
    expected = 40 * sensor.height * sensor.width * optics.FALSE_RETURN_RATE
    assert abs(n_false - expected) < 4 * np.sqrt(expected)


def test_a_false_return_is_labelled_and_is_neither_a_change_nor_a_ghost_ray(
    make_scenario: Callable[..., Scenario],
    make_prop: Callable[..., Prop],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scenario = make_scenario(props=(make_prop("box", change="added"),))
    simulate_pair(scenario, 5, tmp_path / "usual")
    monkeypatch.setattr(optics, "FALSE_RETURN_RATE", 1.0)
    simulate_pair(scenario, 5, tmp_path / "blind")
    (usual,), (blind,) = (read_pair_truth(tmp_path / name).changes for name in ("usual", "blind"))
    assert usual.n_returns > 50
    assert usual.n_ghost_rays > 50
    assert (blind.n_returns, blind.n_cells, blind.n_ghost_rays) == (0, 0, 0)
    for name in ("before", "after"):
        for instance, change in read_labels(tmp_path / "blind" / name, 1):
            assert (instance == FALSE_RETURN).all()
            assert (change == 0).all()
        for instance, _ in read_labels(tmp_path / "usual" / name, 1):
            range_mm = next(read_session(tmp_path / "usual" / name).chunks()).range_mm
            np.testing.assert_array_equal(instance != -1, range_mm > 0)


def test_a_scan_that_does_not_roll_has_one_pose_and_still_a_stamp_for_each_column(
    make_scenario: Callable[..., Scenario],
) -> None:
    scenario = make_scenario()
    sensor = load_profile("os1-32-nominal", "512x10")
    world = build_world(scenario, 4)
    still_settings = scenario.model_copy(update={"sensor": Sensor(mode="512x10", rolling_scan=False)})
    rolls, stands = (plan_trajectory(world, each, sensor, 4, "before") for each in (scenario, still_settings))
    every = slice(0, rolls.n_scans)
    middle = rolls.world_T_column(every)[:, sensor.width // 2]
    np.testing.assert_array_equal(stands.world_T_column(every), np.repeat(middle[:, None], sensor.width, axis=1))
    np.testing.assert_array_equal(stands.odom_T_sensor, rolls.odom_T_sensor)
    identity: Float32Array = np.array([0, 0, 0, 0, 0, 0, 1], np.float32)
    np.testing.assert_allclose(stands.sensor_T_column(every) - identity, 0.0, atol=1e-9)
    assert np.abs(rolls.sensor_T_column(every)[:, 0, :3]).max() > 0.03  # half a revolution at 1 m/s
    stamps: Int64Array = stands.column_stamps_ns(every)
    np.testing.assert_array_equal(stamps, rolls.column_stamps_ns(every))
    np.testing.assert_allclose(np.diff(stamps, axis=1), 1e9 / 10 / 512, atol=1.0)


SWITCHES = ("range_noise", "dropouts", "false_positives")


@pytest.mark.parametrize("turned", SWITCHES)
def test_a_switch_leaves_what_the_others_draw_as_it_is(sensor: SensorMetadata, turned: str) -> None:
    scene = room((30.0, 20.0, 10.0), 0.1)  # far and dark: one return in nine is dropped
    others = [name for name in SWITCHES if name != turned]
    for states in product((False, True), repeat=2):
        settings = Sensor().model_copy(update=dict(zip(others, states, strict=True)))
        off, on = (
            scan(scene, sensor, settings.model_copy(update={turned: state}), still(sensor), 9, "before", 2)
            for state in (False, True)
        )
        is_true = (off.geom != FALSE_RETURN) & (on.geom != FALSE_RETURN)
        both = is_true & (off.geom >= 0) & (on.geom >= 0)
        assert both.mean() > 0.7
        if turned == "range_noise":
            assert (off.range_mm[both] != on.range_mm[both]).mean() > 0.5
        else:
            np.testing.assert_array_equal(off.range_mm[both], on.range_mm[both])
        if turned == "dropouts":
            assert 0.05 < (is_true & (off.geom >= 0) & (on.geom == MISS)).mean() < 0.3
        else:
            np.testing.assert_array_equal(off.geom[is_true], on.geom[is_true])
        if turned == "false_positives":
            assert not (off.geom == FALSE_RETURN).any() and (on.geom == FALSE_RETURN).any()
        else:
            is_false = on.geom == FALSE_RETURN
            np.testing.assert_array_equal(off.geom == FALSE_RETURN, is_false)
            np.testing.assert_array_equal(off.range_mm[is_false], on.range_mm[is_false])


def test_each_effect_draws_from_a_stream_of_its_own(sensor: SensorMetadata, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, tuple[str, ...]]] = []

    def listening(seed: int, *purpose: str) -> np.random.Generator:
        asked.append((seed, purpose))
        return stream(seed, *purpose)

    monkeypatch.setattr(lidar, "stream", listening)
    named = {}
    for name in SWITCHES:
        asked.clear()
        settings = IDEAL.model_copy(update={name: True})
        for case in ((3, "before", 0), (3, "after", 0), (3, "before", 1), (4, "before", 0)):
            scan(room((4.0, 4.0, 4.0), 0.5), sensor, settings, still(sensor), *case)
        named[name] = list(asked)
        assert len(set(asked)) == 4
    asked.clear()
    scan(room((4.0, 4.0, 4.0), 0.5), sensor, Sensor(), still(sensor), 3, "before", 0)
    assert asked == [named[name][0] for name in SWITCHES]
    assert len(set(asked)) == 3


def test_a_pixel_is_mixed_when_no_owner_sent_nine_tenths_of_its_light(
    sensor: SensorMetadata, monkeypatch: pytest.MonkeyPatch
) -> None:
    # So much noise and so many dropouts that mixed pixels are told apart without either.
    monkeypatch.setattr(lidar, "range_sigma_m", lambda *_: np.float32(0.08))
    monkeypatch.setattr(lidar, "detection_probability", lambda _: np.float32(0.7))
    echoes: list[Echo] = []

    def listening(*given: Any) -> Echo:
        echoes.append(spread_echo(*given))
        return echoes[-1]

    monkeypatch.setattr(lidar, "spread_echo", listening)
    behind = box_mesh((6.0, 6.0, 6.0))
    # A leaning post in front of the wall at +x, whose echoes blend.
    lean = Rotation.from_euler("x", 20, degrees=True).as_matrix()
    post = move_mesh(box_mesh((0.05, 1.0, 1.5)), make_pose(lean, (5.4, 0.0, 0.0)))
    meshes = (Mesh(behind.vertices, behind.faces[:, ::-1]), post)
    shares: Float32Array = np.full(2, 0.5, np.float32)
    scene = Scene(meshes, Caster(meshes), np.array([0, 1], np.int32), shares, ("wall", "post"), ("rock", "wood"))
    one = scan(scene, sensor, IDEAL, still(sensor), 0, "before", 0)
    assert not one.is_mixed.any() and echoes == []
    np.testing.assert_array_equal(one.owner, one.geom)
    clean, noisy, unowned = (
        scan(scene, sensor, settings.model_copy(update={"sub_rays": 7}), still(sensor), 0, "before", 0, owners)
        for settings, owners in ((IDEAL, None), (Sensor(), None), (IDEAL, np.zeros(2, np.int32)))
    )
    share, owner = echoes[0].owner_share.T, echoes[0].owner.T
    assert ((share > 0.5) & (share < 0.9)).sum() > 5 < ((share > 0.9) & (share < 1.0)).sum()
    np.testing.assert_array_equal(clean.is_mixed, share < 0.9)
    np.testing.assert_array_equal(clean.owner, owner)
    assert {0, 1} == set(clean.owner[clean.is_mixed].tolist())
    kept = noisy.geom >= 0
    assert 0.6 < kept.mean() < 0.8
    np.testing.assert_array_equal(noisy.is_mixed[kept], clean.is_mixed[kept])  # noise and dropouts do not make one
    np.testing.assert_array_equal(noisy.owner[kept], clean.owner[kept])
    assert not noisy.is_mixed[~kept].any() and not noisy.owner[~kept].any()
    # where nobody owns either, the same returns are of one owner
    assert not unowned.is_mixed.any() and not unowned.owner.any()
    np.testing.assert_array_equal(unowned.range_mm, clean.range_mm)


@pytest.mark.parametrize(("share", "is_mixed"), [(0.6, True), (0.899, True), (0.9, False), (0.95, False)])
def test_sixty_to_forty_is_mixed_and_ninety_five_to_five_is_not(
    share: float, is_mixed: bool, sensor: SensorMetadata, monkeypatch: pytest.MonkeyPatch
) -> None:
    def divided(*given: Any) -> Echo:
        echo = spread_echo(*given)
        return replace(echo, owner_share=np.full_like(echo.owner_share, share))

    monkeypatch.setattr(lidar, "spread_echo", divided)
    result = scan(room((4.0, 4.0, 4.0), 0.5), sensor, Sensor(sub_rays=7), still(sensor), 0, "before", 0)
    np.testing.assert_array_equal(result.is_mixed, (result.geom >= 0) & is_mixed)


@pytest.mark.parametrize("settings", [Sensor(), EVERYTHING], ids=["default", "everything"])
def test_another_prop_changes_only_the_beams_that_meet_it(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], sensor: SensorMetadata, settings: Sensor
) -> None:
    world = build_world(make_scenario(props=(make_prop("box", change="added"),)), 5)
    rays = still(sensor, (6.0, 0.0, 0.8))
    without, with_box = (scan(scene, sensor, settings, rays, 5, "after", 3) for scene in (world.before, world.after))
    differs = np.any([a != b for a, b in zip(channels(without), channels(with_box), strict=True)], axis=0)
    assert (world.after.instance[with_box.geom[differs]] == 1).sum() > 200
    # Every other beam passes the ball round the box at more than the beam's width.
    corners = np.concatenate([m.vertices for m, i in zip(world.after.meshes, world.after.instance, strict=True) if i])
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius_m = np.linalg.norm(corners - centre, axis=1).max()
    towards = centre - rays.origins[:, None]
    along = (towards * rays.directions).sum(axis=-1)
    passes_m = np.linalg.norm(towards - along[..., None] * rays.directions, axis=-1)
    assert passes_m.T[differs].max() < radius_m + 0.05
    same_ray = without.true_range_m == with_box.true_range_m
    if settings.sub_rays == 1:
        assert not differs[same_ray].any()


def test_revolutions_and_sessions_have_their_own_noise(
    sensor: SensorMetadata,
) -> None:
    scene = room((4.0, 4.0, 4.0), 0.5)
    rays = still(sensor)
    cases = [(7, "before", 0), (7, "before", 1), (7, "after", 0), (8, "before", 0)]
    noise = [scan(scene, sensor, Sensor(dropouts=False, false_positives=False), rays, *case) for case in cases]
    errors = np.stack([(each.range_mm / 1000.0 - each.true_range_m).ravel() for each in noise])
    between = np.corrcoef(errors)[np.triu_indices(4, 1)]
    assert np.abs(between).max() < 5 / np.sqrt(errors.shape[1])


def test_another_reflectivity_changes_only_the_beams_that_meet_the_prop(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], sensor: SensorMetadata
) -> None:
    other = make_prop("other", 0.6, -0.9, kind="barrel", size_m=(0.6, 0.6, 0.9))
    rays = still(sensor, (6.0, 0.0, 0.8))
    dark, bright, gone = (
        build_world(make_scenario(props=props), 5).before
        for props in (
            (make_prop("box", reflectivity=0.05), other),
            (make_prop("box", reflectivity=0.9), other),
            (other,),
        )
    )
    first, second, third = (scan(scene, sensor, Sensor(), rays, 5, "before", 3) for scene in (dark, bright, gone))
    meets = (dark.instance[first.geom] == 1) | (bright.instance[second.geom] == 1)
    assert meets.sum() > 200
    np.testing.assert_array_equal(first.range_mm[~meets], second.range_mm[~meets])
    np.testing.assert_array_equal(first.reflectivity[~meets], second.reflectivity[~meets])
    # Taken away, it changes no beam that went by it: what is behind has the noise it had.
    same_ray = ~meets & (first.true_range_m == third.true_range_m)
    assert same_ray[~meets].mean() > 0.99
    np.testing.assert_array_equal(first.range_mm[same_ray], third.range_mm[same_ray])
