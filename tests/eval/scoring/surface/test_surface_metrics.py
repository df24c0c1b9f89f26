"""Displacement fields: the truth scores best, an empty field worst, and what an answer leaves out gains nothing."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import make_pose, stream, yaw_pose
from cdpipe.io.answer import Answer
from cdpipe.model.report import SurfaceField, SurfaceRegion
from eval.scoring.answer_check import check_answer
from eval.scoring.scoring import score_answer
from eval.scoring.surface.metrics import COLUMNS
from eval.scoring.surface.places import find_surface_places
from eval.truth.ground_truth import GroundTruth, SessionTruth
from tests.eval.scoring.surface.surface_worlds import (
    CELL_M2,
    drawn_patches,
    report_of,
    rows_of_field,
    score_field,
    surface_columns,
    true_field,
    wall_truth,
)

SEEDS = st.integers(0, 10_000)
EXAMPLES = settings(max_examples=20, deadline=None, derandomize=True, phases=(Phase.generate,))
# larger is better, and smaller is better; what is undefined for an empty field is in neither
HIGH = ("surface_cover", "surface_cover_changed", "surface_cover_unchanged", "surface_level_inside", "surface_recall",
        "surface_region_precision")  # fmt: skip
LOW = ("surface_error_median_changed_m", "surface_error_p95_changed_m")


def noisy_field(truth: GroundTruth, seed: int) -> SurfaceField:
    """A middling answer: 5 mm of noise, a tenth of the points left out, a level that is too small in places.

    Its points are off the grid, so that no two are equally near to a place.
    """
    draw, field = stream(seed, "noise"), true_field(truth)
    displacement = field.displacement_m + draw.normal(0, 0.005, len(field.displacement_m))
    displacement[draw.random(len(displacement)) < 0.1] = np.nan
    points, level = draw.uniform(-0.02, 0.02, field.points_map.shape), draw.uniform(0.004, 0.015, len(displacement))
    return replace(field, points_map=field.points_map + points, displacement_m=displacement, level_m=level)


@EXAMPLES
@given(SEEDS)
def test_the_truth_has_no_error_and_finds_everything(seed: int) -> None:
    truth = wall_truth(drawn_patches(seed))
    found = surface_columns(score_field(truth, true_field(truth)))
    assert {name: found[name] for name in HIGH} == dict.fromkeys(HIGH, 1.0)
    errors = {name: value for name, value in found.items() if "error" in name or "bias" in name}
    assert errors.pop("surface_volume_error_share") is not None  # no scar here: undefined
    assert errors == pytest.approx(dict.fromkeys(errors, 0.0), abs=1e-9)
    assert found["surface_false_regions_per_100m"] == 0.0
    assert found["n_surface_changes"] == len(truth.pair.surface_changes)


@EXAMPLES
@given(SEEDS)
def test_an_empty_field_no_field_and_no_answer_score_worst(seed: int) -> None:
    truth = wall_truth(drawn_patches(seed), kinds={1: "scar"})
    empty = rows_of_field(replace(true_field(truth), regions=(), region=np.full(2400, -1, np.int32)), np.arange(0))
    worst = surface_columns(score_field(truth, empty))
    assert {name: worst[name] for name in HIGH} == dict.fromkeys(HIGH, 0.0)
    assert worst["surface_volume_error_share"] == 1.0
    for other in (score_field(truth, None), score_answer(Answer("merge_refused", "", "drawn", None, {}, {}), truth)):
        columns = surface_columns(other)
        rates = "surface_false_regions_per_100m"
        assert math.isnan(columns.pop(rates)) == (other.row["status"] != "ok")
        assert columns == pytest.approx({k: v for k, v in worst.items() if k != rates}, nan_ok=True)
    middling = surface_columns(score_field(truth, noisy_field(truth, seed)))
    assert all(middling[name] > worst[name] for name in ("surface_cover", "surface_level_inside"))
    deepest = max(abs(each.largest_m) for each in truth.pair.surface_changes)
    if deepest > 0.05:
        assert middling["surface_error_p95_changed_m"] < worst["surface_error_p95_changed_m"]


@EXAMPLES
@given(SEEDS)
def test_moving_both_sessions_changes_no_score(seed: int) -> None:
    patches, draw = drawn_patches(seed), stream(seed, "move")
    # places are cells of the before session's own frame, so that session moves by whole cells
    before = make_pose(translation=0.25 * draw.integers(-40, 40, 3))
    after = yaw_pose(draw.uniform(-3, 3), draw.uniform(-20, 20, 3))
    here, there = wall_truth(patches), wall_truth(patches, before=before, after=after)
    field = noisy_field(here, seed)
    moved = replace(field, points_map=field.points_map + before[:3, 3])
    ours, theirs = score_field(here, field), score_field(there, moved)
    assert surface_columns(theirs) == pytest.approx(surface_columns(ours), nan_ok=True, abs=1e-6)
    for a, b in zip(ours.surface_windows, theirs.surface_windows, strict=True):
        assert (a["true_m"], a["answered_m"]) == pytest.approx((b["true_m"], b["answered_m"]), abs=1e-6)


@EXAMPLES
@given(SEEDS)
def test_repeated_and_reordered_points_count_once(seed: int) -> None:
    truth = wall_truth(drawn_patches(seed))
    field, draw = noisy_field(truth, seed), stream(seed, "repeat")
    rows = np.concatenate([np.arange(2400), draw.integers(0, 2400, 5000)])
    ours = score_field(truth, field)
    theirs = score_field(truth, rows_of_field(field, draw.permutation(rows)))
    assert surface_columns(theirs) == pytest.approx(surface_columns(ours), nan_ok=True)
    assert theirs.surface_windows == ours.surface_windows


@EXAMPLES
@given(SEEDS)
def test_naming_only_the_easy_places_gains_nothing(seed: int) -> None:
    truth = wall_truth(drawn_patches(seed))
    field = noisy_field(truth, seed)
    moved = true_field(truth).displacement_m
    is_wrong = np.abs(np.nan_to_num(field.displacement_m) - moved) > 0.004
    is_changed = np.abs(moved) > 0.01
    whole = surface_columns(score_field(truth, field))
    easy = rows_of_field(field, np.flatnonzero(~(is_wrong & is_changed)))  # leaves out where it is wrong
    some = surface_columns(score_field(truth, easy))
    assert some["n_surface_places"] == whole["n_surface_places"]
    assert some["surface_cover"] <= whole["surface_cover"]
    assert some["surface_recall"] <= whole["surface_recall"]
    if is_changed.any():
        assert some["surface_error_p95_changed_m"] >= whole["surface_error_p95_changed_m"] - 0.01


@EXAMPLES
@given(SEEDS)
def test_the_wrong_sign_finds_nothing(seed: int) -> None:
    truth = wall_truth(drawn_patches(seed), kinds={1: "scar", 2: "rubble"})
    field = true_field(truth)
    regions = tuple(replace(each, volume_m3=-each.volume_m3) for each in field.regions)
    turned = surface_columns(score_field(truth, replace(field, displacement_m=-field.displacement_m, regions=regions)))
    assert (turned["surface_recall"], turned["surface_volume_error_share"]) == (0.0, 1.0)
    empty = surface_columns(score_field(truth, None))
    assert turned["surface_error_median_changed_m"] == pytest.approx(2 * empty["surface_error_median_changed_m"])
    assert turned["surface_bias_changed_m"] == pytest.approx(2 * empty["surface_bias_changed_m"])


def test_every_figure_by_hand() -> None:
    # 1: a scar of 2 x 2 m and 0.1 m, 64 places; 2: rubble of 1 x 1 m and 0.2 m, 16 places; 2,400 places in all
    truth = wall_truth({1: (5, 1, 2, 2, -0.1), 2: (20, 1, 1, 1, 0.2)}, kinds={1: "scar", 2: "rubble"})
    field = true_field(truth, level_m=0.02)
    x = field.points_map[:, 0]
    displacement = np.where(field.region == 0, -0.08, 0.0)  # the scar 2 cm short, the rubble not seen
    displacement[(x > 10) & (x < 15)] = 0.03  # 400 unchanged places, outside of their level
    displacement[x > 29] = np.nan  # 80 unchanged places are left out, 20 of them beside others
    region = np.where((x > 10) & (x < 15), 1, np.where(field.region == 0, 0, -1)).astype(np.int32)
    scar, alarm = field.regions[0], SurfaceRegion(np.array([12.5, 2.1, 2.5]), 25.0, 0.75, 0.03, 0.03)
    scar = replace(scar, volume_m3=-0.3)
    field = replace(field, displacement_m=displacement, region=region, regions=(scar, alarm))
    score = score_field(truth, field)
    found = surface_columns(score)
    n_unchanged = 2400 - 80
    assert found == pytest.approx({
        "surface_cover": (2400 - 60) / 2400, "surface_cover_changed": 1.0,
        "surface_cover_unchanged": (n_unchanged - 60) / n_unchanged,
        "surface_error_median_m": 0.0, "surface_error_median_changed_m": 0.02, "surface_error_median_unchanged_m": 0.0,
        # 16 places are 0.2 m off, 400 are 0.03, 64 are 0.02: of 2,400 the 95th percentile is one of the 400
        "surface_error_p95_m": 0.03, "surface_error_p95_changed_m": 0.2, "surface_error_p95_unchanged_m": 0.03,
        "surface_bias_m": (400 * 0.03 + 64 * 0.02 - 16 * 0.2) / 2400,
        "surface_bias_changed_m": -(64 * 0.02 + 16 * 0.2) / 80, "surface_bias_unchanged_m": 400 * 0.03 / n_unchanged,
        "surface_level_inside": (n_unchanged - 60 - 400) / (n_unchanged - 60), "surface_level_median_m": 0.02,
        "surface_recall": 0.5, "surface_region_precision": 64 / 464, "surface_false_regions_per_100m": 100 / 30,
        # the scar has 0.4 m3, 0.3 were answered; the rubble was not
        "surface_volume_error_share": (0.25 + 1.0) / 2,
        "n_surface_places": 2400, "n_surface_changes": 2, "n_surface_regions": 2,
        "t_surface_s": math.nan,
    }, nan_ok=True, abs=1e-7)  # fmt: skip
    one, two = score.surface_changes
    assert (one["is_found"], two["is_found"], one["n_core_places"], two["n_core_places"]) == (True, False, 64, 16)
    assert one["answered_volume_m3"] == -0.3
    assert one["area_m2"] == 64 * CELL_M2


def test_the_volume_of_a_region_counts_where_single_places_in_it_have_the_wrong_sign_or_were_not_seen() -> None:
    truth = wall_truth({1: (5, 1, 2, 2, -0.1), 2: (9, 1, 1, 1, -0.2)}, kinds={1: "scar", 2: "scar"})
    field = true_field(truth)
    (first, *_), displacement = np.flatnonzero(field.region == 0), field.displacement_m.copy()
    displacement[first] = 0.002
    one_region = np.where(field.region == 1, 0, field.region).astype(np.int32)  # holds both: it is the larger one's
    for region, wanted in ((field.region, [-0.4, -0.2]), (one_region, [-0.4, 0.0])):
        answer = replace(field, displacement_m=displacement, region=region)
        volumes = [row["answered_volume_m3"] for row in score_field(truth, answer).surface_changes]
        assert volumes == pytest.approx(wanted)


def test_the_volume_of_a_region_that_holds_as_much_of_two_changes_counts_once() -> None:
    truth = wall_truth({1: (5, 1, 1, 1, -0.2), 2: (9, 1, 1, 1, -0.2)}, kinds={1: "scar", 2: "scar"})
    field = true_field(truth)
    answer = replace(field, region=np.where(field.region == 1, 0, field.region).astype(np.int32))
    assert [row["answered_volume_m3"] for row in score_field(truth, answer).surface_changes] == [-0.2, 0.0]


def test_columns_are_those_that_are_listed() -> None:
    truth = wall_truth({1: (5, 1, 2, 2, -0.1)})
    assert set(surface_columns(score_field(truth, true_field(truth)))) == {*COLUMNS}


def test_another_pair_has_no_figures_unless_an_answer_says_how_far_rock_moved() -> None:
    truth = wall_truth({}, family="regions/narrow")
    score = score_field(truth, None)
    assert surface_columns(score) == {}
    assert (score.surface_changes, score.surface_windows) == ([], [])
    field = true_field(truth)
    score = score_field(truth, replace(field, displacement_m=np.full(2400, 0.02)))
    assert score.row["surface_error_median_unchanged_m"] == pytest.approx(0.02)
    assert math.isnan(score.row["surface_recall"])
    null = score_field(wall_truth({}, family="surface/null"), None)
    assert (null.row["surface_cover"], len(null.surface_windows) > 0) == (0.0, True)


def test_places_that_the_after_session_did_not_see_are_not_judged() -> None:
    truth = wall_truth({1: (5, 1, 2, 2, 0.1), 2: (25, 1, 2, 2, 0.1)}, unseen_from_m=20.0)
    places = find_surface_places(truth)
    assert places.points_map[places.is_judged, 0].max() < 20.6
    field = true_field(truth)
    found = score_field(truth, field).row
    # the second patch is real, so its region is not false, but it cannot be asked for
    assert (found["n_surface_changes"], found["surface_recall"], found["surface_false_regions_per_100m"]) == (1, 1, 0)


def test_props_are_no_rock() -> None:
    truth = wall_truth({1: (5, 1, 2, 2, 0.1)})
    points = truth.before.scoring_points
    is_prop = (points.points_odom[:, 0] > 10) & (points.points_odom[:, 0] < 12)
    labels = is_prop.astype(np.int16)
    seen = replace(points, instance=labels, change=labels)
    before = SessionTruth(truth.before.odom_T_sensor, truth.before.world_T_sensor, seen, surface=truth.before.surface)
    truth = replace(truth, sessions={**truth.sessions, "before": before})
    assert find_surface_places(truth).true_m.size == 2400 - is_prop.sum()
    field = true_field(truth)
    region = np.where(is_prop, 1, field.region).astype(np.int32)
    prop = SurfaceRegion(np.array([11.0, 2.0, 1.0]), 4.0, 0.4, 0.1, 0.1)
    field = replace(field, region=region, regions=(*field.regions, prop))
    assert score_field(truth, field).row["surface_false_regions_per_100m"] == pytest.approx(100 / 30)


def test_windows_lie_on_one_change_or_on_none_whatever_is_answered() -> None:
    truth = wall_truth({1: (5, 0.5, 4, 4, 0.05), 2: (15, 1, 1, 1, -0.2)})
    windows = score_field(truth, true_field(truth)).surface_windows
    same = ("area_m2", "is_null", "surface_change", "x_m", "y_m", "z_m", "n_places", "true_m")
    other = score_field(truth, None).surface_windows
    assert [[w[name] for name in same] for w in windows] == [[w[name] for name in same] for w in other]
    assert all(w["answered_m"] == 0.0 for w in other)
    null = [w for w in windows if w["is_null"]]
    assert {w["area_m2"] for w in null} == {1.0, 4.0, 16.0}
    assert all(w["true_m"] == 0.0 == w["surface_change"] for w in null)
    first = [w for w in windows if w["surface_change"] == 1]
    assert [w["true_m"] for w in first if w["area_m2"] < 16] == pytest.approx([0.05] * len(
        [w for w in first if w["area_m2"] < 16]))  # fmt: skip
    # a patch of 1 m2 is all that changed in a window of 4 m2, which says so by its mean
    (second,) = [w for w in windows if w["surface_change"] == 2 and w["area_m2"] == 4.0]
    assert second["true_m"] == pytest.approx(-0.2 * 16 / second["n_places"])


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"displacement_m": np.array([0.0, 6.0])}, "surface_displacement_m: entry 1 is 6: expected at most 5 m"),
        ({"displacement_m": np.array([-np.inf, 0.0])}, "surface_displacement_m: entry 0 is -inf"),
        ({"level_m": np.array([0.01, 0.0])}, "surface_level_m: entry 1 is 0: expected a length in metres"),
        ({"level_m": np.array([-0.01, 0.1])}, "surface_level_m: entry 0 is -0.01"),
        ({"normals_map": np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0]])}, "surface_normals_map: entry 1 has length 2"),
        ({"normals_map": np.full((2, 3), np.nan)}, "surface_normals_map: entry 0 has length nan"),
        ({"points_map": np.full((2, 3), np.nan)}, "surface_points_map: entry 0 is not a finite number"),
        ({"points_map": np.full((2, 3), 1e8)}, "surface_points_map: entry 0 is farther than"),
        ({"area_m2": -1.0}, r"surface_regions\[0\].area_m2 = -1.0"),
        ({"volume_m3": math.nan}, r"surface_regions\[0\].volume_m3 = nan"),
        ({"largest_m": 9.0}, r"surface_regions\[0\].largest_m = 9.0"),
        ({"centre_map": np.full(3, np.inf)}, r"surface_regions\[0\].centre_map: entry 0 is not a finite number"),
    ],
)
def test_numbers_that_cannot_be_are_refused_in_one_line(change: dict, told: str) -> None:
    truth = wall_truth({1: (5, 1, 2, 2, 0.1)})
    region = SurfaceRegion(np.zeros(3), 1.0, 0.1, 0.1, 0.1)
    normals = np.array([[0.0, 0.0, 1.0]] * 2)
    field = SurfaceField(np.zeros((2, 3)), normals, np.zeros(2), np.full(2, np.nan), np.zeros(2, np.int32), (region,))
    answer = Answer("ok", "", "drawn", report_of(truth, field), {}, {})
    check_answer(answer, truth, Path("a"))
    if set(change) <= set(SurfaceRegion.__dataclass_fields__):
        change = {"regions": (replace(region, **change),)}
    field = replace(field, **change)
    with pytest.raises(InputError, match=told) as caught:
        check_answer(replace(answer, report=report_of(truth, field)), truth, Path("a"))
    assert "\n" not in str(caught.value)
