"""Predictions of other programs: the documented script, a whole run of them, and every way to be wrong."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import transform
from eval.running.predictions import evaluate
from eval.running.runfolder import RunFolder, write_json
from eval.scoring import answer_check
from eval.scoring.scoring import METRICS_VERSION
from eval.truth.ground_truth import load_ground_truth

Command = Callable[..., tuple[int, str, str]]
ROOT = Path(__file__).parents[3]
SEEDS = (3, 4)


def arrays_of(pair: Path, merge: np.ndarray) -> dict[str, Any]:
    """The truth about the after session's changes, as a foreign program writes it: nothing that may be left out."""
    truth = load_ground_truth(pair)
    scoring_points = truth.after.scoring_points
    rows = [scoring_points.rows_of_change(change.id) for change in truth.pair.changes if change.session == "after"]
    points = [scoring_points.points_odom[own].astype(np.float64) for own in rows]
    return {
        "region_centres_map": transform(merge, np.array([cloud.mean(axis=0) for cloud in points])),
        "region_scores": np.arange(len(rows), 0.0, -1.0),
        "object_points_odom": np.concatenate(points),
        "object_point_odom_offsets": np.cumsum([0, *map(len, points)]),
    }


def document_of(n_objects: int, merge: np.ndarray) -> dict[str, Any]:
    return {
        "format": "tunnelcd-answer", "format_version": 1, "status": "ok", "method": "theirs",
        "before_T_after": merge.tolist(), "radius_m": 2.0, "seconds": {"t_merge_s": 0.5, "t_cd_s": 0.25},
        "objects": [{"session": "after", "kind": "added"}] * n_objects,
    }  # fmt: skip


def write_prediction(folder: Path, document: dict[str, Any], arrays: dict[str, Any]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "answer.json").write_text(json.dumps(document))
    np.savez(folder / "answer.npz", **arrays)
    return folder


@pytest.fixture
def good(tiny_pair: Path, tiny_merge: np.ndarray) -> tuple[dict[str, Any], dict[str, Any]]:
    arrays = arrays_of(tiny_pair, tiny_merge)
    return document_of(len(arrays["region_scores"]), tiny_merge), arrays


@pytest.fixture
def run(tmp_path: Path, tiny_pair: Path) -> RunFolder:
    """Two pairs that are one and the same, and one cell that a run made of each."""
    folder = RunFolder(tmp_path / "run")
    write_json(folder.path / "provenance.json", {"tool": "tunnelcd", "plan": {"name": "by hand"}})
    for seed in SEEDS:
        shutil.copytree(tiny_pair, folder.pair("tiny/pair", seed))
        names = {"scenario": "tiny/pair", "family": "tiny/pair", "seed": seed, "variant": "ours", "status": "ok"}
        row = {**names, "preset": "ours", "pair_kind": "clean", "n_observable": 3, "region_recall": 0.5}
        row["metrics_version"] = METRICS_VERSION
        cell = {
            "key": "made",
            "order": [7, 0],
            "row": row,
            "changes": [],
            "regions": [],
            "objects": [],
            "keyframes": [],
        }
        write_json(folder.cell("tiny/pair", seed, "ours"), cell)
    return folder


def test_the_documented_script_finds_the_box(tmp_path: Path, command: Command) -> None:
    text = (ROOT / "eval" / "scoring" / "ANSWERS.md").read_text()
    script = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert script is not None
    (tmp_path / "predict.py").write_text(script[1])
    command("simulate", "smoke/one_box", "--seed", 10600, "--out", tmp_path / "pairs" / "one", "--quiet")
    argv = [tmp_path / "pairs", tmp_path / "mine"]
    subprocess.run(
        [sys.executable, tmp_path / "predict.py", *argv], cwd=ROOT, env={"PYTHONPATH": str(ROOT)}, check=True
    )
    code, out, _ = command("score", tmp_path / "pairs" / "one", tmp_path / "mine" / "one")
    assert len(out.splitlines()) <= 25 and "more figures: --wide" in out
    row = dict(line.split(None, 1) for line in out.splitlines() if len(line.split()) > 1)
    assert code == 0
    assert [float(row[name]) for name in ("region_recall", "region_precision", "object_f1_50")] == [1, 1, 1]
    assert row["t_merge_s"] != "-" and row["t_total_s"] != "-"


