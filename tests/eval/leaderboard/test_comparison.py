"""The table beside the reference, by hand."""

from __future__ import annotations

import math
from pathlib import Path

import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from eval.cli.main import main
from eval.leaderboard.comparison import FIGURES, compare_with_reference, list_lines, write_tables_of
from eval.leaderboard.reference import find_reference, take_other_methods, why_nothing_compares
from eval.plans.cells import list_planned_cases
from eval.plans.changes import change_plan
from eval.plans.plan import load_plan
from eval.plans.splits import version_name
from eval.running.results.run_data import RunData, read_run
from eval.running.runfolder import RunFolder, write_json
from eval.scoring.scoring import METRICS_VERSION

RECALLS = {"mine": (1.0, 0.5, 0.0), "tunnelcd": (1.0, 1.0, 0.5), "a": (0.0, 0.0, 0.0)}


def table(seeds: tuple[int, ...] = (1, 2, 3)) -> pd.DataFrame:
    rows = [
        {
            "scenario": "narrow", "seed": seed, "variant": name, "family": "narrow", "pair_kind": "", "preset": name,
            "status": "failed" if name == "mine" and recall == 0 else "ok", "metrics_version": METRICS_VERSION,
            "region_recall": recall, "false_regions_per_100m": float(seed), "object_iou_point": recall / 2,
            "object_f1_50": recall, "t_total_s": 10.0 * seed if name != "mine" else math.nan,
        }
        for name, recalls in RECALLS.items()
        for seed, recall in zip(seeds, recalls, strict=True)
    ]  # fmt: skip
    return pd.DataFrame(rows)


def read(folder: Path, frame: pd.DataFrame, split: str = "") -> RunData:
    folder.mkdir(parents=True, exist_ok=True)
    frame.to_csv(folder / "results.csv", index=False)
    write_json(folder / "provenance.json", {"tool": "tunnelcd", "plan": {"name": "x", "split": split}})
    return read_run(folder)


def own(frame: pd.DataFrame) -> pd.DataFrame:
    return frame[frame["variant"] == "mine"]


def test_means_differences_and_pairs_by_hand(tmp_path: Path) -> None:
    frame = table()
    data = take_other_methods(read(tmp_path / "run", frame), "mine")
    calls = {("narrow", 3): {"error": "boom", "seconds": 4.0}}
    found = compare_with_reference(own(frame), "mine", [data], calls)
    rows = found.table.set_index("method")
    assert list(rows.index) == ["mine", "tunnelcd", "a"]
    assert rows.loc["mine", ["n_pairs", "n_answered"]].tolist() == [3, 2]
    assert rows["region_recall"].tolist() == [0.5, pytest.approx(2.5 / 3), 0.0]
    assert rows.loc["tunnelcd", "t_total_s"] == 20.0 and math.isnan(rows.loc["mine", "t_total_s"])
    against = found.pairs[found.pairs["reference"] == "tunnelcd"].set_index("seed")
    assert against["region_recall_difference"].tolist() == [0.0, -0.5, -0.5]
    assert against.loc[3, ["error", "command_s"]].tolist() == ["boom", 4.0]
    mean = found.paired.set_index(["reference", "metric"]).loc[("tunnelcd", "region_recall")]
    assert mean["difference"] == pytest.approx(-1 / 3) and mean["n_used"] == 3 and mean["verdict"] == "too few pairs"
    assert not {metric for reference, metric in zip(found.paired["reference"], found.paired["metric"], strict=True)
                if metric == "t_total_s"}  # fmt: skip
    write_tables_of(found, tmp_path / "out")
    assert len(pd.read_csv(tmp_path / "out" / "differences.csv")) == 6


