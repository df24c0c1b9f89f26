"""Displacement fields that try to score better than they are, made without the truth; METRICS.md says why none pays."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import stream, yaw_pose
from cdpipe.io.answer import Answer
from cdpipe.model.report import SurfaceField, SurfaceRegion
from eval.plans.targets import Targets
from eval.scoring.answer_check import check_answer
from eval.scoring.scoring import CaseScore
from eval.scoring.surface.places import find_surface_places
from eval.tables.surface.limits import detection_limits
from eval.tables.surface.table import MEANS, surface_tables
from eval.truth.ground_truth import GroundTruth
from tests.eval.scoring.surface.surface_worlds import (
    drawn_patches,
    report_of,
    rows_of_field,
    score_field,
    surface_columns,
    true_field,
    wall_truth,
)
from tests.eval.scoring.surface.test_surface_metrics import LOW, noisy_field

SEEDS = st.integers(0, 10_000)
EXAMPLES = settings(max_examples=6, deadline=None, derandomize=True, phases=(Phase.generate,))
PATCHES = {1: (3, 0.5, 3, 3, 0.03), 2: (12, 1, 3, 3, -0.03), 3: (22, 0.5, 4, 4, 0.06)}


@pytest.fixture(name="truth", scope="module")
def truth_fixture() -> GroundTruth:
    return wall_truth(PATCHES, kinds={2: "scar"})


def tables_of(scores: list[CaseScore], **kinds: Any) -> dict[str, pd.DataFrame]:
    """The tables of a run of one method on pairs with seeds 0, 1, .."""
    named = [{"scenario": score.row["family"], "seed": seed, "variant": "m"} for seed, score in enumerate(scores)]
    results = pd.DataFrame([{**score.row, **names} for score, names in zip(scores, named, strict=True)])
    windows = [{**row, **names} for score, names in zip(scores, named, strict=True) for row in score.surface_windows]
    return surface_tables(results, pd.DataFrame(windows), kinds.get("targets", Targets()))


def limits_of(score: CaseScore) -> list[dict[str, Any]]:
    return detection_limits(pd.DataFrame([{**row, "scenario": "s", "seed": 0} for row in score.surface_windows]))


def best_limit(score: CaseScore) -> float:
    """The smallest detection limit of any area, infinite where there is none."""
    return float(np.nanmin([np.inf, *(row["limit_m"] for row in limits_of(score))]))


@EXAMPLES
@given(SEEDS)
def test_the_truth_finds_every_window_and_an_empty_field_none_of_the_same(seed: int) -> None:
    truth = wall_truth(drawn_patches(seed))
    right, empty = limits_of(score_field(truth, true_field(truth))), limits_of(score_field(truth, None))
    assert [(row["found_share"], row["threshold_m"], row["false_share"]) for row in right] == [(1, 0, 0)] * len(right)
    for row in right:
        assert row["limit_m"] == min(each["magnitude_m"] for each in right if each["area_m2"] == row["area_m2"])
    assert [row["n_windows"] for row in empty] == [row["n_windows"] for row in right]
    assert all((row["found_share"], row["n_null_windows"]) == (0.0, 0) for row in empty)
    assert np.isnan([row["limit_m"] for row in empty]).all()


def test_a_pair_whose_field_is_left_out_counts_in_every_mean(truth: GroundTruth) -> None:
    whole = score_field(truth, true_field(truth))
    for left_out in (score_field(truth, None), score_field(truth, rows_of_field(true_field(truth), np.arange(0)))):
        (row,) = tables_of([whole, left_out])["surface_table"].to_dict("records")
        counted = [name for name in MEANS if name != "surface_level_median_m"]  # no level is the worst
        for name in counted:
            both = [score.row[name] for score in (whole, left_out)]
            assert row[name] == pytest.approx(np.mean(both)), name
        assert (row["n_pairs"], row["surface_cover"], row["surface_recall"]) == (2, 0.5, 0.5)


@EXAMPLES
@given(SEEDS)
def test_turning_both_sessions_changes_no_score(seed: int) -> None:
    # a quarter of a turn carries the cells of a session into cells; their order becomes another one
    patches, draw = drawn_patches(seed), stream(seed, "turn")
    before = yaw_pose(np.pi / 2, 0.25 * draw.integers(-40, 40, 3))
    here, there = wall_truth(patches), wall_truth(patches, before=before, after=yaw_pose(1.0, (3.0, 2.0, 1.0)))
    field = noisy_field(here, seed)
    moved = replace(field, points_map=field.points_map @ before[:3, :3].T + before[:3, 3])
    ours, theirs = (surface_columns(score_field(each, of)) for each, of in ((here, field), (there, moved)))
    assert theirs == pytest.approx(ours, nan_ok=True, abs=1e-6)


@EXAMPLES
@given(SEEDS, st.sampled_from([0.05, -0.4, 4.9]))
def test_wrong_values_raise_no_score(seed: int, off_m: float) -> None:
    truth = wall_truth(drawn_patches(seed), kinds={1: "scar"})
    draw, field, moved = stream(seed, "wrong"), noisy_field(truth, seed), true_field(truth).displacement_m
    is_wrong = draw.random(len(moved)) < 0.1
    wrong = np.clip(moved - np.copysign(abs(off_m), np.where(moved == 0, off_m, moved)), -5, 5)
    region = np.where(is_wrong, -1, field.region).astype(np.int32)
    worse = replace(field, displacement_m=np.where(is_wrong, wrong, field.displacement_m), region=region)
    without = replace(field, displacement_m=np.where(is_wrong, np.nan, field.displacement_m))
    for better in (field, without):
        ours, theirs = (score_field(truth, each) for each in (better, worse))
        assert theirs.row["surface_recall"] <= ours.row["surface_recall"]
        assert all(theirs.row[name] >= ours.row[name] - 1e-12 for name in ("surface_error_p95_m", *LOW)), better
        assert theirs.row["surface_volume_error_share"] >= ours.row["surface_volume_error_share"]
        assert best_limit(theirs) >= best_limit(ours)


@EXAMPLES
@given(SEEDS)
def test_a_wrong_region_raises_no_score(seed: int) -> None:
    truth = wall_truth(drawn_patches(seed), kinds={1: "scar"})
    field, draw = noisy_field(truth, seed), stream(seed, "region")
    still = np.flatnonzero((field.region < 0) & ~np.isnan(field.displacement_m))
    region = field.region.copy()
    region[draw.choice(still, 40, replace=False)] = len(field.regions)
    wrong = SurfaceRegion(np.zeros(3), 2.5, float(draw.normal()), 0.1, 0.1)
    ours, theirs = score_field(truth, field).row, score_field(
        truth, replace(field, region=region, regions=(*field.regions, wrong))
    ).row  # fmt: skip
    assert theirs["surface_region_precision"] < ours["surface_region_precision"]
    same = ("surface_recall", "surface_volume_error_share", "surface_error_p95_m", "surface_level_inside")
    assert [theirs[name] for name in same] == pytest.approx([ours[name] for name in same])
    assert theirs["surface_false_regions_per_100m"] >= ours["surface_false_regions_per_100m"]


def test_a_value_that_is_no_number_is_left_out_or_refused(truth: GroundTruth) -> None:
    field, few = noisy_field(truth, 1), np.arange(0, 2400, 3)
    unsaid = field.displacement_m.copy()
    unsaid[few] = np.nan
    told = surface_columns(score_field(truth, replace(field, displacement_m=unsaid)))
    gone = surface_columns(score_field(truth, rows_of_field(field, np.setdiff1d(np.arange(2400), few))))
    assert told == pytest.approx(gone, nan_ok=True, abs=0)
    refused = [("displacement_m", value) for value in (np.inf, -np.inf, 5.1)]
    for name, value in [*refused, *(("level_m", value) for value in (0.0, -0.1, 1e9, np.inf))]:
        values = getattr(field, name).copy()
        values[7] = value
        answer = Answer("ok", "", "m", report_of(truth, replace(field, **{name: values})), {}, {})
        with pytest.raises(InputError, match=f"surface_{name}: entry 7 is"):
            check_answer(answer, truth, Path("a"))


@pytest.mark.parametrize(("level_m", "inside"), [(5.0, 1.0), (1e-9, 0.0), (np.nan, 0.0)])
def test_no_level_of_ones_own_choice_moves_another_score(truth: GroundTruth, level_m: float, inside: float) -> None:
    field = noisy_field(truth, 2)
    ours = score_field(truth, field)
    theirs = score_field(truth, replace(field, level_m=np.full(2400, level_m)))
    moved = {name for name, value in surface_columns(theirs).items() if repr(value) != repr(ours.row[name])}
    assert moved == {"surface_level_inside", "surface_level_median_m"}
    assert theirs.row["surface_level_inside"] == inside
    assert theirs.surface_windows == ours.surface_windows


def sure_rows(field: SurfaceField) -> np.ndarray:
    """The points whose displacement is beyond twice its level."""
    return np.flatnonzero(np.abs(field.displacement_m) > 2 * field.level_m)


def quiet_rows(field: SurfaceField) -> np.ndarray:
    """The points where nothing seems to have moved."""
    return np.flatnonzero(np.abs(field.displacement_m) < 0.5 * field.level_m)


def easy_rows(field: SurfaceField) -> np.ndarray:
    """Three points, at the places where the field says most."""
    return np.argsort(-np.abs(np.nan_to_num(field.displacement_m)), kind="stable")[:3]


@EXAMPLES
@given(SEEDS, st.sampled_from([sure_rows, quiet_rows, easy_rows]))
def test_a_field_at_the_places_of_ones_own_choice_scores_no_better(seed: int, choose: Any) -> None:
    truth = wall_truth(drawn_patches(seed), kinds={1: "scar"})
    field = noisy_field(truth, seed)
    ours, theirs = score_field(truth, field), score_field(truth, rows_of_field(field, choose(field)))
    assert theirs.row["n_surface_places"] == ours.row["n_surface_places"]
    for name in ("surface_cover", "surface_recall"):
        assert theirs.row[name] <= ours.row[name]
    for name in ("surface_error_median_changed_m", "surface_volume_error_share"):
        assert theirs.row[name] >= ours.row[name] - 0.003  # noise of a single place may go
    if choose is easy_rows:
        assert theirs.row["surface_recall"] == 0.0
        assert best_limit(theirs) == np.inf
    assert best_limit(theirs) >= best_limit(ours)


def field_that_says(truth: GroundTruth, displacement_m: np.ndarray) -> SurfaceField:
    """A field at every point, without a region, made without the truth."""
    return replace(
        true_field(truth), displacement_m=displacement_m, region=np.full(len(displacement_m), -1, np.int32), regions=()
    )


@pytest.fixture(name="few_null_windows")
def few_null_windows_fixture(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a long drift: the windows that set thresholds end long before the rock does."""
    monkeypatch.setattr("eval.scoring.surface.windows.MAX_NULL_WINDOWS", 8)


