"""Sessions that are removed after their last cell, and made again when somebody asks."""

import hashlib
import json
import shutil
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from eval.plans.plan import Plan
from eval.report.page import write_page
from eval.running.pair_run import Tools
from eval.running.rescoring import rescore
from eval.running.runfolder import RunFolder
from eval.running.scaling.keeping import Dropped, Keep, digest_files, list_dropped, require_same_bytes
from eval.running.scaling.merging import merge_runs
from eval.running.scaling.remaking import remade_below, remade_when_asked, remake_pair
from eval.running.scaling.shards import Shard
from eval.running.stages.stage_cache import files_digest
from scenarios.schema import Scenario
from sim.session.truth import read_pair_truth, write_pair_truth
from tests.eval.running.scaling.conftest import VARIANT, WORLDS, Runner, load_small
from tests.same_numbers import differences

Command = Callable[..., tuple[int, str, str]]
FIRST = ("smoke/one_box", 20000)


def n_pairs(run: Path) -> int:
    return len(list(run.glob("pairs/*/*")))


def contents(folder: Path) -> dict[str, str]:
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != "scoring_points.npz"]
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture(name="kept")
def kept_fixture(tmp_path: Path, runner: Runner, plan: Plan) -> RunFolder:
    """The first two pairs of the plan, without their sessions."""
    return runner.run(tmp_path / "run", plan, shard=Shard(1, 3), keep="answers")[0]


def test_answers_and_rows_are_those_of_a_run_that_keeps_all(kept: RunFolder, shards: list[Path]) -> None:
    assert list(differences(kept.path, shards[0])) == []
    assert [n_pairs(kept.path), *(list(kept.path.glob(f"{name}/*/*")) for name in ("maps", "stages"))] == [0, [], []]
    assert len(list_dropped(kept)) == 2


def test_rows_alone(tmp_path: Path, runner: Runner, plan: Plan, shards: list[Path]) -> None:
    run, _ = runner.run(tmp_path / "run", plan, shard=Shard(1, 3), keep="nothing")
    assert not list(run.path.glob("answers/*/*/*")) and n_pairs(run.path) == 0
    assert [line for line in differences(run.path, shards[0]) if not line.startswith("answers/")] == []
    shutil.rmtree(run.path / "answers", ignore_errors=True)
    with pytest.raises(InputError, match="left rows alone: run the plan again with --force"):
        rescore(run)


def test_the_simulator_makes_the_same_bytes_again(
    tmp_path: Path, simulated_once: Callable[[Scenario, int], Path], plan: Plan
) -> None:
    simulated = simulated_once(load_small(*FIRST), FIRST[1])
    one = plan.model_copy(update={"seeds": FIRST[1:], "scenarios": plan.scenarios[:1]})
    run, _ = Runner({FIRST[0]: simulated}).run(tmp_path / "run", one, keep="answers")
    with remade_below([run.pair(*FIRST) / "before"]):  # by the simulator itself
        made = contents(run.pair(*FIRST))
    assert len(made) > 8 and made == contents(simulated)
    assert n_pairs(run.path) == 0


