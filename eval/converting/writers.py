"""One function for each format: writes a session or a recording to a path that does not exist, with truth if asked."""

# ruff: noqa: PLC0415 - heavy imports stand inside the functions, and the packages of some formats are extras
from __future__ import annotations

from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import transform
from cdpipe.core.geometry.voxel import FINEST_CELL_M, max_coordinate_m
from cdpipe.io.out.scans import START_NS, Outgoing
from eval.converting.request import Request
from eval.converting.truth import knows_changes

GT_CLOUD = "gt_cloud.pcd"
_FARTHEST_M = max_coordinate_m(FINEST_CELL_M)  # maps and `detect` end here; 32-bit numbers are off by 2 mm


def write_osf(request: Request, path: Path) -> None:
    """Write OSF. LABEL is the change's id, 0 none, 65535 (-1) mixed returns; INSTANCE as `sim.session.truth`.

    A session of a story has no LABEL.
    """
    from cdpipe.io.ouster.osf import write_osf as write
    from sim.session.truth import read_labels

    session = request.own_session()
    if not request.with_truth:  # a profile of one's own is a path, which can tell the scenario
        told = {name: value for name, value in session.provenance.items() if name != "sensor_profile"}
        session = replace(session, provenance=told)
    labels = read_labels(session.path, session.n_chunks)
    has_changes = knows_changes(session)
    fields = (
        ({"LABEL": change.astype(np.uint16)} if has_changes else {}) | {"INSTANCE": instance.astype(np.int16)}
        for instance, change in labels
    )
    write(session, path, fields if request.with_truth else None, request.progress.stage)


def write_pcap(request: Request, path: Path) -> None:
    """Write PCAP, and the metadata of its sensor beside it."""
    from cdpipe.io.ouster.packets import write_pcap as write

    session = request.own_session()
    told = {name: value for name, value in session.provenance.items() if name != "sensor_profile"}
    start_ns = request.outgoing().start_ns or START_NS  # 0 is no time to the SDK
    write(replace(session, provenance=told), path, path.with_suffix(".json"), start_ns, request.progress.stage)


def write_mcap(request: Request, path: Path) -> None:
    """Write one MCAP file."""
    _write_bag(request, path, "mcap")


def write_ros1(request: Request, path: Path) -> None:
    """Write a ROS 1 bag."""
    _write_bag(request, path, "ros1")


def write_ros2(request: Request, folder: Path) -> None:
    """Write a ROS 2 bag into an empty folder; rosbags makes a folder of its own, which gives its file the name."""
    own = folder / "bag"
    _write_bag(request, own, "ros2")
    for file in own.iterdir():
        file.rename(folder / file.name)
    own.rmdir()


def _write_bag(request: Request, path: Path, kind: str) -> None:
    from cdpipe.io.out.bags import write_bag

    write_bag(path, request.outgoing(), kind, request.progress.stage)


def write_pcds(request: Request, folder: Path) -> None:
    """Write PCD files, one a revolution, in the layout of DynamicMap_Benchmark.

    The truth is one file of one return per 0.1 m cell: intensity 1 on what moves while the session is recorded, else 0.
    """
    from cdpipe.io.pcd import write_pcd
    from eval.truth.scoring_points import build_scoring_points
    from sim.session.truth import read_pair_truth

    session = request.own_session()
    _require_float32(request)
    truth = read_pair_truth(session.path.parent) if request.with_truth else None
    counts = chain.from_iterable(chunk.reflectivity for chunk in session.chunks())
    (folder / "pcd").mkdir()
    for scan, reflectivity in zip(request.source.scans(), counts, strict=True):
        points_odom = transform(scan.odom_T_sensor, scan.points_sensor)
        path = folder / "pcd" / f"{scan.index:06d}.pcd"
        write_pcd(path, points_odom, reflectivity.ravel()[scan.pixels], scan.odom_T_sensor)
        request.progress.stage("write", scan.index + 1, session.n_scans)
    if truth is not None:
        points = build_scoring_points(session)
        movers = [mover.instance for mover in truth.movers]
        write_pcd(folder / GT_CLOUD, points.points_odom.astype(np.float64), np.isin(points.instance, movers))


def _require_float32(request: Request) -> None:
    """Raise `InputError` if the path lies so far out that 32-bit numbers are off by millimetres."""
    farthest_m = float(np.abs(request.source.odom_T_sensor[:, :3, 3]).max())
    if farthest_m > _FARTHEST_M:
        off_m = float(np.spacing(np.float32(farthest_m))) / 2
        raise InputError(
            f"{request.source.name}: positions reach {farthest_m:.0f} m, where the 32-bit numbers of PCD are off by up "
            f"to {off_m:.2g} m: convert the recording to a session again, with --origin X,Y,Z"
        )


def write_semantic_kitti(request: Request, folder: Path) -> None:
    """Write the layout of SemanticKITTI into an empty folder."""
    from cdpipe.io.out.kitti import write_kitti
    from eval.converting.truth import LABELS, semantic_fields

    fields = semantic_fields(request.own_session()) if request.with_truth else None
    labels = LABELS if request.with_truth else ()
    write_kitti(folder, Outgoing(request.source, fields), labels, request.progress.stage)


def write_tum(request: Request, path: Path) -> None:
    """Write the session's own poses, and the true ones to .true.tum."""
    from cdpipe.io.out.poses import write_tum_poses
    from sim.session.truth import read_true_poses

    stamps_ns = Outgoing(request.source).stamps_ns()
    write_tum_poses(path, stamps_ns, request.source.odom_T_sensor)
    if request.with_truth:
        write_tum_poses(path.with_suffix(".true.tum"), stamps_ns, read_true_poses(request.own_session().path))


def write_kitti_poses(request: Request, path: Path) -> None:
    """Write the session's own poses, those of the sensor, and the true ones to .true.kitti."""
    from cdpipe.io.out.poses import write_kitti_poses as write
    from sim.session.truth import read_true_poses

    Outgoing(request.source).require_scans()
    write(path, request.source.odom_T_sensor)
    if request.with_truth:
        write(path.with_suffix(".true.kitti"), read_true_poses(request.own_session().path))


def write_laz(request: Request, path: Path) -> None:
    """Write the map as LAZ, or as LAS where the name says so."""
    from cdpipe.io.out import clouds, maps

    require_formats(path)
    clouds.write_laz(path, maps.gather_map(request.outgoing(), request.cell_m, request.progress.stage))


def write_ply(request: Request, path: Path) -> None:
    """Write the map as PLY."""
    from cdpipe.io.out import clouds, maps

    clouds.write_ply(path, maps.gather_map(request.outgoing(), request.cell_m, request.progress.stage))


def write_rrd(request: Request, path: Path) -> None:
    """Write a recording for Rerun."""
    from cdpipe.io.out.rerun import write_rrd as write

    write(path, request.outgoing(), request.progress.stage)


def require_formats(path: Path) -> None:
    """Raise `InputError` unless the extra `formats` is there, before a map is made."""
    from cdpipe.core.plugins import require_extra

    require_extra("formats", str(path))
