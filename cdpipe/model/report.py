"""The answer of a method: regions, objects, times and measurements."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array, Int32Array, Int64Array, require_poses, require_shapes, yaw_rad
from cdpipe.model.sentence import tell
from cdpipe.model.types import Kind, SessionName, UInt8Array

if TYPE_CHECKING:
    import pandas as pd


# No displacement of the rock may be larger: the search for the after surface ends there.
MAX_DISPLACEMENT_M = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Clusters:
    """Groups of new map points that a source of regions cut out itself; C of them, N points in all.

    Attributes:
        is_after: (C,) whether the points are of the after map.
        points: (N,) int64 indices of map points, cluster by cluster.
        starts: (C + 1,) int64 first of the N points of each cluster, and N.
    """

    is_after: BoolArray
    points: Int64Array
    starts: Int64Array

    def __post_init__(self) -> None:
        require_shapes(self, is_after=(len(self.starts) - 1,), points=(int(self.starts[-1]),))


@dataclass(frozen=True, slots=True, eq=False)
class ChangeRegions:
    """Every candidate sphere, best first, and the score of every before keyframe.

    Attributes:
        centres_map: (R, 3) sphere centres, map frame, metres.
        radius_m: Radius of all spheres, metres; or (R,) float64 radius of each, where it follows the drift's width.
        scores: (R,) change score, falling; a larger score means a surer change.
        pairs: (R, 2) int64 before and after keyframe of each.
        is_reported: (R,) whether the region is in the answer: it passed the threshold (or the fixed number of regions),
            or is forced, and was not withdrawn.
        keyframe_scores: (K,) score of every before keyframe, NaN if the after session never came near.
        is_withdrawn: (R,) whether the region passed the threshold but contains no object, or none that a better region
            does not contain; None if none was withdrawn.
        direction: (R,) uint8 session whose keyframe was queried in the other session: 0 before, 1 after. The proposed
            centre is the position of that keyframe. None for methods that query no keyframes.
        proposed_centres_map: (R, 3) centres at which the regions were proposed, before the reported ones were centred
            on their objects; None if no region was centred.
        is_forced: (R,) whether the region is looked at whatever the threshold; None if none is.
        clusters: What the source itself cut out, for `extract.method: clusters`; None of a source that finds places
            alone, and in an answer.
    """

    centres_map: Float64Array
    radius_m: float | Float64Array
    scores: Float64Array
    pairs: Int64Array
    is_reported: BoolArray
    keyframe_scores: Float64Array
    is_withdrawn: BoolArray | None = None
    direction: UInt8Array | None = None
    proposed_centres_map: Float64Array | None = None
    is_forced: BoolArray | None = None
    clusters: Clusters | None = None

    @property
    def is_proposed(self) -> BoolArray:
        """(R,) whether the region passed the threshold (or the fixed number), withdrawn or not."""
        return self.is_reported if self.is_withdrawn is None else self.is_reported | self.is_withdrawn

    @property
    def radii_m(self) -> Float64Array:
        """(R,) radius of each sphere, metres."""
        return np.broadcast_to(np.asarray(self.radius_m, dtype=np.float64), len(self.scores))

    def __post_init__(self) -> None:
        n = len(self.scores)
        require_shapes(self, centres_map=(n, 3), pairs=(n, 2), is_reported=(n,), is_withdrawn=(n,), direction=(n,))
        require_shapes(self, proposed_centres_map=(n, 3), is_forced=(n,))
        if isinstance(self.radius_m, np.ndarray):
            require_shapes(self, radius_m=(n,))
        if self.is_reported.dtype != np.bool_:
            raise ValueError(f"is_reported must be a boolean mask, got {self.is_reported.dtype}")
        if self.is_withdrawn is not None and (self.is_withdrawn & self.is_reported).any():
            raise ValueError("is_withdrawn and is_reported: a region is one or the other")
        if self.direction is not None and (self.direction.dtype != np.uint8 or (self.direction > 1).any()):
            raise ValueError("direction must be uint8: 0 for a queried before keyframe, 1 for an after keyframe")
        if (self.scores[1:] > self.scores[:-1]).any():
            raise ValueError("scores must fall: best candidate first")


@dataclass(frozen=True, slots=True, eq=False)
class ObjectShape:
    """Size and pose of an object, map frame.

    Attributes:
        map_T_box: (4, 4) pose of its oriented box: the centre, and the edges as axes; one axis is vertical.
        box_m: (3,) edges of that box, metres; the vertical one last.
        volume_m3: Volume of its observed part above the surface it stands on.
    """

    map_T_box: Float64Array
    box_m: Float64Array
    volume_m3: float

    def __post_init__(self) -> None:
        require_poses("map_T_box", self.map_T_box[None])
        require_shapes(self, box_m=(3,))


@dataclass(frozen=True, slots=True, eq=False)
class ChangedObject:
    """One object that is in one session and not in the other.

    Attributes:
        session: The session that holds its returns.
        kind: Added, removed, moved or reshaped.
        region: Index of its region, -1 for methods without regions.
        returns: (M, 2) int32 (scan, pixel) of its returns.
        points_map: (P, 3) its thinned points, map frame, metres.
        score: A larger score means a surer change.
        partner: Index in the report of the other half of a moved object, or -1.
        shape: Box and volume; None if a foreign answer does not contain them.
        displacement_map: (3,) displacement of a moved object from before to after, map frame, metres; the same in both
            halves, None if not moved.
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
        require_shapes(self, returns=(None, 2), points_map=(None, 3), displacement_map=(3,))


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceRegion:
    """A connected part of the rock that moved, came or went.

    Attributes:
        centre_map: (3,) its middle, map frame, metres.
        area_m2: Area of the before surface that it covers.
        volume_m3: Displacement times area, summed: positive where rock came into the void.
        mean_m: Mean displacement, weighted by area.
        largest_m: Displacement of the largest magnitude, with its sign.
    """

    centre_map: Float64Array
    area_m2: float
    volume_m3: float
    mean_m: float
    largest_m: float

    def __post_init__(self) -> None:
        require_shapes(self, centre_map=(3,))


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceField:
    """How far the surface of the rock moved from before to after, at points of the before surface.

    Attributes:
        points_map: (Q, 3) points on the before surface, map frame, metres.
        normals_map: (Q, 3) unit normal of the surface at each, into the void.
        displacement_m: (Q,) displacement along the normal, positive into the void; NaN where it was not measured.
        level_m: (Q,) 95 % level of detection, NaN if unknown: where rock did not move, 19 in 20 displacements are
            smaller.
        region: (Q,) int32 index of the point's region, -1 for none.
        regions: The regions that moved.
        chainage_m: (Q,) way along the before path, metres; None if not stated.
        angle_deg: (Q,) angle about the path: 0 the crown of the roof, 90 the left wall, -90 the right wall, 180 the
            floor; None if not stated.
    """

    points_map: Float64Array
    normals_map: Float64Array
    displacement_m: Float64Array
    level_m: Float64Array
    region: Int32Array
    regions: tuple[SurfaceRegion, ...] = ()
    chainage_m: Float64Array | None = None
    angle_deg: Float64Array | None = None

    def __post_init__(self) -> None:
        n = len(self.displacement_m)
        require_shapes(self, points_map=(n, 3), normals_map=(n, 3), level_m=(n,), region=(n,))
        require_shapes(self, chainage_m=(n,), angle_deg=(n,))
        if not np.issubdtype(self.region.dtype, np.integer):
            raise ValueError(f"region must be whole numbers, got {self.region.dtype}")
        if (self.region < -1).any() or (self.region >= len(self.regions)).any():
            raise ValueError(f"region must be -1 or the index of one of {len(self.regions)} regions")


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """How much of the before path was compared: the after session came within 5 m.

    Attributes:
        compared_m: Metres of the before path that were compared.
        unseen_m: Metres of the before path that were not.
        is_near: (S,) whether the after session came near each scan of the before session.
    """

    compared_m: float
    unseen_m: float
    is_near: BoolArray

    def __post_init__(self) -> None:
        require_shapes(self, is_near=(None,))


