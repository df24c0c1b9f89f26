"""Evaluation: blind pairs, failures that are rows, kept pairs, merges that are given."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.io.known_merge import read_alignment, read_known_merge, write_alignment
from cdpipe.model.alignment import PathAlignment
from eval.core.provenance import machine, versions
from eval.core.terminal.progress import Silent
from eval.leaderboard.calls import evaluation_folder, read_call, read_evaluation, require_an_answer
from eval.leaderboard.evaluation import Method, evaluate_command
from eval.leaderboard.given_merge import write_merge
from eval.leaderboard.packing import pack_submission
from eval.leaderboard.submission import Submission, read_submission
from eval.oracles.merge import OracleMerge, align_by_truth
from eval.running.predictions import add_predictions
from eval.running.rescoring import rescore
from eval.running.scaling.keeping import drop_pair
from eval.running.scaling.remaking import remake_pair
from eval.running.stages.pair_stages import PairStages
from eval.truth.adapters import pipeline_input
from eval.truth.ground_truth import load_ground_truth
from scenarios.library import load_scenario
from scenarios.schema import Scenario
from sim.session.truth import read_pair_truth, write_pair_truth
from tests.eval.leaderboard.conftest import GOOD, TOOLS, Evaluator

ONE_BOX = "smoke/one_box"


def rows_of(evaluator: Evaluator, name: str = "mine") -> pd.DataFrame:
    results = pd.read_csv(evaluator.run.path / "results.csv")
    return results[results["variant"] == name]


def test_a_good_method_is_a_variant_of_the_run(evaluator: Evaluator) -> None:
    outcome = evaluator.evaluate()
    assert (outcome.n_done, outcome.n_kept, outcome.n_failed) == (2, 0, 0)
    rows = rows_of(evaluator)
    assert rows["status"].tolist() == ["ok", "ok"] and rows["seed"].tolist() == [20000, 20000]
    assert rows["scenario"].tolist() == [ONE_BOX, "smoke/unchanged"]
    assert rows["merge_error_m"].max() < 1e-9  # it used the true merge that it was given
    assert rows["region_recall"].tolist() == [0.0, 0.0] and rows["t_cd_s"].tolist() == [0.5, 0.5]
    # it is scored again like every answer
    assert rescore(evaluator.run) == 2
    pd.testing.assert_frame_equal(rows_of(evaluator), rows)


BLIND = """
import os, sys
from pathlib import Path
before, after, out, merge = map(Path, sys.argv[1:5])
assert sorted(os.listdir(before.parent)) == ["after", "before"] and before.parent == after.parent
assert os.listdir() == [] and os.listdir(out) == []
around = sorted(path.name for path in before.parent.parent.rglob("*"))
assert "truth" not in around and not any("smoke" in name for name in around), around
texts = [path.read_bytes() for path in before.parent.rglob("*.json")]
assert texts and not any(b"smoke" in text or b"20000" in text for text in texts)
"""


def test_a_method_sees_blind_sessions_and_an_empty_folder_of_its_own(evaluator: Evaluator) -> None:
    assert evaluator.evaluate(BLIND + GOOD).n_failed == 0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("raise RuntimeError('no idea')", "exit code 1: RuntimeError: no idea"),
        ("import time; time.sleep(30)", "took longer than 1.5 s"),
        ("pass", "left no {out}/answer.json"),
        (GOOD.replace('"radius_m": 2.0', '"radius_m": -1'), "no valid answer: answer.json: radius_m = -1"),
        (GOOD.replace("[[90.0, 0, 0]]", "[[float('nan'), 0, 0]]"), "no valid answer"),
        (GOOD + "\n(out / 'answer.npz').write_bytes(b'PK')", "no valid answer: answer.npz: unreadable"),
        (GOOD + "\nsys.exit(3)", "exit code 3"),
        (GOOD + "\n(out / 'answer.npz').open('r+b').truncate(3 << 30)", "answer.npz: 3221 MB, more than the 2147 MB"),
    ],
)
def test_a_pair_without_an_answer_is_a_row_with_its_error(evaluator: Evaluator, text: str, said: str) -> None:
    outcome = evaluator.evaluate(text, limit_s=1.5 if "sleep" in text else 60.0)
    assert outcome.n_failed == 2
    rows = rows_of(evaluator)
    assert rows["status"].tolist() == ["failed", "failed"]
    assert all(said in error for error in rows["error"])
    assert rows["region_recall"].tolist() == [0.0, 0.0] and rows["object_iou_point"].tolist() == [0.0, 0.0]
    call = read_call(evaluator.run, "mine", ONE_BOX, 20000)
    assert call is not None and said in call.error
    assert str(evaluator.run.path) not in call.error
    assert ("RuntimeError" in call.stderr) == ("RuntimeError" in text)
    with pytest.raises(InputError, match=f"mine: no pair has an answer; {ONE_BOX} 20000: "):
        require_an_answer(evaluator.run, "mine")


def test_a_command_that_fails_on_one_pair_is_no_mistake(evaluator: Evaluator) -> None:
    mark = f"mark = Path({str(evaluator.run.path.parent / 'mark')!r})"
    fails_once = f"import sys\nfrom pathlib import Path\n{mark}\nif not mark.exists(): mark.touch(); sys.exit(1)\n"
    evaluator.evaluate(fails_once + GOOD)
    assert sorted(rows_of(evaluator)["status"]) == ["failed", "ok"]
    require_an_answer(evaluator.run, "mine")


def test_finished_pairs_are_kept_until_something_changes(evaluator: Evaluator) -> None:
    count = f"Path({str(evaluator.run.path.parent / 'calls')!r}).open('a').write('x')\n"
    counting = GOOD + count

    def n_calls() -> int:
        return len((evaluator.run.path.parent / "calls").read_text())

    evaluator.evaluate(counting)
    assert evaluator.evaluate(counting).n_kept == 2 and n_calls() == 2
    evaluator.run.cell(ONE_BOX, 20000, "mine").unlink()  # as an interrupt leaves it
    assert evaluator.evaluate(counting).n_kept == 1 and n_calls() == 3
    pair = evaluator.run.pair(ONE_BOX, 20000)
    truth = read_pair_truth(pair)
    write_pair_truth(pair, replace(truth, score_radius_m=3.5))  # another simulation of the pair
    assert evaluator.evaluate(counting).n_kept == 1 and n_calls() == 4
    with pytest.raises(InputError, match="was changed since its rows were made"):
        evaluator.evaluate(counting + "\n")
    with pytest.raises(InputError, match="--time-limit"):
        evaluator.evaluate(counting, limit_s=5.0)
    assert n_calls() == 4
    assert evaluator.evaluate(counting + "\n", force=True).n_done == 2 and n_calls() == 6


def test_words_that_are_not_utf8_are_refused_before_a_pair_is_asked(evaluator: Evaluator) -> None:
    def simulated(*_: object) -> None:
        raise AssertionError("nothing must be made")

    tools = replace(TOOLS, simulate=simulated)
    with pytest.raises(InputError, match=r"provenance\.json: cannot hold .*x\\udcff.*, which is not UTF-8"):
        evaluator.evaluate(command=("tunnelcd", "x\udcff"), tools=tools)
    method = Method("mine", (sys.executable, "x\udcff", "\U0001f600", "{before}"), "given")
    with pytest.raises(InputError, match=r"evaluation\.json: cannot hold .*x\\udcff.*, which is not UTF-8"):
        evaluate_command(evaluator.plan, evaluator.run, method, command=("tunnelcd", "\U0001f600"), tools=tools)
    assert evaluator.run.provenance()["command"] == "tunnelcd '\U0001f600'"


def test_what_asked_is_told_and_not_what_looked_on_or_packed(evaluator: Evaluator) -> None:
    def evaluate(commit: str, **options: bool) -> list[str | None]:
        evaluator.evaluate(tools=replace(TOOLS, commit=lambda: commit), **options)
        return [each.commit for each in read_evaluation(evaluator.run, "mine").askers]

    def pack() -> Submission:
        file = evaluator.run.path.parent / "x.zip"
        pack_submission(evaluator.run, "mine", file)
        return read_submission(file).content

    assert evaluate("a") == evaluate("b") == ["a"]  # the second asked nothing
    packed = pack()
    assert (packed.commit, packed.machine, packed.versions) == ("a", machine(), versions())
    evaluator.run.cell(ONE_BOX, 20000, "mine").unlink()
    assert evaluate("b") == ["a", "b"]
    assert evaluate("c", force=True) == ["c"]
    path = evaluation_folder(evaluator.run, "mine") / "evaluation.json"
    older = {name: value for name, value in json.loads(path.read_text()).items() if name != "askers"}
    path.write_text(json.dumps(older))
    evaluator.run.cell(ONE_BOX, 20000, "mine").unlink()
    assert evaluate("b") == []  # nothing is known of the other pair
    packed = pack()
    assert (packed.commit, packed.machine, packed.versions) == (None, {}, {})
    path.write_text("{")
    assert evaluate("c", force=True) == ["c"]


def test_an_evaluation_of_two_machines_names_both(evaluator: Evaluator) -> None:
    evaluator.evaluate()
    path = evaluation_folder(evaluator.run, "mine") / "evaluation.json"
    document = json.loads(path.read_text())
    one = document["askers"][0]
    other = {**one, "commit": "b", "machine": {**one["machine"], "cpu": "other"}}
    path.write_text(json.dumps({**document, "askers": [one, other]}))
    pack_submission(evaluator.run, "mine", evaluator.run.path.parent / "x.zip")
    packed = read_submission(evaluator.run.path.parent / "x.zip").content
    assert packed.commit is None and packed.machine["cpu"] == f"{one['machine']['cpu']} and other"
    assert packed.machine["cores"] == one["machine"]["cores"] and packed.versions == one["versions"]


LATER = GOOD.replace('"t_cd_s": 0.5', '"t_cd_s": 0.7')


class Interrupted(Silent):
    """Stops an evaluation before its second pair."""

    def cells(self, name: str, done: int, total: int) -> None:
        if done == 1:
            raise KeyboardInterrupt


def test_after_an_interrupted_force_no_answer_of_the_old_command_is_kept(evaluator: Evaluator) -> None:
    evaluator.evaluate()
    with pytest.raises(KeyboardInterrupt):
        evaluator.evaluate(LATER, force=True, progress=Interrupted())
    assert not [*evaluator.run.path.glob("*.csv")]
    with pytest.raises(InputError, match="lacks 1 of 2 pairs"):
        pack_submission(evaluator.run, "mine", evaluator.run.path.parent / "x.zip")
    outcome = evaluator.evaluate(LATER)
    assert (outcome.n_done, outcome.n_kept) == (1, 1)
    assert rows_of(evaluator)["t_cd_s"].tolist() == [0.7, 0.7]


def test_after_an_interrupted_force_no_earlier_answer_of_the_same_command_is_kept(evaluator: Evaluator) -> None:
    calls = evaluator.run.path.parent / "calls"
    counting = GOOD + f"Path({str(calls)!r}).open('a').write('x')\n"
    evaluator.evaluate(counting)
    with pytest.raises(KeyboardInterrupt):
        evaluator.evaluate(counting, force=True, progress=Interrupted())
    assert not [*evaluator.run.path.glob("*.csv")]
    outcome = evaluator.evaluate(counting)
    assert (outcome.n_done, outcome.n_kept, len(calls.read_text())) == (1, 1, 4)


def test_force_on_a_part_of_the_plan_leaves_no_row_of_the_old_command(evaluator: Evaluator) -> None:
    evaluator.evaluate()
    evaluator.evaluate(name="other")
    whole = evaluator.plan
    evaluator.plan = whole.model_copy(update={"scenarios": whole.scenarios[:1]})
    evaluator.evaluate(LATER, force=True)
    assert rows_of(evaluator)["t_cd_s"].tolist() == [0.7]
    assert not evaluator.run.answer("smoke/unchanged", 20000, "mine").exists()
    assert rows_of(evaluator, "other")["t_cd_s"].tolist() == [0.5, 0.5]
    evaluator.plan = whole
    assert evaluator.evaluate(LATER).n_kept == 1
    assert rows_of(evaluator)["t_cd_s"].tolist() == [0.7, 0.7]
    evaluator.plan = whole.model_copy(update={"scenarios": whole.scenarios[:1]})
    evaluator.evaluate(LATER, force=True)  # the same command: the other pair stays
    assert len(rows_of(evaluator)) == 2


def test_an_answer_that_was_exchanged_is_given_again(evaluator: Evaluator) -> None:
    evaluator.evaluate()
    answer = evaluator.run.answer(ONE_BOX, 20000, "mine") / "answer.json"
    answer.write_text(answer.read_text() + " ")
    assert evaluator.evaluate().n_done == 1
    assert evaluator.evaluate().n_done == 0


def test_a_call_of_another_command_is_neither_kept_nor_packed(evaluator: Evaluator) -> None:
    evaluator.evaluate()
    path = evaluation_folder(evaluator.run, "mine") / "smoke__one_box" / "20000.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "method_digest": "0" * 16}))
    with pytest.raises(InputError, match=r"smoke/one_box 20000 \(of another command\)"):
        pack_submission(evaluator.run, "mine", evaluator.run.path.parent / "x.zip")
    assert evaluator.evaluate().n_kept == 1


def test_names_of_presets_and_of_the_runs_own_variants_are_refused(evaluator: Evaluator) -> None:
    with pytest.raises(InputError, match="a preset or an oracle"):
        evaluator.evaluate(name="tunnelcd")
    assert not (evaluator.run.path / "evaluations").exists()


def test_the_folder_says_what_was_evaluated(evaluator: Evaluator) -> None:
    evaluator.evaluate()
    found = read_evaluation(evaluator.run, "mine")
    assert found.plan == "smoke" and found.merge == "given"
    assert found.pairs == ((ONE_BOX, 20000), ("smoke/unchanged", 20000))
    plan = evaluator.run.provenance()["plan"]
    assert plan["name"] == "smoke" and plan["variants"] == []


def test_failures_are_those_of_the_pairs_that_were_asked(evaluator: Evaluator) -> None:
    def draw(name: str, seed: int, settings: tuple[str, ...] = ()) -> Scenario:
        raise ScenarioError(f"{name} does not fit")

    assert evaluator.evaluate(tools=replace(TOOLS, draw=draw)).n_failed == 2
    evaluator.plan = evaluator.plan.model_copy(update={"scenarios": evaluator.plan.scenarios[1:]})
    assert evaluator.evaluate(tools=replace(TOOLS, draw=draw)).n_failed == 1


def test_the_merge_that_is_given_is_the_true_one_along_the_path(tmp_path: Path, write_tiny_pair: object) -> None:
    pair = write_tiny_pair(stretch=1.05)  # type: ignore[operator] # the odometry of both sessions drifts
    truth = load_ground_truth(pair)
    stages = PairStages(pipeline_input(pair, "before"), pipeline_input(pair, "after"))
    write_merge(tmp_path / "merge.json", "given", stages, truth)
    along = read_alignment(tmp_path / "merge.json")
    # both sessions drive the same way: each scan of the after session stands where its twin of the before one does
    scans = truth.after.judged_scans
    np.testing.assert_allclose(along.anchors_odom, truth.after.odom_T_sensor[scans, :3, 3])
    mapped = along.before_T_after @ truth.after.odom_T_sensor[scans]
    np.testing.assert_allclose(mapped, truth.before.odom_T_sensor[scans], atol=1e-9)
    middle = read_known_merge(tmp_path / "merge.json")
    assert any(np.allclose(middle, each) for each in along.before_T_after)


def test_sessions_that_never_meet_have_no_true_merge(tiny_pair: Path) -> None:
    truth = load_ground_truth(tiny_pair)
    far = truth.after.world_T_sensor.copy()
    far[:, 0, 3] += 100.0
    sessions = truth.before, replace(truth.after, world_T_sensor=far)
    poses = truth.before.odom_T_sensor, truth.after.odom_T_sensor
    scans = truth.before.judged_scans, truth.after.judged_scans
    assert align_by_truth(sessions, poses, scans, OracleMerge(), 7) is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"anchors_odom": [[0.0, 0.0]]}, "must be"),
        ({"anchors_odom": [[0.0, 0.0, float("nan")]]}, "not finite"),
        ({"before_T_after_at_anchors": None}, "before_T_after|len"),
        ({"before_T_after_at_anchors": [np.full((4, 4), 2.0).tolist()]}, "rigid|rotation"),
        ({"anchors_odom": [], "before_T_after_at_anchors": []}, "must be|anchor"),
        ({"anchors_odom": {"a": 1}}, "."),
    ],
)
def test_a_damaged_merge_is_one_line(tmp_path: Path, change: dict[str, object], said: str) -> None:
    path = tmp_path / "merge.json"
    write_alignment(path, np.eye(4), PathAlignment.rigid(np.eye(4)), "truth")
    assert read_alignment(path).is_rigid
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(InputError, match=said) as caught:
        read_alignment(path)
    assert "\n" not in str(caught.value) and str(caught.value).startswith(str(path))


def test_a_pair_that_cannot_be_made_is_a_failed_row_without_scores(evaluator: Evaluator) -> None:
    def draw(name: str, seed: int, settings: tuple[str, ...] = ()) -> Scenario:
        if name == ONE_BOX:
            raise ScenarioError(f"{name} does not fit")
        return load_scenario(name, seed, settings)

    assert evaluator.evaluate(tools=replace(TOOLS, draw=draw)).n_failed == 1
    rows = rows_of(evaluator).set_index("scenario")
    assert rows.loc[ONE_BOX, "error"] == "smoke/one_box does not fit"
    assert np.isnan(rows.loc[ONE_BOX, "region_recall"]) and rows.loc["smoke/unchanged", "region_recall"] == 0.0


def test_a_pair_that_cannot_be_mapped_for_its_merge_is_a_failed_row(
    evaluator: Evaluator, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unmapped(*_: object) -> None:
        raise InputError("revolution 7: no return")

    monkeypatch.setattr("eval.leaderboard.evaluation.write_merge", unmapped)
    assert evaluator.evaluate().n_failed == 2
    rows = rows_of(evaluator)
    assert set(rows["status"]) == {"failed"} and set(rows["error"]) == {"revolution 7: no return"}
    assert rows.set_index("scenario").loc[ONE_BOX, "region_recall"] == 0.0


def test_a_command_and_answers_from_elsewhere_do_not_share_a_name(evaluator: Evaluator, tmp_path: Path) -> None:
    evaluator.evaluate()
    answers = tmp_path / "answers"
    for world in (ONE_BOX, "smoke/unchanged"):
        shutil.copytree(evaluator.run.answer(world, 20000, "mine"), answers / world / "20000")
    with pytest.raises(InputError, match="--as mine: a command was evaluated under this name"):
        add_predictions(evaluator.run, answers, "mine")
    assert add_predictions(evaluator.run, answers, "other") == 2
    with pytest.raises(InputError, match="--as other: 2 answers of this name came from elsewhere"):
        evaluator.evaluate(LATER, name="other")
    assert evaluator.evaluate(LATER, name="other", force=True).n_done == 2
    assert rows_of(evaluator, "other")["t_cd_s"].tolist() == [0.7, 0.7]


def test_failures_that_are_kept_are_told(evaluator: Evaluator) -> None:
    assert evaluator.evaluate("raise SystemExit(1)").n_failed_kept == 0
    outcome = evaluator.evaluate("raise SystemExit(1)")
    assert (outcome.n_done, outcome.n_failed, outcome.n_failed_kept) == (0, 2, 2)


def test_rows_of_an_old_command_stand_in_no_table_after_an_interrupt(evaluator: Evaluator) -> None:
    evaluator.evaluate()
    evaluator.evaluate(name="other")
    (evaluation_folder(evaluator.run, "mine") / "table.csv").write_text("old")
    with pytest.raises(KeyboardInterrupt):
        evaluator.evaluate(LATER, force=True, progress=Interrupted())
    assert len(rows_of(evaluator)) == 0 and len(rows_of(evaluator, "other")) == 2
    assert not (evaluation_folder(evaluator.run, "mine") / "table.csv").exists()


def test_rows_about_another_world_go_with_its_pair(evaluator: Evaluator) -> None:
    evaluator.evaluate(name="old")
    changed = load_scenario(ONE_BOX, 20000).model_copy(update={"description": "another world"})

    def draw(name: str, seed: int, settings: tuple[str, ...] = ()) -> Scenario:
        return changed if name == ONE_BOX else load_scenario(name, seed, settings)

    evaluator.evaluate(tools=replace(TOOLS, draw=draw))
    assert rows_of(evaluator, "old")["scenario"].tolist() == ["smoke/unchanged"]
    assert not evaluator.run.answer(ONE_BOX, 20000, "old").exists()
    assert len(rows_of(evaluator)) == 2


def test_a_pair_whose_scenario_was_edited_is_asked_anew(evaluator: Evaluator) -> None:
    evaluator.evaluate()
    edited = load_scenario(ONE_BOX, 20000).model_copy(update={"description": "another world"})

    def draw(name: str, seed: int, settings: tuple[str, ...] = ()) -> Scenario:
        return edited if name == ONE_BOX else load_scenario(name, seed, settings)

    assert [evaluator.evaluate(tools=replace(TOOLS, draw=draw)).n_done for _ in range(2)] == [1, 0]
    assert read_pair_truth(evaluator.run.pair(ONE_BOX, 20000)).scenario == edited.model_dump(mode="json")
    assert len(rows_of(evaluator)) == 2


def test_a_pair_that_cannot_be_made_any_more_or_can_by_now_is_asked_anew(evaluator: Evaluator) -> None:
    reasons = {ONE_BOX: "does not fit"}

    def draw(name: str, seed: int, settings: tuple[str, ...] = ()) -> Scenario:
        if name in reasons:
            raise ScenarioError(reasons[name])
        return load_scenario(name, seed, settings)

    tools = replace(TOOLS, draw=draw)
    evaluator.evaluate()
    for n_done in (1, 0):
        outcome = evaluator.evaluate(tools=tools)
        assert (outcome.n_done, outcome.n_failed) == (n_done, 1)
    reasons[ONE_BOX] = "is too small"
    assert evaluator.evaluate(tools=tools).n_done == 1
    assert rows_of(evaluator).set_index("scenario").loc[ONE_BOX, "error"] == "is too small"
    reasons.clear()
    outcome = evaluator.evaluate(tools=tools)
    assert (outcome.n_done, outcome.n_failed) == (1, 0)


def test_a_world_that_cannot_be_built_is_tried_again_by_other_code_alone(evaluator: Evaluator) -> None:
    asked = []

    def simulate(scenario: Scenario, *_: object) -> None:
        asked.append(scenario)
        raise ScenarioError("props stand in each other")

    tools = replace(TOOLS, simulate=simulate, commit=lambda: "1" * 40)
    assert [evaluator.evaluate(tools=tools).n_done for _ in range(2)] == [2, 0]
    assert len(asked) == 2 and rows_of(evaluator)["error"].tolist() == ["props stand in each other"] * 2
    assert evaluator.evaluate(tools=tools, force=True).n_done == 2
    assert evaluator.evaluate(tools=replace(TOOLS, commit=lambda: "2" * 40)).n_failed == 0


def test_pairs_whose_sessions_were_removed_are_not_asked_again(evaluator: Evaluator) -> None:
    evaluator.evaluate()
    drop_pair(evaluator.run, ONE_BOX, 20000, "answers")
    assert evaluator.evaluate().n_kept == 2
    assert not evaluator.run.pair(ONE_BOX, 20000).exists()


@pytest.mark.parametrize("remade", [False, True])
def test_a_world_that_changed_after_its_sessions_were_removed_is_answered(evaluator: Evaluator, remade: bool) -> None:
    evaluator.evaluate(name="old")
    drop_pair(evaluator.run, ONE_BOX, 20000, "answers")
    if remade:  # the record stays beside the sessions
        remake_pair(evaluator.run, ONE_BOX, 20000, tools=TOOLS)
    changed = load_scenario(ONE_BOX, 20000).model_copy(update={"description": "another world"})

    def draw(name: str, seed: int, settings: tuple[str, ...] = ()) -> Scenario:
        return changed if name == ONE_BOX else load_scenario(name, seed, settings)

    assert evaluator.evaluate(tools=replace(TOOLS, draw=draw)).n_done == 2
    assert read_pair_truth(evaluator.run.pair(ONE_BOX, 20000)).scenario == changed.model_dump(mode="json")
    assert len(rows_of(evaluator)) == 2 and rows_of(evaluator, "old")["scenario"].tolist() == ["smoke/unchanged"]


def test_answers_of_others_outlive_a_damaged_pair_and_a_world_that_cannot_be_drawn(evaluator: Evaluator) -> None:
    def draw(name: str, seed: int, settings: tuple[str, ...] = ()) -> Scenario:
        raise ScenarioError(f"{name} does not fit")

    evaluator.evaluate(name="old")
    (evaluator.run.pair(ONE_BOX, 20000) / "truth" / "changes.json").write_text("{")
    evaluator.evaluate()
    assert len(rows_of(evaluator, "old")) == 2 == len(rows_of(evaluator))
    evaluator.evaluate(name="new", tools=replace(TOOLS, draw=draw))
    assert len(rows_of(evaluator, "old")) == 2 and rows_of(evaluator, "new")["status"].tolist() == ["failed"] * 2
