"""One object seen several times side by side: its truth and what each method answered."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from cdpipe.geometry import Float64Array
from eval.figures import BLACK, CONTEXT, blank_figure, data_address


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One view of an object.

    Attributes:
        title: What stands above it.
        note: What stands below it.
        layers: (points (N, 3) in metres, colour) from back to front; all panels of an object share a frame.
    """

    title: str
    note: str
    layers: tuple[tuple[Float64Array, str], ...]


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
    # panels no flatter than 4:3, so that a railing and a box have the same height on the page
    lack = 0.5 * max(0.0, 0.75 * (high[0] - low[0]) - (high[1] - low[1]))
    low[1], high[1] = low[1] - lack, high[1] + lack
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
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_aspect("equal")
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_title(panel.title, fontsize=9, pad=4)
        axes.set_xlabel(panel.note, fontsize=7, labelpad=4)
        for spine in axes.spines.values():
            spine.set_color("#bbbbbb")
    _scale_bar(figure.axes[0], low, high)
    return data_address(figure)


def oblique_view(truth: Float64Array, view_from: Float64Array) -> Callable[[Float64Array], Float64Array]:
    """Return a function from (N, 3) points to (N, 2) picture coordinates, metres: orthographic, 25 deg from above.

    The eye stands on the side of `view_from`, turned by 25 deg about the object so that its depth is seen.
    """
    offset = view_from[:2] - truth.mean(axis=0)[:2]
    azimuth = np.arctan2(offset[1], offset[0]) + np.deg2rad(25.0)
    elevation = np.deg2rad(25.0)
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.array([-np.cos(azimuth) * np.sin(elevation), -np.sin(azimuth) * np.sin(elevation), np.cos(elevation)])
    centre = truth.mean(axis=0)
    return lambda points: np.column_stack([(points - centre) @ right, (points - centre) @ up])


def _scale_bar(axes: Axes, low: Float64Array, high: Float64Array) -> None:
    width_m = high[0] - low[0]
    length_m = next((step for step in (5.0, 2.0, 1.0, 0.5, 0.2) if step < 0.4 * width_m), 0.1)
    x_m, y_m = low[0] + 0.06 * width_m, low[1] + 0.07 * (high[1] - low[1])
    axes.plot([x_m, x_m + length_m], [y_m, y_m], color=BLACK, linewidth=2, solid_capstyle="butt")
    axes.annotate(f"{length_m:g} m", (x_m + length_m, y_m), xytext=(3, -3), textcoords="offset points", fontsize=7)
