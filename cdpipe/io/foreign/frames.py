"""The tree of a robot's frames, as tf tells it: the way to the sensor from a fixed frame or a part of the robot."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, Int64Array, invert, make_pose
from cdpipe.io.foreign.trajectory import Trajectory
from cdpipe.io.tum import require_unit_poses

FIXED = ("odom", "map", "world")
"""Frames in which a robot keeps its way, the smooth one first."""
NO_SENSOR = (*FIXED, "camera_init")
"""Frames that move with no sensor: also that of LOAM and its kin."""
_STANDING = 1e-6  # change of a pose entry, metres or radians, that is none
_LONGEST_CHAIN = 64


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """Poses (N, 4, 4) of a frame in its parent at (N,) rising times, seconds; a fixed one has one pose."""

    parent: str
    time_s: Float64Array
    poses: Float64Array

    def at(self, time_s: Float64Array) -> Float64Array:
        """Return the poses (M, 4, 4) at times (M,), interpolated."""
        if not self.is_moving:
            return self.poses[:1].repeat(len(time_s), axis=0)
        motion = Trajectory("", self.poses, self.time_s).motion()
        return self.poses[:1].repeat(len(time_s), axis=0) if motion is None else motion.poses(time_s)

    @property
    def is_moving(self) -> bool:
        """Whether its poses differ."""
        return bool(np.ptp(self.poses, axis=0).max() > _STANDING)  # a publisher of static frames may repeat them


def is_fixed(frame: str) -> bool:
    """Tell whether a frame is fixed by its name, also in a namespace: `robot/odom`, `map_slam`."""
    return frame in NO_SENSOR or bool(set(re.split(r"[/_]", frame)) & set(FIXED))


def is_base(frame: str) -> bool:
    """Tell whether a frame is a part of a robot by its name: `base_link`, `robot/base_footprint`."""
    return frame.rsplit("/", 1)[-1].startswith("base")


def make_edge(where: str, parent: str, stamps: Int64Array, rows: Float64Array, *, is_static: bool) -> Edge:
    """Return the edge of (N,) stamps, ns, and (N, 7) rows x, y, z, qx, qy, qz, qw.

    Raises:
        InputError: There is none, or one is no pose.
    """
    if rows.ndim != 2 or rows.shape[1] != 7 or stamps.shape != (len(rows),) or not len(rows):
        raise InputError(f"{where}: holds no poses")
    require_unit_poses(rows, lambda index: f"{where}: pose {index}")
    stamps, first = np.unique(stamps, return_index=True)
    if is_static:
        stamps, first = stamps[-1:], first[-1:]
    rows = rows[first]
    return Edge(parent, stamps / 1e9, make_pose(Rotation.from_quat(rows[:, 3:]).as_matrix(), rows[:, :3]))


def find_chain(edges: dict[str, Edge], frame: str, top: str = "") -> list[Edge]:
    """Return the edges from a fixed frame, or from `top`, down to a frame; empty if `top` is not above it.

    Of several fixed frames above it, it is the first in `FIXED` in which the frame moves.
    """
    chain: list[Edge] = []
    above = [frame]
    while above[-1] in edges and above[-1] != top and len(chain) < _LONGEST_CHAIN:
        chain.append(edges[above[-1]])
        above.append(chain[-1].parent)
    if top:
        return chain[::-1] if above[-1] == top else []
    ends = [above.index(name) for name in FIXED if name in above]
    # clouds in a fixed frame are registered: what moves above it is no way of the sensor
    moving = [end for end in ends if any(edge.is_moving for edge in chain[:end])] if frame not in FIXED else []
    return chain[: (moving or ends or [len(chain)])[0]][::-1]


def find_mounting(edges: dict[str, Edge], base: str, frame: str) -> list[Edge]:
    """Return the edges that lead from a base to a frame of the same robot; empty where tf tells of no such way."""
    way = find_chain(edges, frame, base)
    up: list[Edge] = []
    for edge in _climb(edges, base) if not way else ():
        if edge.parent in NO_SENSOR:
            return []
        up.append(replace(edge, poses=invert(edge.poses)))
        way = find_chain(edges, frame, edge.parent)
        if way or edge.parent == frame:
            return up + way
    return way


def _climb(edges: dict[str, Edge], frame: str) -> list[Edge]:
    """Return the edges above a frame, the nearest first."""
    found: list[Edge] = []
    while frame in edges and len(found) < _LONGEST_CHAIN:
        found.append(edges[frame])
        frame = found[-1].parent
    return found


def compose(where: str, chain: Sequence[Edge]) -> Trajectory | None:
    """Return the poses along a chain of edges, at the times of that with the most; None if they share no time."""
    moving = [edge.time_s for edge in chain if edge.is_moving]
    moving = moving or [edge.time_s for edge in chain if len(edge.time_s) > 1] or [chain[0].time_s]
    start_s, end_s = max(times[0] for times in moving), min(times[-1] for times in moving)
    time_s = max(moving, key=len)
    time_s = time_s[(time_s >= start_s) & (time_s <= end_s)]
    if not len(time_s):
        return None
    poses = chain[0].at(time_s)
    for edge in chain[1:]:
        poses = poses @ edge.at(time_s)
    return Trajectory(where, poses, time_s)
