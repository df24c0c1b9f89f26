import errno
import json
import math
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import count, groupby
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import pytest
from torch import nn

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.descriptors.change_network import make_untrained_change_network
from cdpipe.descriptors.sphere_network import make_untrained_sphere_network
from cdpipe.descriptors.weights_file import numbered_checkpoint_bytes
from cdpipe.io.answer import read_answer
from cdpipe.io.readers import open_session
from cdpipe.mapping.mapping import build_map
from cdpipe.model.config import MapConfig
from cdpipe.pipeline import Done
from eval.core.terminal.progress import Silent
from eval.plans.cells import expand_cells
from eval.plans.changes import change_plan
from eval.plans.plan import Plan, load_plan
from eval.running import pair_run
from eval.running.cell_rows import ITEM_TABLES
from eval.running.pair_run import Tools
from eval.running.rescoring import _list_unscored, rescore
from eval.running.runfolder import (
    NEW_TABLES,
    RunFolder,
    open_run_folder,
    start_run_folder,
    write_json,
    write_tables,
)
from eval.running.runner import RunOutcome, _provenance, run_plan
from eval.running.stages.pair_stages import time_parts
from eval.scoring.scoring import METRICS_VERSION
from eval.truth.adapters import pipeline_input
from tests.eval.running.runs import (
    MAPLESS,
    ONE_BOX,
    UNCHANGED,
    VARIANTS,
    Runner,
    Told,
    load_small,
    plan_of,
    table,
)


def test_smoke_plan_end_to_end(smoke: RunFolder) -> None:
    results = table(smoke)
    assert results["status"].tolist() == ["ok"] * 8
    # in the plan's order, not the alphabet's
    assert list(zip(results["scenario"], results["variant"], strict=True)) == [
        (name, variant) for name in (ONE_BOX, UNCHANGED) for variant in VARIANTS
    ]
    assert set(results["seed"]) == {20000}
    assert results["n_changes"].tolist() == [1] * 4 + [0] * 4
    assert (results["merge_error_m"] < 0.1).all()
    # an unchanged pair has nothing to recall
    assert results["region_recall"].notna().tolist() == [True] * 4 + [False] * 4
    for name in ("changes", "regions", "objects", "keyframes"):
        items = table(smoke, name)
        assert set(items["variant"]) <= set(VARIANTS)
        assert {"scenario", "seed", "variant"} <= set(items.columns)
    assert len(table(smoke, "changes")) == len(VARIANTS)
    assert {"value", "low", "high", "n", "n_failed"} <= set(table(smoke, "summary").columns)


def test_the_box_is_found(tmp_path: Path, runner: Runner) -> None:
    # the preset is tuned and calibrated for four times as many returns
    found = '{preset: voxel-diff, set: ["regions.min_points=8", "query.threshold=0"]}'
    run, _ = runner.run(tmp_path / "run", plan_of(tmp_path, variants=found))
    assert table(run)["region_recall"].tolist() == [1.0]


def test_times_and_sizes_of_a_run(smoke: RunFolder) -> None:
    results = table(smoke)
    times = results[[name for name in results.columns if name.startswith("t_") and "per_" not in name]]
    assert np.isfinite(times.to_numpy()).all()
    for _, cases in results.groupby("scenario"):
        # one merge serves all variants of a pair that merge alike, one set of descriptors all
        seconds = cases.set_index("variant")["t_merge_s"]
        for alike in (["paper", "random-regions"], ["tunnelcd", "voxel-diff"]):
            assert seconds[alike].nunique() == 1
        described = cases.set_index("variant")["t_descriptor_s"]
        assert (described[["tunnelcd", "paper"]] > 0).all()
        assert (cases.set_index("variant").loc[["voxel-diff", "random-regions"], "t_descriptor_s"] == 0).all()
    np.testing.assert_allclose(results["t_total_s"], results["t_descriptor_s"] + results["t_cd_s"] + results["t_oe_s"])
    assert (results["map_points_before"] > 1000).all()
    assert (results["n_keyframes_after"] > 10).all()


def test_stored_maps_are_those_of_the_default_settings(smoke: RunFolder) -> None:
    with np.load(smoke.maps(ONE_BOX, 20000)) as stored:
        for session in ("before", "after"):
            expected = build_map(pipeline_input(smoke.pair(ONE_BOX, 20000), session), MapConfig()).points
            np.testing.assert_array_equal(stored[f"{session}_points"], expected.astype(np.float32))