def test_a_run_takes_predictions_in_as_a_variant(
    tmp_path: Path, run: RunFolder, command: Command, good: tuple[dict[str, Any], dict[str, Any]]
) -> None:
    document, arrays = good
    mine = tmp_path / "mine"
    write_prediction(mine / "tiny/pair/3", document, arrays)  # as the scenario is called
    failed = {name: document[name] for name in ("format", "format_version", "method")} | {"status": "failed"}
    (mine / "tiny__pair/4").mkdir(parents=True)  # and as the run calls its folder
    (mine / "tiny__pair/4/answer.json").write_text(json.dumps(failed))
    code, out, _ = command("score", run.path, "--predictions", mine, "--as", "their method")
    assert code == 0 and "2 predictions" in out
    results = pd.read_csv(run.path / "results.csv")
    assert results["variant"].tolist() == ["ours", "ours", "their method", "their method"]
    assert results["seed"].tolist() == [3, 4, 3, 4]
    theirs = results[results["variant"] == "their method"]
    assert theirs["status"].tolist() == ["ok", "failed"] and theirs["pair_kind"].tolist() == ["clean"] * 2
    # the two changes of the after session, whole, of the three that count; nothing of the failed pair
    n_after, n_all = len(arrays["region_scores"]), int(theirs["n_observable"].iloc[0])
    assert theirs["region_recall"].tolist() == [n_after / n_all, 0.0]
    assert theirs["object_iou_point"].tolist() == pytest.approx([n_after / n_all, 0.0])
    # they are answers of the run now: they can be scored again, and written over
    for argv in (("score", run.path, "-q"), ("score", run.path, "--predictions", mine, "--as", "their method", "-q")):
        assert command(*argv)[0] == 0
        pd.testing.assert_frame_equal(pd.read_csv(run.path / "results.csv"), results)


def test_two_predictions_for_one_pair_are_refused(
    tmp_path: Path, run: RunFolder, command: Command, good: tuple[dict[str, Any], dict[str, Any]]
) -> None:
    for folder in ("tiny/pair/3", "tiny__pair/3", "tiny/pair/4"):
        write_prediction(tmp_path / "mine" / folder, *good)
    code, _, err = command("score", run.path, "--predictions", tmp_path / "mine", "--as", "theirs")
    assert code == 2 and err.count("\n") == 1
    assert "tiny/pair/3 and " in err and "tiny__pair/3: " in err


def test_rows_of_other_metrics_are_scored_again_first(
    tmp_path: Path, run: RunFolder, command: Command, good: tuple[dict[str, Any], dict[str, Any]]
) -> None:
    for seed in SEEDS:
        write_prediction(tmp_path / f"mine/tiny/pair/{seed}", *good)
    path = run.cell("tiny/pair", 3, "ours")
    cell = run.read_cell(path)
    assert cell is not None
    cell["row"]["metrics_version"] = METRICS_VERSION - 1
    write_json(path, cell)
    code, _, err = command("score", run.path, "--predictions", tmp_path / "mine", "--as", "theirs")
    assert (
        code == 2
        and f"has rows of metrics version {METRICS_VERSION - 1}, but predictions are scored by {METRICS_VERSION}" in err
    )
    assert not run.cell("tiny/pair", 3, "theirs").exists()


