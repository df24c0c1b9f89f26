"""How the columns of results.csv are shown: heading, format, which direction is better, what they mean."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from eval.tables.rows import is_told_the_truth

EN_DASH = "\u2013"
THIN_SPACE = "\u2009"
UNDEFINED = EN_DASH
_BILLIONTH = 1e-9
_WITH_SETTINGS = re.compile(r"[^\[]+\[[\w.-]+=.*\]")
_NEXT_SETTING = re.compile(r",(?=[\w.-]+=)")


def share(value: float) -> str:
    """Write two decimals, for shares and rates."""
    return f"{value:.2f}" if math.isfinite(value) else UNDEFINED


def fine(value: float) -> str:
    """Write three decimals, for errors in metres and degrees."""
    return f"{value:.3f}" if math.isfinite(value) else UNDEFINED


def spaced(variant: str) -> str:
    """Return a variant's name with spaces where a line may break: before and between its settings, at oracles' "+".

    Any other name is shown as it is.
    """
    if is_told_the_truth(variant):
        variant = variant.replace("+", " + ")
    return _NEXT_SETTING.sub(", ", variant.replace("[", " [", 1)) if _WITH_SETTINGS.fullmatch(variant) else variant


def significant(value: float) -> str:
    """Write three significant digits for seconds and volumes, with an exponent below a billionth."""
    if not math.isfinite(value):
        return UNDEFINED
    if abs(value) < _BILLIONTH:  # nothing that is measured; its zeros would push a table off the page
        return f"{value + 0.0:.3g}"
    if abs(value) >= 100:
        return f"{value:.0f}"
    return np.format_float_positional(value, precision=3, fractional=False, unique=False, trim="-")


def count(value: float) -> str:
    """Write a whole number with thin spaces between the thousands; a mean that is not whole gets one decimal."""
    if not math.isfinite(value):
        return UNDEFINED
    return f"{value:,.0f}".replace(",", THIN_SPACE) if value == round(value) else f"{value:.1f}"


def scaled(factor: float) -> Callable[[float], str]:
    """Return what writes three significant digits of a value times a factor, for other units than those of a table."""
    return lambda value: significant(factor * value)


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table.

    Attributes:
        key: Its name in the file.
        heading: What stands above it on the page.
        better: Which direction wins, or None where neither does.
        shown: How a value is written.
        meaning: What it is.
        when_undefined: When it has no value.
        is_newer: Whether tables of earlier versions lack it; a page of these leaves it out.
    """

    key: str
    heading: str
    better: Literal["high", "low"] | None
    shown: Callable[[float], str]
    meaning: str = ""
    when_undefined: str = ""
    is_newer: bool = False


def select(columns: Iterable[Column], *keys: str) -> tuple[Column, ...]:
    """Return the columns of the given keys, in that order."""
    known = {column.key: column for column in columns}
    return tuple(known[key] for key in keys)


_NO_CHANGE = "Undefined where the pair has no observable change."
_NOT_OK = "Undefined where the status is not ok."

RESULT_COLUMNS = (
    Column("region_recall", "region recall", "high", share,
           "Share of the observable changes that a reported region finds: its centre lies within the family's scoring "
           "radius of the change's centroid.", _NO_CHANGE),
    Column("region_precision", "region precision", "high", share,
           "Share of true regions among the reported true and false ones; a second region on a found change counts as "
           "neither.", "0 where none was reported that counts; undefined where nothing changed and none was."),
    Column("region_recall_at_k", "recall at K", "high", share,
           "Region recall of the K best-scored candidates, whatever the threshold says; K is the number of observable "
           "changes.", _NO_CHANGE),
    Column("region_auroc", "AUROC", "high", share,
           "How well the scores along the before path, one per metre, tell places near an observable change from those "
           "far from any; 0.5 is chance, also for a pair without scores or without an answer.",
           "Undefined where a pair has places of one class only."),
    Column("false_regions_per_100m", "false regions / 100 m", "low", share,
           "Reported regions that find no change, per 100 m of the after drive.", _NOT_OK),
    Column("object_iou_point", "object IoU", "high", share,
           "Returns of the answer against returns of the truth, one per 0.1 m cell; best one-to-one match per "
           "observable change, unmatched counts 0, mean over changes.", _NO_CHANGE),
    Column("object_f1_50", "object F1 at 0.5", "high", share,
           "Objects right at an IoU of at least 0.5, as the harmonic mean of their precision and recall.", _NO_CHANGE),
    Column("kind_accuracy", "kind", "high", share,
           "Share of the matched changes that were called added, removed, moved or reshaped rightly.",
           "0 where none was matched; undefined where nothing changed."),
    Column("merge_error_m", "merge error [m]", "low", fine,
           "Median translation error between every metre of the after path and the truly nearest of the before path.",
           _NOT_OK),
    Column("merge_error_deg", "merge error [deg]", "low", fine, "The same in rotation.", _NOT_OK),
    Column("t_total_s", "time [s]", "low", significant,
           "Descriptors, change detection and object extraction of one pair, without the merge; one thread.", _NOT_OK),
)  # fmt: skip

UNCHANGED_COLUMNS = (
    Column("n_regions", "regions", None, count, "Reported regions; each is a false alarm.", _NOT_OK),
    Column("n_objects", "objects", None, count, "Objects cut out of them.", _NOT_OK),
    *select(RESULT_COLUMNS, "false_regions_per_100m", "merge_error_m", "merge_error_deg", "t_total_s"),
)  # fmt: skip

TIME_MEANINGS = (
    ("t_index", "Work a robot does while mapping: the indexing of both maps, once per pair.", ""),
    ("t_merge", "From indexed maps and stored vectors to an accepted transform, once per pair.",
     "The paper gives 0.051 s and 0.184 s; whether with indexing, it does not say."),
    ("t_refine", "Local refinement of the merge along the path, once per pair.", "The paper has none."),
    ("t_descriptor", "Work a robot does while mapping: the vectors of all keyframes of both sessions.",
     "Not part of the paper's table."),
    ("t_cd, t_oe per region", "Detecting changed regions, and cutting objects out of them, divided by the number of "
     "regions.", "Undefined where no region was reported."),
    ("t_total", "Descriptors + change detection + object extraction, per pair.", "The column `time` above."),
    ("with merge", "The same and indexing, merge, refinement.", ""),
    ("as the paper", "Change detection + object extraction only.",
     "The paper's own total holds the merge on site 1 and leaves it out on site 2, so none is quoted."),
    ("V_sphere", "Volume of a region's sphere that is tunnel, by our definition; the paper states none.",
     "The paper's values are 34-58 % of 4/3 π r³."),
    ("V_OE", "Volume of what was cut out of the region, after map only.", "Undefined where nothing was cut out."),
    ("points", "Thinned map points: of both maps; of the after map in a region's sphere and on its objects.",
     "Least and greatest over the regions that find a change."),
)  # fmt: skip
