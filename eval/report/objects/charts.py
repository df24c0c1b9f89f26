"""How the IoU of an object depends on its size: every object of one method, and what each method reaches by size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cdpipe.core.geometry import Float64Array
from eval.core.charts import Axis, Drawing, Look, Panel, Series
from eval.core.domains import domain_name
from eval.report.regions.charts import look_of

_DOTS = Look("#a8a8a8", 0.0, marker="circle", size=3.0)
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


def iou_by_size_chart(panels: Mapping[str, SizePanel], names: Sequence[str]) -> Drawing:
    """Draw point IoU over the volume of the hull, a panel for each domain; dots and bars are of the first method.

    Args:
        panels: By domain.
        names: All methods, the first one first.
    """
    row: list[Panel] = []
    for domain, panel in panels.items():
        series = [Series(np.clip(panel.volume_m3, _LEAST_M3, _MOST_M3), panel.iou, _DOTS)]
        for name, line in panel.lines.items():
            low, high = (line.low, line.high) if name == names[0] else (None, None)
            look = replace(look_of(name, names), marker="circle", size=3.0)
            series.append(Series(line.volume_m3, line.iou, look, name, low=low, high=high))
        x = Axis("hull of the object [m³]", (0.8 * _LEAST_M3, 1.25 * _MOST_M3), is_log=True)
        y = Axis("" if row else "point IoU", (-0.03, 1.03))
        row.append(Panel(x, y, series, f"{domain_name(domain)}, {len(panel.iou)} objects"))
    return Drawing([row], 325)
