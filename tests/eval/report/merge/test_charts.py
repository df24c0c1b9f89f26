"""The charts of the merge: which pairs stand where."""

import numpy as np
import pandas as pd

from eval.core.charts import Series
from eval.core.figures import picture
from eval.report.merge.charts import error_chart, time_chart
from eval.tables.merge_table import EXACT_M, RIGHT_M

NAN = float("nan")


def points(series: Series) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in zip(np.ravel(series.x), np.ravel(series.y), strict=True)]


def test_errors_stand_at_their_height_and_pairs_without_one_above_them_all() -> None:
    results = pd.DataFrame({
        "variant": "ours",
        "pair_kind": ["clean", "clean", "drift", "drift", "drift"],
        "overlap_true": [0.3, 0.5, 0.9, 0.4, NAN],
        "merge_error_m": [0.01, 1e-9, NAN, NAN, 1e9],
        "status": ["ok", "ok", "ok", "merge_refused", "died"],
    })  # fmt: skip
    ((panel,),) = error_chart(results).rows
    drawn = [(each.name, each.look.marker, points(each)) for each in panel.series if each.name and len(points(each))]
    height = {name: at for at, name in (panel.y.ticks or {}).items()}
    assert drawn == [
        # an error of 1e-9 m is drawn at 0.1 mm
        ("clean", "circle", [(0.3, 0.01), (0.5, 1e-4)]),
        ("drift", "circle", [(0.9, height["accepted, no error defined"])]),
        ("drift", "x", [(0.4, height["refused"]), (0.0, height["failed"])]),
    ]
    assert min(height[name] for name in ("accepted, no error defined", "refused", "failed")) > 300.0
    limits = [points(each)[0][1] for each in panel.series if not each.name]
    assert limits[:2] == [EXACT_M, RIGHT_M]


def test_three_variants_share_a_row_and_one_axis() -> None:
    one = {"pair_kind": "clean", "overlap_true": 0.5, "merge_error_m": 0.01, "status": "ok"}
    rows = error_chart(pd.DataFrame([{"variant": name, **one} for name in "abcd"])).rows
    assert [[panel.heading for panel in row] for row in rows] == [["a", "b", "c"], ["d"]]
    assert len({panel.y.span for row in rows for panel in row}) == 1
    assert [any((panel.y.ticks or {}).values()) for panel in rows[0]] == [True, False, False]


def test_times_have_a_row_a_median_and_a_count_for_each_variant() -> None:
    seconds = {"ours": (0.05, 0.01, 0.3), "theirs": (1.0, 2.0, NAN)}
    results = pd.DataFrame([{"variant": name, "t_merge_s": value} for name, own in seconds.items() for value in own])
    ((_, panel, other),) = time_chart(results).rows
    assert (panel.x.title, panel.y.span) == ("t_merge [s]", (1.5, -0.5))
    medians = [points(each) for each in panel.series if each.look.width > 0]
    assert [(ends[0][0], round(np.mean([y for _, y in ends]))) for ends in medians] == [(0.05, 0), (1.5, 1)]
    assert [label for each in panel.series for label in each.labels] == ["n 3", "n 2"]
    for each in panel.series:
        assert all(panel.x.span[0] <= x <= panel.x.span[1] for x, _ in points(each))
    # no pair states the time of the third part
    assert [label for each in other.series for label in each.labels] == ["n 0", "n 0"]
    assert len(picture(time_chart(results)).axes) == 3