def test_a_run_goes_on_with_the_same_packages_and_names_both_machines(tmp_path: Path, runner: Runner) -> None:
    plan = plan_of(tmp_path, variants="{preset: random-regions}, {preset: c2c}")
    run, _ = runner.run(tmp_path / "run", plan, limit=1)
    told = run.provenance()
    for versions, threads in (
        ({**told["versions"], "numpy": "1.0"}, told["machine"]["threads"]),
        (told["versions"], 63),
    ):
        machine = {**told["machine"], "threads": threads}
        write_json(run.path / "provenance.json", {**told, "versions": versions, "machine": machine})
        with pytest.raises(InputError, match=r"its finished cells and the others: of different .*or add --force"):
            runner.run(tmp_path / "run", plan)
    write_json(run.path / "provenance.json", {**told, "machine": {**told["machine"], "cpu": "another"}})
    runner.run(tmp_path / "run", plan)
    found = run.provenance()
    assert found["machine"]["cpu"] == f"another and {told['machine']['cpu']}"
    assert [part["machine"]["cpu"] for part in found["parts"]] == ["another", told["machine"]["cpu"]]
    assert runner.run(tmp_path / "run", plan)[1].n_done == 0
    assert run.provenance()["parts"] == found["parts"]


def test_provenance_says_what_made_the_results(smoke: RunFolder) -> None:
    document = smoke.provenance()
    assert document["command"] == "tunnelcd run 'a b'"
    assert document["seeds"] == [20000]
    assert Plan.model_validate(document["plan"]) == load_plan("smoke")
    assert set(document["config_digests"]) == {
        f"{name} {variant}" for name in (ONE_BOX, UNCHANGED) for variant in VARIANTS
    }
    assert len(set(document["config_digests"].values())) == 4
    assert list(document["checkpoints"]) == ["3deg", "sphere"]
    assert all(document["checkpoints"].values())
    assert document["finished"] >= document["started"]
    assert document["machine"]["cores"] >= 1
    assert document["versions"]["numpy"] == np.__version__


def test_finished_cells_are_kept(smoke_copy: RunFolder, runner: Runner) -> None:
    before = {path: path.stat().st_mtime_ns for path in smoke_copy.path.rglob("*") if "cells" in path.parts}
    outcome = runner.run(smoke_copy.path, load_plan("smoke"))[1]
    assert outcome == RunOutcome(n_done=0, n_kept=8, n_left=0)
    assert runner.families() == []
    assert before == {path: path.stat().st_mtime_ns for path in before}


@pytest.mark.parametrize("refusing", [("paper",), VARIANTS])
def test_the_summary_counts_a_refused_unchanged_pair_as_an_alarm(
    smoke_copy: RunFolder, refusing: tuple[str, ...]
) -> None:
    for variant in refusing:
        path = smoke_copy.cell(UNCHANGED, 20000, variant)
        cell = json.loads(path.read_text())
        cell["row"] |= {"status": "merge_refused", "is_alarm": None}
        path.write_text(json.dumps(cell))
    assert write_tables(smoke_copy)["is_alarm"].isna().sum() == len(VARIANTS) + len(refusing)
    summary = pd.read_csv(smoke_copy.path / "summary.csv").set_index(["scenario", "variant", "metric"])
    assert summary.loc[(UNCHANGED, "paper", "is_alarm"), ["value", "n_used"]].tolist() == [1, 1]


def test_effects_count_a_refused_unchanged_pair_as_the_summary_does(smoke_copy: RunFolder) -> None:
    quiet = f"{UNCHANGED}[sensor.range_noise=false]"
    cell = json.loads(smoke_copy.cell(UNCHANGED, 20000, "tunnelcd").read_text())
    assert cell["row"]["is_alarm"] is False
    row = {**cell["row"], "scenario": quiet, "status": "merge_refused", "is_alarm": None}
    write_json(smoke_copy.cell(quiet, 20000, "tunnelcd"), {**cell, "row": row})
    write_tables(smoke_copy)
    alarms = table(smoke_copy, "effects").set_index("metric").loc["is_alarm"]
    assert alarms[["without", "with", "difference", "n"]].tolist() == [0, 1, 1, 1]


