"""Truth of a pair: true poses, changes, their cells and their places in the world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import (
    BoolArray,
    Float32Array,
    Float64Array,
    Int64Array,
    invert,
    require_poses,
    require_shape,
    transform_each,
)
from cdpipe.io.session import Session, read_session
from cdpipe.mapping.mapping import choose_keyframes
from cdpipe.model.types import SessionName
from eval.truth.scoring_points import ScoringPoints, load_scoring_points
from sim.session.truth import (
    Int16Array,
    PairTruth,
    read_chunk_surface,
    read_mover_track,
    read_pair_truth,
    read_true_poses,
)

SESSIONS: tuple[SessionName, SessionName] = ("before", "after")
JUDGED_SPACING_M = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceLabels:
    """How far the rock moved at each of the N scoring points of a session.

    Attributes:
        displacement_m: (N,) float32 from before to after, positive into the void; NaN where a point is not on rock.
        change: (N,) int16 id of the surface change that the point belongs to, 0 for none.
    """

    displacement_m: Float32Array
    change: Int16Array


@dataclass(frozen=True, slots=True, eq=False)
class SessionTruth:
    """One session with its true poses.

    Attributes:
        odom_T_sensor: (S, 4, 4) poses of the robot's odometry.
        world_T_sensor: (S, 4, 4) true poses.
        scoring_points: Returns that objects are scored against.
        seen_movers_world: (N, 3) mean true position of the returns on each mover in each revolution that has some.
        judged_scans: (J,) the first scan and one per metre of odometry. Keyframe scores and merges are judged there,
            whatever keyframes an answer names.
        made_poses: Package that estimated the poses, with its version; "" where it was none.
        surface: How far the rock moved at each scoring point; None where the pair has no surface changes.
    """

    odom_T_sensor: Float64Array
    world_T_sensor: Float64Array
    scoring_points: ScoringPoints
    seen_movers_world: Float64Array = field(default_factory=lambda: np.zeros((0, 3)))
    judged_scans: Int64Array = field(init=False)
    made_poses: str = ""
    surface: SurfaceLabels | None = None

    def __post_init__(self) -> None:
        require_poses("odom_T_sensor", self.odom_T_sensor)
        require_poses("world_T_sensor", self.world_T_sensor)
        require_shape("world_T_sensor", self.world_T_sensor, self.odom_T_sensor.shape)
        require_shape("seen_movers_world", self.seen_movers_world, (None, 3))
        if self.surface is not None:
            require_shape("surface.displacement_m", self.surface.displacement_m, (len(self.scoring_points),))
            require_shape("surface.change", self.surface.change, (len(self.scoring_points),))
        object.__setattr__(self, "judged_scans", choose_keyframes(self.odom_T_sensor, JUDGED_SPACING_M))

    def to_world(self, points_odom: Float64Array, scans: Int64Array) -> Float64Array:
        """Transform (N, 3) odom points into the world, each by the true pose of one of (N,) scans."""
        return transform_each(self.world_T_sensor[scans] @ invert(self.odom_T_sensor[scans]), points_odom)


@dataclass(frozen=True, slots=True, eq=False)
class GroundTruth:
    """A pair's truth, ready to score against.

    Attributes:
        pair: Family, seed, radius and the C changes.
        sessions: The two sessions.
        change_rows: C arrays: the rows of its session's scoring points that belong to each change.
        centroids_world: (C, 3) centroid of those rows through the true poses, world frame; the object's own origin for
            a change that fills no cell.
        is_observable: (C,) observable changes; a change that fills no cell is never observable.
        is_partial: (C,) changes of the group "partial".
    """

    pair: PairTruth
    sessions: Mapping[SessionName, SessionTruth]
    change_rows: tuple[Int64Array, ...]
    centroids_world: Float64Array
    is_observable: BoolArray
    is_partial: BoolArray

    @property
    def before(self) -> SessionTruth:
        """The before session."""
        return self.sessions["before"]

    @property
    def after(self) -> SessionTruth:
        """The after session."""
        return self.sessions["after"]

    def range_m(self, index: int) -> float:
        """Return the shortest range at which the session that holds a change saw it, metres; NaN where it did not."""
        change = self.pair.changes[index]
        return self.sessions[change.session].scoring_points.range_of_change(change.id)

    def points_odom(self, index: int) -> Float64Array:
        """Return the (N, 3) cells of a change's truth, that session's odom frame, metres."""
        scoring_points = self.sessions[self.pair.changes[index].session].scoring_points
        return scoring_points.points_odom[self.change_rows[index]].astype(np.float64)

    @property
    def n_observable(self) -> int:
        """Number of observable changes of both groups."""
        return int(np.count_nonzero(self.is_observable))


def load_ground_truth(pair: Path, *, keeps_points: bool = True) -> GroundTruth:
    """Read the truth of a simulated pair.

    Args:
        pair: Its folder.
        keeps_points: Whether the scoring points may be stored in the pair, so that they are read the next time; where
            not, nothing is written.

    Raises:
        InputError: A session or a part of the truth is missing, damaged or of another session.
    """
    truth = read_pair_truth(pair)
    n_movers = {name: sum(mover.session == name for mover in truth.movers) for name in SESSIONS}
    return ground_truth(truth, {name: _load_session(pair / name, n_movers[name], keeps_points) for name in SESSIONS})


def ground_truth(truth: PairTruth, sessions: Mapping[SessionName, SessionTruth]) -> GroundTruth:
    """Assemble a pair's truth from the list of its changes and its two sessions."""
    rows, centroids = [], []
    for change in truth.changes:
        session = sessions[change.session]
        of_change = session.scoring_points.rows_of_change(change.id)
        rows.append(of_change)
        if len(of_change) == 0:
            centroids.append(np.asarray(change.world_T_object)[:3, 3])
            continue
        points_odom = session.scoring_points.points_odom[of_change].astype(np.float64)
        centroids.append(session.to_world(points_odom, session.scoring_points.scans(of_change)).mean(axis=0))
    return GroundTruth(
        pair=truth,
        sessions=sessions,
        change_rows=tuple(rows),
        centroids_world=np.array(centroids, dtype=np.float64).reshape(-1, 3),
        is_observable=np.array(
            [change.is_observable and len(cells) > 0 for change, cells in zip(truth.changes, rows, strict=True)],
            dtype=np.bool_,
        ),
        is_partial=np.array([change.group == "partial" for change in truth.changes], dtype=np.bool_),
    )


