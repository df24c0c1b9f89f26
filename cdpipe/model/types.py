"""What passes between the stages. Every class is frozen and rejects arrays of the wrong shape."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
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
    require_poses,
    require_shape,
)
from cdpipe.model.alignment import PathAlignment

Kind = Literal["added", "removed", "moved", "reshaped"]
SessionName = Literal["before", "after"]
PLACES = 256  # along each edge of a map's cell, at which a return can be kept
Spheres = Float32Array | Int8Array
UInt8Array = npt.NDArray[np.uint8]
Float16Array = npt.NDArray[np.float16]


@dataclass(frozen=True, slots=True, eq=False)
class PosedScan:
    """One LiDAR revolution with the pose the robot believed it had.

    Attributes:
        index: Position of the scan in its session.
        points_sensor: (N, 3) float64 returns, metres, deskewed into the sensor frame at the revolution's pose.
        odom_T_sensor: (4, 4) float64 pose that maps sensor points into the session's odom frame.
        stamps_ns: (N,) int64 time of each return since the start of the session.
        pixels: (N,) int32 where each return came from: row * W + column, or the row of the file it was read from.
    """

    index: int
    points_sensor: Float64Array
    odom_T_sensor: Float64Array
    stamps_ns: Int64Array
    pixels: Int32Array

    def __post_init__(self) -> None:
        require_shape("points_sensor", self.points_sensor, (None, 3))
        require_shape("odom_T_sensor", self.odom_T_sensor, (4, 4))
        require_shape("stamps_ns", self.stamps_ns, (len(self.points_sensor),))
        require_shape("pixels", self.pixels, (len(self.points_sensor),))


class ScanSource(Protocol):
    """A session as the pipeline sees it, whatever it was recorded with."""

    @property
    def name(self) -> str:
        """What to call it in messages."""

    @property
    def odom_T_sensor(self) -> Float64Array:
        """(S, 4, 4) pose of each scan."""

    def scan(self, index: int) -> PosedScan:
        """Read one scan."""

    def scans(self) -> Iterator[PosedScan]:
        """Read all scans in order."""


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeViews:
    """How far the sensor saw from each keyframe: what is nearer and not there was seen through.

    Attributes:
        ranges_m: (K, ROWS, COLUMNS) float16 range of the nearest return of each pixel (`cdpipe.mapping.free_space`), 0
        without. sensor_T_odom: (K, 4, 4) float64 of the keyframes' scans.
    """

    ranges_m: Float16Array
    sensor_T_odom: Float64Array

    def __post_init__(self) -> None:
        require_shape("ranges_m", self.ranges_m, (len(self.sensor_T_odom), None, None))
        require_poses("sensor_T_odom", self.sensor_T_odom)


@dataclass(frozen=True, slots=True, eq=False)
class PointMap:
    """A thinned map and, for each of its points, the returns it stands for.

    Attributes:
        points: (N, 3) float64 mean of the returns of each occupied cell, the session's odom frame, metres; each return
            weighs by the inverse square of its range.
        nearest_m: (N,) float32 shortest range of the returns of each.
        voxel_m: Cell size of the thinning.
        odom_T_sensor: (S, 4, 4) pose of every scan.
        keyframe_scans: (K,) int64 index of the scan of each keyframe.
        return_points: (M,) int32 map point of each return, in scan order.
        return_pixels: (M,) int32 pixel of each return within its scan.
        scan_offsets: (S + 1,) int64; the returns of scan s are scan_offsets[s]:scan_offsets[s + 1].
        seen_from: (N, 3) float32 mean position of the sensor when each point was seen, weighed as the point is; None
            where that is not known.
        return_offsets: (M, 3) uint8 place of each return in its cell, in 1/PLACES of `voxel_m` from the cell's lower
            corner; None where that was not kept.
        views: What the scans of the keyframes saw, None where that was not kept.
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

    def __post_init__(self) -> None:
        require_shape("points", self.points, (None, 3))
        if self.seen_from is not None:
            require_shape("seen_from", self.seen_from, self.points.shape)
        if self.return_offsets is not None:
            require_shape("return_offsets", self.return_offsets, (len(self.return_points), 3))
        require_shape("nearest_m", self.nearest_m, (len(self.points),))
        require_poses("odom_T_sensor", self.odom_T_sensor)
        require_shape("keyframe_scans", self.keyframe_scans, (None,))
        require_shape("return_pixels", self.return_pixels, self.return_points.shape)
        require_shape("scan_offsets", self.scan_offsets, (len(self.odom_T_sensor) + 1,))

    def positions_of(self, returns: Int64Array) -> Float64Array:
        """Return the (N, 3) places of (N,) returns, the session's odom frame, metres, to 1/PLACES of a cell.

        Raises:
            ValueError: The map did not keep them.
        """
        if self.return_offsets is None:
            raise ValueError("return_offsets is None: this map does not know where its returns are")
        cells = np.floor(self.points[self.return_points[returns]] / self.voxel_m)
        return (cells + (self.return_offsets[returns] + 0.5) / PLACES) * self.voxel_m

    @property
    def odom_T_keyframe(self) -> Float64Array:
        """(K, 4, 4) pose of each keyframe."""
        return self.odom_T_sensor[self.keyframe_scans]


