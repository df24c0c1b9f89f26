"""Functions in processes of their own: what they return, raise and die of, and what such a process does not run."""

import errno
import math
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from cdpipe.core.errors import InputError, MergeFailedError, ScenarioError, TunnelcdError
from cdpipe.core.isolation import ProcessDiedError, run_isolated

ROOT, HERE = Path(__file__).parents[3], Path(__file__).parent
ERRORS: dict[str, Exception] = {
    "input": InputError("two lines\nof it"),
    "scenario": ScenarioError("no room"),
    "merge": MergeFailedError("too little", {"overlap": 0.1}),
    "disk": OSError(errno.ENOSPC, "No space left on device", Path("/full/answer.npz")),
    "bug": ZeroDivisionError("a bug"),
}


def echo(document: Any) -> Any:
    sys.stdout.write("what a library prints is no answer")
    os.write(1, b"nor is this")
    return document


def fail(what: str) -> None:
    raise ERRORS[what]


def end(code: int) -> None:
    os._exit(code)


def kill(number: int) -> None:
    os.kill(os.getpid(), number)


def answer_with_no_json(_: None) -> set[int]:
    return {1}


def wait_after_telling_its_number(file: str) -> None:
    Path(file).write_text(str(os.getpid()))
    time.sleep(60)


@pytest.fixture(autouse=True)
def _importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a new process find this module under the name that it has here."""
    monkeypatch.syspath_prepend(HERE)
    for function in (echo, fail, end, kill, answer_with_no_json, wait_after_telling_its_number):
        monkeypatch.setattr(function, "__module__", Path(__file__).stem)


def test_a_document_comes_back_as_it_went() -> None:
    document = {"text": "ä\n\u2028", "numbers": [1, 0.1, 1e300, -0.0, math.inf], "none": None, "long": "x" * 200_000}
    assert run_isolated(echo, document) == document
    assert math.isnan(run_isolated(echo, math.nan))


@pytest.mark.parametrize(
    ("what", "kind"), [("input", InputError), ("scenario", ScenarioError), ("merge", TunnelcdError)]
)
def test_an_error_of_the_input_is_raised_as_what_it_is(what: str, kind: type[Exception]) -> None:
    with pytest.raises(TunnelcdError) as caught:
        run_isolated(fail, what)
    assert (type(caught.value), str(caught.value)) == (kind, str(ERRORS[what]))


def test_an_error_of_the_disk_keeps_its_number_and_its_file() -> None:
    with pytest.raises(OSError, match="No space") as caught:
        run_isolated(fail, "disk")
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, "/full/answer.npz")


def test_a_bug_is_a_bug_here_too(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RuntimeError, match=r"^ZeroDivisionError: a bug$"):
        run_isolated(fail, "bug")
    assert "in fail" in capfd.readouterr().err
    with pytest.raises(RuntimeError, match=r"TypeError: .* not JSON serializable"):
        run_isolated(answer_with_no_json, None)


def test_what_ends_a_process_is_told() -> None:
    with pytest.raises(ProcessDiedError, match=r"^exit code 3$"):
        run_isolated(end, 3)
    with pytest.raises(ProcessDiedError, match=r"^signal 9$"):
        run_isolated(kill, 9)


CALLER = """\
from cdpipe.core.isolation import run_isolated
from test_isolation import {name}
{name}.__module__ = "test_isolation"
run_isolated({name}, "{document}")
"""


def caller(folder: Path, name: str, document: object) -> list[str]:
    """Return a command that is started as the installed `tunnelcd` is: the working folder is not on its path."""
    program = folder / "bin" / "program"
    program.parent.mkdir()
    program.write_text(CALLER.format(name=name, document=document))
    return [sys.executable, str(program)]


def test_what_lies_in_the_working_folder_is_not_run(tmp_path: Path) -> None:
    argv, hostile = caller(tmp_path, "echo", "all"), tmp_path / "hostile"
    hostile.mkdir()
    for name in ("json", "threading", "cdpipe", "sitecustomize"):
        (hostile / f"{name}.py").write_text("from pathlib import Path\nPath('run').touch()\n")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(ROOT), str(HERE)))}
    subprocess.run(argv, cwd=hostile, env=environment, check=True)
    assert not (hostile / "run").exists()


def test_the_mark_of_an_editable_installation_is_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mark = "__editable__.tunnelcd-0.3.0.finder.__path_hook__"  # as setuptools puts on the path
    (tmp_path / mark).mkdir()
    (tmp_path / mark / "json.py").write_text("from pathlib import Path\nPath('run').touch()\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [mark, *sys.path])
    assert run_isolated(echo, "all") == "all"
    assert not (tmp_path / "run").exists()


def test_a_process_ends_with_the_one_that_started_it(tmp_path: Path) -> None:
    told = tmp_path / "pid"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(ROOT), str(HERE)))}
    with subprocess.Popen(caller(tmp_path, "wait_after_telling_its_number", told), env=environment) as parent:
        start = time.monotonic()
        while not (told.is_file() and told.read_text()):
            assert time.monotonic() - start < 30
            time.sleep(0.02)
        parent.kill()
    while (
        Path(f"/proc/{told.read_text()}/cmdline").is_file() and Path(f"/proc/{told.read_text()}/cmdline").read_bytes()
    ):
        assert time.monotonic() - start < 30
        time.sleep(0.02)
