"""Plans on workers: a real scheduler and real workers on loopback, and a pair so small that a cell takes no time."""

import errno
import importlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest
from pydantic import TypeAdapter

from cdpipe.core.errors import InputError
from cdpipe.core.names import path_part
from eval.core import cluster
from eval.core.cluster import Where
from eval.core.terminal import progress
from eval.core.terminal.progress import Lines, Silent
from eval.plans.cells import expand_cells
from eval.plans.plan import Plan, load_plan
from eval.running import pair_run, run_workers, runner
from eval.running.pair_run import Made, Tools
from eval.running.run_workers import Task, _unfit, remove_traces, work_on
from eval.running.runfolder import RunFolder, start_run_folder, write_json
from eval.running.runner import RunOutcome, run_plan
from eval.running.schedule import schedule_pairs
from tests.eval.plans.shipped import plan_of

distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
HOOKED, ROOT = Path(__file__).parent / "hooked", Path(__file__).parents[3]
FIRST, SECOND = "oracle-merge[preset=voxel-diff]", "oracle-merge[preset=random-regions]"
PLAN = """\
name: test
scenarios: [smoke/one_box]
seeds: "20000:20003"
variants:
  - {preset: voxel-diff, oracle_merge: {}}
  - {preset: random-regions, oracle_merge: {}}
"""


THERE = Where(scheduler="tcp://127.0.0.1:8786")


class Workers:
    """A cluster whose processes look into a folder for what befalls a cell (`hooked/befalling.py`)."""

    def __init__(self, hook: Path, address: str) -> None:
        self.hook = hook
        self.where = Where(scheduler=address)

    def befalls(self, what: str, *cells: str) -> None:
        for cell in cells:
            (self.hook / f"{what}-{cell}").touch()

    def spare(self) -> None:
        for path in self.hook.glob("*-*"):
            path.unlink()
        (self.hook / "begun").write_text("")

    def begun(self) -> list[tuple[str, int]]:
        """Return every cell that was begun, and by which process, in order."""
        lines = (self.hook / "begun").read_text().splitlines()
        return [(line.rpartition(" ")[0], int(line.rpartition(" ")[2])) for line in lines]


@pytest.fixture(scope="module")
def hook(tmp_path_factory: pytest.TempPathFactory, lasting_pair: Path) -> Path:
    folder = tmp_path_factory.mktemp("hook")
    shutil.copytree(lasting_pair, folder / "pair")
    (folder / "begun").touch()
    return folder


@pytest.fixture(scope="module")
def environment(hook: Path) -> dict[str, str]:
    path = os.pathsep.join((str(HOOKED), str(ROOT)))
    threads = dict.fromkeys(cluster.THREAD_VARIABLES, "1")
    return {**os.environ, **threads, "PYTHONPATH": path, "TUNNELCD_TEST_HOOK": str(hook)}


