"""Rooms that plots of the sensor look at, and revolutions of a sensor that stands in one."""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry import make_pose
from cdpipe.sensor.ouster import SensorMetadata
from scenarios.schema import Sensor
from sim.geometry.mesh import Mesh, box_mesh
from sim.geometry.raycast import Caster
from sim.scene import Scene
from sim.sensor.air import AirVolume
from sim.sensor.lidar import Scan, scan
from sim.sensor.rays import revolution_rays

SEED = 7
IDEAL = Sensor(range_noise=False, dropouts=False, false_positives=False)
COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7")  # after Okabe and Ito


def still_scan(
    scene: Scene, sensor: SensorMetadata, settings: Sensor, number: int, air: AirVolume | None = None
) -> Scan:
    """Return revolution `number` of a sensor that stands at the origin of a scene."""
    rays = revolution_rays(sensor, np.tile(make_pose(), (sensor.width, 1, 1)))
    return scan(scene, sensor, settings, rays, SEED, "before", number, air=air)


def make_room(half_m: tuple[float, float, float], reflectivity: float = 0.25) -> Scene:
    """Return a box around the origin, seen from inside, by half its length, width and height."""
    mesh = Mesh(box_mesh(half_m).vertices, box_mesh(half_m).faces[:, ::-1])
    share = np.array([reflectivity], np.float32)
    return Scene((mesh,), Caster([mesh]), np.zeros(1, np.int32), share, ("wall",), ("rock",))