@pytest.mark.usefixtures("few_null_windows")
def test_being_silent_where_thresholds_come_from_does_not_pay() -> None:
    patches = {1: (18, 0.5, 4, 4, 0.01), 2: (24, 0.5, 4, 4, 0.02)}
    truth = wall_truth(patches)
    x = true_field(truth).points_map[:, 0]
    score = score_field(truth, field_that_says(truth, np.where(x < 12, 0.0, 0.05)))
    null = pd.DataFrame([row for row in score.surface_windows if row["is_null"]])
    of_threshold = null[~null["is_check"]]
    small = of_threshold[of_threshold["area_m2"] == 1.0]
    assert (len(small), small["answered_m"].max()) == (8, 0.0)  # so their own threshold would be 0
    rows = [row for row in limits_of(score) if row["area_m2"] < 16.0]  # there are but seven windows of 16 m2 in all
    assert [row["threshold_m"] for row in rows] == pytest.approx([0.05] * 4)
    assert [(row["found_share"], row["false_share"]) for row in rows] == [(0.0, 0.0)] * 4


@pytest.mark.parametrize("everywhere_m", [0.03, 0.07, 0.3, -0.05])
def test_one_value_everywhere_finds_nothing(truth: GroundTruth, everywhere_m: float) -> None:
    # its means over more or fewer places differ by rounding, and half of them exceed the threshold by that
    rows = limits_of(score_field(truth, field_that_says(truth, np.full(2400, everywhere_m))))
    assert [(row["found_share"], row["false_share"]) for row in rows] == [(0.0, 0.0)] * len(rows)


