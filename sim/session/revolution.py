"""One revolution of a session: the sensor's channels, the prop behind each return, and the rays that meet a ghost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array
from cdpipe.sensor.ouster import SensorMetadata
from scenarios.schema import Scenario
from sim.drive.trajectory import Trajectory
from sim.scene import Scene
from sim.sensor.lidar import Scan, scan
from sim.sensor.rays import Rays, revolution_rays
from sim.session.labels import Tally, mark_belonging
from sim.session.truth import MIXED, Int16Array, SessionName


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """Returns of one revolution on a changed prop; in the session that holds the change without mixed ones.

    Attributes:
        row, column: (N,) pixels.
        points_odom: (N, 3) places as the session measured them.
        belongs: (N,) which of them belong to the change; all True in the session that does not hold it.
    """

    row: Int64Array
    column: Int64Array
    points_odom: Float64Array
    belongs: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class Revolution:
    """One simulated revolution as it is written, and its contribution to each change.

    Attributes:
        range_mm, reflectivity, signal: (H, W) as in `ScanChunk`.
        instance: (H, W) int16 truth labels.
        mixed: (N,) flat numbers of the pixels that blend a changed prop with something else.
        column_poses: (W, 7) as in `ScanChunk`.
        hits: Returns on changed props, by change id.
        ghost_rays: Number of rays that met each ghost, by change id.
    """

    range_mm: npt.NDArray[np.uint32]
    reflectivity: npt.NDArray[np.uint8]
    signal: npt.NDArray[np.uint16]
    instance: Int16Array
    mixed: Int64Array
    column_poses: Float32Array
    hits: dict[int, Hits]
    ghost_rays: dict[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """Everything that stays the same while one session is simulated.

    Attributes:
        labels: `instance` of each geom, int16; two entries -2 and -1 at the end serve the geom numbers -2 and -1.
        owners: (G,) int32 `instance` of the geoms of props of which this session holds a change, 0 for all others.
    """

    name: SessionName
    scenario: Scenario
    scene: Scene
    labels: Int16Array
    owners: Int32Array
    sensor: SensorMetadata
    trajectory: Trajectory
    tallies: tuple[Tally, ...]
    seed: int


def simulate_revolution(drive: Drive, number: int) -> Revolution:
    """Simulate one revolution. The result depends on its number alone, so revolutions may run in any thread."""
    rays, result = cast_revolution(drive, number)
    reach_m = true_reach_m(drive.sensor, result)
    instance = drive.labels.take(result.geom, mode="wrap")
    hits, ghost_rays = {}, {}
    for tally in drive.tallies:
        change = tally.change
        if change.session != drive.name:
            ghost_rays[change.id] = tally.ghost.count(rays, reach_m.T)
        is_own = change.session == drive.name
        is_on_it = (result.owner == change.instance) & ~result.is_mixed if is_own else instance == change.instance
        row, column = np.divmod(np.flatnonzero(is_on_it), drive.sensor.width)
        if len(row):
            points_world = rays.points(row, column, reach_m[row, column])
            belongs = mark_belonging(tally, points_world) if is_own else np.ones(len(row), dtype=bool)
            hits[change.id] = Hits(row, column, _measure(drive, number, result, row, column), belongs)
    column_poses = drive.trajectory.sensor_T_column(slice(number, number + 1))[0]
    channels = result.range_mm, result.reflectivity, result.signal
    return Revolution(*channels, instance, np.flatnonzero(result.is_mixed), column_poses, hits, ghost_rays)


def cast_revolution(drive: Drive, number: int) -> tuple[Rays, Scan]:
    """Return the rays of one revolution and the scan that the sensor reports."""
    world_T_column = drive.trajectory.world_T_column(slice(number, number + 1))[0]
    rays = revolution_rays(drive.sensor, world_T_column)
    settings = drive.scenario.sensor
    return rays, scan(drive.scene, drive.sensor, settings, rays, drive.seed, drive.name, number, drive.owners)


def true_reach_m(sensor: SensorMetadata, result: Scan) -> Float32Array:
    """Return the length (H, W) float32 of each ray from its origin to its hit, metres, 0 without a true return."""
    return np.where(result.geom >= 0, result.true_range_m - np.float32(sensor.beam_origin_m), np.float32(0.0))


def label_changes(drive: Drive, revolutions: list[Revolution]) -> Int16Array:
    """Label every return of a chunk (s, H, W) with its change, or `MIXED`, and add to the tallies."""
    labels = np.zeros((len(revolutions), *revolutions[0].instance.shape), dtype=np.int16)
    for of_revolution, each in zip(labels, revolutions, strict=True):
        of_revolution.flat[each.mixed] = MIXED
    for tally in drive.tallies:
        change_id = tally.change.id
        tally.n_ghost_rays += sum(each.ghost_rays.get(change_id, 0) for each in revolutions)
        for place, each in enumerate(revolutions):
            hits = each.hits.get(change_id)
            if hits is None:
                continue
            if tally.change.session != drive.name:
                tally.other.add(hits.points_odom)
                continue
            tally.own.add(hits.points_odom[hits.belongs])
            labels[place, hits.row[hits.belongs], hits.column[hits.belongs]] = change_id
    return labels


def _measure(drive: Drive, number: int, result: Scan, row: Int64Array, column: Int64Array) -> Float64Array:
    """Return the positions (N, 3) of some returns of a revolution as the session measured them, odom frame."""
    sensor, trajectory = drive.sensor, drive.trajectory
    reach = result.range_mm[row, column][:, None] / 1000.0 - sensor.beam_origin_m
    points_sensor = sensor.origins[row, column] + reach * sensor.directions[row, column]
    poses = trajectory.odom_T_column(number, column)
    return np.asarray(np.einsum("nij,nj->ni", poses[:, :3, :3], points_sensor) + poses[:, :3, 3])
