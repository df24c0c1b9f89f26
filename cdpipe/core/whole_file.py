"""Output files that are complete or absent, and the hidden folders in which others are begun."""

from __future__ import annotations

import errno
import os
import shutil
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from cdpipe.core.errors import InputError
from cdpipe.core.names import path_part

if sys.platform != "win32":
    import fcntl

_FULL_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_LONGEST_BYTES = 255  # of a name, which file systems take
_MOST_CLAIMS = 100


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield the hidden path of an empty file that becomes `path` when the block succeeds, and is removed when it fails.

    Raises:
        InputError: The path is a device or a pipe, which would be replaced.
        BlockingIOError: Another process, or another thread, writes it now.
        OSError: The path is a folder, or nothing can be written there.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise InputError(f"{path}: a device or a pipe: name a file")
    if path.is_dir() and not path.is_symlink():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    partial = partial_of(path)
    handle = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = _claim_file(partial)
        try:
            yield partial
            partial.replace(path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
    except OSError as error:
        if error.filename == str(partial):
            error.filename = str(path)
        name_full_disk(error, path)
        raise
    finally:
        if handle is not None:
            os.close(handle)


def name_full_disk(error: OSError, path: Path) -> None:
    """Give the error of a full disk the name of the output, where the system tells none."""
    if error.filename is None and error.errno in _FULL_DISK:
        error.filename = str(path)


def partial_of(path: Path) -> Path:
    """Return the hidden name beside a path under which it is written first; of a long name it holds a part.

    Raises:
        OSError: The path's own name is too long.
    """
    if len(os.fsencode(path.name)) > _LONGEST_BYTES:
        raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG), str(path))
    name = f".{path.name}.partial"
    return path.with_name(name if len(os.fsencode(name)) <= _LONGEST_BYTES else f".{path_part(path.name)}.partial")


@contextmanager
def hidden_folder(path: Path, called: Path | None = None) -> Iterator[Path]:
    """Hold an empty hidden folder beside `path` for the block, which may rename it; else it is removed at the end.

    What a killed process left there is removed. Folders above it are made.

    Args:
        path: The output.
        called: What messages call it; left out: `path`.

    Raises:
        InputError: Another process holds it.
        OSError: It cannot be made, or its name is another's.
    """
    partial = partial_of(path)
    try:
        handle = _claim(partial)
    except BlockingIOError as error:
        raise InputError(
            f"{called or path}: another `tunnelcd` writes there: wait until it ends, or name another"
        ) from error
    try:
        for child in list(os.scandir(partial)):
            if child.is_dir(follow_symlinks=False):
                shutil.rmtree(child.path)
            else:
                Path(child.path).unlink()
        yield partial
    finally:
        # a folder that was renamed has its own name; under this one there may be the next one of another
        if _is_held(handle, partial):
            shutil.rmtree(partial, ignore_errors=True)
        if handle is not None:
            os.close(handle)


def hold(folder: Path) -> int | None:
    """Hold a folder against other processes that ask for it, until the handle is closed or this process dies.

    Returns:
        The handle; None on a system without such locks. Some network disks hold no locks, and exclude nobody.

    Raises:
        BlockingIOError: Another process holds it.
        OSError: There is no such folder, or it cannot be read.
    """
    if sys.platform == "win32":
        return None
    return _locked(os.open(folder, os.O_RDONLY | os.O_DIRECTORY))


def _locked(handle: int) -> int:
    """Lock an open file or folder and return its handle, which is closed where another process holds it."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise
    except OSError:
        pass
    return handle


def _claim_file(partial: Path) -> int | None:
    """Make a new file of that name and hold it; what a killed process left there is removed."""
    if sys.platform == "win32":
        partial.unlink(missing_ok=True)
        return None
    for _ in range(_MOST_CLAIMS):
        try:
            handle = _locked(os.open(partial, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666))
        except FileExistsError:
            _remove_unheld(partial)
        except BlockingIOError:
            continue  # another looks whether it is held
        else:
            if _is_held(handle, partial):
                return handle
            os.close(handle)
    raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK), str(partial))


def _remove_unheld(partial: Path) -> None:
    """Remove a file that no process holds; of a link only the link.

    Raises:
        BlockingIOError: A process holds it.
    """
    handle = None
    try:
        if stat.S_ISREG(partial.lstat().st_mode):
            for access in (os.O_RDWR, os.O_RDONLY):  # a network disk locks only what may be written
                with suppress(PermissionError):
                    handle = _locked(os.open(partial, access | os.O_NOFOLLOW | os.O_NONBLOCK))
                    break
        if handle is None or _is_held(handle, partial):
            partial.unlink()
    except FileNotFoundError:
        pass
    except BlockingIOError as error:
        raise BlockingIOError(error.errno, "another `tunnelcd` writes there", str(partial)) from error
    finally:
        if handle is not None:
            os.close(handle)


def _claim(partial: Path) -> int | None:
    """Hold the hidden folder of that name; make it unless it is there."""
    for _ in range(_MOST_CLAIMS):
        partial.parent.mkdir(parents=True, exist_ok=True)  # another that is refused may remove them
        try:
            partial.mkdir()
        except FileExistsError:
            if partial.is_symlink() or partial.is_file() or _is_of_another(partial):
                raise
        except FileNotFoundError:
            continue
        except KeyboardInterrupt:
            with suppress(OSError):
                partial.rmdir()
            raise
        try:
            handle = hold(partial)
        except FileNotFoundError:
            continue
        if _is_held(handle, partial):
            return handle
        # meanwhile its holder has renamed or removed it, and a lock on that excludes nobody
        if handle is not None:
            os.close(handle)
    # a network disk may tell other numbers of an open folder than of its name
    raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK), str(partial))


def _is_of_another(folder: Path) -> bool:
    """Return whether a folder is another user's, who could exchange what is written there, or lead it elsewhere."""
    if sys.platform == "win32":
        return False
    try:
        return folder.lstat().st_uid != os.geteuid()
    except FileNotFoundError:
        return False


def _is_held(handle: int | None, path: Path) -> bool:
    """Return whether a handle is still that of this name; without a handle, whether there is a folder of this name."""
    try:
        found = path.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) if handle is None else os.path.samestat(os.fstat(handle), found)
