import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from cdpipe.core.errors import ScenarioError
from cdpipe.sensor.ouster import load_profile
from eval.cli.printed_results import print_summary
from eval.core.output import remove
from eval.core.terminal.progress import Silent
from eval.report.page import write_page
from eval.running.rescoring import rescore
from eval.running.runfolder import write_tables
from eval.running.runner import RunOutcome
from scenarios.schema import Scenario
from sim.session.truth import read_pair_truth
from tests.eval.running.runs import ONE_BOX, Runner, load_small, plan_of, table

WORLDS = f"{ONE_BOX}, {{name: {ONE_BOX}, set: [sensor.range_noise=false], each: [sensor.sub_rays=7]}}"
QUIET = f"{ONE_BOX}[sensor.range_noise=false]"
BLURRED = f"{ONE_BOX}[sensor.range_noise=false][sensor.sub_rays=7]"


def test_worlds_are_simulated_with_their_settings_and_named_by_them(tmp_path: Path, runner: Runner) -> None:
    run, outcome = runner.run(tmp_path / "run", plan_of(tmp_path, scenarios=WORLDS))
    assert outcome == RunOutcome(3, 0, 0)
    sensors = [scenario.sensor for scenario in runner.asked]
    assert [(each.range_noise, each.sub_rays) for each in sensors] == [(True, 1), (False, 1), (False, 7)]
    results = table(run)
    assert results["scenario"].tolist() == [ONE_BOX, QUIET, BLURRED]
    assert set(results["family"]) == {ONE_BOX}
    assert list(run.provenance()["config_digests"]) == [f"{world} voxel-diff" for world in (ONE_BOX, QUIET, BLURRED)]
    assert sorted(path.name for path in (run.path / "pairs").iterdir()) == [
        "smoke__one_box",
        "smoke__one_box_sensor.range_noise=false_",
        "smoke__one_box_sensor.range_noise=false__sensor.sub_rays=7_",
    ]
    # the stand-in gives every world the same returns
    effects = table(run, "effects")
    assert set(effects["settings"]) == {"sensor.range_noise=false", "sensor.sub_rays=7"}
    assert effects.groupby("settings")["reference"].unique().map(list).tolist() == [[ONE_BOX], [QUIET]]
    assert (effects["difference"].dropna() == 0).all()
    assert set(effects.query("metric == 'region_recall'")["n"]) == {1}


def test_effects_that_are_no_more_leave_no_table(tmp_path: Path, runner: Runner) -> None:
    run, _ = runner.run(tmp_path / "run", plan_of(tmp_path, scenarios=WORLDS))
    assert (run.path / "effects.csv").exists()
    for world in (QUIET, BLURRED):
        remove(run.cell(world, 20000, "voxel-diff"))
    write_tables(run)
    assert not (run.path / "effects.csv").exists()


def test_scoring_again_names_worlds_as_running_does(tmp_path: Path, runner: Runner) -> None:
    labels: list[str] = []

    class Heard(Silent):
        def cells(self, label: str, done: int, total: int) -> None:
            labels.append(label)

    run, _ = runner.run(tmp_path / "run", plan_of(tmp_path, scenarios=WORLDS))
    shutil.copytree(run.answer(QUIET, 20000, "voxel-diff"), run.answer(QUIET, 20000, "foreign"))
    rescore(run, Heard())
    named = [f"{world} 20000 voxel-diff" for world in (ONE_BOX, QUIET, BLURRED)]
    assert sorted(labels) == sorted([*named, f"{QUIET} 20000 foreign", "done"])


def test_the_pair_of_a_world_is_kept_while_its_scenario_is_the_same(tmp_path: Path, runner: Runner) -> None:
    plan = plan_of(tmp_path, scenarios=WORLDS)
    run, _ = runner.run(tmp_path / "run", plan)
    assert runner.run(tmp_path / "run", plan)[1] == RunOutcome(0, 3, 0)
    run.cell(QUIET, 20000, "voxel-diff").unlink()
    assert runner.run(tmp_path / "run", plan)[1] == RunOutcome(1, 2, 0)
    assert len(runner.asked) == 3
    # the same label, but the scenario behind it has changed
    changed = replace(
        runner.tools, draw=lambda name, seed, settings: load_small(name, seed, [*settings, "score_radius_m=5"])
    )
    run.cell(ONE_BOX, 20000, "voxel-diff").unlink()
    assert runner.run(tmp_path / "run", plan, tools=changed)[1] == RunOutcome(3, 0, 0)
    assert len(runner.asked) == 6


