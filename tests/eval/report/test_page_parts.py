import base64
import io
import math
from importlib.resources import files
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgb
from matplotlib.image import imread

from eval.core.charts import BLUE, ORANGE
from eval.report.maps import RED, RegionMark, TruthMark, distance_map, joined_labels, overlay_map, region_map
from eval.report.objects.figures import Panel, object_panels, oblique_view
from eval.report.tables import beside, best
from eval.running.results.grids import find_grids, off_grids, split_variant
from eval.running.results.run_data import RunData
from eval.running.runfolder import RunFolder
from eval.tables.columns import RESULT_COLUMNS, UNDEFINED, count, significant, spaced

HIGH = next(column for column in RESULT_COLUMNS if column.key == "object_iou_point")
LOW = next(column for column in RESULT_COLUMNS if column.key == "t_total_s")
NAN = math.nan


def pixels(address: str) -> np.ndarray:
    return imread(io.BytesIO(base64.b64decode(address.removeprefix("data:image/png;base64,"))))[..., :3]


def share_of(image: np.ndarray, colour: str) -> float:
    return float((np.abs(image - np.array(to_rgb(colour))).max(axis=2) < 0.02).mean())


def square(x_m: float, y_m: float) -> np.ndarray:
    """A 2 m square of points every 0.05 m."""
    steps = np.arange(0.025, 2.0, 0.05)
    x, y = np.meshgrid(x_m + steps, y_m + steps)
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.00045, "0.00045"),
        (0.0123456, "0.0123"),
        (1.0, "1"),
        (12.345, "12.3"),
        (1234.5, "1234"),
        (0.0, "0"),
        (-0.0, "0"),
        (1e-9, "0.000000001"),
        (2.5e-10, "2.5e-10"),
        (-5e-324, "-4.94e-324"),
        (NAN, UNDEFINED),
    ],
)
def test_seconds_have_three_digits_and_no_exponent(value: float, text: str) -> None:
    assert significant(value) == text


def test_counts_are_grouped_and_broken_means_keep_a_decimal() -> None:
    assert [count(value) for value in (0.0, 1263631.0, 2.5, NAN)] == ["0", "1\u2009263\u2009631", "2.5", UNDEFINED]


@pytest.mark.parametrize(
    ("values", "column", "marks"),
    [
        ([0.1, 0.3, 0.2], HIGH, [False, True, False]),
        ([0.1, 0.3, 0.2], LOW, [True, False, False]),
        # 0.301 and 0.304 are both written 0.30
        ([0.301, 0.304, 0.2], HIGH, [True, True, False]),
        ([0.3, 0.3, 0.3], HIGH, [False, False, False]),
        ([NAN, 0.3, NAN], HIGH, [False, False, False]),
        ([NAN, 0.3, 0.1], HIGH, [False, True, False]),
        ([-0.0, 0.0], HIGH, [False, False]),
        ([], HIGH, []),
    ],
)
def test_best_is_judged_as_written(values: list[float], column: object, marks: list[bool]) -> None:
    assert best(values, column) == marks


def test_a_mean_over_hardly_any_pair_is_not_the_best() -> None:
    values = [0.9, 1.0, 0.5]
    assert best(values, HIGH, [60, 2, 60]) == [True, False, False]
    # nor is one that left a pair out, and who is best of the others cannot be said
    assert best(values, HIGH, [60, 59, 60]) == [False, False, False]
    assert best(values, HIGH, [60, 60, 59]) == [False, True, False]
    # where nobody has more, nobody is left out
    assert best(values, HIGH, [1, 1, 1]) == [False, True, False]
    assert best(values, HIGH, [3, 2, 3]) == [True, False, False]
    assert beside("0.1-0.2", 2, 60) == "0.1-0.2\n2 of 60 pairs"
    assert [beside("", n, 60) for n in (0, 60)] == ["", ""]


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("m[a.b=1,c.d=x]", "m [a.b=1, c.d=x]"),
        ("m[a.b=[1, 2],c.d=x]", "m [a.b=[1, 2], c.d=x]"),
        ("oracle-merge+oracle-regions[a.b=1]", "oracle-merge + oracle-regions [a.b=1]"),
        *((name, name) for name in ("paper-topn", "=1+1", "a,b", "x[1],y", "c++", "[a=1]")),
    ],
)
def test_only_the_settings_of_a_variant_get_spaces(name: str, shown: str) -> None:
    assert spaced(name) == shown