@dataclass(frozen=True, slots=True, eq=False)
class ChangeReport:
    """The whole answer for one pair of sessions; `str(report)` is one sentence about it.

    Attributes:
        before_T_after: (4, 4) the merge that was used, between the odom frames as recorded; of one that varies along
            the path the rigid transform that fits it best.
        evidence: What the merge measured.
        regions: All candidates.
        objects: Objects extracted from the reported regions.
        seconds: Wall-clock seconds per stage (`t_merge_s`, `t_cd_s`, `t_oe_s`, `t_descriptor_s`).
        figures: (R,) value of each row of the paper's Table II per region, by column name, NaN if not reported; and
            `asked_points`, the before map's points in the sphere of each candidate as it was proposed.
        keyframe_scans: Scans of the before and of the after keyframes that `regions.pairs` indexes.
        config: The effective settings.
        local_before_T_after: (Ka, 4, 4) refined alignment at each after keyframe; None if `before_T_after` holds
            everywhere.
        checkpoints: Digest of the weights of each descriptor that was used, by its name.
        extras: Version of each optional package that the answer depends on; "absent" if it was wanted in vain.
        surface: How far the rock moved; None where it was not asked for.
        coverage: How much of the before path was compared, as `detect` measures it; no file holds it, and
            `cdpipe.merge.coverage.measure_coverage` measures it from the paths of both sessions.
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
    checkpoints: Mapping[str, str] = field(default_factory=dict)
    extras: Mapping[str, str] = field(default_factory=dict)
    surface: SurfaceField | None = None
    coverage: Coverage | None = None

    def __str__(self) -> str:
        """Return one sentence, e.g. `5 added, 1 moved 2.3 m, 2 removed; 410 m compared, 35 m not seen`."""
        return tell(self)

    def to_pandas(self, table: Literal["objects", "regions", "surface"] = "objects") -> pd.DataFrame:
        """Return the objects, the reported regions or the rock as a table; positions in the map frame, metres.

        `objects`: one row per object: kind, centroid and corners of its points, centre, horizontal edges (the longer
        one is the length), height and yaw of its upright box, volume, and displacement if moved. Unknown values are
        empty.

        `regions`: one row per region that passed the threshold, best first. A withdrawn region contains no object, or
        none that a better region does not contain, and is not in the answer.

        `surface`: one row per metre of chainage and sector of the section, 45 degrees each, in which places were
        measured: their number, mean and largest displacement (positive into the void), the median of their 95 % levels
        of detection, the share of places beyond it, and how many lie in regions that moved.

        Raises:
            ValueError: There is no such table, or the answer has no displacement with its chainage and angle.
        """
        import pandas as pd  # noqa: PLC0415 - importing cdpipe must stay fast

        if table not in ("objects", "regions", "surface"):
            raise ValueError(f"table must be 'objects', 'regions' or 'surface', got {table!r}")
        if table == "surface":
            return _tabulate_surface(self.surface)
        if table == "objects":
            rows = [_object_row(index, item) for index, item in enumerate(self.objects)]
            return pd.DataFrame(rows, columns=_OBJECT_COLUMNS)
        shown = np.flatnonzero(self.regions.is_proposed)
        columns = {"score": self.regions.scores, "is_withdrawn": ~self.regions.is_reported}
        columns |= {f"{axis}_m": self.regions.centres_map[:, k] for k, axis in enumerate(_AXES)} | dict(self.figures)
        columns["radius_m"] = self.regions.radii_m
        if self.regions.is_forced is not None:
            columns["is_forced"] = self.regions.is_forced
        return pd.DataFrame({"region": shown, **{name: values[shown] for name, values in columns.items()}})


_AXES = "xyz"
_OBJECT_COLUMNS = [
    *("object", "session", "kind", "partner", "region", "score", "n_returns", "n_points"),
    *(f"{axis}_m" for axis in _AXES),
    *(f"{end}_{axis}_m" for end in ("min", "max") for axis in _AXES),
    *(f"box_{axis}_m" for axis in _AXES),
    *("box_length_m", "box_width_m", "box_height_m", "box_yaw_deg", "volume_m3"),
    *(f"displacement_{axis}_m" for axis in _AXES),
]


_SECTORS = ("crown", "left shoulder", "left wall", "left foot", "floor", "right foot", "right wall", "right shoulder")
_SECTOR_DEG = 360 / len(_SECTORS)


def _tabulate_surface(surface: SurfaceField | None) -> pd.DataFrame:
    import pandas as pd  # noqa: PLC0415 - importing cdpipe must stay fast

    if surface is None or surface.chainage_m is None or surface.angle_deg is None:
        raise ValueError("surface: the answer has no displacement of the rock with chainage and angle")
    known = np.flatnonzero(np.isfinite(surface.displacement_m))
    values_m, levels_m = surface.displacement_m[known], surface.level_m[known]
    sector = np.round(surface.angle_deg[known] / _SECTOR_DEG).astype(np.int64) % len(_SECTORS)
    metre = np.floor(surface.chainage_m[known]).astype(np.int64)
    cells, cell = np.unique(np.column_stack([metre, sector]), axis=0, return_inverse=True)
    rows = []
    for number, (start_m, which) in enumerate(cells.tolist()):
        own = np.flatnonzero(cell.reshape(-1) == number)
        largest = own[np.argmax(np.abs(values_m[own]))]
        sure = own[np.isfinite(levels_m[own])]  # a place without a level tells of no share
        level_m = np.median(levels_m[sure]) if len(sure) else np.nan
        beyond = (np.abs(values_m[sure]) > levels_m[sure]).mean() if len(sure) else np.nan
        measured = values_m[own].mean(), values_m[largest], level_m
        in_regions = (surface.region[known[own]] >= 0).sum()
        rows.append((start_m, start_m + 1, _SECTORS[which], len(own), *measured, beyond, in_regions))
    return pd.DataFrame(rows, columns=_SURFACE_COLUMNS)


_SURFACE_COLUMNS = [
    *("chainage_from_m", "chainage_to_m", "sector", "n_places", "mean_displacement_m", "largest_displacement_m"),
    *("median_level_m", "share_beyond_level", "n_places_in_regions"),
]


def _object_row(index: int, item: ChangedObject) -> tuple[object, ...]:
    points = item.points_map if len(item.points_map) else np.full((1, 3), np.nan)
    identity = index, item.session, item.kind, item.partner, item.region, item.score
    counts = len(item.returns), len(item.points_map)
    corners = *points.mean(axis=0), *points.min(axis=0), *points.max(axis=0)
    shift = np.full(3, np.nan) if item.displacement_map is None else item.displacement_map
    return (*identity, *counts, *corners, *_box_row(item.shape), *shift)


def _box_row(shape: ObjectShape | None) -> tuple[float, ...]:
    """Return centre (3,), edges (3,), yaw in degrees and volume; NaN without a shape."""
    if shape is None:
        return (np.nan,) * 8
    yaw_deg = float(np.rad2deg(yaw_rad(shape.map_T_box)))
    return (*shape.map_T_box[:3, 3], *shape.box_m, yaw_deg, shape.volume_m3)
