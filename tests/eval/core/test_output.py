import errno
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.whole_file import whole_file
from eval.core.output import copy_folder, make_writable, new_files, new_folder, unwritable


def tree(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_a_folder_appears_whole(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    with new_folder(out) as partial:
        (partial / "file").write_text("x")
        assert not out.exists()
    assert tree(tmp_path) == ["a", "a/b", "a/b/file"]


def test_an_empty_folder_may_be_there(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    with new_folder(out) as partial:
        (partial / "file").write_text("x")
    assert tree(tmp_path) == ["out", "out/file"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_nothing_is_left_when_the_block_fails(tmp_path: Path, error: type[BaseException]) -> None:
    with pytest.raises(error), new_folder(tmp_path / "a" / "b") as partial:
        (partial / "file").write_text("x")
        raise error
    assert tree(tmp_path) == []


def test_a_mistake_within_names_the_output_and_not_its_hidden_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError) as error, new_folder(tmp_path / "out") as partial:
        raise InputError(f"{partial / 'a.html'}: no room")
    assert str(error.value) == f"{tmp_path / 'out' / 'a.html'}: no room"
    with pytest.raises(InputError) as error, new_files(tmp_path / "a.yaml", tmp_path / "a.png") as partial:
        raise InputError(f"{partial / 'a.png'}: no room")
    assert str(error.value) == f"{tmp_path / 'a.png'}: no room"


def test_what_a_killed_run_left_does_not_get_into_the_next(tmp_path: Path) -> None:
    (tmp_path / ".out.partial").mkdir()
    (tmp_path / ".out.partial" / "old").write_text("x")
    with new_folder(tmp_path / "out") as partial:
        assert tree(partial) == []
    assert tree(tmp_path) == ["out"]


no_locks = pytest.mark.skipif(sys.platform == "win32", reason="there are no such locks")


@no_locks
@pytest.mark.parametrize("write", [new_folder, new_files])
def test_a_second_writer_is_refused_and_takes_nothing_from_the_first(
    tmp_path: Path, write: Callable[[Path], AbstractContextManager[Path]]
) -> None:
    out = tmp_path / "out"
    with write(out) as partial:
        (partial / "out").write_text("first")
        for other in (new_folder, new_files):
            with pytest.raises(InputError, match=r"out: another `tunnelcd` writes there"), other(out):
                pass
        assert (partial / "out").read_text() == "first"
    assert tree(tmp_path) == ["out", "out/out"] if write is new_folder else ["out"]


@no_locks
def test_what_a_living_process_writes_stays_and_what_a_killed_one_left_goes(tmp_path: Path) -> None:
    told = "from pathlib import Path; from eval.core.output import new_folder\n"
    told += "with new_folder(Path('out')) as partial: (partial / 'old').touch(); print('begun', flush=True); input()"
    begin = [sys.executable, "-c", told]
    with subprocess.Popen(begin, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None and other.stdout.readline() == b"begun\n"
        with pytest.raises(InputError, match="another `tunnelcd` writes there"), new_folder(tmp_path / "out"):
            pass
        assert tree(tmp_path) == [".out.partial", ".out.partial/old"]
        other.kill()
    assert tree(tmp_path) == [".out.partial", ".out.partial/old"]
    with new_folder(tmp_path / "out") as partial:
        assert tree(partial) == []
    assert tree(tmp_path) == ["out"]


def test_a_link_under_the_hidden_name_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "note").write_text("x")
    (tmp_path / ".out.partial").symlink_to("mine")
    with pytest.raises(InputError, match="cannot write there"), new_folder(tmp_path / "out"):
        pass
    assert tree(tmp_path) == [".out.partial", "mine", "mine/note"]


@pytest.mark.skipif(sys.platform == "win32", reason="folders have no number of their owner there")
def test_a_hidden_folder_of_another_user_is_not_written_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (hidden := tmp_path / ".out.partial").mkdir()
    (hidden / "own").write_text("x")
    monkeypatch.setattr(os, "geteuid", lambda: hidden.stat().st_uid + 1)
    with pytest.raises(InputError, match="out: cannot write there"), new_folder(tmp_path / "out"):
        pass
    assert tree(tmp_path) == [".out.partial", ".out.partial/own"]


@pytest.mark.parametrize("write", [new_folder, new_files])
def test_an_output_that_others_made_meanwhile_stays(
    tmp_path: Path, write: Callable[[Path], AbstractContextManager[Path]]
) -> None:
    with pytest.raises(InputError, match=r"out: cannot write there"), write(tmp_path / "out") as partial:
        (partial / "out").write_text("x")
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "mine").write_text("x")
    assert tree(tmp_path) == ["out", "out/mine"]


@pytest.mark.parametrize("write", [new_folder, new_files, whole_file])
def test_a_full_disk_without_a_name_is_that_of_the_output(
    tmp_path: Path, write: Callable[[Path], AbstractContextManager[Path]]
) -> None:
    with pytest.raises(OSError, match="No space left") as caught, write(tmp_path / "out"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert caught.value.filename == str(tmp_path / "out")


def test_a_folder_with_something_in_it_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("x")
    with pytest.raises(InputError, match="is not empty: name a new or empty folder"), new_folder(tmp_path):
        pass
    assert tree(tmp_path) == ["mine"]


def test_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="is a file"), new_folder(tmp_path / "file"):
        pass
    for place in (tmp_path / "file" / "below", tmp_path / "file" / "far" / "below"):
        with pytest.raises(InputError, match="cannot write there"), new_folder(place):
            pass
        with pytest.raises(InputError, match="cannot write there"):
            make_writable(place)
    assert tree(tmp_path) == ["file"]


def test_where_nobody_may_write(tmp_path: Path) -> None:
    # not even root can make a folder in /proc; elsewhere the test above has covered the branch
    if not Path("/proc/self").exists():
        pytest.skip("needs /proc")
    with pytest.raises(InputError, match="name a folder you may write to"), new_folder(Path("/proc/self/out")):
        pass


LONGEST = 255  # bytes of a name that file systems take


@pytest.mark.parametrize("name", ["x" * LONGEST, "ü" * (LONGEST // 2)])
def test_every_name_that_the_file_system_takes_can_be_written(tmp_path: Path, name: str) -> None:
    with new_folder(tmp_path / "a" / name) as partial:
        (partial / "file").write_text("x")
    with whole_file(tmp_path / "b" / name) as partial:
        partial.write_text("x")
    with new_files(tmp_path / "c" / name) as partial:
        (partial / name).write_text("x")
    assert tree(tmp_path) == ["a", f"a/{name}", f"a/{name}/file", "b", f"b/{name}", "c", f"c/{name}"]


@pytest.mark.parametrize("name", ["x" * 300, f"{'x' * 300}/y", f"y/{'x' * 300}"])
def test_longer_names_are_refused_on_one_line(tmp_path: Path, name: str) -> None:
    for write in (new_folder, new_files):
        with pytest.raises(InputError, match="File name too long"), write(tmp_path / name):
            pass
    assert tree(tmp_path) == []


def test_a_folder_is_no_name_of_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(IsADirectoryError), whole_file(Path()) as partial:
        partial.write_text("x")
    assert tree(tmp_path) == [] and not list(tmp_path.parent.glob(".*.partial"))


def test_a_folder_is_copied_until_a_file_cannot_be(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        (tmp_path / "old" / "deep").mkdir(parents=True, exist_ok=True)
        (tmp_path / "old" / "deep" / name).write_text(name)
    tried: list[str] = []

    def copy(source: str, target: str) -> None:
        tried.append(target)
        if len(tried) > 1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), target)
        shutil.copyfile(source, target)

    # shutil.copytree goes on with the other files, and its error has no number
    with pytest.raises(OSError, match="No space left") as caught:
        copy_folder(tmp_path / "old", tmp_path / "new", copy)
    assert caught.value.errno == errno.ENOSPC and len(tried) == 2
    shutil.rmtree(tmp_path / "new")
    copy_folder(tmp_path / "old", tmp_path / "new")
    assert tree(tmp_path / "new") == tree(tmp_path / "old")


@pytest.mark.parametrize("write", [new_folder, new_files])
def test_nothing_is_left_when_the_start_is_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Callable[[Path], AbstractContextManager[Path]]
) -> None:
    make = Path.mkdir

    def make_and_interrupt(path: Path, *args: Any, **options: Any) -> None:
        make(path, *args, **options)
        if path.name.endswith(".partial"):
            raise KeyboardInterrupt

    monkeypatch.setattr(Path, "mkdir", make_and_interrupt)
    with pytest.raises(KeyboardInterrupt), write(tmp_path / "a" / "b"):
        pass
    assert tree(tmp_path) == []


@pytest.mark.skipif(sys.platform == "win32", reason="there are no pipes in folders")
@pytest.mark.parametrize("is_linked", [False, True])
def test_a_device_or_a_pipe_is_not_replaced(is_linked: bool, tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    os.mkfifo(tmp_path / "pipe")
    if is_linked:
        path.symlink_to("pipe")
    else:
        path = tmp_path / "pipe"
    with pytest.raises(InputError, match="a device or a pipe: name a file"), whole_file(path) as partial:
        partial.write_text("{}")
    assert path.is_fifo() and path.is_symlink() == is_linked
    assert {each.name for each in tmp_path.iterdir()} == {"pipe", path.name}


@pytest.mark.skipif(os.name != "posix", reason="locks of POSIX")
def test_a_file_that_another_writes_is_told_as_such(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    with whole_file(path), pytest.raises(BlockingIOError) as blocked, whole_file(path):
        pytest.fail("both write")
    said = f"{path}: another `tunnelcd` writes there: wait until it ends, or name another"
    assert str(unwritable(path, blocked.value)) == said
