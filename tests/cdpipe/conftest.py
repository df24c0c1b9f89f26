"""A small tunnel made of points, scanned twice: no simulator, every number known."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, invert, make_pose, stream, transform, yaw_pose
from cdpipe.mapping.mapping import build_map
from cdpipe.model.config import MapConfig
from cdpipe.model.types import DescriptorSet, MappedSession, PosedScan, ScanSource

LENGTH_M = 60.0
HALF_WIDTHS_M, HEIGHT_M = (2.5, 3.5), 3.5  # by world
# centre and size of what stands on the floor: one box is added, one is moved
ADDED_BOX = ((20.0, 0.0, 0.5), (1.2, 0.9, 1.0))
MOVED_FROM = ((12.0, 0.8, 0.35), (0.7, 0.7, 0.7))
MOVED_TO = ((46.0, -0.9, 0.35), (0.7, 0.7, 0.7))
AFTER_ODOM_T_WORLD = yaw_pose(0.7, (30.0, -12.0, 1.0))
AFTER_MOUNT_RAD = 1.9  # the after session's sensor sits turned on its robot


class CloudScans:
    """A scan source whose scans are given."""

    def __init__(self, name: str, odom_T_sensor: Float64Array, clouds_sensor: list[Float64Array]) -> None:
        self.name = name
        self.odom_T_sensor = odom_T_sensor
        self._clouds = clouds_sensor

    def scan(self, index: int) -> PosedScan:
        cloud = self._clouds[index]
        rows = np.arange(len(cloud))
        return PosedScan(index, cloud, self.odom_T_sensor[index], rows.astype(np.int64), rows.astype(np.int32))

    def scans(self) -> Iterator[PosedScan]:
        return (self.scan(index) for index in range(len(self._clouds)))


def bend(along_m: Float64Array, world: int) -> Float64Array:
    """Sideways position of the tunnel's axis."""
    if world == 0:
        return 5.0 * np.sin(along_m / 14.0)
    return 3.0 * np.cos(along_m / 7.0) - 0.1 * along_m


def tunnel_points(world: int, sample: int) -> Float64Array:
    """Points all over a rough, bent tunnel; worlds differ in shape, samples in where the points fall."""
    rng = stream(sample, "tunnel points", str(world))
    n, half_width = 150_000, HALF_WIDTHS_M[world]
    along = rng.uniform(0, LENGTH_M, n)
    perimeter = rng.uniform(0, 2 * (2 * half_width + HEIGHT_M), n)
    phases = stream(world, "roughness").uniform(0, 2 * np.pi, (6, 2))
    rough = sum(
        0.07 * np.sin(0.9 * (k + 1) * along + a) * np.sin(0.7 * (k + 1) * perimeter + b)
        for k, (a, b) in enumerate(phases)
    )
    width = 2 * half_width
    corners = np.array([0, width, width + HEIGHT_M, 2 * width + HEIGHT_M, 2 * (width + HEIGHT_M)])
    across = np.interp(perimeter, corners, [-half_width, half_width, half_width, -half_width, -half_width])
    up = np.interp(perimeter, corners, [0, 0, HEIGHT_M, HEIGHT_M, 0])
    swell = 1 + rough / half_width
    across, up = across * swell, HEIGHT_M / 2 + (up - HEIGHT_M / 2) * swell
    return np.column_stack([along, bend(along, world) + across, up])


def box_points(
    box: tuple[tuple[float, float, float], tuple[float, float, float]], world: int, sample: int
) -> Float64Array:
    """Points on the sides and the top of a box, given by its offset from the tunnel's axis."""
    (along, across, up), size = box
    rng = stream(sample, "box", str(box))
    points = rng.uniform(-0.5, 0.5, (1500, 3))
    side = rng.integers(0, 3, 1500)
    points[np.arange(1500), side] = np.where(rng.random(1500) < 0.5, -0.5, 0.5)
    points[side == 2, 2] = 0.5
    return points * size + (along, bend(np.array(along), world) + across, up)


def scanned(
    name: str, odom_T_world: Float64Array, world: int, sample: int, boxes: list, mount_rad: float = 0.0
) -> CloudScans:
    """Scan a tunnel every half metre along its axis; each scan sees 6000 of the points within 12 m."""
    points = np.concatenate([tunnel_points(world, sample), *(box_points(box, world, sample) for box in boxes)])
    rng = stream(sample, "scans", str(world))
    poses, clouds = [], []
    for along in np.arange(4.0, LENGTH_M - 4.0, 0.5):
        heading = np.arctan2(bend(np.array(along + 0.1), world) - bend(np.array(along - 0.1), world), 0.2)
        world_T_sensor = yaw_pose(heading + mount_rad, (along, bend(np.array(along), world), 1.5))
        near = np.flatnonzero(np.abs(points[:, 0] - along) < 12.0)  # the others are farther still
        near = near[np.linalg.norm(points[near] - world_T_sensor[:3, 3], axis=1) < 12.0]
        seen = points[rng.choice(near, 6000, replace=False)]
        seen = seen + rng.normal(0, 0.005, seen.shape)
        clouds.append(transform(invert(world_T_sensor), seen))
        poses.append(odom_T_world @ world_T_sensor)
    return CloudScans(name, np.array(poses), clouds)


