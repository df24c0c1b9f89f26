"""Charts over the pairs of a run: merge errors against overlap, and times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cdpipe.core.geometry import Float64Array, stream
from eval.core.charts import BLACK, BLUE, GREEN, ORANGE, VERMILLION, Axis, Drawing, Look, Panel, Series, log_span

_KIND_COLOURS = {"clean": BLUE, "drift": ORANGE, "smooth": GREEN, "disjoint": VERMILLION}
_LEAST_ERROR_M, _MOST_ERROR_M = 1e-4, 300.0
_N_ACROSS = 3
# pairs without an error stand on lines of their own above the errors
_LINES = {"accepted, no error defined": 1e3, "refused": 3e3, "failed": 9e3}
_DOTS, _MEDIAN = Look(BLUE, 0.0, marker="circle", size=2.5, opacity=0.4), Look(BLACK, 1.6)


@dataclass(frozen=True, slots=True, eq=False)
class MergedPairs:
    """What the chart of errors shows of N pairs and one variant.

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


def error_chart(variants: Mapping[str, MergedPairs], exact_m: float, right_m: float) -> Drawing:
    """Draw merge error against true overlap, a panel for each variant; refused and failed pairs stand above.

    Args:
        variants: What to draw, by variant; at least one.
        exact_m: Line of the target for exact merges, metres.
        right_m: Line above which a merge is wrong, metres.
    """
    ticks = {10.0**power: f"{10.0**power:g}" for power in range(-4, 3)} | {at: name for name, at in _LINES.items()}
    looks = {exact_m: Look(BLACK, 0.8, "dash"), right_m: Look(BLACK, 0.8), 1.5 * _MOST_ERROR_M: Look("#b0b0b0", 0.8)}
    limits = [Series([-0.04, 1.04], [at_m, at_m], look) for at_m, look in looks.items()]
    panels: list[Panel] = []
    for name, pairs in variants.items():
        is_first = len(panels) % _N_ACROSS == 0
        shown = ticks if is_first else dict.fromkeys(ticks, "")
        span = (_LEAST_ERROR_M / 1.5, 2 * max(_LINES.values()))
        y = Axis("merge error [m]" if is_first else "", span, is_log=True, ticks=shown)
        panels.append(Panel(Axis("true overlap", (-0.04, 1.04)), y, [*_error_series(pairs), *limits], name))
    return Drawing([panels[start : start + _N_ACROSS] for start in range(0, len(panels), _N_ACROSS)], 264)


def _error_series(pairs: MergedPairs) -> list[Series]:
    is_accepted = np.array([outcome == "accepted" for outcome in pairs.outcomes])
    lines = np.array([
        _LINES["accepted, no error defined" if outcome == "accepted" else outcome] for outcome in pairs.outcomes
    ])  # fmt: skip
    errors_m = np.clip(pairs.errors_m, _LEAST_ERROR_M, _MOST_ERROR_M)
    heights = np.where(is_accepted & ~np.isnan(pairs.errors_m), errors_m, lines)
    # an overlap is undefined where nothing could be made; such a pair is shown at the left border
    overlaps = np.nan_to_num(pairs.overlaps, nan=0.0)
    kinds = np.array(pairs.kinds)
    found = []
    for kind in dict.fromkeys(pairs.kinds):
        for of_accepted, marker in ((True, "circle"), (False, "x")):
            own = (kinds == kind) & (is_accepted == of_accepted)
            look = Look(_KIND_COLOURS.get(kind, BLACK), 0.0, marker=marker, size=4.0, opacity=0.75)
            found.append(Series(overlaps[own], heights[own], look, kind))
    return found


def time_chart(times: Mapping[str, Mapping[str, Float64Array]]) -> Drawing:
    """Draw the seconds of every accepted pair, a panel for each part of the merge and a row for each variant.

    Args:
        times: For each panel's name the (N,) defined seconds of each variant; a bar marks their median, and
            their number stands beside them.
    """
    variants = list(dict.fromkeys(name for panel in times.values() for name in panel))
    panels: list[Panel] = []
    for title, panel in times.items():
        known = {name: seconds[seconds > 0] for name, seconds in panel.items()}
        low, high = log_span(np.concatenate([*known.values(), np.zeros(0)]), 1.5, 3.0)
        series = []
        for row, name in enumerate(variants):
            seconds = known.get(name, np.zeros(0))
            shifts = stream(0, "page", "strip").uniform(-0.22, 0.22, len(seconds))
            series.append(Series(seconds, row + shifts, _DOTS))
            if len(seconds):
                series.append(Series([np.median(seconds)] * 2, [row - 0.34, row + 0.34], _MEDIAN))
            series.append(Series([high], [row + 0.3], Look(width=0.0), labels=[f"n {len(seconds)}"]))
        ticks = {float(row): "" if panels else name for row, name in enumerate(variants)}
        y = Axis(span=(len(variants) - 0.5, -0.5), ticks=ticks)
        panels.append(Panel(Axis(title, (low, high), is_log=True), y, series))
    return Drawing([panels], 35 + 28 * len(variants))
