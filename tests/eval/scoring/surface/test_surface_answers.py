"""What a displacement field may say: the value at the limit is taken, the next one is refused, and named."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cdpipe.core.geometry import FARTHEST_M
from cdpipe.io.answer import Answer
from cdpipe.model.report import SurfaceField, SurfaceRegion
from eval.scoring import answer_check as module
from eval.scoring.answer_check import MAX_AMOUNT, MAX_DISPLACEMENT_M
from eval.scoring.scoring import score_answer
from eval.scoring.surface.metrics import COLUMNS, is_surface_pair, score_surface
from tests.eval.scoring.surface.surface_worlds import report_of, score_field, surface_columns, true_field, wall_truth
from tests.eval.scoring.test_answer_check import FAR, INF, NAN, TOO_MUCH, taken_or_refused

MORE_M = np.nextafter(MAX_DISPLACEMENT_M, INF)


def field_of(**changed: Any) -> SurfaceField:
    """Three points in two regions, of which some part is changed in its last entry."""
    region = SurfaceRegion(np.zeros(3), 1.0, 0.1, 0.1, 0.1)
    of_region = {name: value for name, value in changed.items() if name in SurfaceRegion.__dataclass_fields__}
    arrays = {
        "points_map": np.zeros((3, 3)), "normals_map": np.tile((0.0, 0.6, 0.8), (3, 1)), "displacement_m": np.zeros(3),
        "level_m": np.full(3, 0.01), "region": np.array([0, 1, -1], np.int32),
    }  # fmt: skip
    for name, value in changed.items():
        if name in arrays:
            arrays[name][2] = value
    return SurfaceField(**arrays, regions=(region, replace(region, **of_region)))


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({}, None),
        ({"displacement_m": MAX_DISPLACEMENT_M}, None),
        ({"displacement_m": -MAX_DISPLACEMENT_M}, None),
        ({"displacement_m": NAN}, None),
        ({"displacement_m": MORE_M}, "surface_displacement_m: entry 2 is 5: expected at most 5 m in size, NaN"),
        ({"displacement_m": -MORE_M}, "surface_displacement_m: entry 2 is -5: expected"),
        ({"displacement_m": INF}, "surface_displacement_m: entry 2 is inf: expected"),
        ({"level_m": MAX_DISPLACEMENT_M}, None),
        ({"level_m": NAN}, None),
        ({"level_m": 5e-324}, None),
        ({"level_m": 0.0}, "surface_level_m: entry 2 is 0: expected a length in metres, up to 5, NaN where it"),
        ({"level_m": MORE_M}, "surface_level_m: entry 2 is 5: expected"),
        ({"level_m": 1e9}, r"surface_level_m: entry 2 is 1e\+09: expected"),
        ({"normals_map": (0.0, 0.0, 1.0009)}, None),
        ({"normals_map": (0.0, 0.0, 0.9991)}, None),
        ({"normals_map": (0.0, 0.0, 1.0011)}, "surface_normals_map: entry 2 has length 1.0011: expected a unit vector"),
        ({"normals_map": (0.0, 0.0, 0.9989)}, "surface_normals_map: entry 2 has length 0.9989"),
        ({"normals_map": (0.8, 0.8, 0.0)}, "surface_normals_map: entry 2 has length 1.13137"),
        ({"points_map": (0.0, 0.0, FARTHEST_M)}, None),
        ({"points_map": (0.0, 0.0, FAR)}, "surface_points_map: entry 2 is farther than"),
        ({"points_map": (0.0, NAN, 0.0)}, "surface_points_map: entry 2 is not a finite number"),
        ({"centre_map": np.array([FARTHEST_M, 0.0, 0.0])}, None),
        ({"centre_map": np.array([FAR, 0.0, 0.0])}, r"surface_regions\[1\]\.centre_map: entry 0 is farther than"),
        ({"area_m2": 0.0}, None),
        ({"area_m2": MAX_AMOUNT}, None),
        ({"area_m2": -1e-300}, r"surface_regions\[1\]\.area_m2 = -1e-300: expected 0 to 1e\+15 m2"),
        ({"area_m2": TOO_MUCH}, r"surface_regions\[1\]\.area_m2 = 1"),
        ({"area_m2": NAN}, r"surface_regions\[1\]\.area_m2 = nan"),
        ({"volume_m3": MAX_AMOUNT}, None),
        ({"volume_m3": -MAX_AMOUNT}, None),
        ({"volume_m3": TOO_MUCH}, r"surface_regions\[1\]\.volume_m3 = 1"),
        ({"volume_m3": -TOO_MUCH}, r"surface_regions\[1\]\.volume_m3 = -1"),
        ({"volume_m3": NAN}, r"surface_regions\[1\]\.volume_m3 = nan"),
        ({"mean_m": MAX_DISPLACEMENT_M}, None),
        ({"mean_m": MORE_M}, r"surface_regions\[1\]\.mean_m = 5.0"),
        ({"mean_m": NAN}, r"surface_regions\[1\]\.mean_m = nan"),
        ({"largest_m": -MAX_DISPLACEMENT_M}, None),
        ({"largest_m": -MORE_M}, r"surface_regions\[1\]\.largest_m = -5.0"),
        ({"largest_m": INF}, r"surface_regions\[1\]\.largest_m = inf"),
    ],
)  # fmt: skip
def test_fields(changed: dict[str, Any], told: str | None) -> None:
    with taken_or_refused(told):
        module._check_surface(field_of(**changed))


def test_the_first_entry_that_cannot_be_is_named() -> None:
    field = replace(field_of(), displacement_m=np.array([0.0, 7.0, 8.0]))
    with pytest.raises(ValueError, match="entry 1 is 7"):
        module._check_surface(field)
    field = replace(field_of(), normals_map=np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 3.0], [0.0, 0.0, 2.0]]))
    with pytest.raises(ValueError, match="entry 1 has length 3"):
        module._check_surface(field)


def test_which_pairs_ask_for_a_field() -> None:
    patch = {1: (5, 1, 2, 2, 0.1)}
    families = {"surface/a": True, "surface": True, "surfaces/a": False, "regions/surface": False}
    for family, is_asked in families.items():
        assert is_surface_pair(wall_truth({}, family=family)) == is_asked
        assert is_surface_pair(wall_truth(patch, family=family))


def test_an_answer_that_ends_at_the_merge_has_no_figures_of_the_rock() -> None:
    truth = wall_truth({1: (5, 1, 2, 2, 0.1)})
    answer = Answer("ok", "", "m", report_of(truth, true_field(truth)), {}, {}, until="merge")
    found = score_surface(answer, truth, 30.0)
    assert (found.columns, found.changes, found.windows) == ({}, [], [])


def test_a_field_that_nobody_asked_for_is_scored_without_a_number_of_changes() -> None:
    counts = []
    for family in ("surface/a", "regions/a"):
        truth = wall_truth({}, family=family)
        answer = Answer("ok", "", "m", report_of(truth, true_field(truth)), {}, {})
        counts.append(score_surface(answer, truth, 40.0).columns["n_surface_changes"])
    assert counts[0] == 0
    assert np.isnan(counts[1])


def test_the_seconds_are_the_answers_own_and_rates_need_a_path_and_an_answer() -> None:
    truth = wall_truth({})
    field = replace(true_field(truth), region=np.zeros(2400, np.int32), regions=field_of().regions[:1])
    report = report_of(truth, field)
    found = score_surface(Answer("ok", "", "m", report, {"t_surface_s": 2.5}, {}), truth, 40.0).columns
    assert (found["t_surface_s"], found["surface_false_regions_per_100m"]) == (2.5, 2.5)
    short = score_surface(Answer("ok", "", "m", report, {}, {}), truth, 0.5).columns
    assert short["surface_false_regions_per_100m"] == 200.0
    assert np.isnan(score_surface(Answer("ok", "", "m", report, {}, {}), truth, 0.0).columns[
        "surface_false_regions_per_100m"])  # fmt: skip
    none = score_surface(Answer("failed", "", "m", None, {}, {}), truth, 40.0).columns
    assert np.isnan([none["surface_false_regions_per_100m"], none["t_surface_s"]]).all()
    assert list(found) == list(COLUMNS)
    # on unchanged rock a region is worth nothing, and none is not wrong
    assert found["surface_region_precision"] == 0.0
    assert np.isnan(none["surface_region_precision"])
    assert np.isnan([found["surface_recall"], found["surface_volume_error_share"]]).all()


def test_levels_of_the_rock_by_hand() -> None:
    # 2,400 places: 40 of each column; level 1 cm
    truth = wall_truth({1: (20, 0, 5, 5, 0.2)})
    field = true_field(truth)
    x = field.points_map[:, 0]
    said = np.where(x < 3, 0.01, np.where(x < 6, -0.0101, np.where(x < 9, 0.005, np.nan)))
    level = np.where(x < 6, 0.01, np.where(x < 7, np.nan, 0.006))
    found = surface_columns(score_field(truth, replace(field, displacement_m=said, level_m=level)))
    # x < 3 is inside, to 6 beyond, to 7 without a level, to 9 inside; one column more takes the answer of its neighbour
    assert found["surface_level_inside"] == pytest.approx((12 + 8 + 1) / 37)
    assert found["surface_level_median_m"] == 0.01
    assert found["surface_cover"] == pytest.approx(37 / 120)
    assert (found["surface_cover_changed"], found["surface_cover_unchanged"]) == (0.0, pytest.approx(37 / 100))
    # no displacement at all: what has no level is not inside
    silent = replace(field, displacement_m=np.zeros(2400), level_m=np.full(2400, NAN))
    assert score_field(truth, silent).row["surface_level_inside"] == 0.0
    assert score_field(truth, None).row["surface_level_inside"] == 0.0
    everything = wall_truth({1: (-1, -1, 40, 10, 0.2)})
    none = score_answer(Answer("failed", "", "m", None, {}, {}), everything).row
    assert np.isnan(
        [none["surface_level_inside"], none["surface_level_median_m"], none["surface_cover_unchanged"]]
    ).all()
    assert none["surface_cover_changed"] == 0.0


def test_volumes_by_hand() -> None:
    # a scar and its rubble; the scar is answered in two regions, the rubble in one that holds some of the scar as well
    truth = wall_truth({1: (5, 1, 2, 2, -0.1), 2: (9, 1, 1, 1, 0.2)}, kinds={1: "scar", 2: "rubble"})
    field = true_field(truth)
    x = field.points_map[:, 0]
    own = field.regions[0]
    regions = tuple(replace(own, volume_m3=each) for each in (-0.1, -0.15, 0.05, 7.0, -7.0))
    region = np.where(field.region == 0, np.where(x < 5.5, 0, np.where(x < 6.5, 1, 2)), -1)
    region = np.where(field.region == 1, 2, region)  # 16 places of each
    region = np.where(x > 20, 3, region)
    score = score_field(truth, replace(field, region=region.astype(np.int32), regions=regions))
    scar, rubble = score.surface_changes
    assert (scar["answered_volume_m3"], rubble["answered_volume_m3"]) == pytest.approx((-0.25, 0.05))
    assert (scar["volume_error_share"], rubble["volume_error_share"]) == pytest.approx((0.15 / 0.4, 0.15 / 0.2))
    assert score.row["surface_volume_error_share"] == pytest.approx((0.375 + 0.75) / 2)
    # twice too much is off by the whole volume, and ten times is not worse
    for factor, share in ((2.0, 1.0), (10.0, 1.0), (1.5, 0.5)):
        huge = tuple(replace(each, volume_m3=factor * each.volume_m3) for each in field.regions)
        found = score_field(truth, replace(field, regions=huge)).row["surface_volume_error_share"]
        assert found == pytest.approx(share)
    # changes that are no scar and no rubble are not asked
    plain = wall_truth({1: (5, 1, 2, 2, -0.1), 2: (9, 1, 1, 1, 0.2)}, kinds={1: "scar", 2: "heave"})
    assert score_field(plain, None).row["surface_volume_error_share"] == 1.0
    half = tuple(replace(each, volume_m3=0.5 * each.volume_m3) for each in field.regions)
    assert score_field(plain, replace(field, regions=half)).row["surface_volume_error_share"] == pytest.approx(0.5)


def test_a_region_belongs_to_the_change_of_most_judged_places_that_moved() -> None:
    truth = wall_truth({1: (17, 1, 1, 2, 0.1), 2: (24, 1, 4, 3, 0.2), 3: (5, 1, 1, 1, 0.3)}, unseen_from_m=20.0)
    field = true_field(truth)
    # one region on what was seen of 1, and on all of 2, which nobody could judge; change 3 is not answered
    region = np.where(np.isin(field.region, (0, 1)), 0, -1).astype(np.int32)
    regions = (replace(field.regions[0], volume_m3=0.25),)
    first, second, third = score_field(truth, replace(field, region=region, regions=regions)).surface_changes
    assert [row["answered_volume_m3"] for row in (first, second, third)] == [0.25, 0.0, 0.0]
    assert (second["n_places"], second["is_observable"]) == (0, False)


def test_rock_that_moved_and_belongs_to_no_change_takes_no_region_away() -> None:
    truth = wall_truth({1: (5, 1, 2, 2, 0.1), 2: (9, 1, 1, 1, 0.2)})
    surface = truth.before.surface
    before = replace(truth.before, surface=replace(surface, change=np.where(surface.change == 1, 0, surface.change)))
    truth = replace(truth, sessions={**truth.sessions, "before": before})
    field = true_field(wall_truth({1: (5, 1, 2, 2, 0.1), 2: (9, 1, 1, 1, 0.2)}))
    region = np.where(field.region >= 0, 0, -1).astype(np.int32)
    _, second = score_field(truth, replace(field, region=region, regions=field.regions[:1])).surface_changes
    assert second["answered_volume_m3"] == pytest.approx(0.4)


def test_a_change_without_a_volume_has_no_error_of_it() -> None:
    truth = wall_truth({1: (5, 1, 2, 2, 0.1)}, kinds={1: "scar"})
    changes = tuple(replace(each, volume_m3=0.0) for each in truth.pair.surface_changes)
    score = score_field(replace(truth, pair=replace(truth.pair, surface_changes=changes)), None)
    assert np.isnan(score.surface_changes[0]["volume_error_share"])
    assert np.isnan(score.row["surface_volume_error_share"])


def test_errors_of_distinct_values_by_hand() -> None:
    # 120 columns of 20 places; column k is answered k tenths of a millimetre; columns 40 to 79 moved by -0.1 m
    truth = wall_truth({1: (10, 0, 10, 5, -0.1)})
    field = true_field(truth)
    column = np.floor(field.points_map[:, 0] / 0.25)
    found = score_field(truth, replace(field, displacement_m=1e-4 * column)).row
    error = 1e-4 * np.arange(120) + np.where((np.arange(120) >= 40) & (np.arange(120) < 80), 0.1, 0.0)
    parts = {"": error, "_changed": error[40:80], "_unchanged": np.r_[error[:40], error[80:]]}
    for part, of_part in parts.items():
        of_places = np.repeat(of_part, 20)
        assert found[f"surface_error_median{part}_m"] == pytest.approx(np.median(of_places), abs=1e-8)
        assert found[f"surface_error_p95{part}_m"] == pytest.approx(np.percentile(of_places, 95), abs=1e-8)
        # too much into the void is too little of what moved out of it
        bias_m = -of_part.mean() if part == "_changed" else of_part.mean()
        assert found[f"surface_bias{part}_m"] == pytest.approx(bias_m, abs=1e-8)
        assert found[f"surface_cover{part}"] == 1.0
