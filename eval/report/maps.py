"""Maps seen from above as PNG data addresses: both maps, the distances between them, and regions.

Points are counted in the cells of a raster, so the size of a picture does not grow with the number of points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, stream
from eval.core.charts import BLACK, BLUE, CONTEXT, GREEN, ORANGE, VERMILLION
from eval.core.figures import DPI, blank_figure, data_address

RED = "#C8102E"
BOTH = "#555555"
FAR_M = 1.0
_MAP_WIDTH_IN, _MAP_HEIGHT_IN = 9.0, 6.0
_SQUARE_M, _LEAST_IN_SQUARE = 4.0, 20
_MAX_TESTED = 250_000
_DASHED = (0, (3, 2))
_DISTANCE_COLOURS = LinearSegmentedColormap.from_list(
    # a thinned map is 0.2 m from itself: grey up to there
    "distance",
    [(0.0, "#d9d9d9"), (0.2, "#d4d0cb"), (0.45, "#f0b26b"), (0.7, VERMILLION), (1.0, "#7f1d00")],
)

State = Literal["found", "missed", "unobservable", "not scored"]
Points = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class TruthMark:
    """The true place of a change on the map: x, y in metres, its label and its outcome."""

    x_m: float
    y_m: float
    label: str
    state: State


@dataclass(frozen=True, slots=True)
class RegionMark:
    """A reported region on the map: its centre and radius in metres, and whether it finds no change."""

    x_m: float
    y_m: float
    radius_m: float
    is_false: bool


def overlay_map(before: Points, after: Points) -> str:
    """Draw two maps seen from above: before blue, after orange, dark where both have points.

    Args:
        before: (N, 3) points, metres.
        after: (M, 3) points, shown in the same axes.
    """
    raster = Raster.around(before, after)
    n_before, n_after = raster.count(before), raster.count(after)
    image = _tinted(n_before, BLUE) * (n_before > 0)[..., None]
    image = np.where(((n_after > 0) & (n_before == 0))[..., None], _tinted(n_after, ORANGE), image)
    image = np.where(((n_after > 0) & (n_before > 0))[..., None], _tinted(n_before + n_after, BOTH), image)
    figure, axes = _map_axes(raster)
    axes.imshow(_on_white(image, (n_before + n_after) > 0), extent=raster.extent, origin="lower")
    _legend(
        axes, [Patch(color=BLUE, label="before"), Patch(color=ORANGE, label="after"), Patch(color=BOTH, label="both")]
    )
    return data_address(figure)


def distance_map(before: Points, after: Points) -> str:
    """Draw the after map seen from above, coloured by the distance of its points to the before map.

    Args:
        before: (N, 3) points, metres.
        after: (M, 3) points in the same frame; a fixed random subset of a large map is tested.
    """
    raster = Raster.around(before, after)
    after = draw_subset(after, _MAX_TESTED)
    tree = cKDTree(before, compact_nodes=False, balanced_tree=False)
    distances = np.asarray(tree.query(after, distance_upper_bound=2 * FAR_M)[0])
    rows, columns, inside = raster.cells(after)
    farthest = np.full(raster.shape, -1.0)
    np.maximum.at(farthest, (rows, columns), np.minimum(distances[inside], FAR_M))
    image = _DISTANCE_COLOURS(np.clip(farthest / FAR_M, 0.0, 1.0))
    n_before = raster.count(before)
    image = np.where((farthest < 0)[..., None], _on_white(_tinted(n_before, CONTEXT), n_before > 0), image)
    figure, axes = _map_axes(raster)
    axes.imshow(image, extent=raster.extent, origin="lower")
    draw_colour_bar(
        figure, axes, _DISTANCE_COLOURS, FAR_M, "distance to the before map [m]", location="top", shrink=0.35, aspect=30
    )
    return data_address(figure)


def region_map(points: Points, regions: Sequence[RegionMark], truths: Sequence[TruthMark]) -> str:
    """Draw reported regions as red circles over a grey map seen from above, and where the changes truly are.

    Args:
        points: (N, 3) map points, metres.
        regions: Reported regions; false ones are dashed.
        truths: True positions; labels of neighbours are joined.
    """
    raster = Raster.around(points)
    counts = raster.count(points)
    figure, axes = _map_axes(raster)
    axes.imshow(_on_white(_tinted(counts, "#9a9a9a"), counts > 0), extent=raster.extent, origin="lower")
    for region in regions:
        circle = Circle((region.x_m, region.y_m), region.radius_m, fill=True, facecolor=(*to_rgb(RED), 0.18))
        circle.set(edgecolor=RED, linewidth=1.5, linestyle=_DASHED if region.is_false else "solid")
        axes.add_patch(circle)
    for state, look in _TRUTH_LOOKS.items():
        marks = [mark for mark in truths if mark.state == state]
        axes.plot([mark.x_m for mark in marks], [mark.y_m for mark in marks], linestyle="none", **look)
    for x_m, y_m, label in joined_labels(truths, 0.035 * raster.width_m):
        axes.annotate(
            label, (x_m, y_m), xytext=(7, 6), textcoords="offset points", fontsize=8, fontweight="bold",
            bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
        )  # fmt: skip
    handles: list[Any] = [
        Line2D([], [], color=RED, linewidth=1.5, label="region, finds a change"),
        Line2D([], [], color=RED, linewidth=1.5, linestyle=_DASHED, label="region, false"),
        *(
            Line2D([], [], linestyle="none", label=f"change, {state}", **look)
            for state, look in _TRUTH_LOOKS.items()
            if any(mark.state == state for mark in truths)
        ),
    ]
    _legend(axes, handles)
    return data_address(figure)


_TRUTH_LOOKS: dict[State, dict[str, Any]] = {
    "found": {"marker": "o", "markersize": 7, "color": GREEN, "markeredgecolor": "white"},
    "missed": {"marker": "X", "markersize": 8, "color": BLACK, "markeredgecolor": "white"},
    "unobservable": {"marker": "D", "markersize": 6, "color": "white", "markeredgecolor": BLACK},
    "not scored": {"marker": "s", "markersize": 6, "color": BLUE, "markeredgecolor": "white"},
}


def joined_labels(marks: Sequence[TruthMark], reach_m: float) -> list[tuple[float, float, str]]:
    """Return (x, y, label) with the labels of marks nearer than `reach_m` to a first one joined by commas."""
    joined: list[tuple[float, float, list[str]]] = []
    for mark in marks:
        for x_m, y_m, labels in joined:
            if np.hypot(mark.x_m - x_m, mark.y_m - y_m) < reach_m:
                labels.append(mark.label)
                break
        else:
            joined.append((mark.x_m, mark.y_m, [mark.label]))
    return [(x_m, y_m, ", ".join(labels)) for x_m, y_m, labels in joined]


@dataclass(frozen=True, slots=True)
class Raster:
    """Square cells over the plan of a map."""

    low: tuple[float, float]
    cell_m: float
    shape: tuple[int, int]

    @classmethod
    def around(cls, *clouds: Points) -> Raster:
        """Return cells that cover all points of some (N, 3) clouds except stray ones."""
        plans = [cloud[bulk_mask(cloud[:, :2]), :2] for cloud in clouds if len(cloud)]
        if not plans:
            raise ValueError("a map to draw must hold points")
        low = np.min([plan.min(axis=0) for plan in plans], axis=0)
        high = np.max([plan.max(axis=0) for plan in plans], axis=0)
        margin = 0.02 * float((high - low).max()) + 0.5
        low, span = low - margin, (high - low) + 2 * margin
        # finer than the map's own 0.2 m, cells would only show gaps between its points
        cell_m = max(0.2, float(span.max()) / (_MAP_WIDTH_IN * DPI))
        columns, rows = np.ceil(span / cell_m).astype(int)
        return cls((float(low[0]), float(low[1])), cell_m, (int(rows), int(columns)))

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom, top, metres."""
        (x_m, y_m), (rows, columns) = self.low, self.shape
        return x_m, x_m + columns * self.cell_m, y_m, y_m + rows * self.cell_m

    @property
    def width_m(self) -> float:
        """The longer side, metres."""
        return max(self.shape) * self.cell_m

    def cells(self, points: Points) -> tuple[Any, Any, Any]:
        """Return row and column of the points inside, and which those are."""
        index = np.floor((points[:, :2] - np.array(self.low)) / self.cell_m).astype(np.int64)
        inside = ((index >= 0) & (index < self.shape[::-1])).all(axis=1)
        return index[inside, 1], index[inside, 0], inside

    def count(self, points: Points) -> npt.NDArray[np.int64]:
        """Return the number of points in every cell."""
        rows, columns, _ = self.cells(points)
        flat = np.bincount(rows * self.shape[1] + columns, minlength=self.shape[0] * self.shape[1])
        return flat.reshape(self.shape)


