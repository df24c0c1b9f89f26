"""Plots of the sensor against reality: every measure over its bins, the rebuilt scene, and static novelty."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from cdpipe.core.geometry import Float64Array
from eval.core.charts import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    VERMILLION,
    Axis,
    Dash,
    Drawing,
    Look,
    Panel,
    Series,
    log_span,
    named_ticks,
)
from eval.core.figures import blank_figure, picture, png
from eval.studies.reality.sensor_measures import Revolutions
from eval.studies.reality.static_novelty import CELLS_M, REAL_SHARES, Novelty
from eval.studies.reality.tables import first_number

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
    sources = [str(source) for source in dict.fromkeys(table["source"])]
    names = list(dict.fromkeys(source.split(",")[0] for source in sources))
    panels = []
    for measure, across, up, scale in _PANELS:
        rows = table[(table["measure"] == measure) & (table["where"] != "all")]
        bins = sorted(dict.fromkeys(rows["where"]), key=first_number)
        series = []
        for source in sources:
            values = rows[rows["source"] == source].set_index("where")["value"].reindex(bins)
            dash: Dash = "dash" if "sub-rays" in source else "dot" if "off" in source else "solid"
            look = Look(_COLOURS[names.index(source.split(",")[0])], dash=dash, marker="circle", size=3.0)
            series.append(Series(np.arange(len(bins)), values, look, source))
        ticks = dict(list(named_ticks([_bin_name(each) for each in bins]).items())[:: max(1, len(bins) // 11)])
        highest = rows["value"].max()
        span = log_span(rows["value"]) if scale == "log" else (0.0, 1.05 * highest) if highest > 0 else None
        panels.append(Panel(Axis(across, ticks=ticks, tick_pt=5.5), Axis(up, span, is_log=scale == "log"), series))
    path.write_bytes(png(picture(Drawing([panels[start : start + 2] for start in range(0, 8, 2)], 270))))


def draw_scene(real: Revolutions, recast: Revolutions, path: Path) -> None:
    """Write the range images of the recording and of the simulator in the scene made of it, and their difference."""
    figure = blank_figure(12.0, 5.6)
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
    path.write_bytes(png(figure))


def draw_novelty(results: Sequence[Novelty], path: Path) -> None:
    """Write the share of new returns by the number of revolutions, and by effect."""
    standing = sorted((r for r in results if r.way == "standing" and r.variant == "default"), key=_n_revolutions)
    numbers = [each.n_revolutions for each in standing]
    lines = []
    for index, (cell_m, colour) in enumerate(zip(CELLS_M, (BLUE, VERMILLION, GREEN), strict=True)):
        percent = [100.0 * each.shares[index] for each in standing]
        lines.append(Series(numbers, percent, Look(colour, marker="circle", size=3.0), f"voxel {cell_m:g} m"))
        lines.append(Series(numbers, [100.0 * REAL_SHARES[index]] * len(numbers), Look(colour, 1.0, "dot")))
    x = Axis("revolutions in both halves", is_log=True, ticks={float(number): f"{number}" for number in numbers})
    heading = "standing, default effects; dotted: real recording"
    y = Axis("returns in new voxels [%]", log_span([np.ravel(each.y) for each in lines]), is_log=True)
    by_number = Panel(x, y, lines, heading)
    most = [each for each in results if each.n_revolutions == _most_common(results)]
    # a variant that the standing sensor was not run with keeps its place among the others
    variants = list(dict.fromkeys(each.variant for each in sorted(most, key=_is_standing)))
    places = np.arange(len(variants))
    bars = []
    for way, colour in zip(dict.fromkeys(each.way for each in most), (BLUE, ORANGE, VERMILLION), strict=False):
        shares = {each.variant: 100.0 * each.shares[0] for each in most if each.way == way}
        bars.append(Series(places, [shares.get(name, np.nan) for name in variants], Look(colour), way, "bars"))
    ends = [-0.5, len(variants) - 0.5]
    bars.append(Series(ends, [100.0 * REAL_SHARES[0]] * 2, Look(BLACK, 1.0, "dot"), "real recording"))
    x = Axis(ticks=named_ticks([name.replace("_", "_\n").replace(" ", "\n") for name in variants]), tick_pt=5.5)
    heading = f"{_most_common(results)} revolutions"
    by_effect = Panel(x, Axis("returns in new voxels of 0.1 m [%]"), bars, heading)
    path.write_bytes(png(picture(Drawing([[by_number], [by_effect]], 300))))


def _bin_name(where: str) -> str:
    short = where.removeprefix("jump ").removesuffix(" photons").removesuffix(" m")
    return short.replace(" photons or more", "+")


def _is_standing(novelty: Novelty) -> bool:
    return novelty.way == "standing"


def _n_revolutions(novelty: Novelty) -> int:
    return novelty.n_revolutions


def _most_common(results: Sequence[Novelty]) -> int:
    numbers: Float64Array = np.array([each.n_revolutions for each in results], dtype=np.float64)
    values, counts = np.unique(numbers, return_counts=True)
    return int(values[np.argmax(counts)])
