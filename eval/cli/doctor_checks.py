"""Small jobs with a known answer, one for each package that results depend on; `eval.cli.doctor` runs them.

Each returns its result in words, and raises where the result is wrong.
"""

# ruff: noqa: PLC0415 - a package that is broken must break its own check only
from __future__ import annotations

import json
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cdpipe.core.geometry import Float64Array

_HALF_M = 3.0
_SHIFT_M = (0.12, -0.07, 0.03)


def ray() -> str:
    """Cast a ray from the middle of a box at one of its walls (embreex)."""
    import numpy as np

    from sim.geometry.mesh import box_mesh
    from sim.geometry.raycast import Caster

    ranges_m, _, _ = Caster([box_mesh([_HALF_M] * 3)]).cast(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]))
    _require(abs(ranges_m[0] - _HALF_M) < 1e-4, f"a ray met a wall {_HALF_M} m away at {ranges_m[0]} m")
    return f"a ray meets a wall at {ranges_m[0]:.3f} m"


def kernel() -> str:
    """Cast a ray from the middle of a box at one of its walls (warp-lang), on a GPU where there is one."""
    import numpy as np

    from sim.geometry.mesh import box_mesh
    from sim.geometry.warp_caster import WarpCaster

    caster = WarpCaster([box_mesh([_HALF_M] * 3)], np.zeros(3))
    ranges_m, _, _ = caster.cast_local(np.zeros((1, 3), np.float32), np.array([[1.0, 0.0, 0.0]], np.float32))
    _require(abs(ranges_m[0] - _HALF_M) < 1e-4, f"a ray met a wall {_HALF_M} m away at {ranges_m[0]} m")
    return f"a ray meets a wall at {ranges_m[0]:.3f} m on {caster.device}"


def world() -> str:
    """Build the world of a shipped scenario (mujoco; trimesh, scikit-image and embreex on the way)."""
    from scenarios.library import load_scenario
    from sim.scene import build_world

    built = build_world(load_scenario("smoke/one_box", 0), 0)
    n_before, n_after = len(built.before.meshes), len(built.after.meshes)
    _require(n_after > n_before, f"smoke/one_box: {n_before} geoms before, {n_after} after, expected more")
    return f"builds smoke/one_box: {n_before} geoms before, {n_after} after"


def weights() -> str:
    """Load the shipped networks, and hold their digests against their model cards (torch, safetensors)."""
    import torch

    from cdpipe.descriptors.change_network import load_trained_change_network
    from cdpipe.descriptors.network import load_trained_network
    from cdpipe.descriptors.sphere_network import load_trained_sphere_network

    told = []
    shipped: tuple[tuple[str, Callable[[], tuple[torch.nn.Module, str]]], ...] = (
        ("3deg", load_trained_network),
        ("sphere", load_trained_sphere_network),
        ("range-net", load_trained_change_network),
    )
    for name, load in shipped:
        network, digest = load()
        card = json.loads((resources.files("cdpipe") / "descriptors" / "weights" / f"{name}.json").read_text())
        _require(digest == card["checkpoint"], f"{name}.safetensors is {digest}, its model card {card['checkpoint']}")
        is_finite = all(torch.isfinite(values).all() for values in network.state_dict().values())
        _require(is_finite, f"{name}.safetensors holds numbers that are not finite")
        told.append(f"{name} {digest}")
    return f"{', '.join(told)}, as their cards say"


def threads() -> str:
    """Multiply with torch, and tell its threads."""
    import torch

    product = torch.ones(64, 64) @ torch.ones(64, 64)
    _require(bool((product == 64).all()), "a product of ones is not their number")
    return f"{torch.get_num_threads()} thread{'s' if torch.get_num_threads() > 1 else ''}"


def registration() -> str:
    """Align a room with itself shifted (small_gicp)."""
    import numpy as np
    import small_gicp

    points = _room(0)
    found = small_gicp.align(points, points - _SHIFT_M, registration_type="GICP", downsampling_resolution=0.1)
    off_m = float(np.linalg.norm(found.T_target_source[:3, 3] - _SHIFT_M))
    _require(off_m < 0.02, f"a room shifted by 14 cm was aligned {100 * off_m:.1f} cm off")
    return f"aligns a shifted room within {1000 * off_m:.1f} mm"


