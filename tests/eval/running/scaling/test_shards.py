"""Shards of a plan, and their union."""

import json
import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.names import path_part
from eval.plans.cells import expand_cells
from eval.plans.plan import Plan
from eval.report.page import write_page
from eval.running.runfolder import RunFolder, read_json, write_json, write_tables
from eval.running.runner import list_cells
from eval.running.scaling.merging import merge_runs
from eval.running.scaling.shards import Shard, choose_cells, parse_shard
from tests.eval.running.scaling.conftest import VARIANT, WORLDS, Runner
from tests.same_numbers import differences, is_time

Command = Callable[..., tuple[int, str, str]]


@pytest.mark.parametrize("n", [1, 2, 4, 6])
def test_shards_part_the_cells_and_no_pair(plan: Plan, n: int) -> None:
    cells = expand_cells(plan)
    parts = [choose_cells(cells, Shard(k, n)) for k in range(1, n + 1)]
    assert sorted(cells.index(cell) for part in parts for cell in part) == list(range(12))
    pairs = [{(cell.scenario, cell.seed) for cell in part} for part in parts]
    assert sum(map(len, pairs)) == 6
    assert max(map(len, pairs)) - min(map(len, pairs)) <= 1


@pytest.mark.parametrize("text", ["", "3", "0/2", "3/2", "1/0", "a/b", "-1/2", "1/2/3", "1,2", "\u0661/\u0662"])
def test_a_shard_that_cannot_be_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"^--shard .*: expected i/n with i from 1 to n"):
        parse_shard(text)


def test_more_shards_than_pairs_are_refused_before_a_folder_is_made(tmp_path: Path, command: Command) -> None:
    code, _, err = command("run", "smoke", "--shard", "1/3", "--out", tmp_path / "run")
    assert (code, err) == (
        2, "error: --shard 1/3: the plan has 2 pairs, which stay whole: make at most 2 shards\n"
    )  # fmt: skip
    assert not (tmp_path / "run").exists()


def test_a_shard_goes_on_and_takes_no_other_ones_folder(
    tmp_path: Path, runner: Runner, plan: Plan, shards: Sequence[Path]
) -> None:
    shutil.copytree(shards[1], tmp_path / "run")
    (cell, *_) = sorted((tmp_path / "run").glob("cells/*/*/*.json"))
    cell.unlink()
    _, outcome = runner.run(tmp_path / "run", plan, shard=Shard(2, 3))
    assert (outcome.n_done, outcome.n_kept, runner.asked) == (1, 3, [])
    assert read_json(tmp_path / "run" / "provenance.json")["shard"] == "2/3"
    for other in (Shard(1, 3), Shard(2, 4)):
        with pytest.raises(InputError, match=f"holds shard 2/3, this is shard {other}: name a folder of its own"):
            runner.run(tmp_path / "run", plan, shard=other)
        with pytest.raises(InputError, match="holds shard 2/3"):
            list_cells(plan, tmp_path / "run", shard=other)


def test_no_shard_is_run_in_the_folder_of_the_whole_plan(runner: Runner, plan: Plan, whole: Path) -> None:
    with pytest.raises(InputError, match="holds a run of the whole plan, this is shard 1/2"):
        runner.run(whole, plan, shard=Shard(1, 2))


def test_shards_united_are_the_undivided_run(tmp_path: Path, shards: Sequence[Path], whole: Path) -> None:
    found = merge_runs(shards[::-1], tmp_path / "run", command="tunnelcd merge-runs")
    assert (found.n_cells, found.n_shared, found.notes) == (12, 0, ())
    assert list(differences(tmp_path / "run", whole)) == []
    tables = {path.name for path in whole.glob("*.csv")}
    assert {path.name for path in (tmp_path / "run").glob("*.csv")} == tables
    one, other = (read_json(folder / "provenance.json") for folder in (tmp_path / "run", whole))
    assert [part["shard"] for part in one.pop("parts")] == ["3/3", "2/3", "1/3"]
    assert one.pop("finished") and one | {"command": ""} == {k: v for k, v in other.items() if k != "finished"}


