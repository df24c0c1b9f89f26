"""Files that are whole or absent, also where two write one at the same time."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from cdpipe.core.whole_file import whole_file

Link = Callable[[Path, Path], None]
WRITER = """import sys
from pathlib import Path
from cdpipe.core.whole_file import whole_file
with whole_file(Path(sys.argv[1])) as partial, partial.open("w") as file:
    file.write("half"); file.flush()
    print("there", flush=True)
    sys.stdin.readline()
    file.write(" and whole")
"""


@pytest.mark.skipif(os.name != "posix", reason="locks of POSIX")
def test_a_file_that_another_process_writes_is_refused_and_stays_whole(tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    argv = [sys.executable, "-c", WRITER, str(path)]
    root = Path(__file__).parents[4]
    with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=root) as other:
        assert other.stdout is not None and other.stdout.readline() == "there\n"
        with pytest.raises(BlockingIOError, match="another `tunnelcd` writes there") as refused, whole_file(path):
            pytest.fail("both write")
        assert refused.value.filename == str(path) and not path.exists()
        other.communicate("go on\n", timeout=20)
    assert path.read_text() == "half and whole"
    assert [file.name for file in tmp_path.iterdir()] == ["x.txt"]


@pytest.mark.skipif(os.name != "posix", reason="links of POSIX")
@pytest.mark.parametrize("link", [os.link, os.symlink])
def test_what_a_killed_writer_left_is_replaced_and_what_it_leads_to_stays(tmp_path: Path, link: Link) -> None:
    precious, path = tmp_path / "precious", tmp_path / "x.txt"
    precious.write_text("mine")
    link(precious, tmp_path / ".x.txt.partial")
    with whole_file(path) as partial:
        partial.write_text("new")
    assert (precious.read_text(), path.read_text()) == ("mine", "new")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["precious", "x.txt"]


@pytest.mark.skipif(os.name != "posix", reason="locks of POSIX")
def test_a_network_disk_that_locks_only_what_may_be_written_keeps_two_apart_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fcntl = pytest.importorskip("fcntl")
    flock = fcntl.flock

    def flock_of_nfs(handle: int, how: int) -> None:
        if fcntl.fcntl(handle, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        flock(handle, how)

    monkeypatch.setattr(fcntl, "flock", flock_of_nfs)
    path = tmp_path / "x.txt"
    with whole_file(path) as partial:
        partial.write_text("first")
        with pytest.raises(BlockingIOError, match="another `tunnelcd` writes there"), whole_file(path):
            pytest.fail("both write")
    assert path.read_text() == "first"
