"""Plots of the sensor against reality: every measure over its bins, the rebuilt scene, and static novelty."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from cdpipe.core.geometry import Float64Array
from eval.core.figures import BLACK, BLUE, GREEN, ORANGE, VERMILLION
from eval.studies.reality.sensor_measures import Revolutions
from eval.studies.reality.static_novelty import CELLS_M, REAL_SHARES, Novelty
from eval.studies.reality.tables import first_number

_DPI = 90
_PANELS = (
    ("returns by beam", "beam, top to bottom", "share of pixels that return", "linear"),
    ("returns by photons of the neighbours", "photons of the two neighbours", "share that returns", "linear"),
    ("photons x range^2 per percent", "range, m", "photons m² per percent", "log"),
    ("range noise, facing", "range, m", "1 sigma, mm, facing surfaces", "linear"),
    ("range noise, smooth", "range, m", "1 sigma, mm, all smooth surfaces", "linear"),
    ("range noise, facing, 4 to 13 m", "photons", "1 sigma, mm, facing, 4 to 13 m", "linear"),
    ("isolated returns", "range, m", "share of returns", "linear"),
    ("mixed at edges", "jump of range, m", "share of edge pixels in between", "linear"),
)
_COLOURS = (BLACK, BLUE, VERMILLION, ORANGE, GREEN)


def draw_measures(table: pd.DataFrame, path: Path) -> None:
    """Write a panel for each measure; the recording is black, 19 sub-rays dashed, no effects dotted."""
    figure = Figure(figsize=(12.0, 15.0), layout="constrained")
    sources = list(dict.fromkeys(table["source"]))
    names = list(dict.fromkeys(source.split(",")[0] for source in sources))
    for axes, (measure, across, up, scale) in zip(figure.subplots(4, 2).ravel(), _PANELS, strict=True):
        rows = table[(table["measure"] == measure) & (table["where"] != "all")]
        labels = list(dict.fromkeys(rows["where"]))
        ticks = sorted(labels, key=first_number)
        for source in sources:
            values = rows[rows["source"] == source].set_index("where")["value"].reindex(ticks)
            colour = _COLOURS[names.index(source.split(",")[0])]
            style = "--" if "sub-rays" in source else ":" if "off" in source else "-"
            axes.plot(range(len(ticks)), values, style, marker="o", ms=3, color=colour, label=source)
        _dress(axes, ticks, across, up, scale)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, frameon=False)
    _save(figure, path)


def draw_scene(real: Revolutions, recast: Revolutions, path: Path) -> None:
    """Write the range images of the recording and of the simulator in the scene made of it, and their difference."""
    figure = Figure(figsize=(12.0, 5.6), layout="constrained")
    images = [np.where(each.range_m[0] > 0, each.range_m[0], np.nan) for each in (real, recast)]
    titles = ("real", "simulated in the scene made of it", "simulated minus real")
    for axes, title, image in zip(figure.subplots(3, 1), titles, (*images, images[1] - images[0]), strict=True):
        is_difference = title == titles[2]
        low, high, colours = (-0.1, 0.1, "RdBu_r") if is_difference else (2.0, 40.0, "viridis")
        drawn = axes.imshow(image, aspect="auto", interpolation="nearest", vmin=low, vmax=high, cmap=colours)
        axes.set_title(f"{title} (white: no return)", fontsize=10, loc="left")
        axes.set_ylabel("beam")
        figure.colorbar(drawn, ax=axes, label="m" if is_difference else "range, m", pad=0.01)
    figure.axes[2].set_xlabel("column")
    _save(figure, path)


def draw_novelty(results: Sequence[Novelty], path: Path) -> None:
    """Write the share of new returns by the number of revolutions, and by effect."""
    figure = Figure(figsize=(12.0, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.7))
    standing = sorted((r for r in results if r.way == "standing" and r.variant == "default"), key=_n_revolutions)
    for index, (cell_m, colour) in enumerate(zip(CELLS_M, (BLUE, VERMILLION, GREEN), strict=True)):
        shares = 100.0 * np.array([each.shares[index] for each in standing])
        left.plot(
            [each.n_revolutions for each in standing], shares, marker="o", ms=3, color=colour, label=f"{cell_m:g} m"
        )
        left.axhline(100.0 * REAL_SHARES[index], color=colour, ls=":", lw=1)
    left.set(xscale="log", yscale="log", xlabel="revolutions in both halves", ylabel="returns in new voxels, %")
    left.set_title("standing, default effects; dotted: real recording", fontsize=10)
    left.legend(title="voxel", frameon=False)
    most = [each for each in results if each.n_revolutions == _most_common(results)]
    # What a standing sensor has no case of keeps its place among the others.
    variants = list(dict.fromkeys(each.variant for each in sorted(most, key=_is_standing)))
    ways = list(dict.fromkeys(each.way for each in most))
    for place, (way, colour) in enumerate(zip(ways, (BLUE, ORANGE, VERMILLION), strict=False)):
        bars = {each.variant: 100.0 * each.shares[0] for each in most if each.way == way}
        at = np.arange(len(variants)) + (place - 1) * 0.27
        right.bar(at, [bars.get(name, np.nan) for name in variants], width=0.25, color=colour, label=way)
    right.axhline(100.0 * REAL_SHARES[0], color=BLACK, ls=":", lw=1, label="real recording")
    right.set_xticks(range(len(variants)), variants, rotation=35, ha="right")
    right.set_ylabel("returns in new voxels of 0.1 m, %")
    right.set_title(f"{_most_common(results)} revolutions", fontsize=10)
    right.legend(frameon=False, ncols=2, fontsize=8)
    right.set_ylim(0.0, 1.25 * max(100.0 * each.shares[0] for each in most))
    _save(figure, path)


def _dress(axes: Axes, ticks: Sequence[str], across: str, up: str, scale: str) -> None:
    shown = [
        tick.removeprefix("jump ").removesuffix(" photons").removesuffix(" m").replace(" photons or more", "+")
        for tick in ticks
    ]
    step = max(1, len(ticks) // 11)
    axes.set_xticks(range(0, len(ticks), step), shown[::step], fontsize=8, rotation=20 if step == 1 else 0)
    axes.set(xlabel=across, ylabel=up, yscale=scale)
    if scale == "linear" and not up.startswith("share that"):
        axes.set_ylim(bottom=0.0)
    axes.grid(visible=True, lw=0.3)


def _is_standing(novelty: Novelty) -> bool:
    return novelty.way == "standing"


def _n_revolutions(novelty: Novelty) -> int:
    return novelty.n_revolutions


def _most_common(results: Sequence[Novelty]) -> int:
    numbers: Float64Array = np.array([each.n_revolutions for each in results], dtype=np.float64)
    values, counts = np.unique(numbers, return_counts=True)
    return int(values[np.argmax(counts)])


def _save(figure: Figure, path: Path) -> None:
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=_DPI)