def test_variants_are_taken_apart() -> None:
    assert split_variant("tunnelcd[extract.voxel_m=0.3,query.radius_m=4.5]") == (
        "tunnelcd",
        {"extract.voxel_m": "0.3", "query.radius_m": "4.5"},
    )
    assert split_variant("paper-topn") == ("paper-topn", {})


def test_tables_leave_points_of_grids_out_unless_they_hold_nothing_else(tmp_path: Path) -> None:
    points = [f"p[a.x={x},b.y={y}]" for x in (1, 2) for y in (3, 4)]
    # the last point stands alone in the other scenario: it is shown for that
    cases = [("one", "p"), ("one", "p[a.x=1]"), *(("one", name) for name in points), ("two", points[-1])]
    rows = tuple({"scenario": scenario, "variant": name, "seed": 1} for scenario, name in cases)
    table = pd.DataFrame({"variant": ["p", "p[a.x=1]", *points], "value": range(6)})
    data = RunData(RunFolder(tmp_path), rows, (), (), {}, ())
    assert off_grids(table, data)["value"].tolist() == [0, 1, 5]
    of_grid = RunData(RunFolder(tmp_path), rows[2:6], (), (), {}, ())
    assert off_grids(table[2:], of_grid)["value"].tolist() == [2, 3, 4, 5]


def test_a_grid_varies_two_settings_and_may_fix_others(tmp_path: Path) -> None:
    points = [f"p[a.x={a},b.y={b},c.n=8]" for a in (0.3, 10.0) for b in (1, 2)]
    others = ["p", "p[a.x=0.3,b.y=1]", "q[a.x=1]", "q[a.x=2]"]
    rows = tuple({"scenario": "s", "variant": name} for name in [*points, *others])
    (grid,) = find_grids(RunData(RunFolder(tmp_path), rows, (), (), {}, ()))
    assert (grid.preset, grid.keys) == ("p with c.n=8", ("a.x", "b.y"))
    assert grid.values == (("0.3", "10.0"), ("1", "2"))
    assert grid.points["10.0", "1"] == points[2]


def test_variants_that_fill_no_grid_are_no_grid(tmp_path: Path) -> None:
    names = ("p", "p[a.x=1,b.y=1]", "p[a.x=2,b.y=2]", "p[a.x=1,b.y=2]")
    rows = tuple({"scenario": "s", "seed": 1, "variant": name} for name in names)
    assert find_grids(RunData(RunFolder(tmp_path), rows, (), (), {}, ())) == []
    whole = (*rows, {"scenario": "s", "seed": 1, "variant": "p[a.x=2,b.y=1]"})
    assert len(find_grids(RunData(RunFolder(tmp_path), whole, (), (), {}, ()))) == 1


