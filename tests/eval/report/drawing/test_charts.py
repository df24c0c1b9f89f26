"""A chart is described once: plotly accepts its interactive form, and the picture holds the same numbers."""

import itertools
import json
from pathlib import Path

import numpy as np
import pandas as pd
import plotly.graph_objects as go
import pytest
from matplotlib.colors import to_hex

from eval.core.charts import Axis, Drawing, Heat, Panel, Series, log_span
from eval.core.figures import picture
from eval.report.drawing.charts import Chart, plotly_figure, plotly_script
from eval.report.regions.charts import draw_free_response, draw_roc, draw_sizes, look_of
from eval.report.scenarios import draw_scenarios
from eval.report.settings.factors import draw_factors, factors
from eval.report.settings.grids import draw_grids
from eval.running.run_data import RunData
from eval.running.runfolder import RunFolder

NAN = float("nan")
TABLE = pd.DataFrame(
    {"domain": ["in", "in", "out"], "variant": ["tunnelcd", "paper", "paper"], "region_auroc_pooled": [0.9, 0.6, 0.5],
     "n_found": [2, 0, 0], "n_observable": [4, 4, 0], "false_regions_per_100m": [0.2, NAN, NAN],
     "recall_at_0.1": [0.9, 0.1, 0.1]}
)  # fmt: skip
SHARE = Axis("share", (0.0, 1.0))


def run(rows: list[dict[str, object]]) -> RunData:
    common = {"family": "narrow", "status": "ok", "is_unchanged_pair": False}
    return RunData(RunFolder(Path("nowhere")), tuple({**common, **row} for row in rows), (), (), {}, ())


def accepted(drawing: Drawing) -> go.Figure:
    """What plotly makes of a chart as the page holds it; it refuses keys and values that it does not know."""
    return go.Figure(json.loads(Chart("a", "", drawing, "").json))


def curves(x_name: str, y_name: str) -> pd.DataFrame:
    """Two methods in distribution, one out of it, and all pairs together, which no chart shows."""
    rows = [("in", "tunnelcd", 0.0, 0.0), ("in", "tunnelcd", 0.5, 0.25), ("in", "tunnelcd", 1.0, 1.0),
            ("in", "paper", 0.0, 0.0), ("in", "paper", 1.0, 1.0), ("out", "paper", 0.0, 0.1),
            ("out", "paper", 40.0, 0.3), ("all", "paper", 0.0, 0.5)]  # fmt: skip
    return pd.DataFrame(rows, columns=["domain", "variant", x_name, y_name])


def roc() -> Chart:
    chart = draw_roc(curves("false_positive_rate", "true_positive_rate"), TABLE, "tunnelcd")
    assert chart is not None
    return chart


def free_response() -> Chart:
    chart = draw_free_response(curves("false_regions_per_100m", "recall"), TABLE)
    assert chart is not None
    return chart


def one_panel(*series: Series, x: Axis = SHARE, y: Axis = SHARE, heat: Heat | None = None) -> Drawing:
    return Drawing([[Panel(x, y, series, "heading", heat)]], 200)


@pytest.mark.parametrize("n_columns", [1, 2, 3])
def test_panels_share_the_room_and_do_not_overlap(n_columns: int) -> None:
    found = plotly_figure(Drawing([[Panel(SHARE, SHARE, [])] * n_columns] * 2, 200))["layout"]
    x = [found[f"xaxis{i + 1}" if i else "xaxis"]["domain"] for i in range(n_columns)]
    assert x[0][0] == 0.0
    assert x[-1][1] == pytest.approx(1.0, abs=1e-3)
    assert all(left[1] < right[0] for left, right in itertools.pairwise(x))
    upper, lower = found["yaxis"]["domain"], found[f"yaxis{n_columns + 1}"]["domain"]
    assert lower[1] < upper[0]


@pytest.mark.parametrize("is_across", [False, True])
def test_intervals_reach_from_low_to_high_on_the_page_and_in_the_picture(is_across: bool) -> None:
    places, values, low, high = [0.2, 0.6], [0.5, 0.7], [0.4, NAN], [0.8, NAN]
    xy = (values, places) if is_across else (places, values)
    drawing = one_panel(Series(*xy, low=low, high=high, is_across=is_across))
    (trace,) = accepted(drawing).data
    bars = trace.error_x if is_across else trace.error_y
    assert (bars.arrayminus[0], bars.array[0]) == pytest.approx((0.1, 0.3))
    assert bars.array[1] is None
    (drawn,) = picture(drawing).axes[0].collections
    ends = drawn.get_segments()[0][:, 0 if is_across else 1]
    np.testing.assert_allclose(ends, [0.4, 0.8])


def test_undefined_is_null_and_no_text_ends_the_script() -> None:
    text = Chart("a", "", one_panel(Series([1.23456789, NAN], [0, 1], name="</script><b>")), "").json
    assert "</" not in text
    found = json.loads(text)["data"][0]
    assert (found["x"], found["name"]) == ([1.2346, None], "&#60;/script&#62;&#60;b&#62;")