def test_a_run_that_makes_no_cell_leaves_who_made_them(smoke_copy: RunFolder, runner: Runner) -> None:
    """Other code, command and time: the provenance still names those that the rows are of; the tables are written."""
    before = smoke_copy.provenance()
    (smoke_copy.path / "summary.csv").unlink()
    later = replace(runner.tools, commit=lambda: "f" * 40, now=lambda: "2999-01-01T00:00:00+00:00")
    assert runner.run(smoke_copy.path, load_plan("smoke"), command=["again"], tools=later)[1].n_done == 0
    told = smoke_copy.provenance()
    assert told.pop("tables") == {"git_commit": "f" * 40}
    assert told == before
    assert (smoke_copy.path / "summary.csv").is_file()
    smoke_copy.cell(ONE_BOX, 20000, "paper").unlink()
    runner.run(smoke_copy.path, load_plan("smoke"), command=["again"], tools=later)
    assert smoke_copy.provenance()["git_commit"] == "f" * 40
    assert "tables" not in smoke_copy.provenance()
    assert smoke_copy.provenance()["finished"] == "2999-01-01T00:00:00+00:00"


def test_a_cell_cut_short_is_done_again_and_no_other(smoke_copy: RunFolder, runner: Runner) -> None:
    cut = smoke_copy.cell(ONE_BOX, 20000, "paper")
    cut.write_text(cut.read_text()[:-50])
    row = table(smoke_copy).query("scenario == @ONE_BOX and variant == 'paper'")["region_recall"].item()
    assert runner.run(smoke_copy.path, load_plan("smoke"))[1] == RunOutcome(1, 7, 0)
    assert runner.families() == []
    assert table(smoke_copy).query("scenario == @ONE_BOX and variant == 'paper'")["region_recall"].item() == row


def test_another_version_of_the_metrics_redoes_all(smoke_copy: RunFolder, runner: Runner) -> None:
    for path in smoke_copy.path.glob("cells/*/*/*.json"):
        document = json.loads(path.read_text())
        document["row"]["metrics_version"] -= 1
        write_json(path, document)
    assert runner.run(smoke_copy.path, load_plan("smoke"), limit=1)[1] == RunOutcome(1, 0, 7)
    # what is stale is in no table
    assert len(table(smoke_copy)) == 1


def test_limit_and_then_the_rest(tmp_path: Path, runner: Runner) -> None:
    plan = plan_of(tmp_path, variants="{preset: voxel-diff}, {preset: random-regions}")
    run, outcome = runner.run(tmp_path / "run", plan, limit=1)
    assert outcome == RunOutcome(1, 0, 1)
    assert table(run)["variant"].tolist() == ["voxel-diff"]
    assert runner.run(tmp_path / "run", plan)[1] == RunOutcome(1, 1, 0)
    assert table(run)["variant"].tolist() == ["voxel-diff", "random-regions"]
    assert runner.families() == [ONE_BOX]


def test_an_infinite_figure_of_a_cell_stands_in_results_alone(smoke_copy: RunFolder) -> None:
    path = next(iter(sorted(smoke_copy.path.glob("cells/*/*/*.json"))))
    cell = json.loads(path.read_text())
    cell["row"] |= {"n_partial": math.inf, "n_observable": math.inf}
    path.write_text(json.dumps(cell))
    assert np.isinf(write_tables(smoke_copy)["n_partial"]).sum() == 1
    assert not np.isinf(pd.read_csv(smoke_copy.path / "summary.csv").select_dtypes("number")).any(axis=None)


def test_force_and_a_limit_would_leave_others_without_rows(smoke_copy: RunFolder, tmp_path: Path) -> None:
    before = sorted(path.name for path in smoke_copy.path.glob("cells/*/*/*"))
    with pytest.raises(InputError, match="--force removes every finished cell of the plan, and --limit runs a part"):
        run_plan(load_plan("smoke"), smoke_copy, force=True, limit=1)
    assert sorted(path.name for path in smoke_copy.path.glob("cells/*/*/*")) == before


def test_sessions_that_were_removed_by_hand_are_made_again_on_demand(tmp_path: Path, runner: Runner) -> None:
    plan = plan_of(tmp_path)
    run, _ = runner.run(tmp_path / "run", plan)
    shutil.rmtree(run.path / "pairs")
    assert runner.run(run.path, plan)[1].n_done == 0 and not (run.path / "pairs").exists()
    assert runner.run(run.path, plan, keep="sessions")[1].n_done == 0
    assert (run.pair(ONE_BOX, 20000) / "truth" / "changes.json").is_file()


