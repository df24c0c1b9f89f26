"""Charts are figures that plotly itself accepts, and JSON that can stand inside a page."""

import itertools
import json
import math
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import pytest

from eval.report.charts import Chart, error_bars, layout, line_of, plotly_script
from eval.report.regions.charts import free_response_figure, roc_figure, size_figure
from eval.report.regions.plots import Bins, Curve, line_look
from eval.report.scenarios import draw_scenarios
from eval.report.settings.factors import draw_factors, factors
from eval.report.settings.grids import draw_grids
from eval.running.run_data import RunData
from eval.running.runfolder import RunFolder

RISING = np.array([0.0, 0.5, 1.0])
CURVES = {"in": {"tunnelcd": Curve(RISING, RISING**2, (0.2, 0.5)), "paper": Curve(RISING, RISING)},
          "out": {"paper": Curve(np.array([0.0, 40.0]), np.array([0.1, 0.3]))}}  # fmt: skip


def run(rows: list[dict[str, object]]) -> RunData:
    common = {"family": "narrow", "status": "ok", "is_unchanged_pair": False}
    return RunData(RunFolder(Path("nowhere")), tuple({**common, **row} for row in rows), (), (), {}, ())


def accepted(figure: dict[str, object]) -> go.Figure:
    """What plotly makes of a figure as the page holds it; it refuses keys and values that it does not know."""
    return go.Figure(json.loads(Chart("a", "", figure, "").json))


@pytest.mark.parametrize("n_columns", [1, 2, 3])
def test_panels_share_the_room_and_do_not_overlap(n_columns: int) -> None:
    found = layout(n_columns, 2, 200)
    x = [found[f"xaxis{i + 1}" if i else "xaxis"]["domain"] for i in range(n_columns)]
    assert x[0][0] == 0.0
    assert x[-1][1] == pytest.approx(1.0, abs=1e-3)
    assert all(left[1] < right[0] for left, right in itertools.pairwise(x))
    upper, lower = found["yaxis"]["domain"], found[f"yaxis{n_columns + 1}"]["domain"]
    assert lower[1] < upper[0]


def test_error_bars_reach_from_low_to_high() -> None:
    bars = error_bars([0.5, 0.7], [0.4, math.nan], [0.8, math.nan])
    assert (bars["arrayminus"][0], bars["array"][0]) == pytest.approx((0.1, 0.3))
    assert np.isnan(bars["array"][1])


def test_undefined_is_null_and_no_text_ends_the_script() -> None:
    figure = {"data": [{"x": np.array([1.23456789, np.nan]), "name": "</script><b>"}], "layout": {"height": 9}}
    text = Chart("a", "", figure, "").json
    assert "</" not in text
    found = json.loads(text)["data"][0]
    assert found == {"x": [1.2346, None], "name": "</script><b>"}


def test_a_method_looks_alike_on_the_page_and_on_paper() -> None:
    for name in ("tunnelcd", "paper-paired", "random-regions", "mine"):
        look, line = line_look(name, ["mine"]), line_of(name, ["mine"])
        assert (line["color"], line["width"]) == (look["color"], look["linewidth"])
    assert [line_of(name, [])["dash"] for name in ("tunnelcd", "paper-paired", "random-regions")] == [
        "solid", "dash", "dot"
    ]  # fmt: skip


def test_curves_of_all_panels_are_there_and_each_name_once_in_the_legend() -> None:
    for figure in (roc_figure(CURVES), free_response_figure(CURVES, (0.1, 0.5))):
        traces = accepted(figure).data
        assert sorted(trace.name for trace in traces if trace.showlegend) == ["paper", "tunnelcd"]
        assert {trace.xaxis for trace in traces} == {"x", "x2"}


def test_false_regions_without_end_stay_inside_the_picture() -> None:
    figure = accepted(free_response_figure(CURVES, ()))
    line = next(trace for trace in figure.data if trace.xaxis == "x2")
    assert line.x == (0.01, 10.0, 10.0)
    dot = next(trace for trace in figure.data if trace.mode == "markers")
    assert (dot.x, dot.y) == ((0.2,), (0.5,))


