"""How thick the walls of a session's own map are: the error of its poses from scan to scan, seen across the walls.

A wall that was seen from several poses stands in the map as often. Range noise is left out: each return is placed once
by the pose of the map and once by the true one, and in cells of 0.5 m both clouds are compared across the wall.

Run as `python -m eval.studies.wall_thickness PAIR...`, where PAIR is a folder of `tunnelcd simulate`. One row is one
session with one kind of poses: RMS across the walls in the median cell and in 95 % of the cells, metres, with the poses
that were recorded and with those of `map.consistency: graph`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer

from cdpipe.core.geometry import Float64Array, Int64Array, invert, transform_each
from cdpipe.core.geometry.voxel import cell_keys
from cdpipe.io.readers import open_session
from cdpipe.mapping.poses.consistency import make_consistent
from cdpipe.model.types import ScanSource, SessionName
from eval.core.terminal.exits import run_program
from eval.core.terminal.printing import echo
from sim.session.truth import read_true_poses

SESSIONS: tuple[SessionName, SessionName] = ("before", "after")
CELL_M = 0.5
REACH_M = 20.0
_EVERY = 40
_MIN_RETURNS, _MIN_SCANS = 20, 3
# Largest spread of the true returns across a cell that is a wall, and not an edge.
_FLAT_M = 0.05


def measure_thickness_m(
    points_sensor: Float64Array, scans: Int64Array, odom_T_sensor: Float64Array, world_T_sensor: Float64Array
) -> Float64Array:
    """Return the RMS across the wall of each flat cell that three scans and more saw, metres.

    The map's frame may turn and shift against the world, slowly along the path: each cell is compared in the mean frame
    of the scans that saw it.

    Args:
        points_sensor: (N, 3) returns, each in the sensor frame of its scan.
        scans: (N,) scan of each.
        odom_T_sensor: (S, 4, 4) poses of the map.
        world_T_sensor: (S, 4, 4) true poses.
    """
    world = transform_each(world_T_sensor[scans], points_sensor)
    mapped = transform_each(odom_T_sensor[scans], points_sensor)
    world_R_odom = (world_T_sensor @ invert(odom_T_sensor))[:, :3, :3]
    cell = np.unique(cell_keys(world, CELL_M), return_inverse=True)[1]
    order = np.argsort(cell, kind="stable")
    found = []
    for members in np.split(order, np.flatnonzero(np.diff(cell[order])) + 1):
        if len(members) < _MIN_RETURNS or len(np.unique(scans[members])) < _MIN_SCANS:
            continue
        true = world[members] - world[members].mean(axis=0)
        _, spread, axes = np.linalg.svd(true, full_matrices=False)
        if spread[2] > _FLAT_M * np.sqrt(len(members)):
            continue
        u, _, v = np.linalg.svd(world_R_odom[scans[members]].mean(axis=0))
        in_map = (mapped[members] - mapped[members].mean(axis=0)) @ (u @ v).T
        found.append(np.sqrt(np.mean(((in_map - true) @ axes[2]) ** 2)))
    return np.array(found, dtype=np.float64)


def measure_session(session: Path) -> dict[str, Float64Array]:
    """Return the RMS of the cells of a simulated session, by the source of its poses.

    Raises:
        InputError: The session or its truth is missing or damaged.
    """
    source, world_T_sensor = open_session(session), read_true_poses(session)
    found = {}
    for name, each in (("recorded", source), ("graph", make_consistent(source, has_loops=True))):
        found[name] = measure_thickness_m(*_sample(each), each.odom_T_sensor, world_T_sensor)
    return found


def _sample(source: ScanSource) -> tuple[Float64Array, Int64Array]:
    """Return some (N, 3) returns of all scans within reach, sensor frames, and the (N,) scan of each."""
    points, scans = [], []
    for scan in source.scans():
        near = scan.points_sensor[np.linalg.norm(scan.points_sensor, axis=1) < REACH_M][scan.index % _EVERY :: _EVERY]
        points.append(near)
        scans.append(np.full(len(near), scan.index))
    return np.concatenate(points), np.concatenate(scans)


def main(pairs: Annotated[list[Path], typer.Argument(help="folders of `tunnelcd simulate`")]) -> None:
    """Print how thick the walls of each session's own map are, metres."""
    rows = []
    for pair in pairs:
        for name in SESSIONS:
            for poses, rms_m in measure_session(pair / name).items():
                median_m, most_m = np.percentile(rms_m, [50, 95]) if len(rms_m) else (np.nan, np.nan)
                rows.append({"pair": pair.name, "session": name, "poses": poses, "cells": len(rms_m)})
                rows[-1] |= {"median_m": f"{median_m:.4f}", "p95_m": f"{most_m:.4f}"}
    for line in pd.DataFrame(rows).to_string(index=False).splitlines():
        echo(line)


if __name__ == "__main__":
    run_program(main, "eval.studies.wall_thickness")