def test_tables_that_cannot_all_be_written_stay_those_of_before(
    smoke_copy: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {path.name: path.read_bytes() for path in smoke_copy.path.glob("*.csv")}
    path = next(iter(sorted(smoke_copy.path.glob("cells/*/*/*.json"))))
    cell = json.loads(path.read_text())
    cell["row"]["n_regions"] = 77
    path.write_text(json.dumps(cell))

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("eval.running.runfolder._write_csv", full)
        with pytest.raises(OSError, match="No space left"):
            write_tables(smoke_copy)
    assert {path.name: path.read_bytes() for path in smoke_copy.path.glob("*.csv")} == before
    assert not (smoke_copy.path / NEW_TABLES).exists()
    assert 77 in write_tables(smoke_copy)["n_regions"].tolist()
    assert 77 in pd.read_csv(smoke_copy.path / "results.csv")["n_regions"].tolist()


def test_maps_beyond_what_pictures_can_show_are_one_line(smoke_copy: RunFolder) -> None:
    path = next(iter(sorted(smoke_copy.path.glob("maps/*/*.npz"))))
    with np.load(path) as stored:
        points = {name: stored[name].copy() for name in stored.files}
    points["after_points"][0, 1] = 1e30
    np.savez(path, allow_pickle=False, **points)
    scenario, seed = path.parent.name.replace("__", "/"), int(path.stem)
    with pytest.raises(InputError, match=rf"{path.name}: after_points: positions reach 1.*can be numbered up to"):
        smoke_copy.read_maps(scenario, seed)


def test_a_changed_setting_redoes_its_cells_only(tmp_path: Path, runner: Runner) -> None:
    preset = tmp_path / "own.yaml"
    preset.write_text("regions: {source: voxel-diff}\nextract: {method: clusters}\n")
    plan = plan_of(tmp_path, variants=f"{{preset: {preset}}}, {{preset: random-regions}}")
    run, _ = runner.run(tmp_path / "run", plan)
    assert table(run)["preset"].tolist() == ["own", "random-regions"]
    preset.write_text("regions: {source: voxel-diff}\nextract: {method: clusters}\nquery: {threshold: 1000000}\n")
    assert runner.run(tmp_path / "run", plan)[1] == RunOutcome(1, 1, 0)
    assert table(run).set_index("variant").loc["own", "n_regions"] == 0
    assert runner.families() == [ONE_BOX]


def test_force_redoes_everything(tmp_path: Path, runner: Runner) -> None:
    plan = plan_of(tmp_path)
    runner.run(tmp_path / "run", plan)
    assert runner.run(tmp_path / "run", plan, force=True)[1] == RunOutcome(1, 0, 0)
    assert runner.families() == [ONE_BOX, ONE_BOX]


def test_a_pair_of_another_scenario_is_simulated_anew(tmp_path: Path, runner: Runner) -> None:
    plan = plan_of(tmp_path)
    runner.run(tmp_path / "run", plan)
    changed = replace(runner.tools, draw=lambda name, seed, settings: load_small(name, seed, ["score_radius_m=5"]))
    assert runner.run(tmp_path / "run", plan, tools=changed)[1].n_done == 1
    assert runner.families() == [ONE_BOX, ONE_BOX]


def test_a_refused_merge_is_a_row_that_scores_0(tmp_path: Path, runner: Runner) -> None:
    variants = '{preset: paper, set: ["merge.min_hessian_ratio=1"]}, {preset: voxel-diff}'
    run, _ = runner.run(tmp_path / "run", plan_of(tmp_path, scenarios=f"{ONE_BOX}, {UNCHANGED}", variants=variants))
    results = table(run).set_index(["scenario", "variant"])
    refused = "paper[merge.min_hessian_ratio=1]"
    row = results.loc[(ONE_BOX, refused)]
    assert row["status"] == "merge_refused"
    assert "cannot be merged" in row["error"]
    assert row[["region_recall", "region_recall_at_k", "object_iou_point", "object_f1_25"]].tolist() == [0, 0, 0, 0]
    assert row[["t_refine_s", "t_total_s", "merge_error_m"]].isna().all()
    assert row["t_merge_s"] > 0
    assert row["t_index_s"] > 0
    assert results.loc[(UNCHANGED, refused), "status"] == "merge_refused"
    assert np.isnan(results.loc[(UNCHANGED, refused), "region_recall"])
    assert results.loc[(ONE_BOX, "voxel-diff"), "status"] == "ok"
    answer = read_answer(run.answer(ONE_BOX, 20000, refused))
    assert answer.report is None
    assert "hessian_ratio" in answer.evidence
    assert table(run, "changes").query("variant == @refused")["is_found"].tolist() == [False]


def test_an_error_of_the_input_is_a_row_and_a_bug_is_not(tmp_path: Path, runner: Runner) -> None:
    class Broken(Silent):
        def stage(self, name: str, done: int, total: int) -> None:
            if name == "merge":
                raise RuntimeError("a bug")

    plan = plan_of(tmp_path, variants=f"{MAPLESS}, {{preset: voxel-diff}}")
    run, _ = runner.run(tmp_path / "run", plan)
    results = table(run)
    failed, fine = results.to_dict("records")
    assert (failed["status"], fine["status"]) == ("failed", "ok")
    assert "map.max_range_m" in failed["error"]
    assert failed["region_recall"] == 0
    with pytest.raises(RuntimeError, match="a bug"):
        runner.run(tmp_path / "run", plan, force=True, progress=Broken())
    # what was finished before the bug is kept
    assert run.read_cell(run.cell(ONE_BOX, 20000, failed["variant"])) is not None
    assert run.read_cell(run.cell(ONE_BOX, 20000, fine["variant"])) is None


@pytest.mark.parametrize("step", ["draw", "simulate"])
def test_a_world_that_cannot_be_made_is_a_row_and_the_others_go_on(tmp_path: Path, runner: Runner, step: str) -> None:
    usual = getattr(runner.tools, step)

    def fails_for_one(what: Any, *rest: Any) -> Any:
        if ONE_BOX in (what, getattr(what, "family", "")):
            raise ScenarioError("props stand in each other")
        return usual(what, *rest)

    tools = replace(runner.tools, **{step: fails_for_one})
    plan = plan_of(tmp_path, scenarios=f"{ONE_BOX}, {UNCHANGED}")
    run, outcome = runner.run(tmp_path / "run", plan, tools=tools)
    assert outcome == RunOutcome(2, 0, 0)
    results = table(run).set_index("scenario")
    assert results["status"].to_dict() == {ONE_BOX: "failed", UNCHANGED: "ok"}
    assert results.loc[ONE_BOX, "error"] == "props stand in each other"
    assert np.isnan(results.loc[ONE_BOX, "region_recall"])


@pytest.mark.parametrize("keep", [None, "sessions"])
def test_a_world_that_cannot_be_built_is_not_tried_again(
    tmp_path: Path, runner: Runner, keep: Literal["sessions"] | None
) -> None:
    asked = []

    def fails(scenario: object, *_: Any) -> None:
        asked.append(scenario)
        raise ScenarioError("props stand in each other")

    tools = replace(runner.tools, simulate=fails)
    for force, n_asked in ((False, 1), (False, 1), (True, 2)):
        runner.run(tmp_path / "run", plan_of(tmp_path), tools=tools, keep=keep, force=force)
        assert len(asked) == n_asked


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path: Path, runner: Runner) -> None:
    class Impatient:
        def cells(self, label: str, done: int, total: int) -> None:
            if done == 2:
                raise KeyboardInterrupt

        def stage(self, name: str, done: int, total: int) -> None:
            pass

    plan = plan_of(
        tmp_path, scenarios=f"{ONE_BOX}, {UNCHANGED}", variants="{preset: voxel-diff}, {preset: random-regions}"
    )
    with pytest.raises(KeyboardInterrupt):
        runner.run(tmp_path / "run", plan, progress=Impatient())
    assert runner.run(tmp_path / "run", plan)[1] == RunOutcome(2, 2, 0)


