"""Rows and answers at a URL: the local and the memory file system."""

import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from cdpipe.core.errors import InputError
from eval.plans.plan import Plan
from eval.running.pair_run import Pair
from eval.running.runfolder import RunFolder, write_json
from eval.running.scaling.keeping import list_records
from eval.running.scaling.mirror import Mirror
from eval.running.scaling.shards import Shard
from scenarios.schema import Scenario
from tests.eval.running.scaling.conftest import Runner, load_small
from tests.same_numbers import differences

Command = Callable[..., tuple[int, str, str]]
PART = Shard(1, 3)


@pytest.fixture(name="url", params=["memory", "file", "folder"])
def url_fixture(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    yield {"memory": "memory://bucket/run", "file": f"file://{tmp_path}/far", "folder": str(tmp_path / "far")}[
        request.param
    ]
    MemoryFileSystem.store.clear()
    MemoryFileSystem.pseudo_dirs[:] = [""]


def test_rows_and_answers_are_copied_and_a_new_folder_goes_on(
    tmp_path: Path, runner: Runner, plan: Plan, shards: list[Path], url: str
) -> None:
    runner.run(tmp_path / "a", plan, shard=PART, limit=3, mirror=Mirror(url))
    shutil.rmtree(tmp_path / "a")  # the scratch disk of a machine that is gone
    run, outcome = runner.run(tmp_path / "b", plan, shard=PART, mirror=Mirror(url), keep="answers")
    assert (outcome.n_done, outcome.n_kept) == (1, 3)
    Mirror(url).fetch_all(tmp_path / "c")
    for table in ("results", "regions"):
        shutil.copyfile(run.path / f"{table}.csv", tmp_path / "c" / f"{table}.csv")
    for table in ("changes", "objects", "keyframes"):
        shutil.copyfile(run.path / f"{table}.csv", tmp_path / "c" / f"{table}.csv")
    assert list(differences(tmp_path / "c", shards[0])) == []
    assert Mirror(url).provenance() == run.provenance()


def test_records_of_removed_sessions_are_copied_and_taken(tmp_path: Path, runner: Runner, plan: Plan, url: str) -> None:
    run, _ = runner.run(tmp_path / "a", plan, shard=PART, mirror=Mirror(url), keep="answers")
    records = {path.relative_to(run.path): path.read_bytes() for path in list_records(run)}
    Mirror(url).fetch_all(tmp_path / "c")
    more = plan.model_copy(
        update={"variants": (*plan.variants, plan.variants[0].model_copy(update={"preset": "paper"}))}
    )
    b, _ = runner.run(tmp_path / "b", plan, shard=PART, mirror=Mirror(url), keep="answers")
    for folder in (tmp_path / "c", b.path):
        assert {path.relative_to(folder): path.read_bytes() for path in list_records(RunFolder(folder))} == records
    assert len(records) == 2

    def other(*told: object) -> None:
        runner.copy(*told)  # type: ignore[arg-type]
        (Path(str(told[2])) / "after" / "more").write_text("")

    # a machine that makes other bytes does not mix them with those of before
    with pytest.raises(InputError, match="made again, and its files differ"):
        runner.run(b.path, more, shard=PART, mirror=Mirror(url), tools=replace(runner.tools, simulate=other))
    tools = replace(runner.tools, draw=load_other)
    runner.run(b.path, plan, shard=PART, mirror=Mirror(url), tools=tools)
    assert Mirror(url)._list("dropped") == []  # those were of the old world


def test_sessions_that_are_removed_later_leave_their_records_there(tmp_path: Path, runner: Runner, plan: Plan) -> None:
    url = f"file://{tmp_path}/far"
    runner.run(tmp_path / "a", plan, shard=PART, mirror=Mirror(url))
    runner.run(tmp_path / "a", plan, shard=PART, mirror=Mirror(url), keep="answers")
    assert len(list((tmp_path / "far").glob("dropped/*/*.json"))) == 2


def test_forced_cells_are_forgotten_there_first(tmp_path: Path, runner: Runner, plan: Plan) -> None:
    url = f"file://{tmp_path}/far"
    runner.run(tmp_path / "a", plan, shard=PART, mirror=Mirror(url))
    with pytest.raises(KeyboardInterrupt):
        runner.run(tmp_path / "a", plan, shard=PART, mirror=Stopped(url), force=True)
    _, outcome = runner.run(tmp_path / "b", plan, shard=PART, mirror=Mirror(url))
    assert outcome.n_done == 4


def test_a_first_copy_that_is_cut_short_is_gone_on_with(
    tmp_path: Path, runner: Runner, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = f"file://{tmp_path}/far"
    with pytest.raises(KeyboardInterrupt):
        runner.run(tmp_path / "a", plan, shard=PART, mirror=CutShort(url))
    Mirror(url).fetch_all(tmp_path / "c")
    assert len(cells_of(tmp_path / "c")) == 2
    copied: list[Path] = []
    copy_cell = Mirror._copy_cell
    monkeypatch.setattr(Mirror, "_copy_cell", lambda *told: copied.append(told[2]) or copy_cell(*told))
    for name in ("a", "b"):
        _, outcome = runner.run(tmp_path / name, plan, shard=PART, mirror=Mirror(url))
        assert outcome.n_kept == {"a": 2, "b": 4}[name]
        assert len(copied) == 2  # what was there is not copied again


class CutShort(Mirror):
    def copy_pair(self, run: RunFolder, pair: Pair) -> None:
        super().copy_pair(run, pair)
        raise KeyboardInterrupt


def test_cells_that_were_written_without_the_copy_are_copied_again(
    tmp_path: Path, runner: Runner, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = f"file://{tmp_path}/far"
    run, _ = runner.run(tmp_path / "a", plan, shard=PART, mirror=Mirror(url))
    cells = [run.path / name for name in cells_of(run.path)]
    cells[1].write_text(cells[1].read_text() + " ")
    copied: list[Path] = []
    copy_cell = Mirror._copy_cell
    monkeypatch.setattr(Mirror, "_copy_cell", lambda *told: copied.append(told[2]) or copy_cell(*told))
    for _ in range(2):
        runner.run(tmp_path / "a", plan, shard=PART, mirror=Mirror(url))
        assert copied == [cells[1]]
    assert (tmp_path / "far" / cells_of(run.path)[1]).read_text() == cells[1].read_text()
    # however the URL is written; without a record of what was copied all is
    for is_noted in (True, False):
        cells[2].write_text(cells[2].read_text() + " ")
        copied.clear()
        if not is_noted:
            (run.path / "copied.json").unlink()
        runner.run(tmp_path / "a", plan, shard=PART, mirror=Mirror(str(tmp_path / "far")))
        assert copied == ([cells[2]] if is_noted else cells)


class Stopped(Mirror):
    def copy_pair(self, *_: object) -> None:
        raise KeyboardInterrupt


def cells_of(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.glob("cells/*/*/*.json"))


def test_cells_that_were_finished_without_a_copy_are_copied_later(tmp_path: Path, runner: Runner, plan: Plan) -> None:
    with pytest.raises(KeyboardInterrupt):
        runner.run(tmp_path / "a", plan, shard=PART, mirror=Stopped(f"file://{tmp_path}/far"))
    run, outcome = runner.run(tmp_path / "a", plan, shard=PART, mirror=Mirror(f"file://{tmp_path}/far"))
    assert outcome.n_kept > 0 and cells_of(tmp_path / "far") == cells_of(run.path)
    runner.run(tmp_path / "a", plan, shard=PART, mirror=Mirror(f"file://{tmp_path}/later"))
    assert cells_of(tmp_path / "later") == cells_of(run.path)
    Mirror(f"file://{tmp_path}/later").fetch_all(tmp_path / "c")
    assert len(list((tmp_path / "c").glob("answers/*/*/*/answer.json"))) == len(cells_of(run.path))


def test_rows_about_another_world_do_not_come_back_from_the_copy(tmp_path: Path, runner: Runner, plan: Plan) -> None:
    url = f"file://{tmp_path}/far"
    runner.run(tmp_path / "a", plan, shard=PART, mirror=Mirror(url))
    one = plan.model_copy(update={"variants": plan.variants[:1]})
    tools = replace(runner.tools, draw=load_other)
    for _ in range(2):
        run, _ = runner.run(tmp_path / "a", one, shard=PART, mirror=Mirror(url), tools=tools)
        assert len(pd.read_csv(run.path / "results.csv")) == len(cells_of(tmp_path / "far")) == 2


def load_other(name: str, seed: int, settings: Iterable[str] = ()) -> Scenario:
    return load_small(name, seed, settings).model_copy(update={"description": "another world"})


def test_an_interrupted_fetch_leaves_a_run_folder(
    tmp_path: Path, runner: Runner, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = f"file://{tmp_path}/far"
    runner.run(tmp_path / "a", plan, shard=PART, mirror=Mirror(url))

    def stop(mirror: Mirror, folder: Path, names: list[str], _: object) -> None:
        (folder / names[0]).parent.mkdir(parents=True)
        shutil.copyfile(mirror._place(names[0]), folder / names[0])
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(Mirror, "_get", stop)
        runner.run(tmp_path / "b", plan, shard=PART, mirror=Mirror(url))
    assert runner.run(tmp_path / "b", plan, shard=PART, mirror=Mirror(url))[1].n_done == 0


def test_cells_of_a_copy_made_by_other_packages_are_not_gone_on_with(
    tmp_path: Path, runner: Runner, plan: Plan
) -> None:
    run, _ = runner.run(tmp_path / "a", plan, shard=PART, limit=1, mirror=Mirror(f"file://{tmp_path}/far"))
    told = run.provenance()
    write_json(tmp_path / "far" / "provenance.json", {**told, "versions": {**told["versions"], "numpy": "1.0"}})
    with pytest.raises(InputError, match="far: its finished cells and the others: of different"):
        runner.run(tmp_path / "b", plan, shard=PART, mirror=Mirror(f"file://{tmp_path}/far"))


def test_a_place_may_have_the_name_of_a_world(tmp_path: Path, runner: Runner, plan: Plan) -> None:
    run, _ = runner.run(tmp_path / "a", plan, shard=PART, mirror=Mirror("memory://smoke__one_box"))
    assert Mirror("memory://smoke__one_box")._list("cells") == cells_of(run.path)
    MemoryFileSystem.store.clear()


def test_merge_runs_takes_urls(
    tmp_path: Path, runner: Runner, plan: Plan, shards: list[Path], whole: Path, command: Command
) -> None:
    runner.run(tmp_path / "a", plan, shard=PART, mirror=Mirror(f"file://{tmp_path}/far"))
    code, _, err = command("merge-runs", f"file://{tmp_path}/far", *shards[1:], "--out", tmp_path / "run", "--quiet")
    assert (code, err) == (0, "")
    assert list(differences(tmp_path / "run", whole)) == []
    assert RunFolder(tmp_path / "run").provenance()["parts"][0]["folder"] == f"file://{tmp_path}/far"


def test_a_copy_of_another_shard_or_of_something_else_is_refused(tmp_path: Path, runner: Runner, plan: Plan) -> None:
    url = f"file://{tmp_path}/far"
    runner.run(tmp_path / "a", plan, shard=PART, mirror=Mirror(url))
    with pytest.raises(InputError, match=f"^{url}: holds shard 1/3, this is shard 2/3"):
        runner.run(tmp_path / "b", plan, shard=Shard(2, 3), mirror=Mirror(url))
    place = Mirror(url)
    place._fs.rm_file(place._place("provenance.json"))
    with pytest.raises(InputError, match=f"^{url}: not empty and not a copy of a run: name another place"):
        runner.run(tmp_path / "c", plan, shard=PART, mirror=Mirror(url))
    with pytest.raises(InputError, match="not empty and not a copy of a run"):
        place.fetch_all(tmp_path / "d")


@pytest.mark.parametrize("name", ["cells/../../x.json", "cells/a/b/c.json", "cells/a/1/.c.json", "cells/a/1/2/c.json"])
def test_files_with_other_names_are_left_there(tmp_path: Path, runner: Runner, plan: Plan, name: str) -> None:
    place = Mirror("memory://odd")
    place._fs.pipe_file("/odd/provenance.json", b'{"tool": "tunnelcd"}')
    place._fs.store[f"/odd/{name}"] = place._fs.store["/odd/provenance.json"]
    place.fetch_all(tmp_path / "run" / "in")
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["provenance.json"]
    MemoryFileSystem.store.clear()


def test_a_cell_that_is_too_large_is_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = Mirror("memory://large")
    place._fs.pipe_file("/large/provenance.json", b'{"tool": "tunnelcd"}')
    place._fs.pipe_file("/large/cells/a/1/b.json", b"{" + b" " * 100)
    monkeypatch.setattr("eval.running.scaling.mirror.MAX_BYTES", 50)
    with pytest.raises(InputError, match="101 bytes, more than the 50 that it may have"):
        place.fetch_all(tmp_path / "run")
    MemoryFileSystem.store.clear()


@pytest.mark.parametrize(
    ("url", "what"),
    [
        ("nosuch://x/y", "nosuch://x/y"),
        ("s3://[b/x", "s3://[b/x: no URL: "),
        ("ftp://me:secret@host/run", "a URL with a password would stand in provenance.json"),
    ],
)
def test_a_place_that_cannot_be_opened_is_one_line(tmp_path: Path, command: Command, url: str, what: str) -> None:
    code, _, err = command("run", "smoke", "--out", tmp_path / "run", "--rows-to", url)
    assert code == 2 and err.startswith(f"error: {what}") and err.count("\n") == 1 and "secret" not in err
    assert not (tmp_path / "run").exists()


def test_the_run_folder_is_no_copy_of_itself(tmp_path: Path, command: Command) -> None:
    code, _, err = command("run", "smoke", "--out", tmp_path / "run", "--rows-to", f"file://{tmp_path}/run")
    assert (code, err) == (2, f"error: --rows-to file://{tmp_path}/run: is the run folder itself: name another place\n")
