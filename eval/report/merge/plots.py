"""Plots over the pairs of a run: merge errors against overlap, and times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter

from cdpipe.core.geometry import Float64Array, stream
from eval.core.figures import BLACK, BLUE, GREEN, ORANGE, VERMILLION, blank_figure, data_address

_WIDTH_IN = 9.0
KIND_COLOURS = {"clean": BLUE, "drift": ORANGE, "smooth": GREEN, "disjoint": VERMILLION}


@dataclass(frozen=True, slots=True, eq=False)
class MergedPairs:
    """What the error plot shows of N pairs and one variant.

    Attributes:
        kinds: (N,) kind of each pair.
        overlaps: (N,) share of the after path that the before session saw too.
        errors_m: (N,) median error; NaN where it is undefined.
        outcomes: (N,) "accepted", "refused" or "failed".
    """

    kinds: Sequence[str]
    overlaps: Float64Array
    errors_m: Float64Array
    outcomes: Sequence[str]


_LEAST_ERROR_M, _MOST_ERROR_M = 1e-4, 300.0
# what has no error stands on lines of its own above the plot
_LINES = {"accepted, no error defined": 1e3, "refused": 3e3, "failed": 9e3}


def error_plot(variants: Mapping[str, MergedPairs], exact_m: float, right_m: float) -> str:
    """Draw merge error against true overlap, a panel for each variant; refused and failed pairs stand above.

    Args:
        variants: What to draw, by variant; at least one.
        exact_m: Line of the target for exact merges, metres.
        right_m: Line above which a merge is wrong, metres.
    """
    n_columns = min(len(variants), 3)
    n_rows = -(-len(variants) // n_columns)
    figure = blank_figure(_WIDTH_IN, 0.6 + 3.0 * n_rows)
    panels = figure.subplots(n_rows, n_columns, squeeze=False, sharex=True, sharey=True).ravel()
    for axes in panels[len(variants) :]:
        axes.set_axis_off()
    for index, (axes, (name, pairs)) in enumerate(zip(panels, variants.items(), strict=False)):
        _error_panel(axes, pairs, (exact_m, right_m))
        axes.set_title(name, fontsize=8)
        if index % n_columns == 0:
            axes.set_ylabel("merge error [m]", fontsize=8)
        axes.set_xlabel("true overlap", fontsize=8)
    found = [kind for kind in KIND_COLOURS if any(kind in pairs.kinds for pairs in variants.values())]
    handles = [
        Line2D([], [], linestyle="none", marker="o", markersize=5, color=KIND_COLOURS[kind], label=kind)
        for kind in found
    ]
    if handles:
        figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), fontsize=8, frameon=False)
    return data_address(figure)


def _error_panel(axes: Axes, pairs: MergedPairs, limits_m: tuple[float, float]) -> None:
    is_accepted = np.array([outcome == "accepted" for outcome in pairs.outcomes])
    is_defined = is_accepted & ~np.isnan(pairs.errors_m)
    lines = np.array([
        _LINES["accepted, no error defined" if outcome == "accepted" else outcome] for outcome in pairs.outcomes
    ])  # fmt: skip
    heights = np.where(is_defined, np.clip(pairs.errors_m, _LEAST_ERROR_M, _MOST_ERROR_M), lines)
    # an overlap is undefined where nothing could be made; such a pair is shown at the left border
    overlaps = np.nan_to_num(pairs.overlaps, nan=0.0)
    kinds = np.array(pairs.kinds)
    for kind in dict.fromkeys(pairs.kinds):
        colour = KIND_COLOURS.get(kind, BLACK)
        for of_accepted, marker in ((True, "o"), (False, "x")):
            own = (kinds == kind) & (is_accepted == of_accepted)
            axes.plot(
                overlaps[own], heights[own], linestyle="none", marker=marker, markersize=4, color=colour, alpha=0.75
            )
    for limit_m, style in zip(limits_m, ("--", "-"), strict=True):
        axes.axhline(limit_m, color=BLACK, linewidth=0.8, linestyle=style)
    axes.axhline(_MOST_ERROR_M * 1.5, color="#b0b0b0", linewidth=0.8)
    axes.set_yscale("log")
    axes.set(xlim=(-0.04, 1.04), ylim=(_LEAST_ERROR_M / 1.5, max(_LINES.values()) * 2))
    decades = [10.0**power for power in range(-4, 3)]
    names = [f"{value:g}" for value in decades]
    axes.set_yticks([*decades, *_LINES.values()], [*names, *_LINES])
    axes.minorticks_off()
    axes.tick_params(labelsize=7)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _decades(values: Float64Array) -> tuple[float, float]:
    """Return the powers of ten around (N,) positive numbers, a little wider."""
    low, high = np.floor(np.log10(values.min())), np.ceil(np.log10(values.max()))
    return float(10.0 ** (low - 0.08)), float(10.0 ** (max(high, low + 1) + 0.08))


def time_plot(times: Mapping[str, Mapping[str, Float64Array]]) -> str:
    """Draw the seconds of every accepted pair, a panel for each part of the merge and a row for each variant.

    Args:
        times: For each panel's name the (N,) defined seconds of each variant; a bar marks their median, and
            their number stands beside them.
    """
    variants = list(dict.fromkeys(name for panel in times.values() for name in panel))
    figure = blank_figure(_WIDTH_IN, 0.9 + 0.32 * len(variants))
    panels = figure.subplots(1, len(times), squeeze=False, sharey=True)[0]
    for axes, (title, panel) in zip(panels, times.items(), strict=True):
        for row, name in enumerate(variants):
            seconds = panel.get(name, np.zeros(0))
            seconds = seconds[seconds > 0]
            shift = stream(0, "page", "strip").uniform(-0.22, 0.22, len(seconds))
            axes.plot(seconds, row + shift, linestyle="none", marker="o", markersize=2.5, color=BLUE, alpha=0.4)
            axes.text(
                1.02,
                row,
                f"n {len(seconds)}",
                transform=axes.get_yaxis_transform(),
                fontsize=6,
                va="center",
                clip_on=False,
            )
            if len(seconds):
                axes.plot([np.median(seconds)] * 2, [row - 0.34, row + 0.34], color=BLACK, linewidth=1.6)
        axes.set_xscale("log")
        every = np.concatenate([seconds[seconds > 0] for seconds in panel.values()])
        if len(every):
            axes.set_xlim(*_decades(every))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel(title, fontsize=8)
        axes.grid(axis="x", color="#e6e6e6", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=7)
        for side in ("top", "right", "left"):
            axes.spines[side].set_visible(False)
    panels[0].set_yticks(range(len(variants)), variants)
    panels[0].set_ylim(len(variants) - 0.5, -0.5)
    return data_address(figure)