def coarse_merge() -> str:
    """Find how two samples of a room fit together without a guess (kiss-matcher)."""
    import numpy as np

    from cdpipe.core.geometry import transform, yaw_pose
    from cdpipe.merge.global_registration import register_globally

    before_T_after = yaw_pose(2.0, (30.0, -12.0, 1.0))
    found = register_globally(transform(before_T_after, _room(0)), _room(1), 0.4)
    if found is None:
        raise RuntimeError("two samples of one room were not matched")
    off_m = float(np.linalg.norm(found[:3, 3] - before_T_after[:3, 3]))
    _require(off_m < 0.5, f"two samples of one room were matched {off_m:.2f} m off")
    return f"matches two samples of a room within {100 * off_m:.0f} cm"


def odometry(name: str = "kiss-icp") -> str:
    """Let a sensor stand still for three revolutions (kiss-icp, genz-icp)."""
    import numpy as np

    from cdpipe.mapping.poses.odometry import estimate_motion
    from cdpipe.sensor.ouster import load_profile

    sensor = load_profile("os1-32-nominal", "512x10")
    image = np.full((sensor.height, 512), 5000, dtype=np.uint32), np.zeros((sensor.height, 512), dtype=np.uint16)
    motion = estimate_motion(
        [image] * 3, sensor, np.array([0.0, 0.1, 0.2]), np.arange(512) / 5120.0 - 0.05, np.eye(4), name
    )
    off_m = float(np.abs(motion.points).max())
    _require(off_m < 0.01, f"a sensor that stood still was moved by {off_m:.3f} m")
    return "finds no motion of a sensor that stands still"


def surface_distance() -> str:
    """Measure how far apart two floors are (py4dgeo)."""
    import numpy as np

    from cdpipe.core.geometry import stream
    from cdpipe.methods.m3c2 import load_py4dgeo

    py4dgeo, rng = load_py4dgeo(), stream(0, "doctor", "floor")
    # of an exact plane its error cannot be told, and there is no distance
    floor = np.column_stack([rng.uniform(-1.0, 1.0, (2000, 2)), rng.normal(0.0, 0.001, 2000)])
    algorithm = py4dgeo.M3C2(
        epochs=(py4dgeo.Epoch(floor), py4dgeo.Epoch(floor + np.array([0.0, 0.0, 0.3]))),
        corepoints=np.zeros((1, 3)),
        normal_radii=[0.5],
        cyl_radius=0.3,
        max_distance=1.0,
    )
    distance_m = abs(float(algorithm.run()[0][0]))
    _require(abs(distance_m - 0.3) < 1e-3, f"floors 0.3 m apart were measured {distance_m:.3f} m apart")
    return f"measures floors 0.3 m apart as {distance_m:.3f} m"


def void() -> str:
    """Tell a point in free space from a point on a wall, by rays that end on the wall (dufomap)."""
    import numpy as np

    from cdpipe.methods.dufomap import load_dufomap

    across = np.arange(-2.0, 2.0, 0.02)
    y, z = (grid.ravel() for grid in np.meshgrid(across, across))
    wall = np.column_stack([np.full(len(y), 4.0), y, z])
    pose = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    voids = load_dufomap().dufomap(0.1, 0.2, 1, 1)
    voids.run(wall, pose, False)
    in_air, on_wall = voids.segment(np.array([[2.0, 0.0, 0.0], [4.0, 0.0, 0.0]]), pose, False)
    _require(bool(in_air) and not on_wall, "a point in free space and a point on a wall were not told apart")
    return "tells air from wall"


def free_space() -> str:
    """Tell a voxel that a ray passed from the voxel where it ended (pyoctomap)."""
    import numpy as np

    from cdpipe.methods.octomap import load_pyoctomap

    tree = load_pyoctomap().OcTree(0.1)
    tree.insertPointCloud(np.array([[2.05, 0.05, 0.05]]), np.array([0.05, 0.05, 0.05]))
    labels = tree.getLabels(np.array([[1.05, 0.05, 0.05], [2.05, 0.05, 0.05]])).tolist()
    _require(labels == [0, 1], f"a passed voxel and one that was hit have the labels {labels}")
    return "tells a free voxel from an occupied one"


