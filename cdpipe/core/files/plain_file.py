"""The bytes of a plain file: no device, pipe or folder, and no more than a reader can use."""

from __future__ import annotations

import stat
from pathlib import Path

from cdpipe.core.errors import InputError


def require_plain_file(path: Path, most_bytes: int | None = None, expected: str = "") -> int:
    """Return the size of a file in bytes.

    A pipe, which would be waited for, or a device without end is refused before it is opened.

    Args:
        path: The file; links are followed.
        most_bytes: Largest size that is read.
        expected: What the file should be, at the end of the message.

    Raises:
        InputError: It is missing, cannot be reached, is no plain file, or is larger.
    """
    end = f": {expected}" if expected else ""
    try:
        status = path.stat()
    except FileNotFoundError as error:
        raise InputError(f"{path}: missing{end}") from error
    except (OSError, ValueError) as error:  # a name that holds a zero byte is a ValueError
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error}){end}") from error
    if not stat.S_ISREG(status.st_mode):
        what = "a folder" if stat.S_ISDIR(status.st_mode) else "a device or a pipe"
        raise InputError(f"{path}: cannot be read (it is {what}){end}")
    if most_bytes is not None and status.st_size > most_bytes:
        raise InputError(f"{path}: {_size(status.st_size)}, more than the {_size(most_bytes)} it may have{end}")
    return status.st_size


def read_bytes(path: Path, most_bytes: int | None = None, expected: str = "") -> bytes:
    """Return the content of a file.

    Raises:
        InputError: As `require_plain_file`, or the file cannot be read, or not be held in memory.
    """
    n_bytes = require_plain_file(path, most_bytes, expected)
    try:
        with path.open("rb") as file:
            return file.read(n_bytes)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}){f': {expected}' if expected else ''}") from error
    except MemoryError as error:
        raise InputError(f"{path}: {n_bytes / 1e9:.1f} GB, more than there is memory for") from error


def _size(n_bytes: int) -> str:
    return f"{n_bytes / 1e3:.1f} kB" if n_bytes < 1e5 else f"{n_bytes / 1e6:.{int(n_bytes < 1e7)}f} MB"
