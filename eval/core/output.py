"""Output files and folders that are complete or absent."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from cdpipe.core.errors import InputError
from cdpipe.core.names import visible
from cdpipe.core.whole_file import partial_of

if sys.platform != "win32":
    import fcntl

_HEAD_BYTES = 1024


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield a hidden empty folder that becomes `path` when the block succeeds, and is removed when it fails.

    Raises:
        InputError: `path` is a file or a folder with something in it, or cannot be made.
    """
    made: list[Path] = []
    partial: Path | None = None
    try:
        # a link to an empty folder, or to none yet, is that folder
        path = Path(os.path.realpath(path)) if path.is_symlink() else path.absolute()
        if path.is_symlink():
            raise InputError(f"{path}: is a link that leads to itself: name a folder you may write to")
        hidden = partial_of(path)
        made = _missing_parents(path)
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            what = "is not empty" if path.is_dir() else "is a file"
            raise InputError(f"{path}: {what}: name a new or empty folder for the output")
        partial = hidden
        _start(partial)
        if path.exists():
            _write_nothing(path)
    except BaseException as error:
        _clear(partial, made)
        if isinstance(error, OSError):
            raise unwritable(path, error) from error
        raise
    try:
        yield partial
        if path.exists():
            path.rmdir()
        partial.replace(path)
    except BaseException as error:
        _clear(partial, made)
        _name_output(error, partial, path)
        raise


@contextmanager
def new_files(*paths: Path) -> Iterator[Path]:
    """Yield a hidden empty folder whose files of these names become `paths` when the block succeeds.

    The folder is removed. When the block fails, nothing else is left either.

    Raises:
        InputError: A path exists, or they cannot be made. They lie in one folder.
    """
    for path in paths:
        try:
            is_there = path.exists() or path.is_symlink()
        except OSError as error:
            raise unwritable(path, error) from error
        if is_there:
            raise InputError(f"{path} exists already: name a new file or remove it")
    first = paths[0].absolute()
    with made_parents(first):
        partial: Path | None = None
        try:
            try:
                partial = partial_of(first)
                _start(partial)
            except OSError as error:
                raise unwritable(first, error) from error
            yield partial
            for path in paths:
                (partial / path.name).replace(path)
        except InputError as error:
            _name_output(error, partial, first.parent)
            raise
        finally:
            _clear(partial, [])


@contextmanager
def made_parents(path: Path) -> Iterator[None]:
    """Make the folders above `path`; when the block fails, remove those that are empty.

    Raises:
        InputError: They cannot be made.
    """
    made: list[Path] = []
    try:
        made = _missing_parents(path.absolute())
        path.absolute().parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        _remove_empty(made)
        raise unwritable(path, error) from error
    try:
        yield
    except BaseException:
        _remove_empty(made)
        raise


def make_writable(path: Path) -> None:
    """Make a folder unless it exists, and check that files can be written in it.

    Raises:
        InputError: The path is a file, or nothing can be written there.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        _write_nothing(path)
    except OSError as error:
        raise unwritable(path, error) from error


@contextmanager
def only_writer(folder: Path, command: str) -> Iterator[None]:
    """Hold a folder against other processes that ask for it; the system lets it go when this process dies.

    Raises:
        InputError: Another process holds it.
    """
    if sys.platform == "win32":
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(handle)
        raise InputError(f"{folder}: another `{command}` writes there: wait until it ends, or name another") from error
    except OSError:
        pass  # some network disks hold no locks
    try:
        yield
    finally:
        os.close(handle)


def copy_folder(source: Path, target: Path, copy: Callable[[str, str], object] = shutil.copy2) -> None:
    """Copy a folder with all that is in it, to a new folder or into one that is there.

    Args:
        source: The folder.
        target: Where to; the folder above it exists.
        copy: Copies or links one file.

    Raises:
        OSError: The first file that cannot be copied, with its number. `shutil.copytree` would go on after it.
    """

    def copy_or_end(file: str, place: str) -> None:
        try:
            copy(file, place)
        except OSError as error:
            raise _EndedError from error

    try:
        shutil.copytree(source, target, copy_function=copy_or_end, dirs_exist_ok=True)
    except _EndedError as end:
        assert isinstance(end.__cause__, OSError)
        raise end.__cause__ from None


class _EndedError(Exception):
    """A copy of a folder ended; the cause is why."""


def require_no_links(folder: Path) -> None:
    """Refuse a folder with a link in it: what is written, replaced or removed below the folder would lie elsewhere.

    Raises:
        InputError: It holds a link, at any depth.
    """
    for parent, folders, files in os.walk(folder):
        for name in (*folders, *files):
            if (path := Path(parent, name)).is_symlink():
                raise InputError(
                    f"{visible(str(path))}: is a link, and nothing outside of {folder} may be written or removed: "
                    "put the file or folder itself there"
                )


def require_replaceable(path: Path, mark: bytes, what: str) -> None:
    """Refuse a file that exists and is not what the caller wrote there earlier: it would be lost.

    Args:
        path: The output.
        mark: What stands within the first kilobyte of each such file.
        what: What such a file is, for the message: "page of `tunnelcd leaderboard`".

    Raises:
        InputError: It is another's, or cannot be looked at.
    """
    try:
        if not path.exists():
            return
        if path.is_file():
            with path.open("rb") as file:
                if mark in file.read(_HEAD_BYTES):
                    return
    except OSError as error:
        raise unwritable(path, error) from error
    raise InputError(f"{path}: exists, and is no {what}: name a new file, or remove it")


def remove(path: Path) -> None:
    """Remove a file, a folder, or a link but not what it leads to, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _name_output(error: BaseException, partial: Path | None, path: Path) -> None:
    """Let the line of a mistake name the output, and not the hidden folder in which it was begun."""
    if partial is None:
        return
    if isinstance(error, InputError):
        error.args = tuple(str(told).replace(str(partial), str(path)) for told in error.args)
    elif isinstance(error, OSError):
        for name in ("filename", "filename2"):
            if isinstance(told := getattr(error, name), str):
                setattr(error, name, told.replace(str(partial), str(path)))


def unwritable(path: Path, error: OSError) -> InputError:
    """Return the error that says why an output folder cannot be used."""
    return InputError(f"{path}: cannot write there ({error.strerror}): name a folder you may write to")


def _start(partial: Path) -> None:
    """Make an empty hidden folder in place of what a killed command left there, and the folders above it."""
    partial.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()


def _clear(partial: Path | None, made: list[Path]) -> None:
    """Remove a hidden folder, and the folders that were made above it."""
    if partial is not None:
        shutil.rmtree(partial, ignore_errors=True)
    _remove_empty(made)


def _write_nothing(folder: Path) -> None:
    """Make a file without a name in a folder, which shows that it can be written."""
    with tempfile.TemporaryFile(dir=folder):
        pass


def _missing_parents(path: Path) -> list[Path]:
    """Return the ancestors that do not exist, deepest first."""
    return [parent for parent in path.parents if not parent.exists()]


def _remove_empty(folders: list[Path]) -> None:
    for folder in folders:
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
