"""Metrics of others: entry points of the group `tunnelcd.metrics` add columns to results.csv (HOWTO.md beside this)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from numbers import Real

from cdpipe.core.errors import InputError
from cdpipe.core.plugins import METRICS, entry_points, load_entry_point
from cdpipe.io.answer import Answer
from eval.truth.ground_truth import GroundTruth

Metric = Callable[[GroundTruth, Answer], Mapping[str, float]]
"""`metric(truth, answer)`: columns by name; NaN where undefined. `answer.report` is None where a method gave none."""


def compute_plugin_columns(truth: GroundTruth, answer: Answer, taken: Mapping[str, object]) -> dict[str, float]:
    """Return the columns of every registered metric.

    Args:
        truth: The pair's truth.
        answer: What a method answered.
        taken: Columns that the row has already.

    Raises:
        InputError: A metric cannot be imported, gives no numbers, or a column that the row has already.
    """
    columns: dict[str, float] = {}
    for name in entry_points(METRICS):
        metric: Metric = load_entry_point(METRICS, name)
        for column, value in metric(truth, answer).items():
            if column in taken or column in columns:
                raise InputError(f"{METRICS}: {name!r}: column {column!r} exists already: give it another name")
            if not isinstance(value, Real):
                raise InputError(
                    f"{METRICS}: {name!r}: column {column!r} = {value!r}: expected a number, NaN if undefined"
                )
            columns[column] = float(value)
    return columns
