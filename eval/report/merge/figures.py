"""The picture of a merge: the aligned maps coloured by the distance between their surfaces."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.patches import Rectangle
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array
from eval.core.charts import BLACK, VERMILLION
from eval.core.figures import blank_figure, data_address
from eval.report.maps import Points, Raster, bulk_mask, draw_colour_bar, draw_subset, style_map_axes

FULL_M = 0.3
STRETCH_M = 16.0
_UNSEEN_M = 1.0
_MAX_DRAWN = 120_000
_NEIGHBOURS = 6
_SQUARE_M = 8.0
_MARGINS_M = (-0.5, 0.5, -0.5, 0.5)
_WIDTH_IN = 9.0
_COLOURS = LinearSegmentedColormap.from_list(
    "gap", [(0.0, "#dfe7ee"), (0.2, "#a9c6dc"), (0.4, "#f3d9a4"), (0.65, VERMILLION), (1.0, "#6d0f00")]
)
_UNSEEN = "#ececec"


def surface_distances(before: Points, points: Points) -> Float64Array:
    """Return the distance of (N, 3) points to the surface that (M, 3) points of the before map sample, metres.

    It is the distance to the plane through the six nearest points, because two maps thinned to 0.2 m are 7 cm from each
    other's nearest point even where they fit exactly. Beyond 0.3 m it is the distance to the nearest point.
    """
    nearest_m, index = (
        np.asarray(found)
        for found in cKDTree(before, compact_nodes=False, balanced_tree=False).query(
            points, k=[*range(1, min(_NEIGHBOURS, len(before)) + 1)]
        )
    )
    distances_m = nearest_m[:, 0].copy()
    near = np.flatnonzero(distances_m < FULL_M)
    patches = before[index[near]].astype(np.float64)
    centres = patches.mean(axis=1)
    offsets = patches - centres[:, None]
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
    to_plane_m = np.abs(np.einsum("ni,ni->n", points[near] - centres, axes[:, :, 0]))
    distances_m[near] = np.minimum(to_plane_m, distances_m[near])
    return distances_m


def worst_stretch(points: Points, distances_m: Float64Array) -> tuple[float, float] | None:
    """Return the middle (x, y) of the place that both sessions saw and that fits worst.

    Places are squares of 8 m. The worst has the greatest median distance of its points. A square counts if it holds at
    least half the median number of points and most of them have a before point within 1 m. None where no square counts.
    """
    _, square, counts = np.unique(
        np.floor(points[:, :2] / _SQUARE_M).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    order = np.argsort(square.ravel(), kind="stable")
    best, place = -1.0, None
    for own in np.split(order, np.cumsum(counts)[:-1]):
        seen = own[distances_m[own] < _UNSEEN_M]
        if len(own) < np.median(counts) / 2 or len(seen) <= len(own) / 2:
            continue
        value = float(np.median(distances_m[seen]))
        if value > best:
            middle = points[own, :2].mean(axis=0)
            best, place = value, (float(middle[0]), float(middle[1]))
    return place


def alignment_picture(before: Points, aligned: Points) -> str:
    """Draw the aligned after map seen from above, coloured by its distance to the before map, and where it fits worst.

    Args:
        before: (N, 3) points of the before map, metres.
        aligned: (M, 3) points of the after map in the map frame; a fixed random subset of a large map is drawn.
    """
    raster = Raster.around(before, aligned)
    aligned = draw_subset(aligned[bulk_mask(aligned[:, :2])], _MAX_DRAWN)
    distances_m = surface_distances(before, aligned)
    before = draw_subset(before[bulk_mask(before[:, :2])], _MAX_DRAWN)
    worst = worst_stretch(aligned, distances_m)
    farthest_on_top = np.argsort(distances_m)
    aligned, distances_m = aligned[farthest_on_top], distances_m[farthest_on_top]
    left, right, bottom, top = raster.extent if worst is None else _around_both(raster.extent, _around(worst))
    aspect = (right - left) / (top - bottom)
    height_in = float(np.clip((_WIDTH_IN - 0.9) / (aspect + 1.0), 2.4, 4.4))
    figure = blank_figure(_WIDTH_IN, height_in + 1.1)
    whole, zoom = figure.subplots(1, 2, width_ratios=(float(np.clip(aspect, 0.7, 2.4)), 1.0))
    _points_from_above(whole, before, aligned, distances_m, (left, right, bottom, top))
    whole.set_title("whole map", fontsize=8)
    if worst is None:
        zoom.set_axis_off()
        zoom.text(0.5, 0.5, "the maps have\nno place in common", ha="center", va="center", fontsize=9)
    else:
        window = _around(worst)
        _points_from_above(zoom, before, aligned, distances_m, window)
        zoom.set_title(f"where it fits worst ({STRETCH_M:g} m)", fontsize=8)
        square = Rectangle(window[::2], STRETCH_M, STRETCH_M, fill=False, edgecolor=BLACK, linewidth=1.0)
        whole.add_patch(square)
    draw_colour_bar(
        figure, [whole, zoom], _COLOURS, FULL_M, "distance to the surface of the before map [m]", location="bottom",
        shrink=0.4, aspect=40,
    )  # fmt: skip
    return data_address(figure)


def _around(centre: tuple[float, float]) -> tuple[float, float, float, float]:
    """Left, right, bottom, top of the square that is shown enlarged."""
    half = STRETCH_M / 2
    return centre[0] - half, centre[0] + half, centre[1] - half, centre[1] + half


def _around_both(
    extent: tuple[float, float, float, float], square: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    """Left, right, bottom, top of the smallest window that shows the whole of both, the square's outline too."""
    left, right, bottom, top = (end + margin for end, margin in zip(square, _MARGINS_M, strict=True))
    return min(extent[0], left), max(extent[1], right), min(extent[2], bottom), max(extent[3], top)


def _points_from_above(
    axes: Axes, before: Points, after: Points, distances_m: Float64Array, window: tuple[float, float, float, float]
) -> None:
    """Draw the before map pale and the after map over it, in the order in which its points come."""
    left, right, bottom, top = window
    look: dict[str, Any] = {"s": float(np.clip(75.0 / max(right - left, top - bottom), 0.25, 6.0)), "linewidths": 0}
    axes.scatter(before[:, 0], before[:, 1], color=_UNSEEN, **look)
    axes.scatter(after[:, 0], after[:, 1], c=distances_m, cmap=_COLOURS, vmin=0.0, vmax=FULL_M, **look)
    axes.set(xlim=(left, right), ylim=(bottom, top))
    style_map_axes(axes)
