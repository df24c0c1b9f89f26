"""A disk that does not take what a command writes is the input's fault: one line, exit 2."""

import errno
import os

import pytest

from eval.core.terminal.exits import input_errors


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EFBIG, errno.EACCES])
def test_the_disk_is_named_in_one_line(number: int, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught, input_errors():
        raise OSError(number, os.strerror(number), "run/results.csv")
    assert caught.value.code == 2
    told = capsys.readouterr().err
    assert told.startswith(f"error: run/results.csv: {os.strerror(number)}: ")
    assert told.count("\n") == 1
    with pytest.raises(SystemExit), input_errors():
        raise OSError(number, os.strerror(number))
    assert capsys.readouterr().err.startswith(f"error: the output: {os.strerror(number)}: ")


def test_a_name_that_no_file_can_have_is_told_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for number in (errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EISDIR, errno.ENOTEMPTY):
        with pytest.raises(SystemExit) as caught, input_errors():
            raise OSError(number, os.strerror(number), "a/b")
        assert caught.value.code == 2
        told = capsys.readouterr().err
        assert told.startswith(f"error: a/b: {os.strerror(number)}: ") and told.count("\n") == 1


@pytest.mark.parametrize("number", [errno.EIO, errno.ESTALE])
def test_a_disk_that_fails_is_told_in_one_line(number: int, capsys: pytest.CaptureFixture[str]) -> None:
    for name, called in (("a/b", "a/b"), (None, "a file")):
        with pytest.raises(SystemExit) as caught, input_errors():
            raise OSError(number, os.strerror(number), name)
        told = capsys.readouterr().err
        assert caught.value.code == 2 and told.startswith(f"error: {called}: {os.strerror(number)}: ")
        assert told.count("\n") == 1


def test_memory_that_runs_out_is_told_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for error in (MemoryError(), MemoryError("Unable to allocate 33.1 TiB\nfor an array")):
        with pytest.raises(SystemExit) as caught, input_errors():
            raise error
        assert caught.value.code == 2
        told = capsys.readouterr().err
        assert told.startswith("error: more memory is needed than there is (") and told.count("\n") == 1


def test_any_other_error_of_the_system_is_a_bug() -> None:
    with pytest.raises(ConnectionResetError), input_errors():
        raise ConnectionResetError(errno.ECONNRESET, "reset")
    with pytest.raises(FileNotFoundError), input_errors():  # of a file of ours, it would be a defect
        raise FileNotFoundError(errno.ENOENT, "missing", "page.html")