def described(source: ScanSource, odom_T_world: Float64Array, keyframe_scans: np.ndarray) -> DescriptorSet:
    """Descriptors that know the place along the tunnel (q) and the heading in the world (w)."""
    world_T_sensor = invert(odom_T_world) @ source.odom_T_sensor[keyframe_scans]
    along = world_T_sensor[:, 0, 3]
    q = np.exp(-0.5 * ((along[:, None] - np.linspace(0, LENGTH_M, 64)) / 2.0) ** 2)
    heading = np.arctan2(world_T_sensor[:, 1, 0], world_T_sensor[:, 0, 0])
    w = np.exp(2.0 * np.cos(np.arange(64) * 2 * np.pi / 64 + heading[:, None]))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    return DescriptorSet(q.astype(np.float32), w.astype(np.float32), keyframe_scans, "place", "")


def mapped(source: ScanSource, odom_T_world: Float64Array) -> MappedSession:
    point_map = build_map(source, MapConfig())
    return MappedSession(point_map, described(source, odom_T_world, point_map.keyframe_scans))


@pytest.fixture(scope="session")
def tunnel_before() -> MappedSession:
    """The before session, its odom frame being the world."""
    return mapped(scanned("before", make_pose(), 0, 1, [MOVED_FROM]), make_pose())


@pytest.fixture(scope="session")
def tunnel_after() -> MappedSession:
    """The after session of the same tunnel: one box added, one moved."""
    source = scanned("after", AFTER_ODOM_T_WORLD, 0, 2, [ADDED_BOX, MOVED_TO], AFTER_MOUNT_RAD)
    return mapped(source, AFTER_ODOM_T_WORLD)


@pytest.fixture(scope="session")
def other_tunnel() -> MappedSession:
    """A session of another tunnel whose descriptors pretend to know the first."""
    return mapped(scanned("elsewhere", AFTER_ODOM_T_WORLD, 1, 3, []), AFTER_ODOM_T_WORLD)


@pytest.fixture(scope="session")
def true_before_T_after() -> Float64Array:
    """The pose that the merge of `tunnel_before` and `tunnel_after` should find."""
    return invert(AFTER_ODOM_T_WORLD)


@pytest.fixture(scope="session")
def box_centres_map() -> dict[str, Float64Array]:
    """Centres of the boxes in the before session's odom frame."""
    boxes = {"added": ADDED_BOX, "moved_from": MOVED_FROM, "moved_to": MOVED_TO}
    return {
        name: np.array([along, bend(np.array(along), 0) + across, up])
        for name, ((along, across, up), _) in boxes.items()
    }


def _bent(session: MappedSession, total_rad: float) -> tuple[MappedSession, Float64Array]:
    """Let a session's odometry turn steadily, and return what takes each keyframe's surroundings back (K, 4, 4).

    Every map point goes with the keyframe nearest to it, as it would in a map that such an odometry had built.
    """
    path = session.map.odom_T_keyframe
    bends = [np.eye(4)]
    for pose in path[1:]:
        about = make_pose(translation=pose[:3, 3])
        bends.append(bends[-1] @ about @ yaw_pose(total_rad / (len(path) - 1)) @ invert(about))
    stack = np.array(bends)
    nearest_point = cKDTree(path[:, :3, 3]).query(session.map.points)[1]
    nearest_scan = cKDTree(path[:, :3, 3]).query(session.map.odom_T_sensor[:, :3, 3])[1]
    chosen = stack[nearest_point]
    points = np.einsum("nij,nj->ni", chosen[:, :3, :3], session.map.points) + chosen[:, :3, 3]
    point_map = replace(
        session.map, points=points, odom_T_sensor=stack[nearest_scan] @ session.map.odom_T_sensor, seen_from=None
    )
    return MappedSession(point_map, session.descriptors), invert(stack)


@pytest.fixture(scope="session")
def bent() -> Callable[[MappedSession, float], tuple[MappedSession, Float64Array]]:
    """How to bend a session: see `_bent`."""
    return _bent


def _looking_ahead(sample: int, scale: float) -> MappedSession:
    """Map the tunnel with a sensor that sees only what is ahead and an odometry that scales the way."""
    whole = scanned("ahead", make_pose(), 0, sample, [])
    poses = whole.odom_T_sensor.copy()
    poses[:, :3, 3] *= scale
    clouds = [scan.points_sensor[scan.points_sensor[:, 0] > 0] for scan in whole.scans()]
    return mapped(CloudScans("ahead", poses, clouds), make_pose())


@pytest.fixture(scope="session")
def looking_ahead() -> Callable[[int, float], MappedSession]:
    """How to map the tunnel with a biased view: see `_looking_ahead`."""
    return _looking_ahead
