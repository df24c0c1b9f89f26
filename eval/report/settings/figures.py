"""Differences with their intervals, one line for each setting: what changes a result, and what only seems to."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from eval.core.figures import BLACK, BLUE, GREEN, ORANGE, VERMILLION, blank_figure, data_address

_COLOURS = (BLUE, ORANGE, GREEN, VERMILLION, BLACK)
_MARKERS = "osD^v"
_WIDTH_IN, _ROW_IN, _LINES_PER_ROW = 9.0, 0.34, 0.45


@dataclass(frozen=True, slots=True)
class Effect:
    """The difference that a setting makes to one figure of a variant, and its interval; NaN where undefined."""

    setting: str
    variant: str
    difference: float
    low: float
    high: float


def effect_plot(panels: Mapping[str, Sequence[Effect]]) -> str:
    """Draw one panel for each figure: settings from top to bottom, a dot and a line for each variant.

    Args:
        panels: The effects on each figure, by its name; settings and variants in the order in which they come.
    """
    every = [effect for effects in panels.values() for effect in effects]
    settings = list(dict.fromkeys(effect.setting for effect in every))
    names = [setting.replace(", ", ",\n") for setting in settings]
    # a row is as high as its name needs
    heights = np.maximum(1.0, _LINES_PER_ROW * np.array([1 + name.count("\n") for name in names]))
    middles = dict(zip(settings, np.cumsum(heights) - heights / 2, strict=True))
    variants = list(dict.fromkeys(effect.variant for effect in every))
    figure = blank_figure(_WIDTH_IN, 1.1 + _ROW_IN * float(heights.sum()))
    shared: Axes | None = None
    for index, (name, effects) in enumerate(panels.items()):
        axes = figure.add_subplot(1, len(panels), index + 1, sharey=shared)
        shared = shared or axes
        _panel(axes, effects, middles, variants)
        axes.set_xlabel(f"difference of {name}", fontsize=8)
        axes.tick_params(labelsize=7, labelleft=index == 0, left=False)
    if shared is not None:
        shared.set_yticks(list(middles.values()), names)
        shared.set_ylim(float(heights.sum()), 0.0)
        handles, labels = shared.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), fontsize=8, frameon=False)
    return data_address(figure)


def _panel(axes: Axes, effects: Sequence[Effect], middles: Mapping[str, float], variants: Sequence[str]) -> None:
    axes.axvline(0.0, color=BLACK, linewidth=0.8)
    step = 0.6 / max(len(variants), 2)
    for order, variant in enumerate(variants):
        own = [effect for effect in effects if effect.variant == variant and not math.isnan(effect.difference)]
        rows = [middles[effect.setting] + (order - (len(variants) - 1) / 2) * step for effect in own]
        colour, marker = _COLOURS[order % len(_COLOURS)], _MARKERS[order % len(_MARKERS)]
        axes.hlines(rows, [effect.low for effect in own], [effect.high for effect in own], color=colour, linewidth=1.4)
        means = [effect.difference for effect in own]
        axes.plot(means, rows, linestyle="none", marker=marker, markersize=4.5, color=colour, label=variant)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.grid(axis="x", color="#e6e6e6", linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
