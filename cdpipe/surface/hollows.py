"""Area and volume of rock that left a hollow behind, of which a session sees the rim and only a part of the bottom.

A sensor looks into a hollow of the roof at a flat angle, so most of its bottom is hidden. The hidden bottom is taken
from the convex hull of what was seen: a hollow bulges into the rock. Both surfaces are heights over one plane, the
chart of the region. Where next to nothing is hidden, the sum over the places is the better figure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError, cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int32Array, Int64Array
from cdpipe.model.report import SurfaceRegion
from cdpipe.surface.cells import SurfaceCells
from cdpipe.surface.offsets import NEW
from cdpipe.surface.places import SurfacePlaces
from cdpipe.surface.regions import sort_regions

# Faces of the hull that stand up so steeply are its sides: part of their normal along that of the chart.
_STEEP = 1e-3
# Edge of a pixel of the chart, and the width of the rim around the region. The chart of a region that many times as
# long as wide is turned along it.
_PIXEL_M, _RIM_M, _LONG = 0.1, 0.6, 2.0
# Least share of the area of a hollow without a displacement. Below it, the sum over the places stays.
_HIDDEN = 0.01
# A pixel farther than this from every place of the same wall is beside the wall, behind another one.
_ON_WALL_M = 0.2
# Rock with a normal farther from that of the region is another wall (cosine). A region with less than that share of its
# places on one wall has no chart.
_SAME_WALL, _ON_CHART = 0.2, 0.8
# A region without a place that deep is no hollow: the sum over its places is exact. In a pixel that reaches so deep,
# the cells at less than that share of its depth lie on the side of the hollow.
_DEEP_M, _BOTTOM = 0.1, 0.5
# Cells at these depths are of the hollow, or of the rock around it.
_IN_FRONT_M, _DEEPEST_M = 0.15, 5.0
_LEAST_DEPTH_M = 0.02
# A place that far in front of another one beside it is not of the wall.
_BESIDE_M, _STANDS_OUT_M = 0.25, 0.4
# A height between points is the mean of so many nearest, each weighted by the inverse square of its distance.
_NEAREST = 4
_NEAR_M = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class _Chart:
    """A plane with pixels: (3, 3) axes as rows, the third into the void; low corner; rows and columns."""

    origin: Float64Array
    axes: Float64Array
    low: Float64Array
    shape: tuple[int, int]

    def place(self, points: Float64Array) -> Float64Array:
        """Return the (N, 3) coordinates of points on the chart, metres from its low corner."""
        return np.asarray((points - self.origin) @ self.axes.T - np.append(self.low, 0.0))

    def is_on(self, placed: Float64Array, margin_m: float = 0.0) -> BoolArray:
        """Mark the (N,) points above or below the chart."""
        high = _PIXEL_M * np.asarray(self.shape)
        return np.asarray(((placed[:, :2] > -margin_m) & (placed[:, :2] < high + margin_m)).all(axis=1))

    def pixels(self, placed: Float64Array) -> Int64Array:
        """Return the (N,) pixel that holds each point on the chart."""
        row, column = np.floor(placed[:, :2] / _PIXEL_M).astype(np.int64).T
        return np.asarray(row * self.shape[1] + column)

    @property
    def reach_m(self) -> float:
        """Distance from the origin of everything above or below the chart that counts."""
        return float(np.hypot(_PIXEL_M * np.hypot(*self.shape) + _RIM_M, _DEEPEST_M))

    @property
    def middles(self) -> Float64Array:
        """(P, 2) middles of the pixels."""
        return np.asarray(_PIXEL_M * (np.indices(self.shape).reshape(2, -1).T + 0.5))


def measure_hollows(
    regions: tuple[SurfaceRegion, ...],
    region: Int32Array,
    before: SurfaceCells,
    places: SurfacePlaces,
    is_hidden: BoolArray,
    after: SurfaceCells,
) -> tuple[Int32Array, tuple[SurfaceRegion, ...]]:
    """Return the region of each place and the regions anew, partly hidden hollows with the figures of their charts.

    Args:
        regions: Regions of displacement.
        region: (Q,) region of each place, -1 for none.
        before: Cells of the before session.
        places: Places on them.
        is_hidden: (Q,) whether nothing tells the displacement of a place.
        after: Cells of the after session.
    """
    measured, tree = list(regions), cKDTree(places.points)
    for index, each in enumerate(regions):
        members = np.flatnonzero(region == index)
        found = _measure_hollow(before, places, tree, members, is_hidden, after) if is_hollow(each) else None
        if found is not None:
            area_m2, volume_m3 = found
            mean_m = -volume_m3 / area_m2
            largest_m = min(each.largest_m, mean_m)  # the deepest may be hidden
            measured[index] = replace(each, area_m2=area_m2, volume_m3=-volume_m3, mean_m=mean_m, largest_m=largest_m)
    return sort_regions(region, measured)


def is_hollow(region: SurfaceRegion) -> bool:
    """Tell whether rock left a region so deep that its bottom may be hidden."""
    return region.largest_m < -_DEEP_M


def _measure_hollow(
    before: SurfaceCells,
    places: SurfacePlaces,
    tree: cKDTree,
    members: Int64Array,
    is_hidden: BoolArray,
    after: SurfaceCells,
) -> tuple[float, float] | None:
    """Return area and volume of one hollow; None where its places have no chart, or next to nothing of it is hidden."""
    normal = places.normals[members].mean(axis=0)
    is_flat = places.normals[members] @ normal > _SAME_WALL * np.linalg.norm(normal)
    if is_flat.mean() < _ON_CHART:
        return None
    members = members[is_flat]
    chart = _make_chart(places.points[members], normal / np.linalg.norm(normal))
    around = np.asarray(tree.query_ball_point(chart.origin, chart.reach_m), dtype=np.int64)
    around = around[places.normals[around] @ chart.axes[2] > _SAME_WALL]
    walls = chart.place(places.points[around])
    blind = around[is_hidden[around] & chart.is_on(walls)]
    if len(blind) == 0:
        return None
    cells = after.points[after.tree.query_ball_point(chart.origin, chart.reach_m)]
    try:
        depth_m = _find_depths(chart, before, walls, cells)
        is_own = _outline(chart, depth_m, walls, places.points[members])
        blind = blind[is_own[chart.pixels(chart.place(places.points[blind]))]]
        blind_m2 = float(places.areas_m2[blind].sum())
        if blind_m2 < _HIDDEN * (blind_m2 + float(places.areas_m2[members].sum())):
            return None
        hidden, seen = (np.flatnonzero(is_own & is_part) for is_part in (np.isnan(depth_m), np.isfinite(depth_m)))
        if len(hidden) > 0 and len(seen) > 0:
            depth_m[hidden] = _span_hull(chart.middles, depth_m, seen, hidden)
    except QhullError:  # too few pixels, or all on a line
        return None
    area_m2 = _PIXEL_M**2 * float(np.count_nonzero(is_own))
    return (area_m2, _PIXEL_M**2 * float(depth_m[is_own].sum())) if area_m2 > 0 else None


def _make_chart(points: Float64Array, normal: Float64Array) -> _Chart:
    """Return the chart across a unit normal that holds the (N, 3) points and a rim; a long one is turned along them."""
    origin = points.mean(axis=0)
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    axes = np.stack([first / np.linalg.norm(first), np.cross(normal, first / np.linalg.norm(first)), normal])
    on = (points - origin) @ axes[:2].T
    (across, along), turn = np.linalg.eigh(on.T @ on)
    if along > _LONG**2 * across:
        axes[:2] = turn.T @ axes[:2]
    on = (points - origin) @ axes[:2].T
    low, high = on.min(axis=0) - _RIM_M, on.max(axis=0) + _RIM_M
    rows, columns = np.ceil((high - low) / _PIXEL_M).astype(int)
    return _Chart(origin, axes, low, (int(rows), int(columns)))


def _find_depths(chart: _Chart, before: SurfaceCells, walls: Float64Array, after: Float64Array) -> Float64Array:
    """Return the (P,) depth of the (C, 3) after cells below the (N, 3) walls, on the chart, in each pixel; else NaN."""
    cells = chart.place(after)
    is_over = chart.is_on(cells)
    cells, off_m = cells[is_over], before.tree.query(after[is_over])[0]
    depths_m = _height(_rearmost(walls[chart.is_on(walls, _RIM_M)]), cells) - cells[:, 2]
    is_its = (depths_m > -_IN_FRONT_M) & (depths_m < _DEEPEST_M) & ((depths_m < _DEEP_M) | (off_m > NEW * depths_m))
    pixel, depths_m, n = chart.pixels(cells[is_its]), depths_m[is_its], chart.shape[0] * chart.shape[1]
    deepest_m = np.full(n, -np.inf)
    np.maximum.at(deepest_m, pixel, depths_m)
    is_bottom = (deepest_m[pixel] < _DEEP_M) | (depths_m > _BOTTOM * deepest_m[pixel])
    with np.errstate(invalid="ignore"):
        return np.asarray(np.bincount(pixel, depths_m * is_bottom, n) / np.bincount(pixel, is_bottom, n))


def _rearmost(placed: Float64Array) -> Float64Array:
    """Return the (N, 3) places on a chart without those that have rock behind them: a duct in front of a wall."""
    pairs = cKDTree(placed[:, :2]).query_pairs(_BESIDE_M, output_type="ndarray")
    in_front_m = placed[pairs[:, 0], 2] - placed[pairs[:, 1], 2]
    is_front = np.zeros(len(placed), dtype=np.bool_)
    is_front[pairs[in_front_m > _STANDS_OUT_M, 0]] = True
    is_front[pairs[in_front_m < -_STANDS_OUT_M, 1]] = True
    return placed[~is_front]


def _height(points: Float64Array, at: Float64Array) -> Float64Array:
    """Return the (N,) height at places of the chart, of the (M, 3) points about them; NaN where none is near."""
    distance_m, index = cKDTree(points[:, :2]).query(at[:, :2], k=[*range(1, min(_NEAREST, len(points)) + 1)])
    weights = 1.0 / (np.asarray(distance_m) ** 2 + _PIXEL_M**2)
    heights_m = (weights * points[index, 2]).sum(axis=1) / weights.sum(axis=1)
    return np.asarray(np.where(np.asarray(distance_m)[:, 0] < _NEAR_M, heights_m, np.nan))


def _outline(chart: _Chart, depth_m: Float64Array, walls: Float64Array, members: Float64Array) -> BoolArray:
    """Mark the (P,) pixels of the hollow: deep ones of the wall that hang together and hold a place of the region."""
    seen, hidden = np.flatnonzero(np.isfinite(depth_m)), np.flatnonzero(np.isnan(depth_m))
    if len(seen) == 0:
        return np.zeros(len(depth_m), dtype=np.bool_)
    guess_m = depth_m.copy()
    guess_m[hidden] = _height(np.column_stack([chart.middles[seen], depth_m[seen]]), chart.middles[hidden])
    is_on_wall = cKDTree(walls[:, :2]).query(chart.middles, distance_upper_bound=_ON_WALL_M)[0] < _ON_WALL_M
    labels = ndimage.label((is_on_wall & (guess_m > _LEAST_DEPTH_M)).reshape(chart.shape))[0].ravel()
    own = np.unique(labels[chart.pixels(chart.place(members))])
    return np.isin(labels, own[own > 0])


def _span_hull(middles: Float64Array, depth_m: Float64Array, seen: Int64Array, hidden: Int64Array) -> Float64Array:
    """Return the (H,) depths of the convex hull of the seen pixels, below the hidden ones."""
    planes = ConvexHull(np.column_stack([middles[seen], depth_m[seen]])).equations
    planes = planes[planes[:, 2] > _STEEP]  # the side of the rock
    depths_m = -(middles[hidden] @ planes[:, :2].T + planes[:, 3]) / planes[:, 2]
    return np.asarray(np.clip(depths_m.min(axis=1), 0.0, depth_m[seen].max()))
