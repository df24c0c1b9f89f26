from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from cdpipe.core.errors import InputError
from cdpipe.model.config import load_config
from eval.studies.calibrate import (
    find_alarm_threshold,
    find_rate_threshold,
    find_thresholds,
    format_plan,
    format_settings,
)


def test_five_per_cent_of_forty_pairs_alarm() -> None:
    # 40 pairs may give two alarms: the threshold lies just above the third best score, 0.38
    scores = np.arange(1, 41) / 100
    threshold = find_alarm_threshold(scores)
    assert threshold == pytest.approx(0.3801)
    assert (scores >= threshold).sum() == 2


def test_nineteen_pairs_allow_no_alarm() -> None:
    scores = np.linspace(100, 1234.56, 19)
    assert find_alarm_threshold(scores) == 1235.0
    assert find_alarm_threshold(np.array([1235.0])) == 1236.0


def test_pairs_without_candidates_count_as_silent() -> None:
    assert find_alarm_threshold(np.full(5, -np.inf)) == 0.0
    with pytest.raises(ValueError, match="at least one pair"):
        find_alarm_threshold(np.zeros(0))


def test_half_a_kilometre_allows_five_tenths_of_a_false_region_and_so_none() -> None:
    scores = np.array([9.0, 7.0, 7.0, 5.0])
    # 0.1 per 100 m: 500 m allow none, 1000 m one, 3000 m three, 4000 m all four
    assert find_rate_threshold(scores, 500.0) == pytest.approx(9.001)
    assert find_rate_threshold(scores, 1000.0) == pytest.approx(7.001)
    assert find_rate_threshold(scores, 2999.0) == pytest.approx(7.001)  # two share a score: both or none
    assert find_rate_threshold(scores, 3000.0) == pytest.approx(5.001)
    assert find_rate_threshold(scores, 4000.0) == 0.0
    assert find_rate_threshold(np.zeros(0), 0.0) == 0.0


def _results(n_changes: int = 0, preset: str = "c2c") -> pd.DataFrame:
    rows = [
        (scenario, 10_000 + seed, "m", preset, "ok" if seed else "merge_refused", n_changes, radius_m, 1000.0)
        for scenario, radius_m in (("null/a", 4.5), ("null/b", 4.5), ("null/c", 10.0))
        for seed in range(4)
    ]
    columns = ["scenario", "seed", "variant", "preset", "status", "n_changes", "score_radius_m", "after_path_m"]
    return pd.DataFrame(rows, columns=columns)


def _regions() -> pd.DataFrame:
    found = [("null/a", 1, 5.0), ("null/a", 1, 4.0), ("null/a", 2, 3.0), ("null/b", 3, 6.0), ("null/c", 1, 200.0)]
    rows = [(scenario, 10_000 + seed, "m", score, score >= 4.0, False) for scenario, seed, score in found]
    return pd.DataFrame(rows, columns=["scenario", "seed", "variant", "score", "is_reported", "is_withdrawn"])


def test_a_plan_that_names_no_wide_drifts_has_one_threshold_for_a_variant() -> None:
    table = find_thresholds(_results(), _regions(), has_wide=False)
    assert len(table) == 1
    assert np.isnan(table["score_radius_m"]).all()
    assert int(table["n_pairs"][0]) == 9  # of all three kinds of worlds
    assert format_plan(table) == ""  # a preset holds its own threshold
    named = format_plan(table.assign(variant="c2c[extract.method=surface]", threshold=200.1))
    assert yaml.safe_load(named) == {"thresholds": {"c2c[extract.method=surface]": 200.1}}
    both = pd.concat([table.assign(variant=f"c2c[a.b={value}]", threshold=value) for value in (-0.0, np.nan)])
    assert format_plan(both).splitlines()[1:] == [
        '  "c2c[a.b=-0.0]": 0',
        "  # c2c[a.b=nan]: none, too many pairs alarm at every threshold",
    ]


def test_a_table_by_hand() -> None:
    # narrow: 8 pairs, 2 refused; of the six answered none may alarm (5 % of 6), the best score is 6.
    # Their 6 km allow six false regions, and there are but four. Wide: 3 km allow three, there is one.
    table = find_thresholds(_results(), _regions())
    narrow, wide = table.to_dict("records")
    assert (narrow["score_radius_m"], narrow["n_pairs"], narrow["n_alarms"], narrow["n_unanswered"]) == (4.5, 6, 0, 2)
    assert narrow["threshold"] == pytest.approx(6.001)
    assert (narrow["threshold_at_rate"], narrow["n_false"], narrow["km"]) == (0.0, 4, 6.0)
    assert (wide["score_radius_m"], wide["threshold"], wide["km"]) == (10.0, pytest.approx(200.1), 3.0)


def test_a_preset_that_tells_no_sites_apart_has_one_threshold_of_all_pairs() -> None:
    table = find_thresholds(_results(preset="tunnelcd"), _regions())
    (one,) = table.to_dict("records")
    # 12 pairs, 3 refused; of the nine answered none may alarm, the best score is 200. 9 km allow nine false regions
    assert np.isnan(one["score_radius_m"])
    assert (one["n_pairs"], one["n_unanswered"], one["km"]) == (9, 3, 9.0)
    assert one["threshold"] == pytest.approx(200.1)
    lines = format_settings(table).splitlines()
    assert lines[2] == "    preset: {query: {threshold: 200.1}}  # all sites"
    assert not any("wide" in line for line in lines)
    # a preset of a file that is not at hand may tell them apart
    assert len(find_thresholds(_results(preset="mine"), _regions())) == 2
    with pytest.raises(InputError, match="m, all sites: no pair has an answer"):
        find_thresholds(_results(preset="tunnelcd").assign(status="failed"), _regions())


