"""Which unchanged pairs count as an alarm, worked out by hand."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from eval.tables.alarms import count_alarms, may_be_refused, with_counted_alarms

NAN = float("nan")
# kind of pair, status, whether nothing changed, whether a region was reported, objects; and whether that is an alarm
CASES = [
    ("", "ok", True, 0.0, 0, 0.0),
    ("", "ok", True, 1.0, 0, 1.0),
    ("", "ok", True, 0.0, 1, 1.0),  # objects without a region
    ("", "ok", True, 0.0, NAN, 0.0),
    ("", "merge_refused", True, NAN, NAN, 1.0),  # else who refuses would be silent
    ("same", "failed", True, NAN, 0, 1.0),
    ("smooth", "merge_refused", True, NAN, 0, NAN),
    ("disjoint", "merge_refused", True, NAN, NAN, NAN),
    ("smooth", "ok", True, 0.0, 2, 1.0),
    ("disjoint", "ok", True, 0.0, 0, 0.0),
    ("", "ok", False, NAN, 3, NAN),
    ("", "merge_refused", False, NAN, NAN, NAN),
    ("", "ok", None, NAN, 3, NAN),  # a world that was not made
]


def results() -> pd.DataFrame:
    columns = ["pair_kind", "status", "is_unchanged_pair", "is_alarm", "n_objects", "expected"]
    return pd.DataFrame(CASES, columns=columns)


def test_alarms_by_hand() -> None:
    table = results()
    np.testing.assert_array_equal(count_alarms(table), table["expected"])
    # each row counts for itself
    for row in range(len(table)):
        own = table.iloc[[row]]
        np.testing.assert_array_equal(count_alarms(own), own["expected"])


def test_alarms_of_older_tables() -> None:
    table = results()
    # without objects, kinds of pair, or word on what is unchanged
    of_regions = count_alarms(table.drop(columns="n_objects"))
    np.testing.assert_array_equal(of_regions, table["expected"].mask(table["n_objects"] > 0, table["is_alarm"]))
    refused = (table["status"] != "ok") & table["is_unchanged_pair"].eq(True)
    without_kinds = count_alarms(table.drop(columns="pair_kind"))
    np.testing.assert_array_equal(without_kinds, table["expected"].mask(refused, 1.0))
    np.testing.assert_array_equal(count_alarms(table.drop(columns="is_unchanged_pair")), table["is_alarm"])


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (["True", "False", "", "true"], [1.0, 0.0, NAN, 1.0]),
        ([True, False, None, True], [1.0, 0.0, NAN, 1.0]),
        (["1.0", 0, NAN, 1], [1.0, 0.0, NAN, 1.0]),
    ],
)
def test_alarms_that_were_read_back(cells: list[object], expected: list[float]) -> None:
    table = pd.DataFrame({"is_alarm": pd.Series(cells, dtype=object), "is_unchanged_pair": True, "status": "ok"})
    np.testing.assert_array_equal(count_alarms(table), expected)


def test_a_refusal_can_be_right_where_scans_cannot_tell() -> None:
    assert may_be_refused(results()).tolist() == results()["pair_kind"].isin(["smooth", "disjoint"]).tolist()
    assert not may_be_refused(results().drop(columns="pair_kind")).any()


def test_alarms_are_counted_in_results_but_where_the_plan_ends_at_the_merge() -> None:
    table = results()
    for plan in (None, {}, {"until": "detect"}, {"name": "merge"}, ["merge"]):
        counted = with_counted_alarms(table, plan)
        np.testing.assert_array_equal(counted["is_alarm"], table["expected"])
        pd.testing.assert_frame_equal(counted.drop(columns="is_alarm"), table.drop(columns="is_alarm"))
    assert with_counted_alarms(table, {"until": "merge"}) is table
    without = table.drop(columns="is_alarm")
    assert with_counted_alarms(without, {}) is without
