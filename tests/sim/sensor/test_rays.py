from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, make_pose, transform
from cdpipe.sensor.ouster import SensorMetadata
from sim.sensor.rays import direction_parts, revolution_rays, rotate_directions


def tumbling(width: int) -> Float64Array:
    """A pose per column, far from the origin, turning about every axis on the way."""
    share = np.arange(width) / width
    turns = Rotation.from_euler("zyx", np.stack([2.5 * share, 0.4 * share, -0.3 * share], axis=1)).as_matrix()
    return np.stack([make_pose(r, (390.0 + s, -250.0 - 0.5 * s, 3.0)) for r, s in zip(turns, share, strict=True)])


def test_every_ray_is_the_beam_carried_along_by_its_column(sensor: SensorMetadata) -> None:
    world_T_column = tumbling(sensor.width)
    rays = revolution_rays(sensor, world_T_column)
    assert rays.directions.dtype == np.float32
    assert rays.directions.flags.c_contiguous
    for column in range(0, sensor.width, 37):
        for row in (0, 13, sensor.height - 1):
            pose = world_T_column[column]
            np.testing.assert_allclose(
                rays.origins[column], transform(pose, sensor.origins[row, column]), rtol=0, atol=1e-12
            )
            # A millimetre is the sensor's step: 120 m away the ray must be exact to a small part of it.
            wanted = pose[:3, :3] @ sensor.directions[row, column]
            assert 120.0 * np.abs(rays.directions[column, row] - wanted).max() < 3e-5
    lengths = np.linalg.norm(rays.directions.astype(np.float64), axis=2)
    assert 120.0 * np.abs(lengths - 1.0).max() < 5e-5


def test_all_beams_of_a_column_leave_the_head_at_one_point(sensor: SensorMetadata) -> None:
    np.testing.assert_array_equal(sensor.origins, np.broadcast_to(sensor.origins[:1], sensor.origins.shape))


def test_points_along_some_rays(sensor: SensorMetadata) -> None:
    rays = revolution_rays(sensor, tumbling(sensor.width))
    row, column, reach_m = np.array([0, 5]), np.array([17, 400]), np.array([3.0, 7.5], np.float32)
    points = rays.points(row, column, reach_m)
    for index in range(2):
        wanted = rays.origins[column[index]] + float(reach_m[index]) * rays.directions[column[index], row[index]]
        np.testing.assert_allclose(points[index], wanted, atol=1e-9)


def test_turned_by_columns_of_the_matrices(sensor: SensorMetadata) -> None:
    generator = np.random.default_rng(0)
    rotations = Rotation.random(6, random_state=1).as_matrix()
    vectors = generator.normal(size=(6, 4, 3))
    parts = np.ascontiguousarray(vectors.transpose(2, 0, 1), dtype=np.float32)
    np.testing.assert_allclose(rotate_directions(rotations, parts), vectors @ rotations.transpose(0, 2, 1), atol=2e-6)
    assert direction_parts(sensor).shape == (3, sensor.width, sensor.height)
    assert direction_parts(sensor) is direction_parts(sensor)
