"""One object seen several times side by side: its truth and what each method answered."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from cdpipe.core.geometry import Float64Array
from eval.core.charts import BLACK, CONTEXT
from eval.core.figures import blank_figure, data_address, plain_text

# (points (N, 3) in metres, colour) of each
Layers = tuple[tuple[Float64Array, str], ...]
_TURNS_RAD = np.deg2rad([25.0, -25.0, 65.0, -65.0, 90.0])


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One view of an object.

    Attributes:
        title: What stands above it.
        note: What stands below it.
        layers: From back to front; all panels of an object share a frame.
    """

    title: str
    note: str
    layers: Layers


def object_panels(panels: Sequence[Panel], truth: Float64Array, view_from: Float64Array) -> str:
    """Draw one object in several panels side by side, obliquely from above, all to one scale.

    Args:
        panels: What to draw; the points of all are in the frame of `truth`.
        truth: (N, 3) true points, metres; they set the window.
        view_from: (3,) a point on the side the object is looked at from.
    """
    side = oblique_view(truth, view_from)
    flat = side(truth)
    low, high = flat.min(axis=0), flat.max(axis=0)
    margin = np.maximum(0.35 * (high - low), 0.3)
    low, high = low - margin, high + margin
    # between 4:3 and 3:4, so that a railing and a box have about the same size on the page
    wide, tall = high - low
    lack = 0.5 * np.maximum([0.75 * tall - wide, 0.75 * wide - tall], 0.0)
    low, high = low - lack, high + lack
    width_in = 1.9
    height_in = float(np.clip(width_in * (high[1] - low[1]) / (high[0] - low[0]), 1.4, 2.6))
    figure = blank_figure(width_in * len(panels), height_in + 0.55)
    for index, panel in enumerate(panels):
        axes = figure.add_subplot(1, len(panels), index + 1)
        for points, colour in panel.layers:
            shown = side(points)
            near = ((shown > low) & (shown < high)).all(axis=1)
            size = 1.5 if colour == CONTEXT else 5.0
            axes.scatter(shown[near, 0], shown[near, 1], s=size, c=colour, linewidths=0)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[])
        axes.set_title(plain_text(panel.title), fontsize=11, pad=4)
        axes.set_xlabel(plain_text(panel.note).replace(", ", "\n", 1), fontsize=9, labelpad=4)
        axes.spines[:].set_color("#bbbbbb")
    _scale_bar(figure.axes[0], low, high)
    return data_address(figure)


def oblique_view(truth: Float64Array, view_from: Float64Array) -> Callable[[Float64Array], Float64Array]:
    """Return a function from (N, 3) points to (N, 2) picture coordinates, metres: orthographic, 25 deg from above.

    The view is from the side of `view_from`. It turns about the object by the first of a few angles that shows at least
    60 % of the greatest width that any of them shows, so that no railing is seen from its end.
    """
    centre = truth.mean(axis=0)
    offset = view_from[:2] - centre[:2]
    towards = np.arctan2(offset[1], offset[0])
    widths = [_width_m(truth, towards + turn) for turn in _TURNS_RAD]
    turn = next(turn for turn, width in zip(_TURNS_RAD, widths, strict=True) if width >= 0.6 * max(widths))
    azimuth = towards + turn
    elevation = np.deg2rad(25.0)
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.array([-np.cos(azimuth) * np.sin(elevation), -np.sin(azimuth) * np.sin(elevation), np.cos(elevation)])
    return lambda points: np.column_stack([(points - centre) @ right, (points - centre) @ up])


def _width_m(points: Float64Array, azimuth_rad: float) -> float:
    return float(np.ptp(points[:, :2] @ np.array([-np.sin(azimuth_rad), np.cos(azimuth_rad)])))


def _scale_bar(axes: Axes, low: Float64Array, high: Float64Array) -> None:
    width_m = high[0] - low[0]
    length_m = next((step for step in (5.0, 2.0, 1.0, 0.5, 0.2) if step < 0.4 * width_m), 0.1)
    x_m, y_m = low[0] + 0.06 * width_m, low[1] + 0.07 * (high[1] - low[1])
    axes.plot([x_m, x_m + length_m], [y_m, y_m], color=BLACK, linewidth=2, solid_capstyle="butt")
    axes.annotate(f"{length_m:g} m", (x_m + length_m, y_m), xytext=(3, -3), textcoords="offset points", fontsize=9)