def bulk_mask(plan: Points) -> npt.NDArray[np.bool_]:
    """Return (N,) which of (N, 2) points share their square with others, so that strays do not shrink the picture.

    All points are marked where every point is alone.
    """
    squares = np.floor(plan / _SQUARE_M).astype(np.int64)
    # one number for each square: rows of two are sorted twenty times slower
    numbers = (squares - squares.min(axis=0)) @ np.array([1, int(np.ptp(squares[:, 0])) + 1])
    _, square, counts = np.unique(numbers, return_inverse=True, return_counts=True)
    is_bulk = np.asarray(counts[square] >= _LEAST_IN_SQUARE)
    return is_bulk if is_bulk.any() else np.ones(len(plan), dtype=np.bool_)


def _tinted(counts: npt.NDArray[np.int64], colour: str) -> Float64Array:
    """RGBA image: the colour, paler where points are few."""
    weight = 0.45 + 0.55 * np.clip(np.log1p(counts) / np.log(12.0), 0.0, 1.0)
    rgb = 1.0 - weight[..., None] * (1.0 - np.array(to_rgb(colour)))
    return np.concatenate([rgb, np.ones_like(weight)[..., None]], axis=-1)


def _on_white(image: Float64Array, is_filled: npt.NDArray[np.bool_]) -> Float64Array:
    return np.where(is_filled[..., None], image, 1.0)


