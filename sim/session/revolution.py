"""One revolution of a session: the sensor's channels, the prop behind each return, and the rays that meet a ghost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import Float32Array, Float64Array, Int32Array, Int64Array
from cdpipe.sensor.ouster import SensorMetadata
from scenarios.schema import Air, Scenario
from sim.drive.trajectory import Trajectory
from sim.movers.casting import MovingScene
from sim.movers.trails import raise_dust
from sim.scene import Scene
from sim.sensor.air import AirVolume, air_around
from sim.sensor.glass import Panes
from sim.sensor.lidar import Scan, scan
from sim.sensor.rays import Rays, revolution_rays
from sim.sensor.water import Water
from sim.session.labels import Tally, mark_belonging
from sim.session.surface import MovedRock
from sim.session.truth import MIXED, Int16Array, SessionName, SurfaceChangeTruth

# The arrays of a revolution, in the order of its attributes.
CHANNELS = {
    "range_mm": np.uint32,
    "reflectivity": np.uint8,
    "signal": np.uint16,
    "instance": np.int16,
    "change": np.int16,
}
# Where rock changes, these as well.
SURFACE_CHANNELS = {"displacement": np.float32, "surface_change": np.int16}


@dataclass(frozen=True, slots=True, eq=False)
class Revolution:
    """One simulated revolution with its truth; nothing in it depends on the session's own odometry.

    Attributes:
        range_mm, reflectivity, signal: (R, W) as in `ScanChunk`.
        instance, change: (R, W) int16 as in `sim.session.truth`.
        ghost_rays: Number of rays that met each ghost, by change id.
        sightings: (M, 4) of each mover the number of its returns, and their mean true position, world frame (NaN where
            it has none).
        displacement, surface_change: (R, W) as in `sim.session.truth`; None where no rock changes.
    """

    range_mm: npt.NDArray[np.uint32]
    reflectivity: npt.NDArray[np.uint8]
    signal: npt.NDArray[np.uint16]
    instance: Int16Array
    change: Int16Array
    ghost_rays: dict[int, int]
    sightings: Float64Array
    displacement: Float32Array | None = None
    surface_change: Int16Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """Everything that stays the same while one session is simulated.

    Attributes:
        name: Its part in the pair.
        labels: `instance` of each geom, int16; entries -5 to -1 at the end serve the geom numbers -5 to -1.
        owners: (G,) int32 `instance` of the geoms of props of which this session holds a change, 0 for all others.
        moving: The scene with the session's movers, whose geoms come last in `labels` and `owners`.
        sightings: (M, S, 4) what each revolution saw of each mover so far, as in `Revolution`.
        water: The session's puddles; None without any.
        panes: The session's panes of glass; None where glass is a wall.
        rock: The session's walls where rock changes; None where it does not.
        surface_changes: The changes of the pair's walls.
        own_name: The session's own name where it is one of a longer story, whatever its part in the pair.
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
    moving: MovingScene
    sightings: Float64Array
    water: Water | None = None
    panes: Panes | None = None
    rock: MovedRock | None = None
    surface_changes: tuple[SurfaceChangeTruth, ...] = ()
    own_name: str = ""

    @property
    def session(self) -> str:
        """The name under which the session draws its noise and tells its progress."""
        return self.own_name or self.name


def simulate_revolution(drive: Drive, number: int) -> Revolution:
    """Simulate one revolution. The result depends on its number alone, so revolutions may run in any thread."""
    rays, result = cast_revolution(drive, number)
    reach_m = true_reach_m(drive.sensor, result)
    change = np.where(result.is_mixed, np.int16(MIXED), np.int16(0))
    height, ghost_rays = drive.sensor.height, {}
    farthest_m = reach_m.reshape(-1, height, reach_m.shape[1]).max(axis=0)  # a beam went on to its last return
    for tally in drive.tallies:
        if tally.change.session != drive.name:
            ghost_rays[tally.change.id] = tally.ghost.count(rays, farthest_m.T)
            continue
        row, column = np.nonzero((result.owner == tally.change.instance) & ~result.is_mixed)
        belongs = mark_belonging(tally, rays.points(row % height, column, reach_m[row, column]))
        change[row[belongs], column[belongs]] = tally.change.id
    instance = drive.labels.take(result.geom, mode="wrap")
    sightings = see_movers(drive, rays, instance, reach_m)
    told = result.range_mm, result.reflectivity, result.signal, instance, change, ghost_rays, sightings
    return Revolution(*told) if drive.rock is None else Revolution(*told, *drive.rock.mark(rays, result, reach_m))


