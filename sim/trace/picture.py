"""A picture of what was traced, for a person to check: plan with walls, nodes, drifts and widths, and long sections."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cdpipe.core.geometry import Float64Array
from cdpipe.core.names import visible
from sim.rock.axis import STATION_M, find_nearest
from sim.rock.centreline import headings_of, left_of
from sim.trace.graph import TracedDrift
from sim.trace.tracing import Trace

_COLOURS = ("#1f5fa8", "#c2571a", "#2a8a4a", "#7a3fa0", "#a8324a", "#5a6b1f", "#1d8a94", "#8a6a1f")
_MOST_POINTS = 60_000
_EVERY_M = 2.0  # between the lines across that show the width
_MOST_NAMES = 60
_GAP_M = 12.0  # between the sections of two drifts


def save_picture(found: Trace, path: Path) -> None:
    """Write a PNG: the plan above, the drifts' long sections below, one after the other."""
    figure = Figure(figsize=(14, 10), layout="constrained")
    plan, section = figure.subplots(2, 1, height_ratios=(2.2, 1.0))
    points = _thin(found.mesh.vertices)
    plan.plot(*points[:, :2].T, ",", color="0.6", zorder=0)
    start_m = 0.0
    for drift, colour in zip(found.drifts, _COLOURS * (len(found.drifts) // len(_COLOURS) + 1), strict=False):
        _draw_plan(plan, drift, colour)
        start_m = _draw_section(section, drift, colour, found, points, start_m) + _GAP_M
    _name_nodes(plan, found)
    plan.set(xlabel="x [m]", ylabel="y [m]", title=f"{_plain(found)}: plan. {_told(found)}")
    plan.set_aspect("equal", adjustable="datalim")
    section.margins(y=0.12)
    section.set(
        xlabel="along the drifts, one after the other [m]", ylabel="z [m]",
        title="long sections: grey walls, floor and roof of the line, dashed the straight lines between nodes",
    )  # fmt: skip
    figure.savefig(path, format="png", dpi=110)


def _plain(found: Trace) -> str:
    """Return the name of the mesh as a title shows it; dollars would begin a formula."""
    return visible(Path(found.file.path).name).replace("$", r"\$")


def _told(found: Trace) -> str:
    return (
        f"{found.length_m:.0f} m in {len(found.drifts)} drifts, {len(found.nodes)} nodes; grey the mesh, "
        "thin lines across the width found, dots nodes"
    )


def _thin(points: Float64Array) -> Float64Array:
    return points[:: max(1, len(points) // _MOST_POINTS)]


def _draw_plan(axes: Axes, drift: TracedDrift, colour: str) -> None:
    for middle in drift.middles:
        axes.plot(*middle.points[:, :2].T, "-", color=colour, lw=1.6)
        rows = slice(0, None, round(_EVERY_M / STATION_M))
        left = left_of(headings_of(middle.points))[rows]
        to_left = middle.points[rows, :2] + middle.left_m[rows, None] * left
        to_right = middle.points[rows, :2] - middle.right_m[rows, None] * left
        for one, other in zip(to_left, to_right, strict=True):
            axes.plot(*zip(one, other, strict=True), "-", color=colour, lw=0.6)


def _name_nodes(axes: Axes, found: Trace) -> None:
    for name, (x, y, _) in found.nodes.items():
        is_inner = name.startswith("node")
        axes.plot(x, y, "o", color="k", ms=2.5 if is_inner else 5)
        if len(found.nodes) <= _MOST_NAMES or not is_inner:
            axes.annotate(
                name, (x, y), xytext=(3, 3), textcoords="offset points", fontsize=5.5 if is_inner else 8,
                fontweight="normal" if is_inner else "bold",
            )  # fmt: skip


def _draw_section(
    axes: Axes, drift: TracedDrift, colour: str, found: Trace, walls: Float64Array, start_m: float
) -> float:
    """Draw the section of one drift from `start_m` on, and return where it ends."""
    line = drift.points
    along_m = start_m + np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1))])
    off_m, nearest = find_nearest(line[:, :2], walls[:, :2], drift.width_m)
    height_m = np.concatenate([middle.height_m for middle in drift.middles])
    near = np.flatnonzero(np.isfinite(off_m))
    near = near[np.abs(walls[near, 2] - line[nearest[near], 2]) < 2 * height_m[nearest[near]]]
    axes.plot(along_m[nearest[near]], walls[near, 2], ",", color="0.6", zorder=0)
    axes.plot(along_m, line[:, 2], "-", color=colour, lw=1.4)
    axes.plot(along_m, line[:, 2] + height_m, "-", color=colour, lw=0.7)
    places = np.array([found.nodes[name] for name in drift.nodes])
    at = find_nearest(line[:, :2], places[:, :2], np.inf)[1]
    if drift.nodes[0] == drift.nodes[-1]:
        at[-1] = len(line) - 1
    axes.plot(along_m[at], places[:, 2], "o--", color="k", ms=2.5, lw=0.6)
    axes.annotate(
        f"{drift.nodes[0]} to {drift.nodes[-1]}, {drift.width_m:.1f} x {drift.height_m:.1f} m",
        (along_m[0], float(np.max(line[:, 2] + height_m))), xytext=(0, 4), textcoords="offset points",
        fontsize=7, color=colour,
    )  # fmt: skip
    return float(along_m[-1])