def test_a_time_stated_where_it_is_small_counts_nothing_and_no_time_is_judged(tmp_path: Path) -> None:
    frame = table()
    frame.loc[frame["variant"] == "a", "status"] = "failed"
    frame.loc[(frame["variant"] == "mine") & (frame["seed"] == 1), "t_total_s"] = 0.01
    data = [take_other_methods(read(tmp_path / "run", frame), "mine")]
    assert math.isnan(compare_with_reference(own(frame), "mine", data, {}).table["t_total_s"][0])
    frame.loc[frame["variant"] == "mine", "t_total_s"] = 0.01
    found = compare_with_reference(own(frame), "mine", data, {})
    assert found.table["t_total_s"][0] == 0.01
    verdicts = found.paired.set_index(["reference", "metric"])["verdict"]
    assert verdicts["tunnelcd", "t_total_s"] == "not judged" != verdicts["tunnelcd", "object_f1_50"]


def test_the_table_fits_80_columns(tmp_path: Path) -> None:
    frame = table().replace({"variant": {"a": "a-method-with-a-very-long-name-indeed"}})
    frame.loc[frame["variant"] == "tunnelcd", "t_total_s"] = [1234.5, 0.00123, 99.9]
    data = take_other_methods(read(tmp_path / "run", frame), "mine")
    lines = list_lines(compare_with_reference(own(frame), "mine", [data], {}))
    assert max(map(len, lines)) <= 80
    # every figure stands apart from the next
    assert lines[1].split() == ["mine", "2/3", "0.50", "2.00", "0.25", "0.50", "\u2013"]
    assert lines[2].split() == ["0.00-1.00", "1.00-3.00", "0.00-0.50", "0.00-1.00"]
    assert any(line.startswith("pair by pair, mine less tunnelcd:") for line in lines)


def test_without_the_same_pairs_the_reason_is_told(tmp_path: Path) -> None:
    frame = table()
    for version, advice in (
        (version_name(), "with --split sealed"), ("tunnelcd 0.0.1", "with --split sealed:0.0.1"),
        ("tunnelcd 99.0.0", "evaluate with tunnelcd 99.0.0 and --split sealed"),
    ):  # fmt: skip
        sealed = read(tmp_path / version, table((7, 8, 9)), f"sealed by {version}")
        found = compare_with_reference(own(frame), "mine", [sealed], {})
        assert found.table["method"].tolist() == ["mine"] and len(found.pairs) == 3
        assert any(version in note and note.endswith(advice) for note in found.notes)
    partly = read(tmp_path / "partly", table((2, 3, 4)))
    found = compare_with_reference(own(frame), "mine", [take_other_methods(partly, "mine")], {})
    assert found.table["n_pairs"].tolist() == [2, 2, 2]
    assert any("2 of 3 pairs" in note for note in found.notes)


def test_the_first_place_that_has_a_method_counts(tmp_path: Path) -> None:
    frame = table()
    later = frame.assign(region_recall=0.25)
    places = [take_other_methods(read(tmp_path / name, each), "mine") for name, each in (("1", frame), ("2", later))]
    found = compare_with_reference(own(frame), "mine", places, {})
    assert found.table["method"].tolist() == ["mine", "tunnelcd", "a"]
    assert found.table["region_recall"].tolist()[2] == 0.0


def test_rows_of_a_method_about_other_pairs_hide_none_of_a_later_place(tmp_path: Path) -> None:
    places = [read(tmp_path / "1", table((7, 8, 9))), read(tmp_path / "2", table())]
    found = compare_with_reference(own(table()), "mine", places, {})
    assert found.table["method"].tolist() == ["mine", "tunnelcd", "a"]
    assert found.table["n_pairs"].tolist() == [3, 3, 3]


def test_a_reference_of_the_same_name_is_not_shown_as_the_method(tmp_path: Path) -> None:
    other = read(tmp_path / "theirs", table().assign(region_recall=0.9))
    found = compare_with_reference(own(table()), "mine", [other], {})
    assert found.table["method"].tolist() == ["mine", "tunnelcd", "a"]
    assert found.table["region_recall"].tolist()[0] == 0.5
    assert set(found.paired["reference"]) == {"tunnelcd", "a"} == set(found.pairs["reference"])
    alone = read(tmp_path / "alone", own(table()))
    found = compare_with_reference(own(table()), "mine", [alone], {})
    assert found.table["method"].tolist() == ["mine"]
    assert any("no reference results of these pairs" in note for note in found.notes)