def _steady(folder: Path) -> None:
    """Give all times of a run one value, and its provenance that of one command."""
    for path in folder.glob("cells/*/*/*.json"):
        cell = json.loads(path.read_text())
        cell["row"] |= {key: 1.0 for key in cell["row"] if key.startswith("t_")}
        path.write_text(json.dumps(cell))
    for path in folder.glob("answers/*/*/*/answer.json"):
        answer = json.loads(path.read_text())
        path.write_text(json.dumps(answer | {"seconds": dict.fromkeys(answer["seconds"], 1.0)}))
    provenance = read_json(folder / "provenance.json")
    provenance.pop("parts", None)
    write_json(folder / "provenance.json", provenance | {"command": "", "finished": "now", "started": ""})


def test_the_page_of_united_shards_is_that_of_the_undivided_run(
    tmp_path: Path, shards: Sequence[Path], whole: Path
) -> None:

    merge_runs(shards, tmp_path / "run")
    shutil.copytree(whole, tmp_path / "whole")
    pages = []
    for name in ("run", "whole"):
        _steady(tmp_path / name)
        write_tables(RunFolder(tmp_path / name))
        (tmp_path / name).rename(tmp_path / "page")
        pages.append(write_page(tmp_path / "page", "none").read_text())
        (tmp_path / "page").rename(tmp_path / name)
    assert pages[0] == pages[1]
    assert "no verdict before all are there" not in pages[0]


def test_what_is_missing_is_named_and_can_be_run(
    tmp_path: Path, runner: Runner, plan: Plan, shards: Sequence[Path], whole: Path
) -> None:
    found = merge_runs([shards[0], shards[2]], tmp_path / "run")
    assert found.notes == (
        "shard 2/3 is missing",
        "2 of 6 planned pairs are not finished, the first is smoke/one_box 20001: run them into the new folder, or "
        "merge the rest",
    )
    _, outcome = runner.run(tmp_path / "run", plan)
    assert (outcome.n_done, outcome.n_kept) == (4, 8)
    assert runner.asked == [(world, 20001) for world in WORLDS]
    assert list(differences(tmp_path / "run", whole)) == []


def test_a_cell_that_two_runs_hold_is_kept_once_if_it_is_the_same(
    tmp_path: Path, shards: Sequence[Path], whole: Path
) -> None:
    found = merge_runs([shards[0], whole], tmp_path / "run", keep="answers")
    assert (found.n_cells, found.n_shared, found.notes) == (12, 4, ())
    assert list(differences(tmp_path / "run", whole)) == []
    assert not (tmp_path / "run" / "pairs").exists()


def test_a_cell_that_one_run_holds_without_its_answer_comes_with_that_of_the_other(
    tmp_path: Path, shards: Sequence[Path], whole: Path
) -> None:
    shutil.copytree(shards[0], tmp_path / "rows")
    shutil.rmtree(tmp_path / "rows" / "answers")
    for order in ([tmp_path / "rows", whole], [whole, tmp_path / "rows"]):
        merge_runs(order, tmp_path / "run", keep="answers")
        assert list(differences(tmp_path / "run", whole)) == []
        shutil.rmtree(tmp_path / "run")


