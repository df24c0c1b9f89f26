"""The templates: written once, and they answer with nothing where nothing changed."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from eval.leaderboard.templates import write_template

Command = Callable[..., tuple[int, str, str]]
ROOT = Path(__file__).parents[3]


def test_a_file_that_is_there_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, _ = command("template", "predict.py")
    assert code == 0 and '"python predict.py {before} {after} {out}"' in out
    Path("predict.py").write_text("mine")
    code, out, err = command("template", "predict.py", "--merge", "given")
    assert (code, out) == (2, "") and err.count("\n") == 1 and "exists already" in err
    assert Path("predict.py").read_text() == "mine"
    code, out, _ = command("template", "new/my method.py", "--merge", "given")
    assert code == 0 and "'new/my method.py' {before} {after} {out} {merge}\" --merge given" in out
    assert "{merge}" not in Path("new/my method.py").read_text()  # it is a script, not a pattern


@pytest.mark.parametrize("merge", ["own", "given"])
def test_nothing_new_is_an_answer_without_regions(
    tmp_path: Path, tiny_pair: Path, merge: str, command: Command
) -> None:
    """Both sessions are one: no point of the second is new."""
    write_template(tmp_path / "predict.py", merge)  # type: ignore[arg-type]
    for name in ("before", "after"):
        shutil.copytree(tiny_pair / "before", tmp_path / "same" / name)
    (tmp_path / "merge.json").write_text(
        '{"format": "tunnelcd-merge", "format_version": 1, "source": "truth", '
        f'"before_T_after": {np.eye(4).tolist()}, "anchors_odom": [[0, 0, 0]], '
        f'"before_T_after_at_anchors": {[np.eye(4).tolist()]}}}'
    )
    (tmp_path / "out").mkdir()
    argv = [tmp_path / "same" / "before", tmp_path / "same" / "after", tmp_path / "out", tmp_path / "merge.json"]
    done = subprocess.run(
        [sys.executable, "-W", "error", tmp_path / "predict.py", *argv], cwd=tmp_path, env={"PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "out" / "answer.npz") as arrays:
        assert len(arrays["region_centres_map"]) == 0 and arrays["object_point_odom_offsets"].tolist() == [0]
    assert command("score", tiny_pair, tmp_path / "out")[0] == 0