def test_covering_less_than_half_of_every_window_but_a_silent_one_does_not_pay(truth: GroundTruth) -> None:
    field, places = true_field(truth), find_surface_places(truth)
    x = field.points_map[:, 0]
    is_silent = (x > 15.5) & (x < 21.5)
    # columns of points 0.75 m apart, 0.2 m off the wall, cover their own places alone; around the silent part is none
    is_sparse = (np.floor(x / 0.25).astype(int) % 3 == 0) & ((x < 13) | (x > 24))
    points = field.points_map + np.where(is_sparse, 0.2, 0.0)[:, None] * (0.0, 1.0, 0.0)
    said = replace(field_that_says(truth, np.where(is_silent, 0.0, 0.05)), points_map=points)
    score = score_field(truth, rows_of_field(said, np.flatnonzero(is_silent | is_sparse)))
    assert places.is_judged.all()
    null = pd.DataFrame([row for row in score.surface_windows if row["is_null"] and row["area_m2"] < 16.0])
    is_covered = null["cover"] >= 0.5
    assert is_covered.any()
    assert null["answered_m"][is_covered].max() == 0.0  # so their own threshold would be 0
    assert [row["threshold_m"] > 0.01 for row in limits_of(score) if row["area_m2"] < 16.0] == [True] * 4
    assert best_limit(score) == np.inf