def _map_axes(raster: Raster) -> tuple[Figure, Axes]:
    rows, columns = raster.shape
    height_in = float(np.clip(_MAP_WIDTH_IN * rows / columns, 2.0, _MAP_HEIGHT_IN))
    width_in = float(np.clip(height_in * columns / rows, 6.5, _MAP_WIDTH_IN))
    figure = blank_figure(width_in, height_in + 0.8)
    axes = figure.add_subplot()
    axes.set_xlabel("x [m]", fontsize=8)
    axes.set_ylabel("y [m]", fontsize=8)
    style_map_axes(axes)
    return figure, axes


def style_map_axes(axes: Axes) -> None:
    """Give axes that show a map from above equal scales, small ticks, and no frame at the top and the right."""
    axes.set_aspect("equal")
    axes.tick_params(labelsize=7)
    axes.spines[["top", "right"]].set_visible(False)


def draw_colour_bar(
    figure: Figure, axes: Axes | list[Axes], colours: LinearSegmentedColormap, end_m: float, label: str, **place: Any
) -> None:
    """Draw the scale of colours from 0 to `end_m` and more; `place` says where, as matplotlib takes it."""
    bar = figure.colorbar(ScalarMappable(Normalize(0.0, end_m), colours), ax=axes, extend="max", pad=0.02, **place)
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=7)


def draw_subset(points: Points, n_most: int) -> Points:
    """Return (N, 3) points, or a fixed random subset where there are more than `n_most`."""
    if len(points) <= n_most:
        return points
    return points[stream(0, "page", "subset").choice(len(points), n_most, replace=False)]


def _legend(axes: Axes, handles: list[Any]) -> None:
    axes.legend(
        handles=handles, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(handles), fontsize=8, frameon=False
    )