def test_stages_are_shared_by_the_settings_they_depend_on(tmp_path: Path, runner: Runner) -> None:
    told = Told()
    coarse = 'set: ["map.voxel_m=0.3"]'
    # the two that share a map stand apart in the plan
    # both presets map and merge alike
    alike = [
        "map.consistency=graph", "map.airborne=drop", "map.movers=drop", "merge.refine=checked", "merge.first_every=4",
    ]  # fmt: skip
    same = f"{{preset: random-regions, set: {json.dumps(alike)}}}"
    variants = f"{{preset: voxel-diff}}, {{preset: voxel-diff, {coarse}}}, {same}"
    run, _ = runner.run(tmp_path / "run", plan_of(tmp_path, variants=variants), progress=told)
    # the page's maps, of the recorded poses as answers are; and those of each map setting
    assert (told.stages.count("map before"), told.stages.count("map after")) == (3, 3)
    # another map has the same keyframes
    assert told.stages.count("describe keyframes") == 1
    # per map setting, and each of them again for the clock
    assert [name for name, _ in groupby(told.stages)].count("merge") == 2
    assert table(run)["variant"].tolist() == [
        "voxel-diff",
        "voxel-diff[map.voxel_m=0.3]",
        f"random-regions[{','.join(alike)}]",
    ]


