from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.geometry import Float64Array, make_pose, transform
from cdpipe.ouster import SensorMetadata
from scenarios.schema import Prop, Scenario, Sensor
from sim.lidar import detection_probability, range_sigma_m, revolution_rays, scan
from sim.mesh import Mesh, box_mesh, moved
from sim.scene import Scene, build_world, compile_scene

IDEAL = Sensor(range_noise=False, dropouts=False)


def room(make_scenario: Callable[..., Scenario], half_m: tuple[float, float, float], reflectivity: float) -> Scene:
    inside_out = Mesh(box_mesh(half_m).vertices, box_mesh(half_m).faces[:, ::-1])
    scenario = make_scenario()
    tunnel = scenario.tunnel.model_copy(update={"reflectivity": reflectivity})
    return compile_scene(scenario.model_copy(update={"tunnel": tunnel}), inside_out, [], "before")


def test_a_turning_and_moving_sensor_in_a_room_gives_planes_once_deskewed(
    make_scenario: Callable[..., Scenario], sensor: SensorMetadata
) -> None:
    half_m = (5.0, 3.0, 2.0)
    share = np.arange(sensor.width) / sensor.width
    turns = Rotation.from_euler("zyx", np.stack([1.2 * share, 0.1 * share, 0.05 * share], axis=1)).as_matrix()
    world_T_column = np.stack([make_pose(r, (0.8 * s, -0.3 * s, 0.1)) for r, s in zip(turns, share, strict=True)])
    rays = revolution_rays(sensor, world_T_column)
    result = scan(room(make_scenario, half_m, 0.5), sensor, IDEAL, rays, 0, "before", 0)
    assert (result.range_mm > 0).all()
    points = sensor.project(result.range_mm / 1000.0)
    world = np.stack([transform(world_T_column[c], points[:, c]) for c in range(sensor.width)], axis=1)
    off_wall_m = np.abs(np.abs(world) - half_m).min(axis=-1)
    assert off_wall_m.max() < 0.6e-3  # half a range step, and the float32 of the caster
    # Without the columns' own poses the walls are bent.
    skewed = transform(world_T_column[0], points.reshape(-1, 3))
    assert np.abs(np.abs(skewed) - half_m).min(axis=-1).max() > 0.3


def test_reported_range_includes_the_way_from_the_axis(
    make_scenario: Callable[..., Scenario], sensor: SensorMetadata
) -> None:
    rays = revolution_rays(sensor, np.tile(np.eye(4), (sensor.width, 1, 1)))
    result = scan(room(make_scenario, (4.0, 4.0, 4.0), 0.5), sensor, IDEAL, rays, 0, "before", 0)
    # By hand: distance from the beam's origin to the nearest wall of the cube, plus the origin's offset.
    reach = (np.sign(sensor.directions) * 4.0 - sensor.origins) / sensor.directions
    expected = reach.min(axis=-1) + sensor.beam_origin_m
    np.testing.assert_allclose(result.range_mm / 1000.0, expected, atol=0.6e-3)
    np.testing.assert_allclose(result.true_range_m, expected, atol=1e-4)


def test_range_noise_has_the_sigma_of_its_range(make_scenario: Callable[..., Scenario], sensor: SensorMetadata) -> None:
    np.testing.assert_array_equal(
        range_sigma_m(np.array([0.5, 1.0, 10.0, 19.99, 20.0, 49.0, 50.0, 90.0])),
        [0.007, 0.010, 0.010, 0.010, 0.020, 0.020, 0.050, 0.050],
    )
    scene = room(make_scenario, (30.0, 10.0, 8.0), 0.9)
    rays = revolution_rays(sensor, np.tile(np.eye(4), (sensor.width, 1, 1)))
    errors, ranges = [], []
    for number in range(4):
        result = scan(scene, sensor, Sensor(dropouts=False), rays, 7, "before", number)
        errors.append((result.range_mm / 1000.0 - result.true_range_m).ravel())
        ranges.append(result.true_range_m.ravel())
    error, range_m = np.concatenate(errors), np.concatenate(ranges)
    near, far = error[(range_m > 1.5) & (range_m < 19.0)], error[(range_m > 21.0) & (range_m < 49.0)]
    for part, sigma_m in ((near, 0.010), (far, 0.020)):
        assert abs(part.mean()) < 5 * sigma_m / np.sqrt(len(part)) + 1e-5
        assert part.std() == pytest.approx(np.hypot(sigma_m, 1e-3 / np.sqrt(12)), rel=0.03)


