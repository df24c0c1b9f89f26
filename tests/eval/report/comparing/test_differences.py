"""Paired differences by hand, verdicts, what is refused, and what is on one side only."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from eval.report.comparing.columns import COMPARED, figures_of
from eval.report.comparing.differences import (
    BETTER,
    NOISE,
    NOT_JUDGED,
    SAME,
    TOO_FEW,
    WORSE,
    compare,
    paired_differences,
    verdict,
)
from eval.report.comparing.page import compare_sides
from eval.report.page import write_page
from eval.report.summary import means_by_method
from eval.running.results.run_data import read_run
from eval.running.results.sides import cautions, is_one_machine, only_in, read_side, short_names, why_no_times
from eval.scoring.scoring import METRICS_VERSION
from eval.tables.columns import select
from eval.tables.regions.curves import ranked_pairs, recall_at
from eval.tables.rows import PAIR

NAN = float("nan")
Write = Callable[..., Path]


def row(seed: int, scenario: str = "regions/narrow", variant: str = "tunnelcd", **columns: object) -> dict[str, object]:
    return {
        "scenario": scenario, "family": scenario, "seed": seed, "variant": variant, "status": "ok", "pair_kind": "",
        "metrics_version": METRICS_VERSION, **columns,
    }  # fmt: skip


@pytest.fixture(name="write")
def write_fixture(tmp_path: Path) -> Write:
    """Return a function that writes a run folder of rows."""

    def write(name: str, rows: list[dict[str, object]], **tables: list[dict[str, object]]) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        for table, items in {"results": rows, **tables}.items():
            pd.DataFrame(items).to_csv(folder / f"{table}.csv", index=False)
        machine = {"cpu": "made up", "cores": 2}
        (folder / "provenance.json").write_text(json.dumps({"tool": "tunnelcd", "machine": machine}))
        return folder

    return write


def compared(a: Path | str, b: Path | str, **options: bool) -> pd.DataFrame:
    return compare(read_side(str(a)), read_side(str(b)), **options)


def the_row(table: pd.DataFrame, metric: str, where: str = "in") -> pd.Series:
    found = table[(table["metric"] == metric) & (table["where"] == where)]
    assert len(found) == 1
    return found.iloc[0]


def test_two_pairs_by_hand(write: Write) -> None:
    a = write("a", [row(1, region_recall=0.5, t_total_s=2.0), row(2, region_recall=0.25, t_total_s=4.0)])
    b = write("b", [row(1, region_recall=1.0, t_total_s=1.0), row(2, region_recall=0.5, t_total_s=1.0)])
    recall, time = (the_row(compared(a, b), metric) for metric in ("region_recall", "t_total_s"))
    # differences 1/2 and 1/4; of four draws of two pairs one in four is twice the least, one twice the greatest
    assert (recall["mean_a"], recall["mean_b"], recall["difference"]) == (0.375, 0.75, 0.375)
    assert (recall["low"], recall["high"]) == (0.25, 0.5)
    assert (time["difference"], time["low"], time["high"]) == (-2.0, -3.0, -1.0)
    assert (recall["n_pairs"], recall["n_used"], recall["verdict"]) == (2, 2, TOO_FEW)


def test_only_pairs_of_both_sides_with_a_number_on_both_are_used(write: Write) -> None:
    a = write("a", [row(1, region_recall=0.5), row(2, region_recall=NAN), row(3, region_recall=0.9), row(4)])
    b = write("b", [row(1, region_recall=0.6), row(2, region_recall=0.1), row(3, region_recall=NAN), row(9)])
    found = the_row(compared(a, b), "region_recall")
    assert found[["n_pairs", "n_used", "n_only_a", "n_only_b"]].tolist() == [3, 1, 1, 1]
    assert found["difference"] == pytest.approx(0.1)
    assert np.isnan(found["low"])


def test_the_order_of_rows_does_not_matter(write: Write) -> None:
    rng = np.random.default_rng(0)
    sides = [[row(seed, region_recall=rng.random(), merge_error_m=rng.random()) for seed in range(9)] for _ in "ab"]
    plain = compared(*(write(name, rows) for name, rows in zip("ab", sides, strict=True)))
    shuffled = [[rows[i] for i in rng.permutation(9)] for rows in sides]
    other = compared(*(write(name, rows) for name, rows in zip("cd", shuffled, strict=True)))
    pd.testing.assert_frame_equal(plain, other)


def test_swapping_the_sides_swaps_signs_and_verdicts(write: Write) -> None:
    rng = np.random.default_rng(1)
    a = write("a", [row(seed, region_recall=0.2 * rng.random(), t_total_s=1.0 + seed) for seed in range(8)])
    b = write("b", [row(seed, region_recall=0.5 + 0.2 * rng.random(), t_total_s=2.0 + seed) for seed in range(8)])
    ahead, back = compared(a, b), compared(b, a)
    np.testing.assert_allclose(ahead["difference"], -back["difference"])
    assert [the_row(ahead, name)["verdict"] for name in ("region_recall", "t_total_s")] == [BETTER, WORSE]
    assert [the_row(back, name)["verdict"] for name in ("region_recall", "t_total_s")] == [WORSE, BETTER]


def test_every_column_has_a_direction_and_the_verdict_respects_it() -> None:
    assert {column.better for column in COMPARED} == {"high", "low"}
    low = {column.key for column in COMPARED if column.better == "low"}
    costs = {"t_total_s", "t_total_with_merge_s", "bytes_regions_before"}
    errors = {"merge_error_m", "merge_error_deg", "merge_error_m_p95"}
    assert low == {"false_regions_per_100m", "is_alarm"} | costs | errors
    assert word("high", 6, 0.2, 0.1, 0.3) == word("low", 6, -0.2, -0.3, -0.1) == BETTER
    assert word("low", 6, 0.2, 0.1, 0.3) == word("high", 6, -0.2, -0.3, -0.1) == WORSE
    assert word("high", 60, 0.2, 0.0, 0.3) == word("low", 60, 0.0, -0.1, 0.3) == NOISE
    assert word("high", 5, 0.2, 0.1, 0.3) == word("high", 1, 0.2, NAN, NAN) == TOO_FEW
    assert word("high", 6, 0.0, 0.0, 0.0) == SAME


def test_the_same_is_the_same_number_on_every_pair_however_few(write: Write) -> None:
    plain = write("plain", [row(1, region_recall=0.5, region_auroc=0.8, region_precision=NAN)])
    other = write("other", [row(1, region_recall=0.5, region_auroc=0.9, region_precision=NAN)])
    found = compared(plain, other)
    assert [the_row(found, key)["verdict"] for key in ("region_recall", "region_auroc")] == [SAME, TOO_FEW]
    # two pairs of one tunnel differ, and their mean does not
    worlds = ("regions/narrow", "dust/narrow")
    up = write("up", [row(seed, world, region_recall=0.5) for seed in range(8) for world in worlds])
    swapped = [
        row(seed, world, region_recall=value)
        for seed in range(8)
        for world, value in zip(worlds, (0.25, 0.75), strict=True)
    ]
    assert the_row(compared(up, write("down", swapped)), "region_recall")["verdict"] == NOISE


def word(good: str, n_used: int, difference: float, low: float, high: float) -> str:
    return verdict({"good": good, "n_used": n_used, "difference": difference, "low": low, "high": high})


def test_noise_is_called_moved_about_once_in_twenty_times() -> None:
    rng = np.random.default_rng(2)
    words = []
    for _ in range(200):
        frame = pd.DataFrame([row(seed, region_recall=value) for seed, value in enumerate(rng.normal(size=40))])
        other = frame.assign(region_recall=frame["region_recall"] + rng.normal(size=40))
        first, second = (figures_of(each) for each in (frame, other))
        words.append(_recall_verdict(first, second))
    assert 0.01 < sum(word != NOISE for word in words) / 200 < 0.11


def _recall_verdict(a: pd.DataFrame, b: pd.DataFrame) -> str:
    first, second = (side.set_index(PAIR) for side in (a, b))
    found = {each["metric"]: each for each in paired_differences(first, second)}["region_recall"]
    return verdict(found)


def test_domains_scenarios_and_all_pairs_have_rows(write: Write) -> None:
    rows = [
        row(seed, scenario, region_recall=0.5) for scenario in ("regions/narrow", "regions/cave") for seed in (1, 2)
    ]
    table = compared(write("a", rows), write("b", rows))
    recall = table[table["metric"] == "region_recall"]
    assert dict(zip(zip(recall["scope"], recall["where"], strict=True), recall["n_pairs"], strict=True)) == {
        ("domain", "in"): 2, ("domain", "out"): 2, ("domain", "all"): 4,
        ("scenario", "regions/cave"): 2, ("scenario", "regions/narrow"): 2,
    }  # fmt: skip
    assert set(recall["verdict"]) == {SAME}


def test_a_refusal_counts_as_no_answer_but_where_it_can_be_right() -> None:
    rows = [row(1), row(2, status="merge_refused"), row(3, status="merge_refused", pair_kind="disjoint")]
    figures = figures_of(pd.DataFrame(rows))
    assert figures["is_answered"].tolist()[:2] == [1.0, 0.0]
    assert np.isnan(figures["is_answered"][2])
    assert figures["is_within_target"].isna().tolist() == [True, True, False]
    assert figures["is_within_target"][2] == 1.0


def test_refusing_the_unchanged_pairs_on_which_it_would_cry_wolf_counts_as_crying() -> None:
    unchanged = {"is_unchanged_pair": True, "scenario": "null/narrow", "pair_kind": "clean"}
    rows = [row(1, **unchanged, is_alarm=False), row(2, **unchanged, is_alarm=NAN, status="merge_refused")]
    rows += [row(3, is_unchanged_pair=False, is_alarm=NAN, status="merge_refused")]
    rows += [row(4, **{**unchanged, "pair_kind": "smooth"}, is_alarm=NAN, status="merge_refused")]  # rightly so
    assert figures_of(pd.DataFrame(rows))["is_alarm"].tolist() == pytest.approx([0, 1, NAN, NAN], nan_ok=True)


def test_a_cost_that_is_stated_where_it_is_small_has_no_mean() -> None:
    rows = [row(seed, t_total_s=1.0, bytes_regions_before=1000.0) for seed in (1, 2)]
    partly = [row(1, t_total_s=1.0, bytes_regions_before=NAN), row(2, t_total_s=NAN, bytes_regions_before=1000.0)]
    refused = row(3, t_total_s=NAN, bytes_regions_before=NAN, status="merge_refused")
    for own, cost in (([*rows, refused], (1.0, 1000.0)), ([*partly, refused], (NAN, NAN))):
        found = means_by_method(figures_of(pd.DataFrame(own)), select(COMPARED, "t_total_s", "bytes_regions_before"))
        assert found[["t_total_s", "bytes_regions_before"]].to_numpy()[0].tolist() == pytest.approx(cost, nan_ok=True)


def test_truth_values_read_back_as_texts_are_numbers() -> None:
    figures = figures_of(pd.DataFrame([row(1, is_alarm="True"), row(2, is_alarm="False"), row(3, is_alarm=NAN)]))
    np.testing.assert_array_equal(figures["is_alarm"], [1.0, 0.0, NAN])


def test_variants_of_one_run_are_held_against_one_of_them(write: Write) -> None:
    rows = [row(seed, variant=name, region_recall=value) for seed in (1, 2)
            for name, value in (("a:b", 0.2), ("c2c", 0.3), ("tunnelcd", 0.9))]  # fmt: skip
    run = write("run", rows)
    table = compared(f"{run}:a:b", run)
    recall = table[(table["metric"] == "region_recall") & (table["scope"] == "domain")]
    assert recall["variant_b"].tolist() == ["c2c", "tunnelcd"]
    assert set(recall["variant_a"]) == {"a:b"}
    np.testing.assert_allclose(recall["difference"], [0.1, 0.7])
    single = compared(f"{run}:c2c", f"{run}:tunnelcd")
    assert the_row(single, "region_recall")["difference"] == pytest.approx(0.6)
    with pytest.raises(InputError, match=r'no variant tunnlcd; did you mean "tunnelcd"'):
        read_side(f"{run}:tunnlcd")
    with pytest.raises(InputError, match="no such run folder: expected RUN or RUN:VARIANT"):
        read_side(f"{run}x:c2c")


def test_recall_at_a_rate_is_drawn_again_for_both(write: Write) -> None:
    def sides(is_good: bool) -> tuple[list[dict[str, object]], dict[str, list[dict[str, object]]]]:
        rows = [row(seed, n_observable=1, score_radius_m=4.5, after_path_m=1000.0) for seed in range(8)]
        names = [{key: each[key] for key in ("scenario", "seed", "variant")} for each in rows]
        changes = [{**each, "id": 1, "is_observable": True, "n_truth_cells": 20} for each in names]
        # the bad method scores a false region above every true one
        regions = [{**each, "score": 0.5, "found_changes": "1", "is_withdrawn": False} for each in names]
        wrong = {"score": 0.9, "found_changes": "", "is_withdrawn": False}
        regions += [] if is_good else [{**each, **wrong} for each in names for _ in "12"]
        return rows, {"regions": regions, "changes": changes}

    folders = []
    for name, is_good in (("a", False), ("b", True)):
        rows, tables = sides(is_good)
        folders.append(write(name, rows, **tables))
        frames = (pd.DataFrame(each) for each in (rows, tables["regions"], tables["changes"]))
        assert recall_at(ranked_pairs(*frames), 0.1) == float(is_good)
    found = the_row(compared(*folders), "recall_at_0.1")
    assert found[["mean_a", "mean_b", "difference", "low", "high"]].tolist() == [0.0, 1.0, 1.0, 1.0, 1.0]
    assert (found["n_used"], found["verdict"]) == (8, BETTER)


def test_a_method_without_any_candidate_has_recall_0(write: Write) -> None:
    figures = {"n_observable": 1, "score_radius_m": 4.5, "after_path_m": 2000.0}
    rows = [row(seed, variant=name, **figures) for seed in range(8) for name in ("a", "b")]
    names = [{"scenario": "regions/narrow", "seed": seed, "variant": name} for seed in range(8) for name in ("a", "b")]
    region = {"score": 9.0, "found_changes": "1", "is_withdrawn": False}
    regions = [{**each, **region} for each in names if each["variant"] == "b"]
    changes = [{**each, "id": 1, "is_observable": True, "n_truth_cells": 9, "is_found": False} for each in names]
    folder = write("run", rows, regions=regions, changes=changes)
    found = the_row(compared(f"{folder}:a", f"{folder}:b"), "recall_at_0.1")
    assert found[["mean_a", "mean_b", "verdict"]].tolist() == [0.0, 1.0, BETTER]


def test_a_world_that_neither_side_could_make_is_no_pair(write: Write) -> None:
    made = [row(1, region_recall=0.5, n_observable=2), row(2, region_recall=0.5, n_observable=2)]
    unmade = {**row(3, region_recall=NAN, n_observable=NAN), "status": "failed"}
    folders = [write(name, [*made, unmade]) for name in "ab"]
    found = the_row(compared(*folders), "is_answered")
    assert (found["n_pairs"], found["mean_a"], found["mean_b"]) == (2, 1.0, 1.0)
    whole = write("c", [*made, row(3, region_recall=0.5, n_observable=2)])
    found = the_row(compared(whole, folders[1]), "is_answered")
    assert (found["n_pairs"], found["mean_a"], round(found["mean_b"], 3)) == (3, 1.0, 0.667)


def test_what_a_failed_answer_states_of_its_cost_counts_nowhere(write: Write) -> None:
    cost = {"t_total_s": 2.0, "bytes_regions_before": 100.0, "region_recall": 0.5}
    failed = {**row(3, t_total_s=0.0, bytes_regions_before=1.0, region_recall=0.0), "status": "failed"}
    folders = [write(name, [row(1, **cost), row(2, **cost), failed]) for name in "ab"]
    table = compared(*folders)
    assert the_row(table, "t_total_s")["mean_a"] == 2.0
    assert the_row(table, "bytes_regions_before")["mean_a"] == 100.0
    assert the_row(table, "region_recall")["n_used"] == 3
    assert [row["t_total_s"] for row in read_run(folders[0]).results][:2] == [2.0, 2.0]
    assert np.isnan(float(str(read_run(folders[0]).results[2]["t_total_s"])))


def test_other_metrics_versions_are_refused_in_one_line_that_says_how_to_mend(write: Write) -> None:
    old = write("old", [row(1, region_recall=0.5, metrics_version=METRICS_VERSION - 1)])
    new = write("new", [row(1, region_recall=0.5)])
    with pytest.raises(InputError) as refused:
        compared(old, new)
    message = str(refused.value)
    assert "\n" not in message
    assert f"{old}: metrics version {METRICS_VERSION - 1} and {new}: metrics version {METRICS_VERSION}" in message
    assert f"{old} holds no answers and truths to score again: run its plan again" in message
    assert f"{new} holds" not in message
    answer = old / "answers" / "narrow" / "1" / "tunnelcd"
    answer.mkdir(parents=True)
    (answer / "answer.json").touch()
    (old / "pairs").mkdir()
    with pytest.raises(InputError, match=f"`tunnelcd score {old}` scores it again"):
        compared(new, old)
    mixed = write("mixed", [row(1, metrics_version=METRICS_VERSION - 1), row(2)])
    with pytest.raises(InputError, match=f"metrics version {METRICS_VERSION - 1} and {METRICS_VERSION}:"):
        compared(mixed, mixed)
    unknown = write("unknown", [{key: value for key, value in row(1).items() if key != "metrics_version"}])
    with pytest.raises(InputError, match="metrics version unknown"):
        compared(unknown, new)


def test_rows_with_and_without_an_extra_are_not_mixed(write: Write) -> None:
    fine = write("fine", [row(1, extras="kiss-matcher 1.0;py4dgeo 1"), row(2, extras=""), row(3)])
    mixed = write("mixed", [row(1, extras="py4dgeo 1;kiss-matcher 1.0"), row(2, extras="kiss-matcher absent"), row(3)])
    compared(fine, fine)
    for sides in ((fine, mixed), (mixed, fine)):
        with pytest.raises(
            InputError, match=f"^{mixed}: rows of tunnelcd are of kiss-matcher 1.0 and absent: make them all"
        ):
            compared(*sides)


def test_what_another_program_says_of_its_packages_stops_no_page(write: Write, tmp_path: Path) -> None:
    plan = {"name": "x", "scenarios": ["regions/narrow"], "seeds": [1, 2], "variants": [{"preset": "tunnelcd"}]}
    rows = [row(1, variant="theirs", extras="a 1"), row(2, variant="theirs", extras="a 2"), row(1), row(2)]
    (write("theirs", rows) / "provenance.json").write_text(json.dumps({"plan": plan}))
    assert write_page(tmp_path / "theirs").exists()
    rows[2:] = [row(1, extras="a 1"), row(2, extras="a 2")]
    (write("ours", rows) / "provenance.json").write_text(json.dumps({"plan": plan}))
    with pytest.raises(InputError, match="rows of tunnelcd are of a 1 and 2"):
        write_page(tmp_path / "ours")


def test_runs_that_share_nothing_and_rows_that_stand_twice_are_refused(write: Write) -> None:
    a, b = write("a", [row(1)]), write("b", [row(2)])
    with pytest.raises(InputError, match="share no session pair and variant"):
        compared(a, b)
    twice = write("twice", [row(1), row(1)])
    with pytest.raises(InputError, match="regions/narrow, seed 1, tunnelcd stands there twice"):
        compared(a, twice)


def test_a_run_of_mixed_metrics_gets_no_page(write: Write) -> None:
    mixed = write("mixed", [row(1, metrics_version=METRICS_VERSION - 1), row(2)])
    with pytest.raises(InputError, match=f"metrics version {METRICS_VERSION - 1} and {METRICS_VERSION}:"):
        write_page(mixed)
    assert not (mixed / "index.html").exists()


@pytest.mark.parametrize(("seed", "told"), [("x", "seed = x: expected a whole number"), (1.5, "seed = 1.5: expected")])
def test_a_seed_that_is_none_is_named(write: Write, seed: object, told: str) -> None:
    broken = write("broken", [row(1), {**row(2), "seed": seed}])
    with pytest.raises(InputError, match=f"results.csv:3: {told}"):
        read_run(broken)


def test_what_is_on_one_side_only_is_counted_and_named(write: Write) -> None:
    shared = [row(seed, region_recall=0.5) for seed in (1, 2)]
    more = [row(seed, variant="c2c") for seed in (1, 2)] + [row(seed, "regions/cave") for seed in (1, 2, 3)]
    more += [row(seed) for seed in (5, 6, 7, 9)]
    a, b = (read_side(str(write(name, rows))) for name, rows in (("a", shared + more), ("b", shared)))
    assert only_in(a, b) == [
        "variant c2c: 2 rows",
        "scenario regions/cave: 3 rows",
        "regions/narrow, seed 5-7, 9 of tunnelcd: 4 rows",
    ]
    assert only_in(b, a) == []


@pytest.mark.parametrize(
    ("column", "values"),
    [("score_radius_m", (4.5, 9.0)), ("n_surface_places", (2400, 2300)), ("overlap_true", (1.0, 0.9))],
)
def test_pairs_that_ask_for_something_else_are_told(write: Write, column: str, values: tuple[float, float]) -> None:
    sides = [
        read_side(str(write(name, [row(1, **{column: values[0]}), row(2, **{column: value})])))
        for name, value in zip("ab", values, strict=True)
    ]
    assert cautions(sides[0], sides[1])[0].endswith("on the two sides (regions/narrow 2).")
    assert not any("shared pair" in told for told in cautions(sides[0], sides[0]))


def test_cautions_about_worlds_and_machines(write: Write) -> None:
    a = write("a", [row(1, n_changes=2), row(2, n_changes=2)])
    b = write("b", [row(1, n_changes=2), row(2, n_changes=3)])
    sides = [read_side(str(each)) for each in (a, b)]
    assert is_one_machine(*sides)
    assert cautions(*sides) == [
        "1 shared pair holds other changes, another drive or another score radius on the two sides (regions/narrow 2)."
    ]
    (b / "provenance.json").write_text(json.dumps({"tool": "tunnelcd", "machine": {"cpu": "another"}}))
    sides[1] = read_side(str(b))
    assert not is_one_machine(*sides)
    assert "Times are not judged" in cautions(*sides)[1]
    assert short_names(*sides) == ("a", "b")


def test_a_column_of_truth_values_is_compared_as_numbers(write: Write) -> None:
    a = write("a", [row(1, n_changes=True), row(2, n_changes=True)])
    b = write("b", [row(1, n_changes=True), row(2, n_changes=False)])
    (told,) = cautions(read_side(str(a)), read_side(str(b)))
    assert told.endswith("(regions/narrow 2).")


def test_times_measured_beside_other_work_are_not_judged(write: Write) -> None:
    quiet = write("quiet", [row(1, is_contended=False), row(2, is_contended=NAN)])
    busy = write("busy", [row(1, is_contended=False), row(2, is_contended=True)])
    assert why_no_times(*(read_side(str(each)) for each in (quiet, quiet))) == ""
    told = why_no_times(*(read_side(str(each)) for each in (quiet, busy)))
    assert told == "those of busy were measured beside other work"


def test_times_of_other_machines_are_shown_and_not_judged(write: Write) -> None:
    a, b = (write(name, [row(seed, t_total_s=value) for seed in range(8)]) for name, value in (("a", 1.0), ("b", 2.0)))
    assert the_row(compared(a, b), "t_total_s")["verdict"] == WORSE
    found = the_row(compared(a, b, times_count=False), "t_total_s")
    assert (found["verdict"], found["difference"]) == (NOT_JUDGED, 1.0)


def test_domains_are_compared_over_the_pairs_of_the_plan_alone(write: Write) -> None:
    def rows(kiss: float, drift: float) -> list[dict[str, object]]:
        of = {"kiss-icp": kiss, "drift": drift}
        return [
            {**row(seed, f"narrow[odometry={name}]", region_recall=recall), "family": "narrow",
             "odometry_before": name, "odometry_after": name}
            for name, recall in of.items() for seed in range(8)
        ]  # fmt: skip

    a, b = write("a", rows(0.5, 0.5)), write("b", rows(0.25, 1.0))
    plan = {"name": "mine", "targets": {"method": "tunnelcd", "odometry": "kiss-icp"}}
    for folder in (a, b):
        (folder / "provenance.json").write_text(json.dumps({"tool": "tunnelcd", "plan": plan}))
    table = compared(a, b)
    assert the_row(table, "region_recall")[["n_pairs", "difference", "verdict"]].tolist() == [8, -0.25, WORSE]
    of_drift = the_row(table, "region_recall", "narrow[odometry=drift]")
    assert of_drift[["n_pairs", "difference"]].tolist() == [8, 0.5]
    told = compare_sides(read_side(str(a)), read_side(str(b))).cautions[0]
    assert told.startswith("Domains are compared over pairs with kiss-icp alone")


def test_a_cost_that_some_answers_leave_out_is_not_compared(write: Write) -> None:
    a = write("a", [row(seed, t_total_s=4.0, bytes_regions_before=100) for seed in range(8)])
    b = write("b", [row(seed, t_total_s=1.0 if seed < 6 else NAN, bytes_regions_before=10) for seed in range(8)])
    table = compared(a, b)
    assert "t_total_s" not in set(table["metric"])
    assert the_row(table, "bytes_regions_before")["verdict"] == BETTER


def test_objects_without_regions_are_an_alarm_where_nothing_changed() -> None:
    rows = [row(1, is_unchanged_pair=True, is_alarm=False, n_objects=n) for n in (0, 500)]
    rows.append(row(2, is_unchanged_pair=False, is_alarm=NAN, n_objects=3))
    found = figures_of(pd.DataFrame(rows))["is_alarm"]
    assert found.tolist()[:2] == [0.0, 1.0] and np.isnan(found[2])
