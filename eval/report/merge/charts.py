"""Charts over the pairs of a run: merge errors against overlap, and times."""

from __future__ import annotations

import numpy as np
import pandas as pd

from cdpipe.core.geometry import stream
from eval.core.charts import BLACK, BLUE, GREEN, ORANGE, VERMILLION, Axis, Drawing, Look, Panel, Series, log_span
from eval.report.merge.tables import stated_seconds
from eval.tables.merge_table import EXACT_M, RIGHT_M, TIMES, is_accepted, kinds
from eval.tables.rows import numbers

_KIND_COLOURS = {"clean": BLUE, "drift": ORANGE, "smooth": GREEN, "disjoint": VERMILLION}
_LEAST_ERROR_M, _MOST_ERROR_M = 1e-4, 300.0
_N_ACROSS = 3
# pairs without an error stand on lines of their own above the errors
_NO_ERROR, _REFUSED, _FAILED = 1e3, 3e3, 9e3
_LINES = {_NO_ERROR: "accepted, no error defined", _REFUSED: "refused", _FAILED: "failed"}
_DOTS, _MEDIAN = Look(BLUE, 0.0, marker="circle", size=2.5, opacity=0.4), Look(BLACK, 1.6)


def error_chart(results: pd.DataFrame) -> Drawing:
    """Draw merge error against true overlap, a panel for each variant; refused and failed pairs stand above.

    Args:
        results: Rows as in results.csv, at least one.
    """
    ticks = {10.0**power: f"{10.0**power:g}" for power in range(-4, 3)} | _LINES
    looks = {EXACT_M: Look(BLACK, 0.8, "dash"), RIGHT_M: Look(BLACK, 0.8), 1.5 * _MOST_ERROR_M: Look("#b0b0b0", 0.8)}
    limits = [Series([-0.04, 1.04], [at_m, at_m], look) for at_m, look in looks.items()]
    panels: list[Panel] = []
    for name, pairs in results.groupby("variant", sort=False):
        is_first = len(panels) % _N_ACROSS == 0
        shown = ticks if is_first else dict.fromkeys(ticks, "")
        y = Axis("merge error [m]" if is_first else "", (_LEAST_ERROR_M / 1.5, 2 * _FAILED), is_log=True, ticks=shown)
        panels.append(Panel(Axis("true overlap", (-0.04, 1.04)), y, [*_error_series(pairs), *limits], str(name)))
    return Drawing([panels[start : start + _N_ACROSS] for start in range(0, len(panels), _N_ACROSS)], 264)


def _error_series(pairs: pd.DataFrame) -> list[Series]:
    errors_m, accepted, kind = numbers(pairs, "merge_error_m"), is_accepted(pairs), kinds(pairs)
    lines = np.select([accepted, pairs["status"] == "merge_refused"], [_NO_ERROR, _REFUSED], default=_FAILED)
    shown_m = np.clip(errors_m, _LEAST_ERROR_M, _MOST_ERROR_M)
    heights = np.where(accepted & ~np.isnan(errors_m), shown_m, lines)
    # an overlap is undefined where nothing could be made; such a pair is shown at the left border
    overlaps = np.nan_to_num(numbers(pairs, "overlap_true"), nan=0.0)
    found = []
    for name in dict.fromkeys(kind):
        for of_accepted, marker in ((True, "circle"), (False, "x")):
            own = (kind == name) & (accepted == of_accepted)
            look = Look(_KIND_COLOURS.get(name, BLACK), 0.0, marker=marker, size=4.0, opacity=0.75)
            found.append(Series(overlaps[own], heights[own], look, name))
    return found


def time_chart(results: pd.DataFrame) -> Drawing:
    """Draw the seconds of every accepted pair, a panel for each part of the merge and a row for each variant.

    A bar marks the median of a variant, and the number of its pairs stands beside it.

    Args:
        results: Rows as in results.csv, at least one.
    """
    variants = {str(name): own for name, own in results.groupby("variant", sort=False)}
    panels: list[Panel] = []
    for column in TIMES:
        low, high = log_span(stated_seconds(results, column), 1.5, 3.0)
        series = []
        for row, own in enumerate(variants.values()):
            seconds = stated_seconds(own, column)
            shifts = stream(0, "page", "strip").uniform(-0.22, 0.22, len(seconds))
            series.append(Series(seconds, row + shifts, _DOTS))
            if len(seconds):
                series.append(Series([np.median(seconds)] * 2, [row - 0.34, row + 0.34], _MEDIAN))
            series.append(Series([high], [row + 0.3], Look(width=0.0), labels=[f"n {len(seconds)}"]))
        ticks = {float(row): "" if panels else name for row, name in enumerate(variants)}
        y = Axis(span=(len(variants) - 0.5, -0.5), ticks=ticks)
        panels.append(Panel(Axis(f"{column.removesuffix('_s')} [s]", (low, high), is_log=True), y, series))
    return Drawing([panels], 35 + 28 * len(variants))