def see_movers(drive: Drive, rays: Rays, instance: Int16Array, reach_m: Float32Array) -> Float64Array:
    """Return what a revolution saw of each mover, (M, 4) as in `Revolution`, from instance and reach (R, W)."""
    sightings = np.full((len(drive.moving.movers), 4), np.nan)
    for number, mover in enumerate(drive.moving.movers):
        row, column = np.nonzero(instance == mover.instance)
        sightings[number, 0] = len(row)
        if len(row):
            places = rays.points(row % drive.sensor.height, column, reach_m[row, column])
            sightings[number, 1:] = places.mean(axis=0)
    return sightings


def cast_revolution(drive: Drive, number: int) -> tuple[Rays, Scan]:
    """Return the rays of one revolution and the scan that the sensor reports."""
    world_T_column = drive.trajectory.world_T_column(slice(number, number + 1))[0]
    rays = revolution_rays(drive.sensor, world_T_column)
    settings, air = drive.scenario.sensor, find_air(drive, number)
    surfaces = drive.moving.pose(drive.trajectory.revolution_s[number] + drive.trajectory.column_s)
    told = drive.seed, drive.session, number, drive.owners, air, drive.water, drive.panes
    return rays, scan(surfaces, drive.sensor, settings, rays, *told)


def find_air(drive: Drive, number: int) -> AirVolume | None:
    """Return the mist and dust around the sensor during a revolution; None where the air is clear."""
    plan = drive.scenario.plan(drive.session)
    time_s = drive.trajectory.revolution_s[number : number + 1]
    puffs = raise_dust(drive.moving.movers, float(time_s[0]))
    if plan.air is None and puffs is None:
        return None
    position_m = drive.trajectory.true.sample(time_s)[0][0]
    height_m = plan.height_m or drive.scenario.platform.sensor_height_m
    if plan.trajectory is not None:  # of a recorded drive: what lies below it, if anything does
        met_m = float(drive.scene.caster.cast(position_m[None], (0.0, 0.0, -1.0))[0][0])
        height_m = met_m if np.isfinite(met_m) else height_m
    floor_z_m = position_m[2] - height_m
    told = position_m, float(floor_z_m), float(time_s[0]), drive.seed, drive.session, puffs
    return air_around(plan.air or Air(), *told)


def true_reach_m(sensor: SensorMetadata, result: Scan) -> Float32Array:
    """Return the length (R, W) float32 of each ray from its origin to its hit, metres, 0 without a true return."""
    return np.where(result.geom >= 0, result.true_range_m - np.float32(sensor.beam_origin_m), np.float32(0.0))


def tally_revolution(drive: Drive, number: int, revolution: Revolution) -> None:
    """Add a revolution to the tallies, its returns where the session measured them, and to what was seen of movers."""
    if drive.moving.movers:
        drive.sightings[:, number] = revolution.sightings
    for tally in drive.tallies:
        change = tally.change
        is_own = change.session == drive.name
        tally.n_ghost_rays += revolution.ghost_rays.get(change.id, 0)
        is_on_it = revolution.change == change.id if is_own else revolution.instance == change.instance
        row, column = np.nonzero(is_on_it)
        if len(row):
            returns = tally.own if is_own else tally.other
            returns.add(measured_points(drive, number, revolution.range_mm, row, column))


def measured_points(
    drive: Drive, number: int, range_mm: npt.NDArray[np.uint32], row: Int64Array, column: Int64Array
) -> Float64Array:
    """Return where a session measured some returns of a revolution (R, W): their positions (N, 3), odom frame."""
    sensor, beam = drive.sensor, row % drive.sensor.height
    reach = range_mm[row, column][:, None] / 1000.0 - sensor.beam_origin_m
    points_sensor = sensor.origins[beam, column] + reach * sensor.directions[beam, column]
    poses = drive.trajectory.odom_T_column(number, column)
    return np.asarray(np.einsum("nij,nj->ni", poses[:, :3, :3], points_sensor) + poses[:, :3, 3])