def test_a_pair_is_made_again_when_a_file_that_its_scenario_names_has_changed(tmp_path: Path, runner: Runner) -> None:
    profile = tmp_path / "sensor.json"
    profile.write_text(json.dumps(load_profile("os1-32-u0").to_json()))
    scenario = tmp_path / "mine.yaml"
    scenario.write_text(f"extends: {ONE_BOX}\nfamily: {ONE_BOX}\nsensor: {{profile: sensor.json}}\n")
    plan = plan_of(tmp_path, scenarios=str(scenario))
    run, _ = runner.run(tmp_path / "run", plan)
    content = profile.read_bytes()
    truth = read_pair_truth(run.pair(str(scenario), 20000))
    assert list(truth.files.values()) == [hashlib.sha256(content).hexdigest()]
    assert [Path(name).resolve() for name in truth.files] == [profile.resolve()]
    # touched, or moved away and back: nothing is redone
    profile.unlink()
    profile.write_bytes(content)
    assert runner.run(tmp_path / "run", plan)[1] == RunOutcome(0, 1, 0)
    profile.write_bytes(content + b"\n")
    assert runner.run(tmp_path / "run", plan)[1] == RunOutcome(1, 0, 0)
    assert len(runner.asked) == 2
    # and a pair of before is not taken for one of now when only its cell is lost
    profile.write_bytes(content)
    run.cell(str(scenario), 20000, "voxel-diff").unlink()
    assert runner.run(tmp_path / "run", plan)[1] == RunOutcome(1, 0, 0)
    assert len(runner.asked) == 3


def test_a_family_of_ones_own_is_the_same_world_from_every_folder(
    tmp_path: Path, runner: Runner, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, elsewhere = tmp_path / "own" / "families", tmp_path / "elsewhere"
    own.mkdir(parents=True)
    elsewhere.mkdir()
    (own / "sensor.json").write_text(json.dumps(load_profile("os1-32-u0").to_json()))
    (own / "mine.yaml").write_text(f"extends: {ONE_BOX}\nfamily: {ONE_BOX}\nsensor: {{profile: sensor.json}}\n")
    monkeypatch.setenv("TUNNELCD_PATH", str(tmp_path / "own"))
    for folder, outcome in ((tmp_path / "own", RunOutcome(1, 0, 0)), (elsewhere, RunOutcome(0, 1, 0))):
        monkeypatch.chdir(folder)
        assert runner.run(tmp_path / "run", plan_of(tmp_path, scenarios="mine"))[1] == outcome
    # with another file it is another world
    (own / "sensor.json").write_text((own / "sensor.json").read_text() + "\n")
    assert runner.run(tmp_path / "run", plan_of(tmp_path, scenarios="mine"))[1] == RunOutcome(1, 0, 0)
    assert len(runner.asked) == 2


def test_a_world_with_settings_that_cannot_be_made_keeps_its_family_and_is_told(
    tmp_path: Path, runner: Runner, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails_with_settings(name: str, seed: int, settings: tuple[str, ...]) -> Scenario:
        if settings:
            raise ScenarioError("props stand in each other")
        return load_small(name, seed)

    tools = replace(runner.tools, draw=fails_with_settings)
    run, _ = runner.run(tmp_path / "run", plan_of(tmp_path, scenarios=WORLDS), tools=tools)
    results = table(run)
    assert results["status"].tolist() == ["ok", "failed", "failed"]
    assert set(results["family"]) == {ONE_BOX}
    assert table(run, "effects").query("metric == 'region_recall'")["n"].tolist() == [0, 0]
    print_summary(run.path)
    out = " ".join(capsys.readouterr().out.split())
    assert "note: 2 of 3 pairs could not be made and are in no mean: smoke/one_box[" in out
    assert "20000: props stand in each other" in out
    page = " ".join(write_page(run.path, "none").read_text().split())
    assert "3 session pairs, 1 variant, 2 pairs could not be made and are in no mean" in page.replace(";", ",")


def test_an_answer_beside_those_of_a_world_gets_the_name_of_the_world(tmp_path: Path, runner: Runner) -> None:
    run, _ = runner.run(tmp_path / "run", plan_of(tmp_path, scenarios=WORLDS))
    shutil.copytree(run.answer(QUIET, 20000, "voxel-diff"), run.answer(QUIET, 20000, "theirs"))
    assert rescore(run) == 4
    theirs = table(run).query("variant == 'theirs'")
    assert theirs["scenario"].tolist() == [QUIET]
    # where the run has no cell of the pair left, the folder's name has to do
    remove(run.path / "cells")
    rescore(run)
    assert "smoke/one_box_sensor.range_noise=false_" in set(table(run)["scenario"])
