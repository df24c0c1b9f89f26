"""Output files and folders that are complete or absent."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cdpipe.core.errors import InputError


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield a hidden empty folder that becomes `path` when the block succeeds, and is removed when it fails.

    Raises:
        InputError: `path` is a file or a folder with something in it, or cannot be made.
    """
    path = path.absolute()
    partial = path.with_name(f".{path.name}.partial")
    made = _missing_parents(path)
    try:
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            what = "is not empty" if path.is_dir() else "is a file"
            raise InputError(f"{path}: {what}: name a new or empty folder for the output")
        partial.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        if path.exists():
            probe = path / partial.name
            probe.touch()
            probe.unlink()
    except OSError as error:
        _remove_empty(made)
        raise unwritable(path, error) from error
    try:
        yield partial
        if path.exists():
            path.rmdir()
        partial.replace(path)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        _remove_empty(made)
        raise


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a hidden path that becomes `path` when the block succeeds, and is removed when it fails."""
    partial = path.with_name(f".{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def made_parents(path: Path) -> Iterator[None]:
    """Make the folders above `path`; when the block fails, remove those that are empty.

    Raises:
        InputError: They cannot be made.
    """
    made = _missing_parents(path.absolute())
    try:
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
    probe = path / ".tunnelcd.partial"
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise unwritable(path, error) from error


def unwritable(path: Path, error: OSError) -> InputError:
    """Return the error that says why an output folder cannot be used."""
    return InputError(f"{path}: cannot write there ({error.strerror}): name a folder you may write to")


def _missing_parents(path: Path) -> list[Path]:
    """Return the ancestors that do not exist, deepest first."""
    return [parent for parent in path.parents if not parent.exists()]


def _remove_empty(folders: list[Path]) -> None:
    for folder in folders:
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