def test_overlay_shows_each_map_in_its_colour_and_equal_areas_alike() -> None:
    image = pixels(overlay_map(square(0, 0), square(6, 1)))
    n_before, n_after = (share_of(image[image.shape[0] // 5 :], colour) for colour in (BLUE, ORANGE))
    assert n_before > 0.02
    assert n_after == pytest.approx(n_before, rel=0.1)


def test_distances_colour_only_what_is_new() -> None:
    before = np.concatenate([square(0, 0), square(2, 0)])
    same, new = (
        pixels(distance_map(before, after))
        for after in (before, np.concatenate([before, square(1, 0) + np.array([0, 0, 1.5])]))
    )
    below_the_colour_bar = same.shape[0] // 3
    assert share_of(same[below_the_colour_bar:], "#7f1d00") == 0.0
    # 2 m of the 4 m square are covered from above
    assert share_of(new[below_the_colour_bar:], "#7f1d00") > 0.1


def test_regions_are_drawn_in_red_around_their_centres() -> None:
    points = np.concatenate([square(x, 0) for x in range(0, 20, 2)])
    none = pixels(region_map(points, [], []))
    one = pixels(region_map(points, [RegionMark(5.0, 1.0, 2.0, False)], [TruthMark(5.0, 1.0, "1", "found")]))
    assert share_of(one, RED) > 2 * share_of(none, RED)


def test_stray_points_far_off_do_not_shrink_the_picture() -> None:
    strays = np.array([[x, y, 0.0] for x in (-90.0, 90.0) for y in (-90.0, 90.0)])
    plain, strewn = (pixels(overlay_map(points, points)) for points in (square(0, 0), np.r_[square(0, 0), strays]))
    np.testing.assert_array_equal(plain, strewn)


@pytest.mark.parametrize("draw", [overlay_map, distance_map])
def test_maps_of_one_point_can_be_drawn(draw: object) -> None:
    assert draw(np.zeros((1, 3)), np.ones((1, 3))).startswith("data:image/png;base64,")


def test_labels_of_neighbours_are_joined() -> None:
    marks = [TruthMark(x, 0.0, str(index), "found") for index, x in enumerate((0.0, 0.5, 9.0))]
    assert joined_labels(marks, 1.0) == [(0.0, 0.0, "0, 1"), (9.0, 0.0, "2")]


def test_the_oblique_view_keeps_up_above_and_turns_with_the_eye() -> None:
    truth = np.zeros((1, 3))
    side = oblique_view(truth, np.array([10.0, 0.0, 0.0]))
    up = side(np.array([[0.0, 0.0, 1.0]]))[0]
    np.testing.assert_allclose(up, [0.0, math.cos(math.radians(25))], atol=1e-12)
    # turning the eye and the point by 90 deg about the object changes nothing
    turned = oblique_view(truth, np.array([0.0, 10.0, 0.0]))
    np.testing.assert_allclose(side(np.array([[1.0, 2.0, 3.0]])), turned(np.array([[-2.0, 1.0, 3.0]])), atol=1e-12)


def test_a_railing_is_not_seen_from_its_end() -> None:
    railing = np.column_stack([np.linspace(-2, 2, 50), np.zeros(50), np.zeros(50)])
    for bearing in np.deg2rad(np.arange(0, 360, 15)):
        flat = oblique_view(railing, 9.0 * np.array([math.cos(bearing), math.sin(bearing), 0.0]))(railing)
        assert np.ptp(flat[:, 0]) > 0.55 * 4.0


def test_an_object_that_was_missed_is_drawn_black() -> None:
    points = square(0, 0) + np.array([0.0, 0.0, 0.5])
    nothing = np.zeros((0, 3))
    panels = [Panel("truth", "", ((points, BLUE),)), Panel("a", "", ((points, "#1a1a1a"), (nothing, BLUE)))]
    image = pixels(object_panels(panels, points, np.array([5.0, 0.0, 1.0])))
    half = image.shape[1] // 2
    assert share_of(image[:, :half], BLUE) > 0.03
    assert share_of(image[:, half:], BLUE) == 0.0
    assert share_of(image[:, half:], "#1a1a1a") > 0.03


def test_no_rule_for_all_screens_undoes_one_for_narrow_screens() -> None:
    css = (files("eval.report") / "templates" / "page.css").read_text(encoding="utf-8")
    narrow, after = css.partition("@media (max-width: 40rem) {")[2].split("\n}\n", 1)
    selectors = {line.partition("{")[0].strip() for line in narrow.splitlines() if line.strip()}
    later = {line.partition("{")[0].strip() for line in after.partition("@media print")[0].splitlines()}
    assert "dl" in selectors and selectors & later == set()
