"""How the IoU of an object depends on its size: every object of one method, and what each method reaches by size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter

from cdpipe.core.geometry import Float64Array
from eval.core.domains import domain_name
from eval.core.figures import BLACK, BLUE, GREEN, ORANGE, VERMILLION, blank_figure, data_address

_DASHED, _DOTS = (0, (4, 2)), "#a8a8a8"
_LINES: tuple[dict[str, Any], ...] = (
    {"color": BLACK, "linewidth": 2.0},
    {"color": VERMILLION, "linewidth": 1.4},
    {"color": ORANGE, "linewidth": 1.4},
    {"color": BLACK, "linewidth": 1.3, "linestyle": _DASHED},
    {"color": VERMILLION, "linewidth": 1.2, "linestyle": _DASHED},
    {"color": BLUE, "linewidth": 1.2},
    {"color": GREEN, "linewidth": 1.2},
)
_LEAST_M3, _MOST_M3 = 0.02, 60.0


@dataclass(frozen=True, slots=True, eq=False)
class SizeLine:
    """Mean IoU of one method by size: (B,) middles of the bins in m3, means, and the ends of their intervals."""

    volume_m3: Float64Array
    iou: Float64Array
    low: Float64Array
    high: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class SizePanel:
    """One domain: (N,) volume and IoU of every object of the first method, and the lines of all methods in order."""

    volume_m3: Float64Array
    iou: Float64Array
    lines: Mapping[str, SizeLine]


def iou_by_size_plot(panels: Mapping[str, SizePanel], names: Sequence[str]) -> str:
    """Draw point IoU over the volume of the hull, a panel for each domain; dots and bars are of the first method.

    Args:
        panels: By domain.
        names: All methods, in the order of their looks.
    """
    looks = {name: _LINES[index % len(_LINES)] for index, name in enumerate(names)}
    figure = blank_figure(9.0, 4.2)
    for axes, (domain, panel) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        x = np.clip(panel.volume_m3, _LEAST_M3, _MOST_M3)
        axes.scatter(x, panel.iou, s=12, c=_DOTS, linewidths=0)
        for name, line in panel.lines.items():
            axes.plot(line.volume_m3, line.iou, marker="o", markersize=3, **looks[name])
            if name == names[0]:
                axes.vlines(line.volume_m3, line.low, line.high, color=looks[name]["color"], linewidth=1.0, alpha=0.6)
        axes.set_xscale("log")
        axes.set(xlim=(0.8 * _LEAST_M3, 1.25 * _MOST_M3), ylim=(-0.03, 1.03))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_title(f"{domain_name(domain)}, {len(panel.iou)} objects", fontsize=9)
        axes.set_xlabel("hull of the object [m³]", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.grid(color="#efefef", linewidth=0.6)
        axes.set_axisbelow(True)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    figure.axes[0].set_ylabel("point IoU", fontsize=8)
    handles = [Line2D([], [], label=name, **look) for name, look in looks.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=2, fontsize=7, frameon=False)
    return data_address(figure)
