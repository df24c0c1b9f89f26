"""Differences with their intervals, one line for each setting: which settings change a result and which do not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from eval.core.charts import BLACK, COLOURS, SYMBOLS, Axis, Drawing, Look, Panel, Series

_ROW_PX, _LINES_PER_ROW, _MARGIN_PX = 30, 0.45, 50
_ZERO = Look(BLACK, 0.8)


@dataclass(frozen=True, slots=True)
class Effect:
    """The difference that a setting makes to one figure of a variant, and its interval; NaN where undefined."""

    setting: str
    variant: str
    difference: float
    low: float
    high: float


def effect_chart(panels: Mapping[str, Sequence[Effect]]) -> Drawing:
    """Draw one panel for each figure: settings from top to bottom, a dot and a line for each variant.

    Args:
        panels: The effects on each figure, by its name; settings and variants in the order in which they come.
    """
    every = [effect for effects in panels.values() for effect in effects]
    settings = list(dict.fromkeys(effect.setting for effect in every))
    names = [setting.replace(", ", ",\n") for setting in settings]
    # a row is as high as its name needs
    heights = np.maximum(1.0, _LINES_PER_ROW * np.array([1 + name.count("\n") for name in names]))
    middles = dict(zip(settings, (np.cumsum(heights) - heights / 2).tolist(), strict=True))
    variants = list(dict.fromkeys(effect.variant for effect in every))
    bottom = float(heights.sum())
    row: list[Panel] = []
    for name, effects in panels.items():
        ticks = {place: "" if row else text for place, text in zip(middles.values(), names, strict=True)}
        zero = Series([0.0, 0.0], [0.0, bottom], _ZERO)
        series = [_series(effects, order, variants, middles) for order in range(len(variants))]
        row.append(Panel(Axis(f"difference of {name}"), Axis(span=(bottom, 0.0), ticks=ticks), [zero, *series]))
    return Drawing([row], round(_MARGIN_PX + _ROW_PX * bottom))


def _series(effects: Sequence[Effect], order: int, variants: Sequence[str], middles: Mapping[str, float]) -> Series:
    own = [effect for effect in effects if effect.variant == variants[order]]
    step = 0.6 / max(len(variants), 2)
    rows = [middles[effect.setting] + (order - (len(variants) - 1) / 2) * step for effect in own]
    look = Look(COLOURS[(order + 1) % len(COLOURS)], 0.0, marker=SYMBOLS[order % len(SYMBOLS)], size=4.5)
    low, high = [effect.low for effect in own], [effect.high for effect in own]
    differences = [effect.difference for effect in own]
    return Series(differences, rows, look, variants[order], low=low, high=high, is_across=True)