def test_revolutions_and_sessions_have_their_own_noise(
    make_scenario: Callable[..., Scenario], sensor: SensorMetadata
) -> None:
    scene = room(make_scenario, (4.0, 4.0, 4.0), 0.5)
    rays = revolution_rays(sensor, np.tile(np.eye(4), (sensor.width, 1, 1)))
    cases = [(7, "before", 0), (7, "before", 1), (7, "after", 0), (8, "before", 0)]
    noise = [scan(scene, sensor, Sensor(dropouts=False), rays, *case) for case in cases]
    errors = np.stack([(each.range_mm / 1000.0 - each.true_range_m).ravel() for each in noise])
    between = np.corrcoef(errors)[np.triu_indices(4, 1)]
    assert np.abs(between).max() < 5 / np.sqrt(errors.shape[1])


def test_detection_meets_both_anchors() -> None:
    ranges_m = np.array([45.0, 55.0])
    np.testing.assert_allclose(detection_probability(np.array([0.1, 0.1]), ranges_m), [0.9, 0.5], rtol=1e-9)
    # Four times the reflectivity carries twice as far; a cosine acts as reflectivity does.
    np.testing.assert_allclose(detection_probability(np.array([0.4, 0.4]), 2 * ranges_m), [0.9, 0.5], rtol=1e-9)
    falling: Float64Array = np.asarray(detection_probability(np.full(100, 0.1), np.linspace(1.0, 120.0, 100)))
    assert (np.diff(falling) <= 0).all()
    assert falling[0] > 0.9999
    assert falling[-1] < 0.01


def test_dropouts_follow_the_detection_probability(
    make_scenario: Callable[..., Scenario], sensor: SensorMetadata
) -> None:
    scene = room(make_scenario, (44.0, 44.0, 20.0), 0.1)
    rays = revolution_rays(sensor, np.tile(np.eye(4), (sensor.width, 1, 1)))
    seen = np.mean([scan(scene, sensor, Sensor(), rays, 1, "after", n).range_mm > 0 for n in range(6)], axis=0)
    ideal = scan(scene, sensor, IDEAL, rays, 1, "after", 0)
    directions = np.abs(sensor.directions)
    reach = (np.sign(sensor.directions) * (44.0, 44.0, 20.0) - sensor.origins) / sensor.directions
    cosine = np.take_along_axis(directions, reach.argmin(axis=-1)[..., None], axis=-1)[..., 0]
    expected = detection_probability(0.1 * cosine, ideal.true_range_m)
    assert abs(seen.mean() - expected.mean()) < 0.005
    for low, high in ((0.1, 0.4), (0.4, 0.7), (0.7, 0.95)):
        band = (expected > low) & (expected < high)
        assert band.sum() > 100
        assert abs(seen[band].mean() - expected[band].mean()) < 5 * 0.5 / np.sqrt(6 * band.sum())


def test_range_limits(make_scenario: Callable[..., Scenario], sensor: SensorMetadata) -> None:
    rays = revolution_rays(sensor, np.tile(np.eye(4), (sensor.width, 1, 1)))
    limits = IDEAL.model_copy(update={"min_range_m": 3.0, "max_range_m": 5.0})
    result = scan(room(make_scenario, (6.0, 2.5, 2.0), 0.5), sensor, limits, rays, 0, "before", 0)
    is_kept = (result.true_range_m >= 3.0) & (result.true_range_m <= 5.0)
    np.testing.assert_array_equal(result.range_mm > 0, is_kept)
    np.testing.assert_array_equal(result.geom >= 0, is_kept)
    np.testing.assert_array_equal(result.reflectivity > 0, is_kept)


def test_another_prop_changes_only_the_beams_that_meet_it(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], sensor: SensorMetadata
) -> None:
    world = build_world(make_scenario(props=(make_prop("box", change="added"),)), 5)
    rays = revolution_rays(sensor, moved_poses(sensor.width, (6.0, 0.0, 0.8)))
    without, with_box = (scan(scene, sensor, Sensor(), rays, 5, "after", 3) for scene in (world.before, world.after))
    misses = world.after.instance[with_box.geom] == 0
    same_ray = misses & (without.true_range_m == with_box.true_range_m)
    assert same_ray[misses].mean() > 0.99  # the rest lie in the box's shadow line or dropped out on it
    np.testing.assert_array_equal(without.range_mm[same_ray], with_box.range_mm[same_ray])
    assert (~misses).sum() > 200


def test_another_reflectivity_changes_only_the_beams_that_meet_the_prop(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], sensor: SensorMetadata
) -> None:
    other = make_prop("other", 0.6, -0.9, kind="barrel", size_m=(0.6, 0.6, 0.9))
    rays = revolution_rays(sensor, moved_poses(sensor.width, (6.0, 0.0, 0.8)))
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


def moved_poses(width: int, place: tuple[float, float, float]) -> Float64Array:
    return np.tile(make_pose(translation=place), (width, 1, 1))


def test_helper_meshes_move() -> None:
    np.testing.assert_allclose(
        moved(box_mesh((1, 1, 1)), make_pose(translation=(1, 2, 3))).vertices.mean(axis=0), [1, 2, 3]
    )