def test_score_runs_nothing_and_gives_the_same(smoke_copy: RunFolder, runner: Runner) -> None:
    made = [path for name in ("answers", "stages", "maps") for path in (smoke_copy.path / name).rglob("*")]
    stamps = {path: path.stat().st_mtime_ns for path in made}
    before = table(smoke_copy)
    (smoke_copy.path / "results.csv").unlink()
    assert rescore(smoke_copy) == 8
    # the times too, which no second run would give again
    pd.testing.assert_frame_equal(table(smoke_copy), before)
    assert stamps == {path: path.stat().st_mtime_ns for path in made}
    # and the cells still count as finished
    assert runner.run(smoke_copy.path, load_plan("smoke"))[1] == RunOutcome(0, 8, 0)


def test_score_takes_in_the_answer_of_another_program(smoke_copy: RunFolder) -> None:
    shutil.copytree(smoke_copy.answer(ONE_BOX, 20000, "voxel-diff"), smoke_copy.answer(ONE_BOX, 20000, "theirs"))
    assert rescore(smoke_copy) == 9
    results = table(smoke_copy).set_index(["scenario", "variant"])
    columns = ["region_recall", "object_iou_point", "n_regions"]
    theirs, ours = results.loc[(ONE_BOX, "theirs")], results.loc[(ONE_BOX, "voxel-diff")]
    assert theirs[columns].tolist() == ours[columns].tolist()
    assert (theirs["preset"], theirs["seed"]) == ("theirs", 20000)
    assert table(smoke_copy)["variant"].iloc[-1] == "theirs"


def test_folders_that_are_no_run(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("x")
    with pytest.raises(InputError, match="not empty and not a run folder"):
        start_run_folder(tmp_path)
    with pytest.raises(InputError, match="not a run folder"):
        open_run_folder(tmp_path)
    with pytest.raises(InputError, match="no such run folder"):
        open_run_folder(tmp_path / "absent")
    (tmp_path / "provenance.json").write_text(json.dumps({"tool": "another"}))
    for opener in (start_run_folder, open_run_folder):
        with pytest.raises(InputError, match="not written by tunnelcd"):
            opener(tmp_path)
    (tmp_path / "provenance.json").write_text("{")
    with pytest.raises(InputError, match="damaged"):
        open_run_folder(tmp_path)


def test_the_pipeline_never_sees_truth(pairs: dict[str, Path], tmp_path: Path) -> None:
    """Without its truth, and with the truth of another pair in its place, a session gives the same input."""
    bare = tmp_path / "bare"
    shutil.copytree(pairs[ONE_BOX], bare, ignore=shutil.ignore_patterns("truth"))
    assert not list(bare.rglob("truth"))
    with_truth, without = pipeline_input(pairs[ONE_BOX], "after"), pipeline_input(bare, "after")
    np.testing.assert_array_equal(with_truth.odom_T_sensor, without.odom_T_sensor)
    for index in (0, 17):
        ours, theirs = with_truth.scan(index), without.scan(index)
        for field in ("points_sensor", "odom_T_sensor", "stamps_ns", "pixels"):
            np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field))
    true_poses = np.load(pairs[ONE_BOX] / "after" / "truth" / "poses.npz")["world_T_sensor"]
    assert np.abs(with_truth.odom_T_sensor - true_poses).max() > 0.1
    assert type(with_truth) is type(open_session(bare / "after"))


@pytest.mark.usefixtures("timed_as_usual")
def test_time_is_the_median_of_three_after_a_warm_up() -> None:
    clock = 0.0
    # the middle one of three in each part, whichever call it was
    parts = iter([(0.5, 0.4), (0.3, 0.1), (0.2, 0.5), (0.1, 0.3)])

    def call() -> Done[str]:
        nonlocal clock
        cd, oe = next(parts)
        clock += cd + oe
        return Done("first" if cd == 0.5 else "later", {"t_cd_s": cd, "t_oe_s": oe})

    result = time_parts(call, clock=lambda: clock)
    assert result.value == "first"
    assert result.seconds == {"t_cd_s": 0.2, "t_oe_s": 0.3}
    assert next(parts, None) is None


@pytest.mark.usefixtures("timed_as_usual")
def test_a_long_call_is_timed_once() -> None:
    clock = 0.0
    calls = 0

    def call() -> Done[str]:
        nonlocal clock, calls
        clock += 1.0
        calls += 1
        return Done("", {"t_cd_s": 0.7})

    assert time_parts(call, clock=lambda: clock).seconds == {"t_cd_s": 0.7}
    assert calls == 1


