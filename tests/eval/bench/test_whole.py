"""The rows of what a user waits for, in the smallest worlds."""

from __future__ import annotations

import json

import pytest

from cdpipe.core.errors import InputError
from eval.bench.bench import list_contests, measure
from eval.bench.whole import WholeSite, whole_contests
from sim.studies.timing import Contest


@pytest.mark.usefixtures("thinned")
def test_rows_of_a_small_world() -> None:
    small = WholeSite(wide="smoke/one_box", training="smoke/one_box", recorded="smoke/one_box", repeats=1)
    rows = {row["name"]: row for row in measure(whole_contests(small))["rows"]}
    assert list(rows) == ["world-smoke/one_box", "dataset-per-process", "detect-60k", "compare-60k"]
    assert all(row["value"] > 0 and row["ratio"] > 0 and row["met"] is not None for row in rows.values())
    assert [row["target"] for row in rows.values()] == [1.0, 1.0, 50.0, 4.0]
    assert rows["world-smoke/one_box"]["rival_value"] == 1.2
    assert rows["dataset-per-process"]["rival_value"] == 25.0
    # seconds of recording per second of work, against one second of recording a second
    assert rows["detect-60k"]["rival_value"] == 1.0
    json.dumps(rows)


def test_a_row_that_cannot_be_measured_costs_no_other() -> None:
    def refuse() -> Contest:
        raise InputError("no place for a prop")

    rows = measure({"refused": refuse, "timed": lambda: Contest("s", (1.0,))})["rows"]
    assert [(row["value"], row["met"], row["reason"]) for row in rows] == [
        (None, False, "no place for a prop"),
        (1.0, None, ""),
    ]


def test_they_stand_in_the_table() -> None:
    assert list(list_contests())[-4:] == ["world-wide", "dataset-per-process", "detect-60k", "compare-60k"]