def test_page_and_picture_draw_the_same_numbers_in_the_same_looks() -> None:
    for drawing in (roc().drawing, free_response().drawing):
        traces, panels = accepted(drawing).data, picture(drawing).axes
        lines = [line for axes in panels for line in axes.get_lines()]
        assert len(lines) == len(traces)
        for trace, line in zip(traces, lines, strict=True):
            np.testing.assert_allclose(line.get_xydata(), np.column_stack([trace.x, trace.y]), rtol=1e-4)
            colour = trace.line.color if "lines" in trace.mode else trace.marker.color
            assert to_hex(line.get_color()) == colour.lower()
            assert line.get_drawstyle() == ("steps-post" if trace.line.shape == "hv" else "default")
    log_x = accepted(free_response().drawing).layout.xaxis
    np.testing.assert_allclose(10.0 ** np.array(log_x.range), panels[0].get_xlim(), rtol=1e-4)
    assert (log_x.type, panels[0].get_xscale()) == ("log", "log")


def test_each_name_is_once_in_the_legend() -> None:
    for drawing in (roc().drawing, free_response().drawing):
        traces = accepted(drawing).data
        assert sorted(trace.name for trace in traces if trace.showlegend) == ["paper", "tunnelcd"]
        assert {trace.xaxis for trace in traces} == {"x", "x2"}
        (legend,) = picture(drawing).legends
        assert sorted(text.get_text() for text in legend.get_texts()) == ["paper", "tunnelcd"]


def test_known_methods_keep_their_look_and_others_differ() -> None:
    assert [look_of(name, []).dash for name in ("tunnelcd", "paper-paired", "random-regions")] == [
        "solid", "dash", "dot"
    ]  # fmt: skip
    assert look_of("mine", ["mine", "yours"]) != look_of("yours", ["mine", "yours"])


def test_bars_stand_side_by_side_and_a_heat_map_holds_its_values() -> None:
    bars = [Series([0, 1], [value, 1.0], style="bars") for value in (0.2, 0.4)]
    figure, drawn = accepted(one_panel(*bars)), picture(one_panel(*bars)).axes[0].patches
    assert [list(trace.y) for trace in figure.data] == [[0.2, 1.0], [0.4, 1.0]]
    assert [bar.get_height() for bar in drawn] == [0.2, 1.0, 0.4, 1.0]
    assert drawn[0].get_x() + drawn[0].get_width() == pytest.approx(drawn[2].get_x())
    values = np.array([[0.1, 0.2], [0.3, NAN]])
    cells = one_panel(heat=Heat(values, [["a", "b"], ["c", "-"]], 0.0, 1.0))
    (heat,) = accepted(cells).data
    assert list(heat.z[1]) == [0.3, None]
    np.testing.assert_array_equal(np.ma.filled(picture(cells).axes[0].images[0].get_array(), NAN), values)


def test_a_logarithmic_axis_is_marked_at_one_and_three() -> None:
    assert list(Axis("", (0.01, 1.0), is_log=True).marks or ()) == pytest.approx([0.01, 0.03, 0.1, 0.3, 1.0, 3.0])
    assert Axis("", (0.01, 1.0)).marks is None
    assert log_span([0.0, NAN, 2.0, 8.0], 2.0, 3.0) == (1.0, 24.0)
    assert log_span([]) == pytest.approx((1 / 1.5, 1.5))


@pytest.mark.parametrize("n_names", [1, 12])
def test_a_legend_of_long_names_takes_no_room_from_the_panels(n_names: int) -> None:
    names = [
        f"tunnelcd[extract.method=voxel,extract.voxel_m=0.{number:02d},cluster.min_points=32]"
        for number in range(n_names)
    ]
    series = [Series([0.0, 1.0], [0.0, 1.0], look_of(name, names), name) for name in names]
    figure = picture(Drawing([[Panel(SHARE, SHARE, series)]], 200))
    figure.draw_without_rendering()
    (axes,), (legend,) = figure.axes, figure.legends
    panel = axes.get_window_extent()
    assert panel.y1 <= legend.get_window_extent().y0
    assert panel.height / figure.dpi > 0.7 * 200 / 88  # 200 px at 88 px an inch, less what axis and margins take


def test_false_regions_without_end_stay_inside_the_picture() -> None:
    figure = accepted(free_response().drawing)
    line = next(trace for trace in figure.data if trace.xaxis == "x2" and trace.name)
    assert line.x == (0.01, 10.0, 10.0)
    dot = next(trace for trace in figure.data if trace.mode == "markers")
    assert (dot.x, dot.y) == ((0.2,), (0.5,))