@pytest.fixture(scope="module")
def lasting_workers(hook: Path, environment: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A scheduler and two workers; dead workers are started again, as `dask worker` does."""
    folder = tmp_path_factory.mktemp("cluster")
    file = folder / "scheduler.json"
    commands = [
        ["distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"],
        ["distributed.cli.dask_worker", "--nworkers", "2", "--nthreads", "1", "--no-dashboard"],
    ]
    processes = []
    try:
        for argv in commands:
            whole = [sys.executable, "-m", *argv, "--scheduler-file", str(file)]
            processes.append(subprocess.Popen(whole, cwd=folder, env=environment, stderr=subprocess.DEVNULL))
            while not file.is_file():
                time.sleep(0.05)
        yield Workers(hook, json.loads(file.read_text())["address"])
    finally:
        for process in reversed(processes):
            process.terminate()
            process.wait(20)


@pytest.fixture
def one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give this process the numbers of threads that `environment` gives to others: rows of both are not mixed else."""
    for name in cluster.THREAD_VARIABLES:
        monkeypatch.setenv(name, "1")


@pytest.fixture
def workers(lasting_workers: Workers, one_thread: None) -> Iterator[Workers]:
    with distributed.Client(lasting_workers.where.scheduler) as client:
        client.wait_for_workers(2, timeout=60)
    lasting_workers.spare()
    yield lasting_workers
    lasting_workers.spare()


@pytest.fixture
def copies(hook: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let this process copy pairs too instead of simulating them."""
    monkeypatch.syspath_prepend(HOOKED)
    befalling = importlib.import_module("befalling")
    monkeypatch.setenv("TUNNELCD_TEST_HOOK", str(hook))
    for module in (pair_run, runner):
        monkeypatch.setattr(module, "TOOLS", Tools(simulate=befalling.copied))


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    (tmp_path / "plan.yaml").write_text(PLAN)
    return load_plan(str(tmp_path / "plan.yaml"))


def run_in(folder: Path, plan: Plan, where: Where, **options: Any) -> tuple[RunFolder, RunOutcome]:
    run = start_run_folder(folder)
    return run, run_plan(plan, run, where=where, **options)


def table(run: RunFolder, name: str = "results") -> pd.DataFrame:
    frame = pd.read_csv(run.path / f"{name}.csv")
    return frame[[column for column in frame.columns if not column.startswith("t_")]]


def hidden(run: RunFolder) -> list[str]:
    return sorted(str(path.relative_to(run.path)) for path in run.path.rglob(".*"))


def until(is_so: Callable[[], Any], process: subprocess.Popen[str] | None = None) -> None:
    start = time.monotonic()
    while not is_so():
        assert time.monotonic() - start < 90, "waited in vain"
        assert process is None or process.poll() is None
        time.sleep(0.02)


@pytest.mark.usefixtures("copies")
def test_rows_are_those_of_a_serial_run(tmp_path: Path, plan: Plan, workers: Workers) -> None:
    here, outcome = run_in(tmp_path / "here", plan, Where())
    there, other = run_in(tmp_path / "there", plan, workers.where)
    assert outcome == other == RunOutcome(6, 0, 0)
    ours, theirs = table(here), table(there)
    assert ours["status"].tolist() == ["ok"] * 6
    assert ours["is_contended"].tolist() == [False] * 6
    assert theirs["is_contended"].tolist() == [True] * 6
    columns = [name for name in ours.columns if name != "is_contended"]
    pd.testing.assert_frame_equal(ours[columns], theirs[columns], check_exact=True)
    for name in ("changes", "regions", "objects", "keyframes"):
        pd.testing.assert_frame_equal(table(here, name), table(there, name), check_exact=True)
    # two workers took part, every cell was begun once, and nothing is left over
    assert {pid for _, pid in workers.begun()}.isdisjoint({os.getpid()})
    assert sorted(Counter(cell for cell, _ in workers.begun()).values()) == [1] * 6
    assert hidden(here) == hidden(there) == []
    assert "is_contended" not in set(pd.read_csv(there.path / "summary.csv")["metric"])
    # the same folder goes on here, or there
    assert run_in(there.path, plan, Where())[1] == run_in(there.path, plan, workers.where)[1] == RunOutcome(0, 6, 0)


@pytest.mark.soak
def test_a_killed_worker_loses_only_the_cell_in_flight(tmp_path: Path, plan: Plan, workers: Workers) -> None:
    workers.befalls("hold", f"20000-{SECOND}")

    def kill() -> None:
        until(lambda: any(cell == f"20000 {SECOND}" for cell, _ in workers.begun()))
        os.kill(next(pid for cell, pid in workers.begun() if cell == f"20000 {SECOND}"), signal.SIGKILL)
        workers.hook.joinpath(f"hold-20000-{SECOND}").unlink()

    killer = threading.Thread(target=kill)
    killer.start()
    run, outcome = run_in(tmp_path / "run", plan, workers.where)
    killer.join()
    assert outcome == RunOutcome(6, 0, 0)
    assert table(run)["status"].tolist() == ["ok"] * 6
    times = Counter(cell for cell, _ in workers.begun())
    assert times.pop(f"20000 {SECOND}") == 2
    assert set(times.values()) == {1}
    assert hidden(run) == []


def test_a_cell_that_kills_its_worker_is_a_row_and_the_others_are_fine(
    tmp_path: Path, plan: Plan, workers: Workers
) -> None:
    workers.befalls("kill", f"20001-{FIRST}")
    run, outcome = run_in(tmp_path / "run", plan, workers.where)
    assert outcome == RunOutcome(6, 0, 0, n_died=1)
    rows = table(run).set_index(["seed", "variant"])
    assert rows["status"].to_dict() == {
        (seed, variant): "worker_died" if (seed, variant) == (20001, FIRST) else "ok"
        for seed in (20000, 20001, 20002)
        for variant in (FIRST, SECOND)
    }
    died = rows.loc[(20001, FIRST)]
    assert died["error"] == "killed its worker, and again where it ran alone (signal 9)"
    assert died["region_recall"] == 0
    assert len({pid for cell, pid in workers.begun() if cell == f"20001 {FIRST}"}) == 2
    assert hidden(run) == []
    # it is finished: the same command does not kill anybody again
    assert run_in(run.path, plan, workers.where)[1] == RunOutcome(0, 6, 0, n_died=1)


@pytest.mark.soak
def test_a_simulation_that_kills_its_worker_makes_a_row_of_every_cell(
    tmp_path: Path, plan: Plan, workers: Workers
) -> None:
    workers.befalls("kill", "simulation")
    run, outcome = run_in(tmp_path / "run", plan, workers.where, limit=2)
    assert outcome == RunOutcome(2, 0, 4, n_died=2)
    assert table(run)["status"].tolist() == ["worker_died"] * 2
    assert hidden(run) == []


def test_a_full_disk_ends_the_run_in_one_line_and_the_next_goes_on(
    tmp_path: Path, plan: Plan, workers: Workers, command: Callable[..., tuple[int, str, str]]
) -> None:
    workers.befalls("full", f"20000-{SECOND}")
    run = tmp_path / "run"
    argv = ("run", tmp_path / "plan.yaml", "--out", run, "--quiet", "--scheduler", workers.where.scheduler)
    code, out, err = command(*argv)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1 and "No space left on device" in err
    folder = RunFolder(run)
    # other workers may still be at the cell that they had begun
    until(lambda: not list(run.glob("cells/*/*/.*")) and not list(run.glob("pairs/*/.*")))
    assert folder.cell("smoke/one_box", 20000, FIRST).is_file()
    assert not folder.answer("smoke/one_box", 20000, SECOND).exists()
    for path in run.glob("cells/*/*/*.json"):
        assert folder.read_cell(path) is not None
        assert (run / "answers" / path.parts[-3] / path.parts[-2] / path.stem / "answer.json").is_file()
    n_kept = len(list(run.glob("cells/*/*/*.json")))
    workers.spare()
    assert run_in(run, plan, workers.where)[1] == RunOutcome(6 - n_kept, n_kept, 0)
    assert hidden(folder) == []


@pytest.mark.usefixtures("copies", "one_thread")
def test_a_killed_client_takes_its_workers_along_and_loses_nothing_finished(
    tmp_path: Path, plan: Plan, environment: dict[str, str], hook: Path
) -> None:
    hold = hook / f"hold-20001-{SECOND}"
    hold.touch()
    (hook / "begun").write_text("")
    argv = ["run", str(tmp_path / "plan.yaml"), "--workers", "2", "--out", str(tmp_path / "run"), "--quiet"]
    process = subprocess.Popen(
        [sys.executable, "-c", "from eval.cli.main import main; main()", *argv], cwd=ROOT, env=environment
    )
    run = RunFolder(tmp_path / "run")
    first = run.cell("smoke/one_box", 20001, FIRST)
    until(lambda: hold.name.removeprefix("hold-").replace("-", " ", 1) in (hook / "begun").read_text(), process)
    assert first.is_file()
    pids = {int(line.rpartition(" ")[2]) for line in (hook / "begun").read_text().splitlines()}
    process.kill()
    process.wait(20)
    until(lambda: not any(Path(f"/proc/{pid}/cmdline").is_file() for pid in pids))
    hold.unlink()
    stamp, n_kept = first.stat().st_mtime_ns, len(list(run.path.glob("cells/*/*/*.json")))
    assert 1 <= n_kept < 6
    assert run_in(run.path, plan, Where())[1] == RunOutcome(6 - n_kept, n_kept, 0)
    assert first.stat().st_mtime_ns == stamp
    rows = table(run)
    assert rows["status"].tolist() == ["ok"] * 6
    assert rows["is_contended"].sum() == n_kept
    assert hidden(run) == []


def test_a_scheduler_that_cannot_be_reached_is_named_at_once(
    tmp_path: Path, command: Callable[..., tuple[int, str, str]]
) -> None:
    start = time.monotonic()
    argv = ("run", "smoke", "--scheduler", "tcp://127.0.0.1:9", "--out", tmp_path / "run")
    code, out, err = command(*argv)
    assert (code, out) == (2, "")
    assert err.startswith("error: --scheduler tcp://127.0.0.1:9: cannot be reached (")
    assert err.endswith("expected tcp://HOST:PORT of a running `dask scheduler`\n") and err.count("\n") == 1
    assert time.monotonic() - start < 10
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("address", ["nowhere", "tcp://127.0.0.1", "tcp://:8786"])
def test_what_is_no_address_is_named(address: str) -> None:
    with (
        pytest.raises(InputError, match=r"tcp://HOST:PORT"),
        cluster.connected(Where(scheduler=address), 1),
    ):
        pass


@pytest.mark.parametrize(
    "error",
    [
        distributed.comm.CommClosedError("in <TCP>: Stream is closed"),
        OSError("Timed out trying to connect to tcp://127.0.0.1:8786 after 30 s"),
        CancelledError("work_on-1"),
    ],
)
def test_a_scheduler_that_goes_away_at_any_moment_is_one_line(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "_of_scheduler", lambda address: nullcontext())
    with pytest.raises(InputError, match="went away; what is finished is kept"), cluster.connected(THERE, 1):
        raise error


def test_a_full_disk_of_a_worker_is_no_scheduler_that_went_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "_of_scheduler", lambda address: nullcontext())
    with pytest.raises(OSError, match="No space"), cluster.connected(THERE, 1):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("error", [RuntimeError("Nanny failed to start."), TimeoutError()])
def test_a_worker_that_dies_while_it_starts_is_one_line(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(**_: object) -> None:
        raise error

    monkeypatch.setattr(distributed, "LocalCluster", fail)
    with pytest.raises(InputError, match="run the same command again"), cluster.connected(Where(workers=2), 2):
        pass


def told_by(threads: str, **versions: str) -> Any:
    ours, names = cluster._about()
    theirs = {**ours, **versions}, dict.fromkeys(names, threads)
    return SimpleNamespace(run=lambda about: {"tcp://10.0.0.7:1234": theirs})


def test_workers_with_other_packages_or_threads_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in cluster.THREAD_VARIABLES:
        monkeypatch.setenv(name, "1")
    cluster._require_alike(told_by("1"), "tcp://a:1")
    with pytest.raises(InputError, match=r"^tcp://10\.0\.0\.7:1234: .*numpy 1\.0"):
        cluster._require_alike(told_by("1", numpy="1.0"), "tcp://a:1")
    with pytest.raises(InputError, match=r"OMP_NUM_THREADS=1 OPENBLAS"):
        cluster._require_alike(told_by("unset"), "tcp://a:1")


def test_a_machine_is_shared_where_two_tasks_run_at_a_time() -> None:
    def cluster_of(**threads: int) -> Any:
        return SimpleNamespace(nthreads=lambda: {f"tcp://{name.replace('_', ':')}": n for name, n in threads.items()})

    assert not cluster.is_shared(cluster_of())
    assert not cluster.is_shared(cluster_of(a_1=1))
    assert not cluster.is_shared(cluster_of(a_1=1, b_1=1))
    assert cluster.is_shared(cluster_of(a_1=1, b_1=1, a_2=1))
    assert cluster.is_shared(cluster_of(a_1=2))
    assert cluster.n_slots(cluster_of(a_1=2, b_1=1)) == 3


@pytest.mark.parametrize("name", ["objects", "merge-noise", "merge-gates"])  # oracles, an early end
def test_a_task_is_the_same_after_its_way_through_json(tmp_path: Path, name: str) -> None:
    plan = plan_of(name)
    plan = plan.model_copy(update={"seeds": plan.seeds[:1]})
    for pair in schedule_pairs(RunFolder(tmp_path), plan, expand_cells(plan), False, Tools()):
        task = Task(tmp_path, "token", pair, Made("commit"))
        came = TypeAdapter(Task).validate_json(task.as_json())
        assert came.as_json() == task.as_json()
        assert _unfit(replace(came, token="")) == ""
        assert asdict(came) == asdict(task)


@pytest.mark.usefixtures("copies")
def test_dry_run_lists_the_cells_and_writes_nothing(
    tmp_path: Path, plan: Plan, command: Callable[..., tuple[int, str, str]]
) -> None:
    argv = ("run", tmp_path / "plan.yaml", "--out", tmp_path / "run", "--dry-run")
    named = [f"smoke/one_box {seed} {variant}" for seed in (20000, 20001, 20002) for variant in (FIRST, SECOND)]

    def listing(*states: str) -> list[str]:
        return [f"{state:<8}  {name}" for state, name in zip(states, named, strict=True)]

    code, out, err = command(*argv, "--limit", "4")
    assert (code, err) == (0, "")
    total = f"{tmp_path / 'run'}: 6 cells: 0 finished, 4 to do, 2 left by --limit; nothing was run"
    assert out.splitlines() == [*listing(*["to do"] * 4, *["left"] * 2), total]
    assert not (tmp_path / "run").exists()
    run, _ = run_in(tmp_path / "run", plan, Where(), limit=3)
    files = {path: path.stat().st_mtime_ns for path in run.path.rglob("*")}
    out = command(*argv)[1]
    total = f"{tmp_path / 'run'}: 6 cells: 3 finished, 3 to do; nothing was run"
    assert out.splitlines() == [*listing(*["finished"] * 3, *["to do"] * 3), total]
    assert command(*argv, "--force")[1].splitlines()[:6] == listing(*["to do"] * 6)
    assert files == {path: path.stat().st_mtime_ns for path in run.path.rglob("*")}


def test_dry_run_refuses_what_a_run_would(tmp_path: Path, command: Callable[..., tuple[int, str, str]]) -> None:
    (tmp_path / "mine").touch()
    for folder in (tmp_path, tmp_path / "mine"):
        code, out, err = command("run", "smoke", "--out", folder, "--dry-run")
        assert (code, out) == (2, "") and err.startswith(f"error: {folder}: ")


@pytest.mark.usefixtures("copies")
def test_a_full_disk_leaves_nothing_half_written(
    tmp_path: Path, plan: Plan, monkeypatch: pytest.MonkeyPatch, command: Callable[..., tuple[int, str, str]]
) -> None:
    usual, asked = pair_run.write_answer, []

    def full(folder: Path, variant: str, *rest: Any) -> None:
        asked.append(variant)
        usual(folder, variant, *rest)
        if len(asked) == 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(pair_run, "write_answer", full)
    run = RunFolder(tmp_path / "run")
    argv = ("run", tmp_path / "plan.yaml", "--out", run.path, "--quiet")
    folder = run.answer("smoke/one_box", 20000, SECOND)
    told = f"error: {folder}: No space left on device: give it a disk with room and leave to write\n"
    assert command(*argv) == (2, "", told)
    assert run.cell("smoke/one_box", 20000, FIRST).is_file() and not folder.exists()
    assert hidden(run) == []
    assert command(*argv)[0] == 0
    assert asked == [FIRST, SECOND, SECOND, FIRST, SECOND, FIRST, SECOND]


def test_a_file_that_cannot_be_written_leaves_no_part_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, text: str) -> None:
        path.touch()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match="No space"):
        write_json(tmp_path / "cell.json", {})
    assert list(tmp_path.iterdir()) == []


def task_of(folder: Path, plan: Plan, **changes: Any) -> Task:
    """Make the task of the first pair of a plan, in a folder whose token it knows."""
    folder.mkdir(exist_ok=True)
    (folder / ".workers").write_text("token")
    pair = schedule_pairs(RunFolder(folder), plan, expand_cells(plan), False, Tools())[0]
    return replace(Task(folder, "token", pair, Made("commit", is_contended=True)), **changes)


@pytest.mark.usefixtures("copies")
def test_a_worker_that_cannot_do_what_its_client_would_says_why(tmp_path: Path, plan: Plan) -> None:
    task = task_of(tmp_path / "run", plan)
    stale = replace(task.pair, todo=tuple(replace(each, key="other") for each in task.pair.todo))
    for changed, told in (
        (replace(task, folder=tmp_path / "absent"), "does not see it: workers need the same folder"),
        (replace(task, token="of a later run"), "does not see it"),
        (replace(task, pair=stale), "has other files, weights, extras or metrics"),
        (replace(task, metrics_version=-1), "has other files, weights, extras or metrics"),
    ):
        assert told in work_on(changed.as_json())
        assert [path.name for path in (tmp_path / "run").rglob("*")] == [".workers"]
    assert work_on(task.as_json()) == ""
    cell = RunFolder(task.folder).read_cell(RunFolder(task.folder).cell("smoke/one_box", 20000, FIRST))
    assert cell is not None
    assert (cell["row"]["status"], cell["row"]["commit"], cell["row"]["is_contended"]) == ("ok", "commit", True)


@pytest.mark.usefixtures("copies")
@pytest.mark.parametrize("place", ["cell", "pair"])
def test_what_was_begun_too_often_is_not_begun_again(tmp_path: Path, plan: Plan, place: str) -> None:
    task = task_of(tmp_path / "run", plan)
    run = RunFolder(task.folder)
    first = run.cell("smoke/one_box", 20000, FIRST)
    traces = {
        "cell": first.with_name(f".{first.stem}.begun"),
        "pair": run.pair("smoke/one_box", 20000).with_name(".20000.begun"),
    }
    traces[place].parent.mkdir(parents=True)
    traces[place].write_text("6")
    assert work_on(task.as_json()) == ""
    rows = [json.loads(run.cell("smoke/one_box", 20000, name).read_text())["row"] for name in (FIRST, SECOND)]
    assert [row["status"] for row in rows] == ["worker_died", "ok" if place == "cell" else "worker_died"]
    assert re.fullmatch("its worker died 6 times (during it|while its pair was made)", rows[0]["error"])
    # what an earlier run left behind counts no more
    traces[place].write_text("3")
    remove_traces(run)
    assert hidden(run) == []


@pytest.mark.usefixtures("copies")
@pytest.mark.parametrize("place", ["cells/world/20000/.paper.begun", "pairs/world/.20000.begun"])
def test_no_trace_is_left_of_a_worker_that_dies_as_soon_as_its_cell_is_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    run = start_run_folder(tmp_path / "run")
    trace = run.path / place

    def finish(_: object) -> None:
        trace.parent.mkdir(parents=True)
        trace.write_text("1")

    monkeypatch.setattr(run_workers._Dispatch, "run", finish)
    run_workers.run_on_workers(None, run, [], Made(None), Silent())
    assert not [path for path in run.path.rglob("*") if path.is_file()]


def test_a_run_that_is_stopped_ends_after_the_cell_in_flight(
    tmp_path: Path, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = task_of(tmp_path / "run", plan)
    usual = pair_run._answer

    def answer(*what: Any) -> None:
        usual(*what)
        remove_traces(RunFolder(task.folder))  # as another run does that takes the folder

    monkeypatch.setattr(pair_run, "_answer", answer)
    assert work_on(task.as_json()) == "the run was stopped"
    assert [path.name.partition(".")[0] for path in task.folder.glob("cells/*/*/*.json")] == [path_part(FIRST)]


def test_lines_tell_the_pace_and_the_time_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = iter([100.0, 100.0, 160.0, 160.0, 280.0, 280.0])
    monkeypatch.setattr(progress.time, "perf_counter", lambda: next(clock))
    lines = Lines("cells")
    # 10 of 40 were done when it began: 6 more in a minute, 8 in three
    for done, total in ((10, 40), (16, 40), (16, 40), (18, 18)):
        lines.cells("narrow 7", done, total)
    told = ["[10/40] narrow 7", "[16/40] narrow 7; 6 cells/min, 4 min 00 s left", "[18/18] narrow 7; 2.67 cells/min"]
    assert capsys.readouterr().err.splitlines() == told


PROGRAM = """
import json, os, psutil, sys
from eval.core import cluster

if __name__ == "__main__":
    with cluster.connected(cluster.Where(workers=2), 2) as client:
        own = [psutil.Process(), *psutil.Process().children(recursive=True)]
        pids, listed = {each.pid for each in own}, psutil.net_connections("inet")
        hosts = {each.laddr.ip for each in listed if each.pid in pids and each.status == "LISTEN"}
        scratch = client.run(lambda dask_worker: dask_worker.local_directory)
        top = {os.path.dirname(os.path.dirname(folder)) for folder in scratch.values()}
        modes = [os.stat(folder).st_mode & 0o777 for folder in top]
        told = {"hosts": sorted(hosts), "modes": modes, "folders": sorted(top), "n_processes": len(own)}
        names = ("MALLOC_TRIM_THRESHOLD_", "OMP_NUM_THREADS")
        print(json.dumps(told | {name: [*client.run(os.environ.get, name).values()] for name in names}))
"""


@pytest.fixture(scope="module", name="told")
def told_fixture(environment: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What workers of this machine tell; they start in a folder with modules that nobody should import."""
    folder = tmp_path_factory.mktemp("program")
    hostile, program = folder / "hostile", folder / "bin" / "program"
    hostile.mkdir()
    for name in ("json", "pickle", "multiprocessing", "cdpipe"):
        (hostile / f"{name}.py").write_text("from pathlib import Path\nPath('run').touch()\n")
    program.parent.mkdir()
    program.write_text(PROGRAM)
    unset = ("MALLOC_TRIM_THRESHOLD_", *cluster.THREAD_VARIABLES)
    plain = {name: value for name, value in environment.items() if name not in unset}
    done = subprocess.run([sys.executable, str(program)], cwd=hostile, env=plain, check=True, capture_output=True)
    return {**json.loads(done.stdout), "is_hostile_run": (hostile / "run").exists()}


def test_workers_of_this_machine_let_nobody_in(told: dict[str, Any]) -> None:
    assert told["n_processes"] > 2
    assert told["hosts"] == ["127.0.0.1"]
    assert told["modes"] == [0o700]
    assert not any(Path(folder).exists() for folder in told["folders"])
    assert not told["is_hostile_run"]


def test_workers_of_this_machine_keep_freed_memory_and_one_thread(told: dict[str, Any]) -> None:
    assert told["MALLOC_TRIM_THRESHOLD_"] == [None, None]
    assert told["OMP_NUM_THREADS"] == ["1", "1"]