def test_every_row_names_the_code_that_made_its_answer(tmp_path: Path, runner: Runner) -> None:
    def commits() -> list[tuple[str, str]]:
        results = table(run).fillna({"commit": ""})
        return list(zip(results["variant"], results["commit"], strict=True))

    plan = plan_of(tmp_path, variants="{preset: voxel-diff}, {preset: random-regions}")
    run, _ = runner.run(tmp_path / "run", plan, limit=1, tools=replace(runner.tools, commit=lambda: "older+"))
    runner.run(tmp_path / "run", plan, tools=replace(runner.tools, commit=lambda: "newer"))
    assert commits() == [("voxel-diff", "older+"), ("random-regions", "newer")]
    assert "commit" not in set(table(run, "summary")["metric"])
    # scoring again is not answering again, and what another program answered is of no commit of ours
    shutil.copytree(run.answer(ONE_BOX, 20000, "voxel-diff"), run.answer(ONE_BOX, 20000, "theirs"))
    rescore(run)
    assert commits() == [("voxel-diff", "older+"), ("random-regions", "newer"), ("theirs", "")]


def test_scoring_again_changes_nothing_before_all_is_scored(smoke_copy: RunFolder) -> None:
    (smoke_copy.answer(UNCHANGED, 20000, "paper") / "answer.json").write_text("{")
    files = {path: path.stat().st_mtime_ns for path in smoke_copy.path.glob("cells/*/*/*.json")}
    with pytest.raises(InputError, match=r"answer\.json"):
        rescore(smoke_copy)
    assert len(files) == 8
    assert files == {path: path.stat().st_mtime_ns for path in files}


def test_an_oracle_runs_the_stages_of_its_preset(tmp_path: Path, runner: Runner) -> None:
    later = 'set: ["query.n_regions=2", "query.threshold=0"]'
    variants = f"{{preset: tunnelcd, {later}}}, {{preset: tunnelcd, {later}, oracle_merge: {{}}}}"
    run, _ = runner.run(tmp_path / "run", plan_of(tmp_path, variants=variants))
    results = table(run)
    assert results["variant"].str.partition("[")[0].tolist() == ["tunnelcd", "oracle-merge"]
    assert results["status"].tolist() == ["ok", "ok"]
    assert (results["n_regions"] + results["n_withdrawn"]).tolist() == [2, 2]
    assert results["preset"].tolist() == ["tunnelcd", "tunnelcd"]
    times = results.loc[1, ["t_total_with_merge_s", "t_total_s"]]
    assert times["t_total_with_merge_s"] == times["t_total_s"] > 0
    report = read_answer(run.answer(ONE_BOX, 20000, results["variant"][1])).report
    assert report is not None
    assert report.local_before_T_after is not None
    assert len(report.local_before_T_after) == len(report.keyframe_scans[1])


@pytest.mark.parametrize(
    ("scenarios", "variants", "rest"),
    [
        (f"{{name: {ONE_BOX}, pair_kind: drift}}", "{preset: voxel-diff}", ""),
        (ONE_BOX, "{preset: voxel-diff}", "until: merge"),
    ],
)
def test_what_a_plan_says_of_a_cell_redoes_it(
    tmp_path: Path, runner: Runner, scenarios: str, variants: str, rest: str
) -> None:
    runner.run(tmp_path / "run", plan_of(tmp_path, variants="{preset: voxel-diff}"))
    changed = plan_of(tmp_path, scenarios=scenarios, variants=variants, rest=rest)
    assert runner.run(tmp_path / "run", changed)[1] == RunOutcome(1, 0, 0)
    assert runner.run(tmp_path / "run", changed)[1] == RunOutcome(0, 1, 0)
    # the pair itself is the same
    assert runner.families() == [ONE_BOX]