def _load_session(path: Path, n_movers: int, keeps_points: bool) -> SessionTruth:
    session = read_session(path)
    odom_T_sensor, made_poses = session.odom_T_sensor, str(session.provenance.get("odometry", ""))
    seen_world = _load_seen_movers(path, n_movers, len(odom_T_sensor))
    try:
        points = load_scoring_points(path, keeps=keeps_points)
        poses, surface = read_true_poses(path), _load_surface(session, points)
        return SessionTruth(odom_T_sensor, poses, points, seen_world, made_poses=made_poses, surface=surface)
    except (KeyError, ValueError) as error:
        raise InputError(f"{path / 'truth'}: not the truth of this session: {error}") from error


def _load_seen_movers(path: Path, n_movers: int, n_scans: int) -> Float64Array:
    """Return where the movers of a session were seen (N, 3), as `SessionTruth.seen_movers_world`."""
    track = read_mover_track(path)
    found = (0, n_scans) if track is None else track.n_returns.shape
    if found != (n_movers, n_scans):
        raise InputError(
            f"{path / 'truth' / 'movers.npz'}: not the truth of this session: it has {found[0]} movers and {found[1]} "
            f"revolutions, expected {n_movers} and {n_scans}"
        )
    return np.zeros((0, 3)) if track is None else track.seen_world[track.n_returns > 0]


def _load_surface(session: Session, points: ScoringPoints) -> SurfaceLabels | None:
    """Return how far the rock moved at the scoring points of a session; None where it has no such truth.

    Raises:
        ValueError: The displacements are of a session with other scans.
    """
    scans, pixels = np.divmod(points.returns, points.n_pixels)
    displacement_m = np.full(len(points), np.nan, dtype=np.float32)
    change = np.zeros(len(points), dtype=np.int16)
    for index in range(session.n_chunks):
        labels = read_chunk_surface(session.path, index)
        if labels is None:
            return None
        first = index * session.chunk_scans
        n_scans = min(session.chunk_scans, session.n_scans - first)
        rows = np.flatnonzero((scans >= first) & (scans < first + n_scans))
        for each in labels:
            require_shape(f"surface/{index:05d}.npz", each.reshape(len(each), -1), (n_scans, points.n_pixels))
        displacement_m[rows], change[rows] = (
            each.reshape(n_scans, -1)[scans[rows] - first, pixels[rows]] for each in labels
        )
    return SurfaceLabels(displacement_m, change)