@dataclass(frozen=True, slots=True, eq=False)
class DescriptorSet:
    """Descriptors of one session's keyframes, as stored while mapping.

    Attributes:
        q: (K, D) float32 place vectors, unit length, unchanged by a turn of the sensor.
        w: (K, D) float32 orientation vectors, or None for descriptors that have none.
        keyframe_scans: (K,) int64 scan of each keyframe.
        name: Which descriptor.
        checkpoint: Digest of the weights, or "" where there are none.
        spheres: (K, E) float32 or int8 what the map around each keyframe looks like (`describe_map`), or None.
    """

    q: Float32Array
    w: Float32Array | None
    keyframe_scans: Int64Array
    name: str
    checkpoint: str
    spheres: Spheres | None = None

    def __post_init__(self) -> None:
        require_shape("q", self.q, (None, None))
        if self.spheres is not None:
            require_shape("spheres", self.spheres, (len(self.q), None))
        if self.w is not None:
            require_shape("w", self.w, (len(self.q), None))
        require_shape("keyframe_scans", self.keyframe_scans, (len(self.q),))


@dataclass(frozen=True, slots=True, eq=False)
class MappedSession:
    """What a robot brings home: its thinned map and the descriptors of its keyframes, all of them or none."""

    map: PointMap
    descriptors: DescriptorSet

    def __post_init__(self) -> None:
        described = self.descriptors.keyframe_scans
        if len(described) and not np.array_equal(described, self.map.keyframe_scans):
            raise ValueError(
                f"the descriptors are of {len(described)} keyframes that are not the map's "
                f"{len(self.map.keyframe_scans)}: describe the session again"
            )
        if not np.isfinite(self.descriptors.q).all():
            raise ValueError("descriptors.q is not finite: describe the session again")


