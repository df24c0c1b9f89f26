"""What hides one of our packages is named, from the program's first moment on."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cdpipe.core.program import find_hiding

ROOT = Path(__file__).parents[3]
PROGRAM = "from cdpipe.core.program import main\nmain()\n"


def call(*path: Path) -> tuple[int, str, str]:
    """Run `tunnelcd --version` with folders on PYTHONPATH."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path))}
    words = [sys.executable, "-P", "-c", PROGRAM, "--version"]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("name", ["eval", "sim", "scenarios"])
def test_a_package_of_the_same_name_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    (tmp_path / name / "__init__.py").write_text("raise RuntimeError('imported')\n")
    code, out, err = call(tmp_path, ROOT)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"error: {tmp_path / name / '__init__.py'}: hides the package {name} of tunnelcd")
    assert call(ROOT, tmp_path)[0] == 0


def test_a_module_hides_and_a_folder_without_code_does_not(tmp_path: Path) -> None:
    (tmp_path / "eval").mkdir()
    (tmp_path / "eval" / "notes.txt").write_text("x")
    assert call(tmp_path, ROOT)[0] == 0
    (tmp_path / "sim.py").write_text("")
    assert f"{tmp_path / 'sim.py'}: hides the package sim" in call(tmp_path, ROOT)[2]


def test_nothing_hides_our_own() -> None:
    assert [find_hiding(name) for name in ("eval", "scenarios", "sim", "nobody_has_this")] == [""] * 4


@pytest.mark.parametrize("content", [b"font.size: 60\ntext.usetex: True\n", b"\xff\n", None])
def test_a_file_in_the_working_folder_sets_no_charts(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "matplotlibrc").write_bytes(content)
    elif sys.platform == "win32":
        pytest.skip("has no pipes in folders")
    else:
        os.mkfifo(tmp_path / "matplotlibrc")
    told = "import matplotlib as m, os; print(m.rcParams['text.usetex'], m.rcParams['font.size'], os.getcwd())"
    words = [sys.executable, "-P", "-c", f"from cdpipe.core.program import *\nimport_charts()\n{told}"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=60)
    assert (done.stdout, done.stderr) == (f"False 10.0 {tmp_path}\n", "")


@pytest.mark.skipif(sys.platform == "win32", reason="needs a shell that closes streams")
@pytest.mark.parametrize(
    ("words", "closed"),
    [("list sensors --out x.json", ">&-"), ("list sensors --out x.json", ">&- 2>&- <&-"), ("check smok", "2>&-")],
)
def test_a_closed_stream_leads_nowhere(tmp_path: Path, words: str, closed: str) -> None:
    command = ["/bin/sh", "-c", f'exec "$0" -c "$1" {words} {closed}', sys.executable, PROGRAM]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (2 if words.startswith("check") else 0, "", "")
    assert words.startswith("check") or (tmp_path / "x.json").read_text().startswith("[")