def test_missing_cases_strangers_and_mistakes_are_named_together_and_nothing_is_written(
    tmp_path: Path, run: RunFolder, command: Command, good: tuple[dict[str, Any], dict[str, Any]]
) -> None:
    document, arrays = good
    mine = tmp_path / "mine"
    write_prediction(mine / "tiny/pair/3", document, arrays)
    write_prediction(mine / "tiny/pear/4", document, arrays)
    code, _, err = command("score", run.path, "--predictions", mine, "--as", "theirs")
    assert code == 2 and err.splitlines() == [
        f'error: {mine}/tiny/pear/4: the run has no such pair; did you mean "tiny/pair/4"?',
        f"error: {mine}: no prediction for tiny/pair/4 of {run.path}: write {mine}/tiny/pair/4/answer.json, of status "
        '"failed" where there is no answer',
    ]
    (mine / "tiny/pear").rename(mine / "tiny/rest")
    shutil.move(mine / "tiny/rest/4", mine / "tiny/pair/4")
    for seed in SEEDS:
        write_prediction(
            mine / f"tiny/pair/{seed}", document, {**arrays, "region_scores": arrays["region_scores"] * np.nan}
        )
    code, _, err = command("score", run.path, "--predictions", mine, "--as", "theirs", "-q")
    told = "not an answer to this pair: region_scores: entry 0 is not a finite number"
    assert code == 2 and err.splitlines() == [f"error: {mine}/tiny/pair/{seed}: {told}" for seed in SEEDS]
    assert sorted(file.name for file in run.path.glob("*")) == ["cells", "pairs", "provenance.json"]
    assert {file.stem for file in run.path.glob("cells/*/*/*")} == {"ours"}


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (("--predictions", "mine"), "give both, or neither"),
        (("--as", "theirs"), "give both, or neither"),
        (("--predictions", "mine", "--as", "ours"), "--as ours: "),
        (
            ("--predictions", "mine", "--as", "tunnelcd"),
            "--as tunnelcd: ",
        ),
        (("--predictions", "mine", "--as", "paper[x=1]"), "a preset or an oracle of tunnelcd is called so"),
        (("--predictions", "mine", "--as", "oracle-merge"), "a preset or an oracle of tunnelcd is called so"),
        (("--predictions", "mine", "--as", "."), "--as '.': expected a name"),
        (("--predictions", "absent", "--as", "theirs"), "absent/<scenario>/<seed>/"),
        (("answer", "--predictions", "mine", "--as", "theirs"), "goes with a run folder alone"),
    ],
)
def test_what_cannot_be_asked(
    tmp_path: Path,
    run: RunFolder,
    command: Command,
    good: tuple[dict[str, Any], dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
    argv: tuple[str, ...],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    for seed in SEEDS:
        write_prediction(Path(f"mine/tiny/pair/{seed}"), *good)
    code, out, err = command("score", run.path, *argv)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1 and words in err


def test_an_answer_that_was_put_there_for_some_pairs_only_is_told(
    run: RunFolder, command: Command, good: tuple[dict[str, Any], dict[str, Any]]
) -> None:
    plan = {"name": "by hand", "scenarios": ["smoke/one_box"], "seeds": [3], "variants": [{"preset": "paper"}]}
    write_json(run.path / "provenance.json", {"tool": "tunnelcd", "plan": plan})
    write_prediction(run.answer("tiny/pair", 3, "theirs"), *good)
    code, out, _ = command("score", run.path)
    assert code == 0
    assert "note: theirs has no answer for tiny/pair 4: its means are over the other 1 pairs" in out
    assert "note: ours" not in out


def without(*names: str) -> Callable[[dict[str, Any]], None]:
    def change(parts: dict[str, Any]) -> None:
        for name in names:
            del parts[name]

    return change


def renamed(old: str, new: str) -> Callable[[dict[str, Any]], None]:
    return lambda parts: parts.update({new: parts.pop(old)})


def shifted(parts: dict[str, Any]) -> None:
    parts["object_points_odom"] = parts["object_points_odom"] + 50.0


@pytest.mark.parametrize(
    ("of_document", "change", "words"),
    [
        (True, without("radius_m"), "answer.json: radius_m: "),
        (True, without("status"), "answer.json: status: "),
        (True, renamed("objects", "object"), 'unknown key; did you mean "objects"?'),
        (True, lambda d: d.update(status="OK"), "status = 'OK': "),
        (True, lambda d: d.update(format_version=2), "answer.json: format_version = 2: "),
        (True, lambda d: d.update(seconds={"t_cd": 1.0}), 'seconds.t_cd is unknown; did you mean "t_cd_s"?'),
        (True, lambda d: d.update(seconds={"t_cd_s": -1.0}), "seconds.t_cd_s = -1.0: "),
        (True, lambda d: d.update(seconds={"t_cd_s": float("nan")}), "seconds.t_cd_s = nan: "),
        (True, lambda d: d["objects"][0].pop("kind"), "objects.0.kind: "),
        (True, lambda d: d.update(objects=d["objects"][:1]), "object_point_odom_offsets has 3 entries"),
        (True, lambda d: d.update(radius_m="4.5"), "answer.json: radius_m = '4.5': "),
        (True, lambda d: d.update(radius_m=None), "answer.json: radius_m = None: "),
        (True, lambda d: d.update(radius_m=float("inf")), "radius_m = inf: expected a length"),
        (True, lambda d: d.update(method="m" * 1001), "answer.json: method"),
        (True, lambda d: d.update(evidence={f"e{k}": 1.0 for k in range(1001)}), "answer.json: evidence"),
        (True, lambda d: d.update(checkpoints={"sphere": "0" * 5_000_000}), "answer.json: checkpoints.sphere"),
        (True, lambda d: d.update(seconds=None), "answer.json: seconds = None: "),
        (True, lambda d: d.update(evidence=[1.0]), "answer.json: evidence = [1.0]: "),
        (
            True,
            lambda d: d["objects"][0].update(partner="1"),
            "objects.0.partner = '1': ",
        ),
        (True, lambda d: d["objects"][0].update(partner=0), "objects[0].partner = 0: "),
        (
            True,
            lambda d: d["objects"][0].update(score="high"),
            "objects.0.score = 'high': ",
        ),
        (
            False,
            lambda a: a.update(keyframe_scores=np.array(["a"])),
            "array keyframe_scores: ",
        ),
        (False, lambda a: a.update(keyframe_scores=np.array([np.inf])), "keyframe_scores: "),
        (False, lambda a: a.update(region_is_withdrawn=np.zeros(2)), "region_is_withdrawn: "),
        (False, lambda a: a.update(region_is_forced=np.zeros(2)), "region_is_forced: "),
        (False, lambda a: a.update(region_is_reported=np.ones(2, int)), "region_is_reported: "),
        (False, lambda a: a.update(before_keyframe_scans=np.array([3, 3])), "before_keyframe_scans "),
        (False, lambda a: a.update(region_centres_map=np.zeros(3)), "region_centres_map "),
        (True, lambda d: d.update(objects=["box"]), "objects.0 = 'box': "),
        (False, without("region_scores"), "answer.npz: array region_scores "),
        (
            False,
            renamed("region_scores", "region_score"),
            "answer.npz: array region_score ",
        ),
        (
            False,
            without("object_points_odom", "object_point_odom_offsets"),
            "object_points_odom ",
        ),
        (False, without("object_point_odom_offsets"), "array object_point_odom_offsets "),
        (False, lambda a: a["object_point_odom_offsets"].put(-1, 2), "object_point_odom_offsets "),
        (False, lambda a: a.update(region_scores=a["region_scores"][::-1]), "scores must fall: best candidate first"),
        (False, lambda a: a.update(region_scores=a["region_scores"][:1]), "must be (1, 3), got (2, 3)"),
        (False, shifted, "object_points_odom of the after session: none of its"),
    ],
)
def test_every_mistake_is_one_line_with_its_file(
    tiny_pair: Path,
    command: Command,
    good: tuple[dict[str, Any], dict[str, Any]],
    of_document: bool,
    change: Callable[[dict[str, Any]], object],
    words: str,
) -> None:
    document, arrays = good
    change(document if of_document else arrays)
    folder = write_prediction(tiny_pair.parent / "theirs", document, arrays)
    code, out, err = command("score", tiny_pair, folder)
    assert (code, out) == (2, "") and words in err and len(err) < 2000
    assert all(line.startswith(f"error: {folder}") for line in err.splitlines())


@pytest.mark.parametrize(("many", "code"), [(14, 2), (15, 0)])
def test_returns_where_nothing_returned_are_refused(
    tiny_pair: Path,
    command: Command,
    good: tuple[dict[str, Any], dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
    many: int,
    code: int,
) -> None:
    document, arrays = good
    arrays = {name: value for name, value in arrays.items() if name.startswith("region")}
    arrays["object_returns"] = np.column_stack([np.arange(14), np.zeros(14, dtype=np.int64)])  # each scan's only miss
    arrays["object_return_offsets"] = np.array([0, 14, 14])
    # fewer of them could by chance be second returns of their cells
    monkeypatch.setattr(answer_check, "_MANY", many)
    folder = write_prediction(tiny_pair.parent / "theirs", document, arrays)
    found, _, err = command("score", tiny_pair, folder)
    assert found == code
    assert ("nothing returned at any of their 14 (scan, pixel)" in err) == (code == 2)


def test_an_answer_to_another_pair_is_named(
    tiny_pair: Path, command: Command, good: tuple[dict[str, Any], dict[str, Any]]
) -> None:
    document, arrays = good
    scoring_points = load_ground_truth(tiny_pair).before.scoring_points
    rows = np.arange(200)
    own = scoring_points.points_odom[rows].astype(np.float64)
    returns = np.column_stack([scoring_points.scans(rows), scoring_points.pixels(rows)])
    whole = {name: value for name, value in arrays.items() if name.startswith("region")} | {
        "object_returns": returns,
        "object_return_offsets": np.array([0, 200]),
        "object_point_offsets": np.array([0, 200]),
    }
    document["objects"] = [{"session": "before", "kind": "removed"}]
    for shift_m, expected in ((0.0, 0), (0.2, 0), (-1000.0, 2), (40.0, 2)):
        folder = tiny_pair.parent / f"theirs-{shift_m:g}"
        write_prediction(folder, document, {**whole, "object_points_map": own + shift_m})
        code, _, err = command("score", tiny_pair, folder)
        assert code == expected, err
    assert err.count("\n") == 1 and "or to the sessions the other way round?" in err
    assert "1 of 1 objects do not lie where object_returns says: objects[0] is " in err


@pytest.mark.parametrize("other", ["my_method", "MY method"])
def test_a_name_that_would_take_the_folder_of_another_is_refused(
    tmp_path: Path, run: RunFolder, command: Command, good: tuple[dict[str, Any], dict[str, Any]], other: str
) -> None:
    for seed in SEEDS:
        write_prediction(tmp_path / f"mine/tiny/pair/{seed}", *good)
    given = ("score", run.path, "--predictions", tmp_path / "mine", "--quiet", "--as")
    assert command(*given, "my method")[0] == 0
    stored = {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()}
    code, _, err = command(*given, other)
    assert code == 2 and err == f"error: --as {other}: would take the folder of the variant my method: choose another\n"
    assert {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()} == stored


@pytest.mark.parametrize("name", ["..", "Paper", "oracle-mine", "a\x1b[2Jb", "n" * 201])
def test_what_no_method_may_be_called(
    tmp_path: Path, run: RunFolder, command: Command, good: tuple[dict[str, Any], dict[str, Any]], name: str
) -> None:
    for seed in SEEDS:
        write_prediction(tmp_path / f"mine/tiny/pair/{seed}", *good)
    code, _, err = command("score", run.path, "--predictions", tmp_path / "mine", "--as", name)
    assert code == 2 and err.startswith("error: --as ") and err.count("\n") == 1 and "\x1b" not in err


def test_an_answer_of_too_many_regions_is_refused_and_loses_no_row(
    tmp_path: Path, run: RunFolder, command: Command, good: tuple[dict[str, Any], dict[str, Any]]
) -> None:
    document, arrays = good
    many = 60_000
    centres = np.repeat(arrays["region_centres_map"][:1], many, axis=0)
    answers = [arrays, {**arrays, "region_centres_map": centres, "region_scores": np.zeros(many)}]
    for seed, each in zip(SEEDS, answers, strict=True):
        write_prediction(tmp_path / f"mine/tiny/pair/{seed}", document, each)
    code, _, err = command("score", run.path, "--predictions", tmp_path / "mine", "--as", "many", "--quiet")
    assert code == 2 and err.count("\n") == 1 and "tiny/pair 4 many: " in err and "60000 regions" in err
    assert not (run.path / "answers").exists() and not (run.path / "results.csv").exists()
    assert [path.stem for path in run.path.glob("cells/*/*/*")] == ["ours", "ours"]
    # nor by the way of the answers of a run
    write_prediction(run.answer("tiny/pair", SEEDS[1], "many"), document, answers[1])
    code, _, err = command("score", run.path, "--quiet")
    assert code == 2 and "60000 regions" in err and not (run.path / "results.csv").exists()


@pytest.mark.parametrize("name", ["NA", "1e5", "evil\x1b[31m"])
def test_an_answer_that_was_put_into_the_run_has_a_name_that_tables_hold(
    run: RunFolder, command: Command, good: tuple[dict[str, Any], dict[str, Any]], name: str
) -> None:
    write_prediction(run.path / "answers/tiny__pair" / str(SEEDS[0]) / name, *good)
    code, _, err = command("score", run.path, "--quiet")
    assert code == 2 and err.count("\n") == 1 and "expected" in err and "\x1b" not in err


def test_an_answer_that_was_never_scored_is_not_replaced(
    tmp_path: Path, run: RunFolder, command: Command, good: tuple[dict[str, Any], dict[str, Any]]
) -> None:
    for seed in SEEDS:
        write_prediction(tmp_path / f"mine/tiny/pair/{seed}", *good)
    answer = run.answer("tiny/pair", SEEDS[0], "theirs")
    write_prediction(answer, {**good[0], "method": "of somebody else"}, good[1])
    argv = ("score", run.path, "--predictions", tmp_path / "mine", "--as", "theirs")
    code, _, err = command(*argv)
    assert code == 2 and "holds an answer that is not scored: `tunnelcd score" in err
    assert "somebody else" in (answer / "answer.json").read_text()
    # an interrupt leaves the same answer without a cell: the same command goes on
    for name in ("answer.json", "answer.npz"):
        shutil.copyfile(tmp_path / f"mine/tiny/pair/{SEEDS[0]}" / name, answer / name)
    assert command(*argv)[0] == 0


def test_a_function_that_writes_nothing_is_told_at_its_first_pair(run: RunFolder) -> None:
    asked = []
    with pytest.raises(InputError, match=r"pair 1 of 2: the function wrote no answer\.json to its second argument"):
        evaluate(lambda pair, _: asked.append(pair), run.path, "mine")
    assert len(asked) == 1


@pytest.mark.parametrize("name", ["answer.npz", "answer.json"])
def test_an_answer_that_nobody_reads_is_not_copied(run: RunFolder, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    def predict(_: Path, answer: Path) -> None:
        (answer / "answer.json").write_text("{}")
        with (answer / name).open("r+b" if name == "answer.json" else "wb") as file:
            file.truncate(1 << 41)  # of nothing: it takes no room on the disk

    monkeypatch.setattr(shutil, "copyfile", lambda *_: pytest.fail("copied"))
    with pytest.raises(InputError, match=rf"^pair 1 of 2: {name}: .*(GB|MB|bytes)") as caught:
        evaluate(predict, run.path, "mine")
    assert "\n" not in str(caught.value)


def test_what_a_function_leaves_beside_its_answer_is_not_copied(
    run: RunFolder, good: tuple[dict[str, Any], dict[str, Any]]
) -> None:
    def predict(_: Path, answer: Path) -> None:
        write_prediction(answer, *good)
        write_prediction(answer / "more", *good)
        with (answer / "log.txt").open("wb") as file:
            file.truncate(1 << 41)

    assert evaluate(predict, run.path, "mine")["status"].tolist() == ["ok", "ok"]
