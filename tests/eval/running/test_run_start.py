"""What a run tells before it begins: missing extras, workers that would idle, schedulers that do not answer."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from cdpipe.core.errors import InputError
from cdpipe.methods.registry import Method
from eval.cli.commands.tools import check_file
from eval.core import cluster
from eval.core.cluster import Where, exposure, require_reachable
from eval.core.output import only_writer, removed_if_empty
from eval.core.terminal.progress import Lines, Silent
from eval.plans.plan import Plan, load_plan
from eval.running import runner
from eval.running.pair_run import Tools
from eval.running.runfolder import start_run_folder
from eval.running.runner import run_plan

Command = Callable[..., tuple[int, str, str]]


def plan_of(folder: Path, variants: str, seeds: str = "[10600]") -> Plan:
    path = folder / "plan.yaml"
    path.write_text(f"name: test\nscenarios: [smoke/one_box]\nseeds: {seeds}\nvariants: [{variants}]\n")
    return load_plan(str(path))


def forbidden(*_: object, **__: object) -> None:
    raise AssertionError("nothing must be made")


def test_missing_extras_are_named_all_at_once_before_anything_is_made(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cdpipe.core.plugins.find_spec", lambda name: None)
    monkeypatch.setattr(runner, "TOOLS", Tools(simulate=forbidden))
    plan_of(tmp_path, "{preset: voxel-diff}, {preset: m3c2}, {preset: dufomap}, {preset: m3c2, set: [map.voxel_m=0.3]}")
    code, out, err = command("run", tmp_path / "plan.yaml", "--out", tmp_path / "run")
    assert (code, out) == (2, "")
    assert err.splitlines() == [
        f"error: regions.source = {name} needs a package more: pip install 'tunnelcd[{name}]'"
        for name in ("m3c2", "dufomap")
    ]
    assert not (tmp_path / "run").exists()
    # the first cell alone needs neither, and a list of cells needs nothing
    with pytest.raises(AssertionError, match="nothing must be made"):
        command("run", tmp_path / "plan.yaml", "--out", tmp_path / "run", "--limit", 1)
    assert command("run", tmp_path / "plan.yaml", "--out", tmp_path / "list", "--dry-run")[0] == 0


def test_words_that_are_not_utf8_are_refused_before_anything_is_made(tmp_path: Path) -> None:
    run = start_run_folder(tmp_path / "run")
    plan = plan_of(tmp_path, "{preset: voxel-diff}")
    with pytest.raises(InputError, match=r"provenance\.json: cannot hold .*x\\udcff.*, which is not UTF-8"):
        run_plan(plan, run, command=("tunnelcd", "run", "x\udcff"), tools=Tools(simulate=forbidden))
    assert not any(run.path.iterdir())


def test_regions_from_the_truth_need_a_source_that_does_not_cut_out_itself(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = Method(detect=forbidden, propose=None, uses_descriptors=False, has_clusters=False)
    monkeypatch.setattr(runner, "load_source", lambda config: whole)
    plan_of(tmp_path, "{preset: tunnelcd}, {preset: tunnelcd, oracle_regions: true}")
    code, _, err = command("run", tmp_path / "plan.yaml", "--out", tmp_path / "run")
    (line,) = err.splitlines()
    assert (code, line.startswith("error: oracle-regions: regions.source = sphere finds regions and objects at")) == (
        2,
        True,
    )
    assert not (tmp_path / "run").exists()


class Noted(Silent):
    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)


@pytest.mark.parametrize(
    ("workers", "seeds", "words"),
    [
        (3, "[10600]", "--workers 3: 1 pair "),
        (3, "[10600, 10601]", "--workers 3: 2 pairs "),
        (2, "[10600, 10601]", ""),
        (None, "[10600]", ""),
    ],
)
def test_workers_that_would_idle_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, workers: int | None, seeds: str, words: str
) -> None:
    def stopped(*_: object) -> Any:
        raise InputError("far enough")

    monkeypatch.setattr(cluster.importlib.util, "find_spec", lambda name: object())  # as if the extra were there
    monkeypatch.setattr(runner, "connected", stopped)
    monkeypatch.setattr(runner, "_run_here", stopped)
    progress, plan = Noted(), plan_of(tmp_path, "{preset: voxel-diff}, {preset: c2c}", seeds)
    with pytest.raises(InputError, match="far enough"):
        run_plan(plan, start_run_folder(tmp_path / "run"), where=Where(workers), progress=progress)
    assert len(progress.notes) == bool(words)
    assert not words or words in progress.notes[0]


def test_a_note_is_a_line_of_a_log(capsys: pytest.CaptureFixture[str]) -> None:
    Lines().note("something")
    assert capsys.readouterr().err == "note: something\n"


def test_what_accepts_and_does_not_speak_is_no_scheduler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "_PROBE_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as mute:
        address = f"tcp://127.0.0.1:{mute.getsockname()[1]}"
        start = time.monotonic()
        with pytest.raises(InputError, match=rf"--scheduler {address}: cannot be reached \(timed out\)"):
            require_reachable(Where(scheduler=address))
        assert 0.4 < time.monotonic() - start < 5
    require_reachable(Where(workers=2))


@pytest.mark.parametrize(
    ("address", "is_told"),
    [
        ("tcp://127.0.0.1:8786", False), ("tcp://[::1]:8786", False), ("tcp://localhost:8786", False),
        ("tls://10.0.0.7:8786", False), ("tcp://10.0.0.7:8786", True), ("tcp://node:8786", True),
        ("10.0.0.7:8786", True), ("tcp://[::2]:8786", True), ("tcp://[:8786", True), (None, False),
    ],
)  # fmt: skip
def test_a_scheduler_that_other_machines_reach_without_a_certificate_is_told(
    address: str | None, is_told: bool
) -> None:
    assert ("can run code" in exposure(Where(scheduler=address))) == is_told


def test_the_warning_is_one_line_before_the_run_also_with_quiet(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object) -> None:
        raise InputError("far enough")

    monkeypatch.setattr(cluster, "_probe", lambda address: None)
    monkeypatch.setattr(runner, "connected", stopped)
    argv = ("run", "smoke", "--scheduler", "tcp://10.0.0.7:8786", "--quiet", "--out", tmp_path / "run")
    warning, error = command(*argv)[2].splitlines()
    assert warning == f"warning: {exposure(Where(scheduler='tcp://10.0.0.7:8786'))}"
    assert error == "error: far enough"


def test_a_scheduler_is_knocked_at_before_anything_is_loaded(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(runner, "run_plan", forbidden)
    code, _, err = command("run", "smoke", "--scheduler", "tcp://127.0.0.1:9", "--out", tmp_path / "run")
    assert code == 2 and "cannot be reached" in err


def test_an_unknown_name_is_checked_with_a_suggestion() -> None:
    with pytest.raises(InputError, match=r'tunelcd: .*"tunnelcd"'):
        check_file("tunelcd")
    with pytest.raises(InputError, match="see `list`"):
        check_file("zzzzz")


@pytest.mark.skipif(os.name != "posix", reason="locks of POSIX")
def test_a_run_folder_that_another_command_writes_is_refused(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "TOOLS", Tools(simulate=forbidden))
    plan_of(tmp_path, "{preset: voxel-diff}")
    run = tmp_path / "run"
    said = f"error: {run}: another `tunnelcd` writes there: wait until it ends, or name another\n"
    asked = ("--plan", tmp_path / "plan.yaml", "--command", "true {before} {after} {out}", "--as", "mine", "--out", run)
    with removed_if_empty(run):
        run.mkdir()
        with only_writer(run):
            for words in (("run", tmp_path / "plan.yaml", "--out", run), ("evaluate", *asked)):
                code, _, err = command(*words)
                assert code == 2 and err.endswith(said)  # after a warning of `evaluate`
                assert run.is_dir() and not any(run.iterdir())


def test_a_new_folder_that_another_command_has_taken_meanwhile_stays(tmp_path: Path) -> None:
    path = tmp_path / "run"
    with ExitStack() as other:
        with pytest.raises(InputError, match="another"), removed_if_empty(path):
            path.mkdir()
            other.enter_context(only_writer(path))
            raise InputError("another writes there")
        assert path.is_dir()
    with pytest.raises(InputError, match=r"cannot write there \(No such file"), only_writer(tmp_path / "gone"):
        pytest.fail("it is gone")
