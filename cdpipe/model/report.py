"""The answer of a method: regions, objects, and all that was measured on the way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array, Int32Array, Int64Array, require_poses, require_shapes, yaw_rad
from cdpipe.model.types import Kind, SessionName, UInt8Array

if TYPE_CHECKING:
    import pandas as pd


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
        require_shapes(self, centres_map=(n, 3), pairs=(n, 2), is_reported=(n,), is_withdrawn=(n,), direction=(n,))
        if self.is_reported.dtype != np.bool_:
            raise ValueError(f"is_reported must be a boolean mask, got {self.is_reported.dtype}")
        if self.is_withdrawn is not None and (self.is_withdrawn & self.is_reported).any():
            raise ValueError("is_withdrawn and is_reported: a region is one or the other")
        if self.direction is not None and (self.direction.dtype != np.uint8 or (self.direction > 1).any()):
            raise ValueError("direction must be uint8: 0 for a before keyframe that was looked up, 1 for an after")
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
        require_shapes(self, box_m=(3,))


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
        require_shapes(self, returns=(None, 2), points_map=(None, 3), displacement_map=(3,))


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

    def to_pandas(self, table: Literal["objects", "regions"] = "objects") -> pd.DataFrame:
        """Return the objects or the reported regions as a table; positions in the map frame, metres.

        `objects`: one row per object: what happened to it, centroid and corners of its points, centre, level edges (the
        longer one is the length), height and yaw of its upright box, volume, and how far a moved one went. What is not
        known is empty.

        `regions`: one row per region that the threshold let through, best first. A withdrawn region does not stand in
        the answer: nothing could be cut out of it.

        Raises:
            ValueError: There is no such table.
        """
        import pandas as pd  # noqa: PLC0415 - importing cdpipe must stay fast

        if table not in ("objects", "regions"):
            raise ValueError(f"table must be 'objects' or 'regions', got {table!r}")
        if table == "regions":
            return pd.DataFrame(_region_columns(self))
        return pd.DataFrame(
            [_object_row(index, item) for index, item in enumerate(self.objects)], columns=_OBJECT_COLUMNS
        )


_AXES = "xyz"
_OBJECT_COLUMNS = [
    *("object", "session", "kind", "partner", "region", "score", "n_returns", "n_points"),
    *(f"{axis}_m" for axis in _AXES),
    *(f"{end}_{axis}_m" for end in ("min", "max") for axis in _AXES),
    *(f"box_{axis}_m" for axis in _AXES),
    *("box_length_m", "box_width_m", "box_height_m", "box_yaw_deg", "volume_m3"),
    *(f"displacement_{axis}_m" for axis in _AXES),
]


def _region_columns(report: ChangeReport) -> dict[str, object]:
    regions = report.regions
    shown = np.flatnonzero(regions.is_proposed)
    return {
        "region": shown,
        "score": regions.scores[shown],
        "is_withdrawn": ~regions.is_reported[shown],
        **{f"{axis}_m": regions.centres_map[shown, k] for k, axis in enumerate(_AXES)},
        **{name: values[shown] for name, values in report.figures.items()},
    }


def _object_row(index: int, item: ChangedObject) -> tuple[object, ...]:
    points = item.points_map if len(item.points_map) else np.full((1, 3), np.nan)
    identity = index, item.session, item.kind, item.partner, item.region, item.score
    counts = len(item.returns), len(item.points_map)
    corners = *points.mean(axis=0), *points.min(axis=0), *points.max(axis=0)
    shift = np.full(3, np.nan) if item.displacement_map is None else item.displacement_map
    return (*identity, *counts, *corners, *_box_row(item.shape), *shift)


def _box_row(shape: ObjectShape | None) -> tuple[float, ...]:
    """Return centre (3,), edges (3,), yaw in degrees and volume, NaN where nothing is known."""
    if shape is None:
        return (np.nan,) * 8
    yaw_deg = float(np.rad2deg(yaw_rad(shape.map_T_box)))
    return (*shape.map_T_box[:3, 3], *shape.box_m, yaw_deg, shape.volume_m3)
