"""Speed of the simulator in one world: ray casting against rivals, whole sessions against real time."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

import mujoco
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from cdpipe.core.geometry import Float64Array, Int32Array, stream, yaw_pose
from cdpipe.core.progress import report_nothing
from cdpipe.sensor.ouster import SensorMetadata, load_profile
from scenarios.library import load_scenario
from scenarios.schema import Prop, PropKind, Scenario
from sim.drive.trajectory import record
from sim.geometry.backends import find_gpu, make_sensor_caster
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster, model_meshes
from sim.movers.casting import MovingScene
from sim.placement.placing import Standing, floor_heights
from sim.props.props import shape_of
from sim.props.shapes import Size
from sim.scene import compile_model
from sim.sensor.rays import Rays, revolution_rays
from sim.session.planning import plan_drives
from sim.session.revolution import Drive
from sim.session.simulate import write_session
from sim.studies.timing import Contest, SkippedContest, raced, timed

THREADS = 2
# Props of few geoms, three each. A crate has 36, which would slow the rival down nine times more.
_PROP_SIZES_M: dict[PropKind, Size] = {"box": (0.8, 0.6, 0.6), "barrel": (0.58, 0.58, 0.88)}


@dataclass(frozen=True)
class BenchSite:
    """The world of the measurement, built at its first use.

    Attributes:
        scenario: Name of a scenario; its walls should have some 300,000 triangles.
        seed: Seed of the world; no test uses it.
        n_props: Number of props along the path in the crowded model.
        repeats: Repetitions of short work; long work has a fifth of them.
        spread_spacing_m: Distance between the revolutions of the session with sub-rays; it keeps that session short.
    """

    scenario: str = "narrow"
    seed: int = 0
    n_props: int = 500
    repeats: int = 25
    spread_spacing_m: float = 2.0

    @cached_property
    def drawn(self) -> Scenario:
        """The scenario with every distribution drawn, beams without width."""
        return load_scenario(self.scenario, self.seed, ["sensor.sub_rays=1"])

    @cached_property
    def sensor(self) -> SensorMetadata:
        """The scenario's sensor."""
        return load_profile(self.drawn.sensor.profile, self.drawn.sensor.mode)

    @cached_property
    def planned(self) -> tuple[Drive, float]:
        """The first drive, and how many seconds world and drives took."""
        start = time.perf_counter()
        drive = plan_drives(self.drawn, self.seed, self.sensor)[0]
        return drive, time.perf_counter() - start

    @property
    def drive(self) -> Drive:
        """The drive of the before session."""
        return self.planned[0]

    @property
    def wall(self) -> Mesh:
        """The rock of the tunnel."""
        return self.drive.scene.meshes[0]

    @cached_property
    def rays(self) -> Rays:
        """A revolution in the middle of the drive, all of its rays from one point, as `mj_multiRay` wants them."""
        middle = self.drive.trajectory.n_scans // 2
        pose = self.drive.trajectory.world_T_sensor[middle]
        rays = revolution_rays(self.sensor, np.tile(pose, (self.sensor.width, 1, 1)))
        return replace(rays, origins=np.tile(pose[:3, 3], (self.sensor.width, 1)))

    @property
    def few(self) -> int:
        """Repetitions of long work."""
        return max(3, self.repeats // 5)


def sensor_contests(site: BenchSite) -> dict[str, Callable[[], Contest]]:
    """Return the measurements by name, in the order of the table."""
    return {
        "world": lambda: Contest("s", (site.planned[1],)),
        "casting": lambda: against_mujoco(site, 0, 6.0),
        f"casting-{site.n_props}-props": lambda: against_mujoco(site, site.n_props, 20.0),
        "casting-bare": lambda: against_embree(site),
        "casting-two-threads": lambda: two_threads(site),
        "session": lambda: time_session(site, site.drive, 15.0),
        "session-dust-dual": lambda: time_session(site, dusty_drive(site), 1.0),
        "session-19-sub-rays": lambda: time_session(site, spread_drive(site), 3.0),
        "session-19-sub-rays-gpu": lambda: time_gpu_session(site, 10.0),
    }


def against_mujoco(site: BenchSite, n_props: int, target: float) -> Contest:
    """Time the cast of one revolution in one thread against one call of `mj_multiRay` with the same rays."""
    model, data = compile_model([site.wall], crowd(site, n_props))
    caster = Caster(model_meshes(model, data))
    rays = site.rays
    directions = rays.directions.reshape(-1, 3).astype(np.float64)
    ours, theirs = raced(
        partial(caster.cast_columns, rays.origins, rays.directions),
        partial(mujoco_hits, model, data, rays.origins[0], directions),
        site.few if n_props else site.repeats,
        time.thread_time,
    )
    rival = f"mj_multiRay, a call a scan, {len(site.wall.faces) // 1000}k triangles"
    if n_props:
        rival += f", {n_props} props in {model.ngeom - 1} geoms"
    return Contest("Mray/s", ours, len(directions) / 1e6, rival, theirs, target)


def mujoco_hits(
    model: mujoco.MjModel, data: mujoco.MjData, origin: Float64Array, directions: Float64Array
) -> tuple[Float64Array, Int32Array]:
    """Return MuJoCo's distances (N,), -1 for a miss, and geom ids (N,) of rays (N, 3) from one point."""
    count = len(directions)
    ids, ranges_m = np.empty(count, np.int32), np.empty(count)
    mujoco.mj_multiRay(model, data, origin, directions.ravel(), None, True, -1, ids, ranges_m, None, count, 1e3)
    return ranges_m, ids


def against_embree(site: BenchSite) -> Contest:
    """Time the cast of one revolution in one thread against Embree alone, whose arrays are prepared beforehand."""
    rays, scene = site.rays, EmbreeScene()
    meshes = [
        TriangleMesh(scene, (mesh.vertices - rays.origins[0]).astype(np.float32), mesh.faces)
        for mesh in site.drive.scene.meshes
    ]
    directions = rays.directions.reshape(-1, 3)
    ours, theirs = raced(
        partial(site.drive.scene.caster.cast_columns, rays.origins, rays.directions),
        partial(scene.run, np.zeros_like(directions), directions, output=1),
        site.repeats,
        time.thread_time,
    )
    n_triangles = sum(len(mesh.faces) for mesh in site.drive.scene.meshes)
    rival = f"bare embreex, {n_triangles // 1000}k triangles in {len(meshes)} meshes"
    return Contest("Mray/s", ours, len(directions) / 1e6, rival, theirs, 1 / 1.2)


def two_threads(site: BenchSite) -> Contest:
    """Time the cast of 32 revolutions by two threads against one, wall clock."""
    caster, rays = site.drive.scene.caster, site.rays
    n_rays = rays.directions.shape[0] * rays.directions.shape[1]
    jobs = range(32)

    def cast(_: int) -> None:
        caster.cast_columns(rays.origins, rays.directions)

    with ThreadPoolExecutor(1) as one, ThreadPoolExecutor(THREADS) as two:
        ours, theirs = raced(
            lambda: list(two.map(cast, jobs)), lambda: list(one.map(cast, jobs)), site.few, time.perf_counter
        )
    return Contest("Mray/s", ours, len(jobs) * n_rays / 1e6, "one thread", theirs, 1.7)


def crowd(site: BenchSite, n_props: int) -> list[Standing]:
    """Return boxes and barrels on the floor along the path, none near the sensor."""
    generator = stream(site.seed, "bench", "crowd")
    way = site.drive.trajectory.true.points
    middle = site.rays.origins[0]
    points = way[generator.integers(len(way), size=4 * n_props)]
    points[:, :2] += generator.uniform(-1.5, 1.5, size=(len(points), 2))
    floor_m = floor_heights(Caster([site.wall]), points)
    is_free = np.isfinite(floor_m) & (np.linalg.norm(points - middle, axis=1) > 1.5)
    places = np.column_stack([points[:, :2], floor_m])[is_free][:n_props]
    kinds = list(_PROP_SIZES_M)
    props = [
        Prop(name=str(number), kind=kind, size_m=_PROP_SIZES_M[kind])
        for number, kind in enumerate(kinds[index % len(kinds)] for index in range(len(places)))
    ]
    yaws = generator.uniform(0.0, 2 * np.pi, size=len(places))
    return [
        Standing(prop, shape_of(prop, site.seed), frozenset({"before"}), yaw_pose(yaw, place))
        for prop, place, yaw in zip(props, places, yaws, strict=True)
    ]


def spread_drive(site: BenchSite) -> Drive:
    """Return the same drive with 19 sub-rays and fewer revolutions over the whole path."""
    scenario = site.drawn
    spread = scenario.model_copy(
        update={
            "sensor": scenario.sensor.model_copy(update={"sub_rays": 19}),
            "platform": scenario.platform.model_copy(update={"scan_spacing_m": site.spread_spacing_m}),
        }
    )
    drive = site.drive
    trajectory = record(drive.trajectory.true, spread, site.sensor, site.seed, drive.name)
    return replace(drive, scenario=spread, trajectory=trajectory)


def dusty_drive(site: BenchSite) -> Drive:
    """Return the same drive in the dust of `dust/narrow`, with seven sub-rays and two returns a beam."""
    scenario, drive = site.drawn, site.drive
    air = load_scenario("dust/narrow", site.seed).before.air
    dusty = scenario.model_copy(
        update={
            "sensor": scenario.sensor.model_copy(update={"sub_rays": 7, "returns": "dual"}),
            "before": scenario.before.model_copy(update={"air": air}),
        }
    )
    return replace(drive, scenario=dusty)


def time_gpu_session(site: BenchSite, target: float) -> Contest:
    """Time the session with 19 sub-rays whose rays a GPU casts; skipped without one."""
    if not find_gpu():
        return SkippedContest("revolutions/s", (), target=target, reason="no GPU, or no extra `gpu`")
    drive = spread_drive(site)
    caster = make_sensor_caster("warp", drive.scene.meshes, drive.scene.caster)
    return time_session(site, replace(drive, moving=MovingScene(drive.scene, drive.moving.movers, caster)), target)


def time_session(site: BenchSite, drive: Drive, target: float) -> Contest:
    """Time one session with its truth, from the planned drive to files, with two threads, against real time."""
    names = count()
    with TemporaryDirectory() as folder, ThreadPoolExecutor(THREADS) as pool:
        seconds = timed(
            lambda: write_session(drive, Path(folder) / str(next(names)), pool, report_nothing),
            site.few,
        )
    n_scans = drive.trajectory.n_scans
    real_s = n_scans / site.sensor.rate_hz
    return Contest("revolutions/s", seconds, n_scans, f"real time, {n_scans} revolutions", (real_s,), target)