def test_fields_on_pairs_that_ask_for_none_leave_the_table_as_it_was(truth: GroundTruth) -> None:
    asked = score_field(truth, noisy_field(truth, 3))
    still = wall_truth({}, family="regions/narrow")
    easy = score_field(still, field_that_says(still, np.zeros(2400)))
    assert easy.row["surface_cover"] == 1.0
    (alone,), (both,) = (tables_of(scores)["surface_table"].to_dict("records") for scores in ([asked], [asked, easy]))
    assert both == pytest.approx(alone, nan_ok=True)
    # where no pair asks, what was answered is shown
    (row,) = tables_of([easy])["surface_table"].to_dict("records")
    assert (row["n_pairs"], row["surface_cover"]) == (1, 1.0)


def test_an_empty_field_meets_no_target(truth: GroundTruth) -> None:
    columns = ("surface_error_median_m", "surface_error_p95_unchanged_m", "surface_limit_1m2_m", "surface_level_inside")
    bounds = tuple({"column": name, "name": name, "at_most": 1.0} for name in columns)
    targets = Targets(method="m", surface=bounds)
    judged = tables_of([score_field(truth, None)], targets=targets)["surface_targets"]
    assert list(judged["target"]) == list(columns)
    assert list(judged["is_met"]) == [False] * 4
    judged = tables_of([score_field(truth, noisy_field(truth, 1))], targets=targets)["surface_targets"]
    assert list(judged["is_met"]) == [True] * 4
