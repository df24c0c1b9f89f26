"""Output files that are complete or absent."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cdpipe.core.errors import InputError
from cdpipe.core.names import path_part

_LONGEST_BYTES = 255  # of a name, which file systems take


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a hidden path that becomes `path` when the block succeeds, and is removed when it fails.

    Raises:
        InputError: The path is a device or a pipe, which would be replaced.
        OSError: The path is a folder, or nothing can be written there.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise InputError(f"{path}: a device or a pipe: name a file")
    if path.is_dir() and not path.is_symlink():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    partial = partial_of(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.unlink(missing_ok=True)  # it may be a link, which a writer would follow
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def partial_of(path: Path) -> Path:
    """Return the hidden name beside a path under which it is written first; of a long name it holds a part.

    Raises:
        OSError: The path's own name is too long.
    """
    if len(os.fsencode(path.name)) > _LONGEST_BYTES:
        raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG), str(path))
    name = f".{path.name}.partial"
    return path.with_name(name if len(os.fsencode(name)) <= _LONGEST_BYTES else f".{path_part(path.name)}.partial")