def test_pairs_that_two_runs_simulated_otherwise_are_refused(
    tmp_path: Path, shards: Sequence[Path], whole: Path
) -> None:
    shutil.copytree(shards[0], tmp_path / "other")
    folders = whole, tmp_path / "other"
    pair = RunFolder(folders[1]).pair(WORLDS[0], 20000)
    (pair / "after" / "session.json").write_text((pair / "after" / "session.json").read_text() + " ")
    with pytest.raises(InputError, match=rf"^{WORLDS[0]} 20000: .* answered different sessions"):
        merge_runs(folders, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def _edit_cell(folder: Path, change: Callable[[dict], object]) -> None:
    path = folder / "cells" / "smoke__one_box" / "20000" / f"{path_part(VARIANT)}.json"
    cell = json.loads(path.read_text())
    change(cell)
    path.write_text(json.dumps(cell))


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda cell: cell["row"].update(region_recall=0.25), r"region_recall = \S+ and 0.25"),
        (lambda cell: cell.update(key="0" * 16), r"scenario, settings, weights or extras: key \w{16} and 0{16}"),
        (lambda cell: cell["keyframes"].pop(), r"\d+ and \d+ rows of keyframes"),
        (lambda cell: cell["changes"][0].update(kind="x"), r"changes 0: kind = '\w+' and 'x'"),
    ],
)
def test_a_cell_with_two_results_is_refused_and_nothing_is_written(
    tmp_path: Path, shards: Sequence[Path], whole: Path, change: Callable[[dict], object], what: str
) -> None:
    shutil.copytree(shards[0], tmp_path / "a")
    _edit_cell(tmp_path / "a", change)
    who = rf"^smoke/one_box 20000 {re.escape(VARIANT)}: {whole} and {tmp_path}/a"
    wanted = rf"{who} hold different results \({what}\): remove"
    with pytest.raises(InputError, match=wanted):
        merge_runs([whole, tmp_path / "a"], tmp_path / "run")
    assert {path.name for path in tmp_path.iterdir()} == {"a"}


