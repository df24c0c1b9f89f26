"""Output files and folders that are complete or absent."""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from cdpipe.core.errors import InputError
from cdpipe.core.names import visible
from cdpipe.core.whole_file import hidden_folder, hold, name_full_disk

_HEAD_BYTES = 1024


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield a hidden empty folder that becomes `path` when the block succeeds, and is removed when it fails.

    Raises:
        InputError: `path` is a file or a folder with something in it, cannot be made, or is being written by another.
    """
    made: list[Path] = []
    try:
        with ExitStack() as stack:
            with _told_as(path):
                # a link to an empty folder, or to none yet, is that folder
                home = Path(os.path.realpath(path)) if path.is_symlink() else path.absolute()
                if home.is_symlink():
                    raise InputError(f"{path}: is a link that leads to itself: name a folder you may write to")
                made = _missing_parents(home)
                _require_empty(home, path)
                partial = stack.enter_context(hidden_folder(home, path))
                _require_empty(home, path)  # another may have written it until now
                if home.exists():
                    _write_nothing(home)
            with _naming(path, partial):
                yield partial
            with _told_as(path):
                if home.exists():
                    home.rmdir()
                partial.replace(home)
    except BaseException:
        _remove_empty(made)
        raise


@contextmanager
def new_files(*paths: Path) -> Iterator[Path]:
    """Yield a hidden empty folder whose files of these names become `paths` when the block succeeds.

    The folder is removed. When the block fails, nothing else is left either.

    Raises:
        InputError: A path exists, or they cannot be made, or are being written by another. They lie in one folder.
    """
    _require_new(paths)
    first = paths[0].absolute()
    with made_parents(first), ExitStack() as stack:
        with _told_as(first):
            partial = stack.enter_context(hidden_folder(first, paths[0]))
        _require_new(paths)
        with _naming(first.parent if len(paths) > 1 else first, partial, first.parent):
            yield partial
        with _told_as(first):
            for path in paths:
                (partial / path.name).replace(path)


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
def removed_if_empty(path: Path) -> Iterator[None]:
    """Remove a new folder where the block fails before it writes anything, unless another process holds it."""
    was_there = path.exists()
    try:
        yield
    except BaseException:
        if not was_there and path.is_dir():
            with suppress(InputError), only_writer(path):
                if not any(path.iterdir()):
                    path.rmdir()
        raise


@contextmanager
def only_writer(folder: Path, command: str = "tunnelcd") -> Iterator[None]:
    """Hold a folder against other processes that ask for it; the system lets it go when this process dies.

    Raises:
        InputError: Another process holds it, or it is gone.
    """
    try:
        handle = hold(folder)
    except BlockingIOError as error:
        raise InputError(f"{folder}: another `{command}` writes there: wait until it ends, or name another") from error
    except OSError as error:
        raise unwritable(folder, error) from error
    try:
        yield
    finally:
        if handle is not None:
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

    A pipe, a socket or a device is refused as well: whoever opens it may wait for ever.

    Raises:
        InputError: It holds one of them, at any depth.
    """
    for parent, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(parent, name)
            try:
                mode = path.lstat().st_mode
            except (FileNotFoundError, NotADirectoryError):  # removed meanwhile by another process
                continue
            if stat.S_ISLNK(mode):
                raise InputError(
                    f"{visible(str(path))}: is a link, and nothing outside of {folder} may be written or removed: "
                    "put the file or folder itself there"
                )
            if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
                raise InputError(f"{visible(str(path))}: is a pipe, a socket or a device: remove it")


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


@contextmanager
def _naming(path: Path, partial: Path, folder: Path | None = None) -> Iterator[None]:
    """Let the line of a mistake of the block name the output, and not the hidden folder in which it was begun.

    Args:
        path: The output, for a full disk of which the system tells no name.
        partial: The hidden folder.
        folder: What its files will lie in; left out: `path`.
    """
    home = str(folder or path)
    try:
        yield
    except InputError as error:
        error.args = tuple(str(told).replace(str(partial), home) for told in error.args)
        raise
    except OSError as error:
        for name in ("filename", "filename2"):
            if isinstance(told := getattr(error, name), str):
                setattr(error, name, told.replace(str(partial), home))
        name_full_disk(error, path)
        raise


@contextmanager
def _told_as(path: Path) -> Iterator[None]:
    """Turn what the system refuses in the block into one line about the output."""
    try:
        yield
    except OSError as error:
        raise unwritable(path, error) from error


def _require_empty(home: Path, path: Path) -> None:
    if home.exists() and (not home.is_dir() or any(home.iterdir())):
        what = "is not empty" if home.is_dir() else "is a file"
        raise InputError(f"{path}: {what}: name a new or empty folder for the output")


def _require_new(paths: Sequence[Path]) -> None:
    for path in paths:
        with _told_as(path):
            is_there = path.exists() or path.is_symlink()
        if is_there:
            raise InputError(f"{path} exists already: name a new file or remove it")


def unwritable(path: Path, error: OSError) -> InputError:
    """Return the error that says why an output cannot be written; the path may be a file."""
    if isinstance(error, BlockingIOError):
        return InputError(f"{path}: another `tunnelcd` writes there: wait until it ends, or name another")
    return InputError(f"{path}: cannot write there ({error.strerror}): name a folder you may write to")


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
