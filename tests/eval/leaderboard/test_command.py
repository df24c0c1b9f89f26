"""The command of a method: what is refused before anything runs, and every way to end."""

from __future__ import annotations

import hashlib
import sys
import time
from pathlib import Path

import pytest

from cdpipe.core.errors import InputError
from eval.leaderboard.command import STDERR_BYTES, digest_programs, parse_command, run_command

WHOLE = "{before} {after} {out}"


@pytest.mark.parametrize(
    ("text", "gets_merge", "said"),
    [
        ("", False, "is empty"),
        ("python 'x", False, "No closing quotation"),
        (f"no-such-program-1 {WHOLE}", False, "no such program"),
        (f"{sys.executable} x\udcff {WHOLE}", False, r"x\udcff is not UTF-8"),
        ("python x.py {before} {after}", False, "{out} is missing"),
        ("python x.py {befor} {after} {out}", False, 'did you mean "before"'),
        (f"python x.py {WHOLE} {{merge}}", False, "needs --merge given"),
        (f"python x.py {WHOLE}", True, "{merge} is missing"),
    ],
)
def test_a_command_that_cannot_work_is_refused(text: str, gets_merge: bool, said: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_command(text, gets_merge=gets_merge)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_script_that_is_not_there_is_refused_before_a_pair_is_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("predict.py").write_text("pass")
    for words in ("predit.py", "-u predit.py", "-B -u predit.py"):
        with pytest.raises(InputError, match=r'predit\.py: no such file in .*; did you mean "predict\.py"'):
            parse_command(f"{sys.executable} {words} {WHOLE}", gets_merge=False)
    for words in ("-u predict.py", "predict.py", "-m predit.py", "{out}/later.py", "-c pass predit.py"):
        assert parse_command(f"{sys.executable} {words} {WHOLE}", gets_merge=False)


def test_words_that_name_files_become_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("x.py").write_text("pass")
    words = parse_command(f"{sys.executable} x.py y.py 0.3 '{{\"a\": 1}}' {WHOLE}", gets_merge=False)
    assert words == (
        sys.executable, str(tmp_path / "x.py"), "y.py", "0.3", '{"a": 1}', "{before}", "{after}", "{out}"
    )  # fmt: skip
    assert list(digest_programs(words)) == [sys.executable, str(tmp_path / "x.py")]


def test_a_word_that_is_too_long_for_a_name_of_a_file_is_none() -> None:
    for long in (f"{'x' * 300}.y", f"{'x/' * 3000}y"):
        words = parse_command(f"{sys.executable} -c pass {long} {WHOLE}", gets_merge=False)
        assert words[3] == long and list(digest_programs(words)) == [sys.executable]
    for long in (f"{'x' * 300}.py", f"{'x' * 300}/y.py"):
        with pytest.raises(InputError, match="no such file"):
            parse_command(f"{sys.executable} {long} {WHOLE}", gets_merge=False)


def test_a_program_that_is_named_by_its_file_is_noticed_when_it_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    program = tmp_path / "m.py"
    program.write_text("#!/usr/bin/env python\n")
    program.chmod(0o700)
    words = parse_command(f"./m.py {WHOLE}", gets_merge=False)
    assert digest_programs(words) == {str(program): hashlib.sha256(program.read_bytes()).hexdigest()}
    (tmp_path / "python").write_text("not the one of the PATH")
    assert digest_programs(("python", "{out}")) == {}


def test_words_without_a_dot_or_slash_and_options_with_a_path_stay_as_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # EVALUATE.md says so: `train` may be a command beside a folder of that name
    monkeypatch.chdir(tmp_path)
    (tmp_path / "weights").mkdir()
    words = parse_command(f"{sys.executable} weights ./weights --w=./weights {WHOLE}", gets_merge=False)
    assert words[1:4] == ("weights", str(tmp_path / "weights"), "--w=./weights")


def run(code: str, folder: Path, limit_s: float = 60.0, *more: str) -> tuple[str, str, float]:
    words = (sys.executable, "-c", code, "{out}", *more)
    ended = run_command(words, {"out": folder / "o"}, folder, limit_s)
    return ended.error, ended.stderr, ended.seconds


def test_it_runs_in_its_folder_with_its_words(tmp_path: Path) -> None:
    code = "import os, sys, pathlib; pathlib.Path('here').write_text(' '.join(sys.argv[1:]))"
    assert run(code, tmp_path, 60.0, "{other}", "x={out}")[0] == ""
    assert (tmp_path / "here").read_text() == f"{tmp_path / 'o'} {{other}} x={tmp_path / 'o'}"


def test_a_crash_names_its_last_line_and_keeps_the_end_of_standard_error(tmp_path: Path) -> None:
    code = f"import sys; sys.stderr.write('x' * {3 * STDERR_BYTES}); sys.stderr.write('\\n'); 1 / 0"
    error, stderr, _ = run(code, tmp_path)
    assert error == "the command ended with exit code 1: ZeroDivisionError: division by zero"
    assert len(stderr) == STDERR_BYTES and stderr.startswith("xx")


def test_a_signal_and_a_program_that_cannot_start_are_errors(tmp_path: Path) -> None:
    assert run("import os; os.kill(os.getpid(), 9)", tmp_path)[0] == "the command ended with signal 9"
    ended = run_command((str(tmp_path),), {}, tmp_path, 1.0)
    assert ended.error.startswith("the command could not be started")


def test_at_its_time_limit_a_command_ends_with_all_that_it_started(tmp_path: Path) -> None:
    child = f"import time, pathlib; time.sleep(2.5); pathlib.Path({str(tmp_path / 'late')!r}).touch()"
    code = f"import subprocess, sys, time; subprocess.Popen([sys.executable, '-c', {child!r}]); time.sleep(60)"
    error, _, seconds = run(code, tmp_path, 1.0)
    assert error == "the command took longer than 1 s"
    assert seconds >= 1.0
    time.sleep(2.0)
    assert not (tmp_path / "late").exists()
