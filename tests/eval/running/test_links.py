"""Links inside of an output folder: nothing outside of it is written or removed."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.whole_file import whole_file
from cdpipe.descriptors.describe import save_descriptors
from cdpipe.model.config import MapConfig
from cdpipe.model.types import DescriptorSet
from eval.core.output import make_writable, new_folder, remove
from eval.report.page import write_page
from eval.running.runfolder import open_run_folder, start_run_folder, write_json
from eval.truth.ground_truth import load_ground_truth
from scenarios.catalogue import read_prop


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    folder = tmp_path / "outside"
    (folder / "3" / "ours").mkdir(parents=True)
    (folder / "3" / "ours" / "answer.json").write_text("precious")
    return folder


@pytest.mark.parametrize("place", ["answers", "answers/world", "pairs/world", "stages/world/3/x", "index.html"])
@pytest.mark.parametrize("opened", [start_run_folder, open_run_folder, write_page])
def test_a_run_folder_with_a_link_is_refused(
    tmp_path: Path, outside: Path, place: str, opened: Callable[[Path], object]
) -> None:
    write_json(tmp_path / "run" / "provenance.json", {"tool": "tunnelcd"})
    link = tmp_path / "run" / place
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(outside)
    with pytest.raises(InputError, match=rf"{place}: is a link, and nothing outside of .*: put the"):
        opened(tmp_path / "run")
    assert (outside / "3" / "ours" / "answer.json").read_text() == "precious"


@pytest.mark.skipif(sys.platform == "win32", reason="has no pipes in folders")
@pytest.mark.parametrize("opened", [start_run_folder, open_run_folder, write_page])
def test_a_run_folder_with_a_pipe_is_refused(tmp_path: Path, opened: Callable[[Path], object]) -> None:
    write_json(tmp_path / "run" / "provenance.json", {"tool": "tunnelcd"})
    (lock := tmp_path / "run" / "pairs" / "world" / ".3.lock").parent.mkdir(parents=True)
    os.mkfifo(lock)  # `run` and `evaluate` opened it and waited
    with pytest.raises(InputError, match=r"\.3\.lock: is a pipe, a socket or a device: remove it"):
        opened(tmp_path / "run")


def test_the_run_folder_itself_may_be_a_link(tmp_path: Path) -> None:
    write_json(tmp_path / "run" / "provenance.json", {"tool": "tunnelcd"})
    (tmp_path / "link").symlink_to(tmp_path / "run")
    assert start_run_folder(tmp_path / "link").provenance() == {"tool": "tunnelcd"}


def test_links_in_a_circle_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Callable[..., tuple[int, str, str]]
) -> None:
    loop = tmp_path / "loop.yaml"
    loop.symlink_to(loop)
    code, _, err = command("run", "smoke", "--preset", loop, "--out", tmp_path / "run")
    assert code == 2 and len(err.splitlines()) == 1 and str(loop) in err
    prop = tmp_path / "props" / "own_crate.yaml"
    prop.parent.mkdir()
    prop.write_text("mesh: {path: ../loop.yaml}\n")
    monkeypatch.setenv("TUNNELCD_PATH", str(tmp_path))
    assert read_prop("own_crate").mesh.path == str(loop)


def test_a_link_is_removed_and_not_what_it_leads_to(tmp_path: Path, outside: Path) -> None:
    for target in (outside, outside / "3" / "ours" / "answer.json", tmp_path / "nowhere"):
        link = tmp_path / "link"
        link.symlink_to(target)
        remove(link)
        assert not link.is_symlink()
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "link").symlink_to(outside)
    remove(tmp_path / "folder")
    assert (outside / "3" / "ours" / "answer.json").read_text() == "precious"


def test_a_link_in_the_place_of_an_unfinished_file_is_not_followed(tmp_path: Path, outside: Path) -> None:
    precious = outside / "3" / "ours" / "answer.json"
    (tmp_path / ".table.csv.partial").symlink_to(precious)
    (tmp_path / "table.csv").symlink_to(precious)
    with whole_file(tmp_path / "table.csv") as partial:
        partial.write_text("new")
    assert (tmp_path / "table.csv").read_text() == "new" and precious.read_text() == "precious"


def test_looking_whether_a_folder_can_be_written_follows_no_link(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".tunnelcd.partial").symlink_to(tmp_path / "made")
    make_writable(tmp_path / "out")
    assert not (tmp_path / "made").exists() and (tmp_path / "out" / ".tunnelcd.partial").is_symlink()


@pytest.mark.parametrize("is_there", [True, False])
def test_a_link_to_an_empty_folder_or_to_none_is_that_folder(tmp_path: Path, *, is_there: bool) -> None:
    if is_there:
        (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    with new_folder(tmp_path / "link") as partial:
        (partial / "file").write_text("x")
    assert (tmp_path / "real" / "file").read_text() == "x" and (tmp_path / "link").is_symlink()


def test_a_link_to_itself_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(InputError, match=r"loop: is a link that leads to itself"), new_folder(tmp_path / "loop"):
        pass


def test_the_cache_of_scoring_is_not_written_through_a_link(tmp_path: Path, tiny_pair: Path) -> None:
    pair = tmp_path / "linked"
    pair.mkdir()
    (pair / "truth").mkdir()
    shutil.copytree(tiny_pair / "truth", pair / "truth", dirs_exist_ok=True)
    for name in ("before", "after"):
        (pair / name).symlink_to(tiny_pair / name)
    assert len(load_ground_truth(pair).after.scoring_points)
    assert not (tiny_pair / "after" / "truth" / "scoring_points.npz").exists()
    assert len(load_ground_truth(tiny_pair).after.scoring_points)
    assert (tiny_pair / "after" / "truth" / "scoring_points.npz").is_file()


def test_descriptors_are_not_written_through_a_link(tmp_path: Path, outside: Path) -> None:
    precious = outside / "3" / "ours" / "answer.json"
    descriptors = DescriptorSet(np.zeros((1, 2), np.float32), None, np.zeros(1, np.int64), "x", "")
    (tmp_path / "session" / "descriptors").mkdir(parents=True)
    (tmp_path / "session" / "descriptors" / "x.partial.npz").symlink_to(precious)
    save_descriptors(tmp_path / "session", descriptors, np.eye(4)[None], MapConfig())
    assert precious.read_text() == "precious"
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "descriptors").symlink_to(outside)
    with pytest.raises(InputError, match="descriptors: is a link"):
        save_descriptors(tmp_path / "other", descriptors, np.eye(4)[None], MapConfig())
    assert [path.name for path in outside.iterdir()] == ["3"]
