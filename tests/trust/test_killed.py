"""The short form of `make soak`: a run that is killed, one without room for its files, and commands that are killed."""

from __future__ import annotations

import random
import shutil
import sys
from pathlib import Path

import pytest

if sys.platform == "win32":
    pytest.skip("needs SIGKILL and limits of processes", allow_module_level=True)
pytest.importorskip("distributed", reason="the extra `cluster` is not installed")

from tests.soak.comparing import compare_runs
from tests.soak.soak import Size, Soak, disks
from tests.trust.contents import find_damaged

KILLED, LIMITED = "kill of a run without workers", "no file larger than a random size (RLIMIT_FSIZE)"


@pytest.fixture(scope="module", name="soak")
def soak_fixture(tmp_path_factory: pytest.TempPathFactory) -> Soak:
    size = Size(["smoke/one_box"], n_seeds=1, presets=["voxel-diff", "random-regions"], has_page=False)
    soak = Soak(tmp_path_factory.mktemp("soak") / "here", random.Random(5), size)
    soak.run_undisturbed()
    return soak


def test_a_run_that_is_killed_and_one_without_room_lose_nothing(soak: Soak, capsys: pytest.CaptureFixture[str]) -> None:
    soak.disturb_run(KILLED, 3)
    disks()[LIMITED](soak, LIMITED)
    assert soak.is_clean(), capsys.readouterr().err
    assert soak.tallies[KILLED].times >= 1 and soak.tallies[LIMITED].times >= 1


def test_the_soak_sees_what_is_lost_doubled_changed_and_left(soak: Soak, tmp_path: Path) -> None:
    usual, run = soak.usual / "run" / "run", tmp_path / "run"
    shutil.copytree(usual, run)
    assert not any(compare_runs(usual, run).values()) and not list(find_damaged(tmp_path))
    _, second = (usual / "results.csv").read_text().splitlines()[1:]
    changed = second.replace(",ok,", ",failed,")
    assert changed != second
    heading = (usual / "results.csv").read_text().splitlines()[0]
    (run / "results.csv").write_text("\n".join([heading, changed, changed]) + "\n")
    (run / ".results.csv.partial").touch()
    cell = next(run.glob("cells/*/*/*.json"))
    cell.write_text(cell.read_text()[:-1])
    found = compare_runs(usual, run)
    assert {name: len(what) for name, what in found.items()} == {
        "lost": 1, "doubled": 1, "differ": 1, "half_written": 1
    }  # fmt: skip
    # cut short as well, but no reader takes an answer without its answer.json
    answer = next(run.glob("answers/*/*/*/answer.npz"))
    answer.write_bytes(answer.read_bytes()[:-40])
    answer.with_suffix(".json").unlink()
    assert [str(cell) in line for line in find_damaged(tmp_path)] == [True]