def test_pairs_of_one_name_that_are_other_worlds_are_told(tmp_path: Path) -> None:
    frame = table().assign(n_changes=2)
    other = frame.assign(n_changes=[2, 3, 2] * 3)
    for reference, n_other in ((frame, 0), (other, 1)):
        data = take_other_methods(read(tmp_path / str(n_other), reference), "mine")
        found = compare_with_reference(own(frame), "mine", [data], {})
        assert (
            sum("other changes, another drive or another score radius (narrow 2)" in note for note in found.notes)
            == n_other
        )


def test_pairs_of_another_commit_are_told(tmp_path: Path) -> None:
    frame = table().assign(commit="1234567890")
    for commit, n_told in (("1234567890", 0), ("abcdefabcd", 1)):
        data = take_other_methods(read(tmp_path / commit, frame.assign(commit=commit)), "mine")
        found = compare_with_reference(own(frame), "mine", [data], {})
        assert sum(f"of {commit} are of commit {commit[:7]}:" in note for note in found.notes) == n_told
    elsewhere = read(tmp_path / "elsewhere", table((7, 8, 9)).assign(commit="abcdefabcd"))
    assert not any("of commit" in note for note in compare_with_reference(own(frame), "mine", [elsewhere], {}).notes)


def test_who_refuses_an_unchanged_pair_counts_as_alarmed(tmp_path: Path) -> None:
    frame = table().assign(is_unchanged_pair=True, is_alarm=0.0)
    undefined = ["region_recall", "object_iou_point", "object_f1_50"]
    frame.loc[:, undefined] = math.nan
    refused = frame["status"] == "failed"
    frame.loc[refused, ["false_regions_per_100m", "is_alarm"]] = math.nan
    frame.loc[frame["variant"] == "tunnelcd", "is_alarm"] = [1.0, 0.0, 0.0]
    data = take_other_methods(read(tmp_path / "run", frame), "mine")
    found = compare_with_reference(own(frame), "mine", [data], {})
    assert found.table["is_alarm"].tolist() == [pytest.approx(1 / 3), pytest.approx(1 / 3), 0.0]
    lines = list_lines(found)
    assert "alarms" in lines[0]
    assert "time" not in lines[0] and max(map(len, lines)) <= 80
    assert any(line.split()[:2] == ["alarms", "0.00"] for line in lines)


def test_a_name_that_leads_elsewhere_finds_no_reference(tmp_path: Path) -> None:
    read(tmp_path / "secret", table())
    (tmp_path / "reports").mkdir()
    assert find_reference("../reports/main", None) is None
    with pytest.raises(InputError, match="holds no"):
        find_reference("../secret", tmp_path / "reports")


def test_references_are_found_by_folder_and_by_plan(tmp_path: Path) -> None:
    read(tmp_path / "reports" / "x", table())
    for folder in (tmp_path / "reports", tmp_path / "reports" / "x"):
        found = find_reference("x", folder)
        assert found is not None and len(found.results) == 9
    committed = find_reference("main", None)
    assert committed is not None and {"tunnelcd", "m3c2"} < {row["variant"] for row in committed.results}
    assert all(name in committed.results[0] for name in FIGURES)
    assert find_reference("no such plan", None) is None
    with pytest.raises(InputError, match=r"holds no results\.csv"):
        find_reference("y", tmp_path / "reports")
    read(tmp_path / "old", table().assign(metrics_version=1))
    with pytest.raises(InputError, match="metrics version 1"):
        find_reference("x", tmp_path / "old")


def pairs_of(plan: str, split: str) -> list[tuple[str, int]]:
    return sorted({case[:2] for case in list_planned_cases(change_plan(load_plan(plan), split=split))})