def test_bins_carry_their_counts_and_only_the_last_method_its_interval() -> None:
    ends = {"interval_low": 0.2, "interval_high": 0.8}
    bins = [{"low": low, "high": high, "n_changes": n, "recall_at_rate": recall, **ends}
            for low, high, n, recall in ((1.0, np.inf, 2, NAN), (0.0, 1.0, 4, 0.5))]  # fmt: skip
    names = {"measure": "n_returns", "domain": "in"}
    sizes = pd.DataFrame([{**names, "variant": name, **each} for name in ("paper", "tunnelcd") for each in bins])
    chart = draw_sizes(sizes, TABLE, ["tunnelcd"])
    assert chart is not None
    figure = accepted(chart.drawing)
    assert figure.layout.xaxis.ticktext == ("&#60;1<br>n 4", "≥1<br>n 2")
    paper, ours = figure.data
    assert paper.error_y.array is None
    assert (ours.y, ours.error_y.array) == ((0.5, None), pytest.approx((0.3, None)))


def test_what_was_not_scored_has_no_chart() -> None:
    none = pd.DataFrame()
    charts = draw_roc(none, TABLE, ""), draw_free_response(none, TABLE), draw_sizes(none, TABLE, ())
    assert charts == (None, None, None)


def test_a_setting_is_a_line_with_the_presets_own_value_in_its_place() -> None:
    values = {"paper": 0.9, "paper[query.radius_m=3.0]": 0.4, "paper[query.radius_m=6.0]": 0.7}
    rows = [
        {"scenario": "narrow", "seed": seed, "variant": name, "object_iou_point": value + 0.02 * seed}
        for name, value in values.items() for seed in (0, 1)
    ]  # fmt: skip
    # a pair that only one value was run on takes no part
    rows.append({"scenario": "narrow", "seed": 5, "variant": "paper", "object_iou_point": 0.0})
    (factor,) = factors(run(rows))
    assert (factor.preset, factor.key, factor.own) == ("paper", "query.radius_m", "4.5")
    assert list(factor.points) == ["3.0", "4.5", "6.0"]
    (chart,) = draw_factors(run(rows))
    figure = accepted(chart.drawing)
    line, star = figure.data
    assert figure.layout.xaxis.ticktext == ("3.0", "4.5", "6.0")
    assert line.y == pytest.approx((0.41, 0.91, 0.71))
    assert (star.marker.symbol, star.x, star.y) == ("star", (1,), pytest.approx((0.91,)))
    assert "n = 2 session pairs" in chart.caption


def test_a_value_may_be_a_word_among_numbers() -> None:
    values = {"tunnelcd": 0.9, "tunnelcd[query.radius_m=10]": 0.4, "tunnelcd[query.radius_m=4.5]": 0.7}
    rows = [{"scenario": "narrow", "seed": 0, "variant": name, "object_iou_point": v} for name, v in values.items()]
    (factor,) = factors(run(rows))
    assert (list(factor.points), factor.own) == (["4.5", "10", "width"], "width")
    (chart,) = draw_factors(run(rows))
    assert accepted(chart.drawing).layout.xaxis.ticktext == ("4.5", "10", "width")


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
    figure = accepted(chart.drawing)
    iou, seconds = (trace for trace in figure.data if trace.type == "heatmap")
    np.testing.assert_allclose(iou.z, [[0.11, 0.12], [0.21, 0.22]])
    assert [list(row) for row in seconds.text] == [["1", "2"], ["2", "4"]]
    # highest IoU, shortest time
    frames = [trace for trace in figure.data if trace.type == "scatter"]
    assert [(np.mean(frame.x[:4]), np.mean(frame.y[:4])) for frame in frames] == [(1, 1), (0, 0)]
    assert "n = 2 session pairs" in chart.caption


def test_every_scenario_has_a_bar_for_each_method_over_its_pairs() -> None:
    rows = [
        {"scenario": world, "seed": seed, "variant": name, "region_recall_at_k": 0.5, "region_auroc": 0.25 * seed,
         "object_iou_point": 0.1, "object_f1_50": 0.2}
        for world in ("narrow", "wide") for name in ("a", "b") for seed in (1, 3)
    ]  # fmt: skip
    (chart,) = draw_scenarios(run(rows))
    figure = accepted(chart.drawing)
    traces = figure.data
    assert len(traces) == 8
    auroc = [trace for trace in traces if trace.yaxis == "y2"]
    assert figure.layout.xaxis4.ticktext == ("narrow<br>n 2", "wide<br>n 2")
    assert auroc[0].y == (0.5, 0.5)
    # two pairs of 0.25 and 0.75: some draws hold one of them only
    assert auroc[0].error_y.array == pytest.approx((0.25, 0.25))
    assert draw_scenarios(run([row for row in rows if row["seed"] == 1])) == []


def test_the_library_can_stand_inside_a_page() -> None:
    script = plotly_script()
    assert "</script" not in script
    assert len(script) > 1_000_000


def test_a_point_beyond_its_interval_is_drawn() -> None:
    series = Series([0.0, 1.0], [0.5, NAN], low=[0.6, NAN], high=[0.8, NAN])
    np.testing.assert_allclose(series.intervals, [[0.0, NAN], [0.3, NAN]])
    (drawn,) = picture(one_panel(series)).axes[0].collections
    np.testing.assert_allclose(drawn.get_segments()[0][:, 1], [0.5, 0.8])
