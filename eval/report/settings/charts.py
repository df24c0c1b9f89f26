"""Differences with their intervals, one line for each setting: which settings change a result and which do not."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from eval.core.charts import BLACK, COLOURS, SYMBOLS, Axis, Drawing, Look, Panel, Series

_ROW_PX, _LINES_PER_ROW, _MARGIN_PX = 30, 0.45, 50
_ZERO = Look(BLACK, 0.8)


def effect_chart(panels: Mapping[str, pd.DataFrame]) -> Drawing:
    """Draw one panel for each figure: settings from top to bottom, a dot and a line for each variant.

    Args:
        panels: By the name of the figure, a row for each effect on it: `setting`, `variant`, `difference` and its
            interval `low` to `high`, NaN where undefined; settings and variants in the order in which they come.
    """
    every = pd.concat(panels.values())
    settings, variants = (list(every[name].unique()) for name in ("setting", "variant"))
    names = [setting.replace(", ", ",\n") for setting in settings]
    # a row is as high as its name needs
    heights = np.maximum(1.0, _LINES_PER_ROW * np.array([1 + name.count("\n") for name in names]))
    middles = dict(zip(settings, (np.cumsum(heights) - heights / 2).tolist(), strict=True))
    bottom = float(heights.sum())
    step = 0.6 / max(len(variants), 2)
    row: list[Panel] = []
    for figure, effects in panels.items():
        series = [Series([0.0, 0.0], [0.0, bottom], _ZERO)]
        for order, variant in enumerate(variants):
            own = effects[effects["variant"] == variant]
            places = own["setting"].map(middles) + (order - (len(variants) - 1) / 2) * step
            look = Look(COLOURS[(order + 1) % len(COLOURS)], 0.0, marker=SYMBOLS[order % len(SYMBOLS)], size=4.5)
            ends = {"low": own["low"], "high": own["high"]}
            series.append(Series(own["difference"], places.tolist(), look, variant, is_across=True, **ends))
        ticks = {place: "" if row else text for place, text in zip(middles.values(), names, strict=True)}
        row.append(Panel(Axis(f"difference of {figure}"), Axis(span=(bottom, 0.0), ticks=ticks), series))
    return Drawing([row], round(_MARGIN_PX + _ROW_PX * bottom))