def test_view_shows_a_pair_whose_sessions_were_removed(
    kept: RunFolder, tmp_path: Path, command: Command, runner: Runner, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser")
    monkeypatch.setattr("eval.running.scaling.remaking.TOOLS", runner.tools)
    asked = list(runner.asked)
    code, _, err = command("view", kept.pair(*FIRST), "--html", tmp_path / "view.html")
    assert (code, runner.asked) == (0, [*asked, FIRST]), err
    assert (tmp_path / "view.html").is_file() and n_pairs(kept.path) == 0


def test_scoring_again_makes_one_pair_after_the_other(
    kept: RunFolder, runner: Runner, shards: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("eval.running.scaling.remaking.TOOLS", runner.tools)
    asked = list(runner.asked)
    assert rescore(kept) == 4
    assert list(differences(kept.path, shards[0])) == []
    assert runner.asked == [*asked, *((world, 20000) for world in WORLDS)]
    assert n_pairs(kept.path) == 0


def test_the_page_makes_the_pairs_that_it_pictures(
    kept: RunFolder, runner: Runner, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list(runner.asked)
    without = write_page(kept.path, "none").read_text()
    assert runner.asked == asked and "smoke__one_box/20000.npz) are missing" in without
    monkeypatch.setattr("eval.running.scaling.remaking.TOOLS", runner.tools)
    page = write_page(kept.path).read_text()
    assert set(runner.asked[len(asked) :]) == {(world, 20000) for world in WORLDS}
    assert "smoke__one_box/20000.npz) are missing" not in page
    assert n_pairs(kept.path) == 0 and not list(kept.path.glob("maps/*/*"))


def test_a_pair_that_comes_out_otherwise_is_refused(kept: RunFolder, runner: Runner) -> None:
    def other(*told: object) -> None:
        runner.copy(*told)  # type: ignore[arg-type]
        (Path(str(told[2])) / "after" / "more").write_text("")

    with pytest.raises(InputError, match=r"^smoke/one_box 20000: made again, and its files differ .* \(digest"):
        remake_pair(kept, *FIRST, tools=Tools(simulate=other))
    assert n_pairs(kept.path) == 0 and not list(kept.path.glob("pairs/*/.*again"))


def test_a_folder_above_a_pair_does_not_change_its_digest(shards: list[Path], tmp_path: Path) -> None:
    pair = RunFolder(shards[0]).pair(*FIRST)
    copy = tmp_path / "descriptors" / "run"
    shutil.copytree(pair, copy)
    assert digest_files(copy) == digest_files(pair)
    (copy / "after" / "more").write_text("")
    assert digest_files(copy) != digest_files(pair)


def test_the_place_of_a_file_does_not_change_the_digest_of_a_pair(shards: list[Path], tmp_path: Path) -> None:
    digests = []
    for number, (name, content) in enumerate((("a/x.json", "d"), ("/b/x.json", "d"), ("a/x.json", "e"))):
        pair = tmp_path / str(number)
        shutil.copytree(RunFolder(shards[0]).pair(*FIRST), pair)
        scenario = {**read_pair_truth(pair).scenario, "sensor": {"profile": name}}
        write_pair_truth(pair, replace(read_pair_truth(pair), scenario=scenario, files={name: 64 * content}))
        digests.append(digest_files(pair))
    assert digests[0] == digests[1] != digests[2]
    # a record of before is of the files with their paths
    pair = tmp_path / "0"
    own = [path for path in pair.rglob("*") if path.is_file() and path.name != "scoring_points.npz"]
    old = files_digest(pair, own)
    record = Dropped(world="w", seed=1, scenario={}, files={}, digest=old, n_bytes=1)
    require_same_bytes(record, pair)
    with pytest.raises(InputError, match="its files differ"):
        require_same_bytes(record.model_copy(update={"digest": "0" * 16}), pair)


def test_tables_are_written_though_a_pair_of_before_comes_out_otherwise(
    kept: RunFolder, runner: Runner, plan: Plan
) -> None:
    record = list_dropped(kept)[0]
    record.write_text(json.dumps(json.loads(record.read_text()) | {"digest": "0" * 16}))
    kept.cell("smoke/unchanged", 20000, VARIANT).unlink()
    with pytest.raises(InputError, match=r"^smoke/one_box 20000: made again, and its files differ"):
        runner.run(kept.path, plan, shard=Shard(1, 3), keep="sessions")
    assert len(pd.read_csv(kept.path / "results.csv")) == 4 and kept.provenance()["finished"]


@pytest.mark.parametrize("content", ["", "{}", '{"format": "tunnelcd-dropped"}', "[1]"])
def test_a_damaged_record_is_one_line(kept: RunFolder, runner: Runner, content: str) -> None:
    list_dropped(kept)[0].write_text(content)
    with pytest.raises(InputError, match=str(list_dropped(kept)[0])):
        remake_pair(kept, *FIRST, tools=runner.tools)
    assert n_pairs(kept.path) == 0


def test_more_cells_of_a_removed_pair_are_of_the_same_sessions(kept: RunFolder, runner: Runner, plan: Plan) -> None:
    more = plan.model_copy(
        update={"variants": (*plan.variants, plan.variants[0].model_copy(update={"preset": "paper"}))}
    )
    asked = list(runner.asked)
    _, outcome = runner.run(kept.path, more, shard=Shard(1, 3), keep="answers")
    assert (outcome.n_done, outcome.n_kept) == (2, 4)
    assert runner.asked == [*asked, *((world, 20000) for world in WORLDS)]
    record = list_dropped(kept)[0]
    record.write_text(json.dumps(json.loads(record.read_text()) | {"digest": "0" * 16}))
    kept.cell(*FIRST, "oracle-merge[preset=paper]").unlink()
    with pytest.raises(InputError, match="smoke/one_box 20000: made again, and its files differ"):
        runner.run(kept.path, more, shard=Shard(1, 3), keep="answers")
    # forced, all of its cells are of the new sessions
    assert runner.run(kept.path, more, shard=Shard(1, 3), keep="answers", force=True)[1].n_done == 6


def test_rows_about_another_world_go_though_its_sessions_are_gone(kept: RunFolder, runner: Runner, plan: Plan) -> None:
    def draw(name: str, seed: int, settings: Iterable[str] = ()) -> Scenario:
        return load_small(name, seed, settings).model_copy(update={"description": "another world"})

    one = plan.model_copy(update={"variants": plan.variants[:1]})
    runner.run(kept.path, one, shard=Shard(1, 3), keep="answers", tools=replace(runner.tools, draw=draw))
    assert {cell["row"]["variant"] for cell in kept.each_cell()} == {VARIANT}
    assert len(list(kept.path.glob("answers/*/*/*"))) == 2


def test_a_grafted_pair_is_read_as_one(kept: RunFolder) -> None:
    place = list_dropped(kept)[0]
    record = json.loads(place.read_text())
    scenario = {name: value for name, value in record["scenario"].items() if name in ("family", "description", "props")}
    place.write_text(json.dumps(record | {"scenario": {**scenario, "recording": {"sessions": ["drive.bag"]}}}))
    with pytest.raises(InputError) as caught:
        remake_pair(kept, *FIRST)
    assert "recording: unknown key" not in str(caught.value) and "tunnel: missing" not in str(caught.value)


def test_an_interrupted_run_keeps_the_pair_in_work_and_drops_it_later(
    tmp_path: Path, runner: Runner, plan: Plan
) -> None:
    run, outcome = runner.run(tmp_path / "run", plan, shard=Shard(1, 3), keep="answers", limit=3)
    assert (outcome.n_done, n_pairs(run.path)) == (3, 1)  # of the second pair one cell is left
    asked = list(runner.asked)
    runner.run(run.path, plan, shard=Shard(1, 3), keep="answers")
    assert (runner.asked, n_pairs(run.path)) == (asked, 0)


@pytest.mark.parametrize("keep", ["answers", "nothing"])
def test_a_finished_run_gives_its_sessions_up_and_gets_them_back(
    tmp_path: Path, runner: Runner, plan: Plan, shards: list[Path], keep: Keep
) -> None:
    shutil.copytree(shards[0], tmp_path / "run")
    before = contents(tmp_path / "run" / "pairs")
    (tmp_path / "run" / "pairs" / "smoke__one_box" / ".20000.removed").mkdir()  # of a run that was killed
    run, outcome = runner.run(tmp_path / "run", plan, shard=Shard(1, 3), keep=keep)
    assert (outcome.n_done, contents(run.path / "pairs")) == (0, {})
    runner.run(run.path, plan, shard=Shard(1, 3))
    assert n_pairs(run.path) == 0
    runner.run(run.path, plan, shard=Shard(1, 3), keep="sessions")
    assert contents(run.path / "pairs") == before


def test_answers_of_other_programs_stay(tmp_path: Path, runner: Runner, plan: Plan, shards: list[Path]) -> None:
    shutil.copytree(shards[0], tmp_path / "run")
    run = RunFolder(tmp_path / "run")
    shutil.copytree(run.answer(*FIRST, VARIANT), run.answer(*FIRST, "other"))
    rescore(run)
    runner.run(run.path, plan, shard=Shard(1, 3), keep="nothing")
    assert [path.parent.name for path in run.path.glob("answers/*/*/*/answer.json")] == ["other"]


def test_sessions_that_are_gone_cannot_be_exported(kept: RunFolder, tmp_path: Path, command: Command) -> None:
    code, _, err = command("export", kept.path, "--out", tmp_path / "blind")
    assert code == 2
    assert err == (
        f"error: {kept.path}: the sessions of 2 pairs were removed: `tunnelcd run PLAN --out {kept.path} "
        "--keep sessions` makes them again\n"
    )


def test_records_come_along_and_must_agree(kept: RunFolder, tmp_path: Path, shards: list[Path], runner: Runner) -> None:
    merge_runs([kept.path, *shards[1:]], tmp_path / "all")
    assert len(list_dropped(RunFolder(tmp_path / "all"))) == 2 and n_pairs(tmp_path / "all") == 4
    shutil.copytree(kept.path, tmp_path / "other")
    record = list_dropped(RunFolder(tmp_path / "other"))[0]
    record.write_text(json.dumps(json.loads(record.read_text()) | {"digest": "0" * 16}))
    with pytest.raises(InputError, match=r"^smoke/one_box 20000: .* answered different sessions"):
        merge_runs([kept.path, tmp_path / "other"], tmp_path / "again")
    assert not (tmp_path / "again").exists()


def test_a_folder_that_is_asked_makes_nothing_twice(kept: RunFolder, runner: Runner) -> None:
    asked = len(runner.asked)
    with remade_when_asked(kept, tools=runner.tools) as folder:
        assert folder.pair(*FIRST).is_dir() and folder.pair(*FIRST).is_dir()
        before, after = folder.read_maps(*FIRST)
        assert min(len(before), len(after)) > 10
    assert len(runner.asked) == asked + 1 and n_pairs(kept.path) == 0