def test_an_evaluation_that_nothing_compares_with_says_so_before_it_runs(tmp_path: Path) -> None:
    committed = find_reference("main", None)
    assert committed is not None
    version = committed.provenance["plan"]["split"].removeprefix("sealed by ")
    split = "sealed" if version == version_name() else f"sealed:{version.rpartition(' ')[2]}"
    told = why_nothing_compares("main", pairs_of("main", "dev"), committed, tmp_path, "mine")
    assert "reports/main holds none of these" in told and told.endswith(f"evaluate with --split {split}")
    assert not why_nothing_compares("main", pairs_of("main", split), committed, tmp_path, "mine")
    pair = ("narrow", 1)
    other = read(tmp_path / "other", table((7, 8, 9)))
    assert "seeds (7 to 9)" in why_nothing_compares("x", [pair], other, tmp_path, "mine")
    # rows under its own name are no reference
    alone = read(tmp_path / "alone", own(table()))
    assert why_nothing_compares("x", [pair], alone, tmp_path, "mine")
    assert not why_nothing_compares("x", [pair], alone, tmp_path, "b")


def test_a_plan_without_reference_results_is_told_unless_the_run_holds_methods(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("eval.leaderboard.reference.REPORTS", tmp_path)
    pairs = [("narrow", 1), ("narrow", 2)]
    assert "plan x has no reference results" in why_nothing_compares("x", pairs, None, tmp_path / "run", "mine")
    read(tmp_path / "x", table().assign(metrics_version=1))
    assert find_reference("x", None) is None
    assert "metrics version" in why_nothing_compares("x", pairs, None, tmp_path / "run", "mine")
    for name, is_told in (("mine", True), ("tunnelcd", False)):
        cell = RunFolder(tmp_path / "run").cell("narrow", 2, name)
        cell.parent.mkdir(parents=True, exist_ok=True)
        cell.write_text("{}")
        assert bool(why_nothing_compares("x", pairs, None, tmp_path / "run", "mine")) == is_told


def test_the_warning_comes_before_the_first_pair(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def evaluate(*_: object, **__: object) -> None:
        assert capsys.readouterr().err.startswith("warning: nothing to compare with: plan smoke has no reference")
        raise InputError("the first pair")

    monkeypatch.setattr("eval.leaderboard.evaluation.evaluate_command", evaluate)
    words = ["--command", "true {before} {after} {out}", "--as", "mine", "--out", str(tmp_path / "bench"), "--quiet"]
    with pytest.raises(SystemExit):
        main(["evaluate", "--plan", "smoke", *words])
    assert capsys.readouterr().err == "error: the first pair\n"


def test_domains_and_odometries_are_apart(tmp_path: Path) -> None:
    parts = [
        table().assign(scenario=world, family=world, odometry_before=odometry, odometry_after=odometry)
        for world, odometry in (("narrow", "drift"), ("cave", "drift"), ("wide", "kiss-icp"))
    ]
    parts[1].loc[parts[1]["variant"] == "mine", "region_recall"] = 0.25
    frame = pd.concat(parts, ignore_index=True)
    data = take_other_methods(read(tmp_path / "run", frame), "mine")
    found = compare_with_reference(own(frame), "mine", [data], {})
    rows = found.table[found.table["method"] == "mine"].set_index("part")
    assert rows["n_pairs"].to_dict() == {
        "in distribution, odometry drift": 3, "in distribution, odometry kiss-icp": 3,
        "out of distribution, odometry drift": 3,
    }  # fmt: skip
    assert rows.loc["out of distribution, odometry drift", "region_recall"] == 0.25
    lines = list_lines(found)
    assert lines[1] == "in distribution, odometry drift:" and max(map(len, lines)) <= 80
    assert sum(line.endswith("odometry drift:") for line in lines) == 4
    assert set(found.paired["n_pairs"]) == {3}