@dataclass(frozen=True, slots=True, eq=False)
class MergedMaps:
    """Both maps in the before session's odom frame, from here on called `map`.

    Two odometries drift apart, so no single transform fits everywhere: `alignment` says where the after session's odom
    frame lies around each place of its path.

    Attributes:
        before: The before map; its odom frame is the map frame.
        after: The after map, still in its own odom frame.
        before_T_after: (4, 4) pose of the after session's odom frame in the map frame, one for the whole map.
        evidence: What was measured about the alignment, by name.
        is_accepted: Whether the evidence suffices.
        reason: Why not, or "".
        local: The same place by place, as refined; None where nothing was.
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
        """What every later stage aligns with."""
        return PathAlignment.rigid(self.before_T_after) if self.local is None else self.local


@dataclass(frozen=True, slots=True, eq=False)
class ChangeRegions:
    """Every candidate sphere, best first, and the score of every before keyframe.

    Attributes:
        centres_map: (R, 3) sphere centres, map frame, metres.
        radius_m: Radius of all of them.
        scores: (R,) change score, falling; larger means changed more surely.
        pairs: (R, 2) int64 before and after keyframe of each.
        is_reported: (R,) whether it stands in the answer: the threshold (or the fixed number) let it through, and it
            was not withdrawn.
        keyframe_scores: (K,) score of every before keyframe, NaN where the after session never came near.
        is_withdrawn: (R,) whether it was let through and then nothing could be cut out of it; None where no region was.
        direction: (R,) uint8, whose keyframe was looked up in the other session: 0 the before session's, 1 the after
            session's (`pairs` has both, and the centre is where the one that was looked up stands); None for methods
            that look up no keyframes.
    """

    centres_map: Float64Array
    radius_m: float
    scores: Float64Array
    pairs: Int64Array
    is_reported: BoolArray
    keyframe_scores: Float64Array
    is_withdrawn: BoolArray | None = None
    direction: UInt8Array | None = None

    @property
    def is_proposed(self) -> BoolArray:
        """(R,) whether the threshold (or the fixed number) let it through, whatever was cut out of it later."""
        return self.is_reported if self.is_withdrawn is None else self.is_reported | self.is_withdrawn

    def __post_init__(self) -> None:
        n = len(self.scores)
        if self.is_withdrawn is not None:
            require_shape("is_withdrawn", self.is_withdrawn, (n,))
            if (self.is_withdrawn & self.is_reported).any():
                raise ValueError("is_withdrawn and is_reported: a region is one or the other")
        if self.direction is not None:
            require_shape("direction", self.direction, (n,))
            if self.direction.dtype != np.uint8 or (self.direction > 1).any():
                raise ValueError("direction must be uint8: 0 for a before keyframe that was looked up, 1 for an after")
        require_shape("centres_map", self.centres_map, (n, 3))
        require_shape("pairs", self.pairs, (n, 2))
        require_shape("is_reported", self.is_reported, (n,))
        if self.is_reported.dtype != np.bool_:
            raise ValueError(f"is_reported must be a boolean mask, got {self.is_reported.dtype}")
        if (np.diff(self.scores) > 0).any():
            raise ValueError("scores must fall: best candidate first")


@dataclass(frozen=True, slots=True, eq=False)
class ObjectShape:
    """How large an object is and how it stands, map frame.

    Attributes:
        map_T_box: (4, 4) pose of the oriented box around it: its centre, and its edges as axes; one axis is vertical.
        box_m: (3,) edges of that box, metres; the vertical one last.
        volume_m3: What it takes up above the surface it stands on, as far as it was seen.
    """

    map_T_box: Float64Array
    box_m: Float64Array
    volume_m3: float

    def __post_init__(self) -> None:
        require_poses("map_T_box", self.map_T_box[None])
        require_shape("box_m", self.box_m, (3,))


@dataclass(frozen=True, slots=True, eq=False)
class ChangedObject:
    """One object that is in one session and not in the other.

    Attributes:
        session: The session whose returns it is made of.
        kind: What happened to it.
        region: Index of the region it was found in, -1 for methods without regions.
        returns: (M, 2) int32 (scan, pixel) of its returns.
        points_map: (P, 3) its thinned points, map frame, metres.
        score: Larger means surer.
        partner: Index of the other half of a moved object in the report, or -1.
        shape: Boxes and volume; None in a foreign answer that does not tell.
        displacement_map: (3,) from where a moved object stood to where it stands, map frame, metres; the same in both
            halves, None for what was not moved.
    """

    session: SessionName
    kind: Kind
    region: int
    returns: Int32Array
    points_map: Float64Array
    score: float
    partner: int = -1
    shape: ObjectShape | None = None
    displacement_map: Float64Array | None = None

    def __post_init__(self) -> None:
        require_shape("returns", self.returns, (None, 2))
        require_shape("points_map", self.points_map, (None, 3))
        if self.displacement_map is not None:
            require_shape("displacement_map", self.displacement_map, (3,))


@dataclass(frozen=True, slots=True, eq=False)
class ChangeReport:
    """The whole answer for one pair of sessions.

    Attributes:
        before_T_after: (4, 4) the merge that was used.
        evidence: What the merge measured.
        regions: All candidates.
        objects: What was cut out of the reported regions.
        seconds: Wall-clock seconds per stage (`t_merge_s`, `t_cd_s`, `t_oe_s`, `t_descriptor_s`).
        figures: (R,) value of each row of the paper's Table II per region, by column name; NaN where not reported.
        keyframe_scans: Scans of the before and of the after keyframes that `regions.pairs` index.
        config: The effective settings.
        local_before_T_after: (Ka, 4, 4) the merge as refined at each after keyframe; None where `before_T_after` holds
            everywhere.
    """

    before_T_after: Float64Array
    evidence: Mapping[str, float]
    regions: ChangeRegions
    objects: tuple[ChangedObject, ...]
    seconds: Mapping[str, float]
    figures: Mapping[str, Float64Array]
    keyframe_scans: tuple[Int64Array, Int64Array]
    config: Mapping[str, object] = field(default_factory=dict)
    local_before_T_after: Float64Array | None = None