def test_a_world_that_was_not_made_has_no_threshold_of_its_own() -> None:
    made = _results().assign(n_observable=0.0)
    unmade = made.iloc[[1]].assign(seed=10_009, status="failed", score_radius_m=np.nan, n_observable=np.nan)
    found = find_thresholds(pd.concat([made, unmade]), _regions())
    pd.testing.assert_frame_equal(found, find_thresholds(made, _regions()))


def test_what_was_withdrawn_cannot_alarm() -> None:
    regions = _regions()
    regions.loc[regions["score"].isin([6.0, 4.0]), ["is_reported", "is_withdrawn"]] = False, True
    narrow, wide = find_thresholds(_results(), regions).to_dict("records")
    assert narrow["threshold"] == pytest.approx(5.001)
    assert wide["threshold"] == pytest.approx(200.1)


def test_no_threshold_is_below_what_was_looked_at() -> None:
    # all that was let through, down to 4, was withdrawn; what scored 3 was never looked at
    regions = _regions()
    is_narrow = regions["scenario"] != "null/c"
    regions.loc[is_narrow, "is_withdrawn"] = regions.loc[is_narrow, "is_reported"]
    regions.loc[is_narrow, "is_reported"] = False
    narrow, wide = find_thresholds(_results(), regions).to_dict("records")
    assert (narrow["threshold"], narrow["threshold_at_rate"], narrow["n_alarms"]) == (4.0, 4.0, 0)
    assert wide["threshold"] == pytest.approx(200.1)
    assert find_alarm_threshold(np.full(5, -np.inf), lowest=-6.905) == -6.905
    assert find_alarm_threshold(np.array([-7.0, -2.5]), lowest=-6.905) == pytest.approx(-2.499)
    assert find_alarm_threshold(np.full(40, -8.0), lowest=-6.905) == -6.905


def test_a_region_to_which_an_object_was_followed_tells_nothing_of_what_was_looked_at() -> None:
    # all down to 4 was withdrawn; the one of 3 stands, but its object was found from another region
    regions = _regions()
    is_narrow = regions["scenario"] != "null/c"
    regions.loc[is_narrow, "is_withdrawn"] = regions.loc[is_narrow, "is_reported"]
    regions.loc[is_narrow, "is_reported"] = ~regions.loc[is_narrow, "is_reported"]
    narrow = find_thresholds(_results(), regions).iloc[0]
    assert (narrow["threshold"], narrow["threshold_at_rate"]) == (4.0, 4.0)


def test_what_is_looked_at_at_every_threshold_is_silenced_by_none() -> None:
    one_pair = _results(preset="tunnelcd")[:1]
    results = pd.concat([one_pair] * 60, ignore_index=True).assign(seed=range(10_000, 10_060), status="ok")
    rows = [("null/a", 10_000 + k, -9.0 + 0.1 * k, k >= 3, True) for k in range(60)]
    rows.append(("null/a", 10_059, -2.0, False, False))
    columns = ["scenario", "seed", "score", "is_withdrawn", "is_forced"]
    regions = pd.DataFrame(rows, columns=columns).assign(variant="m", is_reported=lambda t: ~t["is_withdrawn"])
    (one,) = find_thresholds(results, regions).to_dict("records")
    # 60 pairs: three may alarm. The ends of three stand whatever the threshold, so no other pair may
    assert (one["threshold"], one["n_alarms"]) == (pytest.approx(-1.999), 3)
    assert (one["threshold_at_rate"], one["n_false"]) == (0.0, 3)  # 60 km allow sixty
    # those of a fourth: no threshold silences it
    regions.loc[3, ["is_withdrawn", "is_reported"]] = False, True
    table = find_thresholds(results, regions)
    (one,) = table.to_dict("records")
    assert np.isnan(one["threshold"]) and one["n_alarms"] == 4
    text = format_settings(table)
    assert "  # m, all sites: none: 4 of 60 pairs alarm at every threshold\n" in text
    assert list(yaml.safe_load(text)["threshold_at_rate"]) == ["m"]
    # in a table of an earlier version the scores of ends were at least the threshold, and no column marks them
    before = find_thresholds(results, regions.drop(columns="is_forced"))
    pd.testing.assert_frame_equal(before, find_thresholds(results, regions.assign(is_forced=np.nan)))
    assert before["threshold"].notna().all()


def test_the_settings_are_lines_of_a_preset(tmp_path: Path) -> None:
    document = yaml.safe_load(format_settings(find_thresholds(_results(), _regions())))
    assert set(document) == {"threshold", "threshold_at_rate"}
    found = document["threshold"]["m"]
    assert found["preset"] == {"query": {"threshold": 6.001}}
    preset = tmp_path / "mine.yaml"
    preset.write_text(yaml.safe_dump({**found["preset"], "wide": found["wide_10m"]}))
    queries = [load_config(str(preset), site=site).query for site in ("narrow", "wide")]
    assert [(query.radius_m, query.threshold) for query in queries] == [(4.5, 6.001), (10.0, 200.1)]


def test_changed_pairs_are_refused() -> None:
    with pytest.raises(InputError, match="null/a, null/b, null/c: "):
        find_thresholds(_results(n_changes=1), pd.DataFrame(columns=["scenario", "seed", "variant", "score"]))


def test_only_validation_seeds_are_calibrated_on() -> None:
    results = _results()
    results.loc[3, "seed"] = 20_000
    with pytest.raises(InputError, match="seed 20000: settings are chosen on seeds 10000 to 19999 alone"):
        find_thresholds(results, _regions())


def test_a_kind_of_site_without_an_answer_gives_no_threshold() -> None:
    with pytest.raises(InputError, match="m, 10 m: "):
        find_thresholds(_results().assign(status=["ok"] * 8 + ["failed"] * 4), _regions())
