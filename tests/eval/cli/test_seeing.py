"""An answer as its user sees it: `detect` in the terminal and as a page, and `view BEFORE AFTER ANSWER`."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from cdpipe.io.answer import read_answer
from eval.core.terminal.progress import Lines
from scenarios import load_scenario
from scenarios.schema import Scenario

Command = Callable[..., tuple[int, str, str]]
FINE = ("--preset", "voxel-diff", "--set", "regions.min_points=8", "--set", "query.threshold=0")
SMALL = ("sensor.mode=512x10", "platform.scan_spacing_m=1.0")
ROOT = Path(__file__).parents[3]
SENTENCE = re.compile(r"\d+ added.*; \d+ m compared, \d+ m not seen")


@pytest.fixture(scope="module")
def pair(simulated_once: Callable[[Scenario, int], Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = simulated_once(load_scenario("smoke/one_box", 20000, SMALL), 20000)
    pair = tmp_path_factory.mktemp("seen") / "p"
    shutil.copytree(made, pair)
    return pair


@pytest.fixture(scope="module")
def answer(pair: Path) -> tuple[Path, str, str]:
    """The folder of an answer with its page, and what `detect` printed in the folder of the pair."""
    words = ["detect", "before", "after", *FINE, "--html", "--out", "answer"]
    program = [sys.executable, "-c", "from eval.cli.main import main; main()", *words]
    places = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(program, cwd=pair, env=places, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return pair / "answer", done.stdout, done.stderr


@pytest.fixture(autouse=True)
def in_the_folder_of_the_pair(pair: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(pair)


def test_detect_fits_a_terminal_and_ends_with_the_sentence(
    answer: tuple[Path, str, str], tmp_path: Path, command: Command
) -> None:
    out, printed, err = answer
    lines = printed.splitlines()
    assert max(map(len, lines)) <= 80
    assert SENTENCE.fullmatch(lines[-1])
    stages = re.findall(r"(\w+(?: \w+)*) [\d.]+ s", " ".join(lines).partition("times: ")[2])
    assert stages == ["descriptors", "indexing", "merge", "refinement", "regions", "objects", "of it returns"]
    report = read_answer(out).report
    assert report is not None
    assert lines[-1].startswith(f"{len(report.objects)} added")
    # a log gets a line a stage, without its steps
    assert [line for line in err.splitlines() if line.startswith("  map")] == ["  map before", "  map after"]
    page = (out / "answer.html").read_text()
    assert lines[-1] in page and (out / "answer.html").stat().st_size < 5_000_000
    # the page stands beside an answer that is otherwise the same
    assert command("detect", "before", "after", *FINE, "--quiet", "--out", tmp_path / "b") == (0, "", "")
    assert {path.name for path in out.iterdir()} - {path.name for path in (tmp_path / "b").iterdir()} == {"answer.html"}
    assert (out / "answer.npz").stat().st_size == (tmp_path / "b" / "answer.npz").stat().st_size


def test_view_writes_the_page_of_a_stored_answer(
    answer: tuple[Path, str, str], tmp_path: Path, command: Command
) -> None:
    out, printed, _ = answer
    file = tmp_path / "x.html"
    code, told, _ = command("view", "before", "after", out, "--html", file)
    assert code == 0
    assert told.splitlines()[-1] == printed.splitlines()[-1]
    assert file.read_bytes() == (out / "answer.html").read_bytes()
    assert command("view", "before", "after", out, "--html", file, "--quiet") == (0, "", "")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["before", "after"], "two sessions without an answer"),
        (["{answer}"], "an answer, without its sessions"),
        (["before", "{answer}"], "an answer, no session: name the session before, the one after and then the answer"),
        (["after", "before", "{answer}"], "is it an answer to this pair"),
        (["before", "absent", "{answer}"], "absent: no such file or folder"),
        (["before", "after", "absent"], "absent/answer.json: missing"),
        (["before", "after", "{answer}", "--seed", "3"], "leave --seed and --world out"),
        (["before", "after", "{answer}", "--html", "none/x.html"], "there is no folder none"),
    ],
)
def test_what_cannot_be_viewed_is_said_in_one_line(
    answer: tuple[Path, str, str], command: Command, words: list[str], told: str
) -> None:
    given = [word.format(answer=answer[0]) for word in words]
    code, out, err = command("view", *given, *([] if "--html" in given else ["--html", "x.html"]))
    errors = [line for line in err.splitlines() if line.startswith("error: ")]
    assert (code, out, len(errors)) == (2, "", 1)
    assert told in errors[0]
    assert not Path("x.html").exists()


def test_an_answer_is_shown_by_the_viewer(
    answer: tuple[Path, str, str], command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser")

    def interrupted(_seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(time, "sleep", interrupted)
    code, out, _ = command("view", "before", "after", answer[0], "--port", "0")
    assert code == 0
    assert re.search(r"http://localhost:\d+ \(Ctrl-C ends\)\n$", out)


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_the_viewer_says_that_a_signal_ended_it(
    answer: tuple[Path, str, str], command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser")
    monkeypatch.setattr(time, "sleep", lambda _: signal.raise_signal(signal.SIGTERM))
    code, _, err = command("view", "before", "after", answer[0], "--port", "0", "--quiet")
    assert (code, err) == (143, "interrupted by SIGTERM; nothing half-written is left\n")


def test_a_log_tells_each_stage_once(capsys: pytest.CaptureFixture[str]) -> None:
    lines = Lines()
    for name, done in (("map before", 0), ("map before: pass 1", 0), ("map before: pass 1", 5), ("merge", 0)):
        lines.stage(name, done, 5)
    assert capsys.readouterr().err == "  map before\n  merge\n"
