"""How a program ends: what a user can cause is one line for each mistake and exit code 2."""

from __future__ import annotations

import errno
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from cdpipe.core.errors import TunnelcdError

# A full disk, a read-only one, a file too large for it, a folder or file of somebody else's.
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EACCES, errno.EPERM)


@contextmanager
def input_errors() -> Iterator[None]:
    """Turn what a user can cause into one line for each mistake and exit code 2; anything else stays a traceback."""
    try:
        yield
    except TunnelcdError as error:
        for line in str(error).splitlines():
            sys.stderr.write(f"error: {line}\n")
        raise SystemExit(2) from error
    except OSError as error:
        if error.errno not in _DISK_ERRORS:
            raise
        sys.stderr.write(
            f"error: {error.filename or 'the output'}: {error.strerror}: give it a disk with room and leave to write\n"
        )
        raise SystemExit(2) from error