def test_cells_are_made_again_with_another_version_of_an_extra_that_they_may_ask(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def keys(version: str) -> dict[str, str]:
        monkeypatch.setattr(pair_run, "extra_version", lambda name: version)
        found = expand_cells(load_plan("merge"))[:4]
        return {cell.variant: pair_run.cell_key(cell, "clean", None, {}) for cell in found}

    there, missing = keys("1.0"), keys("absent")
    changed = {variant: there[variant] != missing[variant] for variant in there}
    assert changed == {"tunnelcd": True, "frame": False, "kiss-matcher": True, "oracle-merge": False}


@pytest.mark.parametrize(("method", "is_asked"), [("planes", False), ("m3c2", True), ("m3c2-ep", True)])
def test_cells_that_measure_rock_with_an_extra_depend_on_its_version(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str, is_asked: bool
) -> None:
    variants = f"{{preset: c2c, set: [surface.method={method}, merge.fallback=false]}}"
    (cell,) = expand_cells(plan_of(tmp_path, variants=variants))
    keys = set()
    for version in ("1.0", "absent"):
        monkeypatch.setattr(pair_run, "extra_version", lambda name, version=version: version)
        keys.add(pair_run.cell_key(cell, "clean", None, {}))
    assert len(keys) == 1 + is_asked


def test_a_cell_without_truth_gets_the_version_and_one_without_answer_is_told(tmp_path: Path) -> None:
    run = start_run_folder(tmp_path / "run")
    for name, row in (
        ("unmade", {"status": "failed", "n_observable": None}),
        ("unmade-too", {"status": "failed"}),  # as a run writes it
        ("lost", {"status": "ok", "n_observable": 1}),
    ):
        named, items = {"scenario": "w", "seed": 1, "variant": name}, {table: [] for table in ITEM_TABLES}
        document = {
            "key": "k",
            "order": [0, 0],
            "row": {**named, "metrics_version": METRICS_VERSION - 1, **row},
            **items,
        }
        write_json(run.path / "cells" / "w" / "1" / f"{name}.json", document)
    documents: dict[Path, dict[str, Any]] = {}
    assert _list_unscored(run, documents) == ["w/1/lost"]
    made = {path.stem: document["row"]["metrics_version"] for path, document in documents.items()}
    assert made == {"unmade": METRICS_VERSION, "unmade-too": METRICS_VERSION}


@pytest.mark.parametrize(
    ("preset", "make"),
    [("tunnelcd", make_untrained_sphere_network), ("range-net", make_untrained_change_network)],
)
def test_a_cell_and_the_provenance_name_weights_by_what_the_file_holds(
    tmp_path: Path, preset: str, make: Callable[[int], nn.Module]
) -> None:
    name, group = ("sphere", "sphere") if preset == "tunnelcd" else ("range-net", "range_net")

    def keyed(file: str, seed: int) -> tuple[str, Any]:
        (tmp_path / file).write_bytes(numbered_checkpoint_bytes(make(seed)))
        plan = change_plan(load_plan("smoke"), presets=[preset], settings=[f"{group}.weights={tmp_path / file}"])
        cell = expand_cells(plan)[0]
        return pair_run.cell_key(cell, "", None, {}), _provenance(plan, [cell], [], Tools())["checkpoints"]

    (one, used), (moved, _), (other, _) = keyed("a", 1), keyed("b", 1), keyed("a", 2)
    assert one == moved != other
    assert list(used) == ["3deg", f"{name} {tmp_path / 'a'}"] and len(set(used.values())) == 2


def test_tables_that_are_there_are_put_together_again_only_where_something_may_have_changed(
    tmp_path: Path, runner: Runner
) -> None:
    commit: list[str | None] = ["a" * 40]
    times = map(str, count())
    tools = replace(runner.tools, commit=lambda: commit[0], now=lambda: next(times))

    def is_written(plan: Plan) -> bool:
        earlier = results.stat().st_mtime_ns if results.is_file() else 0
        assert runner.run(run.path, plan, tools=tools)[1].n_done == 0
        return results.stat().st_mtime_ns != earlier

    plan = plan_of(tmp_path)
    run, _ = runner.run(tmp_path / "run", plan, tools=tools)
    results, (cell,) = run.path / "results.csv", run.path.glob("cells/*/*/*.json")
    bytes_before = results.read_bytes()
    told = run.provenance()
    assert not is_written(plan)
    assert not is_written(plan)
    assert (results.read_bytes(), run.provenance()) == (bytes_before, told)
    results.unlink()
    assert is_written(plan)
    cell.touch()
    assert is_written(plan)
    shutil.copy(cell, cell.with_name("another.json"))  # of another plan, and not newer
    os.utime(cell.with_name("another.json"), ns=(0, 0))
    assert is_written(plan)
    cell.with_name("another.json").unlink()
    assert is_written(plan)
    assert not is_written(plan)
    assert is_written(plan.model_copy(update={"description": "another"}))
    for other in ("b" * 40, "b" * 40 + "+", "b" * 40 + "+", None, None):
        commit[0] = other
        assert is_written(plan)
    document = run.provenance()
    del document["finished"]
    write_json(run.path / "provenance.json", document)
    commit[0] = "b" * 40
    assert is_written(plan)
    assert not is_written(plan)