def test_bins_carry_their_counts_and_only_the_last_method_its_interval() -> None:
    bins = Bins(("<1\n4", "≥1\n2"), np.array([0.5, np.nan]), np.array([0.2, np.nan]), np.array([0.8, np.nan]))
    figure = accepted(size_figure({"in": {"hull [m³]": {"paper": bins, "tunnelcd": bins}}}))
    assert figure.layout.xaxis.ticktext == ("<1<br>n 4", "≥1<br>n 2")
    paper, ours = figure.data
    assert paper.error_y.array is None
    assert ours.error_y.array == pytest.approx((0.3, None))


def test_a_setting_is_a_line_with_the_presets_own_value_in_its_place() -> None:
    values = {"tunnelcd": 0.9, "tunnelcd[query.radius_m=3.0]": 0.4, "tunnelcd[query.radius_m=6.0]": 0.7}
    rows = [
        {"scenario": "narrow", "seed": seed, "variant": name, "object_iou_point": value + 0.02 * seed}
        for name, value in values.items() for seed in (0, 1)
    ]  # fmt: skip
    # a pair that only one value was run on takes no part
    rows.append({"scenario": "narrow", "seed": 5, "variant": "tunnelcd", "object_iou_point": 0.0})
    (factor,) = factors(run(rows))
    assert (factor.preset, factor.key, factor.own) == ("tunnelcd", "query.radius_m", "4.5")
    assert list(factor.points) == ["3.0", "4.5", "6.0"]
    (chart,) = draw_factors(run(rows))
    (line,) = accepted(chart.figure).data
    assert line.x == ("3.0", "4.5", "6.0")
    assert line.y == pytest.approx((0.41, 0.91, 0.71))
    assert line.marker.symbol == ("circle", "star", "circle")
    assert "n = 2 session pairs" in chart.caption


def test_a_lone_value_is_no_setting_to_draw() -> None:
    rows = [{"scenario": "narrow", "seed": 0, "variant": "x[query.radius_m=3.0]", "object_iou_point": 0.5}]
    assert factors(run(rows)) == []


def test_a_grid_holds_means_and_frames_the_best_as_written() -> None:
    rows = [
        {"scenario": "narrow", "seed": seed, "variant": f"p[a.x={a},b.y={b}]", "object_iou_point": 0.1 * a + 0.01 * b,
         "t_total_s": float(a * b)}
        for a in (1, 2) for b in (1, 2) for seed in (0, 1)
    ]  # fmt: skip
    (chart,) = draw_grids(run(rows))
    figure = accepted(chart.figure)
    iou, seconds = figure.data
    np.testing.assert_allclose(iou.z, [[0.11, 0.12], [0.21, 0.22]])
    assert [list(row) for row in seconds.text] == [["1", "2"], ["2", "4"]]
    # highest IoU, shortest time
    assert [(shape.x0 + 0.48, shape.y0 + 0.48) for shape in figure.layout.shapes] == [(1, 1), (0, 0)]
    assert "n = 2 session pairs" in chart.caption


def test_every_scenario_has_a_bar_for_each_method_over_its_pairs() -> None:
    rows = [
        {"scenario": world, "seed": seed, "variant": name, "region_recall_at_k": 0.5, "region_auroc": 0.25 * seed,
         "object_iou_point": 0.1}
        for world in ("narrow", "wide") for name in ("a", "b") for seed in (1, 3)
    ]  # fmt: skip
    (chart,) = draw_scenarios(run(rows))
    traces = accepted(chart.figure).data
    assert len(traces) == 6
    auroc = [trace for trace in traces if trace.yaxis == "y2"]
    assert auroc[0].x == ("narrow<br>n 2", "wide<br>n 2")
    assert auroc[0].y == (0.5, 0.5)
    # two pairs of 0.25 and 0.75: some draws hold one of them only
    assert auroc[0].error_y.array == pytest.approx((0.25, 0.25))
    assert draw_scenarios(run([row for row in rows if row["seed"] == 1])) == []


def test_the_library_can_stand_inside_a_page() -> None:
    script = plotly_script()
    assert "</script" not in script
    assert len(script) > 1_000_000
