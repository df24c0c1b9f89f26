"""Plots of the sensor against reality: every measure over its bins, the rebuilt scene, and static novelty."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import mode

import numpy as np
import pandas as pd

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
from eval.studies.reality.static_novelty import CELLS_M, REAL_SHARES, Case, Shares
from eval.studies.reality.tables import find_first_number

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
_STANDING = ("standing", "default")
_COLOURS = (BLACK, BLUE, VERMILLION, ORANGE, GREEN)


def draw_measures(table: pd.DataFrame, path: Path) -> None:
    """Write a panel for each measure; the recording is black, 19 sub-rays dashed, no effects dotted."""
    sources = [str(source) for source in dict.fromkeys(table["source"])]
    names = list(dict.fromkeys(source.split(",")[0] for source in sources))
    panels = []
    for measure, across, up, scale in _PANELS:
        rows = table[(table["measure"] == measure) & (table["where"] != "all")]
        bins = sorted(dict.fromkeys(rows["where"]), key=find_first_number)
        series = []
        for source in sources:
            values = rows[rows["source"] == source].set_index("where")["value"].reindex(bins)
            dash: Dash = "dash" if "sub-rays" in source else "dot" if "off" in source else "solid"
            look = Look(_COLOURS[names.index(source.split(",")[0])], dash=dash, marker="circle", size=3.0)
            series.append(Series(np.arange(len(bins)), values, look, source))
        ticks = dict(list(named_ticks([_shorten_bin(each) for each in bins]).items())[:: max(1, len(bins) // 11)])
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


def draw_novelty(results: Sequence[tuple[Case, Shares]], path: Path) -> None:
    """Write the share of new returns by the number of revolutions, and by effect."""
    standing = {case.n_revolutions: shares for case, shares in results if (case.way, case.variant) == _STANDING}
    numbers = sorted(standing)
    lines = []
    for index, (cell_m, colour) in enumerate(zip(CELLS_M, (BLUE, VERMILLION, GREEN), strict=True)):
        percent = [100.0 * standing[number][index] for number in numbers]
        lines.append(Series(numbers, percent, Look(colour, marker="circle", size=3.0), f"voxel {cell_m:g} m"))
        lines.append(Series(numbers, [100.0 * REAL_SHARES[index]] * len(numbers), Look(colour, 1.0, "dot")))
    x = Axis("revolutions in both halves", is_log=True, ticks={float(number): f"{number}" for number in numbers})
    heading = "standing, default effects; dotted: real recording"
    y = Axis("returns in new voxels [%]", log_span([np.ravel(each.y) for each in lines]), is_log=True)
    by_number = Panel(x, y, lines, heading)
    most_common = mode(case.n_revolutions for case, _ in results)
    most = [(case, shares) for case, shares in results if case.n_revolutions == most_common]
    # a variant that the standing sensor was not run with keeps its place among the others
    variants = list(dict.fromkeys(case.variant for case, _ in sorted(most, key=lambda each: each[0].way == "standing")))
    places = np.arange(len(variants))
    bars = []
    for way, colour in zip(dict.fromkeys(case.way for case, _ in most), (BLUE, ORANGE, VERMILLION), strict=False):
        percents = {case.variant: 100.0 * shares[0] for case, shares in most if case.way == way}
        bars.append(Series(places, [percents.get(name, np.nan) for name in variants], Look(colour), way, "bars"))
    ends = [-0.5, len(variants) - 0.5]
    bars.append(Series(ends, [100.0 * REAL_SHARES[0]] * 2, Look(BLACK, 1.0, "dot"), "real recording"))
    x = Axis(ticks=named_ticks([name.replace("_", "_\n").replace(" ", "\n") for name in variants]), tick_pt=5.5)
    heading = f"{most_common} revolutions"
    by_effect = Panel(x, Axis("returns in new voxels of 0.1 m [%]"), bars, heading)
    path.write_bytes(png(picture(Drawing([[by_number], [by_effect]], 300))))


def _shorten_bin(where: str) -> str:
    short = where.removeprefix("jump ").removesuffix(" photons").removesuffix(" m")
    return short.replace(" photons or more", "+")