def point_file() -> str:
    """Write a PCD file and read it again (pypcd4)."""
    from tempfile import TemporaryDirectory

    import numpy as np
    from pypcd4.pypcd4 import PointCloud

    from cdpipe.io.pcd import write_pcd

    with TemporaryDirectory() as folder:
        path = Path(folder, "one.pcd")
        write_pcd(path, np.array([[1.0, 2.0, 3.0]]), np.array([7]))
        found = PointCloud.from_path(path).numpy().tolist()
    _require(found == [[1.0, 2.0, 3.0, 7.0]], f"one point came back as {found}")
    return "writes and reads a PCD file"


def recording() -> str:
    """Let Rerun record a point in memory (rerun-sdk)."""
    import rerun as rr

    with rr.RecordingStream("tunnelcd") as stream:
        memory = rr.memory_recording(recording=stream)
        stream.log("point", rr.Points3D([[1.0, 2.0, 3.0]]))
        _require(memory.num_msgs() > 0, "a point that was logged is not in the recording")
    return "records a point"


def sdk() -> str:
    """Let the vendor's SDK load (ouster-sdk)."""
    from cdpipe.io.ouster.sdk import require_sdk

    core = require_sdk()
    info = core.SensorInfo.from_default(core.LidarMode._1024x10)
    _require(info.w == 1024, f"a sensor of 1024 columns has {info.w}")
    return "knows a sensor of 1024 columns"


def server() -> str:
    """Run a viewer for a moment (viser)."""
    from sim.view.viewer import running_server

    with running_server(0) as running:
        return f"serves a view on a free port ({running.get_port()})"


def cluster() -> str:
    """Let a worker in this process add two numbers (dask, distributed)."""
    from distributed import Client

    settings = {"processes": False, "n_workers": 1, "threads_per_worker": 1, "silence_logs": 50}
    # any free port: another program may hold Dask's own
    ports = {"dashboard_address": "127.0.0.1:0", "worker_dashboard_address": "127.0.0.1:0"}
    with Client(**settings, **ports) as client:
        found = client.submit(sum, (2, 3)).result(timeout=5)
    _require(found == 5, f"a worker made {found} of 2 + 3")
    return "a worker computes"


OF_PACKAGE: dict[str, Callable[[], str]] = {
    "torch": threads,
    "mujoco": world,
    "embreex": ray,
    "small_gicp": registration,
}
OF_EXTRA: dict[str, Callable[[], str]] = {
    "ouster": sdk,
    "odometry": odometry,
    "genz": lambda: odometry("genz-icp"),
    "view": server,
    "kiss": coarse_merge,
    "m3c2": surface_distance,
    "dufomap": void,
    "octomap": free_space,
    "formats": point_file,
    "rerun": recording,
    "gpu": kernel,
    "cluster": cluster,
}


def _require(is_right: bool, fault: str) -> None:
    if not is_right:
        raise RuntimeError(fault)


def _room(sample: int) -> Float64Array:
    """Return (N, 3) points on a room's walls and on what stands in it, metres; samples differ in where they fall."""
    import numpy as np

    from cdpipe.core.geometry import stream

    layout, rng = stream(0, "doctor", "layout"), stream(sample, "doctor", "points")
    halves = np.vstack([[7.0, 4.0, 2.0], layout.uniform(0.3, 1.2, (14, 3))])
    centres = np.vstack([np.zeros(3), layout.uniform((-6, -3, -1.5), (6, 3, 1.5), (14, 3))])
    clouds = []
    for centre, half in zip(centres, halves, strict=True):
        points = rng.uniform(-half, half, (int(60 * half.sum() ** 2), 3))
        axis = rng.integers(0, 3, len(points))
        points[np.arange(len(points)), axis] = half[axis] * rng.choice((-1.0, 1.0), len(points))
        clouds.append(points + centre)
    return np.concatenate(clouds)