def test_times_are_no_difference(tmp_path: Path, shards: Sequence[Path], whole: Path) -> None:
    shutil.copytree(shards[0], tmp_path / "a")
    _edit_cell(tmp_path / "a", lambda cell: cell["row"].update({key: 9.0 for key in cell["row"] if is_time(key)}))
    assert merge_runs([whole, tmp_path / "a"], tmp_path / "run").n_shared == 4


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"plan": {}}, "plans"),
        ({"versions": {"numpy": "1.0"}}, "versions of packages"),
        ({"checkpoints": {"3deg": "other"}}, "weights"),
        ({"config_digests": {}}, "settings"),
        ({"machine": {"threads": {"OMP_NUM_THREADS": "8"}}}, "threads of the numeric libraries"),
    ],
)
def test_runs_that_differ_in_what_rows_depend_on_are_refused(
    tmp_path: Path, shards: Sequence[Path], change: dict[str, object], what: str
) -> None:
    shutil.copytree(shards[1], tmp_path / "b")
    write_json(tmp_path / "b" / "provenance.json", {**read_json(tmp_path / "b" / "provenance.json"), **change})
    with pytest.raises(InputError, match=rf"^{shards[0]} and {tmp_path}/b: of different {what} \("):
        merge_runs([shards[0], tmp_path / "b"], tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_another_commit_is_named(tmp_path: Path, shards: Sequence[Path]) -> None:
    shutil.copytree(shards[1], tmp_path / "b")
    told = read_json(tmp_path / "b" / "provenance.json")
    write_json(tmp_path / "b" / "provenance.json", {**told, "git_commit": "beef"})
    found = merge_runs([shards[0], tmp_path / "b", shards[2]], tmp_path / "run")
    assert found.notes == ("the runs are of several commits: c0ffee, beef",)


def test_merge_runs_from_the_command_line(tmp_path: Path, command: Command, shards: Sequence[Path]) -> None:
    code, out, err = command("merge-runs", *shards, "--out", tmp_path / "run")
    assert code == 0 and "12 cells of 3 runs" in out + err
    assert command("merge-runs", *shards, "--out", tmp_path / "run")[0] == 2  # not empty
    code, _, err = command("merge-runs", shards[0], shards[0], "--out", tmp_path / "twice")
    assert (code, err) == (2, f"error: {shards[0]}: is named twice: name each run folder once\n")
    code, _, err = command("merge-runs", shards[0], "--out", tmp_path / "one")
    assert (code, err) == (2, "error: merge-runs unites two run folders or more: name them all\n")
    code, _, err = command("merge-runs", shards[0], shards[1], "--out", shards[1] / "in")
    assert code == 2 and "lies in the run folder" in err and not (shards[1] / "in").exists()


def test_what_was_evaluated_comes_along_and_two_methods_of_one_name_do_not(
    tmp_path: Path, shards: Sequence[Path]
) -> None:
    copies = [shutil.copytree(shard, tmp_path / shard.name) for shard in shards[:2]]
    for number, copy in enumerate(copies):
        folder = copy / "evaluations" / "mine"
        (folder / "world").mkdir(parents=True)
        document = {"command": ["python", "m.py"], "merge": "own", "limit_s": 60.0, "pairs": [["world", number]]}
        (folder / "evaluation.json").write_text(json.dumps(document))
        (folder / "world" / f"{number}.json").write_text("{}")
    merge_runs(copies, tmp_path / "run", keep="answers")
    united = tmp_path / "run" / "evaluations" / "mine"
    assert json.loads((united / "evaluation.json").read_text())["pairs"] == [["world", 0], ["world", 1]]
    assert sorted(path.name for path in (united / "world").iterdir()) == ["0.json", "1.json"]
    other = copies[1] / "evaluations" / "mine" / "evaluation.json"
    other.write_text(json.dumps({**json.loads(other.read_text()), "merge": "given"}))
    with pytest.raises(InputError, match=r"under the name mine \(merge\): evaluate one of them"):
        merge_runs(copies, tmp_path / "two", keep="answers")
    for number, path in enumerate(copy / "evaluations" / "mine" / "evaluation.json" for copy in copies):
        askers = [{"commit": "a"}, *([{"commit": "b"}] * number)]
        path.write_text(json.dumps({**json.loads(path.read_text()), "merge": "own", "askers": askers}))
    merge_runs(copies, tmp_path / "askers", keep="answers")
    united = tmp_path / "askers" / "evaluations" / "mine"
    assert json.loads((united / "evaluation.json").read_text())["askers"] == [{"commit": "a"}, {"commit": "b"}]
    for pairs in (None, 3, [1], [["world"]], [["world", "x"]]):
        for copy in copies:
            path = copy / "evaluations" / "mine" / "evaluation.json"
            path.write_text(json.dumps({**json.loads(path.read_text()), "merge": "own", "pairs": pairs}))
        with pytest.raises(InputError, match=r"evaluation\.json: damaged: expected pairs"):
            merge_runs(copies, tmp_path / "two", keep="answers")


def test_the_record_of_a_call_is_of_the_run_that_gives_its_answer(tmp_path: Path, shards: Sequence[Path]) -> None:
    copies = [shutil.copytree(shards[0], tmp_path / name) for name in ("first", "second")]
    cell = next(copies[0].glob("cells/*/*/*.json"))
    seed, world, method = cell.parent.name, cell.parents[1].name, cell.stem
    for copy in copies:
        folder = copy / "evaluations" / method
        (folder / world).mkdir(parents=True)
        document = {"command": ["python", "m.py"], "merge": "own", "limit_s": 60.0, "pairs": [["world", 1]]}
        (folder / "evaluation.json").write_text(json.dumps(document))
        (folder / world / f"{seed}.json").write_text(json.dumps({"error": copy.name}))
    merge_runs(copies, tmp_path / "run", keep="answers")
    call = tmp_path / "run" / "evaluations" / method / world / f"{seed}.json"
    assert json.loads(call.read_text()) == {"error": "first"}


def test_a_plan_that_cannot_be_read_here_is_told_and_keeps_its_tables(tmp_path: Path, shards: Sequence[Path]) -> None:
    copies = [shutil.copytree(shard, tmp_path / shard.name) for shard in shards[:2]]
    for copy in copies:
        told = json.loads((copy / "provenance.json").read_text())
        told["plan"]["variants"][0]["preset"] = "elsewhere.yaml"
        (copy / "provenance.json").write_text(json.dumps(told))
    (note,) = merge_runs(copies, tmp_path / "run", keep="answers").notes
    assert note.startswith("what is missing cannot be told, as the plan cannot be read here: ")
    assert "elsewhere.yaml" in note
    (tmp_path / "run" / "hard.csv").write_text("a\n1\n")  # of the place where the plan could be read
    write_tables(RunFolder(tmp_path / "run"))
    assert (tmp_path / "run" / "hard.csv").is_file()
