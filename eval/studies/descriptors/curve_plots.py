"""Draws `eval.studies.descriptors.curves`: a column for each thing that was varied, a row for each measure."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, NullLocator

from eval.core.figures import BLACK, BLUE, VERMILLION, blank_figure, png

_MEASURES = (
    ("log_likelihood", 1.0, "log-likelihood"),
    ("auroc", 1.0, "AUROC, mean of tunnels"),
    ("unchanged_above_0", 100.0, "unchanged above 0 [%]"),
    ("changes_found", 100.0, "changes found at 0 [%]"),
)
# column, what stands under it
_VARIED = (
    ("numbers", "numbers stored per keyframe"),
    ("width", "channels, shipped = 1"),
    ("tunnels", "training tunnels"),
    ("bits", "bits of each stored number"),
)
_GROUPS = (("", BLUE, "all validation tunnels"), ("_tight", VERMILLION, "family tight"))
_BASE = {"numbers": 64, "width": 1.0, "share": 1.0, "bits": 32}


def draw_curves(table: pd.DataFrame) -> bytes:
    """Draw every measure against budget, width, data and precision, as far as they were varied. Returns a PNG.

    Args:
        table: Rows of curves.csv; those without a seed are of the shipped network.
    """
    own, shipped = table[table["seed"].notna()], table[table["seed"].isna()]
    shown = [(name, label) for name, label in _VARIED if name == "bits" or varying(own, name, True)[name].nunique() > 1]
    figure = blank_figure(max(5.5, 2.75 * len(shown)), 9.5)
    panels = figure.subplots(len(_MEASURES), len(shown), squeeze=False)
    for axes_row, (measure, scale, title) in zip(panels, _MEASURES, strict=True):
        for axes, (name, label) in zip(axes_row, shown, strict=True):
            if name not in ("bits", shown[0][0]):  # two bits would flatten everything else
                axes.sharey(axes_row[0])
            for column, colour in ((measure + group, colour) for group, colour, _ in _GROUPS):
                if column not in table:
                    continue
                for reads_after in (True, False):
                    chosen = varying(own, name, reads_after)
                    _curve(axes, chosen[name], scale * chosen[column], colour, reads_after)
                if name == "bits":
                    axes.plot(shipped["bits"], scale * shipped[column], "*", color=colour, markersize=8)
            _dressed(axes, table[name], label if measure == _MEASURES[-1][0] else "")
        axes_row[0].set_ylabel(title, fontsize=8)
    figure.legend(
        handles=_handles(), loc="outside upper center", ncols=2 if len(shown) == 1 else 5, fontsize=8, frameon=False
    )
    return png(figure)


def varying(table: pd.DataFrame, varied: str, reads_after: bool) -> pd.DataFrame:
    """Return the rows that differ from the base point in one thing alone."""
    mask = table["reads_after"].astype(bool) == reads_after
    for name, value in _BASE.items():
        if name != {"tunnels": "share"}.get(varied, varied):
            mask &= table[name] == value
    return table[mask]


def _curve(axes: Axes, x: pd.Series[float], y: pd.Series[float], colour: str, is_filled: bool) -> None:
    face = colour if is_filled else "white"
    axes.plot(x, y, linestyle="none", marker="o", markersize=4, color=colour, markerfacecolor=face, alpha=0.75)
    means = y.groupby(x).mean()
    axes.plot(means.index, means, color=colour, linewidth=1.2, linestyle="solid" if is_filled else (0, (3, 2)))


def _dressed(axes: Axes, x: pd.Series[float], label: str) -> None:
    axes.set_xscale("log", base=2)
    ticks = np.unique(x.dropna())
    axes.xaxis.set_major_locator(FixedLocator([float(tick) for tick in ticks]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_xlabel(label, fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(color="#e6e6e6", linewidth=0.6)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _handles() -> list[Line2D]:
    return [
        *(Line2D([], [], color=colour, marker="o", markersize=4, label=name) for _, colour, name in _GROUPS),
        Line2D([], [], color=BLACK, marker="o", markersize=4, label="reads the after image"),
        Line2D(
            [], [], color=BLACK, marker="o", markersize=4, markerfacecolor="white", linestyle=(0, (3, 2)),
            label="compares the numbers alone",
        ),
        Line2D([], [], color=BLACK, marker="*", markersize=8, linestyle="none", label="shipped weights"),
    ]  # fmt: skip
