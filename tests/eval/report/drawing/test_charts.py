"""A chart is described once: the elements of the page and the picture hold the same numbers."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex

from eval.core.charts import Axis, Drawing, Heat, Look, Panel, Series, log_span
from eval.core.figures import picture
from eval.report.drawing.charts import Chart
from eval.report.drawing.looks import look_of
from eval.report.drawing.marks import trace_line
from eval.report.regions.charts import draw_free_response, draw_roc, draw_sizes
from eval.report.scenarios import draw_scenarios
from eval.report.settings.factors import draw_factors, factors
from eval.report.settings.grids import draw_grids, name_equal_grids
from eval.running.results.run_data import RunData
from eval.running.runfolder import RunFolder
from tests.eval.report.drawing.drawn import DrawnSeries, read_panels

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


def drawn_series(drawing: Drawing) -> list[DrawnSeries]:
    """The series of the only panel of a drawing."""
    ((panel,),) = read_panels(drawing)
    return panel.series


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


@pytest.mark.parametrize("n_columns", [1, 2, 3, 4])
def test_every_panel_is_an_image_of_its_own_with_its_axes_inside(n_columns: int) -> None:
    rows = read_panels(Drawing([[Panel(SHARE, SHARE, [], "heading")] * n_columns] * 2, 200))
    assert [len(row) for row in rows] == [n_columns] * 2
    for panel in itertools.chain(*rows):
        assert panel.x_px[0] > 30 and panel.x_px[1] - panel.x_px[0] > 200
        assert panel.y_px[1] - panel.y_px[0] == 200
        assert panel.texts["heading"] == ["heading"] and panel.texts["title"] == ["share", "share"]
        assert panel.texts["tick"] == panel.texts["tick end"] == ["0", "0.2", "0.4", "0.6", "0.8", "1"]


@pytest.mark.parametrize("is_across", [False, True])
def test_intervals_reach_from_low_to_high_on_the_page_and_in_the_picture(is_across: bool) -> None:
    places, values, low, high = [0.2, 0.6], [0.5, 0.7], [0.4, NAN], [0.8, NAN]
    xy = (values, places) if is_across else (places, values)
    drawing = one_panel(Series(*xy, low=low, high=high, is_across=is_across))
    (series,) = drawn_series(drawing)
    np.testing.assert_allclose(series.ends[:, 0 if is_across else 1], [0.4, 0.8], atol=1e-3)
    (drawn,) = picture(drawing).axes[0].collections
    ends = drawn.get_segments()[0][:, 0 if is_across else 1]
    np.testing.assert_allclose(ends, [0.4, 0.8])


def test_a_line_is_broken_where_it_is_undefined_and_names_are_text() -> None:
    drawing = one_panel(Series([0.0, 0.1, NAN, 0.3], [0, 1, 1, 0], name="</script><b>", hover=["<i>", "", "", ""]))
    (series,) = drawn_series(drawing)
    assert series.elements["line"].attrib["d"].count("M") == 2
    assert (series.name, series.texts) == ("</script><b>", '["<i>", "", "", ""]')
    ((panel,),) = Chart("a", "", drawing, "").rows
    assert "<i>" not in panel and "</script" not in panel


def test_a_trace_leaves_out_what_is_drawn_already() -> None:
    x, y = np.array([0.0, 1.0, 1.04, 5.0]), np.array([2.0, 3.0, 3.04, NAN])
    assert trace_line(x, y, is_stepped=False) == "M0 2L1 3"
    assert trace_line(x[:2], y[:2], is_stepped=True) == "M0 2H1V3"


def test_page_and_picture_draw_the_same_numbers_in_the_same_looks() -> None:
    for drawing in (roc().drawing, free_response().drawing):
        (row,) = read_panels(drawing)
        for panel, axes in zip(row, picture(drawing).axes, strict=True):
            lines = {(line.get_xydata().tobytes(), to_hex(line.get_color())) for line in axes.get_lines()}
            assert len(panel.series) == len(lines)
            for series in panel.series:
                ends = series.points[[0, -1]]
                assert any(
                    np.allclose(np.frombuffer(data).reshape(-1, 2)[[0, -1]], ends, rtol=0.02, atol=3e-3)
                    and colour == series.colour.lower()
                    for data, colour in lines
                )
    log_x = picture(free_response().drawing).axes[0]
    assert log_x.get_xscale() == "log"


def test_each_name_is_once_in_the_legend() -> None:
    for chart in (roc(), free_response()):
        assert sorted(name for name, _ in chart.legend) == ["paper", "tunnelcd"]
        named = [{series.name for series in panel.series} - {""} for panel in read_panels(chart.drawing)[0]]
        assert named == [{"paper", "tunnelcd"}, {"paper"}]
        (legend,) = picture(chart.drawing).legends
        assert sorted(text.get_text() for text in legend.get_texts()) == ["paper", "tunnelcd"]


def test_what_is_told_the_truth_lies_behind_the_others() -> None:
    lines = [Series([0, 1], [0, 1], look_of(name), name) for name in ("tunnelcd", "oracle-merge", "paper")]
    assert [series.name for series in drawn_series(one_panel(*lines))] == ["oracle-merge", "tunnelcd", "paper"]


def test_bars_stand_side_by_side_and_a_heat_map_holds_its_values() -> None:
    bars = [Series([0, 1], [value, 1.0], Look(marker="circle"), style="bars", hover="{y:.1f}") for value in (0.2, 0.4)]
    drawing = one_panel(*bars, x=Axis(ticks={0.0: "a", 1.0: "b"}))
    first, second = drawn_series(drawing)
    np.testing.assert_allclose(first.points, [[-0.1875, 0.2], [0.8125, 1.0]], atol=5e-3)
    np.testing.assert_allclose(second.points, [[0.1875, 0.4], [1.1875, 1.0]], atol=5e-3)
    drawn = picture(drawing).axes[0].patches
    assert [bar.get_height() for bar in drawn] == [0.2, 1.0, 0.4, 1.0]
    assert drawn[0].get_x() + drawn[0].get_width() == pytest.approx(drawn[2].get_x())
    values = np.array([[0.0, 1.0], [0.5, NAN]])
    cells = one_panel(heat=Heat(values, [["a", "b"], ["c", "-"]], 0.0, 1.0))
    ((panel,),) = read_panels(cells)
    # halfway between #ffffff and #6baed6
    assert panel.cells == [("a", "#ffffff"), ("b", "#6baed6"), ("c", "#b5d6ea"), ("-", "#fff")]
    np.testing.assert_array_equal(np.ma.filled(picture(cells).axes[0].images[0].get_array(), NAN), values)


def test_a_line_through_many_points_carries_few_markers() -> None:
    series = Series(np.linspace(0, 1, 13), np.linspace(0, 1, 13), look_of("c2c"), "c2c")
    (line,), (dots,) = (
        drawn_series(one_panel(replace(series, look=look))) for look in (series.look, replace(series.look, width=0.0))
    )
    assert line.elements["marks"].attrib["d"].count("M") == 5
    assert dots.elements["marks"].attrib["d"].count("M") == 13


def test_an_axis_without_ends_has_room_for_its_data() -> None:
    ((panel,),) = read_panels(
        one_panel(Series([1.0, 3.0], [2.0, NAN], low=[1.0, NAN], high=[5.0, NAN]), x=Axis(), y=Axis())
    )
    assert panel.texts["tick"] == ["1", "1.5", "2", "2.5", "3"]
    assert panel.texts["tick end"] == ["1", "2", "3", "4", "5"]


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
    series = [Series([0.0, 1.0], [0.0, 1.0], look_of(name), name) for name in names]
    figure = picture(Drawing([[Panel(SHARE, SHARE, series)]], 200))
    figure.draw_without_rendering()
    (axes,), (legend,) = figure.axes, figure.legends
    panel = axes.get_window_extent()
    assert panel.y1 <= legend.get_window_extent().y0
    assert panel.height / figure.dpi > 0.7 * 200 / 88  # 200 px at 88 px an inch, less what axis and margins take


def test_false_regions_without_end_stay_inside_the_picture() -> None:
    inside, outside = read_panels(free_response().drawing)[0]
    (line,) = (series for series in outside.series if series.name)
    np.testing.assert_allclose(line.points[[0, -1], 0], [0.01, 10.0], rtol=0.02)
    (dot,) = (series for series in inside.series if series.name == "tunnelcd" and "line" not in series.elements)
    np.testing.assert_allclose(dot.points, [[0.2, 0.5]], rtol=0.02)


def test_bins_carry_their_counts_and_only_the_last_method_its_interval() -> None:
    ends = {"interval_low": 0.2, "interval_high": 0.8}
    bins = [{"low": low, "high": high, "n_changes": n, "recall_at_rate": recall, **ends}
            for low, high, n, recall in ((1.0, np.inf, 2, NAN), (0.0, 1.0, 4, 0.5))]  # fmt: skip
    names = {"measure": "n_returns", "domain": "in"}
    sizes = pd.DataFrame([{**names, "variant": name, **each} for name in ("paper", "tunnelcd") for each in bins])
    chart = draw_sizes(sizes, TABLE, ["tunnelcd"])
    assert chart is not None
    ((panel,),) = read_panels(chart.drawing)
    assert panel.texts["tick"] == ["<1\nn 4", "≥1\nn 2"]
    paper, ours = panel.series
    assert len(paper.ends) == 0
    np.testing.assert_allclose(ours.points[:, 1], [0.5], atol=5e-3)
    np.testing.assert_allclose(ours.ends[:, 1], [0.2, 0.8], atol=5e-3)


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
    ((panel,),) = read_panels(chart.drawing)
    line, star = panel.series
    assert panel.texts["tick"] == ["3.0", "4.5", "6.0"]
    np.testing.assert_allclose(line.points[:, 1], [0.41, 0.91, 0.71], atol=5e-3)
    assert "line" not in star.elements and star.elements["marks"].attrib["d"].count("M") == 1
    assert "n = 2 session pairs" in chart.caption


def test_a_value_may_be_a_word_among_numbers() -> None:
    values = {"tunnelcd": 0.9, "tunnelcd[query.radius_m=10]": 0.4, "tunnelcd[query.radius_m=4.5]": 0.7}
    rows = [{"scenario": "narrow", "seed": 0, "variant": name, "object_iou_point": v} for name, v in values.items()]
    (factor,) = factors(run(rows))
    assert (list(factor.points), factor.own) == (["4.5", "10", "width"], "width")
    (chart,) = draw_factors(run(rows))
    ((panel,),) = read_panels(chart.drawing)
    assert panel.texts["tick"] == ["4.5", "10", "width"]


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
    ((iou, seconds),) = read_panels(chart.drawing)
    assert [text for text, _ in iou.cells] == ["0.11", "0.12", "0.21", "0.22"]
    assert [text for text, _ in seconds.cells] == ["1", "2", "2", "4"]
    # highest IoU, shortest time
    for panel, place in ((iou, 1.0), (seconds, 0.0)):
        (frame,) = panel.series
        np.testing.assert_allclose(frame.points[:4].mean(axis=0), [place, place], atol=5e-3)
    assert "n = 2 session pairs" in chart.caption


def test_a_mean_over_fewer_pairs_than_another_has_no_frame() -> None:
    rows = [
        {"scenario": "narrow", "seed": seed, "variant": f"p[a.x={a},b.y={b}]", "object_iou_point": 0.1 * a + 0.01 * b}
        for a in (1, 2) for b in (1, 2) for seed in (0, 1) if (a, b, seed) != (2, 2, 1)
    ]  # fmt: skip
    (chart,) = draw_grids(run(rows))
    ((iou,),) = read_panels(chart.drawing)
    assert [text for text, _ in iou.cells] == ["0.11", "0.12", "0.21", "0.22"]
    (frame,) = iou.series
    np.testing.assert_allclose(frame.points[:4].mean(axis=0), [0.0, 1.0], atol=5e-3)


def test_a_difference_below_the_last_digit_has_no_colour_and_no_frame() -> None:
    def of(iou: float, seconds: float) -> list[dict[str, object]]:
        return [
            {"scenario": "narrow", "seed": 0, "variant": f"p[a.x={a},b.y={b}]", "object_iou_point": 0.5 + iou * a,
             "t_total_s": 1.0 + seconds * b, "false_regions_per_100m": NAN}
            for a in (1, 2) for b in (1, 2)
        ]  # fmt: skip

    (chart,) = draw_grids(run(of(1e-4, 0.1)))
    ((seconds,),) = read_panels(chart.drawing)
    assert [text for text, _ in seconds.cells] == ["1.1", "1.2", "1.1", "1.2"]
    # cells that are written alike look alike
    assert len({colour for _, colour in seconds.cells}) == 2
    assert name_equal_grids(run(of(1e-4, 0.1))) == []
    assert draw_grids(run(of(1e-4, 1e-5))) == []
    assert name_equal_grids(run(of(1e-4, 1e-5))) == ["No figure differs on the grid p on narrow: a.x and b.y."]


def test_every_scenario_has_a_bar_for_each_method_over_its_pairs() -> None:
    rows = [
        {"scenario": world, "seed": seed, "variant": name, "region_recall_at_k": 0.5, "region_auroc": 0.25 * seed,
         "object_iou_point": 0.1, "object_f1_50": 0.2}
        for world in ("narrow", "wide") for name in ("a", "b") for seed in (1, 3)
    ]  # fmt: skip
    (chart,) = draw_scenarios(run(rows))
    panels = [panel for (panel,) in read_panels(chart.drawing)]
    assert [len(panel.series) for panel in panels] == [2, 2, 2, 2]
    assert "tick" not in panels[0].texts and panels[3].texts["tick"] == ["narrow\nn 2", "wide\nn 2"]
    auroc = panels[1].series
    np.testing.assert_allclose(auroc[0].points[:, 1], [0.5, 0.5], atol=5e-3)
    # two pairs of 0.25 and 0.75: some draws hold one of them only
    np.testing.assert_allclose(auroc[0].ends[:, 1], [0.25, 0.75] * 2, atol=5e-3)
    assert draw_scenarios(run([row for row in rows if row["seed"] == 1])) == []


def test_a_point_beyond_its_interval_is_drawn() -> None:
    series = Series([0.0, 1.0], [0.5, NAN], low=[0.6, NAN], high=[0.8, NAN])
    np.testing.assert_allclose(series.intervals, [[0.0, NAN], [0.3, NAN]])
    (drawn,) = picture(one_panel(series)).axes[0].collections
    np.testing.assert_allclose(drawn.get_segments()[0][:, 1], [0.5, 0.8])


def test_a_curve_ends_at_the_right_border_with_the_recall_that_it_has_there() -> None:
    rows = [
        ("in", "paper", 0.5, 0.25),
        ("in", "paper", 10.0, 0.5),
        ("in", "paper", 13.0, 0.75),
        ("in", "paper", 80.0, 1.0),
    ]
    table = pd.DataFrame(rows, columns=["domain", "variant", "false_regions_per_100m", "recall"])
    chart = draw_free_response(table, TABLE)
    assert chart is not None
    (curve,) = (series for series in drawn_series(chart.drawing) if series.name == "paper")
    assert curve.points[:, 1].max() == pytest.approx(0.5, abs=5e-3)
