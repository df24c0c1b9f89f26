"""Types that the stages exchange. Every class is frozen and rejects arrays of the wrong shape."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import (
    BoolArray,
    Float32Array,
    Float64Array,
    Int8Array,
    Int32Array,
    Int64Array,
    invert,
    require_poses,
    require_shapes,
)
from cdpipe.model.alignment import PathAlignment

Kind = Literal["added", "removed", "moved", "reshaped"]
SessionName = Literal["before", "after"]
PLACES = 256  # positions along the edge of a map cell to which a return is rounded
Spheres = Float32Array | Int8Array
UInt8Array = npt.NDArray[np.uint8]
Float16Array = npt.NDArray[np.float16]


@dataclass(frozen=True, slots=True, eq=False)
class PosedScan:
    """One LiDAR revolution with its odometry pose.

    Attributes:
        index: Position of the scan in its session.
        points_sensor: (N, 3) float64 returns, metres, deskewed into the sensor frame at the revolution's pose.
        odom_T_sensor: (4, 4) float64 pose that maps sensor points into the session's odom frame.
        stamps_ns: (N,) int64 time of each return since the start of the session.
        pixels: (N,) int32 origin of each return: row * W + column, or the row of its file.
        signal: (N,) uint16 photons of each return, None where the sensor does not tell.
        second_from: Pixels from this one on are second returns of the beams from pixel 0 on; None: one return a beam.
        intensity: (N,) float32 intensity of each return in the recording's own unit, None where it has none.
        airborne_sensor: (D, 3) returns that were left out as mist or dust; None where the air is clear.
        pose_ns: Time of the pose, where the motion through the session's poses deskewed the points, or a finer one that
            it stands for; else None.
    """

    index: int
    points_sensor: Float64Array
    odom_T_sensor: Float64Array
    stamps_ns: Int64Array
    pixels: Int32Array
    signal: npt.NDArray[np.uint16] | None = None
    second_from: int | None = None
    intensity: Float32Array | None = None
    airborne_sensor: Float64Array | None = None
    pose_ns: int | None = None

    def __post_init__(self) -> None:
        n = len(self.points_sensor)
        require_shapes(self, points_sensor=(None, 3), odom_T_sensor=(4, 4), stamps_ns=(n,), pixels=(n,))
        if self.signal is not None:
            require_shapes(self, signal=(n,))
        if self.intensity is not None:
            require_shapes(self, intensity=(n,))

    def keep(self, rows: BoolArray | Int64Array | slice) -> PosedScan:
        """Return the scan with the returns of these rows alone."""
        return replace(
            self,
            points_sensor=self.points_sensor[rows],
            stamps_ns=self.stamps_ns[rows],
            pixels=self.pixels[rows],
            signal=None if self.signal is None else self.signal[rows],
            intensity=None if self.intensity is None else self.intensity[rows],
        )


class ScanSource(Protocol):
    """A session as the pipeline reads it, of any sensor and format."""

    @property
    def name(self) -> str:
        """Name of the session in messages."""

    @property
    def odom_T_sensor(self) -> Float64Array:
        """(S, 4, 4) pose of each scan."""

    def scan(self, index: int) -> PosedScan:
        """Read one scan."""

    def scans(self) -> Iterator[PosedScan]:
        """Read all scans in order."""


class WrappedScans(ScanSource):
    """A source of scans that reads from another one; subclasses replace how scans are read."""

    def __init__(self, source: ScanSource) -> None:
        self._source = source

    @property
    def name(self) -> str:
        """Name of the session in messages."""
        return self._source.name

    @property
    def odom_T_sensor(self) -> Float64Array:
        """(S, 4, 4) pose of each scan."""
        return self._source.odom_T_sensor

    def scan(self, index: int) -> PosedScan:
        """Read one scan."""
        return self._source.scan(index)

    def scans(self) -> Iterator[PosedScan]:
        """Read all scans in order."""
        return self._source.scans()


def offsets_in_cells(points: Float64Array, voxel_m: float) -> UInt8Array:
    """Return the (N, 3) positions of (N, 3) points in their cells of a map, in 1/PLACES of `voxel_m`, rounded down."""
    in_cells = points / voxel_m
    in_cells -= np.floor(in_cells)
    in_cells *= PLACES
    # just below a border the fraction rounds to 1
    return np.minimum(in_cells, PLACES - 1, out=in_cells).astype(np.uint8)


def as_stored(points: Float64Array, voxel_m: float) -> Float64Array:
    """Return the (N, 3) positions that a map of such cells tells of (N, 3) returns (`PointMap.positions_of`)."""
    return _positions(points / voxel_m, offsets_in_cells(points, voxel_m), voxel_m)


def _positions(in_voxels: Float64Array, offsets: UInt8Array, voxel_m: float) -> Float64Array:
    np.floor(in_voxels, out=in_voxels)
    in_voxels += (offsets + 0.5) / PLACES
    in_voxels *= voxel_m
    return in_voxels


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeViews:
    """Range image of each keyframe: the space in front of the measured ranges is free.

    Attributes:
        ranges_m: (K, ROWS, COLUMNS) float16 range of the nearest return of each pixel (`cdpipe.mapping.free_space`), 0
            without a return, negative where all were dropped as mist or dust.
        sensor_T_odom: (K, 4, 4) float64 inverse pose of each keyframe's scan.
    """

    ranges_m: Float16Array
    sensor_T_odom: Float64Array

    def __post_init__(self) -> None:
        require_shapes(self, ranges_m=(len(self.sensor_T_odom), None, None))
        require_poses("sensor_T_odom", self.sensor_T_odom)

    def has_mist(self) -> bool:
        """Return whether the session met mist or dust: whether some pixel holds nothing else."""
        signs = np.ascontiguousarray(self.ranges_m).view(np.int16)  # ten times as fast as comparing float16
        return bool((signs < 0).any())


@dataclass(frozen=True, slots=True, eq=False)
class PointMap:
    """A thinned map and, for each of its points, the returns that it represents.

    Attributes:
        points: (N, 3) float64 mean of the returns of each occupied cell, weighted by the inverse square of the ranges;
            session odom frame, metres.
        nearest_m: (N,) float32 shortest range of the returns of each point.
        voxel_m: Cell size of the thinning.
        odom_T_sensor: (S, 4, 4) pose of every scan.
        keyframe_scans: (K,) int64 index of the scan of each keyframe.
        return_points: (M,) int32 map point of each return, in scan order.
        return_pixels: (M,) int32 pixel of each return within its scan.
        scan_offsets: (S + 1,) int64; the returns of scan s are scan_offsets[s]:scan_offsets[s + 1].
        seen_from: (N, 3) float32 mean position of the sensor when each point was seen, weighted like the point; None
            if unknown.
        return_offsets: (M, 3) uint8 position of each return in its cell, in 1/PLACES of `voxel_m` from the cell's lower
            corner; None if not stored.
        views: Range images of the keyframes; None if not stored.
        recorded_T_sensor: (S, 4, 4) recorded pose of every scan, where `odom_T_sensor` was made consistent; else None.
        mover_points: (D, 3) float32 points that were left out because they moved, one row for each scan that hit one,
            in scan order; session odom frame, metres. None if there were none.
        mover_scans: (D,) int32 that scan.
    """

    points: Float64Array
    nearest_m: Float32Array
    voxel_m: float
    odom_T_sensor: Float64Array
    keyframe_scans: Int64Array
    return_points: Int32Array
    return_pixels: Int32Array
    scan_offsets: Int64Array
    seen_from: Float32Array | None = None
    return_offsets: UInt8Array | None = None
    views: KeyframeViews | None = None
    recorded_T_sensor: Float64Array | None = None
    mover_points: Float32Array | None = None
    mover_scans: Int32Array | None = None

    def __post_init__(self) -> None:
        n, m = len(self.points), len(self.return_points)
        n_dropped = 0 if self.mover_points is None else len(self.mover_points)
        require_shapes(self, points=(None, 3), seen_from=(n, 3), nearest_m=(n,), keyframe_scans=(None,))
        require_shapes(self, return_points=(m,), return_pixels=(m,), return_offsets=(m, 3))
        require_shapes(self, mover_points=(n_dropped, 3), mover_scans=(n_dropped,))
        require_shapes(self, scan_offsets=(len(self.odom_T_sensor) + 1,))
        require_poses("odom_T_sensor", self.odom_T_sensor)
        if self.recorded_T_sensor is not None:
            require_shapes(self, recorded_T_sensor=self.odom_T_sensor.shape)
            require_poses("recorded_T_sensor", self.recorded_T_sensor)

    def positions_of(self, returns: Int64Array | slice) -> Float64Array:
        """Return the (N, 3) positions of (N,) returns, or of a slice, the session's odom frame, metres.

        They are known to 1/PLACES of a cell.

        Raises:
            ValueError: The map does not store them.
        """
        if self.return_offsets is None:
            raise ValueError("return_offsets is None: this map does not store the positions of its returns")
        in_voxels = self.points.take(self.return_points[returns], axis=0)
        in_voxels /= self.voxel_m
        return _positions(in_voxels, self.return_offsets[returns], self.voxel_m)

    def scans_of(self, returns: Int64Array) -> Int64Array:
        """Return the (N,) scan of each of (N,) returns."""
        return np.searchsorted(self.scan_offsets, returns, side="right") - 1

    @property
    def odom_T_keyframe(self) -> Float64Array:
        """(K, 4, 4) pose of each keyframe."""
        return self.odom_T_sensor[self.keyframe_scans]


@dataclass(frozen=True, slots=True, eq=False)
class DescriptorSet:
    """Descriptors of one session's keyframes, as stored while mapping.

    Attributes:
        q: (K, D) float32 place vectors, unit length, unchanged by a turn of the sensor.
        w: (K, D) float32 orientation vectors, or None for descriptors without them.
        keyframe_scans: (K,) int64 scan of each keyframe.
        name: Name of the descriptor.
        checkpoint: Digest of the weights, or "" without weights.
        spheres: (K, E) float32 or int8 descriptor of the map around each keyframe (`describe_map`), or None.
    """

    q: Float32Array
    w: Float32Array | None
    keyframe_scans: Int64Array
    name: str
    checkpoint: str
    spheres: Spheres | None = None

    def __post_init__(self) -> None:
        n = len(self.q)
        require_shapes(self, q=(n, None), spheres=(n, None), w=(n, None), keyframe_scans=(n,))


@dataclass(frozen=True, slots=True, eq=False)
class MappedSession:
    """A mapped session: its thinned map, and descriptors of all of its keyframes or of none.

    Attributes:
        map: The map.
        descriptors: The descriptors. With `describe_rest`, q and w are zeros but for the keyframes that are compared
            first (`cdpipe.merge.candidates.first_keyframes`).
        describe_rest: Returns the descriptors of all keyframes, or None if `descriptors` holds them.
    """

    map: PointMap
    descriptors: DescriptorSet
    describe_rest: Callable[[], DescriptorSet] | None = None

    def __post_init__(self) -> None:
        described = self.descriptors.keyframe_scans
        if len(described) and not np.array_equal(described, self.map.keyframe_scans):
            raise ValueError(
                f"the descriptors are of {len(described)} keyframes that are not the map's "
                f"{len(self.map.keyframe_scans)}: describe the session again"
            )
        if not np.isfinite(self.descriptors.q).all():
            raise ValueError("descriptors.q is not finite: describe the session again")

    def described(self) -> MappedSession:
        """Return the session with the q and w of all keyframes; describes those that are missing."""
        return self if self.describe_rest is None else MappedSession(self.map, self.describe_rest())


@dataclass(frozen=True, slots=True, eq=False)
class MergedMaps:
    """Both maps and their alignment; the before session's odom frame is the map frame.

    Two odometries drift apart, so no single transform fits everywhere: `alignment` varies along the after path.

    Attributes:
        before: The before map.
        after: The after map, still in its own odom frame.
        before_T_after: (4, 4) pose of the after session's odom frame in the map frame, one for the full map.
        evidence: Measurements of the alignment, by name.
        is_accepted: Whether the evidence suffices.
        reason: Reason of a refusal, or "".
        local: The local alignment along the path; None if it was not refined.
        seconds: Wall-clock seconds of `t_index_s`, `t_merge_s` and `t_refine_s`.
    """

    before: PointMap
    after: PointMap
    before_T_after: Float64Array
    evidence: Mapping[str, float]
    is_accepted: bool
    reason: str = ""
    local: PathAlignment | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_poses("before_T_after", self.before_T_after[None])

    @property
    def alignment(self) -> PathAlignment:
        """The alignment that all later stages use."""
        return PathAlignment.rigid(self.before_T_after) if self.local is None else self.local

    def map_of(self, session: SessionName) -> PointMap:
        """Return the map of a session, in its own odom frame."""
        return self.before if session == "before" else self.after

    def to_map(self, session: SessionName, points_odom: Float64Array) -> Float64Array:
        """Return (N, 3) points of a session's odom frame in the map frame, metres."""
        return points_odom if session == "before" else self.alignment.to_map(points_odom)

    def to_odom(self, session: SessionName, points_map: Float64Array) -> Float64Array:
        """Return (N, 3) points of the map frame in a session's odom frame, metres."""
        return points_map if session == "before" else self.alignment.to_odom(points_map)

    def move_poses(self, source: SessionName, target: SessionName, odom_T_here: Float64Array) -> Float64Array:
        """Return (K, 4, 4) poses in the odom frame of session `source` in that of `target`, as it holds at each."""
        if source == target:
            return odom_T_here
        if source == "after":
            return np.asarray(self.alignment.at(odom_T_here[:, :3, 3]) @ odom_T_here)
        positions_after = self.alignment.to_odom(odom_T_here[:, :3, 3])
        return np.asarray(invert(self.alignment.at(positions_after)) @ odom_T_here)

    def keyframe_positions(self, before: DescriptorSet, after: DescriptorSet) -> tuple[Float64Array, Float64Array]:
        """Return the (Kb, 3) before and (Ka, 3) after positions of the described keyframes, map frame, metres."""
        after_positions = self.after.odom_T_sensor[after.keyframe_scans, :3, 3]
        return self.before.odom_T_sensor[before.keyframe_scans, :3, 3], self.alignment.to_map(after_positions)
